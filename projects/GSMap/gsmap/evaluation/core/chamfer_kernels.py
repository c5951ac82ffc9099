"""Compiled inner loops of the Chamfer distance.

Coordinates are stored as three rows x, y and z, so that the loops vectorise. z is 0 for 2D lines.
"""

import math

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - reports that kernels are compiled
from gsmap.structures.elements import FloatArray, IntArray

Lines = tuple[FloatArray, IntArray, IntArray]
"""Points of N lines in metres (3, M), offsets of the lines (N + 1,), and labels (N,)."""
# Compiler flags: no value is NaN, and the sign of zero does not matter. Minima then vectorise,
# and sums still add in the written order.
_NO_NAN = {"nnan", "nsz"}
_BOUND_SLACK = 1.0 - 1e-12  # factor that makes a bound safe against rounding errors


# With numpy's error model, divisions are not checked for a divisor of 0.
@njit(cache=True, error_model="numpy")
def resample_lines(points: FloatArray, offsets: IntArray, num_points: int) -> FloatArray:
    """Resample lines at equal arc length in the plane.

    The results are equal to `gsmap.structures.polylines.resample_all`.

    Args:
        points: Vertices of all lines in metres. (M, D)
        offsets: Line i has the vertices ``offsets[i]:offsets[i + 1]``. (N + 1,)
        num_points: Number of points P of each result, >= 2.

    Returns:
        Coordinates in metres; z is 0 if D is 2. Zeros for a line without vertices. (3, N * P)
    """
    num_lines = len(offsets) - 1
    rows = np.zeros((3, num_lines * num_points))
    for i in range(num_lines):
        line = points[offsets[i] : offsets[i + 1]]
        if not len(line):
            continue
        along = np.zeros(len(line))  # arc length of each vertex
        for k in range(1, len(line)):
            dx = line[k, 0] - line[k - 1, 0]
            dy = line[k, 1] - line[k - 1, 1]
            along[k] = along[k - 1] + math.sqrt(dx * dx + dy * dy)
        step = along[-1] / (num_points - 1)
        k = 0  # the last vertex at or before the target
        for p in range(num_points):
            target = p * step if p < num_points - 1 else along[-1]  # arc length of point p
            while k + 1 < len(line) and along[k + 1] <= target:
                k += 1
            for axis in range(line.shape[1]):
                value = line[k, axis]
                if k + 1 < len(line) and along[k] != target:  # as `np.interp` computes it
                    slope = (line[k + 1, axis] - value) / (along[k + 1] - along[k])
                    value = slope * (target - along[k]) + value
                rows[axis, i * num_points + p] = value
    return rows


@njit(cache=True, fastmath=_NO_NAN)
def chamfer_distance(first: FloatArray, second: FloatArray) -> float:
    """Compute the Chamfer distance of two lines.

    It is the mean of two values: the mean distance of the points of each line from their nearest
    points of the other line.

    Args:
        first: Points in metres. (3, P)
        second: Points in metres. (3, Q)

    Returns:
        Distance in metres.
    """
    ax = first[0]
    ay = first[1]
    az = first[2]
    bx = second[0]
    by = second[1]
    bz = second[2]
    nearest_to_second = np.full(len(bx), np.inf)  # squared distances
    squared = np.empty(len(bx))
    first_sum = 0.0
    for i in range(len(ax)):
        for j in range(len(bx)):
            dx = ax[i] - bx[j]
            dy = ay[i] - by[j]
            dz = az[i] - bz[j]
            squared[j] = dx * dx + dy * dy + dz * dz
        # The minima are computed in a separate loop, so that both loops vectorise.
        nearest = np.inf
        for j in range(len(bx)):
            nearest_to_second[j] = min(nearest_to_second[j], squared[j])
            nearest = min(nearest, squared[j])
        first_sum += math.sqrt(nearest)
    first_mean = first_sum / len(ax)
    second_mean = np.sqrt(nearest_to_second).sum() / len(bx)
    return (first_mean + second_mean) / 2.0


@njit(cache=True, fastmath=_NO_NAN)
def _mean_distance_to_box(line: FloatArray, box: FloatArray) -> float:
    """Compute the mean distance of points (3, P) from a box (x0, y0, x1, y1), in the plane."""
    x = line[0]
    y = line[1]
    total = 0.0
    for i in range(len(x)):
        dx = max(max(box[0] - x[i], x[i] - box[2]), 0.0)
        dy = max(max(box[1] - y[i], y[i] - box[3]), 0.0)
        total += math.sqrt(dx * dx + dy * dy)
    return total / len(x)


