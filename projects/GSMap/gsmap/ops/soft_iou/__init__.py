"""Overlap of soft masks: intersection over union, sum(min) / sum(max), and dice."""

import torch
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.soft_iou.reference import pairwise_minima_reference

_EPS = 1e-6  # added to the union: two empty masks have IoU 0
_pairwise_minima = fused_operator(
    "soft_iou.pairwise_minima",
    "Tensor preds, Tensor targets",
    lambda *masks: tuple(map(len, masks)),
)


def pairwise_soft_iou(preds: Tensor, targets: Tensor, backend: str = "auto") -> Tensor:
    r"""Return the soft IoU in [0, 1] of every prediction with every ground truth. (N, K)

    :math:`\sum_p \min(a, b) / \sum_p \max(a, b)`. Only the minimum is summed per pair, without an
    (N, K, H, W) tensor; the IoU of two empty masks is 0.

    Args:
        preds: Masks in [0, 1]. (N, H, W)
        targets: Masks in [0, 1]. (K, H, W)
        backend: As in `choose_backend`. The fused kernels give no gradient; ``"auto"`` takes them
            where none is asked for.

    Raises:
        ValueError: If the shapes disagree or ``backend`` does not serve.
    """
    if preds.ndim != 3 or targets.ndim != 3 or preds.shape[1:] != targets.shape[1:]:
        raise ValueError(
            "preds and targets must have shapes (N, H, W) and (K, H, W), "
            f"got {tuple(preds.shape)} and {tuple(targets.shape)}."
        )
    dtype = torch.promote_types(preds.dtype, torch.float32)
    preds, targets = preds.to(dtype).flatten(1), targets.to(dtype).flatten(1)  # (N, HW), (K, HW)
    wants_gradient = torch.is_grad_enabled() and (preds.requires_grad or targets.requires_grad)
    backend = choose_backend(
        "reference" if backend == "auto" and wants_gradient else backend,
        preds,
        kernel="pairwise_soft_iou",
    )
    if backend == "reference":
        minima = pairwise_minima_reference(preds, targets)
    else:
        preds, targets = preds.detach(), targets.detach()
        minima = _pairwise_minima(preds, targets, backend)
    return _iou(minima, preds.sum(-1)[:, None], targets.sum(-1))


def soft_iou(preds: Tensor, targets: Tensor) -> Tensor:
    """Return the soft IoU in [0, 1] of pairs of masks in [0, 1]. 2 x (M, H, W) -> (M,)"""
    minima = torch.minimum(preds, targets).sum((1, 2))
    return _iou(minima, preds.sum((1, 2)), targets.sum((1, 2)))


def _iou(minima: Tensor, preds: Tensor, targets: Tensor) -> Tensor:
    """Return sums of minima over those of maxima, since min + max = a + b; 0 of empty masks."""
    return minima / (preds + targets - minima + _EPS)


def dice_loss(preds: Tensor, targets: Tensor) -> Tensor:
    """Return 1 - (2 sum(p t) + 1) / (sum p + sum t + 1) of pairs of masks. 2 x (n, H, W) -> (n,)"""
    overlap = (preds * targets).sum((1, 2))
    return 1 - (2 * overlap + 1) / (preds.sum((1, 2)) + targets.sum((1, 2)) + 1)


def pairwise_dice_loss(preds: Tensor, targets: Tensor) -> Tensor:
    """Dice loss of every prediction with every target. (N, H, W), (K, H, W) -> (N, K)"""
    preds, targets = preds.flatten(1), targets.flatten(1)
    overlap = preds @ targets.T
    return 1 - (2 * overlap + 1) / (preds.sum(-1)[:, None] + targets.sum(-1) + 1)
