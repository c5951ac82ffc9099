"""Overlap of soft masks: intersection over union, sum(min) / sum(max), and dice."""

import torch
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.soft_iou.reference import pairwise_minima_reference
from gsmap.utils.errors import InputError

_EPS = 1e-6  # added to the union, so that two empty masks have IoU 0
# Operator that calls a fused kernel of this folder: sums of minima (N, K), without gradient.
_pairwise_minima = fused_operator(
    "soft_iou.pairwise_minima",
    "Tensor preds, Tensor targets",
    shape=lambda preds, targets: (len(preds), len(targets)),
)


def pairwise_soft_iou(preds: Tensor, targets: Tensor, backend: str = "auto") -> Tensor:
    r"""Compute the soft IoU of each prediction with each ground truth.

    The IoU of the masks a and b is :math:`\sum_p \min(a, b) / \sum_p \max(a, b)`, summed over the
    pixels p, and 0 for two empty masks. Only sums of minima are computed per pair, without an
    (N, K, H, W) tensor.

    Args:
        preds: Predicted masks in [0, 1]. (N, H, W)
        targets: Ground-truth masks in [0, 1]. (K, H, W)
        backend: ``"auto"``, ``"reference"`` (plain torch), ``"cpu"`` (numba) or ``"triton"``, see
            `choose_backend`. The last two are fused kernels without a gradient, so ``"auto"``
            selects them only if no gradient is needed.

    Returns:
        Soft IoU in [0, 1]. (N, K)

    Raises:
        ValueError: If the shapes disagree, or if ``backend`` is unknown or does not support the
            inputs.
    """
    are_masks = preds.ndim == 3 and targets.ndim == 3
    if not are_masks or preds.shape[1:] != targets.shape[1:]:
        raise InputError(
            "preds and targets must have shapes (N, H, W) and (K, H, W), "
            f"got {tuple(preds.shape)} and {tuple(targets.shape)}."
        )
    preds, targets = _in_one_type(preds, targets)
    preds = preds.flatten(1)  # (N, HW)
    targets = targets.flatten(1)  # (K, HW)
    wants_gradient = torch.is_grad_enabled() and (preds.requires_grad or targets.requires_grad)
    if backend == "auto" and wants_gradient:
        backend = "reference"
    backend = choose_backend(backend, preds, kernel="pairwise_soft_iou")
    if backend == "reference":
        minima = pairwise_minima_reference(preds, targets)
    else:
        preds = preds.detach()
        targets = targets.detach()
        minima = _pairwise_minima(preds, targets, backend)
    return _iou(minima, preds.sum(-1)[:, None], target_sums=targets.sum(-1))


def soft_iou(preds: Tensor, targets: Tensor) -> Tensor:
    """Compute the soft IoU of each predicted mask with its ground truth.

    Args:
        preds: Predicted masks in [0, 1]. (M, H, W)
        targets: Ground-truth masks in [0, 1]. (M, H, W)

    Returns:
        Soft IoU in [0, 1]. (M,)
    """
    preds, targets = _in_one_type(preds, targets)
    minima = torch.minimum(preds, targets).sum((1, 2))
    return _iou(minima, preds.sum((1, 2)), target_sums=targets.sum((1, 2)))


def _in_one_type(preds: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Convert masks to the type of the predictions, at least float32.

    Sums over the pixels of a mask are too large for half precision.
    """
    dtype = torch.promote_types(preds.dtype, torch.float32)
    return preds.to(dtype), targets.to(dtype)


def _iou(minima: Tensor, pred_sums: Tensor, target_sums: Tensor) -> Tensor:
    """Soft IoU from the sums of minima and of both masks; 0 for empty masks."""
    maxima = pred_sums + target_sums - minima  # since min(a, b) + max(a, b) = a + b
    return minima / (maxima + _EPS)


def dice_loss(preds: Tensor, targets: Tensor) -> Tensor:
    """Compute the dice loss 1 - (2 sum(p t) + 1) / (sum p + sum t + 1) of each mask.

    Args:
        preds: Predicted masks p in [0, 1]. (n, H, W)
        targets: Ground-truth masks t in [0, 1]. (n, H, W)

    Returns:
        Losses in [0, 1]. (n,)
    """
    preds, targets = _in_one_type(preds, targets)
    overlap = (preds * targets).sum((1, 2))
    sizes = preds.sum((1, 2)) + targets.sum((1, 2))
    return 1 - (2 * overlap + 1) / (sizes + 1)


def pairwise_dice_loss(preds: Tensor, targets: Tensor) -> Tensor:
    """Compute the dice loss of each prediction with each ground truth, see `dice_loss`.

    Args:
        preds: Predicted masks in [0, 1]. (N, H, W)
        targets: Ground-truth masks in [0, 1]. (K, H, W)

    Returns:
        Losses in [0, 1]. (N, K)
    """
    preds, targets = _in_one_type(preds, targets)
    preds = preds.flatten(1)
    targets = targets.flatten(1)
    with torch.autocast(preds.device.type, enabled=False):
        overlap = preds @ targets.T
    sizes = preds.sum(-1)[:, None] + targets.sum(-1)
    return 1 - (2 * overlap + 1) / (sizes + 1)
