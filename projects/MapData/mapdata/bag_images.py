"""Images of a bag's messages, as JPEG files."""

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

_TO_BGR: dict[str, int | None] = {
    "bgr8": None, "8UC3": None, "rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR, "mono8": cv2.COLOR_GRAY2BGR, "8UC1": cv2.COLOR_GRAY2BGR,
    # OpenCV names a pattern by its second row
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR, "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR, "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUYV, "yuyv": cv2.COLOR_YUV2BGR_YUYV,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY, "uyvy": cv2.COLOR_YUV2BGR_UYVY,
}  # fmt: skip
_CHANNELS = {
    "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4,
    "yuv422_yuy2": 2, "yuyv": 2, "yuv422": 2, "uyvy": 2,
}  # fmt: skip
_DEPTHS = ("16UC1", "32FC1")
_VIDEO = ("h264", "h265", "hevc", "av1", "vp8", "vp9", "theora", "ffmpeg")


def trouble_with(message: Any) -> str | None:
    """Say why the images of a topic cannot be used at all, by the encoding of one message."""
    if hasattr(message, "encoding"):
        if message.encoding in _TO_BGR:
            return None
        return f"it has the encoding {message.encoding!r}; known are {sorted(_TO_BGR)}"
    form = str(message.format)
    if form.split(";")[0].strip() in _DEPTHS or "compressedDepth" in form:
        return f"it is a depth image ({form.strip()!r})"
    if form.strip().lower() in _VIDEO:
        return f"it is a frame of video ({form.strip()!r}), not a picture of its own"
    return None


def image_size(message: Any) -> tuple[int, int] | None:
    """Return width and height of a message's image in pixels, or None if it is damaged."""
    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    content = np.asarray(message.data, np.uint8).tobytes()
    try:
        with Image.open(BytesIO(content), formats=FORMATS) as picture:
            return picture.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None


def write_image(message: Any, camera: RigCamera, target: Path, where: str) -> None:
    """Write a message's image as JPEG.

    Args:
        message: Of rosbags, with an image as it is or compressed.
        camera: The camera that took it.
        target: File to write.
        where: Camera and time, for messages.

    Raises:
        BrokenSampleError: If a compressed image is damaged or of another size.
        ValueError: If an image's encoding is not known, or its size is another.
    """
    if hasattr(message, "encoding"):
        camera.write_image(target, _raw_image(message, camera.size_px))
        return
    if trouble := trouble_with(message):
        raise InputError(trouble)
    content = np.asarray(message.data, np.uint8).tobytes()
    image = decode_image(content, "its message", where, camera.size_px)
    if camera.is_distorted or not content.startswith(b"\xff\xd8"):
        camera.write_image(target, image)
    else:
        write_bytes(target, content)


def _raw_image(message: Any, size_px: tuple[int, int]) -> np.ndarray:
    """Return an uncompressed image, BGR. (H, W, 3)"""
    encoding, found = message.encoding, (message.width, message.height)
    if trouble := trouble_with(message):
        raise InputError(trouble)
    if found != size_px:
        raise InputError(f"it has {found} pixels, and its camera info says {size_px}")
    channels = _CHANNELS.get(encoding, 1)
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    code = _TO_BGR[encoding]
    try:
        return image if code is None else cv2.cvtColor(np.ascontiguousarray(image), code)
    except cv2.error as error:
        raise InputError(f"OpenCV cannot convert it from {encoding}: {error.err}") from error
