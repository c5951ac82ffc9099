"""Auxiliary supervision of MapTRv2 (arXiv 2308.05736) by depth."""

import torch
from torch import Tensor

from gsmap.structures.tensors import num_depth_bins


def depth_bins(depth_m: Tensor, stride: int, depth_range: tuple[float, float, float]) -> Tensor:
    """Return the depth bin of each block of pixels, -1 for none, int64.

    A block takes its nearest return. If that lies in front of the first bin or beyond the last, the
    block has no target, even if a further return would have.

    Args:
        depth_m: Depth along the optical axis in metres, 0 without a return. (..., H, W)
        stride: Side of a block in pixels.
        depth_range: Where bin 0 starts, where the last ends, and the step, in metres.

    Returns:
        Indices of bins. (..., H / stride, W / stride)

    Raises:
        ValueError: If the size is no multiple of ``stride``.
    """
    height, width = depth_m.shape[-2:]
    if height % stride or width % stride:
        raise ValueError(
            f"depth_m must have a size divisible by stride {stride}, got {height} x {width}."
        )
    low, _, step = depth_range
    blocks = depth_m.unflatten(-1, (-1, stride)).unflatten(-3, (-1, stride))  # (..., h, s, w, s)
    nearest = torch.where(blocks == 0, torch.inf, blocks).amin((-3, -1))  # (..., h, w)
    position = (nearest - (low - step)) / step
    valid = (position >= 1) & (position < num_depth_bins(depth_range) + 1)
    return torch.where(valid, position, 0).long() - 1


def depth_loss(probs: Tensor, bins: Tensor) -> Tensor:
    """Return the mean of -log p at the target bin, over the pixels that have one (0 if none has).

    Only the target bin enters; the other bins are held down by the softmax. ValueError if the
    shapes disagree. Probabilities (..., D, h, w), bins, -1 for none (..., h, w) -> ()
    """
    if probs.shape[:-3] + probs.shape[-2:] != bins.shape:
        raise ValueError(
            f"bins must have the shape of probs without its bin axis, got {tuple(bins.shape)} "
            f"for {tuple(probs.shape)}."
        )
    valid = bins >= 0
    chosen = probs.float().gather(-3, bins.clamp(min=0).unsqueeze(-3)).squeeze(-3)  # (..., h, w)
    chosen = torch.where(valid, chosen, 1).clamp(min=torch.finfo(chosen.dtype).tiny)
    return -chosen.log().sum() / valid.sum().clamp(min=1)
