# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
r"""Fused CPU kernels (numba): masks of 2D Gaussians, no tensor per Gaussian.

One thread renders one instance at a time, into a mask that stays in the cache. Gaussian by Gaussian
and row by row, only the pixels inside the ellipse where the Gaussian exceeds 1e-8 (6.07 sigma) are
visited, rounded up to whole blocks of a vector's size: P Gaussians together change a pixel by less
than P * 1e-8. The ellipse's rows are worked out at once, before any of their pixels.

Along a row the exponent is a parabola: with the inverse covariance [[a, b], [b, c]],
a (x - v)^2 + dy^2 det / a, whose vertex v = mu_x - dy b / a and constant are worked out once per
row in float64. Neither term can cancel, so the inner loop is safe in float32: R <- R + G (1 - R),
the same as 1 - prod (1 - G) and exact for small G.

The backward pass rebuilds an instance's transmittance T = prod (1 - G), then sums, per Gaussian,
w = dL/dR * T * G / (1 - G) as (sum w, sum w t, sum w t^2) per row in float32, and gathers the rows
in float64 into the moments of w in the Gaussian's own frame (u, v), which give the gradients:

    dL/dsigma = (M_uu / s_u^3, M_vv / s_v^3),  dL/dmu = R(theta) (M_u / s_u^2, M_v / s_v^2),
    dL/dtheta = -M_uv (1 / s_u^2 - 1 / s_v^2).

T and 1 - G are rounded alike both times, so their quotient stays exact near a centre. Two runs give
the same bits, whatever the number of threads, compiled now or before.
"""

import math

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, pixel_range, run_in_threads
from gsmap.ops.gaussian_raster.reference import SQUARED_REACH

# of 2^x on [-0.5, 0.5], fitted at Chebyshev points: relative error about 1e-7
C0, C1, C2, C3, C4, C5 = map(
    np.float32, (1.0000001, 0.69314694, 0.24022122, 0.055507425, 0.00967546, 0.0013266971)
)
ZERO, HALF, ONE, LOWEST = map(np.float32, (0, 0.5, 1, -126))
BIAS, MANTISSA_BITS = np.int32(127), np.int32(23)
MAX_DENSITY = np.float32(1 - 1e-6)
HALF_LOG2E = 0.5 / math.log(2)
LANES = 16  # pixels of a row that are worked on at a time


@njit(inline="always")
def exp2_float32(x):
    """Return 2^x for x <= 0, at least 2^-126."""
    x = max(x, LOWEST)
    whole = np.int32(x - HALF)  # to the nearest, as x <= 0
    part = x - np.float32(whole)
    power = ((((C5 * part + C4) * part + C3) * part + C2) * part + C1) * part + C0
    return power * np.int32((whole + BIAS) << MANTISSA_BITS).view(np.float32)


@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")
def _survey(gaussian, frame, size, spans, rows):
    """Write the ellipse's columns in each of its rows, (2, H), and the row's parabola, (4, H).

    A parabola is its constant, t at the first column, and the vertex in the Gaussian's own frame.
    Return the first row and one past the last, the parabolas' curve, cos and sin.
    """
    x_min, y_min, step_x, step_y = frame
    height, width = size
    cos, sin = math.cos(gaussian[4]), math.sin(gaussian[4])
    inv_u, inv_v = 1.0 / (gaussian[2] * gaussian[2]), 1.0 / (gaussian[3] * gaussian[3])
    a, b = cos * cos * inv_u + sin * sin * inv_v, cos * sin * (inv_u - inv_v)
    det_a, slope, mean_x, mean_y = inv_u * inv_v / a, b / a, gaussian[0], gaussian[1]
    half = math.sqrt(SQUARED_REACH / det_a)
    top, bottom = pixel_range(mean_y - half, mean_y + half, y_min, step_y, height)
    for row in range(top, bottom):
        dy = y_min + (row + 0.5) * step_y - mean_y
        q, offset = dy * dy * det_a, -dy * slope
        vertex, half = mean_x + offset, math.sqrt(max(SQUARED_REACH - q, 0.0) / a)
        left, right = pixel_range(vertex - half, vertex + half, x_min, step_x, width)
        spans[0, row], spans[1, row] = left, right
        rows[0, row], rows[1, row] = q * HALF_LOG2E, x_min + (left + 0.5) * step_x - vertex
        rows[2, row], rows[3, row] = cos * offset + sin * dy, cos * dy - sin * offset
    return top, bottom, np.float32(min(a * HALF_LOG2E, 1e30)), cos, sin


@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")
def _accumulate(gaussian, frame, steps, mask, spans, rows, through):
    """Add one Gaussian to a mask (R), or multiply it into a transmittance (T) if ``through``."""
    size = mask.shape[0], mask.shape[1] - LANES
    top, bottom, curve, _, _ = _survey(gaussian, frame, size, spans, rows)
    for row in range(top, bottom):
        base, start = np.float32(rows[0, row]), np.float32(rows[1, row])
        for first in range(spans[0, row], spans[1, row], LANES):
            line, step = mask[row, first : first + LANES], steps[first - spans[0, row] :]
            for k in range(LANES):
                t = start + step[k]
                density = min(exp2_float32(-(curve * t * t + base)), MAX_DENSITY)
                line[k] = line[k] * (ONE - density) + (ZERO if through else density)


