"""Image files: their size, their pixels with every doubt about them an error, and JPEG."""

import os
import struct
import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, WebPImagePlugin

from gsmap.datasets.errors import BrokenSampleError
from gsmap.utils.errors import InputError
from gsmap.utils.files import fetch_advice

_PLUGINS = (JpegImagePlugin, PngImagePlugin, WebPImagePlugin, BmpImagePlugin)  # no other is opened
FORMATS = ("JPEG", "PNG", "WEBP", "BMP")
_STARTS = {b"\xff\xd8": "jpeg", b"\x89PNG": "png", b"RIFF": "webp", b"BM": "bmp"}
_JPEG_START = b"\xff\xd8"
_TURNING = (b"Exif\0\0", b"tiff:Orientation")  # entries of EXIF and XMP may say how it is turned
_ORIENTATION = 0x0112  # EXIF's tag
_TURNED = range(2, 9)  # 1 is upright, 0 is not set, others mean nothing
_MOST_PIXELS = 10**8  # of an image; a decoder takes memory for all that its header says
_MOST_SCANS = 100  # of a JPEG, each of which may cost as much as the whole image
_SCAN = b"\xff\xda"
_DIM = 1 << 14  # of 16 bits; what stays below has 14 bits or fewer, and would be next to black
# what pillow and simplejpeg raise on files that make no sense
_DAMAGE = (
    ValueError, OSError, SyntaxError, EOFError, LookupError, TypeError, AttributeError,
    ArithmeticError, AssertionError, RuntimeError, struct.error, zlib.error,
    Image.DecompressionBombError,
)  # fmt: skip


class _UnfitError(Exception):
    """An image is whole, but cannot be used as it is."""


def image_size(file: Path, where: str) -> tuple[int, int]:
    """Return an image's width and height in pixels; its pixels are not read.

    Messages begin with ``where``: FileNotFoundError without the file, ValueError if it is no image.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no image at {file}; {_why_missing(file)}.")
    with file.open("rb") as opened:
        start = opened.read(100)
        try:
            with Image.open(opened, formats=FORMATS) as image:
                _require_moderate(image.size)
                return image.size
        except _UnfitError as error:
            raise InputError(f"{where}: {file} cannot be used: {error}.") from error
        except _DAMAGE as error:
            if getattr(error, "errno", None):
                raise
            raise InputError(_no_image(where, file, start)) from error


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
        raise BrokenSampleError(f"{where}: no image at {path}; {_why_missing(file)}.")
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
    if _format_of(content) is None:
        raise BrokenSampleError(_no_image(where, path, content))
    try:
        decode = _decoded_jpeg if content.startswith(_JPEG_START) else _decoded_other
        found, image = decode(content, size)
    except _UnfitError as error:
        raise BrokenSampleError(f"{where}: {path} cannot be used: {error}.") from error
    except _DAMAGE as error:
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


def image_content(file: Path, where: str, size: tuple[int, int]) -> tuple[bytes, str]:
    """Return an image file's content to be copied, once it is known to be that of an image.

    Args:
        file: The file.
        where: What messages begin with.
        size: Width and height in pixels that it must have.

    Returns:
        The content and its format: ``jpeg``, ``png`` or ``webp``. A BMP becomes a JPEG.

    Raises:
        FileNotFoundError: If there is no such file.
        BrokenSampleError: As by ``read_image``.
    """
    content = file.read_bytes()
    image = decode_image(content, str(file), where, size)
    kind = _format_of(content) or ""
    return (encode_jpeg(image, 95), "jpeg") if kind == "bmp" else (content, kind)


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """Return an image, BGR (H, W, 3), as the content of a JPEG file of a quality in 0 to 100."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _format_of(content: bytes) -> str | None:
    """Return the format that a file's first bytes tell, if it is one that is read."""
    return next((kind for start, kind in _STARTS.items() if content.startswith(start)), None)


