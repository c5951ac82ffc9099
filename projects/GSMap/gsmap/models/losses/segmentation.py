"""Mask losses of MGMapNet: classes in BEV, and instances."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.models.losses.auxiliary import mask_loss
from gsmap.models.losses.dice import dice_loss

PAIRINGS = ("matched", "released")


def class_mask_losses(logits: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return cross-entropy and dice of class masks.

    Args:
        logits: Predicted masks, one channel per class. (B, classes, H, W)
        targets: 0 or 1, any dtype. (B, classes, H, W)

    Returns:
        The mean binary cross-entropy () and the mean over samples of the dice loss of all classes
        together ().

    Raises:
        ValueError: If the shapes disagree.
    """
    cross_entropy = mask_loss(logits, targets)
    probs, truth = logits.float().sigmoid().flatten(1, 2), targets.float().flatten(1, 2)
    return cross_entropy, dice_loss(probs, truth).mean()


def instance_mask_losses(
    logits: Tensor, targets: Tensor, avg_factor: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Return cross-entropy and dice of matched instances' masks, summed over ``avg_factor``.

    Args:
        logits: Predicted masks. (M, H, W)
        targets: Masks of their ground truths, 0 or 1, any dtype. (M, H, W)
        avg_factor: The divisor: the number of matched elements, at least 1.

    Returns:
        Binary cross-entropy, each instance the mean over its cells (), and dice (); zero without
        matches.

    Raises:
        ValueError: If the shapes disagree.
    """
    if logits.shape != targets.shape:
        raise ValueError(
            f"targets must have shape {tuple(logits.shape)} of logits, got {tuple(targets.shape)}."
        )
    logits, targets = logits.float(), targets.float()
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    dice = dice_loss(logits.sigmoid(), targets)
    return cross_entropy.mean((1, 2)).sum() / avg_factor, dice.sum() / avg_factor


def pair_masks(
    query_inds: Tensor, gt_inds: Tensor, pairing: str = "matched"
) -> tuple[Tensor, Tensor]:
    """Say which instance's mask each matched query is compared with.

    The released code of MGMapNet compares the i-th matched query, in ascending order, with the i-th
    ground truth, which is right only if the matching happens to be sorted.

    Args:
        query_inds: Matched queries of a sample. (M,)
        gt_inds: The ground truth of each. (M,)
        pairing: ``"matched"``: its own ground truth; ``"released"``: as in the released code.

    Returns:
        Queries (M,) and the ground truths whose masks they are compared with (M,).

    Raises:
        ValueError: If ``pairing`` is unknown.
    """
    if pairing not in PAIRINGS:
        raise ValueError(f"pairing must be one of {PAIRINGS}, got {pairing!r}.")
    if pairing == "matched":
        return query_inds, gt_inds
    return query_inds.sort().values, torch.arange(len(gt_inds), device=gt_inds.device)
