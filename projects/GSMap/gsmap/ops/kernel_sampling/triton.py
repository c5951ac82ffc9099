# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels that sum weighted pixels at fixed offsets from projected points, and gradients.

The pixels around one projected point are the sampling kernel of a BEV cell in GKT (Geometry-guided
Kernel Transformer). The forward and the backward pass are one launch each. A row is the output of
one head of one BEV cell, with all channels of the head. A program computes several neighbouring
rows and loops over the cameras. If none of its cells is visible to a camera, a scalar branch skips
the camera. Sums are float32 for every dtype of the feature maps.

Multiplications and additions are not fused. Coordinates then have the rounding errors of plain
torch, and are rounded to the pixels that plain torch selects. The gradient of the maps is added by
atomics in any order, so repeated runs differ in the last bits. The gradient of the weights is
accumulated in registers, and each entry of the gradient of the points is written by one program.
"""

import torch
import triton
import triton.language as tl

from gsmap.ops.deformable_sampling.triton import BLOCK, find_corner

OPTIONS = {"num_warps": 4, "enable_fp_fusion": False}
# 1.5 * 2^23. Adding and subtracting it rounds a number, as float32 has no fractions at this size.
ROUNDING = tl.constexpr(12582912.0)


@triton.jit
def _nearest(position, size):
    """Clamp coordinates in pixels to the map, and round them half to even. (ROWS,)

    As in the released code of GKT, the centre of pixel i is at the coordinate i, so pixel 0 reaches
    from -0.5 to 0.5. Bilinear interpolation uses another convention: the centre of pixel i is at
    i + 0.5, so pixel 0 reaches from 0 to 1.
    """
    position = tl.minimum(tl.maximum(position, 0.0), size - 1.0)
    return ((position + ROUNDING) - ROUNDING).to(tl.int32)


@triton.jit
def _locate_rows(rows, queries, heads, views, CP: tl.constexpr, ROWS: tl.constexpr):
    """Locate the rows of a program.

    Args:
        rows: Number of rows, B * Q * heads.
        queries: Number Q of BEV cells.
        heads: Number of heads.
        views: Number V of cameras.
        CP: Number of channels of a head, rounded up to a power of two.
        ROWS: Number of rows of a program.

    Returns:
        Index of each row, whether it exists, index of the first camera's image among B * V images,
        index of the BEV cell in its sample, and index of the head, all (ROWS,); indices of the
        channels. (CP,)
    """
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    cell = row // heads
    head = row % heads
    batch = cell // queries
    query = cell % queries
    first_image = batch * views
    channel = tl.arange(0, CP)
    return row, row < rows, first_image, query, head, channel


@triton.jit
def forward_kernel(
    value,
    uv,
    weights,
    visible_cells,
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
        visible_cells: Whether a cell is visible to a camera, uint8. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        out: Output for the sums, float32. (B, Q, heads, C)
        rows: Number of rows, B * Q * heads.
        queries: Number Q of BEV cells.
        heads: Number of heads.
        views: Number V of cameras.
        height: Rows h of a map.
        width: Columns w of a map.
        BILINEAR: Interpolate between pixels instead of rounding to one.
        S: Number of pixels (offsets) around a projection.
        C: Number of channels of a head.
        CP: C rounded up to a power of two.
        ROWS: Number of rows of a program.
    """
    row, valid, first_image, query, head, channel = _locate_rows(
        rows, queries, heads=heads, views=views, CP=CP, ROWS=ROWS
    )
    is_channel = channel < C
    total = tl.zeros((ROWS, CP), dtype=tl.float32)
    for view in range(views):
        projection_index = (first_image + view) * queries + query
        visible = tl.load(visible_cells + projection_index, mask=valid, other=0) != 0
        if tl.max(visible.to(tl.int32), axis=0) != 0:
            uv_offset = (projection_index * heads + head) * 2
            x = tl.load(uv + uv_offset, mask=visible, other=0.0) * width
            y = tl.load(uv + uv_offset + 1, mask=visible, other=0.0) * height
            # Offset in `value` of the head's first channel at the first pixel of the camera's map.
            head_offset = ((first_image + view) * height * width * heads + head) * C
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
                    # Pixels around the point: 0 and 1 above, 2 and 3 below; 0 and 2 left, 1 and 3
                    # right.
                    for corner in tl.static_range(4):
                        # Flat index of the pixel, and whether it lies on the map.
                        pixel_index, inside = find_corner(
                            left + corner % 2,
                            top + corner // 2,
                            valid=visible,
                            height=height,
                            width=width,
                        )
                        weight_x = dx if corner % 2 else 1 - dx
                        weight_y = dy if corner // 2 else 1 - dy
                        corner_weight = weight * weight_x * weight_y
                        pixel_offset = head_offset + pixel_index * (heads * C)
                        channel_offsets = pixel_offset[:, None] + channel[None, :]
                        mask = inside[:, None] & is_channel[None, :]
                        pixel = tl.load(value + channel_offsets, mask=mask, other=0.0).to(
                            tl.float32
                        )
                        # As in `bilinear_cells`, a pixel outside of the map has the weight 0. A NaN
                        # weight remains NaN in this product, but tl.where would replace it by 0.
                        total += pixel * (corner_weight * inside.to(tl.float32))[:, None]
                else:
                    pixel_index = _nearest(at_y, height) * width + _nearest(at_x, width)
                    pixel_offset = head_offset + pixel_index * (heads * C)
                    channel_offsets = pixel_offset[:, None] + channel[None, :]
                    mask = visible[:, None] & is_channel[None, :]
                    pixel = tl.load(value + channel_offsets, mask=mask, other=0.0).to(tl.float32)
                    total += pixel * weight[:, None]
    out_pointers = out + row[:, None] * C + channel[None, :]
    tl.store(out_pointers, total, mask=valid[:, None] & is_channel[None, :])


