# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: deformable sampling of a map, forward and backward in one launch each.

A row is the output of one head of one query, with all channels of the head. A program computes as
many rows as fill ``BLOCK`` values. Sums are float32 for every type of the map. Cells outside of the
map count as zero, and a NaN location makes only its row NaN.

The gradient of the map is added by atomics in any order, so repeated runs differ in the last bits.
No launch waits for the device, and nothing is autotuned.
"""

import torch
import triton
import triton.language as tl

BLOCK = 512  # values of a program: 16 bytes per thread in float32
OPTIONS = {"num_warps": 4, "enable_fp_fusion": True}


@triton.jit
def _locate(locations, weights, sample, ok, height, width):
    """Upper left cell of a sample (col, row), its distances from that cell, its weight. (ROWS,)"""
    x = tl.load(locations + sample * 2, mask=ok, other=0.0) * width - 0.5
    y = tl.load(locations + sample * 2 + 1, mask=ok, other=0.0) * height - 0.5
    col = tl.floor(x)
    row = tl.floor(y)
    weight = tl.load(weights + sample, mask=ok, other=0.0)
    return col, row, x - col, y - row, weight


@triton.jit
def find_corner(col, row, ok, height, width):
    """Find the flat index of a cell of a map.

    Args:
        col: Column of the cell, a whole number, also outside of the map. (ROWS,)
        row: Row of the cell. (ROWS,)
        ok: Whether the sample exists. (ROWS,)
        height: Number of rows of the map.
        width: Number of columns of the map.

    Returns:
        Index of the cell, zero outside of the map, and whether it lies on the map. (ROWS,)
    """
    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height) & ok
    cell_row = tl.where(inside, row, 0.0).to(tl.int32)
    cell_col = tl.where(inside, col, 0.0).to(tl.int32)
    return cell_row * width + cell_col, inside


@triton.jit
def _rows(rows, queries, heads, cells, C: tl.constexpr, CP: tl.constexpr, ROWS: tl.constexpr):
    """Rows of a program and their validity, start of their maps, channels and their validity."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    batch = row // (queries * heads)
    head = row % heads
    start = (batch * cells * heads + head) * C
    channel = tl.arange(0, CP)
    return row, row < rows, start, channel, channel < C


