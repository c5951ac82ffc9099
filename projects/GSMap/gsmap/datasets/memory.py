"""Samples of one frame whose images and calibration are arrays in memory."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from gsmap.datasets.annotations.file import check_samples
from gsmap.datasets.annotations.record import RANGES, AnnotationMeta, CameraRecord, MapSample
from gsmap.datasets.source import Mount, Source, sample_in_vehicle
from gsmap.utils.errors import InputError, InputTypeError

VEHICLE = "vehicle"  # frame: x ahead, y left, on the road below the rear axle
# Arrays of all cameras: by the name of the camera, in a list, or stacked along the first axis.
Cameras = Mapping[str, np.ndarray] | Sequence[np.ndarray] | np.ndarray


def bgr_by_name(images: Cameras) -> dict[str, np.ndarray]:
    """Check images and convert them from RGB to BGR.

    Args:
        images: RGB images by the name of the camera, or in a list, uint8. V x (H, W, 3)

    Returns:
        BGR images by the name of the camera; images of a list are named ``camera 0`` and so on.
        V x (H, W, 3)

    Raises:
        TypeError: If an image is not uint8.
        ValueError: If the shape of an image is not (H, W, 3), or an image has no pixels.
    """
    return {name: _bgr(name, image) for name, image in _by_name(images).items()}


def source_in_memory(
    images: Mapping[str, np.ndarray],
    intrinsics: Cameras,
    cam_from_frame: Cameras,
    frame: str,
    mount: Mount | None = None,
) -> Source:
    """Create a source with one sample from images and calibration in memory.

    Args:
        images: BGR images by the name of the camera, from `bgr_by_name`. The sample contains their
            names and sizes, not the images. V x (H, W, 3)
        intrinsics: Pinhole matrices in pixels, by name or in the order of the images. V x (3, 3)
        cam_from_frame: Transforms from ``frame`` to the cameras in metres, by name or in the order
            of the images. V x (4, 4)
        frame: ``vehicle`` (x ahead, y left, on the road below the rear axle), ``lidar`` or ``ego``.
        mount: Place of the frame ``lidar`` or ``ego`` in the vehicle; None for the usual place, and
            for the frame ``vehicle``.

    Returns:
        Source in the frame ``lidar`` if ``frame`` is ``lidar``, and otherwise in the frame ``ego``.

    Raises:
        ValueError: If an array has a wrong shape, a matrix is not a valid calibration, ``frame`` is
            unknown, the arguments have different cameras, or there is no camera.
    """
    frames = (VEHICLE, *RANGES)  # RANGES has a key for each annotation frame: lidar, ego
    if frame not in frames:
        raise InputError(f"frame must be one of {frames}, got {frame!r}.")
    intrinsics = _by_name(intrinsics)
    cam_from_frame = _by_name(cam_from_frame)
    _require_cameras("intrinsics", values=intrinsics, names=list(images))
    _require_cameras("cam_from_frame", values=cam_from_frame, names=list(images))
    cameras = []
    for name, image in images.items():
        height, width = image.shape[:2]
        camera = CameraRecord(
            name,
            path="in memory",
            width=width,
            height=height,
            intrinsics=intrinsics[name],
            cam_from_frame=cam_from_frame[name],
        )
        cameras.append(camera)
    # `vehicle` is not an annotation frame. Samples in this frame are converted to `ego` below.
    annotation_frame = "ego" if frame == VEHICLE else frame
    sample = MapSample(
        token="in memory",
        scene="",
        map_name="",
        timestamp_ns=0,
        cameras=cameras,
        global_from_frame=np.eye(4),  # a placeholder: the pose is not known
    )
    # Raises an error if a matrix of a camera has a wrong shape or is not a valid calibration.
    check_samples([sample], AnnotationMeta("memory", frame=annotation_frame, split="test"))
    if frame == VEHICLE:
        # The transforms of the cameras start from the ground. `sample_in_vehicle` returns a sample
        # whose transforms start from the frame `ego`.
        sample = sample_in_vehicle(
            "in memory", scene="", timestamp_ns=0, cameras=cameras, global_from_ground=None
        )
    elif mount is not None:
        sample.ego_from_frame = mount.ego_from_frame
    return Source(
        [sample],
        frame=annotation_frame,
        data_root=None,
        has_poses=False,
        ground_z_m=None if mount is None else mount.ground_z_m,
    )


def _require_cameras(argument: str, values: Mapping[str, np.ndarray], names: list[str]) -> None:
    """Raise an error unless there are images, and an argument has a value for each camera."""
    if set(values) != set(names) or not names:
        raise InputError(
            f"{argument} must have the cameras of the images, {names}, got {list(values)}."
        )


def _by_name(values: Cameras) -> dict[str, np.ndarray]:
    """Return arrays by the name of the camera; arrays of a list get numbered names."""
    if not isinstance(values, Mapping):
        values = {f"camera {number}": array for number, array in enumerate(values)}
    return {str(name): np.asarray(array) for name, array in values.items()}


def _bgr(name: str, image: np.ndarray) -> np.ndarray:
    """Check an image and convert it from RGB to BGR. (H, W, 3)"""
    if image.dtype != np.uint8:
        raise InputTypeError(f"the image of {name!r} must be uint8, RGB, got {image.dtype}.")
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"the image of {name!r} must have shape (H, W, 3), got {image.shape}.")
    # A view with other strides, such as a flipped image, is copied for OpenCV.
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR)
