"""Plausibility checks of camera calibrations."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.rigid import invert_rigid

_MAX_DISTANCE_M = 20.0  # from the origin of the vehicle to a camera
# Distances that are too large are taken for millimetres if their median is above this limit, and
# otherwise for centimetres.
_MILLIMETRES_FROM = 300.0
_MIN_HEIGHT_M = 0.15  # height of a camera above the road
_MAX_HEIGHT_M = 5.0
_MAX_UP_DEG = 25.0  # slope of the optical axis, upwards and downwards
_MAX_DOWN_DEG = 65.0
# Angle between the optical axis and a direction in the name of the camera. It is large, because a
# name such as ``back_left`` has two words, and the camera looks between their directions.
_MAX_NAME_DEG = 110.0
# Distance of the principal point from the image centre, relative to the width or height.
_MAX_CENTRE_OFFSET = 0.2
_MIN_FIELD_OF_VIEW_DEG = 15.0
_MAX_FIELD_OF_VIEW_DEG = 150.0
_SIDES = {"left": 90.0, "right": -90.0, "front": 0.0, "back": 180.0, "rear": 180.0}
"""Azimuth of a camera in degrees, anticlockwise from ahead; the keys are words in camera names."""


def calibration_warnings(
    samples: Sequence[MapSample], frame: str, ground_z_m: float | None = None
) -> list[str]:
    """Find implausible calibrations of the cameras of each drive, where they first appear.

    Args:
        samples: Samples of one or more drives.
        frame: Annotation frame of the samples, ``lidar`` or ``ego``.
        ground_z_m: Height of the road in the frame in metres; None for the usual height.

    Returns:
        Warnings without repetitions, one line each.
    """
    warnings: list[str] = []
    for sample in first_samples(samples):
        for line in _warnings(sample, frame=frame, ground_z_m=ground_z_m):
            if line not in warnings:
                warnings.append(line)
    return warnings


def first_samples(samples: Iterable[MapSample]) -> list[MapSample]:
    """First sample of each drive, with the first record of every camera of the drive.

    Cameras that the first sample lacks come from later samples.
    """
    samples_of: dict[str, MapSample] = {}  # first sample by scene
    cameras_of: dict[str, dict[str, CameraRecord]] = {}  # first records by scene and name
    for sample in samples:
        samples_of.setdefault(sample.scene, sample)
        cameras = cameras_of.setdefault(sample.scene, {})
        for camera in sample.cameras:
            cameras.setdefault(camera.name, camera)
    return [
        replace(sample, cameras=list(cameras_of[scene].values()))
        for scene, sample in samples_of.items()
    ]


def _warnings(sample: MapSample, frame: str, ground_z_m: float | None) -> Iterator[str]:
    """Yield the warnings about all cameras of a sample; see `calibration_warnings`."""
    # The frame of the ground has its origin below the rear axle: x ahead, y left, z up.
    ground_from_sample = ground_from_frame(sample, frame=frame, ground_z_m=ground_z_m)
    poses = {}  # transforms from each camera to the ground
    for camera in sample.cameras:
        poses[camera.name] = ground_from_sample @ invert_rigid(camera.cam_from_frame)
    # `reshape` is for a sample without cameras.
    positions = np.array([pose[:3, 3] for pose in poses.values()]).reshape(-1, 3)
    distances = np.linalg.norm(positions, axis=1)
    is_near = bool((distances < _MAX_DISTANCE_M).all())
    if not is_near:
        is_large = np.median(distances) > _MILLIMETRES_FROM
        unit = "millimetres" if is_large else "centimetres"
        yield (
            f"cameras stand up to {distances.max():.0f} m from the vehicle's origin: are positions "
            f"in {unit}? They must be in metres"
        )
    elif len(positions) > 1 and np.ptp(positions, axis=0).max() < 0.01:  # all within 1 cm
        yield "all cameras stand in one point: their positions are missing"
    for camera in sample.cameras:
        pose = poses[camera.name]
        lines = list(_view_warnings(camera.name, pose))
        lines += _lens_warnings(camera)
        if is_near:  # otherwise the unit seems to be wrong, and heights would only repeat it
            lines += _height_warnings(height_m=pose[2, 3])
        for line in lines:
            yield f"camera {camera.name!r} {line}"


def _height_warnings(height_m: float) -> Iterator[str]:
    """Yield warnings about the height of a camera above the road."""
    if height_m <= 0:
        yield f"stands {-height_m:.2f} m below the road"
    elif not _MIN_HEIGHT_M <= height_m <= _MAX_HEIGHT_M:
        yield f"stands {height_m:.2f} m above the road: is the unit metres?"


def _view_warnings(name: str, pose: np.ndarray) -> Iterator[str]:
    """Yield warnings about the direction of a camera.

    Args:
        name: Name of the camera.
        pose: Transform from the camera to the ground. (4, 4)
    """
    right = pose[:3, 0]  # axes of the camera, in the frame of the ground, whose z axis points up
    down = pose[:3, 1]
    ahead = pose[:3, 2]
    up_deg = np.degrees(np.arcsin(np.clip(ahead[2], -1, 1)))  # slope of the optical axis
    # After the first two warnings, further ones would only describe effects of one wrong rotation.
    if up_deg > _MAX_UP_DEG:
        yield (
            f"looks {up_deg:.0f} degrees up at the sky: its axes must be x right, y down, z ahead, "
            "and the transform the right way round"
        )
        return
    if up_deg < -_MAX_DOWN_DEG:
        yield f"looks {-up_deg:.0f} degrees down at the road"
        return
    # An axis with a z component of 0.5 points 30 degrees upwards.
    if down[2] > 0.5:
        yield "is upside down: up and down are swapped"
    elif abs(right[2]) > 0.5:
        yield "lies on its side"
    azimuth_deg = np.degrees(np.arctan2(ahead[1], ahead[0]))  # anticlockwise from ahead
    for word, side_deg in _SIDES.items():
        difference_deg = (azimuth_deg - side_deg + 180) % 360 - 180  # [-180, 180)
        if word in name.lower() and abs(difference_deg) > _MAX_NAME_DEG:
            direction = "left" if azimuth_deg > 0 else "right"
            yield (
                f"has {word!r} in its name, but looks {abs(azimuth_deg):.0f} degrees to the "
                f"{direction}: are axes mirrored?"
            )
    left_m = pose[1, 3]  # distance to the left of the vehicle's centre line
    inward_deg = -np.sign(left_m) * azimuth_deg  # positive towards the other side of the vehicle
    if abs(left_m) > 0.3 and 30 < inward_deg < 150:
        side = "left" if left_m > 0 else "right"
        opposite_side = "right" if left_m > 0 else "left"
        yield f"stands on the {side} and looks to the {opposite_side}: are axes mirrored?"


def _lens_warnings(camera: CameraRecord) -> Iterator[str]:
    """Yield warnings about intrinsics that do not fit the size of the image."""
    fx = camera.intrinsics[0, 0]
    fy = camera.intrinsics[1, 1]
    cx = camera.intrinsics[0, 2]
    cy = camera.intrinsics[1, 2]
    size = f"{camera.width} x {camera.height}"
    centre_offset = max(abs(cx / camera.width - 0.5), abs(cy / camera.height - 0.5))
    if centre_offset > _MAX_CENTRE_OFFSET:
        yield (
            f"has its principal point at ({cx:.0f}, {cy:.0f}) of {size} pixels: the intrinsics "
            f"seem to be of images of about {2 * cx:.0f} x {2 * cy:.0f}"
        )
    # Horizontal field of view of a pinhole camera with its principal point in the centre.
    view_deg = 2 * np.degrees(np.arctan(camera.width / 2 / fx))
    if not _MIN_FIELD_OF_VIEW_DEG <= view_deg <= _MAX_FIELD_OF_VIEW_DEG:
        yield (
            f"has a field of view of {view_deg:.0f} degrees, from fx = {fx:.1f} and {size} pixels: "
            "is fx in pixels?"
        )
    if not 0.8 < fx / fy < 1.25:
        yield f"has fx = {fx:.1f} and fy = {fy:.1f}: was the image squeezed?"
