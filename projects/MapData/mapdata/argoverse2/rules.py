"""Vectorised geometry rules (on shapely arrays) from which Argoverse 2 ground truth is made."""

import numpy as np
import shapely

from mapdata.local_map import POLYGON, LocalPatch

DUPLICATE_IOU = 0.9
DUPLICATE_BUFFER_M = 1.0


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
