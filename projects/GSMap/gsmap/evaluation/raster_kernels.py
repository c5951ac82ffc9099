"""Compiled comparison of masks; ``raster_ap`` is its only user.

Masks are crops of packed pixels, as ``raster_drawing`` makes them.
"""

import numpy as np
from numba import njit

from gsmap.evaluation.raster_drawing import WordArray
from gsmap.structures.elements import BoolArray, FloatArray, IntArray

_COCO_SLACK = 1.0 - 1e-10  # COCO lowers a threshold of 1, so that equal masks match


@njit(cache=True)
def _count(word: int) -> int:
    """Count the bits of a word; compilers know this pattern and use one instruction."""
    pairs = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    fours = (pairs & np.uint64(0x3333333333333333)) + (
        (pairs >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    bytes_ = (fours + (fours >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(np.int64((bytes_ * np.uint64(0x0101010101010101)) >> np.uint64(56)))


@njit(cache=True)
def areas(masks: WordArray, boxes: IntArray, starts: IntArray) -> IntArray:
    """Count the pixels of each mask. (N,)"""
    counts = np.zeros(len(boxes), dtype=np.int64)
    for i in range(len(boxes)):
        for word in masks[starts[i] : starts[i + 1]]:
            counts[i] += _count(word)
    return counts


@njit(cache=True)
def _intersection(
    masks_a: WordArray,
    box_a: IntArray,
    start_a: int,
    masks_b: WordArray,
    box_b: IntArray,
    start_b: int,
) -> int:
    """Count the pixels that two masks share."""
    top, bottom = max(box_a[0], box_b[0]), min(box_a[0] + box_a[2], box_b[0] + box_b[2])
    left, right = max(box_a[1], box_b[1]), min(box_a[1] + box_a[3], box_b[1] + box_b[3])
    total = 0
    for row in range(top, bottom):
        a = start_a + (row - box_a[0]) * box_a[3] - box_a[1]
        b = start_b + (row - box_b[0]) * box_b[3] - box_b[1]
        for word in range(left, right):
            total += _count(masks_a[a + word] & masks_b[b + word])
    return total


@njit(cache=True)
def mask_ious(
    pred: tuple[WordArray, IntArray, IntArray, IntArray],
    gt: tuple[WordArray, IntArray, IntArray, IntArray],
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
def _union(
    masks: WordArray, boxes: IntArray, starts: IntArray, which: BoolArray, height: int, words: int
) -> WordArray:
    """Join some masks on one canvas. (height, words)"""
    canvas = np.zeros((height, words), dtype=np.uint64)
    for i in range(len(boxes)):
        if which[i]:
            top, left, num_rows, num_words = boxes[i]
            for row in range(num_rows):
                for word in range(num_words):
                    canvas[top + row, left + word] |= masks[starts[i] + row * num_words + word]
    return canvas


@njit(cache=True)
def union_areas(
    pred: tuple[WordArray, IntArray, IntArray, IntArray],
    gt: tuple[WordArray, IntArray, IntArray, IntArray],
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
    words = (width + 63) // 64
    for c in range(num_classes):
        predicted = _union(pred[0], pred[1], pred[2], pred[3] == c, height, words)
        true = _union(gt[0], gt[1], gt[2], gt[3] == c, height, words)
        for row in range(height):
            for word in range(words):
                counts[c, 0] += _count(predicted[row, word] & true[row, word])
                counts[c, 1] += _count(predicted[row, word] | true[row, word])
    return counts
