"""Images of a bag's messages, as JPEG files."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmap.datasets.image_files import decode_image
from gsmap.utils.files import write_bytes
from mapdata.folders.rig import RigCamera

_TO_BGR: dict[str, int | None] = {
    "bgr8": None, "8UC3": None, "rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR, "mono8": cv2.COLOR_GRAY2BGR, "8UC1": cv2.COLOR_GRAY2BGR,
    # OpenCV names a pattern by its second row
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR, "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR, "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUYV, "yuv422": cv2.COLOR_YUV2BGR_UYVY,
}  # fmt: skip
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "yuv422_yuy2": 2, "yuv422": 2}


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
    content = np.asarray(message.data, np.uint8).tobytes()
    image = decode_image(content, "its message", where, camera.size_px)
    if camera.is_distorted or not content.startswith(b"\xff\xd8"):
        camera.write_image(target, image)
    else:
        write_bytes(target, content)


def _raw_image(message: Any, size_px: tuple[int, int]) -> np.ndarray:
    """Return an uncompressed image, BGR. (H, W, 3)"""
    encoding, found = message.encoding, (message.width, message.height)
    if encoding not in _TO_BGR:
        raise ValueError(f"it has the encoding {encoding!r}; known are {sorted(_TO_BGR)}")
    if found != size_px:
        raise ValueError(f"it has {found} pixels, and its camera info says {size_px}")
    channels = _CHANNELS.get(encoding, 1)
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    code = _TO_BGR[encoding]
    try:
        return image if code is None else cv2.cvtColor(np.ascontiguousarray(image), code)
    except cv2.error as error:
        raise ValueError(f"OpenCV cannot convert it from {encoding}: {error.err}") from error
