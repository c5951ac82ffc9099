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

# The imports register the formats in pillow, and this tuple keeps the imports. No other format is
# opened.
_PLUGINS = (JpegImagePlugin, PngImagePlugin, WebPImagePlugin, BmpImagePlugin)
FORMATS = ("JPEG", "PNG", "WEBP", "BMP")
# Format of a file by its first bytes.
_STARTS = {b"\xff\xd8": "jpeg", b"\x89PNG": "png", b"RIFF": "webp", b"BM": "bmp"}
_JPEG_START = b"\xff\xd8"
_ORIENTATION_ENTRIES = (b"Exif\0\0", b"tiff:Orientation")  # EXIF and XMP may have an orientation
_ORIENTATION_TAG = 0x0112  # EXIF tag of the orientation
_ROTATIONS = range(2, 9)  # orientations that need a rotation: 1 is upright, 0 is not set
_MAX_PIXELS = 10**8  # a decoder allocates memory for the size in the header, whatever follows
# A progressive JPEG has several scans, each of which refines the image. A damaged or malicious file
# may have thousands, and each scan may take as much time as a whole image.
_MAX_JPEG_SCANS = 100
_SCAN = b"\xff\xda"  # marker at the start of a scan
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
        where: Beginning of messages, such as the sample and the camera.

    Returns:
        Width and height in pixels.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not an image, or has too many pixels.
        OSError: If the file cannot be read, such as after a failure of the disk.
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
            # Errors of the system, such as a failed disk, have an error number (errno). Errors of
            # pillow about the content have none.
            if getattr(error, "errno", None):
                raise
            raise InputError(_no_image(where, path=file, content=start)) from error


def read_image(
    path: str | np.ndarray, where: str, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Read and check an image file.

    Args:
        path: Image file. An image in memory, BGR (H, W, 3), is returned without a check.
        where: Beginning of messages, such as the sample and the camera.
        size: Expected width and height in pixels; None for any size.

    Returns:
        Image, BGR, uint8. (H, W, 3)

    Raises:
        BrokenSampleError: If the file is missing, or if `decode_image` rejects its content. The
            error is a ``ValueError``.
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

    JPEG files are decoded by simplejpeg, which raises the warnings of its decoder as errors. OpenCV
    is not used for them, because it would fill missing parts with grey without a message.

    Args:
        content: Content of the file.
        path: Path of the file, for messages.
        where: Beginning of messages, such as the sample and the camera.
        size: Expected width and height in pixels; None for any size.

    Returns:
        Image, BGR, uint8. (H, W, 3)

    Raises:
        BrokenSampleError: If the content is damaged or not an image, if the image has another size
            or more than 100 million pixels, if its EXIF orientation needs a rotation, if it is an
            animation, if a JPEG has more than 100 scans, or if a 16-bit image would be almost black
            in 8 bits. The error is a ``ValueError``.
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
    # The functions above return no pixels if the size is wrong. "Its record" in the message is the
    # entry of the camera in the annotation file, which has the expected size.
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
        Content and format: ``jpeg``, ``png`` or ``webp``. A BMP image, which viewers of the copies
        may not support, is encoded as JPEG.

    Raises:
        FileNotFoundError: If there is no such file.
        BrokenSampleError: If `decode_image` rejects the content.
    """
    content = file.read_bytes()
    image = decode_image(content, str(file), where=where, size=size)
    # `decode_image` rejects unknown formats, so `or ""` is only for the type checker.
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
    """Return the message about a file that is not an image, for its content or first bytes."""
    # Another advice is returned if the content is a web page or a pointer of Git LFS.
    advice = fetch_advice(content, "copy it again, or convert it to one of these")
    return f"{where}: {path} is not an image (JPEG, PNG, WebP or BMP); {advice}."


def _decode_jpeg(
    content: bytes, size: tuple[int, int] | None
) -> tuple[tuple[int, int], np.ndarray | None]:
    """Return (width, height) and BGR pixels of a JPEG; no pixels (None) if ``size`` differs."""
    # The orientation is read by pillow. This takes time, so it is done only if there may be one.
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
    """Return (width, height) and BGR pixels of a PNG, WebP or BMP image.

    There are no pixels (None) if ``size`` differs.
    """
    with Image.open(BytesIO(content), formats=FORMATS) as picture:
        if size not in (None, picture.size):
            return picture.size, None
        _check_num_pixels(picture.size)
        num_frames = getattr(picture, "n_frames", 1)
        if num_frames > 1:
            raise _UnfitError(f"it is an animation of {num_frames} images: save each as a file")
        has_16_bits = False
        if picture.tile:
            # The first block of pixel data. Its last field has the raw mode, the type of the stored
            # values, such as "RGB;16B" for 16 bits.
            _, _, _, decoder_arguments = picture.tile[0]
            has_16_bits = ";16" in str(decoder_arguments)
        picture.load()  # the orientation of a PNG may follow the pixels
        _require_upright(picture)
        if picture.mode.startswith("I"):  # grey with 16 bits
            return picture.size, _bgr_from_16_bit_grey(np.asarray(picture))
        if has_16_bits:
            # Pillow has reduced the colours to 8 bits. OpenCV decodes them once more with 16 bits,
            # so that their largest value can be checked.
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
    colours = values[..., :3] if values.ndim == 3 else values  # without the opacity
    brightest = int(colours.max())
    # An image that is black throughout (0) is accepted.
    if 0 < brightest < _MIN_BRIGHTEST:
        raise _UnfitError(
            f"its largest value is {brightest} of 65535, as in a depth map or an image of a camera "
            f"with {brightest.bit_length()} bits, and in 8 bits it would be almost black: spread "
            "its values over 16 bits, or save it with 8 bits"
        )


def _bgr_from_16_bit_grey(grey: np.ndarray) -> np.ndarray:
    """Convert 16-bit grey values to 8-bit BGR. (H, W) -> (H, W, 3)"""
    _require_bright(grey)
    # Pillow may return 16-bit values as wider integers, so the result is limited to 8 bits.
    grey_8_bit = (grey >> 8).clip(0, 255).astype(np.uint8)
    return cv2.cvtColor(grey_8_bit, cv2.COLOR_GRAY2BGR)
