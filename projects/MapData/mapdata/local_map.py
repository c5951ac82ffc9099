"""Patch of a map around a sample, and geometry that is cut with it.

Three coordinate frames are used, all in metres. The *map's frame* is global. The *annotation frame*
is the frame of a sample in 3D. The *patch's frame* is in the plane: it has the position and the yaw
of the annotation frame in the map, but no height, roll or pitch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from gsmap.structures.polylines import Points, arc_lengths, clip_to_box
from gsmap.utils.errors import InputError

# Kinds of geometries, as numbered by ``shapely.get_type_id``.
LINE = 1
POLYGON = 3
COLLECTION = 7
_CHUNK_SEGMENTS = 32  # number of segments in a chunk of `OutlineIndex`


@dataclass(frozen=True, eq=False)
class LocalPatch:
    """A rectangle in the map's plane, rotated by the yaw of a pose; roll and pitch are ignored.

    Args:
        global_from_frame: Pose of the annotation frame in the map, in metres, finite. (4, 4)
        x_range: Smallest and largest x of the rectangle in the patch's frame, in metres.
        y_range: Smallest and largest y of the rectangle in the patch's frame, in metres.

    Raises:
        ValueError: If the pose has another shape, or is not finite.
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
        """Unit vectors of the x and y axis of the patch's frame in the map, as columns. (2, 2)"""
        x_axis = self.global_from_frame[:2, 0]  # shorter than 1 if the frame is tilted
        cos, sin = x_axis / np.hypot(x_axis[0], x_axis[1])
        return np.array([[cos, -sin], [sin, cos]])

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The rectangle in the map's frame."""
        x0, x1 = self.x_range
        y0, y1 = self.y_range
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        polygon = shapely.Polygon(corners @ self.rotation.T + self.global_from_frame[:2, 3])
        shapely.prepare(polygon)  # makes repeated tests with the polygon faster
        return polygon

    def box(self, margin_m: float) -> shapely.Polygon:
        """The rectangle in the patch's frame, enlarged by ``margin_m`` metres on every side.

        A negative margin shrinks it.
        """
        x0, x1 = self.x_range
        y0, y1 = self.y_range
        return shapely.box(
            xmin=x0 - margin_m, ymin=y0 - margin_m, xmax=x1 + margin_m, ymax=y1 + margin_m
        )

    # Products with the inverse (transposed) rotation are written out below. A matrix product may
    # round equal points differently in different rows, and lines join only where points are equal.
    def points_to_local(self, points: Points) -> np.ndarray:
        """Transform points from the map to the patch's frame, in the plane. (n, 2+) -> (n, 2)"""
        x, y = (points[:, :2] - self.global_from_frame[:2, 3]).T
        r = self.rotation
        return np.stack([r[0, 0] * x + r[1, 0] * y, r[0, 1] * x + r[1, 1] * y], axis=-1)

    def to_local(self, geometries: np.ndarray) -> np.ndarray:
        """Transform geometries from the map to the patch's frame, in the plane. (n,)"""
        return shapely.transform(geometries, self.points_to_local)

    def to_frame(self, geometries: np.ndarray) -> np.ndarray:
        """Transform geometries of the map to the annotation frame, with roll and pitch. (n,)

        Points without a height get the height of the frame's origin.
        """
        rotation = self.global_from_frame[:3, :3].T
        translation = self.global_from_frame[:3, 3]

        def transform_points(points: np.ndarray) -> np.ndarray:
            x, y, z = (points - translation).T  # z is NaN for a point without a height
            z = np.where(np.isnan(z), 0.0, z)
            columns = [row[0] * x + row[1] * y + row[2] * z for row in rotation]
            return np.stack(columns, axis=-1)

        return shapely.transform(geometries, transform_points, include_z=True)

    def lines_inside(self, lines: np.ndarray) -> np.ndarray:
        """Parts of the map's lines inside the patch, in the map's frame. (n,) -> (pieces,)"""
        pieces = shapely.get_parts(shapely.intersection(lines, self.polygon))
        return pieces[is_line(pieces)]


