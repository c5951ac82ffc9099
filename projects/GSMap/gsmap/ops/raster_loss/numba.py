# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernels (numba) of the raster loss, which visit only pixels that contribute to it.

In this module, p is the predicted and t the ground-truth mask. A thread computes one instance at a
time. Where both masks are zero within SSIM's window, SSIM is exactly 1 and the L1 term exactly 0.
In each row, every step therefore runs only from the first to the last column that can contribute:
the columns where a mask is not zero, extended by the radius of the window for each blur. The window
is separable and a row is blurred when it is needed, so no blurred map is stored.

Only the two masks are saved for the backward pass. It computes the four blurred maps (p, t,
p^2 + t^2, p t) again and, from them, the derivatives of SSIM with respect to the blurred p, p^2 and
p t. The gradient with respect to a map before its blur is the transposed blur of the derivative.
The window is symmetric, so the transposed blur equals the blur, and the derivatives are blurred
once more. Sums are computed in a fixed order in one thread, so repeated runs are bitwise equal.
"""

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, run_in_threads
from gsmap.ops.raster_loss.reference import MIN_COVERAGE, SSIM_C1, SSIM_C2

ONE = np.float32(1)
TWO = np.float32(2)
C1 = np.float32(SSIM_C1)
C2 = np.float32(SSIM_C2)
COVERAGE = np.float32(MIN_COVERAGE)
TAPS = 6  # number of weights of the window that `_convolve` handles in one pass over its output


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _find_spans(preds, targets, radius, spans):
    """Find the columns of each row that contribute to the loss.

    Args:
        preds: Predicted mask. (H, W)
        targets: Ground-truth mask. (H, W)
        radius: Radius of the window in pixels.
        spans: Output for the first column and one past the last column of each row: where a mask is
            not zero, where its blur is not zero, and where the blur of the blur is not zero.
            (3, H, 2)
    """
    height, width = preds.shape
    for row in range(height):
        left = np.int32(width)
        right = np.int32(0)
        for col in range(width):
            # Without branches, so that the compiler can compute several columns at a time.
            nonzero = (preds[row, col] != 0) | (targets[row, col] != 0)
            left = min(left, np.int32(col) if nonzero else np.int32(width))
            right = max(right, np.int32(col + 1) if nonzero else np.int32(0))
        spans[0, row, 0] = left
        spans[0, row, 1] = max(left, right)  # an empty row has the span (width, width)
    # A blur extends the spans of all rows within the radius by the radius to the left and right.
    for step in range(2):
        for row in range(height):
            left = np.int32(width)
            right = np.int32(0)
            for other in range(max(row - radius, 0), min(row + radius + 1, height)):
                if spans[step, other, 0] < spans[step, other, 1]:
                    left = min(left, spans[step, other, 0])
                    right = max(right, spans[step, other, 1])
            left = max(left - radius, np.int32(0))
            right = min(right + radius, np.int32(width))
            spans[step + 1, row, 0] = left
            spans[step + 1, row, 1] = max(right, left)


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _convolve(source, first, stride, window, out, size):
    """Compute out[k] = sum_j window[j] source[first + k + j stride] for k < size.

    The number of weights in ``window`` is a multiple of ``TAPS`` (6). ``source`` is flat, ``first``
    is an index in it, and ``stride`` is the step from one weight's value to the next.
    """
    # Indices are unsigned. For a signed index, numba would add a test for a negative index, which
    # counts from the end.
    s_1 = np.uint64(stride)
    s_2 = np.uint64(2 * stride)
    s_3 = np.uint64(3 * stride)
    s_4 = np.uint64(4 * stride)
    s_5 = np.uint64(5 * stride)
    out[:size] = 0
    for j in range(0, len(window), TAPS):
        w_0 = window[j]
        w_1 = window[j + 1]
        w_2 = window[j + 2]
        w_3 = window[j + 3]
        w_4 = window[j + 4]
        w_5 = window[j + 5]
        start = np.uint64(first + j * stride)
        for k in range(np.uint64(size)):
            i = start + k
            near = w_0 * source[i] + w_1 * source[i + s_1] + w_2 * source[i + s_2]
            far = w_3 * source[i + s_3] + w_4 * source[i + s_4] + w_5 * source[i + s_5]
            out[k] += near + far


@njit(nogil=True, cache=True)
def _blur_row(images, channels, row, span, window, line, out):
    """Blur a span of one row of padded images, first across the rows, then along the row.

    Args:
        images: Images with a margin of the window's radius. All channels of a pixel follow each
            other in a row. (H + taps, (W + taps) * channels)
        channels: Number of channels.
        row: Row of the images without margin.
        span: First column and one past the last column. (2,)
        window: Weights of the window. (taps,)
        line: Buffer for the span, blurred across the rows. (4 * (W + taps),)
        out: Output for the blurred span. (4 * (W + taps),)

    Returns:
        Number of pixels of the span.
    """
    pitch = images.shape[1]
    pixels = span[1] - span[0]
    # Index of the top left of the first pixel's window. The margin is as wide as the window's
    # radius, so the row and column of this corner in the padded images are equal to the row and
    # column of the pixel in the images without margin.
    first = row * pitch + span[0] * channels
    # The blur along the row reads the whole windows of the first to the last pixel of the span.
    size = (pixels + len(window)) * channels
    _convolve(images.reshape(images.size), first, stride=pitch, window=window, out=line, size=size)
    _convolve(line, 0, stride=channels, window=window, out=out, size=pixels * channels)
    return pixels


@njit(inline="always")
def _ssim_terms(p, t, squares, product):
    """Numerators and denominators of SSIM from the blurred p, t, p^2 + t^2 and p t.

    SSIM is the product of the first two values, divided by the product of the last two.
    """
    means = p * p + t * t
    top_mean = TWO * p * t + C1
    top_cov = TWO * (product - p * t) + C2
    return top_mean, top_cov, means + C1, squares - means + C2


@njit(nogil=True, cache=True)
def _dissimilarity(maps, pixels):
    """Sum 1 - SSIM over a row, and count the pixels near the target and near either mask.

    ``maps`` contains the blurred p, t, p^2 + t^2 and p t of one pixel after another.
    """
    total = 0.0
    near_target = 0.0
    near_either = 0.0
    for k in range(pixels):
        p = maps[4 * k]
        t = maps[4 * k + 1]
        top_mean, top_cov, low_mean, low_var = _ssim_terms(
            p, t, squares=maps[4 * k + 2], product=maps[4 * k + 3]
        )
        total += ONE - (top_mean * top_cov) / (low_mean * low_var)
        # The two numbers have different thresholds. As in the reference, the first one counts each
        # pixel with any part of the target in its window, so that the blurred target exceeds 0. For
        # the second one, the larger of both blurred masks must exceed `MIN_COVERAGE`.
        near_target += 1.0 if t > 0 else 0.0
        near_either += 1.0 if max(p, t) > COVERAGE else 0.0
    return total, near_target, near_either


@njit(nogil=True, cache=True)
def _derivatives(maps, pixels, out):
    """Compute the derivatives of SSIM with respect to the blurred p, p^2 and p t of a row.

    ``maps`` contains the blurred p, t, p^2 + t^2 and p t of one pixel after another, and ``out``
    receives three derivatives per pixel. With A, B, C and D for the results of `_ssim_terms`, SSIM
    is A B / (C D). The blurred p is in all four of them, with the derivatives 2 t, -2 t, 2 p and
    -2 p. The blurred p^2 is only in D, with the derivative 1, and the blurred p t only in B, with
    the derivative 2. So the derivative of SSIM with respect to the blurred p is
    2 (t (B - A) + p SSIM (C - D)) / (C D).
    """
    for k in range(pixels):
        p = maps[4 * k]
        t = maps[4 * k + 1]
        top_mean, top_cov, low_mean, low_var = _ssim_terms(
            p, t, squares=maps[4 * k + 2], product=maps[4 * k + 3]
        )
        scale = ONE / (low_mean * low_var)
        ssim = top_mean * top_cov * scale
        change = t * (top_cov - top_mean) + p * ssim * (low_mean - low_var)
        out[3 * k] = TWO * change * scale
        out[3 * k + 1] = -ssim * scale * low_mean
        out[3 * k + 2] = TWO * top_mean * scale


@njit(nogil=True, cache=True)
def _fill_products(pred, target, weight, out):
    """Compute p, t, p^2 + t^2 and p t of a row, and sum w |p - t|, w p, w t and w - 1.

    The weight of a pixel is w = 1 + (weight - 1) t.
    """
    l1 = 0.0
    predicted = 0.0
    foreground = 0.0
    excess = 0.0
    for k in range(len(pred)):
        p = pred[k]
        t = target[k]
        extra = (weight - ONE) * t
        l1 += (ONE + extra) * abs(p - t)
        predicted += (ONE + extra) * p
        foreground += (ONE + extra) * t
        excess += extra
        out[4 * k] = p
        out[4 * k + 1] = t
        out[4 * k + 2] = p * p + t * t
        out[4 * k + 3] = p * t
    return l1, predicted, foreground, excess


@njit(nogil=True, cache=True)
def _prepare_instance(preds, targets, weight, radius, products, spans, sums):
    """Compute the spans and products of an instance, and the sums that need no window.

    ``sums`` has the order of ``results`` in `loss_forward`. The sums that need a window become 0.
    """
    _find_spans(preds, targets, radius=radius, spans=spans)
    products[:] = 0
    sums[:] = 0
    for row in range(len(preds)):
        left = spans[0, row, 0]
        right = spans[0, row, 1]
        pred = preds[row, left:right]
        target = targets[row, left:right]
        # The row in `products`, from the first pixel of the span on. The margin shifts rows and
        # columns by the radius, and a pixel has four channels.
        out = products[row + radius, 4 * (left + radius) :]
        l1, predicted, foreground, excess = _fill_products(pred, target, weight=weight, out=out)
        sums[0] += l1
        sums[1] += predicted
        sums[3] += foreground
        sums[4] += excess


@njit(nogil=True, cache=True)
def _buffers(shape, taps):
    """Buffers of a thread: products, derivatives, a row blurred along one and both axes, spans."""
    height = shape[0] + taps
    width = shape[1] + taps
    products = np.empty((height, 4 * width), np.float32)
    slopes = np.empty((height, 3 * width), np.float32)
    line = np.empty(4 * width, np.float32)
    maps = np.empty(4 * width, np.float32)
    spans = np.empty((3, shape[0], 2), np.int64)
    return products, slopes, line, maps, spans


@njit(nogil=True, cache=True)
def loss_forward(preds, targets, window, radius, weight, results, first, last):
    """Compute the sums of `raster_loss_sums_reference` of the masks ``first`` to ``last - 1``.

    Args:
        preds: Predicted masks in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32, with zeros at the end that make their number a
            multiple of ``TAPS``. (taps,)
        radius: Radius of the window in pixels.
        weight: Weight of a foreground pixel, relative to a background pixel, float32.
        results: Output for the sums of w |p - t|, w p, 1 - SSIM, w t and w - 1, the number of
            pixels near the target, and the number of pixels near either mask, float64. (n, 7)
        first: First mask.
        last: One past the last mask.
    """
    products, _, line, maps, spans = _buffers(preds.shape[1:], len(window))
    for n in range(first, last):
        _prepare_instance(
            preds[n],
            targets[n],
            weight=weight,
            radius=radius,
            products=products,
            spans=spans,
            sums=results[n],
        )
        for row in range(preds.shape[1]):
            pixels = _blur_row(
                products, 4, row=row, span=spans[1, row], window=window, line=line, out=maps
            )
            dissimilarity, near_target, near_either = _dissimilarity(maps, pixels)
            results[n, 2] += dissimilarity
            results[n, 5] += near_target
            results[n, 6] += near_either


@njit(nogil=True, cache=True, fastmath=FASTMATH)
def _row_gradient(pred, target, maps, weight, factors, grad):
    """Compute the gradient of a row: the sum of the gradients of three sums times their factors.

    The three sums are the sums of w |p - t|, w p and 1 - SSIM.
    """
    for k in range(len(grad)):
        p = pred[k]
        t = target[k]
        # Derivative of the sums of w |p - t| and w p, without the factor w.
        slope = factors[0] * np.sign(p - t) + factors[1]
        # Chain rule: `maps` contains the gradients of SSIM with respect to p, p^2 and p t.
        ssim_slope = maps[3 * k] + TWO * p * maps[3 * k + 1] + t * maps[3 * k + 2]
        grad[k] = (ONE + (weight - ONE) * t) * slope - factors[2] * ssim_slope


@njit(nogil=True, cache=True)
def loss_backward(preds, targets, window, radius, weight, factors, grads, first, last):
    """Compute the gradient of the masks ``first`` to ``last - 1``.

    Args:
        preds: Predicted masks in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, with zeros at the end as in `loss_forward`. (taps,)
        radius: Radius of the window in pixels.
        weight: Weight of a foreground pixel, relative to a background pixel, float32.
        factors: Gradient of the loss with respect to the first three sums, float32. (n, 3)
        grads: Output for the gradient of the predicted masks, float32. (n, H, W)
        first: First mask.
        last: One past the last mask.
    """
    products, slopes, line, maps, spans = _buffers(preds.shape[1:], len(window))
    unused = np.zeros(7)  # output for the sums, which the gradient does not need
    for n in range(first, last):
        # Outside the spans, w is 1, and of the three sums only the sum of w p depends on p.
        grads[n] = factors[n, 1]
        _prepare_instance(
            preds[n],
            targets[n],
            weight=weight,
            radius=radius,
            products=products,
            spans=spans,
            sums=unused,
        )
        slopes[:] = 0
        for row in range(preds.shape[1]):
            pixels = _blur_row(
                products, 4, row=row, span=spans[1, row], window=window, line=line, out=maps
            )
            # The row in `slopes`, from the first pixel of the span on. The margin shifts rows and
            # columns by the radius, and a pixel has three channels.
            out = slopes[row + radius, 3 * (spans[1, row, 0] + radius) :]
            _derivatives(maps, pixels, out=out)
        for row in range(preds.shape[1]):
            _blur_row(slopes, 3, row=row, span=spans[2, row], window=window, line=line, out=maps)
            left = spans[2, row, 0]
            right = spans[2, row, 1]
            pred = preds[n, row, left:right]
            target = targets[n, row, left:right]
            _row_gradient(
                pred,
                target,
                maps=maps,
                weight=weight,
                factors=factors[n],
                grad=grads[n, row, left:right],
            )


def _pad_window(window):
    """Append zeros to a window (size,) up to a multiple of ``TAPS``."""
    num_missing = -len(window) % TAPS
    return torch.nn.functional.pad(window, (0, num_missing))


def raster_loss_sums(preds, targets, window, weight):
    """Compute the sums of `raster_loss_sums_reference`.

    Args:
        preds: Predicted masks in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (size,)
        weight: Weight of a foreground pixel, relative to a background pixel.

    Returns:
        Sums, float32. The first three are differentiable in ``preds``. (n, 7)
    """
    # The kernel adds the values of all pixels in float64, and sets the sums to 0 before.
    sums = torch.empty(len(preds), 7, dtype=torch.float64)
    pixels = preds.shape[1:].numel()
    padded = _pad_window(window)
    radius = len(window) // 2
    weight = np.float32(weight)
    # Calls the kernel with these arguments and a range of masks (`first`, `last`), in each thread.
    run_in_threads(loss_forward, pixels, preds, targets, padded, radius, weight, sums)
    return sums.float()


def raster_loss_sums_backward(grads, preds, targets, window, weight):
    """Compute the gradient of `raster_loss_sums`.

    Args:
        grads: Gradient of the sums, float32. (n, 7)
        preds: Predicted masks in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (size,)
        weight: Weight of a foreground pixel, relative to a background pixel.

    Returns:
        Tuple with one entry, the gradient of the predicted masks, float32. (n, H, W)
    """
    gradient = torch.empty(preds.shape, dtype=torch.float32)
    pixels = preds.shape[1:].numel()
    padded = _pad_window(window)
    radius = len(window) // 2
    weight = np.float32(weight)
    factors = grads[:, :3]  # only the first three sums depend differentiably on the predictions
    run_in_threads(loss_backward, pixels, preds, targets, padded, radius, weight, factors, gradient)
    return (gradient,)
