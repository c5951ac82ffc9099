"""Compiled inner loops of AP_chamfer; ``chamfer_ap`` is their only user.

Lines are coordinates in separate rows, so that the loops vectorise; in the plane z is 0.
"""

import math

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.structures.elements import FloatArray, IntArray

Lines = tuple[FloatArray, IntArray, IntArray]
"""Points of all lines in metres (3, M), offsets of the N lines (N + 1,), labels (N,)."""
_NO_NAN = {"nnan", "nsz"}  # minima vectorise; the order of additions stays as it is written
_BOUND_SLACK = 1.0 - 1e-12  # a lower bound may be too large by the rounding of its sum


@njit(cache=True, error_model="numpy")
def resampled(points: FloatArray, offsets: IntArray, num_points: int) -> FloatArray:
    """Resample lines at equal arc length in the plane, bit by bit as `resample_all` does.

    Args:
        points: Vertices of all lines in metres. (M, D)
        offsets: Line i has the vertices ``offsets[i]:offsets[i + 1]``, zeros if none. (N + 1,)
        num_points: Points P of each result, >= 2.

    Returns:
        Coordinates in rows; z is 0 in the plane. (3, N * P)
    """
    rows = np.zeros((3, (len(offsets) - 1) * num_points))
    for i in range(len(offsets) - 1):
        line = points[offsets[i] : offsets[i + 1]]
        if not len(line):
            continue
        along = np.zeros(len(line))
        for k in range(1, len(line)):
            dx, dy = line[k, 0] - line[k - 1, 0], line[k, 1] - line[k - 1, 1]
            along[k] = along[k - 1] + math.sqrt(dx * dx + dy * dy)
        step, k = along[-1] / (num_points - 1), 0
        for p in range(num_points):
            at = p * step if p < num_points - 1 else along[-1]
            while k + 1 < len(line) and along[k + 1] <= at:
                k += 1
            for axis in range(line.shape[1]):
                value = line[k, axis]
                if k + 1 < len(line) and along[k] != at:  # as `np.interp` computes it
                    slope = (line[k + 1, axis] - value) / (along[k + 1] - along[k])
                    value = slope * (at - along[k]) + value
                rows[axis, i * num_points + p] = value
    return rows


@njit(cache=True, fastmath=_NO_NAN)
def chamfer_distance(first: FloatArray, second: FloatArray) -> float:
    """Return the mean of both directed mean nearest-neighbour distances. (3, P), (3, Q) metres"""
    ax, ay, az = first[0], first[1], first[2]
    bx, by, bz = second[0], second[1], second[2]
    back, squared = np.full(len(bx), np.inf), np.empty(len(bx))
    there = 0.0
    for i in range(len(ax)):
        for j in range(len(bx)):
            dx, dy, dz = ax[i] - bx[j], ay[i] - by[j], az[i] - bz[j]
            squared[j] = dx * dx + dy * dy + dz * dz
        nearest = np.inf
        for j in range(len(bx)):
            back[j] = min(back[j], squared[j])
            nearest = min(nearest, squared[j])
        there += math.sqrt(nearest)
    return (there / len(ax) + np.sqrt(back).sum() / len(bx)) / 2.0


@njit(cache=True, fastmath=_NO_NAN)
def _mean_distance_to_box(line: FloatArray, box: FloatArray) -> float:
    """Return the mean distance in the plane of points (3, P) from a box (x0, y0, x1, y1)."""
    x, y = line[0], line[1]
    total = 0.0
    for i in range(len(x)):
        dx = max(max(box[0] - x[i], x[i] - box[2]), 0.0)
        dy = max(max(box[1] - y[i], y[i] - box[3]), 0.0)
        total += math.sqrt(dx * dx + dy * dy)
    return total / len(x)


@njit(cache=True)
def _boxes(points: FloatArray, offsets: IntArray) -> FloatArray:
    """Return the boxes (x0, y0, x1, y1) of lines in the plane, zeros without points. (N, 4)"""
    boxes = np.zeros((len(offsets) - 1, 4))
    for i in range(len(boxes)):
        x, y = points[0, offsets[i] : offsets[i + 1]], points[1, offsets[i] : offsets[i + 1]]
        if len(x):
            boxes[i] = x.min(), y.min(), x.max(), y.max()
    return boxes


@njit(cache=True)
def beside_a_segment(points: FloatArray, line: FloatArray, half_width_m: float) -> bool:
    """Whether a point (3, P) projects into a segment of a line (3, Q) at most so far aside."""
    px, py, lx, ly = points[0], points[1], line[0], line[1]
    width_sq = half_width_m * half_width_m * _BOUND_SLACK
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
def pair_distances(pred: Lines, gt: Lines, max_distance: float) -> FloatArray:
    """Return the Chamfer distances in metres between lines of the same class. (N, K + 1)

    Pairs farther apart than ``max_distance``, lines of no length and the last column are infinite.
    No point of a line is nearer than the other's bounding box in the plane, which bounds the
    distance from below; few pairs are left to compute in full.
    """
    (pred_points, pred_off, pred_labels), (gt_points, gt_off, gt_labels) = pred, gt
    pred_boxes, gt_boxes = _boxes(pred_points, pred_off), _boxes(gt_points, gt_off)
    has_length = (gt_boxes[:, 0] < gt_boxes[:, 2]) | (gt_boxes[:, 1] < gt_boxes[:, 3])
    distances = np.full((len(pred_labels), len(gt_labels) + 1), np.inf)
    for i in range(len(pred_labels)):
        box = pred_boxes[i]
        if box[0] == box[2] and box[1] == box[3]:
            continue
        a = np.ascontiguousarray(pred_points[:, pred_off[i] : pred_off[i + 1]])
        for k in range(len(gt_labels)):
            if pred_labels[i] != gt_labels[k] or not has_length[k]:
                continue
            b = np.ascontiguousarray(gt_points[:, gt_off[k] : gt_off[k + 1]])
            bound = _mean_distance_to_box(a, gt_boxes[k]) + _mean_distance_to_box(b, box)
            if bound / 2.0 * _BOUND_SLACK <= max_distance:
                distance = chamfer_distance(a, b)
                if distance <= max_distance:
                    distances[i, k] = distance
    return distances
