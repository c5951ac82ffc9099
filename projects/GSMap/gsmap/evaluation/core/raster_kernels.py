"""Compiled drawing and comparison of dilated lines and polygons; ``raster_ap`` is the only user.

The pixels are those of OpenCV 4.8 to 4.10 (8-connected lines of one pixel, even-odd fill), with
which the reference figures were made. OpenCV before and after fills other pixels along the outline
of a polygon, enough to move an AP in the third digit; so the rule stands here, for every version.

A mask is the canvas with 64 pixels of a row to a word: bit b of word w is column 64 w + b.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.structures.elements import BoolArray, FloatArray, IntArray

WordArray = npt.NDArray[np.uint64]

_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_ONE = 65536  # crossings are in 1/65536 of a pixel


@njit(cache=True)
def _stamp(mask: WordArray, width: int, row: int, left: int, right: int, radius: int) -> None:
    """Set the pixels ``left`` to ``right`` of a row, dilated by a square, inside the mask."""
    low, high = max(left - radius, 0), min(right + radius, width - 1)
    first, last = low >> 6, high >> 6
    head, tail = _ALL << np.uint64(low & 63), _ALL >> np.uint64(63 - (high & 63))
    for y in range(max(row - radius, 0), min(row + radius + 1, mask.shape[0])):
        if first == last:
            mask[y, first] |= head & tail
        else:
            mask[y, first] |= head
            for word in range(first + 1, last):
                mask[y, word] = _ALL
            mask[y, last] |= tail


@njit(cache=True)
def _side(value: int, limit: int) -> int:
    """Return -1 below 0, 1 above the limit, 0 between."""
    return -1 if value < 0 else (1 if value > limit else 0)


@njit(cache=True)
def _clip_segment(a: IntArray, b: IntArray, height: int, width: int) -> bool:
    """Move the ends of a segment to where it meets the border, and say if it has a part inside.

    First the rows are brought inside, then the columns; each new coordinate is truncated.
    """
    for axis in (1, 0):
        limit = (width if axis == 0 else height) - 1
        other = 1 - axis
        other_limit = (width if other == 0 else height) - 1
        beyond_a, beyond_b = _side(a[axis], limit), _side(b[axis], limit)
        if beyond_a * beyond_b > 0:
            return False
        if _side(a[other], other_limit) * _side(b[other], other_limit) > 0:
            return False
        for end, beyond in ((a, beyond_a), (b, beyond_b)):
            if beyond:
                border = 0 if beyond < 0 else limit
                along = float(border - end[axis]) * (b[other] - a[other])
                end[other] += int(along / (b[axis] - a[axis]))
                end[axis] = border
    return _side(a[0], width - 1) == 0 and _side(b[0], width - 1) == 0


@njit(cache=True)
def _draw_segment(mask: WordArray, width: int, start: IntArray, end: IntArray, radius: int) -> None:
    """Draw an 8-connected segment between two points inside the mask, dilated."""
    if end[0] < start[0]:
        start, end = end, start
    dx, dy = end[0] - start[0], abs(end[1] - start[1])
    down = 1 if end[1] >= start[1] else -1
    x, y = start[0], start[1]
    steep = dy > dx
    major, minor = max(dx, dy), min(dx, dy)
    error = major - 2 * minor
    run = x  # first pixel of the row that is being drawn
    for _ in range(major):
        aside = error < 0
        error += (2 * major if aside else 0) - 2 * minor
        if steep or aside:
            _stamp(mask, width, y, run, x, radius)
            y += down
            x += 1 if (aside or not steep) else 0
            run = x
        else:
            x += 1
    _stamp(mask, width, y, run, x, radius)


@njit(cache=True)
def _fill(
    mask: WordArray, width: int, corners: IntArray, edges: IntArray, cut: BoolArray, radius: int
) -> None:
    """Fill the inside of a polygon by the even-odd rule, dilated.

    Row y holds the pixels between the crossings of the edges that span [y, y + 1), rounded to the
    nearest pixel; down for edges that leave the mask (``cut``). ``edges`` (P, 2, 2) are two points
    that fix each edge's slope: its ends, or where it meets the border of the mask.
    """
    num_edges, height = len(corners), mask.shape[0]
    x_start, slope = np.zeros(num_edges, np.int64), np.zeros(num_edges, np.int64)
    low, high = np.zeros(num_edges, np.int64), np.zeros(num_edges, np.int64)
    for i in range(num_edges):
        a, b = corners[i], corners[(i + 1) % num_edges]
        if a[1] != b[1]:
            first, last = edges[i, 0], edges[i, 1]
            # as C divides: no quotient of such numbers (2^37) rounds up to the next integer
            slope[i] = int((last[0] - first[0]) * _ONE / (last[1] - first[1]))
            low[i], high[i] = min(a[1], b[1]), max(a[1], b[1])
            upper = first if a[1] < b[1] else last
            x_start[i] = upper[0] * _ONE + (low[i] - upper[1]) * slope[i]
            x_start[i] += 0 if cut[i] else _ONE // 2
    crossings = np.zeros(num_edges, np.int64)
    for row in range(max(0, low.min()), min(height, high.max())):
        count = 0
        for i in range(num_edges):
            if low[i] <= row < high[i]:
                crossings[count] = x_start[i] + (row - low[i]) * slope[i]
                count += 1
        crossings[:count].sort()
        for i in range(0, count - 1, 2):
            left, right = max(0, crossings[i] // _ONE), min(width - 1, crossings[i + 1] // _ONE)
            if left <= right:
                _stamp(mask, width, row, left, right, radius)


@njit(cache=True)
def draw(
    pixels: IntArray, offsets: IntArray, filled: BoolArray, size: tuple[int, int], radius: int
) -> WordArray:
    """Draw and dilate elements, each on a canvas of its own. (N, H, words of W columns)

    Points are column and row (M, 2), of element i ``offsets[i]:offsets[i + 1]``; ``filled`` ones
    (N,) are polygons; ``size`` is H and W, ``radius`` half the dilating square, less the centre.
    """
    height, width = size
    masks = np.zeros((len(filled), height, (width + 63) // 64), np.uint64)
    for i in range(len(masks)):
        corners = pixels[offsets[i] : offsets[i + 1]]
        num_edges = len(corners) - (0 if filled[i] else 1)
        edges = np.zeros((max(num_edges, 0), 2, 2), np.int64)
        cut = np.zeros(len(edges), np.bool_)
        for j in range(len(edges)):
            edges[j, 0], edges[j, 1] = corners[j], corners[(j + 1) % len(corners)]
            for end in edges[j]:
                cut[j] |= _side(end[0], width - 1) != 0 or _side(end[1], height - 1) != 0
            if not cut[j] or _clip_segment(edges[j, 0], edges[j, 1], height, width):
                _draw_segment(masks[i], width, edges[j, 0], edges[j, 1], radius)
            if edges[j, 0, 1] == edges[j, 1, 1]:  # it says nothing about the slope
                edges[j, 0], edges[j, 1] = corners[j], corners[(j + 1) % len(corners)]
        if filled[i] and len(corners):
            _fill(masks[i], width, corners, edges, cut, radius)
    return masks


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
def _count_shared(first: WordArray, second: WordArray) -> int:
    """Count the pixels that two masks share."""
    a, b = first.ravel(), second.ravel()  # one long loop, which vectorises
    total = 0
    for word in range(len(a)):
        total += _count(a[word] & b[word])
    return total


@njit(cache=True)
def mask_ious(
    preds: WordArray, gts: WordArray, pred_labels: IntArray, gt_labels: IntArray
) -> FloatArray:
    """Return the IoU of each prediction with each ground truth of its class, 0 elsewhere. (N, K)"""
    ious = np.zeros((len(preds), len(gts)))
    gt_areas = [_count_shared(gts[k], gts[k]) for k in range(len(gts))]
    for i in range(len(preds)):
        area = _count_shared(preds[i], preds[i])
        for k in range(len(gts)):
            if pred_labels[i] == gt_labels[k]:
                shared = _count_shared(preds[i], gts[k])
                ious[i, k] = shared / max(area + gt_areas[k] - shared, 1)
    return ious


@njit(cache=True)
def _unite(masks: WordArray, chosen: BoolArray, union: WordArray) -> int:
    """Write the union of the chosen masks, and return how many are chosen."""
    union[:] = 0
    united = union.ravel()
    number = 0
    for i in range(len(masks)):
        if chosen[i]:
            number += 1
            mask = masks[i].ravel()
            for word in range(len(united)):
                united[word] |= mask[word]
    return number


@njit(cache=True)
def class_ious(
    preds: WordArray,
    gts: WordArray,
    pred_labels: IntArray,
    gt_labels: IntArray,
    num_classes: int,
) -> FloatArray:
    """IoU of the united predictions of each class with its united ground truths.

    Args:
        preds: Masks of the predictions. (N, H, words)
        gts: Masks of the ground truths. (K, H, words)
        pred_labels: Classes of the predictions, in [0, C). (N,)
        gt_labels: Classes of the ground truths, in [0, C). (K,)
        num_classes: The number C.

    Returns:
        IoU in [0, 1]; NaN for a class with neither predictions nor ground truths. (C,)
    """
    ious = np.full(num_classes, np.nan)
    pred_union = np.zeros(preds.shape[1:], np.uint64)
    gt_union = np.zeros(gts.shape[1:], np.uint64)
    for label in range(num_classes):
        num_preds = _unite(preds, pred_labels == label, pred_union)
        num_gts = _unite(gts, gt_labels == label, gt_union)
        if num_preds + num_gts > 0:
            shared = _count_shared(pred_union, gt_union)
            pred_area = _count_shared(pred_union, pred_union)
            gt_area = _count_shared(gt_union, gt_union)
            ious[label] = shared / max(pred_area + gt_area - shared, 1)
    return ious
