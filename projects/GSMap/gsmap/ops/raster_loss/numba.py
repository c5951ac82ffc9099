# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernels (numba): the raster loss on the pixels that matter.

One thread works on one instance at a time. Where neither mask has anything within SSIM's window,
SSIM is exactly 1 and the L1 term exactly 0, so every step runs, row by row, from the first to the
last column that can differ: from the masks' own columns, grown by the window's radius for each
blur. The window is separable and a row is blurred when it is needed, so no blurred map is kept.

Nothing is kept for the backward pass but the two masks: the four blurred maps (p, t, p^2 + t^2,
p t) are built again, turned into the derivatives of SSIM by the blurred p, p^2 and p t, and blurred
once more (the window is symmetric, so the blur is its own transpose). Sums run in a fixed order in
one thread, so two runs give the same bits.
"""

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, run_in_threads
from gsmap.ops.raster_loss.reference import SEEN, SSIM_C1, SSIM_C2

ONE, TWO = np.float32(1), np.float32(2)
C1, C2 = np.float32(SSIM_C1), np.float32(SSIM_C2)
SEEN_FLOAT32 = np.float32(SEEN)
TAPS = 6  # that are added at a time, without going back to memory


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _find_spans(preds, targets, radius, spans):
    """Write each row's first and one past the last column where a mask is not 0, (3, H, 2).

    The second and third spans are those that a window carries the ones before to.
    """
    height, width = preds.shape
    for row in range(height):
        left, right = np.int32(width), np.int32(0)
        for col in range(width):
            seen = (preds[row, col] != 0) | (targets[row, col] != 0)
            left = min(left, np.int32(col) if seen else np.int32(width))
            right = max(right, np.int32(col + 1) if seen else np.int32(0))
        spans[0, row, 0], spans[0, row, 1] = left, max(left, right)
    for step in range(2):
        for row in range(height):
            left, right = np.int32(width), np.int32(0)
            for other in range(max(row - radius, 0), min(row + radius + 1, height)):
                if spans[step, other, 0] < spans[step, other, 1]:
                    left = min(left, spans[step, other, 0])
                    right = max(right, spans[step, other, 1])
            left = max(left - radius, np.int32(0))
            spans[step + 1, row] = left, max(min(right + radius, np.int32(width)), left)


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _convolve(source, first, stride, window, out, size):
    """Write sum_j window[j] source[first + k + j stride] to ``out[k]`` for k < size."""
    s_1, s_2, s_3 = np.uint64(stride), np.uint64(2 * stride), np.uint64(3 * stride)
    s_4, s_5 = np.uint64(4 * stride), np.uint64(5 * stride)  # unsigned: an index is not wrapped
    out[:size] = 0
    for j in range(0, len(window), TAPS):
        w_0, w_1, w_2 = window[j], window[j + 1], window[j + 2]
        w_3, w_4, w_5 = window[j + 3], window[j + 4], window[j + 5]
        start = np.uint64(first + j * stride)
        for k in range(np.uint64(size)):
            i = start + k
            near = w_0 * source[i] + w_1 * source[i + s_1] + w_2 * source[i + s_2]
            far = w_3 * source[i + s_3] + w_4 * source[i + s_4] + w_5 * source[i + s_5]
            out[k] += near + far


@njit(nogil=True, cache=True)
def _blur_row(images, channels, row, span, window, line, out):
    """Filter a row's span of padded images (H + taps, (W + taps) channels); return its pixels."""
    pitch, pixels = images.shape[1], span[1] - span[0]
    first = row * pitch + span[0] * channels  # images start a radius early
    size = (pixels + len(window)) * channels
    _convolve(images.reshape(images.size), first, pitch, window, line, size)
    _convolve(line, 0, channels, window, out, pixels * channels)
    return pixels


@njit(inline="always")
def _ssim_terms(p, t, squares, product):
    """Return SSIM's numerators and denominators of the blurred p, t, p^2 + t^2 and p t."""
    means = p * p + t * t
    return TWO * p * t + C1, TWO * (product - p * t) + C2, means + C1, squares - means + C2


@njit(nogil=True, cache=True)
def _dissimilarity(maps, pixels):
    """Sum a row's 1 - SSIM, and count the pixels whose window sees the target, and either."""
    total, target, either = 0.0, 0.0, 0.0
    for k in range(pixels):
        p, t = maps[4 * k], maps[4 * k + 1]
        top_mean, top_cov, low_mean, low_var = _ssim_terms(p, t, maps[4 * k + 2], maps[4 * k + 3])
        total += ONE - (top_mean * top_cov) / (low_mean * low_var)
        target += 1.0 if t > 0 else 0.0
        either += 1.0 if max(p, t) > SEEN_FLOAT32 else 0.0
    return total, target, either


@njit(nogil=True, cache=True)
def _derivatives(maps, pixels, out):
    """Fill a row's derivatives of SSIM by the blurred p, p^2 and p t."""
    for k in range(pixels):
        p, t = maps[4 * k], maps[4 * k + 1]
        top_mean, top_cov, low_mean, low_var = _ssim_terms(p, t, maps[4 * k + 2], maps[4 * k + 3])
        scale = ONE / (low_mean * low_var)
        ssim = top_mean * top_cov * scale
        change = t * (top_cov - top_mean) + p * ssim * (low_mean - low_var)
        out[3 * k], out[3 * k + 1] = TWO * change * scale, -ssim * scale * low_mean
        out[3 * k + 2] = TWO * top_mean * scale


