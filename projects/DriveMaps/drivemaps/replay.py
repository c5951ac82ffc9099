"""Frames of a drive in order of time, with 3D lines, for the writers of all viewer formats."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from scipy.spatial import cKDTree

from drivemaps.drive import Drive, DriveFrame
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.structures.frames import FrameView, frame_view

SHOWN_SIGMAS = 2.0
"""Half axes of the ellipses of Gaussians, in standard deviations."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame of a drive, with the map up to it.

    Args:
        frame: Sensors, pose and predictions.
        lines: Predicted polylines on the ground, in metres in the annotation frame. (n, 3) each
        map_lines: Part of the map that has been in the range of a frame so far. Each line is its
            label and its vertices (n, 3) in metres in the global frame.
    """

    frame: DriveFrame
    lines: list[FloatArray]
    map_lines: list[tuple[int, FloatArray]]

    @property
    def ellipses(self) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Ellipses of the Gaussians of the vertices, on the ground of the annotation frame.

        Returns:
            Centres in metres (M, 3), half axes in metres (M, 2) and rotations as quaternions
            (x, y, z, w) (M, 4), or None if the results have no Gaussians.
        """
        elements = self.frame.elements
        if elements.scales is None or elements.rotations is None:
            return None
        centres = np.concatenate([np.zeros((0, 3)), *self.lines])
        # Each vertex is the centre of one Gaussian. `self.lines` are in the annotation frame, but
        # `elements.rotations` are in the global frame, so the yaw of the frame is subtracted.
        # A rotation by an angle about z has the quaternion (0, 0, sin(angle / 2), cos(angle / 2)).
        half_angles = (elements.rotations - self.frame.yaw_rad) / 2.0
        quaternions = np.zeros((len(half_angles), 4))
        quaternions[:, 2] = np.sin(half_angles)
        quaternions[:, 3] = np.cos(half_angles)
        return centres, SHOWN_SIGMAS * elements.scales, quaternions


@dataclass(frozen=True, eq=False)
class Replay:
    """Input of the writers for viewers: a drive, its map, colours and images.

    Args:
        drive: Frames with their predictions.
        elements: Map of the drive in the global frame.
        frame_kind: Kind of the annotation frame, a key of ``FRAME_VIEWS``.
        colours: Colour of each class, ``#RRGGBB``.
        data_root: Folder that image paths are relative to, or None to leave images out.
        ground_z_m: Height of the road in the annotation frame in metres, as in ``AnnotationMeta``.
    """

    drive: Drive
    elements: MapElements
    frame_kind: str
    colours: Sequence[str]
    data_root: Path | None = None
    ground_z_m: float | None = None

    @property
    def view(self) -> FrameView:
        """Orientation and ground plane of the annotation frame."""
        return frame_view(self.frame_kind, self.ground_z_m)

    def moments(self) -> Iterator[Moment]:
        """Iterate over the frames of the drive, each with the part of the map explored so far.

        A place is explored once it has been in the range of a frame.

        Yields:
            Each frame, in the order of time.
        """
        frames = self.drive.frames
        # The tilt of the sensor in a frame determines the ground plane in the annotation frame.
        views = [self.view.with_mounting(frame.sample.ego_from_frame) for frame in frames]
        frame_tree = cKDTree([frame.origin for frame in frames])
        labels = self.elements.labels.tolist()
        whole_lines = [shapely.linestrings(line) for line in self.elements.polylines]
        explored = shapely.Polygon()
        for frame, view in zip(frames, views, strict=True):
            explored |= self.drive.footprint(frame)  # range of the frame, in the global frame
            map_lines = []
            for label, whole_line in zip(labels, whole_lines, strict=True):
                # The explored area may contain several separate parts of a line.
                for part in shapely.get_parts(shapely.intersection(whole_line, explored)):
                    if not part.length:  # a point where the line touches the explored part
                        continue
                    points = shapely.get_coordinates(part)
                    points_3d = _raise_to_ground(
                        points, frames=frames, views=views, frame_tree=frame_tree
                    )
                    map_lines.append((label, points_3d))
            predictions = []
            for line in frame.elements.polylines:
                # `to_frame` returns (x, y) in the annotation frame, and `lift` adds the z of the
                # ground plane.
                predictions.append(view.lift(frame.to_frame(line)))
            yield Moment(frame, lines=predictions, map_lines=map_lines)


def _raise_to_ground(
    points: FloatArray,
    frames: Sequence[DriveFrame],
    views: Sequence[FrameView],
    frame_tree: cKDTree,
) -> FloatArray:
    """Add the height of the ground to points, from the ground plane of the nearest frame.

    Args:
        points: Points (x, y) in metres in the global frame. (n, 2)
        frames: Frames of the drive.
        views: Ground plane of each frame.
        frame_tree: Search tree of the origins (x, y) of the frames in the global frame.

    Returns:
        Points (x, y, z) in metres in the global frame. (n, 3)
    """
    _, nearest = frame_tree.query(points)
    points_3d = np.empty((len(points), 3))
    for index in np.unique(nearest):
        frame = frames[index]
        rows = nearest == index
        local = views[index].lift(frame.to_frame(points[rows]))  # on the ground, in the frame
        pose = frame.sample.global_from_frame
        height = local @ pose[2, :3] + pose[2, 3]  # the third row of the pose gives z
        points_3d[rows] = np.column_stack([points[rows], height])
    return points_3d
