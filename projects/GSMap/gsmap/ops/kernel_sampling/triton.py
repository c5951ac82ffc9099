# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: fixed kernels around projected points, forward and backward in one launch each.

A row is the output of one head of one cell, with all channels of the head. A program has some rows,
neighbours on the map, and walks over the cameras: one that sees none of its cells is left by a
scalar branch. The sums are float32, whatever the type of the maps.

Products and sums are not fused, as a pixel is the rounding of a sum: it is the one that plain
torch takes. The gradient of the maps is added up by atomics, in any order; that of the weights is
gathered in registers, and that of the points has one writer.
"""

import torch
import triton
import triton.language as tl

from gsmap.ops.deformable_sampling.triton import BLOCK, find_corner

OPTIONS = {"num_warps": 4, "enable_fp_fusion": False}
ROUNDING = tl.constexpr(12582912.0)  # 1.5 * 2^23: its float32 neighbours are whole numbers


@triton.jit
def _nearest(position, size):
    """Round half to even, after moving to the border of the map, which changes no result."""
    position = tl.minimum(tl.maximum(position, 0.0), size - 1.0)
    return ((position + ROUNDING) - ROUNDING).to(tl.int32)


@triton.jit
def _rows(rows, queries, heads, views, C: tl.constexpr, CP: tl.constexpr, ROWS: tl.constexpr):
    """Return a program's rows, their validity, their cell in the first camera, head, channels."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    cell, head = row // heads, row % heads
    batch, query = cell // queries, cell % queries
    return row, row < rows, batch * views, query, head, tl.arange(0, CP)


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
    """Sum pixels of value (B, V, h * w, heads, C) to out (B, Q, heads, C)."""
    row, ok, image, query, head, channel = _rows(rows, queries, heads, views, C, CP, ROWS)
    exists = channel < C
    total = tl.zeros((ROWS, CP), tl.float32)
    for view in range(views):
        place = (image + view) * queries + query
        served = tl.load(seen + place, ok, 0) != 0
        if tl.max(served.to(tl.int32), 0) != 0:
            x = tl.load(uv + (place * heads + head) * 2, served, 0.0) * width
            y = tl.load(uv + (place * heads + head) * 2 + 1, served, 0.0) * height
            start = ((image + view) * height * width * heads + head) * C
            for s in range(S):
                weight = tl.load(weights + row * S + s, served, 0.0)
                at_x = x + tl.load(offsets + 2 * s).to(tl.float32)
                at_y = y + tl.load(offsets + 2 * s + 1).to(tl.float32)
                if BILINEAR:
                    at_x, at_y = at_x - 0.5, at_y - 0.5
                    left, top = tl.floor(at_x), tl.floor(at_y)
                    dx, dy = at_x - left, at_y - top
                    for corner in tl.static_range(4):
                        cell, inside = find_corner(
                            left + corner % 2, top + corner // 2, served, height, width
                        )
                        share = weight * (dx if corner % 2 else 1 - dx)
                        share *= dy if corner // 2 else 1 - dy
                        at = (start + cell * (heads * C))[:, None] + channel[None, :]
                        mask = inside[:, None] & exists[None, :]
                        pixel = tl.load(value + at, mask, 0.0).to(tl.float32)
                        total += pixel * (share * inside.to(tl.float32))[:, None]
                else:
                    cell = _nearest(at_y, height) * width + _nearest(at_x, width)
                    at = (start + cell * (heads * C))[:, None] + channel[None, :]
                    mask = served[:, None] & exists[None, :]
                    total += tl.load(value + at, mask, 0.0).to(tl.float32) * weight[:, None]
    output = out + row[:, None] * C + channel[None, :]
    tl.store(output, total, ok[:, None] & exists[None, :])


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
    """Add to grad_value, float32, and write the other gradients, of grads (B, Q, heads, C)."""
    row, ok, image, query, head, channel = _rows(rows, queries, heads, views, C, CP, ROWS)
    exists = channel < C
    output = grads + row[:, None] * C + channel[None, :]
    grad = tl.load(output, ok[:, None] & exists[None, :], 0.0)
    number = tl.arange(0, SP)
    in_weights = tl.zeros((ROWS, SP), tl.float32)
    for view in range(views):
        place = (image + view) * queries + query
        served = tl.load(seen + place, ok, 0) != 0
        if tl.max(served.to(tl.int32), 0) != 0:
            point = (place * heads + head) * 2
            x = tl.load(uv + point, served, 0.0) * width
            y = tl.load(uv + point + 1, served, 0.0) * height
            start = ((image + view) * height * width * heads + head) * C
            in_x = tl.zeros((ROWS,), tl.float32)
            in_y = tl.zeros((ROWS,), tl.float32)
            for s in range(S):
                weight = tl.load(weights + row * S + s, served, 0.0)
                at_x = x + tl.load(offsets + 2 * s).to(tl.float32)
                at_y = y + tl.load(offsets + 2 * s + 1).to(tl.float32)
                in_weight = tl.zeros((ROWS,), tl.float32)
                if BILINEAR:
                    at_x, at_y = at_x - 0.5, at_y - 0.5
                    left, top = tl.floor(at_x), tl.floor(at_y)
                    dx, dy = at_x - left, at_y - top
                    for corner in tl.static_range(4):
                        cell, inside = find_corner(
                            left + corner % 2, top + corner // 2, served, height, width
                        )
                        across = dx if corner % 2 else 1 - dx
                        down = dy if corner // 2 else 1 - dy
                        at = (start + cell * (heads * C))[:, None] + channel[None, :]
                        mask = inside[:, None] & exists[None, :]
                        pixel = tl.load(value + at, mask, 0.0).to(tl.float32)
                        share = grad * (weight * across * down)[:, None]
                        tl.atomic_add(grad_value + at, share, mask=mask, sem="relaxed")
                        product = tl.sum(grad * pixel, 1)
                        in_weight += product * across * down
                        in_x += product * weight * down * (1 if corner % 2 else -1)
                        in_y += product * weight * across * (1 if corner // 2 else -1)
                else:
                    cell = _nearest(at_y, height) * width + _nearest(at_x, width)
                    at = (start + cell * (heads * C))[:, None] + channel[None, :]
                    mask = served[:, None] & exists[None, :]
                    pixel = tl.load(value + at, mask, 0.0).to(tl.float32)
                    share = grad * weight[:, None]
                    tl.atomic_add(grad_value + at, share, mask=mask, sem="relaxed")
                    in_weight += tl.sum(grad * pixel, 1)
                in_weights += tl.where(number[None, :] == s, in_weight[:, None], 0.0)
            if BILINEAR:
                tl.store(grad_uv + point, in_x * width, served)
                tl.store(grad_uv + point + 1, in_y * height, served)
    sums = grad_weights + row[:, None] * S + number[None, :]
    tl.store(sums, in_weights, ok[:, None] & (number < S)[None, :])


def _layout(value, weights):
    """Return the kernels' counts and sizes, and how many programs there are."""
    batch, queries, heads, samples = weights.shape
    channels = value.shape[4]
    padded = max(16, triton.next_power_of_2(channels))
    rows_each = max(1, BLOCK // padded)
    rows = batch * queries * heads
    sizes = {"S": samples, "C": channels, "CP": padded, "ROWS": rows_each}
    return (rows, queries, heads, value.shape[1]), sizes, (triton.cdiv(rows, rows_each),)


def _inputs(value, uv, weights, seen, offsets):
    """Return the tensors as the kernels read them."""
    flags = seen.contiguous().view(torch.uint8)
    return value.contiguous(), uv.contiguous(), weights.contiguous(), flags, offsets.contiguous()


def sample_kernels(value, uv, weights, seen, offsets, height, width, bilinear):
    """Sum weighted pixels; points and weights are float32. -> float32 (B, Q, heads, C)"""
    out = torch.empty(*weights.shape[:3], value.shape[4], dtype=torch.float32, device=value.device)
    if out.numel():
        counts, sizes, grid = _layout(value, weights)
        tensors = *_inputs(value, uv, weights, seen, offsets), out
        with torch.cuda.device_of(value):
            forward_kernel[grid](
                *tensors, *counts, height, width, BILINEAR=bilinear, **sizes, **OPTIONS
            )
    return out


def sample_kernels_backward(grads, value, uv, weights, seen, offsets, height, width, bilinear):
    """Return the gradients in the maps, the points and the weights."""
    inputs = _inputs(value, uv, weights, seen, offsets)
    in_value = torch.zeros(value.shape, dtype=torch.float32, device=value.device)
    in_uv = torch.zeros(uv.shape, dtype=torch.float32, device=value.device)
    in_weights = torch.zeros(weights.shape, dtype=torch.float32, device=value.device)
    if grads.numel():
        counts, sizes, grid = _layout(value, weights)
        sizes["SP"] = triton.next_power_of_2(sizes["S"])
        tensors = grads.contiguous(), *inputs, in_value, in_uv, in_weights
        with torch.cuda.device_of(value):
            backward_kernel[grid](
                *tensors, *counts, height, width, BILINEAR=bilinear, **sizes, **OPTIONS
            )
    return in_value.to(value.dtype), in_uv, in_weights
