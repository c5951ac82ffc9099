"""Pedestrian crossings as map elements: their long edges, or their outlines as open lines.

A local map is cut to a rectangle around the vehicle, the patch. An outline that the edge of the
patch cuts is open: it ends at the edge.
"""

import numpy as np
import shapely

from gsmap.datasets.annotations.record import UNITED
from mapdata.local_map import COLLECTION, LocalPatch, is_line

EDGES = "edges"
PARALLEL = "parallel"
# Names of all rules by which crossings become map elements: rings of overlapping crossings united
# (`mapdata.nuscenes.map`), `long_edges`, and `open_outlines`.
CROSSINGS = (UNITED, EDGES, PARALLEL)
EDGE_MARGIN_M = 0.2  # distance from the edge of the patch at which open outlines end
# One minus the cosine of the largest angle between sides that count as parallel, about 8 degrees.
PARALLEL_COSINE_GAP = 0.01


def long_edges(polygons: np.ndarray) -> np.ndarray:
    """Find the two longest edges of each polygon, the longest one last. (n,) -> (2 n,)"""
    edges = []
    for polygon in polygons:
        ring = shapely.get_coordinates(polygon.exterior)
        lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
        for start in np.argsort(lengths, kind="stable")[-2:]:  # edge i begins at vertex i
            edges.append(ring[start : start + 2])
    return shapely.linestrings(np.array(edges)) if edges else np.empty(0, dtype=object)


def open_outlines(pieces: np.ndarray, owner: np.ndarray, patch: LocalPatch) -> np.ndarray:
    """Outlines of crossings, with parallel neighbours united, open where the patch cuts them.

    Outlines run anticlockwise, and holes are left out. An outline that is cut into several lines is
    returned as one line that connects them.

    Args:
        pieces: Valid parts of crossings inside the patch, in its frame, in metres. (pieces,)
        owner: Index of the crossing that each part belongs to, ascending. (pieces,)
        patch: The patch. Lines end ``EDGE_MARGIN_M`` inside it.

    Returns:
        Lines in the patch's frame, with heights if the parts have heights. (lines,)
    """
    exteriors = shapely.get_exterior_ring(merge_parallel(pieces, owner))
    is_clockwise = ~shapely.is_ccw(exteriors)
    exteriors[is_clockwise] = shapely.reverse(exteriors[is_clockwise])
    lines, ring_of_line = cut_rings(exteriors, patch.box(-EDGE_MARGIN_M))
    if len(lines) == 0:
        return lines
    has_z = bool(shapely.has_z(lines).any())
    points, line_of_point = shapely.get_coordinates(lines, include_z=has_z, return_index=True)
    # The lines of one ring become one line: `indices` are consecutive numbers of the rings.
    _, outline_of_line = np.unique(ring_of_line, return_inverse=True)
    return shapely.linestrings(points, indices=outline_of_line[line_of_point])


def cut_rings(rings: np.ndarray, box: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Cut rings with a box, and join pieces of a ring that touch.

    A ring whose first vertex lies inside the box is cut there too, so two of its pieces touch.

    Args:
        rings: Rings, in metres. (rings,)
        box: The box, in the frame of the rings.

    Returns:
        Lines inside the box (pieces,), and the index of the ring of each line (pieces,).
    """
    parts = shapely.intersection(rings, box)
    for i in np.flatnonzero(shapely.get_type_id(parts) == COLLECTION):
        members = shapely.get_parts(parts[i])  # lines, and points where the ring touches the box
        parts[i] = shapely.multilinestrings(members[is_line(members)])
    pieces, ring_of_piece = shapely.get_parts(shapely.line_merge(parts), return_index=True)
    has_length = is_line(pieces)
    return pieces[has_length], ring_of_piece[has_length]


def merge_parallel(pieces: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Unite crossings whose bounding boxes touch and whose long sides are parallel.

    Each crossing that is not yet united with another is united with all later ones that fit it.
    Crossings that are mapped for each carriageway of a road become one.

    Args:
        pieces: Valid parts of crossings, in metres. (pieces,)
        owner: Index of the crossing that each part belongs to, ascending. (pieces,)

    Returns:
        The united crossings, one entry for each part of a crossing. (polygons,)
    """
    _, crossing_of_piece = np.unique(owner, return_inverse=True)  # consecutive numbers from 0
    crossings = shapely.multipolygons(pieces, indices=crossing_of_piece)
    bounds = shapely.bounds(crossings)  # smallest x, y and largest x, y (n, 4)
    # Two boxes touch if each of them begins before the other ends, along both axes.
    begins_before_end = (bounds[:, None, :2] <= bounds[None, :, 2:]).all(-1)  # (n, n)
    near = begins_before_end & begins_before_end.T  # the boxes of two crossings touch
    np.fill_diagonal(near, False)
    is_free = np.ones(len(crossings), dtype=bool)  # False once a crossing is in `merged`
    sides = np.zeros((len(crossings), 2))  # unit vectors; only crossings with a neighbour need them
    for i in np.flatnonzero(near.any(1)):
        sides[i] = _long_side(crossings[i])
    merged = []
    for i, crossing in enumerate(crossings):
        if not is_free[i]:
            continue
        is_free[i] = False
        others = np.flatnonzero(near[i] & is_free)
        cosines = np.abs(sides[others] @ sides[i])  # without sign, as sides have no direction
        others = others[1.0 - cosines < PARALLEL_COSINE_GAP]
        is_free[others] = False
        if len(others):
            crossing = shapely.union_all(crossings[[i, *others]])
        merged.append(crossing)
    return shapely.get_parts(np.array(merged, dtype=object))


def _long_side(geometry: shapely.Geometry) -> np.ndarray:
    """Unit vector along the long side of the smallest rectangle around a geometry. (2,)"""
    hull = shapely.get_coordinates(shapely.convex_hull(geometry))
    edges = np.diff(hull, axis=0)
    edge_lengths = np.hypot(edges[:, 0], edges[:, 1])
    along = edges / edge_lengths[:, None]  # the smallest rectangle has a side on one of the edges
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    # The rectangle on an edge has the extents of the hull along and across this edge as its sides.
    length = np.ptp(hull @ along.T, axis=0)
    width = np.ptp(hull @ across.T, axis=0)
    best = (length * width).argmin()
    return along[best] if length[best] >= width[best] else across[best]
