"""Losses of rendered masks: the raster loss of GSMap (Eq. 12), and dice and IoU losses."""

from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WeightConfig, check_weight, class_weights
from gsmap.models.gsmap.reference import require_gaussians
from gsmap.ops.raster_loss import check_raster_settings, raster_loss
from gsmap.ops.soft_iou import dice_loss, soft_iou
from gsmap.utils.errors import InputError


class MaskLoss(MapLoss):
    """Base class of losses of the rendered masks of matched instances.

    `MapLoss` adds up the `values` of all pairs with their weights, and divides by the number of
    pairs of one layer.

    Without overlap of the masks, the gradient has no useful direction. ``full_iou`` therefore
    reduces the loss of pairs with a small overlap.

    Args:
        loss_weight: Weight of the loss, or a weight for each class.
        full_iou: Smallest soft IoU at which a pair has the full loss, or a value for each class.
            Below it, the loss is multiplied by IoU / full_iou. With 0, all pairs have the full
            loss.
        flags: Flags of `MapLoss`: ``last_layer_only`` and ``first_group_only``.
    """

    name = "raster"  # logged as loss_raster; a head has at most one loss of this name

    def __init__(
        self, loss_weight: WeightConfig = 10.0, full_iou: WeightConfig = 0.0, **flags: bool
    ) -> None:
        super().__init__(loss_weight=loss_weight, **flags)
        self.full_iou = full_iou

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head lacks Gaussians or ``full_iou`` does not fit its classes."""
        require_gaussians(self, head)
        check_weight(self, self.full_iou, classes=head.classes)

    def reduce_small_overlaps(self, losses: Tensor, pairs: MatchedPairs) -> Tensor:
        """Reduce the losses of pairs whose soft IoU is below ``full_iou``.

        Args:
            losses: Loss of each pair. (M,)
            pairs: Matched pairs.

        Returns:
            The reduced losses. (M,)
        """
        if self.full_iou == 0:  # never true for a list with a value for each class
            return losses
        full_iou = class_weights(self.full_iou, pairs.gt_labels)
        # The factor is a weight of the pair, so it has no gradient.
        iou = soft_iou(pairs.pred_masks.detach(), pairs.gt_masks)
        return losses * torch.where(iou < full_iou, iou / full_iou, 1)


@MODELS.register_module()
class RasterLoss(MaskLoss):
    """Raster loss of matched instances, averaged over them (GSMap Eq. 12).

    Args:
        loss_weight: Weight of the loss (lambda_r of the paper), or a weight for each class.
        alpha: Share of the weighted L1 term (lambda_alpha of the paper), in [0, 1]. The rest is the
            SSIM term.
        foreground_weight: Weight of a foreground pixel in the L1 term, > 0. 1 is plain L1.
        normalize: Divisor of the sums over pixels: ``"both"``, ``"foreground"`` or ``"pixels"``
            (`gsmap.ops.raster_loss.raster_loss`).
        window_size: Side of the window of SSIM in pixels, odd.
        window_sigma: Standard deviation of the window of SSIM in pixels, > 0.
        full_iou: Smallest soft IoU of a pair with the full loss (`MaskLoss`).
        flags: Flags of `MapLoss`.

    Raises:
        ValueError: If an argument is outside its range.
    """

    def __init__(
        self,
        loss_weight: WeightConfig = 10.0,
        alpha: float = 0.8,
        foreground_weight: float = 1.0,
        normalize: str = "both",
        window_size: int = 11,
        window_sigma: float = 1.5,
        full_iou: WeightConfig = 0.0,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight=loss_weight, full_iou=full_iou, **flags)
        self.settings: dict[str, Any] = {
            "alpha": alpha,
            "foreground_weight": foreground_weight,
            "normalize": normalize,
            "window_size": window_size,
            "window_sigma": window_sigma,
        }
        check_raster_settings(**self.settings)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Raster loss of each pair. (M,)"""
        losses = raster_loss(pairs.pred_masks, pairs.gt_masks, **self.settings)
        return self.reduce_small_overlaps(losses, pairs)


@MODELS.register_module()
class MaskOverlapLoss(MaskLoss):
    """Dice or IoU loss of the rendered masks of matched instances, an alternative to Eq. 12.

    Args:
        loss_weight: Weight of the loss, or a weight for each class.
        kind: ``"dice"`` for one minus the dice coefficient, ``"iou"`` for one minus the soft IoU.
        full_iou: Smallest soft IoU of a pair with the full loss (`MaskLoss`).
        flags: Flags of `MapLoss`.

    Raises:
        ValueError: If ``kind`` is unknown.
    """

    def __init__(
        self,
        loss_weight: WeightConfig = 10.0,
        kind: str = "dice",
        full_iou: WeightConfig = 0.0,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight=loss_weight, full_iou=full_iou, **flags)
        if kind not in ("dice", "iou"):
            raise InputError(f"kind must be 'dice' or 'iou', got {kind!r}.")
        self.kind = kind

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Dice or IoU loss of each pair. (M,)"""
        if self.kind == "dice":
            losses = dice_loss(pairs.pred_masks, pairs.gt_masks)
        else:
            losses = 1 - soft_iou(pairs.pred_masks, pairs.gt_masks)
        return self.reduce_small_overlaps(losses, pairs)
