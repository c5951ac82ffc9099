"""Loading, resizing and cropping of camera images, with an update of the projections."""

from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import mmcv
import numpy as np
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from mmengine.logging import print_log
from torch.utils.data import get_worker_info

from gsmap.datasets.image_files import read_image
from gsmap.datasets.transforms.image_steps import (
    FILTERS,
    CropTop,
    Resize,
    finish_on_host,
    shape_after_steps,
    take_step,
)
from gsmap.utils.errors import InputError

# If an image shrinks by a larger factor, bilinear interpolation between four pixels skips pixels.
_MAX_BILINEAR_SHRINKAGE = 2.0


@TRANSFORMS.register_module()
@dataclass(eq=False)
class LoadCameraImages(BaseTransform):
    """Load and check the images of all cameras.

    The transform adds the keys of ``LoadMultiViewImageFromFiles`` of mmdet3d that other transforms
    read, and ``lidar2img``, ``img_aug_matrix`` (lists of (4, 4)) and ``img_path``. The matrix
    ``img_aug_matrix`` collects the changes of pixel coordinates by later transforms.

    Smaller images are padded at the bottom and right to the size of the largest. ``raw_shapes`` has
    (height, width) of each image without the padding, and later transforms keep it up to date.
    Unlike in mmdet3d, images are contiguous arrays and not strided views of a stack: a copy of such
    a view takes as long as the decoding of the image.

    Args:
        to_float32: Whether to convert the images to float32 directly after loading.
        on_device: Whether to leave the images in uint8 and to record the later image steps
            (`image_steps`), which the GPU then carries out. ``to_float32`` then converts nothing
            here.
    """

    to_float32: bool = True
    on_device: bool = False

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load the images of ``results['images']``.

        Raises:
            BrokenSampleError: If a file is missing or damaged, or does not match the record.
        """
        cameras = results["images"]
        images = []
        raw_shapes = []
        max_height = 0
        max_width = 0
        for name, camera in cameras.items():
            where = f"sample {results['token']!r}, camera {name}"
            image = read_image(camera["img_path"], where=where, size=camera.get("size"))
            height, width = image.shape[:2]
            images.append(image)
            raw_shapes.append((height, width))
            max_height = max(max_height, height)
            max_width = max(max_width, width)
        shape = (max_height, max_width)
        converts_here = self.to_float32 and not self.on_device
        results["img"] = []
        for image in images:
            if image.shape[:2] != shape:
                image = mmcv.impad(image, shape=shape)
            if converts_here:
                image = image.astype(np.float32)
            results["img"].append(image)
        results["to_float32"] = self.to_float32  # `ScaleImages` rounds pixels if this is False
        results["raw_shapes"] = raw_shapes
        if self.on_device:
            results["image_steps"] = []  # the list makes later transforms record their steps
        results["img_shape"] = results["ori_shape"] = results["pad_shape"] = shape
        results["num_views"] = len(images)
        for key in ("img_path", "cam2img", "lidar2cam"):
            results[key] = [camera[key] for camera in cameras.values()]
        results["img_aug_matrix"] = [np.eye(4) for _ in images]
        results["lidar2img"] = []
        for camera in cameras.values():
            results["lidar2img"].append(camera["cam2img"] @ camera["lidar2cam"])
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class ScaleImages(BaseTransform):
    """Resize all images and update ``lidar2img`` and ``img_aug_matrix``.

    Args:
        scale: Factor, > 0. Sizes are rounded down, and the matrices are multiplied by the exact
            ratio of each axis. Either ``scale`` or ``size`` must be given.
        size: Width and height of all images after the transform, in pixels. The padding of smaller
            images is removed first.
        trained_size: Width and height of the training images in pixels. If ``scale`` leads to
            another length of the longer side, the images are resized to the longer side of
            ``trained_size`` instead, without cropping or padding. They are averaged by area if they
            shrink by more than a factor of 2. None always uses ``scale``.
        kernel: ``bilinear`` or ``bicubic``, see `Resize`.

    Raises:
        ValueError: If both or neither of ``scale`` and ``size`` are given, the given one is not
            positive, or the kernel is unknown.
    """

    scale: float | None = None
    size: tuple[int, int] | None = None
    trained_size: tuple[int, int] | None = None
    kernel: str = "bilinear"

    def __post_init__(self) -> None:
        if self.kernel not in FILTERS:
            raise InputError(f"kernel must be one of {FILTERS}, got {self.kernel!r}.")
        if (self.scale is None) == (self.size is None):
            raise InputError(f"give scale or size, got {self.scale} and {self.size}.")
        smallest = min(self.size) if self.size else cast(float, self.scale)
        if not smallest > 0:  # also refuses NaN
            raise InputError(f"scale or size must be > 0, got {self.size or self.scale}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Resize ``results['img']``.

        Raises:
            ValueError: If the images would have no pixel.
        """
        if self.size is not None:
            width, height = self.size
            return self._resize_to_size(results, size=(int(width), int(height)))
        # The recorded steps have not changed the pixels yet, so the images may have another size.
        height, width = shape_after_steps(results)
        size = self.output_size(width, height)
        by_area = False
        if self.trained_size is not None and max(size) != max(self.trained_size):
            factor = max(self.trained_size) / max(width, height)
            size = _scaled_size((width, height), factor)
            by_area = min(size) > 0 and width / size[0] > _MAX_BILINEAR_SHRINKAGE
            _log_other_scale(
                (width, height), size, trained_size=tuple(self.trained_size), by_area=by_area
            )
        if min(size) < 1:
            raise InputError(f"scale {self.scale} leaves nothing of a {width} x {height} image.")
        matrix = np.diag([size[0] / width, size[1] / height, 1.0, 1.0])
        if by_area:
            # No image step averages by area, so all recorded steps are carried out on the host now.
            finish_on_host(results)
            images = results["img"]
            results["img"] = [mmcv.imresize(img, size, interpolation="area") for img in images]
        elif size != (width, height):
            # Resizes the images now, or records the step for the GPU.
            take_step(results, self._resize_step(results, size))
        _transform_pixels(results, matrix)
        raw_shapes = []
        for raw_height, raw_width in results["raw_shapes"]:
            raw_shapes.append((round(raw_height * matrix[1, 1]), round(raw_width * matrix[0, 0])))
        results["raw_shapes"] = raw_shapes
        results["img_shape"] = results["pad_shape"] = size[::-1]  # (height, width)
        results["scale_factor"] = size[0] / width
        return results

    def _resize_step(self, results: dict[str, Any], size: tuple[int, int]) -> Resize:
        """Return the step that resizes all images to (width, height)."""
        return Resize(size, rounded=not results.get("to_float32", True), kernel=self.kernel)

    def _resize_to_size(self, results: dict[str, Any], size: tuple[int, int]) -> dict[str, Any]:
        """Resize each image without its padding to (width, height)."""
        step = self._resize_step(results, size)
        raw_shapes = results["raw_shapes"]
        if len(set(raw_shapes)) > 1:
            # A recorded step would resize all images, with their padding, by equal factors.
            finish_on_host(results)
            cropped_images = []
            for image, (height, width) in zip(results["img"], raw_shapes, strict=True):
                cropped_images.append(image[:height, :width])
            results["img"] = step.on_host(cropped_images)
        else:  # no image has padding
            take_step(results, step)
        scalings = []
        for height, width in raw_shapes:
            scalings.append(np.diag([size[0] / width, size[1] / height, 1.0, 1.0]))
        for key in ("lidar2img", "img_aug_matrix"):
            pairs = zip(scalings, results[key], strict=True)
            results[key] = [scaling @ projection for scaling, projection in pairs]
        # Shapes are (height, width).
        results["raw_shapes"] = [size[::-1]] * len(results["img"])
        results["img_shape"] = results["pad_shape"] = size[::-1]
        return results

    def output_size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height after the transform for images of a given size, in pixels."""
        if self.size is not None:
            return self.size
        return _scaled_size((width, height), cast(float, self.scale))


@TRANSFORMS.register_module()
@dataclass(eq=False)
class CropImages(BaseTransform):
    """Crop rows, usually of the sky, at the top of all images and update the matrices.

    Args:
        top: Number of rows to remove, at least 1.

    Raises:
        ValueError: If ``top`` is less than 1.
    """

    top: int

    def __post_init__(self) -> None:
        if self.top < 1:
            raise InputError(f"top must be >= 1 row, got {self.top}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Crop ``results['img']``.

        Raises:
            ValueError: If the images have no more than ``top`` rows.
        """
        height, width = shape_after_steps(results)
        if height <= self.top:
            raise InputError(f"top={self.top} leaves nothing of images of {height} rows.")
        # A projection gives (u z, v z, z), so the shift of v is multiplied by z.
        matrix = np.eye(4)
        matrix[1, 2] = -self.top
        take_step(results, CropTop(self.top))
        _transform_pixels(results, matrix)
        raw_shapes = results["raw_shapes"]
        results["raw_shapes"] = [(rows - self.top, cols) for rows, cols in raw_shapes]
        results["img_shape"] = results["pad_shape"] = (height - self.top, width)
        return results


