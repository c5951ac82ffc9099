# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernels (numba): soft rasters and ground-truth masks.

One thread works on one element at a time. Edge by edge and row by row, only the pixels within a
reach of the edge are visited: beyond it a soft raster differs from 0 or 1 by less than 1e-8, and a
line's mask is empty. Two buffers of one mask per thread hold the smallest squared distance and the
edge it belongs to; no tensor per edge exists. The backward pass rebuilds both and scatters each
pixel's gradient to the two ends of its nearest edge, in float64 and in a fixed order, so two runs
give the same bits.
"""

import math

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, pixel_range, run_in_threads
from gsmap.ops.polyline_raster.reference import DISTANCE_EPS, LENGTH_EPS

FAR = np.float32(np.inf)
REACH = -math.log(1e-8)  # in units of softness: beyond it masks are 0 or 1
INTEGER_FRAME = (-0.5, -0.5, 1.0, 1.0)  # MapVR samples pixel (row, col) at (col, row)


@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")
def _visit_edge(start, end, index, frame, reach, eps, steps, distances, owners):
    """Lower the distances (H, W) by one edge's, and note whose they are."""
    x_min, y_min, step_x, step_y = frame
    height, width = distances.shape
    x0, y0 = float(start[0]), float(start[1])
    edge_x, edge_y = float(end[0]) - x0, float(end[1]) - y0
    length = math.sqrt(edge_x * edge_x + edge_y * edge_y)
    length2 = max(edge_x * edge_x + edge_y * edge_y + eps, 1e-38)
    along_x, along_y = np.float32(edge_x / length2), np.float32(edge_y / length2)
    ex, ey, step = np.float32(edge_x), np.float32(edge_y), np.float32(step_x)
    low_y, high_y = min(y0, y0 + edge_y) - reach, max(y0, y0 + edge_y) + reach
    low_x, high_x = min(x0, x0 + edge_x) - reach, max(x0, x0 + edge_x) + reach
    top, bottom = pixel_range(low_y, high_y, y_min, step_y, height)
    for row in range(top, bottom):
        offset_y = y_min + (row + 0.5) * step_y - y0
        left_x, right_x = low_x, high_x
        if abs(edge_y) > 1e-6 * length:  # the strip along the edge, where it crosses this row
            crossing = x0 + offset_y * edge_x / edge_y
            half = reach * length / abs(edge_y)
            left_x, right_x = max(left_x, crossing - half), min(right_x, crossing + half)
        left, right = pixel_range(left_x, right_x, x_min, step_x, width)
        nearest, owner = distances[row, left : max(left, right)], owners[row, left:right]
        first, fy = np.float32(x_min + (left + 0.5) * step_x - x0), np.float32(offset_y)
        for k in range(len(nearest)):
            fx = first + steps[k] * step
            t = min(max(fx * along_x + fy * along_y, np.float32(0)), np.float32(1))
            dx, dy = fx - t * ex, fy - t * ey
            squared = dx * dx + dy * dy
            closer = squared < nearest[k]
            nearest[k] = squared if closer else nearest[k]
            owner[k] = index if closer else owner[k]


@njit(nogil=True, cache=True)
def _fill_inside(ring, frame, inside):
    """Set pixels (H, W) to 1 inside the closed ring by the even-odd rule, and to 0 outside."""
    x_min, y_min, step_x, step_y = frame
    inside[:] = 0
    for i in range(len(ring)):
        j = i + 1 if i + 1 < len(ring) else 0
        x0, y0, x1, y1 = float(ring[i, 0]), float(ring[i, 1]), float(ring[j, 0]), float(ring[j, 1])
        if y0 == y1:
            continue
        top, bottom = pixel_range(min(y0, y1), max(y0, y1), y_min, step_y, len(inside))
        for row in range(top, bottom):
            y = y_min + (row + 0.5) * step_y
            if (y0 > y) == (y1 > y):
                continue
            crossing = (x1 - x0) * (y - y0) / (y1 - y0) + x0
            position = (crossing - x_min) / step_x - 0.5
            for col in range(math.ceil(min(max(position, 0.0), inside.shape[1]))):
                inside[row, col] ^= 1


@njit(nogil=True, cache=True)
def _buffers(shape):
    """Return a thread's scratch: column numbers, distances, owners, inside."""
    steps = np.arange(shape[1]).astype(np.float32)
    return steps, np.empty(shape, np.float32), np.empty(shape, np.int32), np.empty(shape, np.uint8)


@njit(nogil=True, cache=True)
def _survey(ring, closed, filled, frame, reach, eps, buffers):
    """Fill squared distances, infinite beyond the reach, nearest edges and, if filled, the inside.

    False, and nothing is filled, if a vertex is not finite.
    """
    if not np.isfinite(ring).all():
        return False
    steps, distances, owners, inside = buffers
    distances[:] = FAR
    owners[:] = -1
    for i in range(len(ring) if closed else len(ring) - 1):
        j = i + 1 if i + 1 < len(ring) else 0
        _visit_edge(ring[i], ring[j], np.int32(i), frame, reach, eps, steps, distances, owners)
    if filled:
        _fill_inside(ring, frame, inside)
    return True


@njit(inline="always")
def _measure(squared, nearest):
    """Return D: a squared distance as it is, or, if ``nearest`` > 0, the distance."""
    return max(math.sqrt(squared), nearest) if nearest > 0 else float(squared)


