# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: fixed kernels around projected points, forward and backward in one launch each.

A row is the output of one head of one BEV cell, with all channels of the head. A program computes
several rows, neighbours on the map, and loops over the cameras. A camera to which none of its cells
is visible is skipped by a scalar branch. Sums are float32 for every type of the maps.

Products and sums are not fused, so that rounding a sum gives the pixel of plain torch. The gradient
of the maps is added by atomics, in any order. The gradient of the weights is accumulated in
registers, and each entry of the gradient of the points is written by one program.
"""

import torch
import triton
import triton.language as tl

from gsmap.ops.deformable_sampling.triton import BLOCK, find_corner

OPTIONS = {"num_warps": 4, "enable_fp_fusion": False}
ROUNDING = tl.constexpr(12582912.0)  # 1.5 * 2^23, whose float32 neighbours are whole numbers


@triton.jit
def _nearest(position, size):
    """Nearest row or column of the map, rounded half to even."""
    position = tl.minimum(tl.maximum(position, 0.0), size - 1.0)
    return ((position + ROUNDING) - ROUNDING).to(tl.int32)


@triton.jit
def _rows(rows, queries, heads, views, C: tl.constexpr, CP: tl.constexpr, ROWS: tl.constexpr):
    """Rows of a program and their validity, image of the first camera, cell, head, channels."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    cell = row // heads
    head = row % heads
    batch = cell // queries
    query = cell % queries
    image = batch * views
    channel = tl.arange(0, CP)
    return row, row < rows, image, query, head, channel


