"""Pooling of lifted image features into bird's-eye-view cells (Lift, Splat, Shoot), in plain torch.

A lifted point is one (pixel, depth) pair; its feature is the depth's probability times the pixel's
context vector. `bev_pool` forms the points and says what is right; `bev_pool_conv3x3` never does:
each cell is a weighted bag of context vectors, so that memory stays at pixels + cells, and its
forward pass is deterministic on every device.
"""

from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant


def cell_indices(points_m: Tensor, grid: BEVGrid, z_range: tuple[float, float]) -> Tensor:
    """Return ``row * width + col`` of the grid cell that each point falls into, -1 outside. (...)

    An index is truncated towards zero, as in MapTRv2: points up to one cell below the lower edge
    count into index 0.

    Args:
        points_m: Points (x, y, z) in metres, in the frame of ``grid``. (..., 3)
        grid: The cells.
        z_range: Lowest and highest z in metres of the one layer of cells; ValueError if empty.
    """
    if points_m.shape[-1] != 3:
        raise ValueError(f"points_m must end in (x, y, z), got shape {tuple(points_m.shape)}.")
    if not z_range[0] < z_range[1]:
        raise ValueError(f"z_range must be (low, high) with low < high, got {z_range}.")
    lower = constant(points_m, [grid.x_range[0], grid.y_range[0], z_range[0]])
    size = constant(points_m, [*grid.pixel_size_m, z_range[1] - z_range[0]])
    limit = constant(points_m, [grid.width, grid.height, 1], torch.long)
    index = ((points_m - lower) / size).long()  # (..., 3)
    inside = ((index >= 0) & (index < limit)).all(-1)
    return torch.where(inside, index[..., 1] * grid.width + index[..., 0], -1)


def bev_pool(probs: Tensor, context: Tensor, cells: Tensor, grid: BEVGrid) -> Tensor:
    """Sum depth probability times context feature over the points of every cell. (B, C, H, W)

    The sums are differentiable in ``probs`` and ``context``.

    Args:
        probs: Probability of each depth bin. (B, V, D, h, w)
        context: Image features. (B, V, C, h, w)
        cells: Cell of each point, -1 for none, from `cell_indices`. (B, V, D, h, w)
        grid: The cells, H rows and W columns.

    Raises:
        ValueError: If the shapes disagree.
    """
    _check_shapes(probs, context, cells)
    points = probs[..., None] * context.permute(0, 1, 3, 4, 2)[:, :, None]  # (B, V, D, h, w, C)
    keys = _bag_numbers(cells, grid, outside=len(cells) * grid.height * grid.width)
    pooled = context.new_zeros(len(cells) * grid.height * grid.width + 1, context.shape[2])
    pooled = pooled.index_add(0, keys, points.flatten(0, 4))[:-1]
    return pooled.view(len(cells), grid.height, grid.width, -1).permute(0, 3, 1, 2)


