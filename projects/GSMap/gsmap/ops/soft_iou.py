"""Soft intersection over union of masks: sum(min) / sum(max)."""

import torch
from torch import Tensor


def pairwise_soft_iou(preds: Tensor, targets: Tensor, eps: float = 1e-6) -> Tensor:
    r"""Soft IoU of every prediction with every ground truth, without an (N, K, H, W) tensor.

    :math:`\sum_p \min(a, b) / \sum_p \max(a, b)`; since min + max = a + b, only the minimum is
    summed per pair.

    Args:
        preds: Masks in [0, 1]. (N, H, W)
        targets: Masks in [0, 1]. (K, H, W)
        eps: Added to the union, so that two empty masks have IoU 0.

    Returns:
        IoU in [0, 1]. (N, K)

    Raises:
        ValueError: If the shapes disagree.
    """
    if preds.ndim != 3 or targets.ndim != 3 or preds.shape[1:] != targets.shape[1:]:
        raise ValueError(
            "preds and targets must have shapes (N, H, W) and (K, H, W), "
            f"got {tuple(preds.shape)} and {tuple(targets.shape)}."
        )
    dtype = torch.promote_types(preds.dtype, torch.float32)
    preds, targets = preds.to(dtype).flatten(1), targets.to(dtype).flatten(1)  # (N, HW), (K, HW)
    if not len(targets):
        return preds.new_zeros(len(preds), 0)
    intersection = torch.stack([torch.minimum(preds, target).sum(-1) for target in targets], -1)
    union = preds.sum(-1)[:, None] + targets.sum(-1) - intersection
    return intersection / (union + eps)
