"""What viewers show of a drive over time, with heights, independent of any viewer's format."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from scipy.spatial import cKDTree

from drivemaps.drive import Drive, DriveFrame
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.frames import FrameView, frame_view

SHOWN_SIGMAS = 2.0  # ellipses reach so many standard deviations


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame of a drive, as viewers show it.

    Args:
        frame: Sensors, pose and predictions.
        lines: Its predictions in the annotation frame, on the ground. each (n, 3)
        seen: The part of the drive's map that has been in range so far: label and vertices in the
            global frame. each (int, (n, 3))
    """

    frame: DriveFrame
    lines: list[FloatArray]
    seen: list[tuple[int, FloatArray]]

    @property
    def ellipses(self) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Gaussians of the vertices: centres, half axes in metres, quaternions (x, y, z, w).

        (M, 3), (M, 2) and (M, 4); None if the results carry no Gaussians.
        """
        elements = self.frame.elements
        if elements.scales is None or elements.rotations is None:
            return None
        half_turns = (elements.rotations - self.frame.yaw_rad) / 2.0
        quaternions = np.zeros((len(half_turns), 4))
        quaternions[:, 2], quaternions[:, 3] = np.sin(half_turns), np.cos(half_turns)
        centres = np.concatenate([np.zeros((0, 3)), *self.lines])
        return centres, SHOWN_SIGMAS * elements.scales, quaternions


@dataclass(frozen=True, eq=False)
class Replay:
    """A drive and its map with what a viewer needs to show them.

    Args:
        drive: Frames with their predictions.
        elements: The drive's map.
        frame_kind: The annotation frame, a key of ``FRAME_VIEWS``.
        colours: Colour of each class, ``#RRGGBB``.
        data_root: Folder that the paths of images start from; None leaves the images out.
        ground_z_m: Height of the road in the annotation frame, as in ``AnnotationMeta``.
    """

    drive: Drive
    elements: MapElements
    frame_kind: str
    colours: Sequence[str]
    data_root: Path | None = None
    ground_z_m: float | None = None

    @property
    def view(self) -> FrameView:
        """How the annotation frame lies."""
        return frame_view(self.frame_kind, self.ground_z_m)

    def moments(self) -> Iterator[Moment]:
        """Go through the drive and let its map grow: yield what there is to see at each frame."""
        view, drive = self.view, self.drive
        views = [view.with_mounting(frame.sample.ego_from_frame) for frame in drive.frames]
        places = cKDTree([f.sample.global_from_frame[:2, 3] for f in drive.frames])
        lines = [shapely.linestrings(line) for line in self.elements.polylines]
        explored = shapely.Polygon()
        for frame, ground in zip(drive.frames, views, strict=True):
            explored |= drive.footprint(frame)
            seen = []
            for label, line in zip(self.elements.labels.tolist(), lines, strict=True):
                for part in shapely.get_parts(shapely.intersection(line, explored)):
                    if part.length:
                        points = shapely.get_coordinates(part)
                        nearest = places.query(points)[1]
                        seen.append((label, _raised(drive, views, points, nearest)))
            local = [ground.lift(frame.to_frame(p)) for p in frame.elements.polylines]
            yield Moment(frame, local, seen)


def _raised(
    drive: Drive, views: list[FrameView], points: FloatArray, nearest: IntArray
) -> FloatArray:
    """Put points of the global frame on the ground of the frames that are nearest. (n, 3)"""
    raised = np.empty((len(points), 3))
    for number in np.unique(nearest):
        frame, rows = drive.frames[number], nearest == number
        local = views[number].lift(frame.to_frame(points[rows]))
        pose = frame.sample.global_from_frame
        raised[rows] = np.column_stack([points[rows], local @ pose[2, :3] + pose[2, 3]])
    return raised