@triton.jit
def forward_kernel(
    value,
    locations,
    weights,
    out,
    rows,
    queries,
    heads,
    height,
    width,
    S: tl.constexpr,
    C: tl.constexpr,
    CP: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Sum weighted samples of a map for ``ROWS`` rows.

    Args:
        value: Flattened maps, row-major. (B, H * W, heads, C)
        locations: Sampling points (x, y), [0, 1] over the map, float32. (B, Q, heads, S, 2)
        weights: Attention weights, float32. (B, Q, heads, S)
        out: Output for the sums, float32. (B, Q, heads, C)
        rows: Number of rows, B * Q * heads.
        queries: Number Q of queries.
        heads: Number of heads.
        height: Rows H of the map.
        width: Columns W of the map.
        S: Number of samples of a head.
        C: Number of channels of a head.
        CP: C rounded up to a power of two.
        ROWS: Number of rows of a program.
    """
    row, ok, start, channel, exists = _rows(
        rows, queries, heads=heads, cells=height * width, C=C, CP=CP, ROWS=ROWS
    )
    total = tl.zeros((ROWS, CP), dtype=tl.float32)
    for s in range(S):
        left, top, dx, dy, weight = _locate(
            locations, weights, sample=row * S + s, ok=ok, height=height, width=width
        )
        for corner in tl.static_range(4):
            cell, inside = find_corner(
                left + corner % 2, top + corner // 2, ok=ok, height=height, width=width
            )
            across = dx if corner % 2 else 1 - dx
            down = dy if corner // 2 else 1 - dy
            share = weight * across * down
            at = (start + cell * (heads * C))[:, None] + channel[None, :]
            mask = inside[:, None] & exists[None, :]
            pixel = tl.load(value + at, mask=mask, other=0.0).to(tl.float32)
            # A product instead of tl.where keeps a NaN share outside of the map.
            total += pixel * (share * inside.to(tl.float32))[:, None]
    output = out + row[:, None] * C + channel[None, :]
    tl.store(output, total, mask=ok[:, None] & exists[None, :])


@triton.jit
def backward_kernel(
    grads,
    value,
    locations,
    weights,
    grad_value,
    grad_locations,
    grad_weights,
    rows,
    queries,
    heads,
    height,
    width,
    S: tl.constexpr,
    C: tl.constexpr,
    CP: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Compute the gradients of ``ROWS`` rows.

    Args:
        grads: Gradient of the sums, float32. (B, Q, heads, C)
        value: Flattened maps, row-major. (B, H * W, heads, C)
        locations: Sampling points (x, y), [0, 1] over the map, float32. (B, Q, heads, S, 2)
        weights: Attention weights, float32. (B, Q, heads, S)
        grad_value: Output, float32, to which the gradient of the maps is added.
            (B, H * W, heads, C)
        grad_locations: Output for the gradient of the sampling points. (B, Q, heads, S, 2)
        grad_weights: Output for the gradient of the weights. (B, Q, heads, S)
        rows: Number of rows, B * Q * heads.
        queries: Number Q of queries.
        heads: Number of heads.
        height: Rows H of the map.
        width: Columns W of the map.
        S: Number of samples of a head.
        C: Number of channels of a head.
        CP: C rounded up to a power of two.
        ROWS: Number of rows of a program.
    """
    row, ok, start, channel, exists = _rows(
        rows, queries, heads=heads, cells=height * width, C=C, CP=CP, ROWS=ROWS
    )
    output = grads + row[:, None] * C + channel[None, :]
    grad = tl.load(output, mask=ok[:, None] & exists[None, :], other=0.0)
    for s in range(S):
        sample = row * S + s
        left, top, dx, dy, weight = _locate(
            locations, weights, sample=sample, ok=ok, height=height, width=width
        )
        grad_weight = tl.zeros((ROWS,), dtype=tl.float32)
        grad_x = tl.zeros((ROWS,), dtype=tl.float32)
        grad_y = tl.zeros((ROWS,), dtype=tl.float32)
        for corner in tl.static_range(4):
            cell, inside = find_corner(
                left + corner % 2, top + corner // 2, ok=ok, height=height, width=width
            )
            across = dx if corner % 2 else 1 - dx
            down = dy if corner // 2 else 1 - dy
            at = (start + cell * (heads * C))[:, None] + channel[None, :]
            mask = inside[:, None] & exists[None, :]
            pixel = tl.load(value + at, mask=mask, other=0.0).to(tl.float32)
            share = weight * across * down
            tl.atomic_add(grad_value + at, grad * share[:, None], mask=mask, sem="relaxed")
            product = tl.sum(grad * pixel, axis=1)
            grad_weight += product * across * down
            grad_x += product * down * (1 if corner % 2 else -1)
            grad_y += product * across * (1 if corner // 2 else -1)
        tl.store(grad_weights + sample, grad_weight, mask=ok)
        tl.store(grad_locations + sample * 2, grad_x * weight * width, mask=ok)
        tl.store(grad_locations + sample * 2 + 1, grad_y * weight * height, mask=ok)


def _layout(value, weights):
    """Number of rows, sizes that are compiled in, and grid of the programs."""
    channels = value.shape[3]
    padded_channels = max(16, triton.next_power_of_2(channels))
    rows_each = max(1, BLOCK // padded_channels)
    rows = weights.shape[:3].numel()
    sizes = {"S": weights.shape[3], "C": channels, "CP": padded_channels, "ROWS": rows_each}
    return rows, sizes, (triton.cdiv(rows, rows_each),)


def deformable_sample(value, locations, weights, height, width):
    """Sum weighted bilinear samples of a map.

    Args:
        value: Flattened maps, row-major. (B, H * W, heads, C)
        locations: Sampling points (x, y), [0, 1] over the map, float32. (B, Q, heads, S, 2)
        weights: Attention weights, float32. (B, Q, heads, S)
        height: Rows H of the map.
        width: Columns W of the map.

    Returns:
        Sums, float32. (B, Q, heads, C)
    """
    batch, queries, heads, _ = weights.shape
    shape = (batch, queries, heads, value.shape[3])
    out = torch.empty(shape, dtype=torch.float32, device=value.device)
    if out.numel():
        rows, sizes, grid = _layout(value, weights)
        with torch.cuda.device_of(value):
            forward_kernel[grid](
                value.contiguous(),
                locations.contiguous(),
                weights=weights.contiguous(),
                out=out,
                rows=rows,
                queries=queries,
                heads=heads,
                height=height,
                width=width,
                **sizes,
                **OPTIONS,
            )
    return out


def deformable_sample_backward(grads, value, locations, weights, height, width):
    """Compute the gradients of `deformable_sample`.

    Args:
        grads: Gradient of the sums, float32. (B, Q, heads, C)
        value: Flattened maps, row-major. (B, H * W, heads, C)
        locations: Sampling points (x, y), [0, 1] over the map, float32. (B, Q, heads, S, 2)
        weights: Attention weights, float32. (B, Q, heads, S)
        height: Rows H of the map.
        width: Columns W of the map.

    Returns:
        Gradients of the maps, the locations and the weights.
    """
    locations = locations.contiguous()
    weights = weights.contiguous()
    grad_value = torch.zeros(value.shape, dtype=torch.float32, device=value.device)
    if not grads.numel():
        return grad_value.to(value.dtype), torch.zeros_like(locations), torch.zeros_like(weights)
    grad_locations = torch.empty_like(locations)
    grad_weights = torch.empty_like(weights)
    rows, sizes, grid = _layout(value, weights)
    with torch.cuda.device_of(value):
        backward_kernel[grid](
            grads.contiguous(),
            value.contiguous(),
            locations=locations,
            weights=weights,
            grad_value=grad_value,
            grad_locations=grad_locations,
            grad_weights=grad_weights,
            rows=rows,
            queries=weights.shape[1],
            heads=weights.shape[2],
            height=height,
            width=width,
            **sizes,
            **OPTIONS,
        )
    return grad_value.to(value.dtype), grad_locations, grad_weights
