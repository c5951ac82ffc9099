"""Reading of image files with checks, and encoding of JPEG files."""

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

# The import registers the formats in pillow; no other format is opened.
_PLUGINS = (JpegImagePlugin, PngImagePlugin, WebPImagePlugin, BmpImagePlugin)
FORMATS = ("JPEG", "PNG", "WEBP", "BMP")
# First bytes of a file by format.
_STARTS = {b"\xff\xd8": "jpeg", b"\x89PNG": "png", b"RIFF": "webp", b"BM": "bmp"}
_JPEG_START = b"\xff\xd8"
_ORIENTATION_ENTRIES = (b"Exif\0\0", b"tiff:Orientation")  # EXIF and XMP may have an orientation
_ORIENTATION_TAG = 0x0112  # EXIF tag of the orientation
_ROTATIONS = range(2, 9)  # orientations that need a rotation: 1 is upright, 0 is not set
_MAX_PIXELS = 10**8  # a decoder allocates memory for the size in the header, whatever follows
_MAX_JPEG_SCANS = 100  # each scan may take as much time as a whole image
_SCAN = b"\xff\xda"
_MIN_BRIGHTEST = 1 << 14  # if all values of a 16-bit file are smaller, the image has <= 14 bits
# Errors of pillow and simplejpeg for damaged files.
_DAMAGE = (
    ValueError, OSError, SyntaxError, EOFError, LookupError, TypeError, AttributeError,
    ArithmeticError, AssertionError, RuntimeError, struct.error, zlib.error,
    Image.DecompressionBombError,
)  # fmt: skip


class _UnfitError(Exception):
    """Intact image with properties that are not supported."""


def image_size(file: Path, where: str) -> tuple[int, int]:
    """Read the width and height of an image from the header of the file.

    Args:
        file: Image file.
        where: Sample and camera, with which messages begin.

    Returns:
        Width and height in pixels.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not an image, or has too many pixels.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no image at {file}; {_why_missing(file)}.")
    with file.open("rb") as stream:
        start = stream.read(100)
        try:
            with Image.open(stream, formats=FORMATS) as image:
                _check_num_pixels(image.size)
                return image.size
        except _UnfitError as error:
            raise InputError(f"{where}: {file} cannot be used: {error}.") from error
        except _DAMAGE as error:
            if getattr(error, "errno", None):  # the disk failed: pillow's errors have no number
                raise
            raise InputError(_no_image(where, path=file, content=start)) from error


def read_image(
    path: str | np.ndarray, where: str, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Read and check an image file.

    Args:
        path: Image file. An image in memory, BGR (H, W, 3), is returned without a check.
        where: Sample and camera, with which messages begin.
        size: Expected width and height in pixels; None for any size.

    Returns:
        Image, BGR, uint8. (H, W, 3)

    Raises:
        BrokenSampleError: If the file is missing, damaged or not an image, if the image has another
            size, or if its EXIF orientation needs a rotation.
    """
    if isinstance(path, np.ndarray):
        return path
    file = Path(path)
    if not file.is_file():
        raise BrokenSampleError(f"{where}: no image at {path}; {_why_missing(file)}.")
    return decode_image(file.read_bytes(), path, where=where, size=size)


