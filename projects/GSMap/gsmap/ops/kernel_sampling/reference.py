"""Sampling of camera features by fixed kernels in plain torch.

A kernel is a fixed set of S offsets around a projected point.
"""

import torch
from torch import Tensor

from gsmap.ops.deformable_sampling import bilinear_cells, sum_rows
from gsmap.structures.tensors import constant


def kernel_cells(uv: Tensor, offsets: Tensor, shape: tuple[int, int]) -> Tensor:
    """Find the pixels under a kernel that is centred at each projected point.

    Coordinates are rounded half to even after the offset is added, without a half-pixel shift, as
    in GKT's released code. Pixels outside of the map are moved to its border.

    Args:
        uv: Projected points (x, y), [0, 1] over the map. (..., 2)
        offsets: Offsets (dx, dy) of the pixels from the point, in pixels. (S, 2)
        shape: Rows and columns of the map.

    Returns:
        Row-major indices of the pixels. (..., S)
    """
    height, width = shape
    position = uv * constant(uv, [width, height])
    pixels = torch.round(position[..., None, :] + offsets.to(uv))
    return border_pixels(pixels, shape)


def border_pixels(position: Tensor, shape: tuple[int, int]) -> Tensor:
    """Row-major indices of pixels (x, y), moved to the border of the map. (..., 2) -> (...)"""
    height, width = shape
    cols = position[..., 0].clamp(0, width - 1)
    rows = position[..., 1].clamp(0, height - 1)
    return (rows * width + cols).long()


def kernel_pixels(
    uv: Tensor, offsets: Tensor, weights: Tensor, shape: tuple[int, int], bilinear: bool
) -> tuple[Tensor, Tensor]:
    """Find the pixels under a kernel that is centred at each projected point, and their weights.

    Args:
        uv: Projected points (x, y), [0, 1] over the map. (..., 2)
        offsets: Offsets (dx, dy) of the kernel's S points from its centre, in pixels. (S, 2)
        weights: Weights of the kernel's points. (..., S)
        shape: Rows and columns of the map.
        bilinear: Interpolate between the four pixels around each point of the kernel instead of
            rounding to one. Pixels outside of the map then have weight 0.

    Returns:
        Row-major indices of the pixels, and their weights, both (..., S), or (..., 4 S) if
        bilinear.
    """
    if not bilinear:
        return kernel_cells(uv, offsets, shape=shape), weights
    height, width = shape
    locations = uv[..., None, :] + offsets / constant(uv, [width, height])
    return bilinear_cells(locations, weights, shape=shape)


def sample_kernels_reference(
    value: Tensor,
    shape: tuple[int, int],
    uv: Tensor,
    visible_cells: Tensor,
    weights: Tensor,
    offsets: Tensor,
    bilinear: bool,
) -> Tensor:
    """Sum weighted pixels around the projections of each BEV cell in the cameras.

    Args:
        value: Flattened feature maps, row-major. (B, V, h * w, heads, C)
        shape: Rows h and columns w of a map.
        uv: Projection (x, y) of each cell for each head, [0, 1] over the map; finite for visible
            cells. (B, V, Q, heads, 2)
        visible_cells: Whether a cell is visible to a camera, bool. (B, V, Q)
        weights: Weights of the pixels. (B, Q, heads, S)
        offsets: Offsets (dx, dy) of the pixels from the projection, in pixels. (S, 2)
        bilinear: Interpolate between pixels instead of rounding to one.

    Returns:
        Sums. (B, Q, heads, C)
    """
    batch, views, num_pixels, heads, channels = value.shape
    visible = visible_cells.transpose(1, 2)[..., None, None]  # (B, Q, V, 1, 1)
    # Projections of invisible cells may have any value, also NaN.
    uv = torch.where(visible, uv.transpose(1, 2), 0.0)  # (B, Q, V, heads, 2)
    weights = weights[:, :, None] * visible  # (B, Q, V, heads, S)
    pixels, weights = kernel_pixels(uv, offsets, weights=weights, shape=shape, bilinear=bilinear)
    sample = torch.arange(batch, device=value.device).view(-1, 1, 1, 1, 1)
    view = torch.arange(views, device=value.device).view(1, 1, -1, 1, 1)
    head = torch.arange(heads, device=value.device).view(1, 1, 1, -1, 1)
    # `value` is read as a table with B * V * h * w * heads rows of C channels.
    rows = ((sample * views + view) * num_pixels + pixels) * heads + head
    # One sum for each head, over all cameras: (B, Q, heads, V * S), or V * 4 S if bilinear.
    rows = rows.transpose(2, 3).flatten(3)
    weights = weights.transpose(2, 3).flatten(3)
    return sum_rows(value.reshape(-1, channels), rows, weights=weights)