class GeometryLayer:
    """Lines or polygons of a map with a spatial index, which leaves out invalid geometries.

    Args:
        geometries: Geometries in the map's frame, in metres. (n,)
    """

    def __init__(self, geometries: Sequence[shapely.Geometry] | np.ndarray) -> None:
        self.geometries = np.array(list(geometries), dtype=object)
        self._valid = np.flatnonzero(shapely.is_valid(self.geometries))  # indices
        self._tree = shapely.STRtree(self.geometries[self._valid])

    @property
    def invalid_count(self) -> int:
        """Number of invalid geometries, such as polygons that cross themselves."""
        return len(self.geometries) - len(self._valid)

    def touching(self, patch: LocalPatch) -> np.ndarray:
        """Indices of the valid geometries that intersect the patch, ascending. (m,)

        They are indices into ``geometries``.
        """
        positions = self._tree.query(patch.polygon, predicate="intersects")  # in `_valid`
        return np.sort(self._valid[positions])

    def near(self, patch: LocalPatch) -> np.ndarray:
        """Valid geometries that intersect the patch, in the order of ``geometries``. (m,)"""
        return self.geometries[self.touching(patch)]


def is_line(geometries: np.ndarray) -> np.ndarray:
    """Whether geometries are lines with a length > 0. (n,) -> (n,) bool"""
    return (shapely.get_type_id(geometries) == LINE) & (shapely.length(geometries) > 0)


def vertices_of(lines: Sequence[shapely.Geometry] | np.ndarray, dim: int) -> list[np.ndarray]:
    """Vertices of each line that has any, in ``dim`` (2 or 3) coordinates. each (n, dim)"""
    # `owner` is the index of the line of each point, in rising order.
    points, owner = shapely.get_coordinates(lines, include_z=dim == 3, return_index=True)
    if not len(points):
        return []
    starts = np.flatnonzero(np.diff(owner)) + 1
    return np.split(points, starts)


def lift_corners(
    pieces: np.ndarray, polygons: np.ndarray, rectangle: shapely.Polygon
) -> np.ndarray:
    """Set the heights of corners of a rectangle to which polygons with heights were clipped.

    Where an edge of a polygon is cut, shapely interpolates its height. At a corner of the rectangle
    inside of a polygon, it takes a mean of other heights. Here, the corner gets the height of the
    plane that fits the vertices of the polygon best. The distance in height from the clipped
    outline to this plane is interpolated along the outline and added.

    Args:
        pieces: Polygons inside the rectangle, in metres. (n,)
        polygons: Polygon of each piece before it was clipped. (n,)
        rectangle: The rectangle, of which the pieces have exact corners.

    Returns:
        Pieces with new heights at the corners. Polygons without heights do not change. (n,)
    """
    corners = shapely.get_coordinates(rectangle)[:-1]  # (4, 2)
    is_inside = shapely.contains_properly(polygons[:, None], shapely.points(corners))  # (n, 4)
    is_lifted = is_inside.any(axis=1) & shapely.has_z(polygons)
    lifted = pieces.copy()
    for index in np.flatnonzero(is_lifted).tolist():
        lifted[index] = _lift_piece(
            pieces[index], polygon=polygons[index], corners=corners[is_inside[index]]
        )
    return lifted


def _lift_piece(
    piece: shapely.Polygon, polygon: shapely.Polygon, corners: np.ndarray
) -> shapely.Polygon:
    """Set the heights of a clipped polygon at corners of the rectangle. (n, 2)"""
    outline = shapely.get_coordinates(piece.exterior, include_z=True)[:-1]  # (m, 3)
    vertices = shapely.get_coordinates(polygon, include_z=True)
    vertices = np.unique(vertices, axis=0)  # without the second end of each ring (k, 3)
    is_corner = (outline[:, None, :2] == corners).all(axis=-1).any(axis=-1)  # (m,)
    is_known = ~is_corner
    if not is_corner.any() or not np.isfinite(vertices).all():
        return piece
    # The origin is moved to the vertices, as coordinates of maps are large.
    origin = vertices.mean(axis=0)
    offsets = vertices - origin
    slopes = np.linalg.lstsq(offsets[:, :2], offsets[:, 2], rcond=None)[0]
    heights = origin[2] + (outline[:, :2] - origin[:2]) @ slopes  # of the plane (m,)
    if is_known.any():
        ring = np.concatenate([outline, outline[:1]])
        lengths = arc_lengths(ring)
        heights += np.interp(
            lengths[:-1],
            lengths[:-1][is_known],
            (outline[:, 2] - heights)[is_known],
            period=lengths[-1],
        )
    outline[is_corner, 2] = heights[is_corner]
    return shapely.Polygon(outline, holes=piece.interiors)