@njit(inline="always")
def _row_sums(grad, steps, start, curve, base):
    """Return the sums of w, w t and w t^2 over some pixels of a row."""
    sum_0, sum_1, sum_2 = ZERO, ZERO, ZERO
    for k in range(len(grad)):
        t = start + steps[k]
        density = exp2_float32(-(curve * t * t + base))
        weight = grad[k] * density / (ONE - min(density, MAX_DENSITY))
        weight = ZERO if density > MAX_DENSITY else weight  # clamped: no gradient
        sum_0 += weight
        sum_1 += weight * t
        sum_2 += weight * t * t
    return sum_0, sum_1, sum_2


# inlined, or the process that compiles it runs another copy (in the last bit) than the cached one
@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy", forceinline=True)
def _gaussian_gradient(gaussian, frame, steps, grad, spans, rows, out):
    """Write the gradient in one Gaussian's (mean, scales, rotation) of T dL/dR, ``grad``."""
    size = grad.shape[0], grad.shape[1] - LANES
    top, bottom, curve, cos, sin = _survey(gaussian, frame, size, spans, rows)
    m_u = m_v = m_uu = m_uv = m_vv = 0.0
    for row in range(top, bottom):
        base, start = np.float32(rows[0, row]), np.float32(rows[1, row])
        u, v = rows[2, row], rows[3, row]
        left = spans[0, row]
        whole = (spans[1, row] - left + LANES - 1) // LANES * LANES
        s_0, s_1, s_2 = _row_sums(grad[row, left : left + whole], steps, start, curve, base)
        m_u += cos * s_1 + u * s_0
        m_v += v * s_0 - sin * s_1
        m_uu += cos * cos * s_2 + 2 * cos * u * s_1 + u * u * s_0
        m_vv += sin * sin * s_2 - 2 * sin * v * s_1 + v * v * s_0
        m_uv += (cos * v - sin * u) * s_1 - cos * sin * s_2 + u * v * s_0
    inv_u, inv_v = 1.0 / (gaussian[2] * gaussian[2]), 1.0 / (gaussian[3] * gaussian[3])
    out[0] = cos * m_u * inv_u - sin * m_v * inv_v
    out[1] = sin * m_u * inv_u + cos * m_v * inv_v
    out[2] = m_uu * inv_u / gaussian[2]
    out[3] = m_vv * inv_v / gaussian[3]
    out[4] = m_uv * (inv_v - inv_u)


@njit(nogil=True, cache=True)
def _can_be_rendered(gaussians):
    """Tell whether an instance's parameters are finite, and its scales not zero."""
    return np.isfinite(gaussians).all() and gaussians[:, 2:4].all()


@njit(nogil=True, cache=True)
def _buffers(shape, step):
    """Return a thread's scratch: a mask with a margin, its columns in metres, a row's geometry."""
    width = shape[1] + LANES
    steps = (np.arange(width) * step).astype(np.float32)
    spans, rows = np.empty((2, shape[0]), np.int64), np.empty((4, shape[0]))
    return np.empty((shape[0], width), np.float32), steps, spans, rows


@njit(nogil=True, cache=True)
def render_forward(gaussians, frame, masks, first, last):
    """Write the float32 masks (N, H, W) of some instances; NaN where a parameter is not finite.

    ``gaussians`` are mean x, y, scale u, v and rotation, float64 (N, P, 5); ``frame`` is the
    smallest x and y and the pixel's size along both, in metres.
    """
    mask, steps, spans, rows = _buffers(masks.shape[1:], frame[2])
    for n in range(first, last):
        if not _can_be_rendered(gaussians[n]):
            masks[n] = np.nan
            continue
        mask[:] = 0
        for gaussian in gaussians[n]:
            _accumulate(gaussian, frame, steps, mask, spans, rows, False)
        for row in range(masks.shape[1]):
            for col in range(masks.shape[2]):
                masks[n, row, col] = mask[row, col]


@njit(nogil=True, cache=True)
def render_backward(gaussians, frame, grads, out, first, last):
    """Write the gradient (N, P, 5), float64, in the Gaussians of gradients (N, H, W), float32."""
    trans, steps, spans, rows = _buffers(grads.shape[1:], frame[2])
    for n in range(first, last):
        if not _can_be_rendered(gaussians[n]):
            out[n] = np.nan
            continue
        trans[:] = 1
        for gaussian in gaussians[n]:
            _accumulate(gaussian, frame, steps, trans, spans, rows, True)
        for row in range(grads.shape[1]):
            for col in range(grads.shape[2]):
                trans[row, col] *= grads[n, row, col]
            trans[row, grads.shape[2] :] = 0
        for p in range(gaussians.shape[1]):
            _gaussian_gradient(gaussians[n, p], frame, steps, trans, spans, rows, out[n, p])


def render_gaussians(gaussians, frame, height, width):
    """Render float32 Gaussians (N, P, 5), as :func:`render_forward`. (N, H, W)"""
    masks = torch.empty(len(gaussians), height, width, dtype=torch.float32)
    run_in_threads(render_forward, height * width, gaussians.double(), tuple(frame), masks)
    return masks


def render_gaussians_backward(grads, gaussians, frame, height, width):
    """Return the gradient in the Gaussians. (N, P, 5)"""
    gradients = torch.empty(gaussians.shape, dtype=torch.float64)
    pixels, wide = height * width, gaussians.double()
    run_in_threads(render_backward, pixels, wide, tuple(frame), grads, gradients)
    return (gradients.float(),)