@njit(cache=True)
def _boxes(points: FloatArray, offsets: IntArray) -> FloatArray:
    """Compute the boxes (x0, y0, x1, y1) of lines in the plane; zeros without points. (N, 4)"""
    boxes = np.zeros((len(offsets) - 1, 4))
    for i in range(len(boxes)):
        x = points[0, offsets[i] : offsets[i + 1]]
        y = points[1, offsets[i] : offsets[i + 1]]
        if len(x):
            boxes[i, 0] = x.min()
            boxes[i, 1] = y.min()
            boxes[i, 2] = x.max()
            boxes[i, 3] = y.max()
    return boxes


@njit(cache=True)
def beside_a_segment(points: FloatArray, line: FloatArray, half_width_m: float) -> bool:
    """Check whether at least one point projects onto a segment of a line and is close to it.

    A point that projects onto an end of a segment does not count for this segment.
    A point whose distance is ``half_width_m`` up to rounding errors does not count as close.

    Args:
        points: Points in metres; z is not used. (3, P)
        line: Vertices in metres; z is not used. (3, Q)
        half_width_m: Largest distance of a point from the segment, in metres.
    """
    px = points[0]
    py = points[1]
    lx = line[0]
    ly = line[1]
    width_sq = half_width_m * half_width_m * _BOUND_SLACK
    for i in range(len(px)):
        for j in range(len(lx) - 1):
            sx = lx[j + 1] - lx[j]
            sy = ly[j + 1] - ly[j]
            qx = px[i] - lx[j]
            qy = py[i] - ly[j]
            # `seg_sq` is the squared length of the segment. `along` and `across` are the distances
            # of the point from the start of the segment, along and across the segment, multiplied
            # by the length of the segment.
            seg_sq = sx * sx + sy * sy
            along = qx * sx + qy * sy
            if 0.0 < along < seg_sq:
                across = qx * sy - qy * sx
                if across * across < width_sq * seg_sq:
                    return True
    return False


@njit(cache=True)
def pair_distances(pred: Lines, gt: Lines, max_distance: float) -> FloatArray:
    """Compute the Chamfer distances between lines of equal class.

    If the nearest points of the other line are replaced by its bounding box in the plane, the
    result is a lower bound. Pairs whose bound exceeds ``max_distance`` are not computed in full.

    Args:
        pred: N predicted lines.
        gt: K annotated lines.
        max_distance: Largest distance in metres.

    Returns:
        Distances in metres; infinite beyond ``max_distance``, for different classes and for lines
        without length. The last column is infinite, so that each row has a minimum even if K is 0.
        (N, K + 1)
    """
    pred_points, pred_offsets, pred_labels = pred
    gt_points, gt_offsets, gt_labels = gt
    pred_boxes = _boxes(pred_points, pred_offsets)
    gt_boxes = _boxes(gt_points, gt_offsets)
    has_length = (gt_boxes[:, 0] < gt_boxes[:, 2]) | (gt_boxes[:, 1] < gt_boxes[:, 3])
    distances = np.full((len(pred_labels), len(gt_labels) + 1), np.inf)
    for i in range(len(pred_labels)):
        box = pred_boxes[i]
        if box[0] == box[2] and box[1] == box[3]:  # a line without length
            continue
        # Rows of a slice are not adjacent in memory. The copy makes them adjacent for the loops.
        pred_line = np.ascontiguousarray(pred_points[:, pred_offsets[i] : pred_offsets[i + 1]])
        for k in range(len(gt_labels)):
            if pred_labels[i] != gt_labels[k] or not has_length[k]:
                continue
            gt_line = np.ascontiguousarray(gt_points[:, gt_offsets[k] : gt_offsets[k + 1]])
            from_pred = _mean_distance_to_box(pred_line, box=gt_boxes[k])
            from_gt = _mean_distance_to_box(gt_line, box=box)
            if (from_pred + from_gt) / 2.0 * _BOUND_SLACK <= max_distance:
                distance = chamfer_distance(pred_line, second=gt_line)
                if distance <= max_distance:
                    distances[i, k] = distance
    return distances
