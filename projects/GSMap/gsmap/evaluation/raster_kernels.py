"""Compiled comparison of masks; ``raster_ap`` is its only user."""

import numpy as np
from numba import njit

from gsmap.evaluation.raster_drawing import Masks, WordArray
from gsmap.structures.elements import FloatArray, IntArray


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
def _intersection(a: Masks, i: int, b: Masks, k: int) -> int:
    """Count the pixels that a mask shares with another."""
    a_top, a_left, a_rows, a_words = a.boxes[i]
    b_top, b_left, b_rows, b_words = b.boxes[k]
    total = 0
    for row in range(max(a_top, b_top), min(a_top + a_rows, b_top + b_rows)):
        of_a = a.starts[i] + (row - a_top) * a_words - a_left
        of_b = b.starts[k] + (row - b_top) * b_words - b_left
        for word in range(max(a_left, b_left), min(a_left + a_words, b_left + b_words)):
            total += _count(a.words[of_a + word] & b.words[of_b + word])
    return total


@njit(cache=True)
def mask_ious(pred: Masks, gt: Masks) -> FloatArray:
    """Return the IoU of each prediction with each ground truth of its class, 0 elsewhere. (N, K)"""
    ious = np.zeros((len(pred.labels), len(gt.labels)))
    gt_areas = [_intersection(gt, k, gt, k) for k in range(len(gt.labels))]
    for i in range(len(pred.labels)):
        area = _intersection(pred, i, pred, i)
        for k in range(len(gt.labels)):
            if pred.labels[i] == gt.labels[k]:
                shared = _intersection(pred, i, gt, k)
                if shared:
                    ious[i, k] = shared / (area + gt_areas[k] - shared)
    return ious


@njit(cache=True)
def _union(masks: Masks, label: int, height: int, words: int) -> WordArray:
    """Join the masks of a class on one canvas. (height, words)"""
    canvas = np.zeros((height, words), np.uint64)
    for i in np.flatnonzero(masks.labels == label):
        top, left, num_rows, num_words = masks.boxes[i]
        for row in range(num_rows):
            start = masks.starts[i] + row * num_words
            for word in range(num_words):
                canvas[top + row, left + word] |= masks.words[start + word]
    return canvas


@njit(cache=True)
def class_ious(pred: Masks, gt: Masks, num_classes: int, height: int, width: int) -> FloatArray:
    """Return the IoU of all predictions of a class together with all its ground truths. (C,)

    It is NaN for a class with neither; ``height`` and ``width`` are those of the canvas.
    """
    ious = np.full(num_classes, np.nan)
    words = (width + 63) // 64
    for c in range(num_classes):
        if (pred.labels == c).any() or (gt.labels == c).any():
            predicted, true = _union(pred, c, height, words), _union(gt, c, height, words)
            shared, union = 0, 0
            for row in range(height):
                for word in range(words):
                    shared += _count(predicted[row, word] & true[row, word])
                    union += _count(predicted[row, word] | true[row, word])
            ious[c] = shared / max(union, 1)
    return ious
