"""Polylines as numpy arrays: resampling, equivalent point orders, boxes and clipping."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

Points = NDArray[np.floating[Any]]

PADDING = -10000.0
"""Value of the unused rows of ``equivalent_orders`` and ``sampled_orders``.

It is far from all points in metres, so an unused row is never the nearest one.
"""


def _check_polyline(points: Points, num_points: int = 2) -> Points:
    """Check a polyline (n, D) and the number of points to resample, and convert it to float64."""
    points = np.asarray(points)
    # The message names the usual numbers of coordinates, but more than three are accepted.
    if points.ndim != 2 or len(points) < 2 or points.shape[1] < 2:
        raise InputError(f"points must have shape (n >= 2, 2 or 3), got {points.shape}.")
    if num_points < 2:
        raise InputError(f"num_points must be >= 2, got {num_points}.")
    return points.astype(np.float64, copy=False)


def is_closed(points: Points) -> bool:
    """Whether a polyline is a ring: its last point equals its first exactly. (n, D)

    Two equal points are not a ring.
    """
    return len(points) > 2 and bool(np.array_equal(points[0], points[-1]))


def arc_lengths(points: Points) -> NDArray[np.float64]:
    """Compute the distance along a polyline from its first point to each point, in the plane.

    Heights are ignored, so a line with z and its projection to the plane are resampled at equal
    (x, y). The released code of the published methods resamples lines by shapely, which ignores
    heights as well.

    Args:
        points: Vertices in metres. (n, D)

    Returns:
        Distances in metres. (n,)
    """
    steps = np.linalg.norm(np.diff(np.asarray(points, np.float64)[:, :2], axis=0), axis=-1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def points_at_steps(points: Points, step: float) -> NDArray[np.float64]:
    """Sample a line at equal steps from its start.

    The last sample is at most one step before the end of the line, which is not sampled itself.

    Args:
        points: Vertices of the line. (n, D)
        step: Distance of the samples along the line in the plane, in the unit of the points.

    Returns:
        Samples. (m, D)
    """
    along = arc_lengths(points)
    distances = np.arange(0.0, along[-1], step)
    return np.stack([np.interp(distances, along, column) for column in points.T], axis=-1)


def pad_lines(
    lines: Sequence[NDArray[Any]],
    length: int | None = None,
    mode: Literal["constant", "edge"] = "edge",
) -> NDArray[Any]:
    """Stack lines with different numbers of points and pad the shorter ones at their end.

    Args:
        lines: Points of each line, at least one point per line. K x (n, D)
        length: Number P of points of each padded line, at least the largest number n of points of a
            line; None for this number, or 2 without lines.
        mode: Padding: ``"edge"`` repeats the last point, ``"constant"`` is zero.

    Returns:
        Lines. (K, P, D), or (0, P, 2) without lines
    """
    length = length or max(map(len, lines), default=2)
    rows = []
    for line in lines:
        missing = length - len(line)
        rows.append(np.pad(line, ((0, missing), (0, 0)), mode))
    return np.array(rows) if rows else np.zeros((0, length, 2))


def parts_inside(
    points: Points, x_range: tuple[float, float], y_range: tuple[float, float]
) -> list[NDArray[np.float64]]:
    """Compute the parts of a line inside a rectangle by shapely.

    Unlike in `clip_to_box`, a line that crosses itself is also cut at the crossing, because shapely
    cuts it there.

    Args:
        points: Vertices in metres; a line of fewer than two has no parts. (n, 2)
        x_range: Smallest and largest x of the rectangle, in metres.
        y_range: Smallest and largest y of the rectangle, in metres.

    Returns:
        Parts of the line inside the rectangle, each (m >= 2, 2).
    """
    import shapely  # imported here, so that result files can be read without shapely

    if len(points) < 2:
        return []
    box = shapely.box(x_range[0], y_range[0], x_range[1], y_range[1])
    inside = shapely.LineString(points).intersection(box)
    parts = []
    for part in shapely.get_parts(inside):
        vertices = shapely.get_coordinates(part)
        if len(vertices) > 1:  # a line that touches the box leaves a point
            parts.append(vertices)
    return parts


def resample(points: Points, num_points: int) -> NDArray[np.float64]:
    """Resample a polyline at equal distances in the plane, both ends included.

    Args:
        points: Vertices in metres; z is interpolated. (n, D)
        num_points: Number P of points, at least 2.

    Returns:
        Points. (P, D)

    Raises:
        ValueError: If ``points`` is no polyline or ``num_points`` is less than 2.
    """
    points = _check_polyline(points, num_points)
    offsets = np.array([0, len(points)])  # of a single polyline
    return resample_all(points, offsets, num_points=num_points)[0]


def resample_all(
    points: Points, offsets: NDArray[np.integer[Any]], num_points: int
) -> NDArray[np.float64]:
    """Resample polylines at equal distances in the plane, both ends included.

    `resample` does this for a single polyline, and checks it. Here nothing is checked.

    Args:
        points: Vertices of all polylines, in metres. (M, D)
        offsets: Polyline i has the vertices ``offsets[i]:offsets[i + 1]``. (N + 1,)
        num_points: Number P of points of each result, at least 2.

    Returns:
        Points, zeros for a polyline without vertices. (N, P, D)
    """
    counts = np.diff(offsets)
    resampled = np.zeros((len(counts), num_points, points.shape[1]))
    if not counts.any():
        return resampled
    # All polylines get n vertices, the largest number: the last vertex is repeated. `indices` are
    # the vertices within a polyline, and `rows` are the corresponding rows of `points`. (N, n)
    indices = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
    rows = indices + offsets[:-1, None]
    # In a polyline without vertices, the index is -1, and the row is -1 or belongs to another
    # polyline. Any valid row will do, because the result of this polyline stays zero below.
    vertices = points[rows.clip(0)]  # (N, n, D)
    steps = np.linalg.norm(np.diff(vertices[..., :2], axis=1), axis=-1)
    along = np.zeros(rows.shape)  # distance of each vertex from the start of its polyline
    np.cumsum(steps, axis=1, out=along[:, 1:])
    distances = np.arange(num_points) * (along[:, -1:] / (num_points - 1))  # (N, P)
    distances[:, -1] = along[:, -1]  # exactly, in spite of rounding
    for i in np.flatnonzero(counts):
        n = counts[i]  # without repeated vertices
        for axis in range(points.shape[1]):
            resampled[i, :, axis] = np.interp(distances[i], along[i, :n], vertices[i, :n, axis])
    return resampled


def equivalent_orders(
    points: Points, num_points: int, rng: np.random.Generator | None = None
) -> NDArray[np.float64]:
    """Compute the point orders that describe one map element (shift pattern "v2" in MapTR's code).

    An open polyline has two orders: forward and reversed. A ring, whose last vertex equals its
    first, has n - 1 different vertices and one order for each of them. The order starts at the
    vertex and keeps the direction of the ring. Order k starts k vertices before the first vertex.
    If a ring has more than S = max(P - 1, 2) different vertices, only S of these orders are
    computed, with evenly spaced or random numbers k.

    Args:
        points: Vertices at full resolution, in metres. (n, D)
        num_points: Number P of points of an order, at equal distances in the plane.
        rng: Generator for a random selection of the orders of a ring; None for an even one.

    Returns:
        Orders in the first rows; unused rows are ``PADDING``. (S, P, D)

    Raises:
        ValueError: If ``points`` is no polyline or ``num_points`` is less than 2.
    """
    points = _check_polyline(points, num_points)
    num_rows = max(num_points - 1, 2)  # an open polyline needs two
    orders = np.full((num_rows, num_points, points.shape[1]), PADDING)
    if not is_closed(points):
        orders[0] = resample(points, num_points)
        orders[1] = orders[0, ::-1]
        return orders
    count = len(points) - 1  # different vertices
    # A roll is the number of vertices by which an order starts before the first vertex.
    if count <= num_rows:
        rolls = np.arange(count)
    elif rng is None:
        rolls = np.linspace(0, count, num_rows, endpoint=False).astype(np.int64)
    else:
        rolls = rng.choice(count, num_rows, replace=False)
    twice = np.concatenate([points, points[1:]])  # a second lap, so that no distance wraps around
    along = arc_lengths(twice)
    # Distance from vertex 0 to the start of each order, in the direction of the ring. The vertex r
    # places before vertex 0 is vertex count - r, or vertex 0 itself for r = 0.
    starts = along[-rolls % count, None]
    # The length of one lap is `along[count]`.
    distances = starts + np.linspace(0.0, along[count], num_points)
    columns = [np.interp(distances, along, column) for column in twice.T]
    orders[: len(rolls)] = np.stack(columns, axis=-1)
    return orders


def sampled_orders(points: Points, closed: bool) -> NDArray[np.float64]:
    """Compute the point orders of a resampled line, with both directions at each point.

    An open line has two orders: forward and reversed. A closed line has P - 1 different points. A
    forward and a reversed order start at each of them. The line is not resampled again.

    Args:
        points: Points in metres; the last equals the first if closed. (P, D)
        closed: Whether the line is closed.

    Returns:
        Orders in the first rows. For a closed line, the forward orders precede the reversed ones,
        and all rows are used. Unused rows are ``PADDING``. (2 (P - 1), P, D)
    """
    orders = np.full((2 * (len(points) - 1), *points.shape), PADDING)
    if not closed:
        orders[0] = points
        orders[1] = points[::-1]
        return orders
    ring = points[:-1]
    for step in range(len(ring)):
        orders[step, :-1] = np.roll(ring, step, axis=0)
        orders[len(ring) + step, :-1] = np.roll(ring[::-1], step, axis=0)
    orders[:, -1] = orders[:, 0]  # each order is closed
    return orders


def shortest_orders(lines: Points, least_gain_m: float = 1e-3) -> NDArray[np.int64]:
    """Reorder the points of lines to shorten the path through them (2-opt, Croes 1958).

    In each round, the run of points whose reversal shortens the line most is reversed. The rounds
    end when no reversal shortens the line by more than ``least_gain_m``. This straightens a line
    that runs back and forth, but the result is not always the shortest path of all orders. If the
    ends of a line are closer than its mean step, so that it is nearly a ring, its first and last
    points keep their places.

    Args:
        lines: Points of each line in metres; lengths are measured in the plane. (M, P, 2 or 3)
        least_gain_m: Shortening that a reversal must exceed, in metres.

    Returns:
        Indices of the points of each line in their new order. (M, P)
    """
    lines = np.asarray(lines, np.float64)[..., :2]
    count, size = lines.shape[:2]
    # Distances between all pairs of points of a line, (M, P, P). They are computed once; the rounds
    # only reorder them.
    apart = np.linalg.norm(lines[:, :, None] - lines[:, None], axis=-1)
    steps = np.linalg.norm(np.diff(lines, axis=1), axis=-1)
    is_ring = apart[:, 0, -1] < steps.mean(1) if size > 1 else np.zeros(count, bool)
    places = np.arange(size)  # positions in an order
    orders = np.tile(places, (count, 1))
    active = np.arange(count if size > 2 else 0)  # indices of lines that a reversal may shorten
    while len(active):
        rows = orders[active]
        # Distances between the points at all pairs of places in the order, (m, P, P).
        paths = apart[active[:, None, None], rows[:, :, None], rows[:, None]]
        # A row and a column of zeros on each side: the steps before the start and after the end of
        # a line have no length. Place i of the order then has the index i + 1 in `paths`.
        paths = np.pad(paths, ((0, 0), (1, 1), (1, 1)))
        step = paths.diagonal(1, 1, 2)  # to place i from the place before it, (m, P + 1)
        # A reversal of the points i to j replaces the steps to point i and from point j by the
        # steps from the point before i to j, and from i to the point after j.
        replaced = step[:, :-1, None] + step[:, None, 1:]  # (m, P, P), for places i and j
        before_i_to_j = paths[:, :-2, 1:-1]
        i_to_after_j = paths[:, 1:-1, 2:]
        gain = replaced - before_i_to_j - i_to_after_j
        gain[is_ring[active], 0] = 0.0  # the first point of a ring stays
        gain[is_ring[active], :, -1] = 0.0  # and so does its last point
        # Only pairs with i < j are reversals. The gain of the others becomes 0. (m, P * P)
        gain = np.triu(gain, 1).reshape(len(active), -1)
        best = gain.argmax(1)  # flat index i * P + j
        improves = gain[np.arange(len(active)), best] > least_gain_m
        active = active[improves]  # a line without an improvement is finished
        first, last = np.divmod(best[improves, None], size)  # places i and j
        # The place from which each place gets its point: first + last - place in the reversed run.
        inside = (places >= first) & (places <= last)
        reversal = np.where(inside, first + last - places, places)
        orders[active] = np.take_along_axis(orders[active], reversal, axis=1)
    return orders


def bounding_boxes(points: Points) -> Points:
    """Axis-aligned boxes (x_min, y_min, x_max, y_max) of lines. (..., P, D) -> (..., 4)"""
    xy = np.asarray(points)[..., :2]
    return np.concatenate([xy.min(-2), xy.max(-2)], axis=-1)


def clamp(points: Points, x_range: tuple[float, float], y_range: tuple[float, float]) -> Points:
    """Move points outside of a rectangle to its nearest edge.

    Args:
        points: Points (x, y) and further entries, which do not change. (..., D)
        x_range: Smallest and largest x of the rectangle, in the unit of the points.
        y_range: Smallest and largest y of the rectangle, in the unit of the points.

    Returns:
        Points, as a new array. (..., D)
    """
    low, high = np.transpose([x_range, y_range])  # (x_min, y_min) and (x_max, y_max)
    clamped = np.array(points)  # a copy
    clamped[..., :2] = np.clip(clamped[..., :2], low, high)
    return clamped


def clip_to_box(
    points: Points, x_range: tuple[float, float], y_range: tuple[float, float]
) -> list[NDArray[np.float64]]:
    """Compute the pieces of a polyline in an axis-aligned rectangle (Liang and Barsky, 1984).

    Pieces keep the direction of the polyline, and further coordinates are interpolated. A ring
    that leaves the rectangle is cut into open pieces; its arbitrary start does not end a piece. A
    ring inside the rectangle stays one closed piece. Pieces that only touch the rectangle are left
    out.

    Args:
        points: Vertices in metres. (n, D)
        x_range: Smallest and largest x of the rectangle, in metres.
        y_range: Smallest and largest y of the rectangle, in metres.

    Returns:
        Pieces inside the rectangle, in their order, each (m >= 2, D).

    Raises:
        ValueError: If ``points`` is no polyline.
    """
    points = _check_polyline(points)
    step = np.diff(points, axis=0)  # of each segment
    has_length = step.any(axis=-1)
    start = points[:-1][has_length]
    step = step[has_length]
    # Lower edges in x and y, then upper edges. (2, 1, 2)
    edges = np.array([x_range, y_range]).T[:, None]
    # Share of each segment at which it crosses the lines of the lower and the upper edges in x and
    # y, infinite if it is parallel to an edge.
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = (edges - start[:, :2]) / step[:, :2]  # (2, n, 2)
    # A segment on the line of an edge gives 0 / 0, which is NaN. Such a segment is inside the range
    # between this edge and the opposite one. So it gets minus infinity for a lower edge (always
    # past it) and infinity for an upper edge (never past it).
    along_edge = (step[:, :2] == 0) & np.isnan(cuts)
    cuts = np.where(along_edge, [[[-np.inf]], [[np.inf]]], cuts)
    # Shares in [0, 1] of a segment at which it enters and leaves the rectangle. For each of the
    # ranges of x and y, the smaller of two cuts is the entry, and the larger one is the exit. The
    # rectangle is entered at the later entry and left at the earlier exit. A segment that misses
    # the rectangle has enter >= leave.
    enter = cuts.min(0).max(-1).clip(min=0)
    leave = cuts.max(0).min(-1).clip(max=1)
    hits = np.flatnonzero(enter < leave)
    if not len(hits):
        return []
    # First and last point inside the rectangle of each segment that hits it.
    first = start[hits] + enter[hits, None] * step[hits]
    last = start[hits] + leave[hits, None] * step[hits]
    # A piece continues if the next segment hits, and the vertex between both is inside.
    is_next = np.diff(hits) == 1
    is_joined = is_next & (leave[hits[:-1]] == 1.0) & (enter[hits[1:]] == 0.0)
    breaks = np.flatnonzero(~is_joined) + 1
    limits = [0, *breaks.tolist(), len(hits)]
    pieces = []
    for begin, end in pairwise(limits):
        # First point of the first segment of the piece, and last points of all its segments.
        piece = np.concatenate([first[begin : begin + 1], last[begin:end]])
        pieces.append(piece)
    starts_inside = hits[0] == 0 and enter[0] == 0
    ends_inside = hits[-1] == len(start) - 1 and leave[-1] == 1
    # The last piece of a ring goes on with the first one, if both meet inside the rectangle.
    if len(pieces) > 1 and starts_inside and ends_inside and is_closed(points):
        last_piece = pieces.pop()
        pieces[0] = np.concatenate([last_piece, pieces[0][1:]])  # the common vertex once
    return pieces
