"""Vectorised geometry rules (on shapely arrays) from which Argoverse 2 ground truth is made."""

import numpy as np
import shapely

from mapdata.local_map import COLLECTION, POLYGON, LocalPatch, is_line

EDGE_MARGIN_M = 0.2
DUPLICATE_IOU = 0.9
DUPLICATE_BUFFER_M = 1.0
PARALLEL_COSINE_GAP = 0.01  # about 8 degrees


def clip_lines(lines: np.ndarray, patch: LocalPatch) -> np.ndarray:
    """Cut lines of the city with the patch and move the pieces to the vehicle's frame. (pieces,)"""
    return patch.to_frame(patch.lines_inside(lines))


def clip_polygons(polygons: np.ndarray, patch: LocalPatch) -> tuple[np.ndarray, np.ndarray]:
    """Cut valid polygons of the city with the patch and move the pieces to the vehicle's frame.

    Returns the valid pieces (pieces,), and which polygon each came from (pieces,).
    """
    pieces, owner = shapely.get_parts(
        shapely.intersection(polygons, patch.polygon), return_index=True
    )
    keep = (shapely.get_type_id(pieces) == POLYGON) & shapely.is_valid(pieces)
    pieces, owner = patch.to_frame(pieces[keep]), owner[keep]
    keep = shapely.is_valid(pieces)
    return pieces[keep], owner[keep]


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


def drop_duplicates(lines: np.ndarray) -> np.ndarray:
    """Leave out each line that an earlier kept one covers: IoU >= 0.9 of their 2 m wide strips."""
    strips = shapely.buffer(lines, DUPLICATE_BUFFER_M, cap_style="flat", join_style="mitre")
    area = shapely.area(strips)
    first, second = _possible_duplicates(shapely.bounds(strips), area)
    keep = np.ones(len(lines), dtype=bool)
    starts = np.searchsorted(first, np.arange(len(lines) + 1))  # of the pairs of each line
    for i in np.flatnonzero(np.diff(starts)).tolist():
        if not keep[i]:
            continue
        others = second[starts[i] : starts[i + 1]]
        others = others[keep[others]]  # what is dropped already needs no comparison
        overlap = shapely.area(shapely.intersection(strips[i], strips[others]))
        keep[others[overlap >= DUPLICATE_IOU * (area[i] + area[others] - overlap)]] = False
    return lines[keep]


def _possible_duplicates(bounds: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs i < j of strips whose boxes and areas allow an IoU of 0.9. each (pairs,)"""
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


def merge_until_stable(lines: np.ndarray) -> np.ndarray:
    """Node lines where they meet and join them at their ends, until their number stays the same."""
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
