"""Compiled inner loops of AP_chamfer; ``chamfer_ap`` is their only user.

Coordinates come as separate x and y arrays, so that the loops vectorise. The order of every sum is
that of numpy and GEOS, so that distances which equal a threshold exactly do so here as well.
"""

import math

import numpy as np
from numba import njit

from gsmap.structures.elements import BoolArray, FloatArray, IntArray

_NO_NAN = {"nnan", "nsz"}  # minima vectorise; the order of additions stays as it is written
_BOUND_SLACK = 1.0 - 1e-12  # a lower bound may be too large by the rounding of its sum


@njit(cache=True)
def line_lengths(points: FloatArray, offsets: IntArray) -> FloatArray:
    """Return the arc length of each polyline, in metres. (N,)"""
    lengths = np.zeros(len(offsets) - 1)
    for i in range(len(lengths)):
        total = 0.0
        for j in range(offsets[i] + 1, offsets[i + 1]):
            dx, dy = points[j, 0] - points[j - 1, 0], points[j, 1] - points[j - 1, 1]
            total += math.sqrt(dx * dx + dy * dy)
        lengths[i] = total
    return lengths


@njit(cache=True)
def resample(
    points: FloatArray, offsets: IntArray, lengths: FloatArray, num_points: int
) -> tuple[FloatArray, FloatArray]:
    """Place points at equal arc lengths, both ends included, on each polyline.

    Args:
        points: Points of all polylines. (M, 2)
        offsets: Where each polyline starts in ``points``. (N + 1,)
        lengths: Arc length of each polyline. (N,)
        num_points: How many points each polyline gets.

    Returns:
        x and y of the new points; zeros for a polyline without points. 2 x (N * num_points,)
    """
    n = len(offsets) - 1
    xs, ys = np.zeros(n * num_points), np.zeros(n * num_points)
    for i in range(n):
        first, last = offsets[i], offsets[i + 1] - 1
        if last < first:
            continue
        step = lengths[i] / (num_points - 1) if num_points > 1 else 0.0
        j, walked = first, 0.0  # the segment j to j + 1 starts at arc length `walked`
        seg_x = seg_y = seg = 0.0
        if j < last:
            seg_x, seg_y = points[j + 1, 0] - points[j, 0], points[j + 1, 1] - points[j, 1]
            seg = math.sqrt(seg_x * seg_x + seg_y * seg_y)
        for k in range(num_points):
            target = k * step if k + 1 < num_points else lengths[i]
            while j < last and walked + seg <= target:
                walked += seg
                j += 1
                if j < last:
                    seg_x, seg_y = points[j + 1, 0] - points[j, 0], points[j + 1, 1] - points[j, 1]
                    seg = math.sqrt(seg_x * seg_x + seg_y * seg_y)
            fraction = (target - walked) / seg if j < last else 0.0
            xs[i * num_points + k] = points[j, 0] + seg_x * fraction
            ys[i * num_points + k] = points[j, 1] + seg_y * fraction
    return xs, ys


@njit(cache=True, fastmath=_NO_NAN)
def _mean_of_roots(squared: FloatArray, n: int) -> float:
    """Return the mean of the square roots of the first n entries, summed as numpy sums."""
    if n < 8 or n > 128:  # numpy halves longer arrays; no reference uses more than 100 points
        total = 0.0
        for i in range(n):
            total += math.sqrt(squared[i])
        return total / n
    r = np.zeros(8)
    for i in range(8):
        r[i] = math.sqrt(squared[i])
    whole = n - n % 8
    for i in range(8, whole, 8):
        for j in range(8):
            r[j] += math.sqrt(squared[i + j])
    total = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]))
    for i in range(whole, n):
        total += math.sqrt(squared[i])
    return total / n


@njit(cache=True, fastmath=_NO_NAN)
def chamfer(
    ax: FloatArray,
    ay: FloatArray,
    bx: FloatArray,
    by: FloatArray,
    row: FloatArray,
    col: FloatArray,
) -> float:
    """Return the Chamfer distance of two point sets: the mean of both directed mean distances.

    Args:
        ax: x of the first set. (P,)
        ay: y of the first set. (P,)
        bx: x of the second set. (Q,)
        by: y of the second set. (Q,)
        row: Scratch. (>= P,)
        col: Scratch. (>= Q,)
    """
    na, nb = len(ax), len(bx)
    for j in range(nb):
        col[j] = np.inf
    for i in range(na):
        nearest = np.inf
        for j in range(nb):
            dx, dy = ax[i] - bx[j], ay[i] - by[j]
            squared = dx * dx + dy * dy
            col[j] = min(col[j], squared)
            nearest = min(nearest, squared)
        row[i] = nearest
    return (_mean_of_roots(row, na) + _mean_of_roots(col, nb)) / 2.0


@njit(cache=True, fastmath=_NO_NAN)
def _mean_distance_to_box(x: FloatArray, y: FloatArray, box: FloatArray) -> float:
    """Return the mean distance of points from a box (x_min, y_min, x_max, y_max)."""
    total = 0.0
    for i in range(len(x)):
        dx = max(max(box[0] - x[i], x[i] - box[2]), 0.0)
        dy = max(max(box[1] - y[i], y[i] - box[3]), 0.0)
        total += math.sqrt(dx * dx + dy * dy)
    return total / len(x)