def _why_missing(file: Path) -> str:
    """Return why a file is not there, and the remedy."""
    if file.is_symlink():
        return f"it is a link to {os.readlink(file)!r}, which is not there"
    if file.exists():
        return "a folder or a device is there"
    if not file.parent.is_dir():
        return f"there is no folder {file.parent}: paths are relative to data_root, is that right?"
    lower = file.name.lower()
    if other := next((name for name in os.listdir(file.parent) if name.lower() == lower), None):
        return f"but {other!r} is there: rename it"
    return "its folder is there without it: fetch it again"


def _no_image(where: str, path: object, content: bytes) -> str:
    advice = fetch_advice(content, "copy it again, or convert it to one of these")
    return f"{where}: {path} is not an image (JPEG, PNG, WebP or BMP); {advice}."


def _decoded_jpeg(
    content: bytes, size: tuple[int, int] | None
) -> tuple[tuple[int, int], np.ndarray | None]:
    """Return a JPEG's size, and its pixels, BGR, unless another size is asked for."""
    if any(entry in content for entry in _TURNING):
        with Image.open(BytesIO(content), formats=FORMATS) as picture:
            _require_upright(picture)
    height, width = simplejpeg.decode_jpeg_header(content)[:2]
    if size not in (None, (width, height)):
        return (width, height), None
    _require_moderate((width, height))
    if (scans := content.count(_SCAN)) > _MOST_SCANS:
        raise _UnfitError(f"it has {scans} scans, more than {_MOST_SCANS}: save it anew")
    return (width, height), simplejpeg.decode_jpeg(content, colorspace="BGR")


def _decoded_other(
    content: bytes, size: tuple[int, int] | None
) -> tuple[tuple[int, int], np.ndarray | None]:
    """Return an image's size, and its pixels, BGR, unless another size is asked for."""
    with Image.open(BytesIO(content), formats=FORMATS) as picture:
        if size not in (None, picture.size):
            return picture.size, None
        _require_moderate(picture.size)
        frames = getattr(picture, "n_frames", 1)
        if frames > 1:
            raise _UnfitError(f"it is an animation of {frames} images: save each as a file")
        deep_mode = ";16" in str(picture.tile[0][3]) if picture.tile else False
        picture.load()  # a PNG may say only behind its pixels how it is turned
        _require_upright(picture)
        if picture.mode.startswith("I"):
            return picture.size, _from_deep_grey(np.asarray(picture))
        if deep_mode:
            _require_bright(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED))
        return picture.size, np.ascontiguousarray(np.asarray(picture.convert("RGB"))[:, :, ::-1])


def _require_moderate(size: tuple[int, int]) -> None:
    """Refuse an image of more pixels than cameras have."""
    if size[0] * size[1] > _MOST_PIXELS:
        raise _UnfitError(
            f"it has {size[0]} x {size[1]} pixels, more than {_MOST_PIXELS / 1e6:g} million: make "
            "it smaller, with its calibration"
        )


def _require_upright(picture: Image.Image) -> None:
    """Refuse a picture that viewers turn: calibrations are for pixels as they are stored."""
    orientation = picture.getexif().get(_ORIENTATION)
    if orientation in _TURNED:
        raise _UnfitError(
            f"its EXIF wants it turned, orientation {orientation}: turn its pixels, or remove that "
            "entry if the calibration is for the pixels as they are stored"
        )


def _require_bright(values: np.ndarray) -> None:
    """Refuse 16-bit values that would be next to black in 8 bits. (H, W) or (H, W, 3 or 4)"""
    colours = values[..., :3] if values.ndim == 3 else values
    brightest = int(colours.max())
    if 0 < brightest < _DIM:
        raise _UnfitError(
            f"its values end at {brightest} of 65535, as those of a camera of "
            f"{brightest.bit_length()} bits or of depth do, and it would be next to black: spread "
            "them over 16 bits, or save 8 bits"
        )


def _from_deep_grey(grey: np.ndarray) -> np.ndarray:
    """Return 16-bit grey values in 8 bits, as BGR. (H, W, 3)"""
    _require_bright(grey)
    return cv2.cvtColor((grey >> 8).clip(0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
