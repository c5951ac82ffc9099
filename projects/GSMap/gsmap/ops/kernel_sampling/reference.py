"""Sampling by fixed kernels in plain torch: the definition of right."""

import torch
from torch import Tensor

from gsmap.ops.deformable_sampling import bilinear_cells, sum_rows
from gsmap.structures.tensors import constant


def kernel_cells(uv: Tensor, offsets: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the feature pixels under a kernel centred at projected points, borders replicated.

    Coordinates are rounded half to even after the offset is added, without a half-pixel shift, as
    the original does. Points in [0, 1] (..., 2), offsets (dx, dy) in pixels (S, 2) -> (..., S)
    """
    height, width = shape
    position = uv * constant(uv, [width, height])
    return border_pixels(torch.round(position[..., None, :] + offsets.to(uv)), shape)


def border_pixels(position: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return row-major indices of pixels (x, y), moved onto the map. (..., 2) -> (...)"""
    height, width = shape
    cols, rows = position[..., 0].clamp(0, width - 1), position[..., 1].clamp(0, height - 1)
    return (rows * width + cols).long()


def kernel_pixels(
    uv: Tensor, offsets: Tensor, weights: Tensor, shape: tuple[int, int], bilinear: bool
) -> tuple[Tensor, Tensor]:
    """Return the pixels under a kernel, and their weights. 2 x (..., S or 4 S)

    Args:
        uv: Projected points in [0, 1] over the map. (..., 2)
        offsets: Offsets (dx, dy) in pixels. (S, 2)
        weights: Weights of the kernel. (..., S)
        shape: Rows and columns of the map.
        bilinear: Sample between pixels, in place of rounding to one.
    """
    if not bilinear:
        return kernel_cells(uv, offsets, shape), weights
    height, width = shape
    places = uv[..., None, :] + offsets / constant(uv, [width, height])
    return bilinear_cells(places, weights, shape)


def sample_kernels_reference(
    value: Tensor,
    shape: tuple[int, int],
    uv: Tensor,
    seen: Tensor,
    weights: Tensor,
    offsets: Tensor,
    bilinear: bool,
) -> Tensor:
    """Sum weighted pixels of all cameras. (B, Q, heads, C)

    Args:
        value: Flattened feature maps. (B, V, h * w, heads, C)
        shape: Rows h and columns w of a map.
        uv: Projected points in [0, 1] over the map. (B, V, Q, heads, 2)
        seen: Whether a camera sees a cell. (B, V, Q)
        weights: Weights of the pixels. (B, Q, heads, S)
        offsets: Offsets (dx, dy) of the pixels from the point. (S, 2)
        bilinear: Sample between pixels, in place of rounding to one.
    """
    batch, views, cells, heads, channels = value.shape
    seen = seen.transpose(1, 2)[..., None, None]  # (B, Q, V, 1, 1)
    uv = torch.where(seen, uv.transpose(1, 2), 0.0)  # (B, Q, V, heads, 2); unseen: may be anything
    weights = weights[:, :, None] * seen  # (B, Q, V, heads, S)
    pixels, weights = kernel_pixels(uv, offsets, weights, shape, bilinear)
    sample = torch.arange(batch, device=value.device).view(-1, 1, 1, 1, 1)
    view = torch.arange(views, device=value.device).view(1, 1, -1, 1, 1)
    head = torch.arange(heads, device=value.device).view(1, 1, 1, -1, 1)
    rows = ((sample * views + view) * cells + pixels) * heads + head
    rows = rows.transpose(2, 3).flatten(3)  # (B, Q, heads, V * S)
    weights = weights.transpose(2, 3).flatten(3)
    return sum_rows(value.reshape(-1, channels), rows, weights)
