"""Vectorised geometry rules (on shapely arrays) from which Argoverse 2 ground truth is made."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from gsmap.converters.local_map import LocalPatch

EDGE_MARGIN_M = 0.2
DUPLICATE_IOU = 0.9
DUPLICATE_BUFFER_M = 1.0
PARALLEL_COSINE_GAP = 0.01  # about 8 degrees

_LINE, _POLYGON, _COLLECTION = 1, 3, 7  # shapely type ids


@dataclass(frozen=True, eq=False)
class EgoPatch:
    """The rectangle of the map that a sample sees, turned with the vehicle.

    Args:
        city_from_ego: Pose of the vehicle. (4, 4)
        x_range: Smallest and largest x (forward) in the vehicle's frame, in metres.
        y_range: Smallest and largest y (left) in the vehicle's frame, in metres.
    """

    city_from_ego: np.ndarray
    x_range: tuple[float, float] = (-30.0, 30.0)
    y_range: tuple[float, float] = (-15.0, 15.0)

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The rectangle in the city's plane: the vehicle's yaw turns it, roll and pitch do not.

        Raises:
            ValueError: If the pose is not a finite 4 x 4 matrix.
        """
        return LocalPatch.from_pose(self.city_from_ego, self.x_range, self.y_range).polygon

    def box(self, margin_m: float) -> shapely.Polygon:
        """Return the rectangle in the vehicle's frame, enlarged by ``margin_m`` on every side."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        return shapely.box(x0 - margin_m, y0 - margin_m, x1 + margin_m, y1 + margin_m)

    def to_ego(self, geometries: np.ndarray) -> np.ndarray:
        """Move geometries from the city to the vehicle's frame, roll and pitch included."""
        rotation, translation = self.city_from_ego[:3, :3].T, self.city_from_ego[:3, 3]

        def move(points: np.ndarray) -> np.ndarray:
            # Products are written out: a matrix product may round one point differently from row to
            # row, and equal points must stay equal for lines to join.
            x, y, z = (points - translation).T
            z = np.where(np.isnan(z), 0.0, z)  # a map without heights lies at the vehicle's own
            return np.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation], -1)

        return shapely.transform(geometries, move, include_z=True)


def clip_lines(lines: np.ndarray, patch: EgoPatch) -> np.ndarray:
    """Cut lines of the city with the patch and move the pieces to the vehicle's frame. (pieces,)"""
    pieces = shapely.get_parts(shapely.intersection(lines, patch.polygon))
    return patch.to_ego(pieces[_is_line(pieces)])


def clip_polygons(polygons: np.ndarray, patch: EgoPatch) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons of the city with the patch and move the pieces to the vehicle's frame.

    Args:
        polygons: Valid polygons in the city frame.
        patch: What the sample sees.

    Returns:
        Valid pieces (pieces,), and which polygon each came from (pieces,).
    """
    pieces, owner = shapely.get_parts(
        shapely.intersection(polygons, patch.polygon), return_index=True
    )
    keep = (shapely.get_type_id(pieces) == _POLYGON) & shapely.is_valid(pieces)
    pieces, owner = patch.to_ego(pieces[keep]), owner[keep]
    keep = shapely.is_valid(pieces)
    return pieces[keep], owner[keep]


def cut_rings(rings: np.ndarray, box: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return what of each ring lies in the box, its pieces joined where they touch.

    Args:
        rings: Rings in the vehicle's frame.
        box: Where they are cut.

    Returns:
        Lines (pieces,), and which ring each came from (pieces,).
    """
    cut = shapely.intersection(rings, box)
    for i in np.flatnonzero(shapely.get_type_id(cut) == _COLLECTION):  # lines and points that touch
        parts = shapely.get_parts(cut[i])
        cut[i] = shapely.multilinestrings(parts[_is_line(parts)])
    pieces, owner = shapely.get_parts(shapely.line_merge(cut), return_index=True)
    keep = _is_line(pieces)
    return pieces[keep], owner[keep]


