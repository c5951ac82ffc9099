"""Polylines whose ends meet become one; one that meets itself becomes a ring."""

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial import cKDTree

from gsmap.structures.elements import FloatArray
from gsmap.structures.polylines import arc_lengths

JOIN_M = 2.0  # widest gap that is closed
_HEADING_M = 2.0  # an end's direction is that of its last metres
_DISTANCE_STEP_M = 0.25  # of gaps about as wide, the straightest is closed first
_RING_M = 10.0  # a shorter line is not closed


def stitch(lines: Sequence[FloatArray]) -> list[FloatArray]:
    """Join lines at their ends, the narrowest and straightest gaps first.

    Two ends are joined if they are near, the line turns by less than a right angle there, and
    neither is joined to another.

    Args:
        lines: Open lines or rings; columns after (x, y) are carried along. each (n, D)

    Returns:
        The joined lines; a ring's last vertex equals its first. each (m, D)
    """
    closed = [bool(np.array_equal(line[0, :2], line[-1, :2])) for line in lines]
    partner: dict[int, int] = {}
    for a, b in _candidates(lines):
        own_ends = a // 2 == b // 2
        short = own_ends and arc_lengths(lines[a // 2])[-1] < _RING_M
        if not (a in partner or b in partner or closed[a // 2] or closed[b // 2] or short):
            partner[a], partner[b] = b, a
    joined, used = [], [False] * len(lines)
    for first in range(len(lines)):
        if not used[first]:
            joined.append(_chain(lines, partner, first, used))
    return joined


def _candidates(lines: Sequence[FloatArray]) -> list[tuple[int, int]]:
    """Return pairs of ends that may be joined, the best first; start and end of lines by turns."""
    ends, headings = [], []  # the latter point outwards
    for line in lines:
        for part in (line[:, :2], line[::-1, :2]):
            within = shapely.line_interpolate_point(shapely.LineString(part), _HEADING_M)
            inner = shapely.get_coordinates(within)[0]
            ends.append(part[0])
            headings.append((part[0] - inner) / max(np.linalg.norm(part[0] - inner), 1e-9))
    if not ends:
        return []
    points, outward = np.array(ends), np.array(headings)
    pairs = cKDTree(points).query_pairs(JOIN_M, output_type="ndarray")
    first, second = pairs.T
    cosine = (outward[first] * outward[second]).sum(axis=1)
    gap = np.linalg.norm(points[first] - points[second], axis=1)
    steps = np.round(gap / _DISTANCE_STEP_M)
    order = np.lexsort((second, first, cosine.round(6), steps))
    return [(int(a), int(b)) for a, b in pairs[order[cosine[order] < 0.0]]]


def _chain(
    lines: Sequence[FloatArray], partner: dict[int, int], first: int, used: list[bool]
) -> FloatArray:
    """Walk from line to line over joined ends, from an open end or around a ring. (m, D)"""
    entry = 2 * first
    seen = {first}
    while entry in partner and partner[entry] // 2 not in seen:  # back to where the chain starts
        entry = partner[entry] ^ 1
        seen.add(entry // 2)
    start, parts = entry, []
    while True:
        used[entry // 2] = True
        line = lines[entry // 2]
        parts.append(line if entry % 2 == 0 else line[::-1])
        following = partner.get(entry ^ 1)
        if following is None:
            break
        if following == start:
            parts.append(parts[0][:1])
            break
        entry = following
    points = np.concatenate(parts)
    moved = np.append(True, (points[1:, :2] != points[:-1, :2]).any(axis=1))
    return points[moved]
