# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernels (numba): the raster loss on the pixels that matter.

One thread works on one instance at a time. Where neither mask has anything within SSIM's window,
SSIM is exactly 1 and the L1 term exactly 0, so every step runs, row by row, from the first to the
last column that can differ: from the masks' own columns, grown by the window's radius for each
blur. The window is separable, and the row pass takes symmetric taps together.

Nothing is kept for the backward pass but the two masks: the five blurred maps (p, t, p^2, t^2, p t)
are built again, turned into the derivatives of SSIM by the blurred p, p^2 and p t, and blurred once
more (the window is symmetric, so the blur is its own transpose). Sums run in a fixed order in one
thread, so two runs give the same bits.
"""

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, run_in_threads
from gsmap.ops.raster_loss.reference import SEEN, SSIM_C1, SSIM_C2

ONE, TWO = np.float32(1), np.float32(2)
C1, C2 = np.float32(SSIM_C1), np.float32(SSIM_C2)
SEEN_FLOAT32 = np.float32(SEEN)


@njit(nogil=True, cache=True)
def _find_spans(preds, targets, spans):
    """Write each row's first and one past the last column where a mask is not 0. (H, 2)"""
    height, width = preds.shape
    for row in range(height):
        left, right = 0, width
        while left < width and preds[row, left] == 0 and targets[row, left] == 0:
            left += 1
        while right > left and preds[row, right - 1] == 0 and targets[row, right - 1] == 0:
            right -= 1
        spans[row, 0], spans[row, 1] = left, right


@njit(nogil=True, cache=True)
def _grow_spans(spans, radius, width, grown):
    """Write the columns that a window of a radius carries each row's span to. (H, 2)"""
    for row in range(len(spans)):
        left, right = width, 0
        for other in range(max(row - radius, 0), min(row + radius + 1, len(spans))):
            if spans[other, 0] < spans[other, 1]:
                left, right = min(left, spans[other, 0]), max(right, spans[other, 1])
        grown[row, 0] = max(left - radius, 0)
        grown[row, 1] = max(min(right + radius, width), grown[row, 0])


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _add_scaled(out, source, factor):
    """Add ``factor * source`` to ``out``."""
    for k in range(len(out)):
        out[k] += factor * source[k]


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _add_scaled_pair(out, first, second, factor):
    """Add ``factor * (first + second)`` to ``out``."""
    for k in range(len(out)):
        out[k] += factor * (first[k] + second[k])


@njit(nogil=True, cache=True)
def _blur(images, spans, window, padded, rows, out, out_spans):
    """Filter images (C, H, W) that are 0 outside ``spans``; fill ``out`` inside ``out_spans``."""
    radius = len(window) // 2
    height, width = images.shape[1:]
    for row in range(height):
        left, right = spans[row]
        if left >= right:
            continue
        low, high = max(left - radius, 0), min(right + radius, width)
        size = high - low
        for c in range(len(images)):
            padded[: right - left + 4 * radius] = 0  # starts at column left - 2 radius
            padded[2 * radius : 2 * radius + right - left] = images[c, row, left:right]
            start = low - left + radius  # of the window's first tap at column low
            line = rows[c, row, low:high]
            line[:] = 0
            for k in range(radius):
                far = start + 2 * radius - k
                first, second = padded[start + k : start + k + size], padded[far : far + size]
                _add_scaled_pair(line, first, second, window[k])
            _add_scaled(line, padded[start + radius : start + radius + size], window[radius])
    for row in range(height):
        out[:, row, out_spans[row, 0] : out_spans[row, 1]] = 0
        for k in range(len(window)):
            other = row + k - radius
            if other < 0 or other >= height or spans[other, 0] >= spans[other, 1]:
                continue
            low, high = max(spans[other, 0] - radius, 0), min(spans[other, 1] + radius, width)
            for c in range(len(images)):
                _add_scaled(out[c, row, low:high], rows[c, other, low:high], window[k])


@njit(inline="always")
def _ssim_terms(maps, row, col):
    """Return the blurred p and t and SSIM's two numerators and two denominators at a pixel."""
    p, t = maps[0, row, col], maps[1, row, col]
    top_mean = TWO * p * t + C1
    top_cov = TWO * (maps[4, row, col] - p * t) + C2
    low_mean = p * p + t * t + C1
    low_var = (maps[2, row, col] - p * p) + (maps[3, row, col] - t * t) + C2
    return p, t, top_mean, top_cov, low_mean, low_var


@njit(nogil=True, cache=True)
def _dissimilarity(maps, spans):
    """Return the sum of 1 - SSIM, and on how many pixels the window sees the target, or either."""
    total, target, either = 0.0, 0.0, 0.0
    for row in range(len(spans)):
        for col in range(spans[row, 0], spans[row, 1]):
            p, t, top_mean, top_cov, low_mean, low_var = _ssim_terms(maps, row, col)
            total += ONE - (top_mean * top_cov) / (low_mean * low_var)
            target += 1.0 if t > 0 else 0.0
            either += 1.0 if max(p, t) > SEEN_FLOAT32 else 0.0
    return total, target, either


