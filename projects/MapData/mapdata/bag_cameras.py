"""Cameras of a bag: camera info by the rules of ROS' image_pipeline, and topics of images.

A camera info is a message with the calibration of a camera (``sensor_msgs/CameraInfo``). It has the
camera matrix K (3, 3) of raw images, the projection matrix P (3, 4) of rectified images, and the
distortion D of raw images.
"""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.utils.errors import InputError
from mapdata.bag_images import image_size, trouble_with
from mapdata.folders.rig import FISHEYE_MODELS, RigCamera

# Words in topics of rectified images, and words that negate the word after them.
_RECTIFIED = ("rect", "rectified")
_NOT = ("un", "non", "not", "no")
_MOST_SIZES = 5  # number of images whose size is read


@dataclass
class ImageTopic:
    """Images of one topic, as collected by a first pass over a bag.

    Args:
        frame_id: Coordinate frame of the camera, from the first image.
        times_ns: Times of all images in nanoseconds. (n,)
        sizes_px: Width and height of the first images.
        trouble: Reason why no image can be used; empty if images can be used.
        unstamped: Number of images with the stamp 0, which get their time of recording. The caller
            of `add` counts them.
    """

    frame_id: str = ""
    times_ns: list[int] = field(default_factory=list)
    sizes_px: list[tuple[int, int]] = field(default_factory=list)
    trouble: str = ""
    unstamped: int = 0

    def add(self, message: Any, time_ns: int) -> None:
        """Add the image of a message.

        Args:
            message: Raw or compressed image of ROS.
            time_ns: Time of the image in nanoseconds.
        """
        if not self.times_ns:
            self.frame_id = message.header.frame_id.lstrip("/")  # ROS 1 allows "/camera"
            # Reason why the format is not supported, or None.
            self.trouble = trouble_with(message) or ""
        if len(self.times_ns) < _MOST_SIZES and not self.trouble:
            size_px = image_size(message)  # None for a damaged image
            if size_px:
                self.sizes_px.append(size_px)
        self.times_ns.append(time_ns)

    def notes(self, topic: str) -> list[str]:
        """Notes on missing and repeated stamps (times in the headers of messages)."""
        count = len(self.times_ns)
        notes = []
        if self.unstamped:
            notes.append(
                f"{self.unstamped} of {count} images of {topic!r} have the stamp 0: their time of "
                "recording is used"
            )
        repeats = count - len(set(self.times_ns))
        if repeats:
            notes.append(
                f"{repeats} of {count} images of {topic!r} are left out: their stamps repeat the "
                "stamp of another image"
            )
        return notes


def is_rectified(topic: str) -> bool:
    """Whether images are rectified, by the name of their topic.

    One of the words in its last two parts must be ``rect`` or ``rectified``, without a negation
    before it.
    """
    last_parts = topic.rsplit("/", 2)[-2:]
    word_before = ""
    for word in re.split(r"[/_]", "/".join(last_parts).lower()):
        if word in _RECTIFIED and word_before not in _NOT:
            return True
        word_before = word
    return False


def is_calibrated(info: Any) -> bool:
    """Whether a camera info has focal lengths, in K or P."""
    return _is_pinhole(_matrix(info, "k")) or _is_pinhole(_matrix(info, "p"))


def is_same_calibration(info: Any, other: Any) -> bool:
    """Whether two camera infos are equal in size, K, P and distortion."""
    if (info.width, info.height) != (other.width, other.height):
        return False
    for name in ("k", "p", "d"):
        if not np.array_equal(_field(info, name), _field(other, name), equal_nan=True):
            return False
    return True


def _is_pinhole(matrix: np.ndarray) -> bool:
    """Whether a camera matrix is finite and its focal lengths are positive."""
    return bool(np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0)


def _field(info: Any, name: str) -> np.ndarray:
    """Array of a camera info by the name of its field, which is in capitals in ROS 1."""
    values = getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
    return np.asarray(values, dtype=np.float64)


def _matrix(info: Any, name: str) -> np.ndarray:
    """K, or the first three columns of P; zeros if the field is empty. (3, 3)"""
    values = _field(info, name)
    columns = 3 if name == "k" else 4
    if values.size == 0:
        return np.zeros((3, 3))
    if values.size != 3 * columns:
        raise InputError(f"its camera info has {values.size} numbers in {name.upper()}")
    return values.reshape(3, columns)[:, :3]


