"""Calibrations that cannot be right: what is implausible about the cameras of samples."""

from collections.abc import Iterator, Sequence

import numpy as np

from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.rigid import invert_rigid

_FARTHEST_M, _HIGHEST_M, _LOWEST_M = 20.0, 5.0, 0.15
_STEEPEST_UP_DEG, _STEEPEST_DOWN_DEG = 25.0, 65.0
_OFF_CENTRE = 0.2  # of the image's width or height
_FIELDS_OF_VIEW_DEG = 15.0, 150.0
_SIDES = {"left": 90.0, "right": -90.0, "front": 0.0, "back": 180.0, "rear": 180.0}


def calibration_warnings(
    samples: Sequence[MapSample], frame: str, ground_z_m: float | None = None
) -> list[str]:
    """Say what is implausible about the cameras of samples, of each drive's first one.

    Args:
        samples: The samples.
        frame: Their annotation frame.
        ground_z_m: Height of the road in it, as in ``AnnotationMeta``.

    Returns:
        One line a finding, without repetition.
    """
    firsts: dict[str, MapSample] = {}
    for sample in samples:
        firsts.setdefault(sample.scene, sample)
    found = (line for sample in firsts.values() for line in _warnings(sample, frame, ground_z_m))
    return list(dict.fromkeys(found))


def _warnings(sample: MapSample, frame: str, ground_z_m: float | None) -> Iterator[str]:
    ground = ground_from_frame(sample, frame, ground_z_m)
    poses = {c.name: ground @ invert_rigid(c.cam_from_frame) for c in sample.cameras}
    places = np.array([pose[:3, 3] for pose in poses.values()]).reshape(-1, 3)
    distances = np.linalg.norm(places, axis=1)
    plausible = bool((distances < _FARTHEST_M).all())
    if not plausible:
        unit = "millimetres" if np.median(distances) > 300 else "centimetres"
        yield (
            f"cameras stand up to {distances.max():.0f} m from the vehicle's origin: are positions "
            f"in {unit}? They must be in metres"
        )
    elif len(places) > 1 and np.ptp(places, axis=0).max() < 0.01:
        yield "all cameras stand in one point: their positions are missing"
    for camera in sample.cameras:
        pose = poses[camera.name]
        lines = [*_view_warnings(camera.name, pose), *_lens_warnings(camera)]
        if plausible:
            lines += _height_warnings(pose[2, 3])
        yield from (f"camera {camera.name!r} {line}" for line in lines)


def _height_warnings(height_m: float) -> Iterator[str]:
    if height_m <= 0:
        yield f"stands {-height_m:.2f} m below the road"
    elif not _LOWEST_M <= height_m <= _HIGHEST_M:
        yield f"stands {height_m:.2f} m above the road: is the unit metres?"


def _view_warnings(name: str, pose: np.ndarray) -> Iterator[str]:
    """Judge where a camera looks, by its pose on the ground. (4, 4)"""
    right, down, ahead = pose[:3, :3].T
    up_deg = np.degrees(np.arcsin(np.clip(ahead[2], -1, 1)))
    if up_deg > _STEEPEST_UP_DEG:
        yield (
            f"looks {up_deg:.0f} degrees up at the sky: its axes must be x right, y down, z ahead, "
            "and the transform the right way round"
        )
        return
    if up_deg < -_STEEPEST_DOWN_DEG:
        yield f"looks {-up_deg:.0f} degrees down at the road"
        return
    if down[2] > 0.5:
        yield "is upside down: up and down are swapped"
    elif abs(right[2]) > 0.5:
        yield "lies on its side"
    azimuth_deg = np.degrees(np.arctan2(ahead[1], ahead[0]))
    for word, side_deg in _SIDES.items():
        off_deg = abs((azimuth_deg - side_deg + 180) % 360 - 180)
        if word in name.lower() and off_deg > 110:
            yield (
                f"has {word!r} in its name, but looks {abs(azimuth_deg):.0f} degrees to the "
                f"{'left' if azimuth_deg > 0 else 'right'}: are axes mirrored?"
            )
    side = pose[1, 3]
    if abs(side) > 0.3 and 30 < -np.sign(side) * azimuth_deg < 150:
        stands, looks = ("left", "right") if side > 0 else ("right", "left")
        yield f"stands on the {stands} and looks to the {looks}: are axes mirrored?"


def _lens_warnings(camera: CameraRecord) -> Iterator[str]:
    """Judge whether intrinsics fit the image's size."""
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics
    size = f"{camera.width} x {camera.height}"
    off = max(abs(cx / camera.width - 0.5), abs(cy / camera.height - 0.5))
    if off > _OFF_CENTRE:
        yield (
            f"has its principal point at ({cx:.0f}, {cy:.0f}) of {size} pixels: the intrinsics "
            f"seem to be of images of about {2 * cx:.0f} x {2 * cy:.0f}"
        )
    view_deg = 2 * np.degrees(np.arctan(camera.width / 2 / fx))
    low, high = _FIELDS_OF_VIEW_DEG
    if not low <= view_deg <= high:
        yield f"sees {view_deg:.0f} degrees, by fx = {fx:.1f} and {size} pixels: is fx in pixels?"
    if not 0.8 < fx / fy < 1.25:
        yield f"has fx = {fx:.1f} and fy = {fy:.1f}: was the image squeezed?"
