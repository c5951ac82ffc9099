"""Depth targets and depth loss of MapTRv2 (arXiv 2308.05736), from LiDAR returns in the images."""

import torch
from torch import Tensor

from gsmap.structures.tensors import num_depth_bins
from gsmap.utils.errors import InputError


def depth_bins(depth_m: Tensor, stride: int, depth_range: tuple[float, float, float]) -> Tensor:
    """Depth bin of the nearest LiDAR return in each block of pixels.

    If the nearest return of a block is outside the range of the bins, the block has no target, even
    if another of its returns is in a bin.

    Args:
        depth_m: Depth along the optical axis in metres, 0 in pixels without a return. (..., H, W)
        stride: Side of a block in pixels.
        depth_range: Start of the first bin, end of the last bin, and size of a bin, in metres.

    Returns:
        Indices of bins, int64; -1 in blocks without a target. (..., H / stride, W / stride)

    Raises:
        ValueError: If the size is not a multiple of ``stride``.
    """
    height, width = depth_m.shape[-2:]
    if height % stride or width % stride:
        raise InputError(
            f"depth_m must have a size divisible by stride {stride}, got {height} x {width}."
        )
    low, _, step = depth_range
    # Blocks are h rows and w columns, and each has s x s pixels.
    blocks = depth_m.unflatten(dim=-1, sizes=(-1, stride))
    blocks = blocks.unflatten(dim=-3, sizes=(-1, stride))  # (..., h, s, w, s)
    # A pixel without a return is infinitely far, beyond all bins.
    returns = torch.where(blocks == 0, torch.inf, blocks)
    nearest = returns.amin((-3, -1))  # (..., h, w)
    # Position in bins, counted from one bin before the first bin, as in the released code. A depth
    # in bin i has a position in [i + 1, i + 2).
    position = (nearest - (low - step)) / step
    valid = (position >= 1) & (position < num_depth_bins(depth_range) + 1)
    # The position 0 of blocks without a target becomes the index -1.
    return torch.where(valid, position, 0).long() - 1


def depth_loss(probs: Tensor, bins: Tensor) -> Tensor:
    """Cross-entropy of the depth bins: the mean of -log p at the target bin.

    Args:
        probs: Probabilities of the bins. (..., D, h, w)
        bins: Indices of the target bins, -1 without a target, from `depth_bins`. (..., h, w)

    Returns:
        The mean over pixels with a target; 0 if there is none. ()

    Raises:
        ValueError: If the shapes disagree.
    """
    if probs.shape[:-3] + probs.shape[-2:] != bins.shape:
        raise InputError(
            f"bins must have the shape of probs without its bin axis, got {tuple(bins.shape)} "
            f"for {tuple(probs.shape)}."
        )
    valid = bins >= 0
    # Bin 0 stands in where there is no target. Its probability is replaced by 1 below, whose
    # logarithm is 0.
    indices = bins.clamp(min=0).unsqueeze(-3)
    target_probs = probs.float().gather(dim=-3, index=indices).squeeze(-3)  # (..., h, w)
    smallest_prob = torch.finfo(target_probs.dtype).tiny  # avoids log(0)
    target_probs = torch.where(valid, target_probs, 1).clamp(min=smallest_prob)
    return -target_probs.log().sum() / valid.sum().clamp(min=1)