@njit(nogil=True, cache=True)
def soft_forward(rings, polygons, reach, softness, nearest, masks, first, last):
    """Write exp(-D / s), or a sigmoid of +-D / s for polygons; NaN for a vertex not finite.

    Closed float32 rings (N, V, 2) are in pixels. ``reach``, beyond which a mask is 0 or 1, and
    ``softness`` s are of lines and polygons. With ``nearest`` 0, D is the squared distance to the
    nearest edge; else D is the distance, or ``nearest`` where it is smaller, and there it has no
    gradient.
    """
    buffers = _buffers(masks.shape[1:])
    _, distances, owners, inside = buffers
    for n in range(first, last):
        kind = int(polygons[n])
        if not _survey(rings[n], True, kind, INTEGER_FRAME, reach[kind], LENGTH_EPS, buffers):
            masks[n] = np.nan
            continue
        for row in range(masks.shape[1]):
            for col in range(masks.shape[2]):
                fade = 0.0
                if owners[row, col] >= 0:
                    fade = math.exp(-_measure(distances[row, col], nearest) / softness[kind])
                if kind:
                    fade = (1.0 if inside[row, col] else fade) / (1 + fade)
                masks[n, row, col] = fade


@njit(nogil=True, cache=True)
def _scatter(ring, owner, x, y, weight, out):
    """Add weight * d(d^2) to the gradient of the two ends of a pixel's nearest edge."""
    following = owner + 1 if owner + 1 < len(ring) else 0
    x0, y0 = float(ring[owner, 0]), float(ring[owner, 1])
    ex, ey = float(ring[following, 0]) - x0, float(ring[following, 1]) - y0
    fx, fy = x - x0, y - y0
    length2 = ex * ex + ey * ey + LENGTH_EPS
    along = (fx * ex + fy * ey) / length2
    t = min(max(along, 0.0), 1.0)
    dx, dy = fx - t * ex, fy - t * ey
    # the eps moves t off the nearest point of an edge: between the ends t has a gradient of its own
    slip = 2 * t * LENGTH_EPS / length2 if 0.0 <= along <= 1.0 else 0.0
    end_x, end_y = -2 * t * dx - slip * (fx - 2 * t * ex), -2 * t * dy - slip * (fy - 2 * t * ey)
    out[following, 0] += weight * end_x
    out[following, 1] += weight * end_y
    out[owner, 0] += weight * (slip * ex - 2 * dx - end_x)
    out[owner, 1] += weight * (slip * ey - 2 * dy - end_y)


@njit(nogil=True, cache=True)
def soft_backward(rings, polygons, reach, softness, nearest, grads, out, first, last):
    """Write to ``out`` (N, V, 2), float64, the gradient in the rings of ``grads`` (N, H, W)."""
    buffers = _buffers(grads.shape[1:])
    _, distances, owners, inside = buffers
    for n in range(first, last):
        ring, kind = rings[n], int(polygons[n])
        out[n] = 0
        if not _survey(ring, True, kind, INTEGER_FRAME, reach[kind], LENGTH_EPS, buffers):
            out[n] = np.nan
            continue
        for row in range(grads.shape[1]):
            for col in range(grads.shape[2]):
                if owners[row, col] < 0 or grads[n, row, col] == 0:
                    continue
                distance = _measure(distances[row, col], nearest)
                fade = math.exp(-distance / softness[kind])
                slope = -fade
                if kind:
                    slope = (1.0 if inside[row, col] else -1.0) * fade / (1 + fade) ** 2
                weight = grads[n, row, col] * slope / softness[kind]
                if nearest > 0:
                    weight *= 0.5 / distance if distance > nearest else 0.0
                _scatter(ring, owners[row, col], col, row, weight, out[n])


@njit(nogil=True, cache=True)
def draw(polylines, filled, frame, half_width, pixel, masks, first, last):
    """Write masks of lines of a width, or of filled polygons; arguments as of `draw_reference`."""
    buffers = _buffers(masks.shape[1:])
    _, distances, _, inside = buffers
    for n in range(first, last):
        kind = filled[n]
        reach = pixel if kind else half_width + pixel
        if not _survey(polylines[n], kind, kind, frame, reach, 0.0, buffers):
            masks[n] = np.nan
            continue
        for row in range(masks.shape[1]):
            for col in range(masks.shape[2]):
                distance = math.sqrt(distances[row, col])
                if kind:
                    signed = distance if inside[row, col] else -distance
                    share = min(0.5 + signed / pixel, 1.0)
                else:
                    near = min((distance + half_width) / pixel, 0.5)
                    share = near - max((distance - half_width) / pixel, -0.5)
                masks[n, row, col] = max(share, 0.0)


def _settings(softness, plain):
    """Return the kernels' reach, softness and smallest distance."""
    reach = tuple(REACH * tau if plain else math.sqrt(REACH * tau) for tau in softness)
    return reach, tuple(softness), DISTANCE_EPS if plain else 0.0


def soft_rasters(rings, is_polygon, height, width, softness, plain):
    """Render closed float32 rings softly; see ``soft_rasters_reference``. (n, H, W)"""
    masks = torch.empty(len(rings), height, width, dtype=torch.float32)
    rules = _settings(softness, plain)
    run_in_threads(soft_forward, height * width, rings, is_polygon, *rules, masks)
    return masks


def soft_rasters_backward(grads, rings, is_polygon, height, width, softness, plain):
    """Return the gradient in the rings. (n, V, 2)"""
    gradients = torch.empty(rings.shape, dtype=torch.float64)
    rules = _settings(softness, plain)
    run_in_threads(soft_backward, height * width, rings, is_polygon, *rules, grads, gradients)
    return (gradients.float(),)


def draw_polylines(polylines, filled, height, width, frame, half_width, pixel):
    """Draw float32 polylines; see ``draw_reference``. (K, H, W)"""
    masks = torch.empty(len(polylines), height, width, dtype=torch.float32)
    pixels, frame = height * width, tuple(frame)
    run_in_threads(draw, pixels, polylines, filled, frame, half_width, pixel, masks)
    return masks
