# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
r"""Fused CPU kernels (numba): masks of 2D Gaussians without a tensor per Gaussian.

A thread renders one instance at a time into a mask that stays in the processor's cache. For each
Gaussian and row, only the pixels inside the ellipse of densities above 1e-8 (6.07 sigma) are
computed, rounded up to whole blocks of ``LANES`` pixels. The neglected densities of P Gaussians
change a pixel by less than P * 1e-8. The geometry of all rows of an ellipse is computed before
their pixels.

A density is G = exp(-e / 2). Along a row at the distance dy = y - mu_y from the centre, e is a
parabola. With the inverse covariance [[a, b], [b, c]], whose determinant is det, it is
e = a t^2 + dy^2 det / a. Here t = x - x_0 is the distance of a pixel from the vertex
x_0 = mu_x - dy b / a of the parabola. The vertex and the constant dy^2 det / a are computed once
per row in float64. Both terms of e are positive and cannot cancel, so float32 is precise enough for
the inner loop R <- R + G (1 - R), which equals 1 - prod (1 - G) and is exact for small G.

The backward pass computes the transmittance T = prod (1 - G) of an instance again. As
dR/dG = T / (1 - G), a pixel has the weight w = dL/dR * T * G / (1 - G) for a Gaussian. Sum w,
sum w t and sum w t^2 are computed per row in float32. In float64, the sums of all rows give the
moments of w in the frame (u, v) of the Gaussian, M_u = sum w u, M_uv = sum w u v and so on, and
these give the gradients:

    dL/dsigma = (M_uu / s_u^3, M_vv / s_v^3),  dL/dmu = R(theta) (M_u / s_u^2, M_v / s_v^2),
    dL/dtheta = -M_uv (1 / s_u^2 - 1 / s_v^2).

T and 1 - G are rounded identically in both passes, so their quotient stays exact near a centre.
Results are bitwise equal for any number of threads, and for compiled and cached kernels.
"""

import math

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, pixel_range, run_in_threads
from gsmap.ops.gaussian_raster.reference import SQUARED_REACH

# Coefficients of the polynomial C0 + C1 x + C2 x^2 + .. for 2^x on [-0.5, 0.5], fitted at Chebyshev
# points: relative error about 1e-7
C0, C1, C2, C3, C4, C5 = map(
    np.float32, (1.0000001, 0.69314694, 0.24022122, 0.055507425, 0.00967546, 0.0013266971)
)
ZERO, HALF, ONE, LOWEST = map(np.float32, (0, 0.5, 1, -126))
BIAS = np.int32(127)  # of the exponent of a float32
MANTISSA_BITS = np.int32(23)  # of a float32
MAX_DENSITY = np.float32(1 - 1e-6)
HALF_LOG2E = 0.5 / math.log(2)
# Pixels of a row that are computed at a time. The compiler can vectorise loops of a fixed length.
LANES = 16


@njit(inline="always")
def exp2_float32(x):
    """Compute 2^x for x <= 0, at least 2^-126."""
    x = max(x, LOWEST)
    whole = np.int32(x - HALF)  # the conversion cuts towards 0: x <= 0 is rounded to the nearest
    part = x - np.float32(whole)
    power = ((((C5 * part + C4) * part + C3) * part + C2) * part + C1) * part + C0
    # A float32 with the exponent field whole + BIAS and the mantissa 0 has the value 2^whole.
    return power * np.int32((whole + BIAS) << MANTISSA_BITS).view(np.float32)


@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")
def _row_geometry(gaussian, frame, size, spans, parabolas):
    """Compute the geometry of a Gaussian's ellipse in each of its rows.

    Args:
        gaussian: Mean x, y, scales u, v and rotation. (5,)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        size: Height H and width of the raster in pixels.
        spans: Output for the first column and one past the last column in each row. (2, H)
        parabolas: Output for the parabola of each row: its constant times ``HALF_LOG2E``, as G is
            computed as a power of 2; t at the first column; and its vertex (u, v) in the frame of
            the Gaussian. (4, H)

    Returns:
        First row, one past the last row, curvature of the parabolas, cosine and sine of the
        rotation.
    """
    x_min, y_min, step_x, step_y = frame
    height, width = size
    cos = math.cos(gaussian[4])
    sin = math.sin(gaussian[4])
    inv_u = 1.0 / (gaussian[2] * gaussian[2])
    inv_v = 1.0 / (gaussian[3] * gaussian[3])
    a = cos * cos * inv_u + sin * sin * inv_v
    b = cos * sin * (inv_u - inv_v)
    det_a = inv_u * inv_v / a
    slope = b / a
    mean_x = gaussian[0]
    mean_y = gaussian[1]
    # The ellipse ends where the exponent at the vertex alone, dy^2 det / a, reaches SQUARED_REACH.
    half_height = math.sqrt(SQUARED_REACH / det_a)
    top, bottom = pixel_range(
        mean_y - half_height, mean_y + half_height, origin=y_min, step=step_y, size=height
    )
    for row in range(top, bottom):
        dy = y_min + (row + 0.5) * step_y - mean_y
        squared = dy * dy * det_a
        offset = -dy * slope
        vertex = mean_x + offset
        half_width = math.sqrt(max(SQUARED_REACH - squared, 0.0) / a)
        left, right = pixel_range(
            vertex - half_width, vertex + half_width, origin=x_min, step=step_x, size=width
        )
        spans[0, row] = left
        spans[1, row] = right
        parabolas[0, row] = squared * HALF_LOG2E
        parabolas[1, row] = x_min + (left + 0.5) * step_x - vertex
        parabolas[2, row] = cos * offset + sin * dy
        parabolas[3, row] = cos * dy - sin * offset
    # Finite in float32, so that curvature * t * t is 0 at the vertex. Infinity would give NaN.
    curvature = np.float32(min(a * HALF_LOG2E, 1e30))
    return top, bottom, curvature, cos, sin