@njit(cache=True)
def _boxes(xs: FloatArray, ys: FloatArray, offsets: IntArray) -> FloatArray:
    """Return the bounding box of each point set. (N, 4)"""
    boxes = np.zeros((len(offsets) - 1, 4))
    for i in range(len(boxes)):
        start, stop = offsets[i], offsets[i + 1]
        if stop > start:
            boxes[i, 0], boxes[i, 1] = xs[start:stop].min(), ys[start:stop].min()
            boxes[i, 2], boxes[i, 3] = xs[start:stop].max(), ys[start:stop].max()
    return boxes


@njit(cache=True)
def _beside_a_segment(
    px: FloatArray, py: FloatArray, lx: FloatArray, ly: FloatArray, width_sq: float
) -> bool:
    """Whether a point projects into a segment of the line, closer than the strip's half width."""
    for i in range(len(px)):
        for j in range(len(lx) - 1):
            sx, sy = lx[j + 1] - lx[j], ly[j + 1] - ly[j]
            qx, qy = px[i] - lx[j], py[i] - ly[j]
            seg_sq, along = sx * sx + sy * sy, qx * sx + qy * sy
            if 0.0 < along < seg_sq:
                across = qx * sy - qy * sx
                if across * across < width_sq * seg_sq:
                    return True
    return False


@njit(cache=True)
def _lower_bounds(
    x: FloatArray,
    y: FloatArray,
    box: FloatArray,
    label: int,
    gt: tuple[FloatArray, FloatArray, IntArray, IntArray, BoolArray],
    g_boxes: FloatArray,
) -> FloatArray:
    """Bound the Chamfer distance of one line to each ground truth from below. (K,)

    No point of a set is nearer than the set's bounding box. Infinity where the classes differ.
    """
    gx, gy, g_off, g_labels, g_valid = gt
    bounds = np.full(len(g_labels), np.inf)
    for k in range(len(bounds)):
        if g_valid[k] and g_labels[k] == label:
            there = _mean_distance_to_box(x, y, g_boxes[k])
            start, stop = g_off[k], g_off[k + 1]
            back = _mean_distance_to_box(gx[start:stop], gy[start:stop], box)
            bounds[k] = (there + back) / 2.0 * _BOUND_SLACK
    return bounds


@njit(cache=True)
def nearest_ground_truth(
    pred: tuple[FloatArray, FloatArray, IntArray, IntArray, BoolArray],
    gt: tuple[FloatArray, FloatArray, IntArray, IntArray, BoolArray],
    max_distance: float,
    half_width: float,
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Find each prediction's nearest ground truth of its class, by branch and bound.

    Args:
        pred: x, y (M,), offsets (N + 1,), labels (N,), and which elements may match at all (N,).
        gt: The same of the ground truth, K elements.
        max_distance: Pairs farther apart need not be found, in metres.
        half_width: Half width of the strips that have to touch, in metres.

    Returns:
        Index of the nearest ground truth or -1 (N,); Chamfer distance or infinity (N,); whether
        the pair's strips are known to touch (N,).
    """
    px, py, p_off, p_labels, p_valid = pred
    gx, gy, g_off = gt[0], gt[1], gt[2]
    best, distance = np.full(len(p_labels), -1, dtype=np.int64), np.full(len(p_labels), np.inf)
    touching = np.zeros(len(p_labels), dtype=np.bool_)
    row, col = np.empty(max(1, len(px))), np.empty(max(1, len(gx)))
    p_boxes, g_boxes = _boxes(px, py, p_off), _boxes(gx, gy, g_off)
    width_sq = half_width * half_width * _BOUND_SLACK
    for i in range(len(p_labels)):
        if not p_valid[i]:
            continue
        ax, ay = px[p_off[i] : p_off[i + 1]], py[p_off[i] : p_off[i + 1]]
        bounds = _lower_bounds(ax, ay, p_boxes[i], p_labels[i], gt, g_boxes)
        for k in np.argsort(bounds):
            if bounds[k] > min(distance[i], max_distance) or bounds[k] == np.inf:
                break
            bx, by = gx[g_off[k] : g_off[k + 1]], gy[g_off[k] : g_off[k + 1]]
            d = chamfer(ax, ay, bx, by, row, col)
            if d < distance[i] or (d == distance[i] and k < best[i]):
                distance[i], best[i] = d, k
        if distance[i] <= max_distance and best[i] >= 0:
            k = best[i]
            bx, by = gx[g_off[k] : g_off[k + 1]], gy[g_off[k] : g_off[k + 1]]
            touching[i] = _beside_a_segment(ax, ay, bx, by, width_sq) or _beside_a_segment(
                bx, by, ax, ay, width_sq
            )
    return best, distance, touching


@njit(cache=True)
def assign(best: IntArray, distance: FloatArray, num_gts: int, thresholds: FloatArray) -> IntArray:
    """Give each ground truth to the first prediction that finds it, separately per threshold.

    Args:
        best: Nearest ground truth of each prediction, in descending order of score, or -1. (N,)
        distance: Its distance in metres. (N,)
        num_gts: Number of ground truths.
        thresholds: Largest distance of a match in metres, inclusive. (T,)

    Returns:
        The matched ground truth, or -1. (N, T)
    """
    matched = np.full((len(best), len(thresholds)), -1, dtype=np.int64)
    for t in range(len(thresholds)):
        taken = np.zeros(num_gts, dtype=np.bool_)
        for i in range(len(best)):
            k = best[i]
            if k >= 0 and distance[i] <= thresholds[t] and not taken[k]:
                taken[k] = True
                matched[i, t] = k
    return matched