@njit(nogil=True, cache=True)
def _derivatives(maps, spans, out):
    """Fill SSIM's derivatives by the blurred p, p^2 and p t inside the spans. (3, H, W)"""
    for row in range(len(spans)):
        for col in range(spans[row, 0], spans[row, 1]):
            p, t, top_mean, top_cov, low_mean, low_var = _ssim_terms(maps, row, col)
            scale = ONE / (low_mean * low_var)
            ssim = top_mean * top_cov * scale
            out[0, row, col] = TWO * t * (top_cov - top_mean) * scale + TWO * p * ssim * (
                ONE / low_var - ONE / low_mean
            )
            out[1, row, col] = -ssim / low_var
            out[2, row, col] = TWO * top_mean * scale


@njit(nogil=True, cache=True)
def _weighted_masses(preds, targets, spans, weight):
    """Return sum w |p - t|, sum w p, sum w t and sum (w - 1) over an instance."""
    l1, predicted, foreground, excess = 0.0, 0.0, 0.0, 0.0
    for row in range(len(spans)):
        for col in range(spans[row, 0], spans[row, 1]):
            p, t = preds[row, col], targets[row, col]
            extra = (weight - ONE) * t
            l1 += (ONE + extra) * abs(p - t)
            predicted += (ONE + extra) * p
            foreground += (ONE + extra) * t
            excess += extra
    return l1, predicted, foreground, excess


@njit(nogil=True, cache=True)
def _buffers(shape, radius):
    """Return a thread's scratch: products, row pass, blurred maps, padded row, three spans."""
    images = np.empty((3, 5, shape[0], shape[1]), np.float32)
    padded = np.empty(shape[1] + 4 * radius, np.float32)
    return images[0], images[1], images[2], padded, np.empty((3, shape[0], 2), np.int64)


@njit(nogil=True, cache=True)
def _blur_products(preds, targets, window, buffers):
    """Fill an instance's spans and the blurred p, t, p^2, t^2 and p t inside the second."""
    products, rows, maps, padded, spans = buffers
    radius = len(window) // 2
    _find_spans(preds, targets, spans[0])
    _grow_spans(spans[0], radius, preds.shape[1], spans[1])
    _grow_spans(spans[1], radius, preds.shape[1], spans[2])
    for row in range(len(preds)):
        for col in range(spans[0, row, 0], spans[0, row, 1]):
            p, t = preds[row, col], targets[row, col]
            products[0, row, col], products[1, row, col] = p, t
            products[2, row, col], products[3, row, col] = p * p, t * t
            products[4, row, col] = p * t
    _blur(products, spans[0], window, padded, rows, maps, spans[1])


@njit(nogil=True, cache=True)
def loss_forward(preds, targets, window, weight, results, first, last):
    """Write some instances' sums, those of `raster_loss_sums_reference`, float64 (n, 7).

    Masks (n, H, W), the window (size,) and the weight are float32.
    """
    buffers = _buffers(preds.shape[1:], len(window) // 2)
    _, _, maps, _, spans = buffers
    for n in range(first, last):
        _blur_products(preds[n], targets[n], window, buffers)
        masses = _weighted_masses(preds[n], targets[n], spans[0], weight)
        results[n, 0], results[n, 1], results[n, 3], results[n, 4] = masses
        results[n, 2], results[n, 5], results[n, 6] = _dissimilarity(maps, spans[1])


@njit(nogil=True, cache=True)
def loss_backward(preds, targets, window, weight, factors, grads, first, last):
    """Write the gradient (n, H, W) of the first three sums, each times its factor (n, 3)."""
    buffers = _buffers(preds.shape[1:], len(window) // 2)
    slopes, rows, maps, padded, spans = buffers
    for n in range(first, last):
        grads[n] = factors[n, 1]  # outside the spans w is 1, and nothing else depends on p
        _blur_products(preds[n], targets[n], window, buffers)
        _derivatives(maps, spans[1], slopes[:3])
        _blur(slopes[:3], spans[1], window, padded, rows, maps[:3], spans[2])
        for row in range(preds.shape[1]):
            for col in range(spans[2, row, 0], spans[2, row, 1]):
                p, t = preds[n, row, col], targets[n, row, col]
                slope = factors[n, 0] * np.sign(p - t) + factors[n, 1]
                ssim = maps[0, row, col] + TWO * p * maps[1, row, col] + t * maps[2, row, col]
                extra = (weight - ONE) * t
                grads[n, row, col] = (ONE + extra) * slope - factors[n, 2] * ssim


def raster_loss_sums(preds, targets, window, weight):
    """Return the sums of `raster_loss_sums_reference`; the first three are differentiable."""
    sums = torch.empty(len(preds), 7, dtype=torch.float64)
    pixels, weight = preds.shape[1:].numel(), np.float32(weight)
    run_in_threads(loss_forward, pixels, preds, targets, window, weight, sums)
    return sums.float()


def raster_loss_sums_backward(grads, preds, targets, window, weight):
    """Return the gradient in the predictions. (n, H, W)"""
    gradient = torch.empty(preds.shape, dtype=torch.float32)
    pixels, weight = preds.shape[1:].numel(), np.float32(weight)
    run_in_threads(loss_backward, pixels, preds, targets, window, weight, grads[:, :3], gradient)
    return (gradient,)