@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")
def _accumulate(gaussian, frame, steps, mask, spans, parabolas, through):
    """Add one Gaussian to a mask R or, if ``through``, multiply it into a transmittance T.

    Args:
        gaussian: Mean x, y, scales u, v and rotation. (5,)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        steps: 0, 1, 2, .. times the width of a pixel in metres. (W + LANES,)
        mask: R or T, changed in place. It has a margin, so that the last block of a row may exceed
            W. (H, W + LANES)
        spans: Buffer for `_row_geometry`. (2, H)
        parabolas: Buffer for `_row_geometry`. (4, H)
        through: False for R <- R + G (1 - R), True for T <- T (1 - G).
    """
    size = (mask.shape[0], mask.shape[1] - LANES)  # without the margin
    top, bottom, curvature, _, _ = _row_geometry(
        gaussian, frame, size=size, spans=spans, parabolas=parabolas
    )
    for row in range(top, bottom):
        base = np.float32(parabolas[0, row])
        start = np.float32(parabolas[1, row])
        for first in range(spans[0, row], spans[1, row], LANES):
            pixels = mask[row, first : first + LANES]
            distances = steps[first - spans[0, row] :]
            for k in range(LANES):
                t = start + distances[k]
                density = min(exp2_float32(-(curvature * t * t + base)), MAX_DENSITY)
                # R + G (1 - R) = R (1 - G) + G. Only the last term is missing in the update of T.
                pixels[k] = pixels[k] * (ONE - density) + (ZERO if through else density)


@njit(inline="always")
def _row_sums(grad, steps, start, curvature, base):
    """Sums of w, w t and w t^2 over pixels of a row.

    Args:
        grad: Product dL/dR * T at the pixels. (n,)
        steps: Distance of each pixel from the first one in metres. (>= n,)
        start: t at the first pixel.
        curvature: Curvature of the parabola, as `_row_geometry` returns it.
        base: Constant of the parabola, times ``HALF_LOG2E``.
    """
    sum_0 = ZERO
    sum_1 = ZERO
    sum_2 = ZERO
    for k in range(len(grad)):
        t = start + steps[k]
        density = exp2_float32(-(curvature * t * t + base))
        weight = grad[k] * density / (ONE - min(density, MAX_DENSITY))
        weight = ZERO if density > MAX_DENSITY else weight  # clamped: no gradient
        sum_0 += weight
        sum_1 += weight * t
        sum_2 += weight * t * t
    return sum_0, sum_1, sum_2


# Inlined: otherwise the results of the process that compiles the function and of processes that
# load it from the cache can differ in the last bit.
@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy", forceinline=True)
def _gaussian_gradient(gaussian, frame, steps, grad, spans, parabolas, out):
    """Compute the gradient of one Gaussian and write it to ``out`` (5,).

    ``grad`` is the product dL/dR * T (H, W + LANES), which is 0 in the margin. The other arguments
    are described in `_accumulate`.
    """
    size = (grad.shape[0], grad.shape[1] - LANES)  # without the margin
    top, bottom, curvature, cos, sin = _row_geometry(
        gaussian, frame, size=size, spans=spans, parabolas=parabolas
    )
    m_u = 0.0  # moments of w
    m_v = 0.0
    m_uu = 0.0
    m_uv = 0.0
    m_vv = 0.0
    for row in range(top, bottom):
        base = np.float32(parabolas[0, row])
        start = np.float32(parabolas[1, row])
        u = parabolas[2, row]
        v = parabolas[3, row]
        left = spans[0, row]
        num_pixels = (spans[1, row] - left + LANES - 1) // LANES * LANES  # whole blocks
        s_0, s_1, s_2 = _row_sums(
            grad[row, left : left + num_pixels], steps, start=start, curvature=curvature, base=base
        )
        # A pixel at t along the row is at (u + cos t, v - sin t) in the frame of the Gaussian.
        m_u += cos * s_1 + u * s_0
        m_v += v * s_0 - sin * s_1
        m_uu += cos * cos * s_2 + 2 * cos * u * s_1 + u * u * s_0
        m_vv += sin * sin * s_2 - 2 * sin * v * s_1 + v * v * s_0
        m_uv += (cos * v - sin * u) * s_1 - cos * sin * s_2 + u * v * s_0
    inv_u = 1.0 / (gaussian[2] * gaussian[2])
    inv_v = 1.0 / (gaussian[3] * gaussian[3])
    out[0] = cos * m_u * inv_u - sin * m_v * inv_v
    out[1] = sin * m_u * inv_u + cos * m_v * inv_v
    out[2] = m_uu * inv_u / gaussian[2]
    out[3] = m_vv * inv_v / gaussian[3]
    out[4] = m_uv * (inv_v - inv_u)