def build_camera(
    name: str, images: ImageTopic, info: Any, topics: tuple[str, str], cam_from_ground: np.ndarray
) -> tuple[RigCamera, list[str]]:
    """Build a camera from its camera info.

    Args:
        name: Name of the camera.
        images: Images of the camera.
        info: Message with the camera info.
        topics: Topics of the images and of the camera info.
        cam_from_ground: Transform from the ground below the vehicle to the camera, metres. (4, 4)

    Returns:
        The camera, and notes on assumptions.

    Raises:
        ValueError: If the camera info has no focal lengths, or does not fit the size of the images,
            or if `RigCamera` rejects the size or the distortion.
    """
    image_topic, info_topic = topics
    where = f"camera {name!r}: its camera info {info_topic}"  # beginning of messages
    distortion = _field(info, "d")
    notes = []
    full_px = (int(info.width), int(info.height))
    rectified = is_rectified(image_topic)
    has_distortion = bool(distortion.any())
    if rectified and has_distortion:
        notes.append(
            f"camera {name!r}: {image_topic} is taken as rectified because of its name, so P of "
            f"{info_topic} is used, and the distortion in {info_topic} is not"
        )
    matrix, matrix_notes = _choose_matrix(info, rectified=rectified, where=where)
    notes += matrix_notes
    # Some drivers crop the images to a region of the sensor, and merge pixels of it (binning).
    offset_px, binning, size_px = _window(info, full_px)
    image_sizes = images.sizes_px
    is_any_size_unknown = not image_sizes or min(full_px) < 1
    if size_px in image_sizes or is_any_size_unknown:
        matrix = _crop(matrix, offset_px=offset_px, binning=binning)
    elif full_px in image_sizes:  # the driver has neither cropped nor binned the images
        size_px = full_px
        notes.append(
            f"{where} has binning or a region of interest, but its images have all {full_px} "
            "pixels, so that neither is applied"
        )
    else:
        raise InputError(
            f"{where} says {full_px} pixels, binning {binning} and a region of interest from "
            f"{offset_px}. This makes images of {size_px} pixels, but its images have "
            f"{image_sizes[0]}: record the camera info of these images, or give --calibration"
        )
    needs_rectification = has_distortion and not rectified
    model = str(info.distortion_model)
    if not (rectified or has_distortion) and model in FISHEYE_MODELS:
        notes.append(
            f"{where} has the distortion model {model!r} with coefficients that are all zero: its "
            "images are taken as rectified, as ROS does; give --calibration for an ideal fisheye "
            "lens"
        )
    camera = RigCamera(
        name=name,
        intrinsics=matrix,
        cam_from_ground=cam_from_ground,
        size_px=size_px,
        distortion=distortion if needs_rectification else np.zeros(0),
        model=model if needs_rectification else "",
    )
    return camera, notes


def _choose_matrix(info: Any, rectified: bool, where: str) -> tuple[np.ndarray, list[str]]:
    """Choose the camera matrix of the images: P if they are rectified, and K otherwise.

    A driver may leave this matrix empty. The other one replaces it if the camera has no distortion,
    because K and P then describe one image.

    Args:
        info: Message with the camera info.
        rectified: Whether the images are rectified.
        where: Beginning of messages.

    Returns:
        The matrix (3, 3), and a list with a note if it replaces the other one. If the camera info
        has no size, the matrix is not checked and may be zeros. `RigCamera` then raises an error.

    Raises:
        ValueError: If neither K nor P has focal lengths, or if only the other one has them and the
            camera has distortion.
    """
    k = _matrix(info, "k")
    p = _matrix(info, "p")
    matrix = p if rectified else k
    has_size = min(int(info.width), int(info.height)) > 0
    if not has_size or _is_pinhole(matrix):
        return matrix, []
    empty, used = ("P", "K") if rectified else ("K", "P")
    matrix = k if rectified else p
    if not _is_pinhole(matrix):
        raise InputError(
            f"{where} has no calibration, because K and P have no focal lengths: give --calibration"
        )
    if _field(info, "d").any():
        raise InputError(
            f"{where} has no focal lengths in {empty}, and {used} alone is not enough with its "
            "distortion: give --calibration"
        )
    return matrix, [f"{where} has no focal lengths in {empty}: {used} is used"]


def _window(
    info: Any, full_px: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Region of interest and binning of a camera info.

    Args:
        info: Message with the camera info.
        full_px: Width and height of the sensor in pixels.

    Returns:
        Offset of the region (x, y) in pixels, binning (x, y), and size of the images (width,
        height).
    """
    # In ROS, a binning of 0 stands for 1, and a region of size 0 for the whole sensor.
    binning_x = max(int(getattr(info, "binning_x", 1)), 1)
    binning_y = max(int(getattr(info, "binning_y", 1)), 1)
    offset_px = (0, 0)
    width, height = full_px
    roi = getattr(info, "roi", None)
    if roi is not None:
        offset_px = (int(roi.x_offset), int(roi.y_offset))
        width = int(roi.width) or width
        height = int(roi.height) or height
    return offset_px, (binning_x, binning_y), (width // binning_x, height // binning_y)


def _crop(matrix: np.ndarray, offset_px: tuple[int, int], binning: tuple[int, int]) -> np.ndarray:
    """Camera matrix of a region of interest with binning, as in image_geometry. (3, 3)"""
    matrix = matrix.copy()
    matrix[:2, 2] -= offset_px  # cx and cy
    matrix[:2] /= np.array(binning)[:, None]
    return matrix
