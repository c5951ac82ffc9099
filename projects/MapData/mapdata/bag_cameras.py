"""Cameras of a bag: their camera info, by the rules of ROS' image_pipeline, and their images."""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.utils.errors import InputError
from mapdata.bag_images import image_size, trouble_with
from mapdata.folders.rig import RigCamera

_RECTIFIED = ("rect", "rectified")
_NOT = ("un", "non", "not", "no")
_SIZES_SEEN = 5


@dataclass
class ImageTopic:
    """What a first pass over a bag finds of one topic of images.

    Args:
        frame_id: Frame of the first image.
        times_ns: Times of all images. (n,)
        sizes_px: Width and height of the first images.
        trouble: Why no image can be used, or empty.
        unstamped: Number of images whose stamp is 0, which have their time of recording.
    """

    frame_id: str = ""
    times_ns: list[int] = field(default_factory=list)
    sizes_px: list[tuple[int, int]] = field(default_factory=list)
    trouble: str = ""
    unstamped: int = 0

    def add(self, message: Any, time_ns: int) -> None:
        """Add a message."""
        if not self.times_ns:
            self.frame_id = message.header.frame_id.lstrip("/")
            self.trouble = trouble_with(message) or ""
        if len(self.times_ns) < _SIZES_SEEN and not self.trouble:
            size_px = image_size(message)
            self.sizes_px += [size_px] if size_px else []
        self.times_ns.append(time_ns)

    def notes(self, topic: str) -> list[str]:
        """Say what is unusual about the images' times."""
        count, notes = len(self.times_ns), []
        if self.unstamped:
            notes.append(
                f"{self.unstamped} of {count} images of {topic!r} have the stamp 0: their time of "
                "recording is used"
            )
        if repeated := count - len(set(self.times_ns)):
            notes.append(
                f"{repeated} of {count} images of {topic!r} are left out: their stamps repeat that "
                "of another"
            )
        return notes


def is_rectified(topic: str) -> bool:
    """Whether images are rectified: a word of the last two parts of their topic is ``rect``."""
    words = re.split(r"[/_]", "/".join(topic.rsplit("/", 2)[-2:]).lower())
    return any(
        word in _RECTIFIED and (number == 0 or words[number - 1] not in _NOT)
        for number, word in enumerate(words)
    )


def is_calibrated(info: Any) -> bool:
    """Whether a camera info holds a camera matrix, K or P."""
    return any(_is_pinhole(_matrix(info, name)) for name in ("k", "p"))


def is_same_calibration(info: Any, other: Any) -> bool:
    """Whether two camera infos hold the same size, K, P and distortion."""
    sizes = ((item.width, item.height) for item in (info, other))
    return next(sizes) == next(sizes) and all(
        np.array_equal(_field(info, name), _field(other, name), equal_nan=True) for name in "kpd"
    )


def _is_pinhole(matrix: np.ndarray) -> bool:
    """Whether a matrix is finite and has focal lengths above 0."""
    return bool(np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0)


def _field(info: Any, name: str) -> np.ndarray:
    """Return an array of a camera info, whose name is in capitals in ROS 1."""
    found = getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
    return np.asarray(found, np.float64)


def _matrix(info: Any, name: str) -> np.ndarray:
    """Return K or the first three columns of P; an empty one is 0. (3, 3)"""
    found, columns = _field(info, name), 3 if name == "k" else 4
    if found.size not in (0, 3 * columns):
        raise InputError(f"its camera info has {found.size} numbers in {name.upper()}")
    return found.reshape(3, columns)[:, :3] if found.size else np.zeros((3, 3))


def camera_of(
    name: str, images: ImageTopic, info: Any, topics: tuple[str, str], cam_from_ground: np.ndarray
) -> tuple[RigCamera, list[str]]:
    """Return a camera by its camera info, and what was assumed.

    Args:
        name: Name of the camera.
        images: What is known of its images.
        info: Its camera info.
        topics: Topics of the images and of the camera info.
        cam_from_ground: From the ground to the camera. (4, 4)

    Raises:
        ValueError: If it is not calibrated, or its images have another size than it says.
    """
    image_topic, info_topic = topics
    where = f"camera {name!r}: its camera info {info_topic}"
    k, p, d = _matrix(info, "k"), _matrix(info, "p"), _field(info, "d")
    notes = []
    full_px = int(info.width), int(info.height)
    rectified, straight = is_rectified(image_topic), not d.any()
    if rectified and not straight:
        notes.append(
            f"camera {name!r}: {image_topic} is taken as rectified for its name, so P of "
            f"{info_topic} is used, and its distortion is not"
        )
    matrix, other = (p, k) if rectified else (k, p)
    if min(full_px) > 0 and not _is_pinhole(matrix):
        used, empty = ("K", "P") if rectified else ("P", "K")
        if not _is_pinhole(other):
            raise InputError(
                f"{where} has no calibration, K and P have no focal lengths: give --calibration"
            )
        if not straight:
            raise InputError(
                f"{where} has no focal lengths in {empty}, and {used} alone is not enough with its "
                "distortion: give --calibration"
            )
        notes.append(f"{where} has no focal lengths in {empty}, it is 0: {used} is used")
        matrix = other
    offset_px, binning, size_px = _window(info, full_px)
    found = images.sizes_px
    if size_px in found or not found or min(full_px) < 1:
        matrix = _cut_out(matrix, offset_px, binning)
    elif full_px in found:
        size_px = full_px
        notes.append(
            f"{where} has binning or a region of interest, but its images have all {full_px} "
            "pixels: neither is applied"
        )
    else:
        raise InputError(
            f"{where} says {full_px} pixels, binning {binning} and a region of interest from "
            f"{offset_px}, so {size_px}, but its images have {found[0]}: record the camera info of "
            "these images, or give --calibration"
        )
    camera = RigCamera(
        name,
        matrix,
        cam_from_ground,
        size_px,
        np.zeros(0) if rectified or straight else d,
        str(info.distortion_model),
    )
    return camera, notes


def _window(
    info: Any, full_px: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Return which pixels of a camera its images show: offset, binning and resulting size."""
    binning = (
        max(int(getattr(info, "binning_x", 1)), 1),
        max(int(getattr(info, "binning_y", 1)), 1),
    )
    offset_px, size_px = (0, 0), full_px
    roi = getattr(info, "roi", None)
    if roi is not None:
        offset_px = int(roi.x_offset), int(roi.y_offset)
        size_px = int(roi.width) or full_px[0], int(roi.height) or full_px[1]
    return offset_px, binning, (size_px[0] // binning[0], size_px[1] // binning[1])


def _cut_out(
    matrix: np.ndarray, offset_px: tuple[int, int], binning: tuple[int, int]
) -> np.ndarray:
    """Return a camera matrix for a region of interest, binned, as image_geometry does it. (3, 3)"""
    matrix = matrix.copy()
    matrix[:2, 2] -= offset_px
    matrix[:2] /= np.array(binning)[:, None]
    return matrix
