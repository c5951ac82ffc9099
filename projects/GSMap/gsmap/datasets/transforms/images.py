"""Camera images: loading with checks, and scaling with the matrices kept right."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import mmcv
import numpy as np
import simplejpeg
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from PIL import Image, UnidentifiedImageError

from gsmap.datasets.errors import BrokenSampleError

_JPEG_START = b"\xff\xd8"
_EXIF = b"Exif\0\0"
_HEADER_BYTES = 1 << 17
_ORIENTATION = 0x0112  # EXIF's tag; 1 is upright


def read_image(path: str, where: str, size: tuple[int, int] | None = None) -> np.ndarray:
    """Read an image file and make sure that it is whole and what its record says.

    Of a JPEG even a decoder's warning counts: OpenCV paints what is missing grey and says nothing.

    Args:
        path: The file.
        where: Sample and camera, for the message.
        size: Width and height that it must have, if they are known.

    Returns:
        The image, BGR. (H, W, 3)

    Raises:
        BrokenSampleError: If it is missing, damaged, no image, of another size, or to be turned.
    """
    file = Path(path)
    if not file.is_file():
        raise BrokenSampleError(f"{where}: no image at {path}; is data_root right?")
    content = file.read_bytes()
    try:
        found = _size(content)
        image = _decoded(content) if size in (None, found) else None
    except UnidentifiedImageError as error:
        raise BrokenSampleError(f"{where}: {path} is not an image; copy it again.") from error
    except (ValueError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise BrokenSampleError(
            f"{where}: {path} is truncated or damaged ({error}); copy it again."
        ) from error
    if image is None:
        raise BrokenSampleError(
            f"{where}: {path} has {found[0]} x {found[1]} pixels, its record says {size}, and the "
            "calibration is for that: copy the original, or make the annotation file for these "
            "images."
        )
    return image


def _size(content: bytes) -> tuple[int, int]:
    """Return an image's width and height; a JPEG must be upright as it is stored."""
    if not content.startswith(_JPEG_START):
        with Image.open(BytesIO(content)) as picture:
            return picture.size
    if content.find(_EXIF, 0, _HEADER_BYTES) >= 0:
        with Image.open(BytesIO(content)) as picture:
            orientation = picture.getexif().get(_ORIENTATION, 1)
        if orientation != 1:
            raise ValueError(f"its EXIF wants it turned, orientation {orientation}: turn the file")
    height, width = simplejpeg.decode_jpeg_header(content)[:2]
    return width, height


def _decoded(content: bytes) -> np.ndarray:
    """Decode an image; a warning is an error. (H, W, 3)."""
    if content.startswith(_JPEG_START):
        return simplejpeg.decode_jpeg(content, colorspace="BGR")
    with Image.open(BytesIO(content)) as picture:
        return np.ascontiguousarray(np.asarray(picture.convert("RGB"))[:, :, ::-1])


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
    """

    to_float32: bool = True

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load ``results['images']``; BrokenSampleError if one is not as its record says."""
        cameras, token = results["images"], results["token"]
        images = [
            read_image(camera["img_path"], f"sample {token!r}, camera {name}", camera.get("size"))
            for name, camera in cameras.items()
        ]
        results["raw_shapes"] = [image.shape[:2] for image in images]
        shape = tuple(map(max, zip(*results["raw_shapes"], strict=True)))
        padded = [i if i.shape[:2] == shape else mmcv.impad(i, shape=shape) for i in images]
        results["img"] = [i.astype(np.float32) if self.to_float32 else i for i in padded]
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
class ScaleImages(BaseTransform):
    """Resize all images and update ``lidar2img`` and ``img_aug_matrix``.

    Args:
        scale: Factor, > 0; sizes are rounded down, and the matrices take the exact ratio of each
            axis. ValueError if it is not positive.
    """

    def __init__(self, scale: float) -> None:
        if not scale > 0:
            raise ValueError(f"scale must be > 0, got {scale}.")
        self.scale = scale

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Scale ``results['img']``."""
        height, width = results["img"][0].shape[:2]
        # 1e-6: a factor such as 0.58 * 100 must not round down to 57
        size = (int(width * self.scale + 1e-6), int(height * self.scale + 1e-6))
        if min(size) < 1:
            raise ValueError(f"scale {self.scale} leaves nothing of a {width} x {height} image.")
        matrix = np.diag([size[0] / width, size[1] / height, 1.0, 1.0])
        if size != (width, height):
            results["img"] = [mmcv.imresize(img, size) for img in results["img"]]
        for key in ("lidar2img", "img_aug_matrix"):
            results[key] = [matrix @ m for m in results[key]]
        results["img_shape"] = results["pad_shape"] = size[::-1]
        results["scale_factor"] = self.scale
        return results
