"""Compiled drawing and comparison of dilated lines and polygons.

The kernels draw the same pixels as OpenCV 4.8 to 4.10 (8-connected lines of one pixel, even-odd
fill), with which the reference results were computed. Other versions of OpenCV fill different
pixels along the outline of a polygon, enough to change AP in the third digit. With these kernels,
results do not depend on the installed version.

A mask stores 64 pixels of a row in a word: bit b of word w is column 64 w + b.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - reports that kernels are compiled
from gsmap.structures.elements import BoolArray, FloatArray, IntArray

WordArray = npt.NDArray[np.uint64]

_ALL_BITS = np.uint64(0xFFFFFFFFFFFFFFFF)
_PER_PIXEL = 65536  # crossings of a row are integers in units of 1 / 65536 pixel


@njit(cache=True)
def _stamp(mask: WordArray, width: int, row: int, left: int, right: int, radius: int) -> None:
    """Set the pixels ``left`` to ``right`` of a row, dilated by a square and cut to the mask."""
    low = max(left - radius, 0)
    high = min(right + radius, width - 1)
    # A word has 64 columns: column >> 6 is the word of a column, and column & 63 is its bit.
    first = low >> 6
    last = high >> 6
    head = _ALL_BITS << np.uint64(low & 63)  # bits of the first word from column `low` on
    tail = _ALL_BITS >> np.uint64(63 - (high & 63))  # bits of the last word up to column `high`
    for y in range(max(row - radius, 0), min(row + radius + 1, mask.shape[0])):
        if first == last:
            mask[y, first] |= head & tail
        else:
            mask[y, first] |= head
            for word in range(first + 1, last):
                mask[y, word] = _ALL_BITS
            mask[y, last] |= tail


@njit(cache=True)
def _side(value: int, limit: int) -> int:
    """Return -1 for a value below 0, 1 for a value above the limit, and 0 otherwise."""
    if value < 0:
        return -1
    return 1 if value > limit else 0


@njit(cache=True)
def _clip_segment(a: IntArray, b: IntArray, height: int, width: int) -> bool:
    """Clip a segment to the mask in place, and return whether a part of it is inside.

    Rows are clipped before columns; each new coordinate is truncated to an integer.

    Args:
        a: Column and row of the first end. (2,)
        b: Column and row of the second end. (2,)
        height: Number of rows of the mask.
        width: Number of columns of the mask.
    """
    for axis in (1, 0):
        limit = (width if axis == 0 else height) - 1
        other = 1 - axis
        other_limit = (width if other == 0 else height) - 1
        beyond_a = _side(a[axis], limit=limit)
        beyond_b = _side(b[axis], limit=limit)
        if beyond_a * beyond_b > 0:  # both ends are beyond one border
            return False
        # Along the other axis, too, both ends may be beyond one border.
        if _side(a[other], limit=other_limit) * _side(b[other], limit=other_limit) > 0:
            return False
        for end, beyond in ((a, beyond_a), (b, beyond_b)):
            if beyond:
                # Move the end along the segment to the border.
                border = 0 if beyond < 0 else limit
                along = float(border - end[axis]) * (b[other] - a[other])
                end[other] += int(along / (b[axis] - a[axis]))
                end[axis] = border
    return True


@njit(cache=True)
def _draw_segment(mask: WordArray, width: int, start: IntArray, end: IntArray, radius: int) -> None:
    """Draw a dilated 8-connected segment between two points (column, row) inside the mask.

    Bresenham's algorithm steps along the longer axis. The pixels of each row are set together.
    """
    if end[0] < start[0]:
        start, end = end, start  # from left to right
    dx = end[0] - start[0]
    dy = abs(end[1] - start[1])
    row_step = 1 if end[1] >= start[1] else -1
    x = start[0]
    y = start[1]
    is_steep = dy > dx
    major = max(dx, dy)
    minor = min(dx, dy)
    # Below 0 if the pixel after a step along the longer axis alone would lie more than half a pixel
    # beside the segment.
    error = major - 2 * minor
    left = x  # first pixel of the current row
    for _ in range(major):
        steps_aside = error < 0  # this step goes along the shorter axis, too
        error -= 2 * minor
        if steps_aside:
            error += 2 * major
        changes_row = is_steep or steps_aside
        changes_column = not is_steep or steps_aside
        if changes_row:
            _stamp(mask, width, row=y, left=left, right=x, radius=radius)
            y += row_step
        if changes_column:
            x += 1
        if changes_row:
            left = x
    _stamp(mask, width, row=y, left=left, right=x, radius=radius)


@njit(cache=True)
def _fill(
    mask: WordArray, width: int, corners: IntArray, edges: IntArray, cut: BoolArray, radius: int
) -> None:
    """Fill the inside of a polygon by the even-odd rule, dilated.

    In row y, pixels are filled between the crossings of the edges that span [y, y + 1). Crossings
    are rounded to the nearest pixel, or down for edges that leave the mask.

    Args:
        mask: Mask to draw to. (H, words)
        width: Number of columns W of the mask.
        corners: Column and row of each corner. (P, 2)
        edges: Two points that define the slope of each edge: its ends, or its crossings with the
            border of the mask. (P, 2, 2)
        cut: Whether each edge leaves the mask. (P,)
        radius: Number of pixels that each pixel is dilated by.
    """
    num_edges = len(corners)
    height = mask.shape[0]
    x_start = np.zeros(num_edges, dtype=np.int64)
    slope = np.zeros(num_edges, dtype=np.int64)  # columns per row, in units of 1 / 65536 pixel
    # First row of each edge, and the row after its last one. Horizontal edges keep 0 and 0, so they
    # cross no row.
    low = np.zeros(num_edges, dtype=np.int64)
    high = np.zeros(num_edges, dtype=np.int64)
    for i in range(num_edges):
        a = corners[i]
        b = corners[(i + 1) % num_edges]
        if a[1] != b[1]:
            first = edges[i, 0]
            last = edges[i, 1]
            # Equal to the integer division of C, which truncates: numbers up to 2^37 are so small
            # that their quotient in float64 never rounds up to the next integer.
            slope[i] = int((last[0] - first[0]) * _PER_PIXEL / (last[1] - first[1]))
            low[i] = min(a[1], b[1])
            high[i] = max(a[1], b[1])
            upper = first if a[1] < b[1] else last  # the point of the edge in the smaller row
            x_start[i] = upper[0] * _PER_PIXEL + (low[i] - upper[1]) * slope[i]  # in row low[i]
            if not cut[i]:
                x_start[i] += _PER_PIXEL // 2  # the division below then rounds to nearest
    crossings = np.zeros(num_edges, dtype=np.int64)
    for row in range(max(0, low.min()), min(height, high.max())):
        count = 0
        for i in range(num_edges):
            if low[i] <= row < high[i]:
                crossings[count] = x_start[i] + (row - low[i]) * slope[i]
                count += 1
        crossings[:count].sort()
        # Even-odd rule: the inside lies between crossings 0 and 1, 2 and 3, and so on.
        for i in range(0, count - 1, 2):
            left = max(0, crossings[i] // _PER_PIXEL)
            right = min(width - 1, crossings[i + 1] // _PER_PIXEL)
            if left <= right:
                _stamp(mask, width, row=row, left=left, right=right, radius=radius)


@njit(cache=True)
def draw(
    pixels: IntArray, offsets: IntArray, filled: BoolArray, size: tuple[int, int], radius: int
) -> WordArray:
    """Draw and dilate elements, each to a separate mask.

    Args:
        pixels: Column and row of the points of all elements. (M, 2)
        offsets: Element i has the points ``offsets[i]:offsets[i + 1]``. (N + 1,)
        filled: Whether each element is a polygon to fill. (N,)
        size: Rows H and columns W of a mask.
        radius: Number of pixels that each pixel is dilated by, in all directions. A pixel becomes a
            square with a side of 2 * radius + 1 pixels.

    Returns:
        Masks. (N, H, words), words = ceil(W / 64)
    """
    height, width = size
    num_words = (width + 63) // 64
    masks = np.zeros((len(filled), height, num_words), dtype=np.uint64)
    for i in range(len(masks)):
        corners = pixels[offsets[i] : offsets[i + 1]]
        num_edges = len(corners) if filled[i] else len(corners) - 1  # a polygon is closed
        # A line without points has -1 edges.
        edges = np.zeros((max(num_edges, 0), 2, 2), dtype=np.int64)
        cut = np.zeros(len(edges), dtype=np.bool_)
        for j in range(len(edges)):
            start = corners[j]
            end = corners[(j + 1) % len(corners)]
            edges[j, 0] = start
            edges[j, 1] = end
            for point in edges[j]:
                cut[j] |= _side(point[0], limit=width - 1) != 0
                cut[j] |= _side(point[1], limit=height - 1) != 0
            if not cut[j] or _clip_segment(edges[j, 0], edges[j, 1], height=height, width=width):
                _draw_segment(masks[i], width, start=edges[j, 0], end=edges[j, 1], radius=radius)
            if edges[j, 0, 1] == edges[j, 1, 1]:
                # A clipped edge within one row has no slope: `_fill` uses the slope of the whole
                # edge.
                edges[j, 0] = start
                edges[j, 1] = end
        if filled[i] and len(corners):
            _fill(masks[i], width, corners=corners, edges=edges, cut=cut, radius=radius)
    return masks


@njit(cache=True)
def _count(word: int) -> int:
    """Count the bits of a word; compilers replace this pattern by one instruction."""
    # Sums in groups of 2, 4 and 8 bits. The product adds the eight bytes in its highest byte.
    pairs = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    fours = (pairs & np.uint64(0x3333333333333333)) + (
        (pairs >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    bytes_ = (fours + (fours >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(np.int64((bytes_ * np.uint64(0x0101010101010101)) >> np.uint64(56)))


@njit(cache=True)
def _count_shared(first: WordArray, second: WordArray) -> int:
    """Count the pixels that are set in both masks."""
    a = first.ravel()  # the compiler vectorises one long loop
    b = second.ravel()
    total = 0
    for word in range(len(a)):
        total += _count(a[word] & b[word])
    return total


@njit(cache=True)
def mask_ious(
    preds: WordArray, gts: WordArray, pred_labels: IntArray, gt_labels: IntArray
) -> FloatArray:
    """Compute the IoU of each prediction with each ground truth of its class.

    Args:
        preds: Masks of the predictions. (N, H, words)
        gts: Masks of the ground truths. (K, H, words)
        pred_labels: Classes of the predictions. (N,)
        gt_labels: Classes of the ground truths. (K,)

    Returns:
        IoU in [0, 1]; 0 for pairs of different classes. (N, K)
    """
    ious = np.zeros((len(preds), len(gts)))
    # A mask shares all of its pixels with itself, so these are areas in pixels.
    gt_areas = [_count_shared(gts[k], gts[k]) for k in range(len(gts))]
    for i in range(len(preds)):
        area = _count_shared(preds[i], preds[i])
        for k in range(len(gts)):
            if pred_labels[i] == gt_labels[k]:
                shared = _count_shared(preds[i], gts[k])
                # The limit avoids a division by 0 if both masks are empty (outside of the canvas).
                ious[i, k] = shared / max(area + gt_areas[k] - shared, 1)
    return ious


@njit(cache=True)
def _unite(masks: WordArray, chosen: BoolArray, union: WordArray) -> int:
    """Write the union of the chosen masks to ``union``, and return their number."""
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
    """Compute the IoU of the united predictions of each class with its united ground truths.

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
    pred_union = np.zeros(preds.shape[1:], dtype=np.uint64)
    gt_union = np.zeros(gts.shape[1:], dtype=np.uint64)
    for label in range(num_classes):
        num_preds = _unite(preds, chosen=pred_labels == label, union=pred_union)
        num_gts = _unite(gts, chosen=gt_labels == label, union=gt_union)
        if num_preds + num_gts > 0:
            shared = _count_shared(pred_union, gt_union)
            pred_area = _count_shared(pred_union, pred_union)
            gt_area = _count_shared(gt_union, gt_union)
            ious[label] = shared / max(pred_area + gt_area - shared, 1)  # 0 if both are empty
    return ious