@triton.jit
def forward_kernel(
    value,
    uv,
    weights,
    seen,
    offsets,
    out,
    rows,
    queries,
    heads,
    views,
    height,
    width,
    BILINEAR: tl.constexpr,
    S: tl.constexpr,
    C: tl.constexpr,
    CP: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Sum weighted pixels of all cameras for ``ROWS`` rows.

    Args:
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map, float32.
            (B, V, Q, heads, 2)
        weights: Weights of the pixels, float32. (B, Q, heads, S)
        seen: Whether a cell is visible to a camera, uint8. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        out: Output for the sums, float32. (B, Q, heads, C)
        rows: Number of rows, B * Q * heads.
        queries: Number Q of BEV cells.
        heads: Number of heads.
        views: Number V of cameras.
        height: Rows h of a map.
        width: Columns w of a map.
        BILINEAR: Interpolate between pixels instead of rounding to one.
        S: Number of pixels of a kernel.
        C: Number of channels of a head.
        CP: C rounded up to a power of two.
        ROWS: Number of rows of a program.
    """
    row, ok, image, query, head, channel = _rows(
        rows, queries, heads=heads, views=views, C=C, CP=CP, ROWS=ROWS
    )
    exists = channel < C
    total = tl.zeros((ROWS, CP), dtype=tl.float32)
    for view in range(views):
        projection = (image + view) * queries + query
        visible = tl.load(seen + projection, mask=ok, other=0) != 0
        if tl.max(visible.to(tl.int32), axis=0) != 0:
            point = (projection * heads + head) * 2
            x = tl.load(uv + point, mask=visible, other=0.0) * width
            y = tl.load(uv + point + 1, mask=visible, other=0.0) * height
            start = ((image + view) * height * width * heads + head) * C
            for s in range(S):
                weight = tl.load(weights + row * S + s, mask=visible, other=0.0)
                at_x = x + tl.load(offsets + 2 * s).to(tl.float32)
                at_y = y + tl.load(offsets + 2 * s + 1).to(tl.float32)
                if BILINEAR:
                    at_x = at_x - 0.5
                    at_y = at_y - 0.5
                    left = tl.floor(at_x)
                    top = tl.floor(at_y)
                    dx = at_x - left
                    dy = at_y - top
                    for corner in tl.static_range(4):
                        cell, inside = find_corner(
                            left + corner % 2,
                            top + corner // 2,
                            ok=visible,
                            height=height,
                            width=width,
                        )
                        across = dx if corner % 2 else 1 - dx
                        down = dy if corner // 2 else 1 - dy
                        share = weight * across * down
                        at = (start + cell * (heads * C))[:, None] + channel[None, :]
                        mask = inside[:, None] & exists[None, :]
                        pixel = tl.load(value + at, mask=mask, other=0.0).to(tl.float32)
                        total += pixel * (share * inside.to(tl.float32))[:, None]
                else:
                    cell = _nearest(at_y, height) * width + _nearest(at_x, width)
                    at = (start + cell * (heads * C))[:, None] + channel[None, :]
                    mask = visible[:, None] & exists[None, :]
                    pixel = tl.load(value + at, mask=mask, other=0.0).to(tl.float32)
                    total += pixel * weight[:, None]
    output = out + row[:, None] * C + channel[None, :]
    tl.store(output, total, mask=ok[:, None] & exists[None, :])


@triton.jit
def backward_kernel(
    grads,
    value,
    uv,
    weights,
    seen,
    offsets,
    grad_value,
    grad_uv,
    grad_weights,
    rows,
    queries,
    heads,
    views,
    height,
    width,
    BILINEAR: tl.constexpr,
    S: tl.constexpr,
    SP: tl.constexpr,
    C: tl.constexpr,
    CP: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Compute the gradients of ``ROWS`` rows.

    Args:
        grads: Gradient of the sums, float32. (B, Q, heads, C)
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map, float32.
            (B, V, Q, heads, 2)
        weights: Weights of the pixels, float32. (B, Q, heads, S)
        seen: Whether a cell is visible to a camera, uint8. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        grad_value: Output, float32, to which the gradient of the maps is added.
            (B, V, h * w, heads, C)
        grad_uv: Output, filled with zeros, for the gradient of the points. (B, V, Q, heads, 2)
        grad_weights: Output for the gradient of the weights. (B, Q, heads, S)
        rows: Number of rows, B * Q * heads.
        queries: Number Q of BEV cells.
        heads: Number of heads.
        views: Number V of cameras.
        height: Rows h of a map.
        width: Columns w of a map.
        BILINEAR: Interpolate between pixels instead of rounding to one.
        S: Number of pixels of a kernel.
        SP: S rounded up to a power of two.
        C: Number of channels of a head.
        CP: C rounded up to a power of two.
        ROWS: Number of rows of a program.
    """
    row, ok, image, query, head, channel = _rows(
        rows, queries, heads=heads, views=views, C=C, CP=CP, ROWS=ROWS
    )
    exists = channel < C
    output = grads + row[:, None] * C + channel[None, :]
    grad = tl.load(output, mask=ok[:, None] & exists[None, :], other=0.0)
    index = tl.arange(0, SP)
    row_grads = tl.zeros((ROWS, SP), dtype=tl.float32)
    for view in range(views):
        projection = (image + view) * queries + query
        visible = tl.load(seen + projection, mask=ok, other=0) != 0
        if tl.max(visible.to(tl.int32), axis=0) != 0:
            point = (projection * heads + head) * 2
            x = tl.load(uv + point, mask=visible, other=0.0) * width
            y = tl.load(uv + point + 1, mask=visible, other=0.0) * height
            start = ((image + view) * height * width * heads + head) * C
            grad_x = tl.zeros((ROWS,), dtype=tl.float32)
            grad_y = tl.zeros((ROWS,), dtype=tl.float32)
            for s in range(S):
                weight = tl.load(weights + row * S + s, mask=visible, other=0.0)
                at_x = x + tl.load(offsets + 2 * s).to(tl.float32)
                at_y = y + tl.load(offsets + 2 * s + 1).to(tl.float32)
                grad_weight = tl.zeros((ROWS,), dtype=tl.float32)
                if BILINEAR:
                    at_x = at_x - 0.5
                    at_y = at_y - 0.5
                    left = tl.floor(at_x)
                    top = tl.floor(at_y)
                    dx = at_x - left
                    dy = at_y - top
                    for corner in tl.static_range(4):
                        cell, inside = find_corner(
                            left + corner % 2,
                            top + corner // 2,
                            ok=visible,
                            height=height,
                            width=width,
                        )
                        across = dx if corner % 2 else 1 - dx
                        down = dy if corner // 2 else 1 - dy
                        at = (start + cell * (heads * C))[:, None] + channel[None, :]
                        mask = inside[:, None] & exists[None, :]
                        pixel = tl.load(value + at, mask=mask, other=0.0).to(tl.float32)
                        share = grad * (weight * across * down)[:, None]
                        tl.atomic_add(grad_value + at, share, mask=mask, sem="relaxed")
                        product = tl.sum(grad * pixel, axis=1)
                        grad_weight += product * across * down
                        grad_x += product * weight * down * (1 if corner % 2 else -1)
                        grad_y += product * weight * across * (1 if corner // 2 else -1)
                else:
                    cell = _nearest(at_y, height) * width + _nearest(at_x, width)
                    at = (start + cell * (heads * C))[:, None] + channel[None, :]
                    mask = visible[:, None] & exists[None, :]
                    pixel = tl.load(value + at, mask=mask, other=0.0).to(tl.float32)
                    share = grad * weight[:, None]
                    tl.atomic_add(grad_value + at, share, mask=mask, sem="relaxed")
                    grad_weight += tl.sum(grad * pixel, axis=1)
                row_grads += tl.where(index[None, :] == s, grad_weight[:, None], 0.0)
            if BILINEAR:
                tl.store(grad_uv + point, grad_x * width, mask=visible)
                tl.store(grad_uv + point + 1, grad_y * height, mask=visible)
    sums = grad_weights + row[:, None] * S + index[None, :]
    tl.store(sums, row_grads, mask=ok[:, None] & (index < S)[None, :])


def _layout(value, weights):
    """Number of rows, sizes that are compiled in, and grid of the programs."""
    batch, queries, heads, samples = weights.shape
    channels = value.shape[4]
    padded_channels = max(16, triton.next_power_of_2(channels))
    rows_each = max(1, BLOCK // padded_channels)
    rows = batch * queries * heads
    sizes = {"S": samples, "C": channels, "CP": padded_channels, "ROWS": rows_each}
    return rows, sizes, (triton.cdiv(rows, rows_each),)


def sample_kernels(value, uv, weights, seen, offsets, height, width, bilinear):
    """Sum weighted pixels around the projections of each BEV cell, over all cameras.

    Args:
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map, float32.
            (B, V, Q, heads, 2)
        weights: Weights of the pixels, float32. (B, Q, heads, S)
        seen: Whether a cell is visible to a camera, bool. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        height: Rows h of a map.
        width: Columns w of a map.
        bilinear: Interpolate between pixels instead of rounding to one.

    Returns:
        Sums, float32. (B, Q, heads, C)
    """
    batch, queries, heads, _ = weights.shape
    shape = (batch, queries, heads, value.shape[4])
    out = torch.empty(shape, dtype=torch.float32, device=value.device)
    if out.numel():
        rows, sizes, grid = _layout(value, weights)
        with torch.cuda.device_of(value):
            forward_kernel[grid](
                value.contiguous(),
                uv.contiguous(),
                weights=weights.contiguous(),
                seen=seen.contiguous().view(torch.uint8),
                offsets=offsets.contiguous(),
                out=out,
                rows=rows,
                queries=queries,
                heads=heads,
                views=value.shape[1],
                height=height,
                width=width,
                BILINEAR=bilinear,
                **sizes,
                **OPTIONS,
            )
    return out


def sample_kernels_backward(grads, value, uv, weights, seen, offsets, height, width, bilinear):
    """Compute the gradients of `sample_kernels`.

    Args:
        grads: Gradient of the sums, float32. (B, Q, heads, C)
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map, float32.
            (B, V, Q, heads, 2)
        weights: Weights of the pixels, float32. (B, Q, heads, S)
        seen: Whether a cell is visible to a camera, bool. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        height: Rows h of a map.
        width: Columns w of a map.
        bilinear: Interpolate between pixels instead of rounding to one.

    Returns:
        Gradients of the maps, the points and the weights.
    """
    grad_value = torch.zeros(value.shape, dtype=torch.float32, device=value.device)
    grad_uv = torch.zeros(uv.shape, dtype=torch.float32, device=value.device)
    grad_weights = torch.zeros(weights.shape, dtype=torch.float32, device=value.device)
    if grads.numel():
        rows, sizes, grid = _layout(value, weights)
        with torch.cuda.device_of(value):
            backward_kernel[grid](
                grads.contiguous(),
                value.contiguous(),
                uv=uv.contiguous(),
                weights=weights.contiguous(),
                seen=seen.contiguous().view(torch.uint8),
                offsets=offsets.contiguous(),
                grad_value=grad_value,
                grad_uv=grad_uv,
                grad_weights=grad_weights,
                rows=rows,
                queries=weights.shape[1],
                heads=weights.shape[2],
                views=value.shape[1],
                height=height,
                width=width,
                BILINEAR=bilinear,
                SP=triton.next_power_of_2(sizes["S"]),
                **sizes,
                **OPTIONS,
            )
    return grad_value.to(value.dtype), grad_uv, grad_weights
