"""The patch of a map that a sample sees, and geometry cut with it; shared by converters."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from gsmap.structures.polylines import Points, clip_to_box
from gsmap.utils.errors import InputError

LINE, POLYGON, COLLECTION = 1, 3, 7  # shapely type ids
_CHUNK_SEGMENTS = 32


@dataclass(frozen=True, eq=False)
class LocalPatch:
    """A rectangle in the map's plane, turned by the pose's yaw; roll and pitch do not matter.

    Args:
        global_from_frame: Pose of the annotation frame in the map, finite. (4, 4)
        x_range: Smallest and largest x in the frame, in metres.
        y_range: Smallest and largest y in the frame, in metres.
    """

    global_from_frame: np.ndarray
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def __post_init__(self) -> None:
        pose = np.asarray(self.global_from_frame)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(f"global_from_frame must be a finite 4 x 4 matrix, got {pose}.")

    @cached_property
    def rotation(self) -> np.ndarray:
        """Unit vectors of the turned x and y axis in the map, as columns. (2, 2)."""
        cos, sin = self.global_from_frame[:2, 0] / np.hypot(*self.global_from_frame[:2, 0])
        return np.array([[cos, -sin], [sin, cos]])

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The rectangle in the map's frame."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        polygon = shapely.Polygon(corners @ self.rotation.T + self.global_from_frame[:2, 3])
        shapely.prepare(polygon)
        return polygon

    def box(self, margin_m: float) -> shapely.Polygon:
        """Return the rectangle in its own frame, enlarged by ``margin_m`` on every side."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        return shapely.box(x0 - margin_m, y0 - margin_m, x1 + margin_m, y1 + margin_m)

    # Products are written out below: a matrix product may round one point differently from row to
    # row, and equal points must stay equal for lines to join.
    def points_to_local(self, points: Points) -> np.ndarray:
        """Move points from the map to the patch's frame in the plane. (n, 2)."""
        x, y = (points[:, :2] - self.global_from_frame[:2, 3]).T
        r = self.rotation
        return np.stack([r[0, 0] * x + r[1, 0] * y, r[0, 1] * x + r[1, 1] * y], -1)

    def to_local(self, geometries: np.ndarray) -> np.ndarray:
        """Move geometries from the map to the patch's frame in the plane. (n,)."""
        return shapely.transform(geometries, self.points_to_local)

    def to_frame(self, geometries: np.ndarray) -> np.ndarray:
        """Move geometries with height to the annotation frame, roll and pitch included. (n,)."""
        rotation, translation = self.global_from_frame[:3, :3].T, self.global_from_frame[:3, 3]

        def move(points: np.ndarray) -> np.ndarray:
            x, y, z = (points - translation).T
            z = np.where(np.isnan(z), 0.0, z)  # a map without heights lies at the vehicle's own
            return np.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation], -1)

        return shapely.transform(geometries, move, include_z=True)

    def lines_inside(self, lines: np.ndarray) -> np.ndarray:
        """Return the parts of the map's lines inside the patch, in the map's frame. (pieces,)."""
        pieces = shapely.get_parts(shapely.intersection(lines, self.polygon))
        return pieces[is_line(pieces)]


class GeometryLayer:
    """Lines or polygons of a map, with a spatial index; invalid ones are in no answer. (n,)"""

    def __init__(self, geometries: Sequence[shapely.Geometry] | np.ndarray) -> None:
        self.geometries = np.array(list(geometries), dtype=object)
        self._valid = np.flatnonzero(shapely.is_valid(self.geometries))
        self._tree = shapely.STRtree(self.geometries[self._valid])

    @property
    def invalid_count(self) -> int:
        """How many geometries are invalid (self-crossing, for example)."""
        return len(self.geometries) - len(self._valid)

    def touching(self, patch: LocalPatch) -> np.ndarray:
        """Return the positions, ascending, of the valid geometries that meet the patch."""
        return np.sort(self._valid[self._tree.query(patch.polygon, predicate="intersects")])

    def near(self, patch: LocalPatch) -> np.ndarray:
        """Return the valid geometries that meet the patch, in their order."""
        return self.geometries[self.touching(patch)]


def is_line(geometries: np.ndarray) -> np.ndarray:
    """Say which geometries are lines with some length. (n,) bool."""
    return (shapely.get_type_id(geometries) == LINE) & (shapely.length(geometries) > 0)


def vertices_of(lines: Sequence[shapely.Geometry] | np.ndarray, dim: int) -> list[np.ndarray]:
    """Return the vertices of each line. each (n, dim)."""
    points, owner = shapely.get_coordinates(lines, include_z=dim == 3, return_index=True)
    return np.split(points, np.flatnonzero(np.diff(owner)) + 1) if len(points) else []


def rings_of(polygons: np.ndarray) -> np.ndarray:
    """Return all rings, polygon by polygon: the exterior clockwise, then holes anticlockwise.

    (n,) -> (rings,)
    """
    rings, owner = shapely.get_rings(polygons, return_index=True)
    is_hole = np.zeros(len(rings), dtype=bool)
    is_hole[1:] = owner[1:] == owner[:-1]  # a polygon's first ring is its exterior
    turn = shapely.is_ccw(rings) != is_hole
    rings[turn] = shapely.reverse(rings[turn])
    return rings


class OutlineIndex:
    """Simple rings of a map (n,), indexed in short chunks: a patch touches only what is near."""

    def __init__(self, rings: np.ndarray) -> None:
        self._chunks, owners = [], []
        for number, ring in enumerate(rings):
            points = shapely.get_coordinates(ring)
            for start in range(0, len(points) - 1, _CHUNK_SEGMENTS):
                self._chunks.append(points[start : start + _CHUNK_SEGMENTS + 1])
                owners.append(number)
        self._owners = np.array(owners, np.int64)
        self._tree = shapely.STRtree([shapely.LineString(points) for points in self._chunks])

    def cut(self, patch: LocalPatch, margin_m: float) -> list[np.ndarray]:
        """Return the parts of the rings inside a patch, shrunk by ``margin_m`` on each side.

        They are in the patch's frame; a ring wholly inside stays closed. each (n, 2)
        """
        near = np.sort(self._tree.query(patch.polygon, predicate="intersects"))
        x_range, y_range = (
            (low + margin_m, high - margin_m) for low, high in (patch.x_range, patch.y_range)
        )
        pieces = []
        for number in np.unique(self._owners[near]):
            for chunks in self._runs(near[self._owners[near] == number]):
                first, *others = (self._chunks[i] for i in chunks)
                points = np.concatenate([first, *(chunk[1:] for chunk in others)])
                pieces += clip_to_box(patch.points_to_local(points), x_range, y_range)
        return pieces

    def _runs(self, chunks: np.ndarray) -> list[np.ndarray]:
        """Return which of one ring's chunks, ascending, follow one another."""
        runs = np.split(chunks, np.flatnonzero(np.diff(chunks) > 1) + 1)
        first, last = np.flatnonzero(self._owners == self._owners[chunks[0]])[[0, -1]]
        if len(runs) > 1 and chunks[0] == first and chunks[-1] == last:  # across the ring's start
            runs[0] = np.concatenate([runs.pop(), runs[0]])
        return runs
