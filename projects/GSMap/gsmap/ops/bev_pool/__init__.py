"""Pooling of lifted image features into bird's-eye-view cells (Lift, Splat, Shoot), in plain torch.

A lifted point is one (pixel, depth) pair; its feature is the depth's probability times the pixel's
context vector. `bev_pool` forms the points and says what is right; `bev_pool_conv3x3` never does:
each cell is a weighted bag of context vectors, so that memory stays at pixels + cells, and its
forward pass is deterministic on every device.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.grid import BEVGrid


class _SortedPoints(NamedTuple):
    """Points inside the grid, sorted by cell; B * cells bags."""

    pixels: Tensor  # row of the context table (n,)
    probs: Tensor  # (n,)
    counts: Tensor  # points per cell (B * cells,)


def cell_indices(points_m: Tensor, grid: BEVGrid, z_range: tuple[float, float]) -> Tensor:
    """Find the grid cell that each point falls into.

    An index is truncated towards zero, as in MapTRv2: points up to one cell below the lower edge
    count into index 0.

    Args:
        points_m: Points (x, y, z) in metres, in the frame of ``grid``. (..., 3)
        grid: The cells.
        z_range: Lowest and highest z in metres of the one layer of cells.

    Returns:
        ``row * width + col``, or -1 outside. (...)

    Raises:
        ValueError: If points do not end in (x, y, z) or ``z_range`` is empty.
    """
    if points_m.shape[-1] != 3:
        raise ValueError(f"points_m must end in (x, y, z), got shape {tuple(points_m.shape)}.")
    if not z_range[0] < z_range[1]:
        raise ValueError(f"z_range must be (low, high) with low < high, got {z_range}.")
    lower = points_m.new_tensor([grid.x_range[0], grid.y_range[0], z_range[0]])
    size = points_m.new_tensor([*grid.pixel_size_m, z_range[1] - z_range[0]])
    limit = torch.tensor([grid.width, grid.height, 1], device=points_m.device)
    index = ((points_m - lower) / size).long()  # (..., 3)
    inside = ((index >= 0) & (index < limit)).all(-1)
    return torch.where(inside, index[..., 1] * grid.width + index[..., 0], -1)


def bev_pool(probs: Tensor, context: Tensor, cells: Tensor, grid: BEVGrid) -> Tensor:
    """Sum depth probability times context feature over the points of every cell.

    Args:
        probs: Probability of each depth bin. (B, V, D, h, w)
        context: Image features. (B, V, C, h, w)
        cells: Cell of each point, -1 for none, from `cell_indices`. (B, V, D, h, w)
        grid: The cells, H rows and W columns.

    Returns:
        Pooled features, differentiable in ``probs`` and ``context``. (B, C, H, W)

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
    probs: Tensor, context: Tensor, cells: Tensor, grid: BEVGrid, weight: Tensor
) -> Tensor:
    """Pool as `bev_pool` does and convolve the result with a 3x3 kernel, zero-padded.

    Both steps are linear, so the kernel's nine matrices can be applied to the few context vectors
    instead of the many cells: at MapTRv2's size (2,250 pixels, 80,000 cells) this is 35 times less
    arithmetic. The first arguments are those of `bev_pool`.

    Args:
        probs: Probability of each depth bin. (B, V, D, h, w)
        context: Image features. (B, V, C, h, w)
        cells: Cell of each point. (B, V, D, h, w)
        grid: The cells.
        weight: Convolution kernel without bias. (O, C, 3, 3)

    Returns:
        ``conv2d(bev_pool(...), weight, padding=1)``, also differentiable in ``weight``.
        (B, O, H, W)

    Raises:
        ValueError: If the shapes disagree.
    """
    _check_shapes(probs, context, cells)
    if weight.dim() != 4 or weight.shape[1:] != (context.shape[2], 3, 3):
        raise ValueError(
            f"weight must have shape (O, {context.shape[2]}, 3, 3) to match context, "
            f"got {tuple(weight.shape)}."
        )
    if torch.compiler.is_exporting():  # ONNX can scatter sums, and has no bags of many sizes
        return F.conv2d(bev_pool(probs, context, cells, grid), weight, padding=1)
    points = _sort_by_cell(probs, cells, grid)
    taps = weight.permute(1, 2, 3, 0).flatten(1)  # (C, 9*O)
    table = context.permute(0, 1, 3, 4, 2).flatten(0, 3) @ taps  # (B*V*h*w, 9*O)
    table = table.view(-1, weight.shape[0])  # row = pixel * 9 + tap
    counts = points.counts.view(-1, grid.height, grid.width)  # (B, H, W)
    starts = (points.counts.cumsum(0) - points.counts).view_as(counts)
    # the nine neighbours of every cell, in the kernel's order, as ranges of the sorted points
    lengths, firsts = (_neighbours(x).flatten() for x in (counts, starts))  # (B*H*W*9,)
    shift = firsts - (lengths.cumsum(0) - lengths)
    total = int(lengths.sum())
    order = torch.arange(total, device=cells.device) + shift.repeat_interleave(
        lengths, output_size=total
    )
    tap = torch.arange(9, device=cells.device).repeat(counts.numel())
    rows = points.pixels[order] * 9 + tap.repeat_interleave(lengths, output_size=total)
    bags = lengths.view(-1, 9).sum(-1)
    pooled = _weighted_bags(table, rows, points.probs[order], bags)
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


def _sort_by_cell(probs: Tensor, cells: Tensor, grid: BEVGrid) -> _SortedPoints:
    """Keep the points inside the grid and bring each cell's points together, in order."""
    batch, views, _, height, width = probs.shape
    num_cells = grid.height * grid.width
    keys = _bag_numbers(cells, grid, outside=-1)
    kept = (keys >= 0).nonzero().squeeze(1)
    keys, order = keys[kept].sort(stable=True)
    pixels = torch.arange(batch * views * height * width, device=cells.device)
    pixels = pixels.view(batch, views, 1, height, width).expand_as(cells).flatten()
    kept = kept[order]
    counts = torch.bincount(keys, minlength=batch * num_cells)
    return _SortedPoints(pixels[kept], probs.flatten()[kept], counts)


def _neighbours(cells: Tensor) -> Tensor:
    """Return the 3x3 neighbourhood of every cell, 0 outside. (B, H, W) -> (B, H, W, 9)"""
    padded = F.pad(cells, (1, 1, 1, 1))
    return padded.unfold(1, 3, 1).unfold(2, 3, 1).flatten(3)


def _weighted_bags(table: Tensor, rows: Tensor, weights: Tensor, counts: Tensor) -> Tensor:
    """Sum ``weights * table[rows]`` over consecutive runs of ``counts`` entries. (bags, C)"""
    offsets = F.pad(counts.cumsum(0), (1, 0))
    return F.embedding_bag(
        rows, table, offsets, mode="sum", per_sample_weights=weights, include_last_offset=True
    )