def bev_pool_conv3x3(
    probs: Tensor,
    context: Tensor,
    cells: Tensor,
    grid: BEVGrid,
    weight: Tensor,
    fixed_sizes: bool = False,
) -> Tensor:
    """Return ``conv2d(bev_pool(...), weight, padding=1)``, differentiable also in the weight.

    Both steps are linear, so the kernel's nine matrices (O, C, 3, 3) can be applied to the few
    context vectors instead of the many cells: at MapTRv2's size (2,250 pixels, 80,000 cells) this
    is 35 times less arithmetic. -> (B, O, H, W)

    Args:
        probs: Probability of each depth bin. (B, V, D, h, w)
        context: Image features. (B, V, C, h, w)
        cells: Cell of each point, -1 for none, from `cell_indices`. (B, V, D, h, w)
        grid: The cells, H rows and W columns.
        weight: The kernel. (O, C, 3, 3)
        fixed_sizes: Whether no size may depend on values, as in a CUDA graph: both steps are then
            taken one after the other.

    Raises:
        ValueError: If the shapes disagree.
    """
    _check_shapes(probs, context, cells)
    if weight.dim() != 4 or weight.shape[1:] != (context.shape[2], 3, 3):
        raise ValueError(
            f"weight must have shape (O, {context.shape[2]}, 3, 3) to match context, "
            f"got {tuple(weight.shape)}."
        )
    exporting = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)  # torch < 2.7
    if fixed_sizes or exporting():  # ONNX can scatter sums, and has no bags of many sizes
        return F.conv2d(bev_pool(probs, context, cells, grid), weight, padding=1)
    pixels, probs, counts = _sort_by_cell(probs, cells, grid)
    taps = weight.permute(1, 2, 3, 0).flatten(1)  # (C, 9*O)
    table = context.permute(0, 1, 3, 4, 2).flatten(0, 3) @ taps  # (B*V*h*w, 9*O)
    table = table.view(-1, weight.shape[0])  # row = pixel * 9 + tap
    starts = counts.flatten().cumsum(0).view_as(counts) - counts  # (B, H, W)
    # the nine neighbours of every cell, in the kernel's order, as ranges of the sorted points
    lengths, firsts = (
        F.pad(x, (1, 1, 1, 1)).unfold(1, 3, 1).unfold(2, 3, 1).flatten() for x in (counts, starts)
    )  # (B*H*W*9,)
    total = int(lengths.sum())
    spread = partial(torch.repeat_interleave, repeats=lengths, output_size=total)
    shift = spread(firsts - (lengths.cumsum(0) - lengths))
    tap = spread(torch.arange(9, device=cells.device).repeat(counts.numel()))
    order = torch.arange(total, device=cells.device) + shift
    pooled = F.embedding_bag(
        pixels[order] * 9 + tap,
        table,
        F.pad(lengths.view(-1, 9).sum(-1).cumsum(0), (1, 0)),
        mode="sum",
        per_sample_weights=probs[order],
        include_last_offset=True,
    )
    return pooled.view(*counts.shape, -1).permute(0, 3, 1, 2)


def _check_shapes(probs: Tensor, context: Tensor, cells: Tensor) -> None:
    """Raise if the three inputs of a pooling do not describe the same pixels."""
    if probs.dim() != 5 or cells.shape != probs.shape:
        raise ValueError(
            "probs and cells must both have shape (B, V, D, h, w), "
            f"got {tuple(probs.shape)} and {tuple(cells.shape)}."
        )
    batch, views, _, height, width = probs.shape
    if context.dim() != 5 or context[:, :, 0].shape != (batch, views, height, width):
        raise ValueError(
            f"context must have shape ({batch}, {views}, C, {height}, {width}) to match probs, "
            f"got {tuple(context.shape)}."
        )


def _bag_numbers(cells: Tensor, grid: BEVGrid, outside: int) -> Tensor:
    """Number the cells of all samples, one number a point. (B, V, D, h, w) -> (B*V*D*h*w,)"""
    first = torch.arange(len(cells), device=cells.device).view(-1, 1, 1, 1, 1)
    bags = cells + first * (grid.height * grid.width)
    return torch.where(cells >= 0, bags, outside).flatten()


def _sort_by_cell(probs: Tensor, cells: Tensor, grid: BEVGrid) -> tuple[Tensor, Tensor, Tensor]:
    """Return pixels and probabilities of points, cell by cell, and how many a cell has. (B, H, W)

    Points outside the grid are left out.
    """
    batch, views, _, height, width = probs.shape
    keys = _bag_numbers(cells, grid, outside=-1)
    kept = (keys >= 0).nonzero().squeeze(1)
    keys, order = keys[kept].sort(stable=True)
    kept = kept[order]
    pixels = torch.arange(batch * views * height * width, device=cells.device)
    pixels = pixels.view(batch, views, 1, height, width).expand_as(cells).flatten()
    counts = torch.bincount(keys, minlength=batch * grid.height * grid.width)
    return pixels[kept], probs.flatten()[kept], counts.view(batch, grid.height, grid.width)
