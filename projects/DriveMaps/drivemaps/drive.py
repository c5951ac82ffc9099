"""A drive: the maps of its frames, predicted or annotated, in the global frame's plane."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError

MIN_LENGTH_M = 2.0
MIN_AREA_M2 = 1.0
SIMPLIFY_M = 0.02
_SLACK_M = 1e-3  # for the rounding of frames


@dataclass(frozen=True, eq=False)
class DriveFrame:
    """One sample of a drive.

    Args:
        sample: Sensors and poses.
        elements: Its map, (x, y) in metres in the global frame.
    """

    sample: MapSample
    elements: MapElements

    @property
    def origin(self) -> FloatArray:
        """Where the annotation frame's origin lies in the global frame, in metres. (2,)"""
        return self.sample.global_from_frame[:2, 3]

    @property
    def rotation(self) -> FloatArray:
        """Turn by the pose's yaw, from the annotation frame to the global frame. (2, 2)"""
        cos, sin = self.sample.global_from_frame[:2, 0]
        return np.array([[cos, -sin], [sin, cos]]) / np.hypot(cos, sin)

    @property
    def yaw_rad(self) -> float:
        """Angle of that turn in radians."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    def to_global(self, points: FloatArray) -> FloatArray:
        """Move points from the annotation frame to the global frame, in the plane. (..., 2)"""
        return points @ self.rotation.T + self.origin

    def to_frame(self, points: FloatArray) -> FloatArray:
        """Move points from the global frame to the annotation frame, in the plane. (..., 2)"""
        return (points - self.origin) @ self.rotation


@dataclass(frozen=True, eq=False)
class Drive:
    """The frames of one scene.

    Args:
        scene: Name of the scene.
        classes: Class names in label order.
        x_range: Smallest and largest x that a frame sees, in its own frame, in metres.
        y_range: Smallest and largest y, likewise.
        frames: The frames in the order of time.
    """

    scene: str
    classes: tuple[str, ...]
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    frames: Sequence[DriveFrame]

    def sees(self, frame: DriveFrame, points: FloatArray) -> BoolArray:
        """Say which points of the global frame, (M, 2) in metres, lie in a frame's range. (M,)"""
        low, high = np.array([self.x_range, self.y_range]).T
        local = frame.to_frame(points)
        return ((local >= low) & (local <= high)).all(axis=1)

    @property
    def reach_m(self) -> float:
        """How far from a frame's origin the farthest corner of its range is, in metres."""
        return float(np.hypot(np.abs(self.x_range).max(), np.abs(self.y_range).max())) + _SLACK_M

    def times_seen(self, points: FloatArray) -> IntArray:
        """Count the frames that have points, (M, 2) in metres, in their range. (M,)"""
        counts, tree = np.zeros(len(points), np.int64), cKDTree(points)
        for frame in self.frames:
            near = tree.query_ball_point(frame.origin, self.reach_m)
            counts[near] += self.sees(frame, points[near])
        return counts

    def nearby(self, frame: DriveFrame, elements: MapElements) -> MapElements:
        """Return the elements, in the global frame, whose boxes come near a frame's range."""
        long = np.flatnonzero(elements.num_points)
        if not len(long):
            return elements
        starts, points = elements.offsets[long], elements.points[:, :2]
        low, high = (f.reduceat(points, starts) for f in (np.minimum, np.maximum))
        near = (low <= frame.origin + self.reach_m) & (high >= frame.origin - self.reach_m)
        return elements.select(long[near.all(axis=1)])

    def footprint(self, frame: DriveFrame) -> shapely.Polygon:
        """Return a frame's range in the global frame."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        return shapely.Polygon(frame.to_global(corners))


def read_drive(annotations: AnnotationFile, scene: str, maps: Mapping[str, MapElements]) -> Drive:
    """Gather the frames of a scene.

    Args:
        annotations: File with the scene's samples.
        scene: Name of the scene.
        maps: Map of each sample in its annotation frame, by token; samples that it lacks are left
            out.

    Raises:
        ValueError: If the file has no such scene, or no sample of it has a map.
    """
    meta, scenes = annotations.meta, annotations.column("scene")
    samples = [annotations[i] for i, name in enumerate(scenes) if name == scene]
    if not samples:
        raise InputError(
            f"{annotations.path} has no scene {scene!r}, but {sorted(set(scenes))[:5]} ..."
        )
    samples = sorted((s for s in samples if s.token in maps), key=lambda s: s.timestamp_ns)
    if not samples:
        raise InputError(
            f"no sample of scene {scene!r} has results: give the results of {annotations.path}."
        )
    frames = [
        DriveFrame(s, maps[s.token].with_coordinates(2).to_frame(s.global_from_frame))
        for s in samples
    ]
    return Drive(scene, meta.classes, meta.x_range, meta.y_range, frames)


def drive_map(found: Iterable[tuple[int, FloatArray, float]], scored: bool = True) -> MapElements:
    """Order elements, and drop the vertices that a line does not need.

    Args:
        found: Label, vertices (n, 2) and score of each element.
        scored: Whether the map keeps the scores.

    Returns:
        The elements by class, then by falling score. (N,)
    """
    rows = [
        (label, shapely.get_coordinates(shapely.LineString(line[:, :2]).simplify(SIMPLIFY_M)), s)
        for label, line, s in found
    ]
    rows.sort(key=lambda row: (row[0], -round(row[2], 9), *np.round(row[1][0], 6)))
    labels, lines, scores = ([row[i] for row in rows] for i in range(3))
    return MapElements.from_polylines(lines, labels, scores if scored else None)
