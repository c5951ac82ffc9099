"""Geometry rules of the Argoverse 2 ground truth, vectorised over arrays of shapely geometries."""

import numpy as np
import shapely

from mapdata.local_map import POLYGON, LocalPatch, lift_corners

DUPLICATE_IOU = 0.9  # smallest IoU of the strips around two lines that are duplicates
DUPLICATE_BUFFER_M = 1.0  # half the width of these strips


def clip_lines(lines: np.ndarray, patch: LocalPatch) -> np.ndarray:
    """Clip lines to the patch.

    Args:
        lines: Lines in metres, city frame. (n,)
        patch: Patch to clip to.

    Returns:
        Pieces of the lines inside the patch, in metres, ego frame. (pieces,)
    """
    # `lines_inside` clips in the city frame, and `to_frame` transforms to the ego frame.
    return patch.to_frame(patch.lines_inside(lines))


def clip_polygons(polygons: np.ndarray, patch: LocalPatch) -> tuple[np.ndarray, np.ndarray]:
    """Clip polygons to the patch.

    Args:
        polygons: Valid polygons in metres, city frame. (n,)
        patch: Patch to clip to.

    Returns:
        Valid pieces of the polygons inside the patch, in metres, ego frame (pieces,), and the index
        of the polygon of each piece (pieces,).
    """
    clipped = shapely.intersection(polygons, patch.polygon)
    # `owner` is the index of the polygon of each piece. Pieces may also be points or lines, where a
    # polygon only touches the patch.
    pieces, owner = shapely.get_parts(clipped, return_index=True)
    is_polygon = (shapely.get_type_id(pieces) == POLYGON) & shapely.is_valid(pieces)
    pieces = pieces[is_polygon]
    owner = owner[is_polygon]
    lifted = lift_corners(pieces, polygons=polygons[owner], rectangle=patch.polygon)
    pieces = patch.to_frame(pieces)
    # x and y are those of the published ground truth, which depend a little on the heights before.
    points = shapely.get_coordinates(pieces, include_z=True)
    points[:, 2] = shapely.get_coordinates(patch.to_frame(lifted), include_z=True)[:, 2]
    pieces = shapely.set_coordinates(pieces, points)
    is_valid = shapely.is_valid(pieces)  # the transform may round a thin piece to an invalid one
    return pieces[is_valid], owner[is_valid]


def drop_duplicates(lines: np.ndarray) -> np.ndarray:
    """Remove lines that nearly coincide with an earlier line that is kept.

    Two lines are duplicates if the IoU of their 2 m wide strips is at least 0.9.

    Args:
        lines: Lines in metres. (n,)

    Returns:
        The lines that are kept, in their order. (m,)
    """
    strips = shapely.buffer(lines, DUPLICATE_BUFFER_M, cap_style="flat", join_style="mitre")
    area = shapely.area(strips)
    first, second = _possible_duplicates(shapely.bounds(strips), area)
    keep = np.ones(len(lines), dtype=bool)
    # The pairs whose first strip is i have the indices starts[i] to starts[i + 1] - 1.
    starts = np.searchsorted(first, np.arange(len(lines) + 1))
    for i in np.flatnonzero(np.diff(starts)).tolist():  # strips with at least one pair
        if not keep[i]:
            continue
        others = second[starts[i] : starts[i + 1]]
        others = others[keep[others]]
        overlap = shapely.area(shapely.intersection(strips[i], strips[others]))
        union = area[i] + area[others] - overlap
        duplicates = others[overlap >= DUPLICATE_IOU * union]  # without a division by the union
        keep[duplicates] = False
    return lines[keep]


def _possible_duplicates(bounds: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find pairs of strips whose bounding boxes and areas allow an IoU of 0.9.

    Args:
        bounds: Smallest x and y and largest x and y of each strip, in metres. (n, 4)
        area: Area of each strip in square metres. (n,)

    Returns:
        Two arrays: indices of the first and of the second strip of each pair. The first index is
        the smaller one, and the pairs are sorted by it. (pairs,) each
    """
    low = np.maximum(bounds[:, None, :2], bounds[None, :, :2])
    high = np.minimum(bounds[:, None, 2:], bounds[None, :, 2:])
    # Two strips cannot share more than their bounding boxes share, nor more than the smaller strip.
    # `common` is therefore an upper bound of their intersection, and `union` a lower bound.
    common = np.prod(np.maximum(high - low, 0.0), axis=-1)  # (n, n)
    common = np.minimum(common, np.minimum(area[:, None], area[None]))
    union = area[:, None] + area[None] - common
    is_possible = (common >= DUPLICATE_IOU * union) & (union > 0)
    first, second = np.nonzero(np.triu(is_possible, k=1))  # each pair once, with first < second
    return first, second


def merge_until_stable(lines: np.ndarray) -> np.ndarray:
    """Cut lines where they meet and join them at their ends, until the number of lines is stable.

    Args:
        lines: Lines in metres. (n,)

    Returns:
        The joined lines. (m,)
    """
    # `union_all` cuts lines where they cross or touch. `line_merge` joins lines at places where
    # exactly two ends meet. A joined line may be cut again, so both are repeated.
    merged = shapely.union_all(lines)
    count = shapely.get_num_geometries(merged)
    while count > 1:
        previous_count = count
        merged = shapely.line_merge(merged)
        count = shapely.get_num_geometries(merged)
        if count in (1, previous_count):  # a single line, or nothing was joined
            break
        merged = shapely.union_all(merged)
        if shapely.get_num_geometries(merged) == 1:
            break
    return shapely.get_parts(merged)
