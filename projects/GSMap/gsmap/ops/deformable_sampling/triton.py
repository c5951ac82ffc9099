# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: deformable sampling of a map, forward and backward in one launch each.

A map is the flattened BEV or image features, which have H rows and W columns of cells. A row of the
output is the result of one head of one query, with all channels of the head. A program (an instance
of a kernel) computes as many rows of the output as fit into ``BLOCK`` values. Sums are float32 for
every dtype of the map. Cells outside of the map count as zero. A NaN location makes only its row
NaN.

The gradient of the map is summed by atomic additions in any order, so repeated runs differ in the
last bits. No launch waits for the device, and nothing is autotuned.
"""

import torch
import triton
import triton.language as tl

BLOCK = 512  # values of a program: 4 for each of its 128 threads, 16 bytes in float32
OPTIONS = {"num_warps": 4, "enable_fp_fusion": True}


@triton.jit
def _locate_sample(locations, weights, sample, valid, height, width):
    """Locate a sample relative to the centres of the four cells around it.

    Args:
        locations: Sampling points (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        weights: Attention weights. (B, Q, heads, S)
        sample: Flat index of the sample of each row. (ROWS,)
        valid: Whether the row exists; otherwise, zeros are read. (ROWS,)
        height: Number of rows of the map.
        width: Number of columns of the map.

    Returns:
        Column and row of the upper left cell, distance of the sample from the centre of this cell
        along x and y in cells, and weight of the sample. (ROWS,) each
    """
    # The centre of cell 0 has the coordinate 0.5 of a cell.
    x = tl.load(locations + sample * 2, mask=valid, other=0.0) * width - 0.5
    y = tl.load(locations + sample * 2 + 1, mask=valid, other=0.0) * height - 0.5
    left = tl.floor(x)
    top = tl.floor(y)
    weight = tl.load(weights + sample, mask=valid, other=0.0)
    return left, top, x - left, y - top, weight


@triton.jit
def find_corner(col, row, valid, height, width):
    """Find the flat index of a cell of a map.

    Args:
        col: Column of the cell as a whole float; it may lie outside of the map. (ROWS,)
        row: Row of the cell, in the same form. (ROWS,)
        valid: Whether the sample exists. (ROWS,)
        height: Number of rows of the map.
        width: Number of columns of the map.

    Returns:
        Index of the cell, zero outside of the map, and whether it lies on the map. (ROWS,)
    """
    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height) & valid
    cell_row = tl.where(inside, row, 0.0).to(tl.int32)
    cell_col = tl.where(inside, col, 0.0).to(tl.int32)
    return cell_row * width + cell_col, inside


@triton.jit
def _locate_rows(
    rows, queries, heads, cells, C: tl.constexpr, CP: tl.constexpr, ROWS: tl.constexpr
):
    """Locate the rows of a program.

    Args:
        rows: Number of rows, B * Q * heads.
        queries: Number Q of queries.
        heads: Number of heads.
        cells: Number of cells of a map.
        C: Number of channels of a head.
        CP: C rounded up to a power of two, as Triton requires for the size of a block.
        ROWS: Number of rows of a program.

    Returns:
        Index of each row (ROWS,), whether the row exists (ROWS,), offset of the first value of its
        head in the maps (ROWS,), indices of the channels (CP,), and whether they exist (CP,).
    """
    # 64 bits, because offsets in large maps exceed 32 bits.
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    batch = row // (queries * heads)
    head = row % heads
    # Offset of value[batch, 0, head, 0]. A cell is `heads * C` values after the previous one.
    head_offset = (batch * cells * heads + head) * C
    channel = tl.arange(0, CP)
    return row, row < rows, head_offset, channel, channel < C


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
    row, valid, head_offset, channel, is_channel = _locate_rows(
        rows, queries, heads=heads, cells=height * width, C=C, CP=CP, ROWS=ROWS
    )
    total = tl.zeros((ROWS, CP), dtype=tl.float32)
    for s in range(S):
        left, top, dx, dy, weight = _locate_sample(
            locations, weights, sample=row * S + s, valid=valid, height=height, width=width
        )
        # Cells around the sample: 0 and 1 above, 2 and 3 below; 0 and 2 left, 1 and 3 right.
        for corner in tl.static_range(4):
            pixel_index, inside = find_corner(
                left + corner % 2, top + corner // 2, valid=valid, height=height, width=width
            )
            weight_x = dx if corner % 2 else 1 - dx
            weight_y = dy if corner // 2 else 1 - dy
            corner_weight = weight * weight_x * weight_y
            pixel_offset = head_offset + pixel_index * (heads * C)
            channel_offsets = pixel_offset[:, None] + channel[None, :]
            mask = inside[:, None] & is_channel[None, :]
            pixel = tl.load(value + channel_offsets, mask=mask, other=0.0).to(tl.float32)
            # A cell outside of the map has the weight 0. It is set by a product, because tl.where
            # would replace a NaN weight by 0.
            total += pixel * (corner_weight * inside.to(tl.float32))[:, None]
    out_pointers = out + row[:, None] * C + channel[None, :]
    tl.store(out_pointers, total, mask=valid[:, None] & is_channel[None, :])


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
    row, valid, head_offset, channel, is_channel = _locate_rows(
        rows, queries, heads=heads, cells=height * width, C=C, CP=CP, ROWS=ROWS
    )
    grad_pointers = grads + row[:, None] * C + channel[None, :]
    grad = tl.load(grad_pointers, mask=valid[:, None] & is_channel[None, :], other=0.0)
    for s in range(S):
        sample = row * S + s
        left, top, dx, dy, weight = _locate_sample(
            locations, weights, sample=sample, valid=valid, height=height, width=width
        )
        grad_weight = tl.zeros((ROWS,), dtype=tl.float32)
        grad_x = tl.zeros((ROWS,), dtype=tl.float32)
        grad_y = tl.zeros((ROWS,), dtype=tl.float32)
        # Cells around the sample: 0 and 1 above, 2 and 3 below; 0 and 2 left, 1 and 3 right.
        for corner in tl.static_range(4):
            pixel_index, inside = find_corner(
                left + corner % 2, top + corner // 2, valid=valid, height=height, width=width
            )
            weight_x = dx if corner % 2 else 1 - dx
            weight_y = dy if corner // 2 else 1 - dy
            pixel_offset = head_offset + pixel_index * (heads * C)
            channel_offsets = pixel_offset[:, None] + channel[None, :]
            mask = inside[:, None] & is_channel[None, :]
            pixel = tl.load(value + channel_offsets, mask=mask, other=0.0).to(tl.float32)
            corner_weight = weight * weight_x * weight_y
            tl.atomic_add(
                grad_value + channel_offsets,
                grad * corner_weight[:, None],
                mask=mask,
                sem="relaxed",
            )
            product = tl.sum(grad * pixel, axis=1)
            grad_weight += product * weight_x * weight_y
            slope_x = 1 if corner % 2 else -1  # derivative of weight_x
            slope_y = 1 if corner // 2 else -1  # derivative of weight_y
            grad_x += product * weight_y * slope_x
            grad_y += product * weight_x * slope_y
        tl.store(grad_weights + sample, grad_weight, mask=valid)
        # The tensors of these gradients have one entry per sample, so no addition is needed.
        # Locations are shares of the map: a change by 1 is a change by `width` or `height` cells.
        tl.store(grad_locations + sample * 2, grad_x * weight * width, mask=valid)
        tl.store(grad_locations + sample * 2 + 1, grad_y * weight * height, mask=valid)


def _plan_launch(value, weights):
    """Return the number of rows, the compile-time sizes of the kernel, and the grid of programs."""
    channels = value.shape[3]
    # At least 16, so that a program has at most BLOCK / 16 = 32 rows.
    padded_channels = max(16, triton.next_power_of_2(channels))
    rows_per_program = max(1, BLOCK // padded_channels)
    rows = weights.shape[:3].numel()
    sizes = {"S": weights.shape[3], "C": channels, "CP": padded_channels, "ROWS": rows_per_program}
    return rows, sizes, (triton.cdiv(rows, rows_per_program),)


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
        rows, sizes, grid = _plan_launch(value, weights)
        with torch.cuda.device_of(value):  # Triton launches on the current device
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
        Gradients of the maps, in the dtype of ``value`` (B, H * W, heads, C); of the locations
        (B, Q, heads, S, 2); and of the weights (B, Q, heads, S).
    """
    locations = locations.contiguous()
    weights = weights.contiguous()
    grad_value = torch.zeros(value.shape, dtype=torch.float32, device=value.device)
    if not grads.numel():
        return grad_value.to(value.dtype), torch.zeros_like(locations), torch.zeros_like(weights)
    grad_locations = torch.empty_like(locations)
    grad_weights = torch.empty_like(weights)
    rows, sizes, grid = _plan_launch(value, weights)
    with torch.cuda.device_of(value):  # Triton launches on the current device
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