@triton.jit
def backward_kernel(
    grads,
    value,
    uv,
    weights,
    visible_cells,
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
        visible_cells: Whether a cell is visible to a camera, uint8. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        grad_value: Output, float32, to which the gradient of the maps is added.
            (B, V, h * w, heads, C)
        grad_uv: Output, filled with zeros, for the gradient of the projections. They remain zero
            for invisible cells, and without ``BILINEAR``. (B, V, Q, heads, 2)
        grad_weights: Output for the gradient of the weights. (B, Q, heads, S)
        rows: Number of rows, B * Q * heads.
        queries: Number Q of BEV cells.
        heads: Number of heads.
        views: Number V of cameras.
        height: Rows h of a map.
        width: Columns w of a map.
        BILINEAR: Interpolate between pixels instead of rounding to one.
        S: Number of pixels (offsets) around a projection.
        SP: S rounded up to a power of two.
        C: Number of channels of a head.
        CP: C rounded up to a power of two.
        ROWS: Number of rows of a program.
    """
    row, valid, first_image, query, head, channel = _locate_rows(
        rows, queries, heads=heads, views=views, CP=CP, ROWS=ROWS
    )
    is_channel = channel < C
    grad_pointers = grads + row[:, None] * C + channel[None, :]
    grad = tl.load(grad_pointers, mask=valid[:, None] & is_channel[None, :], other=0.0)
    offset_indices = tl.arange(0, SP)
    weight_grads = tl.zeros((ROWS, SP), dtype=tl.float32)
    for view in range(views):
        projection_index = (first_image + view) * queries + query
        visible = tl.load(visible_cells + projection_index, mask=valid, other=0) != 0
        if tl.max(visible.to(tl.int32), axis=0) != 0:
            uv_offset = (projection_index * heads + head) * 2
            x = tl.load(uv + uv_offset, mask=visible, other=0.0) * width
            y = tl.load(uv + uv_offset + 1, mask=visible, other=0.0) * height
            # Offset in `value` of the head's first channel at the first pixel of the camera's map.
            head_offset = ((first_image + view) * height * width * heads + head) * C
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
                    # Pixels around the point: 0 and 1 above, 2 and 3 below; 0 and 2 left, 1 and 3
                    # right.
                    for corner in tl.static_range(4):
                        # Flat index of the pixel, and whether it lies on the map.
                        pixel_index, inside = find_corner(
                            left + corner % 2,
                            top + corner // 2,
                            valid=visible,
                            height=height,
                            width=width,
                        )
                        weight_x = dx if corner % 2 else 1 - dx
                        weight_y = dy if corner // 2 else 1 - dy
                        pixel_offset = head_offset + pixel_index * (heads * C)
                        channel_offsets = pixel_offset[:, None] + channel[None, :]
                        mask = inside[:, None] & is_channel[None, :]
                        pixel = tl.load(value + channel_offsets, mask=mask, other=0.0).to(
                            tl.float32
                        )
                        pixel_grad = grad * (weight * weight_x * weight_y)[:, None]
                        tl.atomic_add(
                            grad_value + channel_offsets, pixel_grad, mask=mask, sem="relaxed"
                        )
                        product = tl.sum(grad * pixel, axis=1)
                        grad_weight += product * weight_x * weight_y
                        slope_x = 1 if corner % 2 else -1  # derivative of weight_x by x
                        slope_y = 1 if corner // 2 else -1  # derivative of weight_y by y
                        grad_x += product * weight * weight_y * slope_x
                        grad_y += product * weight * weight_x * slope_y
                else:
                    pixel_index = _nearest(at_y, height) * width + _nearest(at_x, width)
                    pixel_offset = head_offset + pixel_index * (heads * C)
                    channel_offsets = pixel_offset[:, None] + channel[None, :]
                    mask = visible[:, None] & is_channel[None, :]
                    pixel = tl.load(value + channel_offsets, mask=mask, other=0.0).to(tl.float32)
                    pixel_grad = grad * weight[:, None]
                    tl.atomic_add(
                        grad_value + channel_offsets, pixel_grad, mask=mask, sem="relaxed"
                    )
                    grad_weight += tl.sum(grad * pixel, axis=1)
                # Add to column s by a mask, because a tensor in registers cannot be indexed.
                weight_grads += tl.where(offset_indices[None, :] == s, grad_weight[:, None], 0.0)
            # A rounded position has no gradient. The factors convert from pixels to [0, 1].
            if BILINEAR:
                tl.store(grad_uv + uv_offset, grad_x * width, mask=visible)
                tl.store(grad_uv + uv_offset + 1, grad_y * height, mask=visible)
    weight_pointers = grad_weights + row[:, None] * S + offset_indices[None, :]
    tl.store(weight_pointers, weight_grads, mask=valid[:, None] & (offset_indices < S)[None, :])


def _plan_launch(value, weights):
    """Number of rows, sizes that are constants of the compiled kernel, and grid of the programs."""
    batch, queries, heads, num_offsets = weights.shape
    channels = value.shape[4]
    # A program computes BLOCK values: rows times padded channels. The channels are padded to at
    # least 16, so that a program has at most BLOCK / 16 = 32 rows.
    padded_channels = max(16, triton.next_power_of_2(channels))
    rows_per_program = max(1, BLOCK // padded_channels)
    rows = batch * queries * heads
    sizes = {"S": num_offsets, "C": channels, "CP": padded_channels, "ROWS": rows_per_program}
    return rows, sizes, (triton.cdiv(rows, rows_per_program),)


def sample_kernels(value, uv, weights, visible_cells, offsets, height, width, bilinear):
    """Sum weighted pixels around the projections of each BEV cell, over all cameras.

    Args:
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map, float32.
            (B, V, Q, heads, 2)
        weights: Weights of the pixels, float32. (B, Q, heads, S)
        visible_cells: Whether a cell is visible to a camera, bool. (B, V, Q)
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
        rows, sizes, grid = _plan_launch(value, weights)
        with torch.cuda.device_of(value):  # Triton launches on the current device
            forward_kernel[grid](
                value.contiguous(),
                uv.contiguous(),
                weights=weights.contiguous(),
                visible_cells=visible_cells.contiguous().view(torch.uint8),
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


def sample_kernels_backward(
    grads, value, uv, weights, visible_cells, offsets, height, width, bilinear
):
    """Compute the gradients of `sample_kernels`.

    Args:
        grads: Gradient of the sums, float32. (B, Q, heads, C)
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map, float32.
            (B, V, Q, heads, 2)
        weights: Weights of the pixels, float32. (B, Q, heads, S)
        visible_cells: Whether a cell is visible to a camera, bool. (B, V, Q)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        height: Rows h of a map.
        width: Columns w of a map.
        bilinear: Interpolate between pixels instead of rounding to one.

    Returns:
        Gradients of the maps, in the dtype of ``value`` (B, V, h * w, heads, C); of the projections
        ``uv``, float32 (B, V, Q, heads, 2); and of the weights, float32 (B, Q, heads, S).
    """
    # In float32, since the kernel adds many small values to each entry.
    grad_value = torch.zeros(value.shape, dtype=torch.float32, device=value.device)
    grad_uv = torch.zeros(uv.shape, dtype=torch.float32, device=value.device)
    grad_weights = torch.zeros(weights.shape, dtype=torch.float32, device=value.device)
    if grads.numel():
        rows, sizes, grid = _plan_launch(value, weights)
        with torch.cuda.device_of(value):  # Triton launches on the current device
            backward_kernel[grid](
                grads.contiguous(),
                value.contiguous(),
                uv=uv.contiguous(),
                weights=weights.contiguous(),
                visible_cells=visible_cells.contiguous().view(torch.uint8),
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
