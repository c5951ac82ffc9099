"""Checks of calibrations: warnings, and a figure with the ground plane drawn into the images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gsmap.datasets.annotations.record import RANGES, CameraRecord, MapSample
from gsmap.datasets.image_files import image_size
from gsmap.datasets.plausibility import calibration_warnings as calibration_warnings  # re-exported
from gsmap.datasets.plausibility import first_samples as first_samples  # re-exported
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import invert_rigid
from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import camera_views
from gsmap.visualization.figure import compose_figure
from gsmap.visualization.style import MapStyle

_REACH_M = 30.0  # length of the ground lines ahead of and behind the vehicle
_SIDE_REACH_M = 15.0  # length of the ground lines to the left and right of the vehicle
_WEDGE_M = 6.0  # length of a field of view in the panel from above
_WIDTH_PX = 3200  # six cameras of about 750 px, large enough to see an error of a few centimetres
# Classes of the drawn lines; "cameras" are the fields of view. The order determines the colours.
_LINE_CLASSES = ("ahead", "left", "every_5_m", "behind", "right", "cameras")


def image_warnings(sample: MapSample, data_root: Path) -> list[str]:
    """Warnings about images whose size differs from the size in the calibration of the camera.

    Args:
        sample: The sample.
        data_root: Folder that image paths are relative to. Missing images are ignored.

    Returns:
        A line for each such image.
    """
    warnings = []
    for camera in sample.cameras:
        path = data_root / camera.path
        if path.is_file():
            # The second argument is the beginning of error messages.
            width, height = image_size(path, f"camera {camera.name!r}")
            if (width, height) != (camera.width, camera.height):
                warnings.append(
                    f"camera {camera.name!r} has images of {width} x {height} pixels, but is "
                    f"calibrated for {camera.width} x {camera.height}"
                )
    return warnings


def calibration_figure(
    sample: MapSample, frame: str, data_root: Path, ground_z_m: float | None = None
) -> Figure:
    """Draw the ground plane, every 5 m, over a sample's images, and the cameras from above.

    Args:
        sample: The sample.
        frame: Annotation frame of the sample, ``lidar`` or ``ego``.
        data_root: Folder that image paths are relative to. A missing or damaged image is drawn in
            grey.
        ground_z_m: Height of the road in the frame in metres, as in ``AnnotationMeta``; None for
            the usual height.

    Returns:
        The figure, with different colours for lines ahead, to the left, to the right and behind.
    """
    # The origin of the ground frame is on the road below the rear axle (x ahead, y left, z up).
    frame_from_ground = invert_rigid(ground_from_frame(sample, frame, ground_z_m=ground_z_m))
    lines = _ground_lines(frame_from_ground)
    wedges = []  # fields of view, which are drawn only in the panel from above
    for camera in sample.cameras:
        wedges.append(("cameras", _field_of_view(camera, frame_from_ground)))
    x_range, y_range = RANGES[frame]
    return compose_figure(
        # With `grey`, a missing or damaged image is drawn in grey.
        cameras=camera_views(sample.cameras, data_root, token=sample.token, grey=True),
        panels=[BEVPanel("From above", _elements([*lines, *wedges]))],
        grid=BEVGrid(x_range=x_range, y_range=y_range),
        # The view has the ground plane; it follows from the mounting of the sensor, if it is known.
        view=frame_view(frame, ground_z_m=ground_z_m).with_mounting(sample.ego_from_frame),
        style=MapStyle(classes=_LINE_CLASSES),
        camera_elements=_elements(lines),
        title=f"ground plane of {sample.token}",
        width_px=_WIDTH_PX,
    )


def _elements(lines: Sequence[tuple[str, np.ndarray]]) -> MapElements:
    """Convert pairs (class, points (n, 3)) to map elements with indices of ``_LINE_CLASSES``."""
    polylines = []
    labels = []
    for name, points in lines:
        polylines.append(points)
        labels.append(_LINE_CLASSES.index(name))
    return MapElements.from_polylines(polylines, labels)


def _ground_lines(frame_from_ground: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Lines on the road: pairs of a class and two points (2, 3), in metres in the frame."""
    reach = _REACH_M
    side = _SIDE_REACH_M
    ends = []  # class, start (x, y) and end (x, y) of each line in the ground frame, in metres
    # Without 0, where the lines ahead, behind, left and right are drawn instead.
    offsets = [offset for offset in np.arange(-reach, reach + 1, 5.0) if offset != 0]
    for x in offsets:
        ends.append(("every_5_m", (x, -side), (x, side)))
    for y in offsets:
        if abs(y) <= side:
            ends.append(("every_5_m", (-reach, y), (reach, y)))
    ends.append(("ahead", (0.0, 0.0), (reach, 0.0)))
    ends.append(("behind", (0.0, 0.0), (-reach, 0.0)))
    ends.append(("left", (0.0, 0.0), (0.0, side)))
    ends.append(("right", (0.0, 0.0), (0.0, -side)))
    lines = []
    for name, (start_x, start_y), (end_x, end_y) in ends:
        points = np.array([[start_x, start_y, 0, 1], [end_x, end_y, 0, 1]])
        points_in_frame = points @ frame_from_ground.T  # homogeneous row vectors (2, 4)
        lines.append((name, points_in_frame[:, :3]))
    return lines


def _field_of_view(camera: CameraRecord, frame_from_ground: np.ndarray) -> np.ndarray:
    """Closed triangle of a camera's horizontal field of view, on the road, in the frame. (4, 3)"""
    intrinsics = camera.intrinsics
    ground_from_cam = invert_rigid(camera.cam_from_frame @ frame_from_ground)
    rotation = ground_from_cam[:3, :3]
    centre = ground_from_cam[:3, 3]
    tips = []
    for u in (0, camera.width):  # left and right edge, in the row of the optical axis
        slope = (u - intrinsics[0, 2]) / intrinsics[0, 0]
        ray = rotation @ [slope, 0, 1]  # from camera axes (right, down, forward)
        tips.append(centre + _WEDGE_M * ray / np.linalg.norm(ray))
    outline = np.array([centre, *tips, centre])
    outline[:, 2] = 0  # down to the road
    homogeneous = np.column_stack([outline, np.ones(4)])
    return homogeneous @ frame_from_ground.T[:, :3]  # without the fourth coordinate, which is 1
