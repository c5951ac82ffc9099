"""The patch of a map that a sample sees, and outlines cut with it; shared by converters."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely

from gsmap.structures.polylines import Points, clip_to_box

_CHUNK_SEGMENTS = 32


@dataclass(frozen=True, eq=False)
class LocalPatch:
    """A rectangle in the map's plane, turned with the annotation frame by its yaw alone.

    Args:
        centre: Origin of the frame in the map, in metres. (2,)
        rotation: Unit vectors of the frame's x and y axis in the map, as columns. (2, 2)
        x_range: Smallest and largest x in the frame, in metres.
        y_range: Smallest and largest y in the frame, in metres.
    """

    centre: np.ndarray
    rotation: np.ndarray
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    @classmethod
    def from_pose(
        cls,
        global_from_frame: np.ndarray,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
    ) -> "LocalPatch":
        """Build the patch of a pose, whose yaw is the direction of its x axis.

        Args:
            global_from_frame: Pose. (4, 4)
            x_range: Smallest and largest x in the frame, in metres.
            y_range: Smallest and largest y in the frame, in metres.

        Raises:
            ValueError: If the pose is not a finite 4 x 4 matrix.
        """
        pose = np.asarray(global_from_frame)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"global_from_frame must be a finite 4 x 4 matrix, got {pose}.")
        cos, sin = pose[:2, 0] / np.hypot(*pose[:2, 0])
        return cls(pose[:2, 3], np.array([[cos, -sin], [sin, cos]]), x_range, y_range)

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The rectangle in the map's frame."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        polygon = shapely.Polygon(corners @ self.rotation.T + self.centre)
        shapely.prepare(polygon)
        return polygon

    def points_to_local(self, points: Points) -> np.ndarray:
        """Move points from the map to the annotation frame. (n, 2)."""
        x, y = (points[:, :2] - self.centre).T
        # Written out: a matrix product may round equal points differently from row to row.
        r = self.rotation
        return np.stack([r[0, 0] * x + r[1, 0] * y, r[0, 1] * x + r[1, 1] * y], -1)

    def to_local(self, geometries: np.ndarray) -> np.ndarray:
        """Move geometries from the map to the annotation frame. (n,)."""
        return shapely.transform(geometries, self.points_to_local)


def rings_of(polygons: np.ndarray, exterior_ccw: bool) -> np.ndarray:
    """Return all rings of polygons, exteriors turned as asked and holes the other way round.

    Args:
        polygons: Polygons. (n,)
        exterior_ccw: Whether exteriors run anticlockwise.

    Returns:
        Rings, polygon by polygon, the exterior first. (rings,)
    """
    rings, owner = shapely.get_rings(polygons, return_index=True)
    is_exterior = np.ones(len(rings), dtype=bool)
    is_exterior[1:] = owner[1:] != owner[:-1]  # a polygon's first ring is its exterior
    turn = shapely.is_ccw(rings) != (is_exterior == exterior_ccw)
    rings[turn] = shapely.reverse(rings[turn])
    return rings


class OutlineIndex:
    """Rings of a whole map, indexed in short chunks, so that a patch touches only what is near.

    Args:
        rings: Simple rings, in the map's frame. (n,) of LinearRing
    """

    def __init__(self, rings: np.ndarray) -> None:
        self._rings = [shapely.get_coordinates(ring) for ring in rings]
        chunks, owners = [], []
        self._starts: list[np.ndarray] = []
        for number, points in enumerate(self._rings):
            starts = np.arange(0, len(points) - 1, _CHUNK_SEGMENTS)
            self._starts.append(starts)
            for position, start in enumerate(starts.tolist()):
                chunks.append(shapely.LineString(points[start : start + _CHUNK_SEGMENTS + 1]))
                owners.append((number, position))
        self._tree = shapely.STRtree(chunks)
        self._owners = np.array(owners, np.int64).reshape(-1, 2)

    def cut(self, patch: LocalPatch, margin_m: float) -> list[np.ndarray]:
        """Return the parts of the rings inside a patch.

        Args:
            patch: Where to cut.
            margin_m: By how much the patch is shrunk on each side, in metres.

        Returns:
            Pieces in the annotation frame; a ring wholly inside stays closed. each (n, 2)
        """
        near = self._owners[self._tree.query(patch.polygon, predicate="intersects")]
        x_range, y_range = (
            (low + margin_m, high - margin_m) for low, high in (patch.x_range, patch.y_range)
        )
        pieces = []
        for number in np.unique(near[:, 0]):
            positions = np.sort(near[near[:, 0] == number, 1])
            for points in self._runs(int(number), positions):
                pieces += clip_to_box(patch.points_to_local(points), x_range, y_range)
        return pieces

    def _runs(self, number: int, positions: np.ndarray) -> list[np.ndarray]:
        """Return the polylines that consecutive chunks form; positions ascend. each (n, 2)."""
        ring, starts = self._rings[number], self._starts[number]
        if len(positions) == len(starts):
            return [ring]
        ends = np.append(starts[1:], len(ring) - 1)
        breaks = np.flatnonzero(np.diff(positions) > 1) + 1
        runs = [positions[a:b] for a, b in pairwise([0, *breaks.tolist(), len(positions)])]
        polylines = [ring[starts[run[0]] : ends[run[-1]] + 1] for run in runs]
        if len(runs) > 1 and positions[0] == 0 and positions[-1] == len(starts) - 1:
            polylines[0] = np.concatenate([polylines.pop(), polylines[0][1:]])
        return polylines
