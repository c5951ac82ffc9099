"""Losses of rendered masks: GSMap's raster loss (Eq. 12), and overlap in its place."""

from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WEIGHT, check_weight, class_weights
from gsmap.models.gsmap.reference import require_gaussians
from gsmap.ops.raster_loss import NORMALIZATIONS, raster_loss
from gsmap.ops.soft_iou import dice_loss, soft_iou
from gsmap.utils.errors import InputError


class MaskLoss(MapLoss):
    """A loss of the rendered masks of matched instances.

    Masks that hardly meet push a prediction anywhere, so such a pair's loss may count less.

    Args:
        loss_weight: Weight of the loss, or one for each class.
        full_iou: Soft IoU of a pair's masks from which on its loss counts in full; below, it is
            multiplied with the share of it that is reached. 0: all count in full. Or one for each
            class.
        flags: As in `MapLoss`.
    """

    name = "raster"

    def __init__(self, loss_weight: WEIGHT = 10.0, full_iou: WEIGHT = 0.0, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)
        self.full_iou = full_iou

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head has no Gaussians to render, or other classes."""
        require_gaussians(self, head)
        check_weight(self, self.full_iou, head.classes)

    def per_instance(self, preds: Tensor, targets: Tensor) -> Tensor:
        """Return one value per instance. 2 x (M, H, W) -> (M,)"""
        raise NotImplementedError

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Compare rendered and drawn masks. (M,)"""
        losses = self.per_instance(pairs.pred_masks, pairs.gt_masks)
        if self.full_iou == 0:
            return losses
        full = class_weights(self.full_iou, pairs.gt_labels)
        iou = soft_iou(pairs.pred_masks.detach(), pairs.gt_masks)
        return losses * torch.where(iou < full, iou / full, 1)


@MODELS.register_module()
class RasterLoss(MaskLoss):
    """Raster loss of matched instances, averaged over them (GSMap Eq. 12).

    Args:
        loss_weight: Weight of the loss: the paper's lambda_r.
        alpha: Share of the weighted L1 term: the paper's lambda_alpha. 0 and 1 switch a term off.
        foreground_weight: Weight of a ground-truth pixel in the L1 term; 1 is plain L1.
        normalize: What the sums over pixels are divided by: ``"both"``, ``"foreground"`` or
            ``"pixels"`` (see `gsmap.ops.raster_loss.raster_loss`).
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.
        full_iou: As in `MaskLoss`.
        flags: As in `MapLoss`.

    Raises:
        ValueError: If an argument is outside its range.
    """

    def __init__(
        self,
        loss_weight: WEIGHT = 10.0,
        alpha: float = 0.8,
        foreground_weight: float = 1.0,
        normalize: str = "both",
        window_size: int = 11,
        window_sigma: float = 1.5,
        full_iou: WEIGHT = 0.0,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight, full_iou, **flags)
        if not 0 <= alpha <= 1:
            raise InputError(f"alpha must lie in [0, 1], got {alpha}.")
        if foreground_weight <= 0:
            raise InputError(f"foreground_weight must be > 0, got {foreground_weight}.")
        if normalize not in NORMALIZATIONS:
            raise InputError(f"normalize must be one of {NORMALIZATIONS}, got {normalize!r}.")
        if window_size < 1 or window_size % 2 == 0:
            raise InputError(f"window_size must be odd and >= 1, got {window_size}.")
        if window_sigma <= 0:
            raise InputError(f"window_sigma must be > 0, got {window_sigma}.")
        self.settings: dict[str, Any] = {
            "alpha": alpha,
            "foreground_weight": foreground_weight,
            "normalize": normalize,
            "window_size": window_size,
            "window_sigma": window_sigma,
        }

    def per_instance(self, preds: Tensor, targets: Tensor) -> Tensor:
        """Return one value per instance. 2 x (M, H, W) -> (M,)"""
        return raster_loss(preds, targets, **self.settings)


@MODELS.register_module()
class MaskOverlapLoss(MaskLoss):
    """Dice or IoU loss of the rendered masks of matched instances, in place of Eq. 12.

    Args:
        loss_weight: Weight of the loss.
        kind: ``"dice"`` (`dice_loss`), or ``"iou"``: 1 - sum min / sum max.
        full_iou: As in `MaskLoss`.
        flags: As in `MapLoss`.

    Raises:
        ValueError: If ``kind`` is unknown.
    """

    def __init__(
        self,
        loss_weight: WEIGHT = 10.0,
        kind: str = "dice",
        full_iou: WEIGHT = 0.0,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight, full_iou, **flags)
        if kind not in ("dice", "iou"):
            raise InputError(f"kind must be 'dice' or 'iou', got {kind!r}.")
        self.kind = kind

    def per_instance(self, preds: Tensor, targets: Tensor) -> Tensor:
        """Return one value per instance. 2 x (M, H, W) -> (M,)"""
        if self.kind == "dice":
            return dice_loss(preds, targets)
        return 1 - soft_iou(preds, targets)
