"""Writing of the images in a ROS bag's messages as JPEG files."""

from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from gsmap.datasets.image_files import FORMATS, decode_image
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_bytes
from mapdata.folders.rig import RigCamera

# OpenCV's code for the conversion to BGR, by ROS' name of the encoding; None for no conversion.
_TO_BGR: dict[str, int | None] = {
    "bgr8": None, "8UC3": None, "rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR, "mono8": cv2.COLOR_GRAY2BGR, "8UC1": cv2.COLOR_GRAY2BGR,
    # ROS names a Bayer pattern by its first two rows, OpenCV by the second and third pixel of
    # the second row.
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR, "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR, "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUYV, "yuyv": cv2.COLOR_YUV2BGR_YUYV,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY, "uyvy": cv2.COLOR_YUV2BGR_UYVY,
}  # fmt: skip
_PIXEL_BYTES = {  # bytes of a pixel, by encoding; an encoding that is not listed has 1
    "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4,
    "yuv422_yuy2": 2, "yuyv": 2, "yuv422": 2, "uyvy": 2,
}  # fmt: skip
# Formats of compressed messages that are not pictures: depth images (by their encoding) and video.
_DEPTHS = ("16UC1", "32FC1")
_VIDEO = ("h264", "h265", "hevc", "av1", "vp8", "vp9", "theora", "ffmpeg")


def trouble_with(message: Any) -> str | None:
    """Return the reason why a message's image cannot be used; None if its format is supported.

    Args:
        message: Message of ROS: a raw image with ``encoding`` (``sensor_msgs/Image``), or a
            compressed image with ``format`` (``sensor_msgs/CompressedImage``).

    Returns:
        A clause for a message, in which "it" is the image; or None.
    """
    if hasattr(message, "encoding"):
        if message.encoding in _TO_BGR:
            return None
        return f"it has the encoding {message.encoding!r}; known are {sorted(_TO_BGR)}"
    # ROS separates the parts of a format by semicolons, as in "16UC1; compressedDepth png".
    image_format = str(message.format)
    if image_format.split(";")[0].strip() in _DEPTHS or "compressedDepth" in image_format:
        return f"it is a depth image ({image_format.strip()!r})"
    if image_format.strip().lower() in _VIDEO:
        return f"it is a frame of video ({image_format.strip()!r}), not a picture of its own"
    return None


def image_size(message: Any) -> tuple[int, int] | None:
    """Return width and height of a message's image in pixels; None if the image is damaged.

    A compressed image is not decoded: its size is in its header.
    """
    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    content = np.asarray(message.data, dtype=np.uint8).tobytes()
    try:
        with Image.open(BytesIO(content), formats=FORMATS) as picture:
            return picture.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None  # Pillow raises a SyntaxError for a broken header


def write_image(message: Any, camera: RigCamera, target: Path, where: str) -> None:
    """Write a message's image as JPEG. The image is rectified if the camera has distortion.

    A JPEG image of a camera without distortion is copied, so it loses no quality.

    Args:
        message: Message of rosbags, with a raw or a compressed image.
        camera: Camera that took the image.
        target: File to write.
        where: Camera and time, for error messages.

    Raises:
        BrokenSampleError: If a compressed image is damaged, or not of the camera's size.
        ValueError: If the encoding or the format of an image is not supported, if OpenCV cannot
            convert it, or if a raw image is not of the camera's size.
    """
    if hasattr(message, "encoding"):
        # `RigCamera.write_image` rectifies the image if needed, and encodes it as JPEG.
        camera.write_image(target, _raw_image(message, camera.size_px))
        return
    trouble = trouble_with(message)
    if trouble:
        raise InputError(trouble)
    content = np.asarray(message.data, dtype=np.uint8).tobytes()
    # The image is decoded in any case, as this checks that it is not damaged.
    image = decode_image(content, path="its message", where=where, size=camera.size_px)
    is_jpeg = content.startswith(b"\xff\xd8")  # the first two bytes of every JPEG file
    if camera.is_distorted or not is_jpeg:
        camera.write_image(target, image)
    else:
        write_bytes(target, content)


def _raw_image(message: Any, size_px: tuple[int, int]) -> np.ndarray:
    """Convert an uncompressed image to BGR. (H, W, 3)

    Args:
        message: Message of the type ``sensor_msgs/Image``.
        size_px: Expected width and height in pixels.

    Raises:
        ValueError: If the encoding is not known, or the image has another size.
    """
    trouble = trouble_with(message)
    if trouble:
        raise InputError(trouble)
    width = message.width
    height = message.height
    if (width, height) != size_px:
        raise InputError(f"it has {(width, height)} pixels, and its camera info says {size_px}")
    encoding = message.encoding
    pixel_bytes = _PIXEL_BYTES.get(encoding, 1)
    # A row has `step` bytes, which may include padding at its end.
    rows = np.asarray(message.data, dtype=np.uint8).reshape(height, message.step)
    image = rows[:, : width * pixel_bytes].reshape(height, width, pixel_bytes)
    code = _TO_BGR[encoding]
    if code is None:
        return image
    try:
        return cv2.cvtColor(np.ascontiguousarray(image), code)
    except cv2.error as error:
        raise InputError(f"OpenCV cannot convert it from {encoding}: {error.err}") from error