def decode_image(
    content: bytes, path: str, where: str, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Decode and check the content of an image file.

    A warning of the JPEG decoder is raised as an error. OpenCV would fill missing parts with grey
    without a message.

    Args:
        content: Content of the file.
        path: Path of the file, for messages.
        where: Beginning of messages, such as the sample and the camera.
        size: Expected width and height in pixels; None for any size.

    Returns:
        Image, BGR, uint8. (H, W, 3)

    Raises:
        BrokenSampleError: If the content is damaged or not an image, if the image has another size,
            or if its EXIF orientation needs a rotation.
    """
    if _image_format(content) is None:
        raise BrokenSampleError(_no_image(where, path=path, content=content))
    try:
        if content.startswith(_JPEG_START):
            (width, height), image = _decode_jpeg(content, size)
        else:
            (width, height), image = _decode_other(content, size)
    except _UnfitError as error:
        raise BrokenSampleError(f"{where}: {path} cannot be used: {error}.") from error
    except _DAMAGE as error:
        raise BrokenSampleError(
            f"{where}: {path} is truncated or damaged ({error}); copy it again."
        ) from error
    if image is None:
        raise BrokenSampleError(
            f"{where}: {path} has {width} x {height} pixels, but its record and its calibration "
            f"are for {size}: copy the original, or make the annotation file for these images."
        )
    return image


def image_content(file: Path, where: str, size: tuple[int, int]) -> tuple[bytes, str]:
    """Read the content of an image file for a copy, after a check by `decode_image`.

    Args:
        file: Image file.
        where: Beginning of messages, such as the sample and the camera.
        size: Expected width and height in pixels.

    Returns:
        Content and format: ``jpeg``, ``png`` or ``webp``. A BMP image is encoded as JPEG.

    Raises:
        FileNotFoundError: If there is no such file.
        BrokenSampleError: If `decode_image` rejects the content.
    """
    content = file.read_bytes()
    image = decode_image(content, str(file), where=where, size=size)
    image_format = _image_format(content) or ""
    if image_format == "bmp":
        return encode_jpeg(image, quality=95), "jpeg"
    return content, image_format


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """Encode an image as JPEG.

    Args:
        image: Image, BGR, uint8. (H, W, 3)
        quality: Quality from 0 to 100.

    Returns:
        Content of a JPEG file.
    """
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, content = cv2.imencode(".jpg", image, params=settings)
    return content.tobytes()


def _image_format(content: bytes) -> str | None:
    """Return the format of an image by the first bytes of the file; None if it is not supported."""
    for start, image_format in _STARTS.items():
        if content.startswith(start):
            return image_format
    return None


def _why_missing(file: Path) -> str:
    """Return the reason why a file does not exist, and the remedy."""
    if file.is_symlink():
        return f"it is a link to {os.readlink(file)!r}, which is not there"
    if file.exists():
        return "a folder or a device is there"
    if not file.parent.is_dir():
        return f"there is no folder {file.parent}: paths are relative to data_root, is that right?"
    for name in os.listdir(file.parent):
        if name.lower() == file.name.lower():
            return f"but {name!r} is there: rename it"
    return "the folder exists, but not this file: fetch the file again"


def _no_image(where: str, path: object, content: bytes) -> str:
    """Return the message about a file that is not an image."""
    advice = fetch_advice(content, "copy it again, or convert it to one of these")
    return f"{where}: {path} is not an image (JPEG, PNG, WebP or BMP); {advice}."


def _decode_jpeg(
    content: bytes, size: tuple[int, int] | None
) -> tuple[tuple[int, int], np.ndarray | None]:
    """Return (width, height) and BGR pixels of a JPEG; no pixels (None) if ``size`` differs."""
    if any(entry in content for entry in _ORIENTATION_ENTRIES):
        with Image.open(BytesIO(content), formats=FORMATS) as picture:
            _require_upright(picture)
    height, width = simplejpeg.decode_jpeg_header(content)[:2]
    if size not in (None, (width, height)):
        return (width, height), None
    _check_num_pixels((width, height))
    num_scans = content.count(_SCAN)
    if num_scans > _MAX_JPEG_SCANS:
        raise _UnfitError(f"it has {num_scans} scans, more than {_MAX_JPEG_SCANS}: save it again")
    return (width, height), simplejpeg.decode_jpeg(content, colorspace="BGR")


def _decode_other(
    content: bytes, size: tuple[int, int] | None
) -> tuple[tuple[int, int], np.ndarray | None]:
    """Return (width, height) and BGR pixels of an image; no pixels (None) if ``size`` differs."""
    with Image.open(BytesIO(content), formats=FORMATS) as picture:
        if size not in (None, picture.size):
            return picture.size, None
        _check_num_pixels(picture.size)
        num_frames = getattr(picture, "n_frames", 1)
        if num_frames > 1:
            raise _UnfitError(f"it is an animation of {num_frames} images: save each as a file")
        has_16_bits = False
        if picture.tile:
            # The first block of pixel data; its last field has the raw mode, such as "RGB;16B".
            _, _, _, decoder_arguments = picture.tile[0]
            has_16_bits = ";16" in str(decoder_arguments)
        picture.load()  # the orientation of a PNG may follow the pixels
        _require_upright(picture)
        if picture.mode.startswith("I"):
            return picture.size, _bgr_from_16_bit_grey(np.asarray(picture))
        if has_16_bits:
            encoded = np.frombuffer(content, dtype=np.uint8)
            _require_bright(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED))
        rgb = np.asarray(picture.convert("RGB"))
        return picture.size, np.ascontiguousarray(rgb[:, :, ::-1])  # RGB to BGR


def _check_num_pixels(size: tuple[int, int]) -> None:
    """Raise an error if an image (width, height) has more pixels than the limit."""
    width, height = size
    if width * height > _MAX_PIXELS:
        raise _UnfitError(
            f"it has {width} x {height} pixels, more than {_MAX_PIXELS / 1e6:g} million: make "
            "it smaller, with its calibration"
        )


def _require_upright(picture: Image.Image) -> None:
    """Raise an error for an EXIF rotation, because calibrations refer to the stored pixels."""
    orientation = picture.getexif().get(_ORIENTATION_TAG)
    if orientation in _ROTATIONS:
        raise _UnfitError(
            f"its EXIF wants it turned, orientation {orientation}: turn its pixels, or remove that "
            "entry if the calibration is for the pixels as they are stored"
        )


def _require_bright(values: np.ndarray) -> None:
    """Raise an error for 16-bit values that are nearly black in 8 bits. (H, W[, 3 or 4])"""
    colours = values[..., :3] if values.ndim == 3 else values
    brightest = int(colours.max())
    if 0 < brightest < _MIN_BRIGHTEST:
        raise _UnfitError(
            f"its largest value is {brightest} of 65535, as in a depth map or an image of a camera "
            f"with {brightest.bit_length()} bits, and in 8 bits it would be almost black: spread "
            "its values over 16 bits, or save it with 8 bits"
        )


def _bgr_from_16_bit_grey(grey: np.ndarray) -> np.ndarray:
    """Convert 16-bit grey values to 8-bit BGR. (H, W) -> (H, W, 3)"""
    _require_bright(grey)
    grey_8_bit = (grey >> 8).clip(0, 255).astype(np.uint8)
    return cv2.cvtColor(grey_8_bit, cv2.COLOR_GRAY2BGR)