def drop_duplicates(lines: np.ndarray) -> np.ndarray:
    """Leave out each line that an earlier kept one covers: IoU >= 0.9 of their 2 m wide strips.

    Args:
        lines: Lines in the vehicle's frame.

    Returns:
        The lines that stay, in their order.
    """
    strips = shapely.buffer(lines, DUPLICATE_BUFFER_M, cap_style="flat", join_style="mitre")
    area = shapely.area(strips)
    first, second = _possible_duplicates(shapely.bounds(strips), area)
    overlap = shapely.area(shapely.intersection(strips[first], strips[second]))
    union = area[first] + area[second] - overlap
    same = overlap >= DUPLICATE_IOU * union
    keep = np.ones(len(lines), dtype=bool)
    for i, j in zip(first[same].tolist(), second[same].tolist(), strict=True):
        keep[j] &= not keep[i]
    return lines[keep]


def _possible_duplicates(bounds: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs i < j, in order, whose boxes and areas do not rule out an IoU of 0.9.

    Args:
        bounds: xmin, ymin, xmax, ymax of each strip. (n, 4)
        area: Area of each strip. (n,)

    Returns:
        The first and the second of each pair. Two arrays (pairs,)
    """
    low = np.maximum(bounds[:, None, :2], bounds[None, :, :2])
    high = np.minimum(bounds[:, None, 2:], bounds[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=-1)  # (n, n)
    common = np.minimum(common, np.minimum(area[:, None], area[None]))
    union = area[:, None] + area[None] - common
    first, second = np.nonzero(np.triu((common >= DUPLICATE_IOU * union) & (union > 0), k=1))
    return first, second


def merge_parallel(pieces: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Unite crossings whose bounding boxes touch and whose long sides are parallel.

    Each crossing that is still alone takes in all later lone ones that fit it: carriageway by
    carriageway mapped crossings of one road become one.

    Args:
        pieces: Polygons in the vehicle's frame.
        owner: Ascending; pieces with the same owner are one crossing.

    Returns:
        Polygons, each one instance.
    """
    crossings = shapely.multipolygons(pieces, indices=np.unique(owner, return_inverse=True)[1])
    bounds = shapely.bounds(crossings)
    near = (bounds[:, None, :2] <= bounds[None, :, 2:]).all(-1)
    near &= near.T
    free = np.ones(len(crossings), dtype=bool)
    np.fill_diagonal(near, False)
    sides = np.zeros((len(crossings), 2))
    for i in np.flatnonzero(near.any(1)):
        sides[i] = _long_side(crossings[i])
    merged = []
    for i, crossing in enumerate(crossings):
        if not free[i]:
            continue
        free[i] = False
        others = np.flatnonzero(near[i] & free)
        if len(others):
            cosines = sides[others] @ sides[i]
            others = others[1.0 - np.abs(cosines) < PARALLEL_COSINE_GAP]
            free[others] = False
        merged.append(shapely.union_all(crossings[[i, *others]]) if len(others) else crossing)
    return shapely.get_parts(np.array(merged, dtype=object))


def _long_side(geometry: shapely.Geometry) -> np.ndarray:
    """Return the unit direction of the long side of the smallest-area rectangle. (2,)"""
    hull = shapely.get_coordinates(shapely.convex_hull(geometry))
    edges = np.diff(hull, axis=0)
    along = (
        edges / np.hypot(*edges.T)[:, None]
    )  # one side of the rectangle lies on an edge of the hull
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    length, width = np.ptp(hull @ along.T, axis=0), np.ptp(hull @ across.T, axis=0)
    best = (length * width).argmin()
    return along[best] if length[best] >= width[best] else across[best]


def merge_until_stable(lines: np.ndarray) -> np.ndarray:
    """Node lines where they meet and join them at their ends, until their number no longer changes.

    Args:
        lines: Lines, possibly several times the same.

    Returns:
        Lines without duplicates.
    """
    merged = shapely.union_all(lines)
    count = shapely.get_num_geometries(merged)
    while count > 1:
        before, merged = count, shapely.line_merge(merged)
        count = shapely.get_num_geometries(merged)
        if count in (1, before):
            break
        merged = shapely.union_all(merged)
        if shapely.get_num_geometries(merged) == 1:
            break
    return shapely.get_parts(merged)


def points_of(lines: Sequence[shapely.Geometry] | np.ndarray) -> list[np.ndarray]:
    """Return the vertices of each line. list of (n, 3)"""
    points, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    return np.split(points, np.flatnonzero(np.diff(owner)) + 1) if len(points) else []


def _is_line(geometries: np.ndarray) -> np.ndarray:
    """Say which geometries are lines with some length. (n,) bool"""
    return (shapely.get_type_id(geometries) == _LINE) & (shapely.length(geometries) > 0)