@njit(nogil=True, cache=True)
def _can_be_rendered(gaussians):
    """Whether all parameters of an instance (P, 5) are finite and its scales not zero."""
    return np.isfinite(gaussians).all() and gaussians[:, 2:4].all()


@njit(nogil=True, cache=True)
def _buffers(shape, step):
    """Buffers of a thread, as in `_accumulate`: a mask with a margin, steps, spans, parabolas.

    Args:
        shape: Height H and width W of the raster in pixels.
        step: Width of a pixel in metres.
    """
    width = shape[1] + LANES
    mask = np.empty((shape[0], width), np.float32)
    steps = (np.arange(width) * step).astype(np.float32)
    spans = np.empty((2, shape[0]), np.int64)
    parabolas = np.empty((4, shape[0]))
    return mask, steps, spans, parabolas


@njit(nogil=True, cache=True)
def render_forward(gaussians, frame, masks, first, last):
    """Render the instances ``first`` to ``last - 1``.

    Args:
        gaussians: Mean x, y, scales u, v and rotation, float64. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        masks: Output for the masks, float32; NaN for an instance with a parameter that is not
            finite, or with a scale of 0. (N, H, W)
        first: First instance.
        last: One past the last instance.
    """
    mask, steps, spans, parabolas = _buffers(masks.shape[1:], frame[2])
    for n in range(first, last):
        if not _can_be_rendered(gaussians[n]):
            masks[n] = np.nan
            continue
        mask[:] = 0
        for gaussian in gaussians[n]:
            _accumulate(
                gaussian,
                frame,
                steps=steps,
                mask=mask,
                spans=spans,
                parabolas=parabolas,
                through=False,
            )
        # Copy without the margin.
        for row in range(masks.shape[1]):
            for col in range(masks.shape[2]):
                masks[n, row, col] = mask[row, col]


@njit(nogil=True, cache=True)
def render_backward(gaussians, frame, grads, out, first, last):
    """Compute the gradients of the instances ``first`` to ``last - 1``.

    Args:
        gaussians: Mean x, y, scales u, v and rotation, float64. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        grads: Gradient of the masks, float32. (N, H, W)
        out: Output for the gradient of the Gaussians, float64; NaN for an instance with a parameter
            that is not finite, or with a scale of 0. (N, P, 5)
        first: First instance.
        last: One past the last instance.
    """
    trans, steps, spans, parabolas = _buffers(grads.shape[1:], frame[2])
    for n in range(first, last):
        if not _can_be_rendered(gaussians[n]):
            out[n] = np.nan
            continue
        trans[:] = 1
        for gaussian in gaussians[n]:
            _accumulate(
                gaussian,
                frame,
                steps=steps,
                mask=trans,
                spans=spans,
                parabolas=parabolas,
                through=True,
            )
        # From here on, the buffer contains the product dL/dR * T, which is 0 in the margin.
        for row in range(grads.shape[1]):
            for col in range(grads.shape[2]):
                trans[row, col] *= grads[n, row, col]
            trans[row, grads.shape[2] :] = 0
        for p in range(gaussians.shape[1]):
            _gaussian_gradient(
                gaussians[n, p],
                frame,
                steps=steps,
                grad=trans,
                spans=spans,
                parabolas=parabolas,
                out=out[n, p],
            )


def render_gaussians(gaussians, frame, height, width):
    """Render Gaussians to masks.

    Args:
        gaussians: Mean x, y, scales u, v and rotation, float32. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.

    Returns:
        Masks, float32. (N, H, W)
    """
    masks = torch.empty(len(gaussians), height, width, dtype=torch.float32)
    # Each thread calls the kernel for a range of instances, whose ends are its last two arguments.
    run_in_threads(render_forward, height * width, gaussians.double(), tuple(frame), masks)
    return masks


def render_gaussians_backward(grads, gaussians, frame, height, width):
    """Compute the gradient of `render_gaussians`.

    Args:
        grads: Gradient of the masks, float32. (N, H, W)
        gaussians: Mean x, y, scales u, v and rotation, float32. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.

    Returns:
        Tuple with one entry, the gradient with respect to ``gaussians``, float32. (N, P, 5)
    """
    gradients = torch.empty(gaussians.shape, dtype=torch.float64)
    pixels = height * width
    run_in_threads(render_backward, pixels, gaussians.double(), tuple(frame), grads, gradients)
    return (gradients.float(),)
