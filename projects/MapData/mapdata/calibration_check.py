"""Calibrations that cannot be right: what is implausible about them, and a picture to judge by."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gsmap.datasets.annotations.record import RANGES, CameraRecord, MapSample
from gsmap.datasets.image_files import image_size
from gsmap.datasets.plausibility import calibration_warnings as calibration_warnings
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import invert_rigid
from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import camera_views
from gsmap.visualization.figure import compose_figure
from gsmap.visualization.style import MapStyle

_REACH_M = 30.0
_WIDTH_PX = 3200  # six cameras of about 750 px, large enough to see an error of a few centimetres
_LINES = ("ahead", "left", "every_5_m", "behind", "right", "cameras")


def image_warnings(sample: MapSample, data_root: Path) -> list[str]:
    """Say which images of a sample have another size than their calibration."""
    found = []
    for camera in sample.cameras:
        path = data_root / camera.path
        if path.is_file():
            size = image_size(path, f"camera {camera.name!r}")
            if size != (camera.width, camera.height):
                found.append(
                    f"camera {camera.name!r} has images of {size[0]} x {size[1]} pixels, but is "
                    f"calibrated for {camera.width} x {camera.height}"
                )
    return found


def calibration_figure(
    sample: MapSample, frame: str, data_root: Path, ground_z_m: float | None = None
) -> Figure:
    """Draw the ground plane, every 5 m, over a sample's images, and the cameras from above.

    Args:
        sample: The sample.
        frame: Its annotation frame.
        data_root: Folder that its paths start from; an image that is not there is grey.
        ground_z_m: Height of the road in the frame, as in ``AnnotationMeta``.

    Returns:
        The picture: lines ahead, to the left, to the right and behind have colours of their own.
    """
    frame_from_ground = invert_rigid(ground_from_frame(sample, frame, ground_z_m))
    lines = _ground_lines(frame_from_ground)
    wedges = [("cameras", _wedge(c, frame_from_ground)) for c in sample.cameras]
    style = MapStyle(classes=_LINES)
    return compose_figure(
        camera_views(sample.cameras, data_root, sample.token, grey=True),
        [BEVPanel("From above", _elements([*lines, *wedges]))],
        BEVGrid(*RANGES[frame]),
        frame_view(frame, ground_z_m).with_mounting(sample.ego_from_frame),
        style,
        _elements(lines),
        f"ground plane of {sample.token}",
        width_px=_WIDTH_PX,
    )


def _elements(lines: Sequence[tuple[str, np.ndarray]]) -> MapElements:
    return MapElements.from_polylines(
        [points for _, points in lines], [_LINES.index(name) for name, _ in lines]
    )


def _ground_lines(frame_from_ground: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return lines on the road, in the annotation frame. each (name, (n, 3))"""
    reach = _REACH_M
    steps = [s for s in np.arange(-reach, reach + 1, 5.0) if s]
    ends = [("every_5_m", (s, -15.0), (s, 15.0)) for s in steps]
    ends += [("every_5_m", (-reach, s), (reach, s)) for s in steps if abs(s) <= 15]
    ends += [("ahead", (0.0, 0.0), (reach, 0.0)), ("behind", (0.0, 0.0), (-reach, 0.0))]
    ends += [("left", (0.0, 0.0), (0.0, 15.0)), ("right", (0.0, 0.0), (0.0, -15.0))]
    return [
        (name, (np.array([[*a, 0, 1], [*b, 0, 1]]) @ frame_from_ground.T)[:, :3])
        for name, a, b in ends
    ]


def _wedge(camera: CameraRecord, frame_from_ground: np.ndarray) -> np.ndarray:
    """Return the outline of what a camera sees within 6 m, on the road. (4, 3)"""
    k = camera.intrinsics
    rays = [[(u - k[0, 2]) / k[0, 0], 0, 1] for u in (0, camera.width)]
    pose = invert_rigid(camera.cam_from_frame @ frame_from_ground)
    tips = [pose[:3, 3] + 6 * (ray := pose[:3, :3] @ r) / np.linalg.norm(ray) for r in rays]
    outline = np.array([pose[:3, 3], *tips, pose[:3, 3]])
    outline[:, 2] = 0
    return np.column_stack([outline, np.ones(4)]) @ frame_from_ground.T[:, :3]
