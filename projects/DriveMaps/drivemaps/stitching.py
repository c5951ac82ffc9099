"""Stitching of polylines whose ends meet; a line that meets itself becomes a ring."""

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial import cKDTree

from gsmap.structures.elements import FloatArray
from gsmap.structures.polylines import arc_lengths

JOIN_M = 2.0  # largest gap that is closed
_HEADING_M = 2.0  # the last 2 m of a line define its direction at an end
_GAP_STEP_M = 0.25  # gaps are rounded to multiples; of equal gaps, the straightest is closed first
_RING_M = 10.0  # smallest length of a line that is closed to a ring


def stitch(lines: Sequence[FloatArray]) -> list[FloatArray]:
    """Join lines at their ends, the narrowest and straightest gaps first.

    Two ends are joined if they are at most 2 m apart, the joined line turns by less than a right
    angle there, and neither end is joined to another one.

    Args:
        lines: Open lines or rings in metres. Columns after (x, y) are kept unchanged. N x (n, D)

    Returns:
        Joined lines; the last vertex of a ring equals its first. Each (m, D)
    """
    # A ring also has two ends, at one place. They are not joined to other ends.
    is_closed = [bool(np.array_equal(line[0, :2], line[-1, :2])) for line in lines]
    # End that each joined end is joined to. Line i has the ends 2 * i (first) and 2 * i + 1 (last).
    partner_of: dict[int, int] = {}
    for first, second in _candidates(lines):
        first_line = first // 2
        second_line = second // 2
        if first in partner_of or second in partner_of:
            continue  # a better pair has joined one of the ends
        if is_closed[first_line] or is_closed[second_line]:
            continue
        # Two ends of one line would close it to a ring.
        if first_line == second_line and arc_lengths(lines[first_line])[-1] < _RING_M:
            continue
        partner_of[first] = second
        partner_of[second] = first
    chains = []
    visited: set[int] = set()  # indices of lines
    for index in range(len(lines)):
        if index not in visited:
            chains.append(_join_chain(lines, partner_of, index=index, visited=visited))
    return chains


def _candidates(lines: Sequence[FloatArray]) -> list[tuple[int, int]]:
    """Pairs of numbers of ends that may be joined, the best pair first.

    Line i has the ends 2 * i (first) and 2 * i + 1 (last).
    """
    ends = []
    headings = []
    for line in lines:
        for from_end in (line[:, :2], line[::-1, :2]):  # from the first end, from the last end
            end = from_end[0]
            inner = shapely.line_interpolate_point(shapely.LineString(from_end), _HEADING_M)
            heading = end - shapely.get_coordinates(inner)[0]
            ends.append(end)
            headings.append(heading / max(np.linalg.norm(heading), 1e-9))  # no division by 0
    if not ends:
        return []
    points = np.array(ends)  # (2 N, 2)
    outward = np.array(headings)  # unit vectors that point out of the lines. (2 N, 2)
    pairs = cKDTree(points).query_pairs(JOIN_M, output_type="ndarray")
    first, second = pairs.T
    cosine = (outward[first] * outward[second]).sum(axis=1)
    gap = np.linalg.norm(points[first] - points[second], axis=1)
    rounded_gap = np.round(gap / _GAP_STEP_M)
    # Sort by gap, then by cosine. The cosine is -1 where the outward directions of both ends are
    # opposite: the joined line goes straight on. The indices of the ends make the order unique.
    order = np.lexsort((second, first, cosine.round(6), rounded_gap))  # the last key sorts first
    is_allowed = cosine[order] < 0.0  # the joined line turns by less than a right angle
    return [(int(a), int(b)) for a, b in pairs[order[is_allowed]]]


def _join_chain(
    lines: Sequence[FloatArray], partner_of: dict[int, int], index: int, visited: set[int]
) -> FloatArray:
    """Concatenate the lines of a chain, from an open end or around a ring.

    Args:
        lines: All lines. N x (n, D)
        partner_of: End that each joined end is joined to. Line i has the ends 2 * i and 2 * i + 1.
        index: Index of a line of the chain.
        visited: Indices of the lines in previous chains. This function adds the lines of the chain.

    Returns:
        Vertices without successive equal ones. (m, D)
    """
    # Number of the end at which a line is entered. The ends of a line, 2 * i and 2 * i + 1, differ
    # in the last bit. The number of the other end is therefore `entry ^ 1`.
    entry = 2 * index
    passed = {index}
    # Walk back to the start of the chain: from line to line until an end is not joined, or until
    # all lines of a ring are passed.
    while entry in partner_of and partner_of[entry] // 2 not in passed:
        entry = partner_of[entry] ^ 1
        passed.add(entry // 2)
    start = entry
    # Walk from the start to the other end, and collect the vertices of the lines.
    pieces = []
    next_entry: int | None = start
    while next_entry is not None:
        entry = next_entry
        visited.add(entry // 2)
        line = lines[entry // 2]
        starts_at_first = entry % 2 == 0
        pieces.append(line if starts_at_first else line[::-1])
        next_entry = partner_of.get(entry ^ 1)
        if next_entry == start:
            first_vertex = pieces[0][:1]
            pieces.append(first_vertex)  # closes the ring
            break
    points = np.concatenate(pieces)
    differs_from_previous = (points[1:, :2] != points[:-1, :2]).any(axis=1)
    return points[np.append(True, differs_from_previous)]  # the first vertex is kept
