"""Compiled inner loops of AP_raster; ``raster_ap`` is their only user.

A mask is stored as the crop that holds it: bytes 0 or 1, one crop after another in one flat array.
"""

import numpy as np
from numba import njit

from gsmap.evaluation.elements import BoolArray, FloatArray, IntArray
from gsmap.evaluation.raster_drawing import ByteArray

_COCO_SLACK = 1.0 - 1e-10  # COCO lowers a threshold of 1, so that equal masks match


@njit(cache=True)
def areas(masks: ByteArray, boxes: IntArray, starts: IntArray) -> IntArray:
    """Count the pixels of each mask. (N,)"""
    counts = np.zeros(len(boxes), dtype=np.int64)
    for i in range(len(boxes)):
        total = 0
        for value in masks[starts[i] : starts[i] + boxes[i, 2] * boxes[i, 3]]:
            total += value
        counts[i] = total
    return counts


@njit(cache=True)
def _intersection(
    masks_a: ByteArray,
    box_a: IntArray,
    start_a: int,
    masks_b: ByteArray,
    box_b: IntArray,
    start_b: int,
) -> int:
    """Count the pixels that two masks share."""
    top, bottom = max(box_a[0], box_b[0]), min(box_a[0] + box_a[2], box_b[0] + box_b[2])
    left, right = max(box_a[1], box_b[1]), min(box_a[1] + box_a[3], box_b[1] + box_b[3])
    if top >= bottom or left >= right:
        return 0
    total = 0
    for row in range(top, bottom):
        a = start_a + (row - box_a[0]) * box_a[3] - box_a[1]
        b = start_b + (row - box_b[0]) * box_b[3] - box_b[1]
        line_a, line_b = masks_a[a + left : a + right], masks_b[b + left : b + right]
        shared = np.uint32(0)
        for x in range(len(line_a)):
            shared += np.uint32(line_a[x] & line_b[x])
        total += shared
    return total


@njit(cache=True)
def mask_ious(
    pred: tuple[ByteArray, IntArray, IntArray, IntArray],
    gt: tuple[ByteArray, IntArray, IntArray, IntArray],
) -> FloatArray:
    """Return the IoU of each prediction with each ground truth of its class, 0 elsewhere.

    Args:
        pred: Masks, boxes, starts and labels of N predictions.
        gt: The same of K ground truths.

    Returns:
        IoU. (N, K)
    """
    p_masks, p_boxes, p_starts, p_labels = pred
    g_masks, g_boxes, g_starts, g_labels = gt
    p_areas, g_areas = areas(p_masks, p_boxes, p_starts), areas(g_masks, g_boxes, g_starts)
    ious = np.zeros((len(p_labels), len(g_labels)))
    for i in range(len(p_labels)):
        for k in range(len(g_labels)):
            if p_labels[i] == g_labels[k]:
                shared = _intersection(
                    p_masks, p_boxes[i], p_starts[i], g_masks, g_boxes[k], g_starts[k]
                )
                if shared:
                    ious[i, k] = shared / (p_areas[i] + g_areas[k] - shared)
    return ious


@njit(cache=True)
def assign(
    ious: FloatArray,
    pred_labels: IntArray,
    gt_labels: IntArray,
    thresholds: FloatArray,
) -> IntArray:
    """Match greedily as COCO: take the best free ground truth, the later one of equals.

    Args:
        ious: IoU, predictions in descending order of score. (N, K)
        pred_labels: Class of each prediction. (N,)
        gt_labels: Class of each ground truth. (K,)
        thresholds: Smallest IoU of a match, inclusive, for each class. (C, T)

    Returns:
        The matched ground truth, or -1. (N, T)
    """
    n, k_total = ious.shape
    num_thresholds = thresholds.shape[1]
    matched = np.full((n, num_thresholds), -1, dtype=np.int64)
    for t in range(num_thresholds):
        taken = np.zeros(k_total, dtype=np.bool_)
        for i in range(n):
            best = min(thresholds[pred_labels[i], t], _COCO_SLACK)
            match = -1
            for k in range(k_total):
                if pred_labels[i] == gt_labels[k] and not taken[k] and ious[i, k] >= best:
                    best, match = ious[i, k], k
            if match >= 0:
                taken[match] = True
                matched[i, t] = match
    return matched


@njit(cache=True)
def _paint(
    canvas: ByteArray,
    masks: ByteArray,
    boxes: IntArray,
    starts: IntArray,
    which: BoolArray,
    bit: int,
) -> None:
    """Set a bit of the canvas wherever one of the masks is set."""
    value = np.uint8(bit)
    for i in range(len(boxes)):
        if not which[i]:
            continue
        top, left, height, width = boxes[i]
        for row in range(height):
            line_out = canvas[top + row, left : left + width]
            start = starts[i] + row * width
            line_in = masks[start : start + width]
            for x in range(width):
                line_out[x] |= line_in[x] * value


@njit(cache=True)
def union_areas(
    pred: tuple[ByteArray, IntArray, IntArray, IntArray],
    gt: tuple[ByteArray, IntArray, IntArray, IntArray],
    num_classes: int,
    height: int,
    width: int,
) -> IntArray:
    """Compare all predictions of a class together with all its ground truths.

    Args:
        pred: Masks, boxes, starts and labels of N predictions.
        gt: The same of K ground truths.
        num_classes: Number of classes C.
        height: Rows of the canvas.
        width: Columns of the canvas.

    Returns:
        Pixels in the intersection and in the union. (C, 2)
    """
    counts = np.zeros((num_classes, 2), dtype=np.int64)
    canvas = np.zeros((height, width), dtype=np.uint8)
    for c in range(num_classes):
        p_which, g_which = pred[3] == c, gt[3] == c
        top, bottom = height, 0
        for boxes, which in ((pred[1], p_which), (gt[1], g_which)):
            for i in range(len(boxes)):
                if which[i] and boxes[i, 2]:
                    top = min(top, boxes[i, 0])
                    bottom = max(bottom, boxes[i, 0] + boxes[i, 2])
        if top >= bottom:
            continue
        canvas[top:bottom] = 0
        _paint(canvas, pred[0], pred[1], pred[2], p_which, 1)
        _paint(canvas, gt[0], gt[1], gt[2], g_which, 2)
        both, either = 0, 0
        for value in canvas[top:bottom].ravel():
            both += value == 3
            either += value != 0
        counts[c, 0], counts[c, 1] = both, either
    return counts
