"""Camera images: loading with checks, and scaling with the matrices kept right."""

from pathlib import Path
from typing import Any

import mmcv
import numpy as np
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS

from gsmap.datasets.errors import BrokenSampleError

_JPEG_SUFFIXES = {".jpg", ".jpeg"}
_JPEG_END = b"\xff\xd9"
_TAIL_BYTES = 1024


def check_image_file(path: str, where: str) -> None:
    """Check that an image file exists and, if it is a JPEG, that it is not cut short.

    OpenCV decodes a truncated JPEG to a picture whose rest is grey, without an error.

    Args:
        path: The file.
        where: Sample and camera, for the message.

    Raises:
        BrokenSampleError: If it is missing, empty or truncated.
    """
    file = Path(path)
    if not file.is_file():
        raise BrokenSampleError(f"{where}: no image at {path}; is data_root right?")
    size = file.stat().st_size
    with file.open("rb") as stream:
        stream.seek(max(size - _TAIL_BYTES, 0))
        tail = stream.read()
    if not size or (file.suffix.lower() in _JPEG_SUFFIXES and _JPEG_END not in tail):
        raise BrokenSampleError(f"{where}: {path} is truncated ({size} bytes); copy it again.")


def read_image(path: str, where: str, color_type: str = "color") -> np.ndarray:
    """Read an image file and make sure that it is whole.

    Args:
        path: The file.
        where: Sample and camera, for the message.
        color_type: As in ``mmcv.imfrombytes``.

    Returns:
        The image, BGR unless ``color_type`` says otherwise. (H, W, 3)

    Raises:
        BrokenSampleError: If it is missing, truncated or no image.
    """
    check_image_file(path, where)
    content = Path(path).read_bytes()
    image = mmcv.imfrombytes(content, flag=color_type)
    if image is None:
        raise BrokenSampleError(
            f"{where}: {path} is not an image that OpenCV can decode; copy it again."
        )
    return image


@TRANSFORMS.register_module()
class LoadCameraImages(BaseTransform):
    """Load the images of all cameras, naming sample and file when one is damaged.

    Adds the keys of mmdet3d's ``LoadMultiViewImageFromFiles`` that others read, and ``lidar2img``,
    ``img_aug_matrix`` (lists of (4, 4)) and ``img_path``. Images of different size are padded at
    the bottom and right to the largest; ``raw_shapes`` are (height, width) before that.

    mmdet3d's transform stacks the images along a last axis and takes strided views of that: copies
    that cost as much as decoding, and would make each later step slower.

    Args:
        to_float32: Whether to convert to float32 before anything else.
        color_type: As in ``mmcv.imfrombytes``.
    """

    def __init__(self, to_float32: bool = True, color_type: str = "color") -> None:
        self.to_float32 = to_float32
        self.color_type = color_type

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load ``results['images']``.

        Raises:
            BrokenSampleError: If an image is missing or damaged.
        """
        cameras = results["images"]
        images = [
            read_image(
                camera["img_path"], f"sample {results['token']!r}, camera {name}", self.color_type
            )
            for name, camera in cameras.items()
        ]
        height = max(image.shape[0] for image in images)
        width = max(image.shape[1] for image in images)
        results["img"] = [self._prepared(image, (height, width)) for image in images]
        results["img_shape"] = results["ori_shape"] = results["pad_shape"] = (height, width)
        results["raw_shapes"] = [image.shape[:2] for image in images]
        results["num_views"] = len(images)
        results["img_path"] = [camera["img_path"] for camera in cameras.values()]
        results["cam2img"] = [camera["cam2img"] for camera in cameras.values()]
        results["lidar2cam"] = [camera["lidar2cam"] for camera in cameras.values()]
        results["img_aug_matrix"] = [np.eye(4) for _ in images]
        results["lidar2img"] = [
            cam2img @ lidar2cam
            for cam2img, lidar2cam in zip(results["cam2img"], results["lidar2cam"], strict=True)
        ]
        return results

    def _prepared(self, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Pad an image to the common size and convert it. (H, W, 3)."""
        if image.shape[:2] != size:
            image = mmcv.impad(image, shape=size, pad_val=0)
        return image.astype(np.float32) if self.to_float32 else image


@TRANSFORMS.register_module()
class ScaleImages(BaseTransform):
    """Resize all images and update ``lidar2img`` and ``img_aug_matrix``.

    Args:
        scale: Factor, > 0; sizes are rounded down, and the matrices take the exact ratio of each
            axis.
        interpolation: As in ``mmcv.imresize``.

    Raises:
        ValueError: If ``scale`` is not positive.
    """

    def __init__(self, scale: float, interpolation: str = "bilinear") -> None:
        if not scale > 0:
            raise ValueError(f"scale must be > 0, got {scale}.")
        self.scale = scale
        self.interpolation = interpolation

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Scale ``results['img']``."""
        height, width = results["img"][0].shape[:2]
        # 1e-6: a factor such as 0.58 * 100 must not round down to 57
        size = (int(width * self.scale + 1e-6), int(height * self.scale + 1e-6))
        if min(size) < 1:
            raise ValueError(f"scale {self.scale} leaves nothing of a {width} x {height} image.")
        matrix = np.diag([size[0] / width, size[1] / height, 1.0, 1.0])
        if size != (width, height):
            results["img"] = [
                mmcv.imresize(img, size, interpolation=self.interpolation) for img in results["img"]
            ]
        results["lidar2img"] = [matrix @ m for m in results["lidar2img"]]
        results["img_aug_matrix"] = [matrix @ m for m in results["img_aug_matrix"]]
        results["img_shape"] = results["pad_shape"] = size[::-1]
        results["scale_factor"] = self.scale
        return results

    def __repr__(self) -> str:
        return f"{type(self).__name__}(scale={self.scale})"
