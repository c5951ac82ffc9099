"""Camera images: loading with checks, and scaling with the matrices kept right."""

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

_MOST_SHRUNK = 2.0  # by bilinear sampling, which reads four pixels


@TRANSFORMS.register_module()
@dataclass(eq=False)
class LoadCameraImages(BaseTransform):
    """Load the images of all cameras, naming sample and file when one is damaged.

    Adds the keys of mmdet3d's ``LoadMultiViewImageFromFiles`` that others read, and ``lidar2img``,
    ``img_aug_matrix`` (lists of (4, 4)) and ``img_path``. Images of different size are padded at
    the bottom and right to the largest; ``raw_shapes`` are (height, width) before that. Unlike
    there, no image is a strided view of a stack, which costs as much as decoding.

    Args:
        to_float32: Whether to convert to float32 before anything else.
        on_device: Whether later steps are noted for a GPU (`image_steps`); images stay uint8.
    """

    to_float32: bool = True
    on_device: bool = False

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load ``results['images']``; BrokenSampleError if one is not as its record says."""
        cameras, token = results["images"], results["token"]
        images = [
            read_image(camera["img_path"], f"sample {token!r}, camera {name}", camera.get("size"))
            for name, camera in cameras.items()
        ]
        results["to_float32"] = self.to_float32
        results["raw_shapes"] = [image.shape[:2] for image in images]
        shape = tuple(map(max, zip(*results["raw_shapes"], strict=True)))
        padded = [i if i.shape[:2] == shape else mmcv.impad(i, shape=shape) for i in images]
        converts = self.to_float32 and not self.on_device
        results["img"] = [i.astype(np.float32) if converts else i for i in padded]
        if self.on_device:
            results["image_steps"] = []
        results["img_shape"] = results["ori_shape"] = results["pad_shape"] = shape
        results["num_views"] = len(images)
        for key in ("img_path", "cam2img", "lidar2cam"):
            results[key] = [camera[key] for camera in cameras.values()]
        results["img_aug_matrix"] = [np.eye(4) for _ in images]
        results["lidar2img"] = [
            cam2img @ lidar2cam
            for cam2img, lidar2cam in zip(results["cam2img"], results["lidar2cam"], strict=True)
        ]
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class ScaleImages(BaseTransform):
    """Resize all images and update ``lidar2img`` and ``img_aug_matrix``.

    Args:
        scale: Factor, > 0; sizes are rounded down, and the matrices take the exact ratio of each
            axis.
        size: In place of a factor, the width and height of every image, without the padding that
            made them equal.
        trained_size: Width and height, in pixels, that a model was trained at: images that
            ``scale`` would make larger or smaller get the longer side of it in place of that. They
            are neither cropped nor padded. Beyond a factor of 2 they shrink by area, so that no
            pixel is left out; what ``scale`` does is that of the training.
        kernel: ``bilinear`` or ``bicubic``, see `Resize`.

    Raises:
        ValueError: If there is not one of factor and size, it is not positive, or the kernel is
            unknown.
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
        if not min(self.size or (cast(float, self.scale),)) > 0:
            raise InputError(f"scale or size must be > 0, got {self.size or self.scale}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Scale ``results['img']``."""
        if self.size is not None:
            return self._to_size(results, (int(self.size[0]), int(self.size[1])))
        height, width = shape_after_steps(results)
        size, by_area = self.scaled(width, height), False
        if self.trained_size is not None and max(size) != max(self.trained_size):
            size = _times((width, height), max(self.trained_size) / max(width, height))
            by_area = min(size) > 0 and width / size[0] > _MOST_SHRUNK
            _say_scaled((width, height), size, tuple(self.trained_size), by_area)
        if min(size) < 1:
            raise InputError(f"scale {self.scale} leaves nothing of a {width} x {height} image.")
        matrix = np.diag([size[0] / width, size[1] / height, 1.0, 1.0])
        if by_area:
            finish_on_host(results)
            results["img"] = [
                mmcv.imresize(img, size, interpolation="area") for img in results["img"]
            ]
        elif size != (width, height):
            take_step(results, self._resize(results, size))
        for key in ("lidar2img", "img_aug_matrix"):
            results[key] = [matrix @ m for m in results[key]]
        results["img_shape"] = results["pad_shape"] = size[::-1]
        results["scale_factor"] = size[0] / width
        return results

    def _resize(self, results: dict[str, Any], size: tuple[int, int]) -> Resize:
        """Return the step that brings all images to a size (width, height)."""
        return Resize(size, rounded=not results.get("to_float32", True), kernel=self.kernel)

    def _to_size(self, results: dict[str, Any], size: tuple[int, int]) -> dict[str, Any]:
        """Bring each image, as large as it was loaded, to a size (width, height)."""
        step = self._resize(results, size)
        if len(set(results["raw_shapes"])) > 1:
            finish_on_host(results)
            results["img"] = step.on_host(
                [
                    img[:height, :width]
                    for img, (height, width) in zip(
                        results["img"], results["raw_shapes"], strict=True
                    )
                ]
            )
        else:
            take_step(results, step)
        for view, (height, width) in enumerate(results["raw_shapes"]):
            matrix = np.diag([size[0] / width, size[1] / height, 1.0, 1.0])
            for key in ("lidar2img", "img_aug_matrix"):
                results[key][view] = matrix @ results[key][view]
        results["raw_shapes"] = [size[::-1]] * len(results["img"])
        results["img_shape"] = results["pad_shape"] = size[::-1]
        return results

    def scaled(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of an image after it, in pixels."""
        if self.size is not None:
            return self.size
        return _times((width, height), cast(float, self.scale))


@TRANSFORMS.register_module()
@dataclass(eq=False)
class CropImages(BaseTransform):
    """Cut rows off the top of all images, the sky, and update the matrices.

    Args:
        top: Rows, > 0; ValueError if not, or if an image has no more.
    """

    top: int

    def __post_init__(self) -> None:
        if self.top < 1:
            raise InputError(f"top must be >= 1 row, got {self.top}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Crop ``results['img']``."""
        height, width = shape_after_steps(results)
        if height <= self.top:
            raise InputError(f"top={self.top} leaves nothing of images of {height} rows.")
        matrix = np.eye(4)
        matrix[1, 2] = -self.top
        take_step(results, CropTop(self.top))
        for key in ("lidar2img", "img_aug_matrix"):
            results[key] = [matrix @ m for m in results[key]]
        results["raw_shapes"] = [(rows - self.top, cols) for rows, cols in results["raw_shapes"]]
        results["img_shape"] = results["pad_shape"] = (height - self.top, width)
        return results


def _times(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return width and height of a scaled image, in pixels."""
    # 1e-6: a factor such as 0.58 * 100 must not round down to 57
    return int(size[0] * scale + 1e-6), int(size[1] * scale + 1e-6)


@cache
def _say_scaled(
    found: tuple[int, int], size: tuple[int, int], trained: tuple[int, ...], by_area: bool
) -> None:
    """Say once that images are not scaled as the config says."""
    worker = get_worker_info()
    if worker is None or worker.id == 0:
        print_log(
            "images of {} x {} are scaled to {} x {}, without cropping or padding{}, as the model "
            "was trained at {} x {}; --image-scale gives another factor.".format(
                *found, *size, ", by area" if by_area else "", *trained
            ),
            "current",
        )