def rings_of(polygons: np.ndarray) -> np.ndarray:
    """All rings of polygons: clockwise exteriors, each followed by its anticlockwise holes.

    (n,) -> (rings,)
    """
    rings, owner = shapely.get_rings(polygons, return_index=True)  # owner: index of the polygon
    is_hole = np.zeros(len(rings), dtype=bool)
    is_hole[1:] = owner[1:] == owner[:-1]  # a polygon's first ring is its exterior
    # Holes must be anticlockwise, and exteriors clockwise. All other rings are reversed.
    is_reversed = shapely.is_ccw(rings) != is_hole
    rings[is_reversed] = shapely.reverse(rings[is_reversed])
    return rings


class OutlineIndex:
    """Rings of a map with a spatial index of short chunks, so that long rings are cut quickly.

    A chunk is a part of a ring with at most 32 segments. The last point of a chunk is the first
    point of the next one.

    Args:
        rings: Rings in the map's frame, in metres, that do not cross themselves. (n,)
    """

    def __init__(self, rings: np.ndarray) -> None:
        self._chunks = []
        owners = []
        for ring_index, ring in enumerate(rings):
            points = shapely.get_coordinates(ring)
            for start in range(0, len(points) - 1, _CHUNK_SEGMENTS):
                self._chunks.append(points[start : start + _CHUNK_SEGMENTS + 1])
                owners.append(ring_index)  # the owner of a chunk is its ring
        self._owners = np.array(owners, np.int64)
        self._tree = shapely.STRtree([shapely.LineString(points) for points in self._chunks])

    def clip(self, patch: LocalPatch, margin_m: float) -> list[np.ndarray]:
        """Clip the rings to a patch that is shrunk by ``margin_m`` on each side.

        The margin has the opposite sign of the margin of `LocalPatch.box`.

        Args:
            patch: The patch.
            margin_m: Distance of the sides of the patch from the clipping rectangle inside, in
                metres.

        Returns:
            Parts inside, in the patch's frame, in metres; a ring that is wholly inside stays
            closed. each (n, 2)
        """
        # Ascending indices of the chunks that intersect the patch. A ring has consecutive indices.
        near = np.sort(self._tree.query(patch.polygon, predicate="intersects"))
        x0, x1 = patch.x_range
        y0, y1 = patch.y_range
        x_range = (x0 + margin_m, x1 - margin_m)
        y_range = (y0 + margin_m, y1 - margin_m)
        pieces = []
        for ring_index in np.unique(self._owners[near]):
            chunks_of_ring = near[self._owners[near] == ring_index]
            for run in self._runs(chunks_of_ring):
                parts = [self._chunks[run[0]]]
                for chunk in run[1:]:
                    parts.append(self._chunks[chunk][1:])  # without the point that chunks share
                points = patch.points_to_local(np.concatenate(parts))
                pieces += clip_to_box(points, x_range=x_range, y_range=y_range)
        return pieces

    def _runs(self, chunks: np.ndarray) -> list[np.ndarray]:
        """Group ascending chunks of one ring into runs of consecutive chunks along the ring."""
        gaps = np.flatnonzero(np.diff(chunks) > 1) + 1
        runs = np.split(chunks, gaps)
        chunks_of_ring = np.flatnonzero(self._owners == self._owners[chunks[0]])
        touches_start = chunks[0] == chunks_of_ring[0]
        touches_end = chunks[-1] == chunks_of_ring[-1]
        if len(runs) > 1 and touches_start and touches_end:
            # The last chunk of a ring ends where its first chunk starts. The last run is therefore
            # continued by the first run.
            last_run = runs.pop()
            runs[0] = np.concatenate([last_run, runs[0]])
        return runs