@njit(nogil=True, cache=True)
def _fill_products(pred, target, weight, out):
    """Fill a row's p, t, p^2 + t^2 and p t; return sum w |p - t|, w p, w t and w - 1."""
    l1, predicted, foreground, excess = 0.0, 0.0, 0.0, 0.0
    for k in range(len(pred)):
        p, t = pred[k], target[k]
        extra = (weight - ONE) * t
        l1 += (ONE + extra) * abs(p - t)
        predicted += (ONE + extra) * p
        foreground += (ONE + extra) * t
        excess += extra
        out[4 * k], out[4 * k + 1], out[4 * k + 2] = p, t, p * p + t * t
        out[4 * k + 3] = p * t
    return l1, predicted, foreground, excess


@njit(nogil=True, cache=True)
def _survey(preds, targets, weight, radius, products, spans, sums):
    """Fill an instance's spans and products, and add up what needs no window."""
    _find_spans(preds, targets, radius, spans)
    products[:] = 0
    sums[:] = 0
    for row in range(len(preds)):
        left, right = spans[0, row, 0], spans[0, row, 1]
        pred, target = preds[row, left:right], targets[row, left:right]
        out = products[row + radius, 4 * (left + radius) :]
        l1, predicted, foreground, excess = _fill_products(pred, target, weight, out)
        sums[0] += l1
        sums[1] += predicted
        sums[3] += foreground
        sums[4] += excess


@njit(nogil=True, cache=True)
def _buffers(shape, taps):
    """Return a thread's scratch: products, their derivatives, rows of both, three spans."""
    height, width = shape[0] + taps, shape[1] + taps
    products = np.empty((height, 4 * width), np.float32)
    slopes = np.empty((height, 3 * width), np.float32)
    line, maps = np.empty(4 * width, np.float32), np.empty(4 * width, np.float32)
    return products, slopes, line, maps, np.empty((3, shape[0], 2), np.int64)


@njit(nogil=True, cache=True)
def loss_forward(preds, targets, window, radius, weight, results, first, last):
    """Write some instances' sums, those of `raster_loss_sums_reference`, float64 (n, 7).

    Masks (n, H, W), the window (size,) and the weight are float32; zeros at the window's end make
    its size a multiple of ``TAPS``.
    """
    products, _, line, maps, spans = _buffers(preds.shape[1:], len(window))
    for n in range(first, last):
        _survey(preds[n], targets[n], weight, radius, products, spans, results[n])
        for row in range(preds.shape[1]):
            pixels = _blur_row(products, 4, row, spans[1, row], window, line, maps)
            dissimilarity, target, either = _dissimilarity(maps, pixels)
            results[n, 2] += dissimilarity
            results[n, 5] += target
            results[n, 6] += either


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _row_gradient(pred, target, maps, weight, factors, grad):
    """Write a row's gradient of the first three sums, each times its factor."""
    for k in range(len(grad)):
        p, t = pred[k], target[k]
        slope = factors[0] * np.sign(p - t) + factors[1]
        ssim = maps[3 * k] + TWO * p * maps[3 * k + 1] + t * maps[3 * k + 2]
        grad[k] = (ONE + (weight - ONE) * t) * slope - factors[2] * ssim


@njit(nogil=True, cache=True)
def loss_backward(preds, targets, window, radius, weight, factors, grads, first, last):
    """Write the gradient (n, H, W) of the first three sums, each times its factor (n, 3)."""
    products, slopes, line, maps, spans = _buffers(preds.shape[1:], len(window))
    unused = np.zeros(7)
    for n in range(first, last):
        grads[n] = factors[n, 1]  # outside the spans w is 1, and nothing else depends on p
        _survey(preds[n], targets[n], weight, radius, products, spans, unused)
        slopes[:] = 0
        for row in range(preds.shape[1]):
            pixels = _blur_row(products, 4, row, spans[1, row], window, line, maps)
            out = slopes[row + radius, 3 * (spans[1, row, 0] + radius) :]
            _derivatives(maps, pixels, out)
        for row in range(preds.shape[1]):
            _blur_row(slopes, 3, row, spans[2, row], window, line, maps)
            left, right = spans[2, row, 0], spans[2, row, 1]
            pred, target = preds[n, row, left:right], targets[n, row, left:right]
            _row_gradient(pred, target, maps, weight, factors[n], grads[n, row, left:right])


def _settings(window, weight):
    """Return the kernels' window, radius and weight."""
    padded = torch.nn.functional.pad(window, (0, -len(window) % TAPS))
    return padded, len(window) // 2, np.float32(weight)


def raster_loss_sums(preds, targets, window, weight):
    """Return the sums of `raster_loss_sums_reference`; the first three are differentiable."""
    sums = torch.empty(len(preds), 7, dtype=torch.float64)
    arguments = preds, targets, *_settings(window, weight), sums
    run_in_threads(loss_forward, preds.shape[1:].numel(), *arguments)
    return sums.float()


def raster_loss_sums_backward(grads, preds, targets, window, weight):
    """Return the gradient in the predictions. (n, H, W)"""
    gradient = torch.empty(preds.shape, dtype=torch.float32)
    arguments = preds, targets, *_settings(window, weight), grads[:, :3], gradient
    run_in_threads(loss_backward, preds.shape[1:].numel(), *arguments)
    return (gradient,)
