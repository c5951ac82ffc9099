"""Polylines as numpy arrays: resampling, equivalent point orders, boxes and clipping."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

Points = NDArray[np.floating[Any]]

PADDING = -10000.0
"""Fills the rows of ``equivalent_orders`` that are not used."""


def _check_polyline(points: Points, num_points: int = 2) -> Points:
    points = np.asarray(points)
    if points.ndim != 2 or len(points) < 2 or points.shape[1] < 2:
        raise InputError(f"points must have shape (n >= 2, 2 or 3), got {points.shape}.")
    if num_points < 2:
        raise InputError(f"num_points must be >= 2, got {num_points}.")
    return points.astype(np.float64, copy=False)


def is_closed(points: Points) -> bool:
    """Whether a polyline is a ring: its last point equals its first exactly. (n, D)."""
    return len(points) > 2 and bool(np.array_equal(points[0], points[-1]))


def arc_lengths(points: Points) -> NDArray[np.float64]:
    """Return the distance in the plane from the first point to each point along a polyline.

    Heights do not lengthen a line, as in shapely, which MapTRv2 resamples 3D lines with: the same
    line with and without z is resampled at the same (x, y). (n, D) in metres -> (n,)
    """
    steps = np.linalg.norm(np.diff(np.asarray(points, np.float64)[:, :2], axis=0), axis=-1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def sampled(points: Points, step: float) -> NDArray[np.float64]:
    """Return a point at every step from the start of a line; the rest at the end is dropped.

    Steps are measured in the plane, in the points' unit. (n, D) -> (m, D)
    """
    along = arc_lengths(points)
    at = np.arange(0.0, along[-1], step)
    return np.stack([np.interp(at, along, axis) for axis in points.T], -1)


def padded(
    lines: Sequence[NDArray[Any]],
    length: int | None = None,
    mode: Literal["constant", "edge"] = "edge",
) -> NDArray[Any]:
    """Stack lines, the last point of the shorter ones repeated. (K, P, D)

    Args:
        lines: Points of each line, one or more. (n, D) each
        length: Number P of points; None means those of the longest line, or 2 without any.
        mode: ``"constant"`` fills lines with zeros instead.
    """
    length = length or max(map(len, lines), default=2)
    rows = [np.pad(line, ((0, length - len(line)), (0, 0)), mode) for line in lines]
    return np.array(rows) if rows else np.zeros((0, length, 2))


def parts_inside(
    points: Points, x_range: tuple[float, float], y_range: tuple[float, float]
) -> list[NDArray[np.float64]]:
    """Return the parts of a line in a rectangle, as shapely cuts it.

    Unlike in `clip_to_box`, a line that crosses itself becomes several.

    Args:
        points: Vertices in metres; fewer than two have no part. (n, 2)
        x_range: Smallest and largest x of the rectangle, in metres.
        y_range: Smallest and largest y, likewise.

    Returns:
        The parts. each (m >= 2, 2)
    """
    import shapely  # reading a result file needs neither scipy nor shapely

    if len(points) < 2:
        return []
    box = shapely.box(x_range[0], y_range[0], x_range[1], y_range[1])
    parts = shapely.get_parts(shapely.LineString(points).intersection(box))
    return [part for part in map(shapely.get_coordinates, parts) if len(part) > 1]


def resample(points: Points, num_points: int) -> NDArray[np.float64]:
    """Resample a polyline at equal arc length in the plane, both end points included.

    z is interpolated. ValueError if it is no polyline or ``num_points`` is below 2. (n, D) in
    metres -> (P, D)
    """
    points = _check_polyline(points, num_points)
    return resample_all(points, np.array([0, len(points)]), num_points)[0]


def resample_all(
    points: Points, offsets: NDArray[np.integer[Any]], num_points: int
) -> NDArray[np.float64]:
    """Resample many polylines as `resample` does one. (N, P, D)

    Args:
        points: Vertices of all polylines. (M, D)
        offsets: Polyline i has the vertices ``offsets[i]:offsets[i + 1]``, zeros if none. (N + 1,)
        num_points: Points P of each result, at equal distances in the plane.
    """
    counts = np.diff(offsets)
    resampled = np.zeros((len(counts), num_points, points.shape[1]))
    if not counts.any():
        return resampled
    vertex = np.minimum(np.arange(counts.max()), counts[:, None] - 1) + offsets[:-1, None]
    padded = points[vertex.clip(0)]  # (N, n, D), the last vertex repeated
    along = np.zeros(vertex.shape)
    np.cumsum(np.linalg.norm(np.diff(padded[..., :2], axis=1), axis=-1), axis=1, out=along[:, 1:])
    distances = np.arange(num_points) * (along[:, -1:] / (num_points - 1))  # (N, P)
    distances[:, -1] = along[:, -1]
    for i in np.flatnonzero(counts):
        n = counts[i]
        for axis in range(points.shape[1]):
            resampled[i, :, axis] = np.interp(distances[i], along[i, :n], padded[i, :n, axis])
    return resampled


def equivalent_orders(
    points: Points, num_points: int, rng: np.random.Generator | None = None
) -> NDArray[np.float64]:
    """Return the point orders that describe the same map element ("v2" of MapTR).

    An open polyline has two: as it is, and reversed. A ring, whose last vertex equals its first,
    has one for each of its K vertices, which starts there and runs in the ring's own direction;
    order k starts at vertex -k. Of more than P - 1 vertices, P - 1 are taken.

    Args:
        points: Vertices at full resolution, in metres. (n, D)
        num_points: Points P of an order, at equal arc length.
        rng: Draws which of a ring's vertices are taken; None spreads them evenly.

    Returns:
        The orders; unused rows hold ``PADDING``. (max(P - 1, 2), P, D)

    Raises:
        ValueError: If it is no polyline or ``num_points`` is below 2.
    """
    points = _check_polyline(points, num_points)
    slots = max(num_points - 1, 2)
    orders = np.full((slots, num_points, points.shape[1]), PADDING)
    if not is_closed(points):
        orders[0] = resample(points, num_points)
        orders[1] = orders[0, ::-1]
        return orders
    count = len(points) - 1
    if count <= slots:
        rolls = np.arange(count)
    elif rng is None:
        rolls = np.linspace(0, count, slots, endpoint=False).astype(np.int64)
    else:
        rolls = rng.choice(count, slots, replace=False)
    twice = np.concatenate([points, points[1:]])  # a second lap, so that no distance wraps around
    along = arc_lengths(twice)
    laps = along[-rolls % count, None] + np.linspace(0.0, along[count], num_points)
    orders[: len(rolls)] = np.stack([np.interp(laps, along, column) for column in twice.T], -1)
    return orders


def sampled_orders(points: Points, closed: bool) -> NDArray[np.float64]:
    """Return the point orders of a resampled line as StreamMapNet takes them.

    An open line has two, as it is and reversed. A closed one starts at each of its P - 1 different
    points, and each also reversed; it is not resampled again. Unused rows hold ``PADDING``. (P, D)
    in metres, first = last if closed -> (2 (P - 1), P, D)
    """
    orders = np.full((2 * (len(points) - 1), *points.shape), PADDING)
    if not closed:
        orders[0], orders[1] = points, points[::-1]
        return orders
    ring = points[:-1]
    turned = [np.roll(way, step, 0) for way in (ring, ring[::-1]) for step in range(len(ring))]
    orders[:, :-1] = turned
    orders[:, -1] = orders[:, 0]
    return orders


def shortest_orders(lines: Points, least_gain_m: float = 1e-3) -> NDArray[np.int64]:
    """Return orders of the points of lines in which the way through them is short.

    The part of a line whose reversal shortens it most is reversed, until none does (2-opt, Croes
    1958), so a line that runs back and forth runs straight. A line that ends where it begins, by
    less than its mean step, keeps its ends.

    Args:
        lines: Points of each line in metres; the way is one in the plane. (M, P, 2 or 3)
        least_gain_m: Metres that a reversal must save.

    Returns:
        Numbers of the points of each line in their new order. (M, P)
    """
    lines = np.asarray(lines, np.float64)[..., :2]
    count, size = lines.shape[:2]
    apart = np.linalg.norm(lines[:, :, None] - lines[:, None], axis=-1)  # (M, P, P)
    steps = np.linalg.norm(np.diff(lines, axis=1), axis=-1)
    ring = apart[:, 0, -1] < steps.mean(1) if size > 1 else np.zeros(count, bool)
    orders, places = np.tile(np.arange(size), (count, 1)), np.arange(size)
    left = np.arange(count if size > 2 else 0)
    while len(left):
        rows = orders[left]
        ways = apart[left[:, None, None], rows[:, :, None], rows[:, None]]
        ways = np.pad(ways, ((0, 0), (1, 1), (1, 1)))  # beyond its ends a line goes nowhere
        step = ways.diagonal(1, 1, 2)  # to each point from the one before it, (m, P + 1)
        # [i, j]: the steps into and out of points i to j, as they are and with these reversed
        gain = step[:, :-1, None] + step[:, None, 1:] - ways[:, :-2, 1:-1] - ways[:, 1:-1, 2:]
        gain[ring[left], 0], gain[ring[left], :, -1] = 0.0, 0.0
        gain = np.triu(gain, 1).reshape(len(left), -1)
        best = gain.argmax(1)
        better = gain[np.arange(len(left)), best] > least_gain_m
        left = left[better]
        first, last = (ends[better, None] for ends in np.divmod(best, size))
        inside = (places >= first) & (places <= last)
        turned = np.where(inside, first + last - places, places)
        orders[left] = np.take_along_axis(orders[left], turned, 1)
    return orders


def bounding_boxes(points: Points) -> Points:
    """Return axis-aligned boxes (xmin, ymin, xmax, ymax) in metres. (..., P, D) -> (..., 4)."""
    xy = np.asarray(points)[..., :2]
    return np.concatenate([xy.min(-2), xy.max(-2)], -1)


def clamp(points: Points, x_range: tuple[float, float], y_range: tuple[float, float]) -> Points:
    """Return points with those outside a rectangle moved to its nearest edge. (..., D)

    Args:
        points: Points that begin with (x, y); further entries are kept. (..., D)
        x_range: Smallest and largest x, in the unit of the points.
        y_range: Smallest and largest y.
    """
    clamped = np.array(points)
    clamped[..., :2] = np.clip(clamped[..., :2], *np.transpose([x_range, y_range]))
    return clamped


def clip_to_box(
    points: Points, x_range: tuple[float, float], y_range: tuple[float, float]
) -> list[NDArray[np.float64]]:
    """Cut a polyline with an axis-aligned rectangle (Liang and Barsky, 1984).

    Direction is kept, further coordinates are interpolated, and a ring that is cut comes back as
    open pieces, none of which ends at the ring's arbitrary start. Pieces that only touch the
    rectangle are left out. ValueError if it is no polyline.

    Args:
        points: Vertices in metres. (n, D)
        x_range: Smallest and largest x of the rectangle, in metres.
        y_range: Smallest and largest y, likewise.

    Returns:
        The pieces inside, in order. each (m >= 2, D)
    """
    points = _check_polyline(points)
    start, step = points[:-1], np.diff(points, axis=0)
    moving = step.any(axis=-1)
    start, step = start[moving], step[moving]
    edges = np.array([x_range, y_range]).T[:, None]  # the lower ones, then the upper ones
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = (edges - start[:, :2]) / step[:, :2]  # (2, n, 2), infinite if parallel to an edge
    along_edge = (step[:, :2] == 0) & np.isnan(cuts)
    cuts = np.where(along_edge, [[[-np.inf]], [[np.inf]]], cuts)
    # where segments enter and leave the rectangle, in [0, 1]; enter > leave: missed
    enter, leave = cuts.min(0).max(-1).clip(min=0), cuts.max(0).min(-1).clip(max=1)
    hits = np.flatnonzero(enter < leave)
    if not len(hits):
        return []
    first, last = (start[hits] + at[hits, None] * step[hits] for at in (enter, leave))
    joined = (np.diff(hits) == 1) & (leave[hits[:-1]] == 1.0) & (enter[hits[1:]] == 0.0)
    breaks = np.flatnonzero(~joined) + 1
    ends = [0, *breaks.tolist(), len(hits)]
    pieces = [np.concatenate([first[a : a + 1], last[a:b]]) for a, b in pairwise(ends)]
    runs_through = hits[0] == 0 and hits[-1] == len(start) - 1 and enter[0] == 0 and leave[-1] == 1
    if len(pieces) > 1 and runs_through and is_closed(points):
        pieces[0] = np.concatenate([pieces.pop(), pieces[0][1:]])
    return pieces