def _transform_pixels(results: dict[str, Any], matrix: np.ndarray) -> None:
    """Multiply the projections of all views by a transform of pixels. (4, 4)"""
    for key in ("lidar2img", "img_aug_matrix"):
        results[key] = [matrix @ projection for projection in results[key]]


def _scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Multiply (width, height) by a factor and round down, in pixels."""
    width, height = size
    # 1e-6: 0.58 * 100 is 57.99..., which must not be rounded down to 57
    return int(width * scale + 1e-6), int(height * scale + 1e-6)


@cache
def _log_other_scale(
    input_size: tuple[int, int],
    output_size: tuple[int, int],
    trained_size: tuple[int, ...],
    by_area: bool,
) -> None:
    """Log once that images are not resized by the factor in the config.

    The cache skips a call with arguments that have been logged. Sizes are width and height in
    pixels.
    """
    worker = get_worker_info()
    if worker is None or worker.id == 0:  # only one of the loader's workers logs
        by_area_text = ", by area" if by_area else ""
        print_log(
            f"images of {input_size[0]} x {input_size[1]} are scaled to {output_size[0]} x "
            f"{output_size[1]}, without cropping or padding{by_area_text}, as the model was "
            f"trained at {trained_size[0]} x {trained_size[1]}; --image-scale gives another "
            "factor.",
            logger="current",
        )
