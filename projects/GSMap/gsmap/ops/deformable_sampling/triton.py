# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: deformable sampling of a map, forward and backward in one launch each.

A row is the output of one head of one query, with all channels of the head; a program has as many
rows as fill ``BLOCK`` values. The sums are float32, whatever the type of the map. Corners outside
of the map have the value 0; a location that is not a number makes its own row not a number.

The gradient of the map is added up by atomics, in any order, so two runs differ in the last bits.
No launch waits for the device, and nothing is autotuned.
"""

import torch
import triton
import triton.language as tl

BLOCK = 512  # values of a program: 16 bytes a thread of float32
OPTIONS = {"num_warps": 4, "enable_fp_fusion": True}


@triton.jit
def _locate(locations, weights, sample, ok, height, width):
    """Return a sample's upper left cell, its distances from that cell, and its weight. (ROWS,)"""
    x = tl.load(locations + sample * 2, ok, 0.0) * width - 0.5
    y = tl.load(locations + sample * 2 + 1, ok, 0.0) * height - 0.5
    col, row = tl.floor(x), tl.floor(y)
    return col, row, x - col, y - row, tl.load(weights + sample, ok, 0.0)


@triton.jit
def find_corner(col, row, ok, height, width):
    """Return the flat index of a cell, 0 if it is not on the map, and whether it is. (ROWS,)"""
    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height) & ok
    cell = tl.where(inside, row, 0.0).to(tl.int32) * width + tl.where(inside, col, 0.0).to(tl.int32)
    return cell, inside


@triton.jit
def _rows(rows, queries, heads, cells, C: tl.constexpr, CP: tl.constexpr, ROWS: tl.constexpr):
    """Return a program's rows, their validity, the start of their map, channels and theirs."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    batch, head = row // (queries * heads), row % heads
    channel = tl.arange(0, CP)
    return row, row < rows, (batch * cells * heads + head) * C, channel, channel < C


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
    """Sum samples of value (B, H * W, heads, C) to out (B, Q, heads, C)."""
    row, ok, start, channel, exists = _rows(rows, queries, heads, height * width, C, CP, ROWS)
    total = tl.zeros((ROWS, CP), tl.float32)
    for s in range(S):
        left, top, dx, dy, weight = _locate(locations, weights, row * S + s, ok, height, width)
        for corner in tl.static_range(4):
            cell, inside = find_corner(left + corner % 2, top + corner // 2, ok, height, width)
            share = weight * (dx if corner % 2 else 1 - dx) * (dy if corner // 2 else 1 - dy)
            at = (start + cell * (heads * C))[:, None] + channel[None, :]
            seen = tl.load(value + at, inside[:, None] & exists[None, :], 0.0).to(tl.float32)
            # a product and no choice: what is not a number stays so outside of the map
            total += seen * (share * inside.to(tl.float32))[:, None]
    output = out + row[:, None] * C + channel[None, :]
    tl.store(output, total, ok[:, None] & exists[None, :])


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
    """Add to grad_value, float32, and write the other gradients, of grads (B, Q, heads, C)."""
    row, ok, start, channel, exists = _rows(rows, queries, heads, height * width, C, CP, ROWS)
    output = grads + row[:, None] * C + channel[None, :]
    grad = tl.load(output, ok[:, None] & exists[None, :], 0.0)
    for s in range(S):
        sample = row * S + s
        left, top, dx, dy, weight = _locate(locations, weights, sample, ok, height, width)
        grad_weight = tl.zeros((ROWS,), tl.float32)
        grad_x = tl.zeros((ROWS,), tl.float32)
        grad_y = tl.zeros((ROWS,), tl.float32)
        for corner in tl.static_range(4):
            cell, inside = find_corner(left + corner % 2, top + corner // 2, ok, height, width)
            across = dx if corner % 2 else 1 - dx
            down = dy if corner // 2 else 1 - dy
            at = (start + cell * (heads * C))[:, None] + channel[None, :]
            mask = inside[:, None] & exists[None, :]
            seen = tl.load(value + at, mask, 0.0).to(tl.float32)
            share = weight * across * down
            tl.atomic_add(grad_value + at, grad * share[:, None], mask=mask, sem="relaxed")
            product = tl.sum(grad * seen, 1)
            grad_weight += product * across * down
            grad_x += product * down * (1 if corner % 2 else -1)
            grad_y += product * across * (1 if corner // 2 else -1)
        tl.store(grad_weights + sample, grad_weight, ok)
        tl.store(grad_locations + sample * 2, grad_x * weight * width, ok)
        tl.store(grad_locations + sample * 2 + 1, grad_y * weight * height, ok)


def _layout(value, weights):
    """Return the kernels' sizes, and how many programs there are."""
    channels = value.shape[3]
    padded = max(16, triton.next_power_of_2(channels))
    rows_each = max(1, BLOCK // padded)
    sizes = {"S": weights.shape[3], "C": channels, "CP": padded, "ROWS": rows_each}
    return sizes, (triton.cdiv(weights.shape[:3].numel(), rows_each),)


def deformable_sample(value, locations, weights, height, width):
    """Sum bilinear samples; locations and weights are float32. -> float32 (B, Q, heads, C)"""
    out = torch.empty(*weights.shape[:3], value.shape[3], dtype=torch.float32, device=value.device)
    if out.numel():
        tensors = value.contiguous(), locations.contiguous(), weights.contiguous(), out
        sizes, grid = _layout(value, weights)
        counts = weights.shape[:3].numel(), weights.shape[1], weights.shape[2]
        with torch.cuda.device_of(value):
            forward_kernel[grid](*tensors, *counts, height, width, **sizes, **OPTIONS)
    return out


def deformable_sample_backward(grads, value, locations, weights, height, width):
    """Return the gradients in the map, the locations and the weights."""
    value, locations, weights = value.contiguous(), locations.contiguous(), weights.contiguous()
    in_value = torch.zeros(value.shape, dtype=torch.float32, device=value.device)
    make = torch.empty_like if grads.numel() else torch.zeros_like
    in_locations, in_weights = make(locations), make(weights)
    if grads.numel():
        tensors = grads.contiguous(), value, locations, weights, in_value, in_locations, in_weights
        sizes, grid = _layout(value, weights)
        counts = weights.shape[:3].numel(), weights.shape[1], weights.shape[2]
        with torch.cuda.device_of(value):
            backward_kernel[grid](*tensors, *counts, height, width, **sizes, **OPTIONS)
    return in_value.to(value.dtype), in_locations, in_weights
