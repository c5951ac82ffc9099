"""Image files: their size, their pixels with every doubt about them an error, and JPEG."""

from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from PIL import Image, UnidentifiedImageError

from gsmap.datasets.errors import BrokenSampleError

_JPEG_START = b"\xff\xd8"
_EXIF = b"Exif\0\0"
_HEADER_BYTES = 1 << 17
_ORIENTATION = 0x0112  # EXIF's tag; 1 is upright


def image_size(file: Path, where: str) -> tuple[int, int]:
    """Return an image's width and height in pixels; its pixels are not read.

    Messages begin with ``where``: FileNotFoundError without the file, ValueError if it is no image.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no image at {file}; paths are relative to data_root.")
    try:
        with Image.open(file) as image:
            return image.size
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        if getattr(error, "errno", None):
            raise
        raise ValueError(f"{where}: {file} is not an image; fetch it again.") from error


def read_image(
    path: str | np.ndarray, where: str, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Read an image file and make sure that it is whole and what its record says.

    Args:
        path: The file; an image that lies in memory, BGR, is returned.
        where: Sample and camera, for the message.
        size: Width and height that it must have, if they are known.

    Returns:
        The image, BGR. (H, W, 3)

    Raises:
        BrokenSampleError: If it is missing, damaged, no image, of another size, or to be turned.
    """
    if isinstance(path, np.ndarray):
        return path
    file = Path(path)
    if not file.is_file():
        raise BrokenSampleError(f"{where}: no image at {path}; is data_root right?")
    return decode_image(file.read_bytes(), path, where, size)


def decode_image(
    content: bytes, path: str, where: str, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Decode the content of an image file, as ``read_image`` does.

    Of a JPEG even a decoder's warning counts: OpenCV paints what is missing grey and says nothing.

    Args:
        content: What the file holds.
        path: Its path, for messages.
        where: What messages begin with, such as the sample and the camera.
        size: Width and height in pixels that it must have; None takes any.
    """
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


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """Return an image, BGR (H, W, 3), as the content of a JPEG file of a quality in 0 to 100."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


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
