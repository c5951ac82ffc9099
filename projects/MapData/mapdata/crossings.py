"""Rules of crossings that both data sets share: rings, open outlines and long edges."""

import numpy as np
import shapely

from gsmap.datasets.annotations.record import UNITED
from mapdata.local_map import COLLECTION, LocalPatch, is_line

EDGES, PARALLEL = "edges", "parallel"
CROSSINGS = (UNITED, EDGES, PARALLEL)
EDGE_MARGIN_M = 0.2
PARALLEL_COSINE_GAP = 0.01  # about 8 degrees


def long_edges(polygons: np.ndarray) -> np.ndarray:
    """Return the two longest edges of each polygon, the longer one second. (2 n,)"""
    edges = []
    for polygon in polygons:
        ring = shapely.get_coordinates(polygon.exterior)
        lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
        edges += [ring[i : i + 2] for i in np.argsort(lengths, kind="stable")[-2:]]
    return shapely.linestrings(np.array(edges)) if edges else np.empty(0, object)


def open_outlines(pieces: np.ndarray, owner: np.ndarray, patch: LocalPatch) -> np.ndarray:
    """Return outlines of crossings, parallel neighbours united, open where the patch cuts them.

    They run anticlockwise; holes are left out. The parts of one crossing stay one line.

    Args:
        pieces: Valid parts of crossings inside the patch, in its frame. (pieces,)
        owner: The crossing that each part is of, ascending. (pieces,)
        patch: The patch; lines end ``EDGE_MARGIN_M`` inside it.

    Returns:
        Lines in the patch's frame, with heights if the parts have them. (lines,)
    """
    exteriors = shapely.get_exterior_ring(merge_parallel(pieces, owner))
    turn = ~shapely.is_ccw(exteriors)
    exteriors[turn] = shapely.reverse(exteriors[turn])
    lines, ring = cut_rings(exteriors, patch.box(-EDGE_MARGIN_M))
    if len(lines) == 0:
        return lines
    has_z = bool(shapely.has_z(lines).any())
    points, line = shapely.get_coordinates(lines, include_z=has_z, return_index=True)
    return shapely.linestrings(points, indices=np.unique(ring, return_inverse=True)[1][line])


def cut_rings(rings: np.ndarray, box: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return what of each ring lies in the box, its pieces joined where they touch.

    They are lines (pieces,), with the ring that each came from (pieces,).
    """
    cut = shapely.intersection(rings, box)
    for i in np.flatnonzero(shapely.get_type_id(cut) == COLLECTION):  # lines and points that touch
        parts = shapely.get_parts(cut[i])
        cut[i] = shapely.multilinestrings(parts[is_line(parts)])
    pieces, owner = shapely.get_parts(shapely.line_merge(cut), return_index=True)
    keep = is_line(pieces)
    return pieces[keep], owner[keep]


def merge_parallel(pieces: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Unite crossings whose bounding boxes touch and whose long sides are parallel.

    Each crossing that is still alone takes in all later lone ones that fit it: carriageway by
    carriageway mapped crossings of one road become one. ``owner`` ascends; polygons with the same
    owner are one crossing. (pieces,), (pieces,) -> (polygons,)
    """
    crossings = shapely.multipolygons(pieces, indices=np.unique(owner, return_inverse=True)[1])
    bounds = shapely.bounds(crossings)
    near = (bounds[:, None, :2] <= bounds[None, :, 2:]).all(-1)
    near &= near.T
    np.fill_diagonal(near, False)
    free = np.ones(len(crossings), dtype=bool)
    sides = np.zeros((len(crossings), 2))
    for i in np.flatnonzero(near.any(1)):
        sides[i] = _long_side(crossings[i])
    merged = []
    for i, crossing in enumerate(crossings):
        if not free[i]:
            continue
        free[i] = False
        others = np.flatnonzero(near[i] & free)
        others = others[1.0 - np.abs(sides[others] @ sides[i]) < PARALLEL_COSINE_GAP]
        free[others] = False
        merged.append(shapely.union_all(crossings[[i, *others]]) if len(others) else crossing)
    return shapely.get_parts(np.array(merged, dtype=object))


def _long_side(geometry: shapely.Geometry) -> np.ndarray:
    """Return the unit direction of the long side of the smallest-area rectangle. (2,)"""
    hull = shapely.get_coordinates(shapely.convex_hull(geometry))
    edges = np.diff(hull, axis=0)
    along = edges / np.hypot(*edges.T)[:, None]  # a side of the rectangle lies on the hull
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    length, width = np.ptp(hull @ along.T, axis=0), np.ptp(hull @ across.T, axis=0)
    best = (length * width).argmin()
    return along[best] if length[best] >= width[best] else across[best]
