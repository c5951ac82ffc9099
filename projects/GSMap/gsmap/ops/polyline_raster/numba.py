# numba infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Fused CPU kernels (numba): soft rasters of predictions, and drawn masks of ground truth.

Both are called masks below: one raster (H, W) for each element. A thread computes one element at a
time. For each edge and row, only the pixels within a reach of the edge are computed. Beyond the
reach, a pixel of a soft raster differs from 0 or 1 by less than 1e-8, and a drawn pixel is 0 or 1.

Three buffers per thread, each of the size of a mask, store the smallest squared distance of each
pixel, the index of its nearest edge, and whether it is inside of a polygon. There is no tensor per
edge. The backward pass computes the buffers again and adds the gradient of each pixel to the two
ends of its nearest edge, in float64 and in a fixed order, so repeated runs are bitwise equal.

In the options of the compiler, ``nogil`` lets the threads run in parallel.
"""

import math

import numpy as np
import torch
from numba import njit

from gsmap.ops._numba import FASTMATH, pixel_range, run_in_threads
from gsmap.ops.polyline_raster.reference import DISTANCE_EPS, LENGTH_EPS

FAR = np.float32(np.inf)  # squared distance of a pixel without an edge within reach
# Largest D / softness that counts, with D the distance (or its square) of a pixel from an edge.
# Farther pixels are 0 or 1.
REACH = -math.log(1e-8)
# Smallest x and y, and size of a pixel along x and y, of a raster in pixels. The centre of pixel
# (row, col) is at (x, y) = (col, row), as in the rasterizer of arXiv 2306.10502.
INTEGER_FRAME = (-0.5, -0.5, 1.0, 1.0)


# `FASTMATH` allows the compiler to reorder sums. With numpy's error model, a division by 0 raises
# no error. Both allow the inner loop to be computed in vector lanes.
@njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")
def _visit_edge(start, end, index, frame, reach, eps, columns, distances, edge_indices):
    """Update the squared distances and nearest edges of pixels (H, W) with one more edge.

    The edge from ``start`` to ``end`` has the number ``index``. ``eps`` is added to its squared
    length: `LENGTH_EPS` in soft rasters, as in Zhang et al.'s released code, and 0 in drawn masks.
    ``columns`` contains 0, 1, .. W - 1 as float32, so that the inner loop converts no integers.
    """
    x_min, y_min, step_x, step_y = frame
    height, width = distances.shape
    x0 = float(start[0])
    y0 = float(start[1])
    edge_x = float(end[0]) - x0
    edge_y = float(end[1]) - y0
    length = math.sqrt(edge_x * edge_x + edge_y * edge_y)
    # The lower limit avoids a division by 0 for an edge of length 0 if `eps` is 0. The edge is
    # prepared in float64, and the inner loop computes in float32.
    length2 = max(edge_x * edge_x + edge_y * edge_y + eps, 1e-38)
    along_x = np.float32(edge_x / length2)
    along_y = np.float32(edge_y / length2)
    ex = np.float32(edge_x)
    ey = np.float32(edge_y)
    pixel_width = np.float32(step_x)
    low_y = min(y0, y0 + edge_y) - reach
    high_y = max(y0, y0 + edge_y) + reach
    low_x = min(x0, x0 + edge_x) - reach
    high_x = max(x0, x0 + edge_x) + reach
    # First row, and one past the last row, whose centres lie in this interval.
    top, bottom = pixel_range(low_y, high_y, origin=y_min, step=step_y, size=height)
    for row in range(top, bottom):
        offset_y = y_min + (row + 0.5) * step_y - y0
        left_x = low_x
        right_x = high_x
        # Unless the edge is nearly horizontal, only a part of the row is within the reach of the
        # infinite line through the edge: `half` to both sides of the crossing with this line.
        if abs(edge_y) > 1e-6 * length:
            crossing = x0 + offset_y * edge_x / edge_y
            half = reach * length / abs(edge_y)
            left_x = max(left_x, crossing - half)
            right_x = min(right_x, crossing + half)
        left, right = pixel_range(left_x, right_x, origin=x_min, step=step_x, size=width)
        stop = max(left, right)  # without a pixel in reach, `right` may be less than `left`
        nearest = distances[row, left:stop]
        row_indices = edge_indices[row, left:stop]
        first_x = np.float32(x_min + (left + 0.5) * step_x - x0)
        fy = np.float32(offset_y)
        for k in range(len(nearest)):
            fx = first_x + columns[k] * pixel_width
            # Position of the nearest point of the edge, 0 at its start and 1 at its end.
            t = min(max(fx * along_x + fy * along_y, np.float32(0)), np.float32(1))
            dx = fx - t * ex
            dy = fy - t * ey
            squared = dx * dx + dy * dy
            closer = squared < nearest[k]
            nearest[k] = squared if closer else nearest[k]
            row_indices[k] = index if closer else row_indices[k]


@njit(nogil=True, cache=True)
def _fill_inside(ring, frame, inside):
    """Set pixels (H, W) to 1 inside the closed ring by the even-odd rule, and to 0 outside."""
    x_min, y_min, step_x, step_y = frame
    inside[:] = 0
    for i in range(len(ring)):
        j = i + 1 if i + 1 < len(ring) else 0
        x0 = float(ring[i, 0])
        y0 = float(ring[i, 1])
        x1 = float(ring[j, 0])
        y1 = float(ring[j, 1])
        if y0 == y1:  # a horizontal edge crosses no row
            continue
        top, bottom = pixel_range(
            min(y0, y1), max(y0, y1), origin=y_min, step=step_y, size=len(inside)
        )
        # Rounding may leave out a row whose centre is at a vertex: one more is tested on each side.
        for row in range(max(top - 1, 0), min(bottom + 1, len(inside))):
            y = y_min + (row + 0.5) * step_y
            if (y0 > y) == (y1 > y):  # both ends are on one side of the row
                continue
            crossing = (x1 - x0) * (y - y0) / (y1 - y0) + x0
            position = (crossing - x_min) / step_x - 0.5  # fractional column of the crossing
            # The edge is to the right of these pixels: it changes them between outside and inside.
            for col in range(math.ceil(min(max(position, 0.0), inside.shape[1]))):
                inside[row, col] ^= 1


@njit(nogil=True, cache=True)
def _buffers(shape):
    """Buffers of a thread: column indices (W,), squared distances, nearest edges, inside (H, W)."""
    columns = np.arange(shape[1]).astype(np.float32)
    distances = np.empty(shape, np.float32)
    edge_indices = np.empty(shape, np.int32)
    inside = np.empty(shape, np.uint8)
    return columns, distances, edge_indices, inside


@njit(nogil=True, cache=True)
def _nearest_edges(ring, closed, filled, frame, reach, eps, buffers):
    """Compute the distances, nearest edges and inside of `_buffers` for one polyline or ring.

    Beyond the reach, squared distances are infinite and indices of edges -1. The inside is computed
    only if ``filled``. If ``closed``, there is also an edge from the last vertex to the first one.

    Returns True, or False if a vertex is not finite. The buffers then stay as they are.
    """
    if not np.isfinite(ring).all():
        return False
    columns, distances, edge_indices, inside = buffers
    distances[:] = FAR
    edge_indices[:] = -1
    for i in range(len(ring) if closed else len(ring) - 1):
        j = i + 1 if i + 1 < len(ring) else 0
        _visit_edge(
            ring[i],
            ring[j],
            index=np.int32(i),
            frame=frame,
            reach=reach,
            eps=eps,
            columns=columns,
            distances=distances,
            edge_indices=edge_indices,
        )
    if filled:
        _fill_inside(ring, frame, inside=inside)
    return True


@njit(inline="always")
def _clamped_distance(squared, min_distance):
    """Return D, from which a pixel of a soft raster is computed.

    If ``min_distance`` is 0, D is the squared distance. Otherwise it is the distance, with
    ``min_distance`` as its lower limit.
    """
    return max(math.sqrt(squared), min_distance) if min_distance > 0 else float(squared)


@njit(nogil=True, cache=True)
def soft_forward(rings, polygons, reach, softness, min_distance, masks, first, last):
    """Render the rings ``first`` to ``last - 1``.

    A pixel of a line is exp(-D / s). A pixel of a polygon is sigmoid(D / s) inside the ring and
    sigmoid(-D / s) outside.

    Args:
        rings: Vertices of closed rings in pixels, float32. The ring of a line goes along the line
            and back. (N, V, 2)
        polygons: Whether a ring is a polygon instead of a line, bool. (N,)
        reach: Distance in pixels beyond which a mask is 0 or 1, of lines and of polygons. (2,)
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        min_distance: 0 if D is the squared distance to the nearest edge. Otherwise D is the
            distance, and ``min_distance`` its smallest value, at which it has no gradient.
        masks: Output for the masks, float32; NaN for a ring with a vertex that is not finite.
            (N, H, W)
        first: First ring.
        last: One past the last ring.
    """
    buffers = _buffers(masks.shape[1:])
    _, distances, edge_indices, inside = buffers
    for n in range(first, last):
        kind = int(polygons[n])  # 0 for a line, 1 for a polygon
        is_finite = _nearest_edges(
            rings[n],
            closed=True,
            filled=kind,
            frame=INTEGER_FRAME,
            reach=reach[kind],
            eps=LENGTH_EPS,
            buffers=buffers,
        )
        if not is_finite:
            masks[n] = np.nan
            continue
        for row in range(masks.shape[1]):
            for col in range(masks.shape[2]):
                fade = 0.0
                if edge_indices[row, col] >= 0:  # an edge is within reach
                    distance = _clamped_distance(distances[row, col], min_distance)
                    fade = math.exp(-distance / softness[kind])
                value = fade
                # For a polygon, sigmoid(D / s) = 1 / (1 + fade) inside, and
                # sigmoid(-D / s) = fade / (1 + fade) outside.
                if kind:
                    value = (1.0 if inside[row, col] else fade) / (1 + fade)
                masks[n, row, col] = value


@njit(nogil=True, cache=True)
def _scatter(ring, edge_index, x, y, weight, out):
    """Add ``weight`` times the gradient of the squared distance of a pixel to both ends of an edge.

    The pixel is at (``x``, ``y``). ``out`` has the gradients of the vertices of ``ring``. (V, 2)
    """
    following = edge_index + 1 if edge_index + 1 < len(ring) else 0
    x0 = float(ring[edge_index, 0])
    y0 = float(ring[edge_index, 1])
    ex = float(ring[following, 0]) - x0
    ey = float(ring[following, 1]) - y0
    fx = x - x0
    fy = y - y0
    length2 = ex * ex + ey * ey + LENGTH_EPS
    along = (fx * ex + fy * ey) / length2
    t = min(max(along, 0.0), 1.0)
    dx = fx - t * ex
    dy = fy - t * ey
    # With e = end - start, f = pixel - start and t = f . e / length2, limited to [0, 1], the offset
    # of the pixel from the point at t of the edge is d = f - t e. The squared distance is
    # Q = d . d. Because length2 contains LENGTH_EPS, this point is not exactly the nearest one:
    # between the ends, dQ/dt = -2 d . e = -2 t LENGTH_EPS is not 0. The derivatives of t are
    # dt/de = (f - 2 t e) / length2 and dt/df = e / length2. With slip = 2 t LENGTH_EPS / length2
    # (0 beyond the ends, where t is constant), the derivatives of Q are
    # dQ/de = -2 t d - slip (f - 2 t e) and dQ/df = 2 d - slip e.
    # The gradient is dQ/de for the end, and -dQ/df - dQ/de for the start.
    slip = 2 * t * LENGTH_EPS / length2 if 0.0 <= along <= 1.0 else 0.0
    end_x = -2 * t * dx - slip * (fx - 2 * t * ex)
    end_y = -2 * t * dy - slip * (fy - 2 * t * ey)
    out[following, 0] += weight * end_x
    out[following, 1] += weight * end_y
    out[edge_index, 0] += weight * (slip * ex - 2 * dx - end_x)
    out[edge_index, 1] += weight * (slip * ey - 2 * dy - end_y)


@njit(nogil=True, cache=True)
def soft_backward(rings, polygons, reach, softness, min_distance, grads, out, first, last):
    """Compute the gradients of the rings ``first`` to ``last - 1``.

    Args:
        rings: Vertices of closed rings in pixels, float32. (N, V, 2)
        polygons: Whether a ring is a polygon, bool. (N,)
        reach: Distance in pixels beyond which a mask is 0 or 1, of lines and of polygons. (2,)
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        min_distance: 0 if D is the squared distance to the nearest edge. Otherwise D is the
            distance, and ``min_distance`` its smallest value, at which it has no gradient.
        grads: Gradient of the masks, float32. (N, H, W)
        out: Output for the gradient of the rings, float64; NaN for a ring with a vertex that is not
            finite. (N, V, 2)
        first: First ring.
        last: One past the last ring.
    """
    buffers = _buffers(grads.shape[1:])
    _, distances, edge_indices, inside = buffers
    for n in range(first, last):
        ring = rings[n]
        kind = int(polygons[n])  # 0 for a line, 1 for a polygon
        out[n] = 0
        is_finite = _nearest_edges(
            ring,
            closed=True,
            filled=kind,
            frame=INTEGER_FRAME,
            reach=reach[kind],
            eps=LENGTH_EPS,
            buffers=buffers,
        )
        if not is_finite:
            out[n] = np.nan
            continue
        for row in range(grads.shape[1]):
            for col in range(grads.shape[2]):
                # Pixels without an edge within reach have no gradient.
                if edge_indices[row, col] < 0 or grads[n, row, col] == 0:
                    continue
                distance = _clamped_distance(distances[row, col], min_distance)
                fade = math.exp(-distance / softness[kind])
                slope = -fade  # derivative of the mask by D / s
                if kind:  # derivative of the sigmoid, negative outside
                    slope = (1.0 if inside[row, col] else -1.0) * fade / (1 + fade) ** 2
                weight = grads[n, row, col] * slope / softness[kind]  # gradient of D
                if min_distance > 0:  # gradient of the squared distance, whose root is D
                    weight *= 0.5 / distance if distance > min_distance else 0.0
                _scatter(ring, edge_indices[row, col], x=col, y=row, weight=weight, out=out[n])


@njit(nogil=True, cache=True)
def draw(polylines, filled, frame, half_width, pixel, masks, first, last):
    """Draw the polylines ``first`` to ``last - 1`` as lines or filled polygons.

    Args:
        polylines: Vertices in metres, float32. (K, P, 2)
        filled: Whether a polyline is filled as a polygon, bool. (K,)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        half_width: Half the width of a line in metres.
        pixel: Side in metres of a square with the area of a pixel, whose sides may differ.
        masks: Output for the masks, float32; NaN for a polyline with a vertex that is not finite.
            (K, H, W)
        first: First polyline.
        last: One past the last polyline.
    """
    buffers = _buffers(masks.shape[1:])
    _, distances, _, inside = buffers
    for n in range(first, last):
        kind = filled[n]  # True for a filled polygon, False for a line
        reach = pixel if kind else half_width + pixel
        is_finite = _nearest_edges(
            polylines[n],
            closed=kind,
            filled=kind,
            frame=frame,
            reach=reach,
            eps=0.0,
            buffers=buffers,
        )
        if not is_finite:
            masks[n] = np.nan
            continue
        for row in range(masks.shape[1]):
            for col in range(masks.shape[2]):
                distance = math.sqrt(distances[row, col])
                # `share` is the share of the pixel's area that the shape covers. It is computed
                # across the edge or line, on which the pixel is an interval of length `pixel`.
                if kind:
                    # The edge cuts the interval at the signed distance from the pixel's centre.
                    signed = distance if inside[row, col] else -distance
                    share = min(0.5 + signed / pixel, 1.0)
                else:
                    # Overlap of two intervals across the line, in pixels: the line, `half_width`
                    # to both sides of `distance`, and the pixel, -0.5 to 0.5.
                    high = min((distance + half_width) / pixel, 0.5)
                    low = max((distance - half_width) / pixel, -0.5)
                    share = high - low
                masks[n, row, col] = max(share, 0.0)


def _reach(softness, plain):
    """Distance in pixels beyond which masks are 0 or 1, of lines and of polygons.

    D is the distance if ``plain``, and otherwise its square, so the root of its limit is taken.
    """
    line, polygon = softness
    if plain:
        return REACH * line, REACH * polygon
    return math.sqrt(REACH * line), math.sqrt(REACH * polygon)


def soft_rasters(rings, is_polygon, height, width, softness, plain):
    """Render closed rings softly, as `soft_rasters_reference` does in plain torch.

    Args:
        rings: Vertices of closed rings in pixels, float32. (n, V, 2)
        is_polygon: Whether a ring is a polygon, bool. (n,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        plain: Whether D is the distance to the nearest edge instead of its square.

    Returns:
        Masks in [0, 1], float32. (n, H, W)
    """
    masks = torch.empty(len(rings), height, width, dtype=torch.float32)
    reach = _reach(softness, plain)
    min_distance = DISTANCE_EPS if plain else 0.0
    pixels = height * width
    # `run_in_threads` cuts the rings into one slice per thread. It calls the kernel with these
    # arguments, in which tensors are arrays on their memory, and the bounds `first` and `last` of a
    # slice.
    run_in_threads(
        soft_forward, pixels, rings, is_polygon, reach, tuple(softness), min_distance, masks
    )
    return masks


def soft_rasters_backward(grads, rings, is_polygon, height, width, softness, plain):
    """Compute the gradient of `soft_rasters`.

    Args:
        grads: Gradient of the masks, float32. (n, H, W)
        rings: Vertices of closed rings in pixels, float32. (n, V, 2)
        is_polygon: Whether a ring is a polygon, bool. (n,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        plain: Whether D is the distance to the nearest edge instead of its square.

    Returns:
        Tuple with one entry, the gradient of the rings, float32. (n, V, 2) The caller
        (`fused_operator`) takes a sequence with one gradient per differentiable argument.
    """
    out = torch.empty(rings.shape, dtype=torch.float64)
    reach = _reach(softness, plain)
    min_distance = DISTANCE_EPS if plain else 0.0
    pixels = height * width
    run_in_threads(
        soft_backward, pixels, rings, is_polygon, reach, tuple(softness), min_distance, grads, out
    )
    return (out.float(),)


def draw_polylines(polylines, filled, height, width, frame, half_width, pixel):
    """Draw polylines and filled polygons, as `draw_reference` does in plain torch.

    Args:
        polylines: Vertices in metres, float32. (K, P, 2)
        filled: Whether a polyline is filled as a polygon, bool. (K,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        half_width: Half the width of a line in metres.
        pixel: Side in metres of a square with the area of a pixel.

    Returns:
        Masks in [0, 1], float32. (K, H, W)
    """
    masks = torch.empty(len(polylines), height, width, dtype=torch.float32)
    pixels = height * width
    run_in_threads(draw, pixels, polylines, filled, tuple(frame), half_width, pixel, masks)
    return masks
