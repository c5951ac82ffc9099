"""One frame whose images and calibration lie in memory."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from gsmap.datasets.annotations.file import check_samples
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, MapSample
from gsmap.datasets.source import Mount, Source, sample_in_vehicle
from gsmap.utils.errors import InputError, InputTypeError

VEHICLE = "vehicle"  # frame: x ahead, y left, on the road below the rear axle
Cameras = Mapping[str, np.ndarray] | Sequence[np.ndarray] | np.ndarray


def bgr_by_name(images: Cameras) -> dict[str, np.ndarray]:
    """Check images, and return them in the order of channels that the pipeline has.

    Args:
        images: By the cameras' names, or as a list: RGB, uint8. each (H, W, 3)

    Raises:
        TypeError: If one is not uint8.
        ValueError: If one has another shape.
    """
    return {name: _bgr(name, image) for name, image in _by_name(images).items()}


def source_in_memory(
    images: Mapping[str, np.ndarray],
    intrinsics: Cameras,
    cam_from_frame: Cameras,
    frame: str,
    mount: Mount | None = None,
) -> Source:
    """Make a sample of one frame.

    Args:
        images: From `bgr_by_name`.
        intrinsics: In the same form as those were, in pixels. each (3, 3)
        cam_from_frame: In the same form, in metres. each (4, 4)
        frame: ``vehicle`` (x ahead, y left, on the road below the rear axle), or an annotation
            frame.
        mount: Where that frame lies in the vehicle; None is the usual place.

    Raises:
        ValueError: If an array has another shape, a matrix is none of its kind, or the cameras of
            the arguments differ.
    """
    rig = {"intrinsics": _by_name(intrinsics), "cam_from_frame": _by_name(cam_from_frame)}
    names = list(images)
    for what, values in rig.items():
        if set(values) != set(names) or not names:
            raise InputError(
                f"{what} must have the cameras of images, {names}, got {list(values)}."
            )
    cameras = [
        CameraRecord(
            name,
            path="in memory",
            width=image.shape[1],
            height=image.shape[0],
            **{what: values[name] for what, values in rig.items()},
        )
        for name, image in images.items()
    ]
    given = "ego" if frame == VEHICLE else frame
    sample = MapSample("in memory", "", "", 0, cameras, np.eye(4))
    check_samples([sample], AnnotationMeta("memory", given, "test"))
    if frame == VEHICLE:
        sample = sample_in_vehicle("in memory", "", 0, cameras, None)
    elif mount is not None:
        sample.ego_from_frame = mount.ego_from_frame
    height = None if mount is None else mount.ground_z_m
    return Source([sample], given, None, has_poses=False, ground_z_m=height)


def _by_name(values: Cameras) -> dict[str, np.ndarray]:
    """Return arrays by the camera's name; those of a list are numbered."""
    if isinstance(values, Mapping):
        return {str(name): np.asarray(array) for name, array in values.items()}
    return {f"camera {number}": np.asarray(array) for number, array in enumerate(values)}


def _bgr(name: str, image: np.ndarray) -> np.ndarray:
    """Check an image, and return it in BGR. (H, W, 3)"""
    if image.dtype != np.uint8:
        raise InputTypeError(f"the image of {name!r} must be uint8, RGB, got {image.dtype}.")
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"the image of {name!r} must have shape (H, W, 3), got {image.shape}.")
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR)
