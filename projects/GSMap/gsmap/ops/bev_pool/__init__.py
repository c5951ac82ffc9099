"""Pooling of lifted image features into bird's-eye-view cells (Lift, Splat, Shoot), in plain torch.

A lifted point is one (pixel, depth) pair. Its feature is the probability of the depth times the
context vector of the pixel. A pixel here is a pixel of the feature map of a camera.

`bev_pool` computes the features of all points and is the reference. `bev_pool_conv3x3` also applies
the convolution that follows. It computes each cell directly as a weighted sum of context vectors.
Its memory grows only with pixels + cells, not with pixels * depths * channels, and its forward pass
is deterministic on every device.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


def cell_indices(points_m: Tensor, grid: BEVGrid, z_range: tuple[float, float]) -> Tensor:
    """Find the grid cell of each point.

    Indices are truncated towards zero, as in the released code of Lift-Splat-Shoot. Points up to
    one cell below the lower edge therefore get index 0.

    Args:
        points_m: Points (x, y, z) in metres, in the frame of ``grid``. (..., 3)
        grid: Extent and size of the cells.
        z_range: Lowest and highest z of the single layer of cells, in metres.

    Returns:
        ``row * width + col`` of the cell, or -1 outside of the grid. (...)

    Raises:
        ValueError: If the points are not 3D or ``z_range`` is empty.
    """
    if points_m.shape[-1] != 3:
        raise InputError(f"points_m must end in (x, y, z), got shape {tuple(points_m.shape)}.")
    if not z_range[0] < z_range[1]:
        raise InputError(f"z_range must be (low, high) with low < high, got {z_range}.")
    # `constant` creates tensors on the device of the points, once for each list of numbers.
    lower = constant(points_m, [grid.x_range[0], grid.y_range[0], z_range[0]])
    size = constant(points_m, [*grid.pixel_size_m, z_range[1] - z_range[0]])
    limit = constant(points_m, [grid.width, grid.height, 1], torch.long)
    index = ((points_m - lower) / size).long()  # (..., 3)
    inside = ((index >= 0) & (index < limit)).all(-1)
    cells = index[..., 1] * grid.width + index[..., 0]
    return torch.where(inside, cells, -1)


def bev_pool(probs: Tensor, context: Tensor, cells: Tensor, grid: BEVGrid) -> Tensor:
    """Sum the features (depth probability times context vector) of the points in each cell.

    Args:
        probs: Probability of each depth bin, in [0, 1]. (B, V, D, h, w)
        context: Image features. (B, V, C, h, w)
        cells: Cell of each point from `cell_indices`, -1 for none. (B, V, D, h, w)
        grid: Grid of the cells, with H rows and W columns.

    Returns:
        Sums, differentiable in ``probs`` and ``context``. (B, C, H, W)

    Raises:
        ValueError: If the shapes disagree.
    """
    _check_shapes(probs, context, cells=cells)
    points = probs[..., None] * context.permute(0, 1, 3, 4, 2)[:, :, None]  # (B, V, D, h, w, C)
    num_cells = len(cells) * grid.height * grid.width
    # A bag is the set of the points of one cell. Here points outside the grid have a bag as well.
    bags = _bag_indices(cells, grid, outside=num_cells)
    sums = context.new_zeros(num_cells + 1, context.shape[2])  # the last row is for points outside
    sums = sums.index_add(0, bags, points.flatten(0, 4))[:-1]
    return sums.view(len(cells), grid.height, grid.width, -1).permute(0, 3, 1, 2)


def bev_pool_conv3x3(
    probs: Tensor,
    context: Tensor,
    cells: Tensor,
    grid: BEVGrid,
    weight: Tensor,
    fixed_sizes: bool = False,
) -> Tensor:
    """Pool lifted features and convolve the cells: ``conv2d(bev_pool(...), weight, padding=1)``.

    Both steps are linear, so the nine matrices (O, C) of the filter can be applied to the few
    context vectors instead of the many cells. At a published size (2,250 pixels, 80,000 cells) this
    needs 35 times fewer operations.

    Args:
        probs: Probability of each depth bin, in [0, 1]. (B, V, D, h, w)
        context: Image features. (B, V, C, h, w)
        cells: Cell of each point from `cell_indices`, -1 for none. (B, V, D, h, w)
        grid: Grid of the cells, with H rows and W columns.
        weight: Filter of the convolution. (O, C, 3, 3)
        fixed_sizes: Whether the sizes of intermediate tensors must not depend on the values of the
            inputs, as in a CUDA graph. Pooling and convolution then run one after the other.

    Returns:
        Convolved sums, differentiable in ``probs``, ``context`` and ``weight``. (B, O, H, W)

    Raises:
        ValueError: If the shapes disagree, or ``weight`` has another shape.
    """
    _check_shapes(probs, context, cells=cells)
    if weight.dim() != 4 or weight.shape[1:] != (context.shape[2], 3, 3):
        raise InputError(
            f"weight must have shape (O, {context.shape[2]}, 3, 3) to match context, "
            f"got {tuple(weight.shape)}."
        )
    # torch < 2.7 has no `is_exporting`. There, the general `is_compiling` takes its place.
    is_exporting = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)
    # ONNX has no sums over bags of different sizes, but it has the scattered sums of `bev_pool`.
    if fixed_sizes or is_exporting():
        pooled = bev_pool(probs, context, cells=cells, grid=grid)
        return F.conv2d(pooled, weight, padding=1)
    # Pixel and probability of each point, sorted by cell, and number of points of each cell.
    pixels, probs, counts = _sort_by_cell(probs, cells, grid=grid)
    # A tap is one of the nine positions of the filter. The matrices of all taps are applied to the
    # context vectors of all pixels.
    taps = weight.permute(1, 2, 3, 0).flatten(1)  # (C, 9 O)
    table = context.permute(0, 1, 3, 4, 2).flatten(0, 3) @ taps  # (B V h w, 9 O)
    table = table.view(-1, weight.shape[0])  # row = pixel * 9 + tap
    starts = counts.flatten().cumsum(0).view_as(counts) - counts  # first point of each cell
    # An output cell sums the points of its 3 x 3 neighbours, in the order of the filter's taps. The
    # points of one neighbour are successive in the sorted order. `lengths` and `firsts` contain the
    # number of points and the index of the first point, for each pair r of an output cell and a
    # neighbour. (B H W 9,)
    lengths = _neighbours(counts)
    firsts = _neighbours(starts)
    # The points of all pairs are written into one list, one pair after the other. The points of
    # pair r begin at entry range_starts[r] of the list.
    total = int(lengths.sum())  # number of entries, which depends on the values of `cells`
    range_starts = lengths.cumsum(0) - lengths
    # Entry i of the list, which belongs to a pair r, is the sorted point with the index
    # firsts[r] + (i - range_starts[r]) = i + shift[i].
    shift = torch.repeat_interleave(firsts - range_starts, repeats=lengths, output_size=total)
    # Tap of the pair of each entry: the taps 0 to 8 for each output cell.
    tap = torch.repeat_interleave(
        torch.arange(9, device=cells.device).repeat(counts.numel()),
        repeats=lengths,
        output_size=total,
    )
    order = torch.arange(total, device=cells.device) + shift  # index of the sorted point
    # `embedding_bag` sums rows of the table over bags. The bag of an output cell consists of the
    # entries of its nine neighbours.
    bag_ends = lengths.view(-1, 9).sum(-1).cumsum(0)
    sums = F.embedding_bag(
        pixels[order] * 9 + tap,
        table,
        offsets=F.pad(bag_ends, (1, 0)),  # start of each bag, and end of the last one
        mode="sum",
        per_sample_weights=probs[order],
        include_last_offset=True,
    )
    return sums.view(len(cells), grid.height, grid.width, -1).permute(0, 3, 1, 2)


def _neighbours(values: Tensor) -> Tensor:
    """Gather the 3 x 3 neighbours of each cell, zero outside. (B, H, W) -> (B H W 9,)"""
    padded = F.pad(values, (1, 1, 1, 1))
    windows = padded.unfold(1, 3, 1).unfold(2, 3, 1)  # (B, H, W, 3, 3)
    return windows.flatten()


def _check_shapes(probs: Tensor, context: Tensor, cells: Tensor) -> None:
    """Raise ValueError if the shapes of the three inputs of a pooling disagree."""
    if probs.dim() != 5 or cells.shape != probs.shape:
        raise InputError(
            "probs and cells must both have shape (B, V, D, h, w), "
            f"got {tuple(probs.shape)} and {tuple(cells.shape)}."
        )
    batch, views, _, height, width = probs.shape
    if context.dim() != 5 or context[:, :, 0].shape != (batch, views, height, width):
        raise InputError(
            f"context must have shape ({batch}, {views}, C, {height}, {width}) to match probs, "
            f"got {tuple(context.shape)}."
        )


def _bag_indices(cells: Tensor, grid: BEVGrid, outside: int) -> Tensor:
    """Index of each point's cell among the cells of all samples; ``outside`` for other points.

    (B, V, D, h, w) -> (B V D h w,)
    """
    sample = torch.arange(len(cells), device=cells.device).view(-1, 1, 1, 1, 1)
    bags = cells + sample * (grid.height * grid.width)
    return torch.where(cells >= 0, bags, outside).flatten()


def _sort_by_cell(probs: Tensor, cells: Tensor, grid: BEVGrid) -> tuple[Tensor, Tensor, Tensor]:
    """Sort the points inside the grid by their cells; the order within a cell does not change.

    Returns:
        Pixel (index among all pixels of the batch) and probability of each point (n,), and the
        number of points of each cell (B, H, W).
    """
    batch, views, _, height, width = probs.shape
    bags = _bag_indices(cells, grid, outside=-1)
    points = (bags >= 0).nonzero().squeeze(1)  # indices of the points inside the grid
    bags, order = bags[points].sort(stable=True)
    points = points[order]
    # All depths of a pixel have its number.
    pixels = torch.arange(batch * views * height * width, device=cells.device)
    pixels = pixels.view(batch, views, 1, height, width).expand_as(cells).flatten()
    counts = torch.bincount(bags, minlength=batch * grid.height * grid.width)
    return pixels[points], probs.flatten()[points], counts.view(batch, grid.height, grid.width)
