"""Compiled inner loops of AP_chamfer; ``chamfer_ap`` is their only user.

Coordinates come as separate arrays, so that the loops vectorise; without heights z is empty.
"""

import math

import numpy as np
from numba import njit

from gsmap.structures.elements import BoolArray, FloatArray, IntArray

Points = tuple[FloatArray, FloatArray, FloatArray]  # x, y, z (P,), or z (0,)
Lines = tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray]
"""Coordinates of all points, offsets of the N lines (N + 1,), labels (N,)."""
_NO_NAN = {"nnan", "nsz"}  # minima vectorise; the order of additions stays as it is written
_BOUND_SLACK = 1.0 - 1e-12  # a lower bound may be too large by the rounding of its sum


@njit(cache=True, fastmath=_NO_NAN)
def chamfer(first: Points, second: Points) -> float:
    """Return the mean of both directed mean nearest-neighbour distances; heights: both or none."""
    (ax, ay, az), (bx, by, bz) = first, second
    back, squared = np.full(len(bx), np.inf), np.empty(len(bx))
    there = 0.0
    for i in range(len(ax)):
        for j in range(len(bx)):
            dx, dy = ax[i] - bx[j], ay[i] - by[j]
            squared[j] = dx * dx + dy * dy
        if len(az):
            for j in range(len(bx)):
                dz = az[i] - bz[j]
                squared[j] += dz * dz
        nearest = np.inf
        for j in range(len(bx)):
            back[j] = min(back[j], squared[j])
            nearest = min(nearest, squared[j])
        there += math.sqrt(nearest)
    return (there / len(ax) + np.sqrt(back).sum() / len(bx)) / 2.0


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
        x, y = xs[offsets[i] : offsets[i + 1]], ys[offsets[i] : offsets[i + 1]]
        if len(x):
            boxes[i] = x.min(), y.min(), x.max(), y.max()
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
def nearest_ground_truth(
    pred: Lines, gt: Lines, max_distance: float, half_width: float
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Find each prediction's nearest ground truth of its class.

    No point of a set is nearer than the set's bounding box in the plane, which bounds the distance
    from below; few pairs are left to compute in full.

    Args:
        pred: N predictions; a label of -1 marks one that cannot match.
        gt: K ground truths.
        max_distance: Pairs farther apart are passed over, in metres.
        half_width: Half width of the strips that have to touch, in metres.

    Returns:
        Index of the nearest ground truth or -1 (N,); Chamfer distance or infinity (N,); whether
        the pair's strips are known to touch (N,).
    """
    px, py, pz, p_off, p_labels = pred
    gx, gy, gz, g_off, g_labels = gt
    n = len(p_labels)
    best, distance, touching = np.full(n, -1), np.full(n, np.inf), np.zeros(n, np.bool_)
    p_boxes, g_boxes = _boxes(px, py, p_off), _boxes(gx, gy, g_off)
    width_sq = half_width * half_width * _BOUND_SLACK
    for i in range(n):
        if p_labels[i] < 0:
            continue
        ax, ay = px[p_off[i] : p_off[i + 1]], py[p_off[i] : p_off[i + 1]]
        for k in np.flatnonzero(g_labels == p_labels[i]):
            bx, by = gx[g_off[k] : g_off[k + 1]], gy[g_off[k] : g_off[k + 1]]
            bound = _mean_distance_to_box(ax, ay, g_boxes[k])
            bound += _mean_distance_to_box(bx, by, p_boxes[i])
            if bound / 2.0 * _BOUND_SLACK <= min(distance[i], max_distance):
                az, bz = pz[p_off[i] : p_off[i + 1]], gz[g_off[k] : g_off[k + 1]]
                d = chamfer((ax, ay, az), (bx, by, bz))
                if d < distance[i] and d <= max_distance:
                    distance[i], best[i] = d, k
        if best[i] >= 0:
            k = best[i]
            bx, by = gx[g_off[k] : g_off[k + 1]], gy[g_off[k] : g_off[k + 1]]
            touching[i] = _beside_a_segment(ax, ay, bx, by, width_sq)
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
    matched = np.full((len(best), len(thresholds)), -1)
    for t in range(len(thresholds)):
        taken = np.zeros(num_gts, np.bool_)
        for i in range(len(best)):
            k = best[i]
            if k >= 0 and distance[i] <= thresholds[t] and not taken[k]:
                taken[k], matched[i, t] = True, k
    return matched
