"""Losses of rendered masks: GSMap's raster loss (Eq. 12), and overlap in its place."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.ops.raster_loss import NORMALIZATIONS, raster_loss
from gsmap.ops.soft_iou import dice_loss

_EPS = 1e-6


class _MaskLoss(nn.Module):
    """A loss of the rendered masks of matched instances, averaged over them."""

    name = "raster"
    reads = ("pred.masks", "gt.masks")

    def __init__(self, loss_weight: float, last_layer_only: bool) -> None:
        super().__init__()
        self.loss_weight, self.last_layer_only = loss_weight, last_layer_only

    def per_instance(self, preds: Tensor, targets: Tensor) -> Tensor:
        """Return one value per instance. 2 x (n, H, W) -> (n,)"""
        raise NotImplementedError

    def forward(
        self, preds: Tensor, targets: Tensor, avg_factor: float | Tensor | None = None
    ) -> Tensor:
        """Return the weighted sum over ``avg_factor``, or the mean over the n instances without it.

        Rendered masks and those of their ground truths, 2 x (n, H, W); 0 with a gradient of 0 if
        nothing is matched.
        """
        count = max(len(preds), 1) if avg_factor is None else avg_factor
        return self.loss_weight * self.per_instance(preds, targets).sum() / count


@MODELS.register_module()
class RasterLoss(_MaskLoss):
    """Raster loss of matched instances, averaged over them (GSMap Eq. 12).

    Args:
        loss_weight: Weight of the loss: the paper's lambda_r.
        alpha: Share of the weighted L1 term: the paper's lambda_alpha. 0 and 1 switch a term off.
        foreground_weight: Weight of a ground-truth pixel in the L1 term; 1 is plain L1.
        normalize: What the sums over pixels are divided by: ``"both"``, ``"foreground"`` or
            ``"pixels"`` (see `gsmap.ops.raster_loss.raster_loss`).
        window_size: Side of SSIM's window in pixels, odd.
        window_sigma: Standard deviation of SSIM's window in pixels.
        last_layer_only: Leave it out of all decoder layers but the last.

    Raises:
        ValueError: If an argument is outside its range.
    """

    def __init__(
        self,
        loss_weight: float = 10.0,
        alpha: float = 0.8,
        foreground_weight: float = 1.0,
        normalize: str = "both",
        window_size: int = 11,
        window_sigma: float = 1.5,
        last_layer_only: bool = False,
    ) -> None:
        super().__init__(loss_weight, last_layer_only)
        if not 0 <= alpha <= 1:
            raise ValueError(f"alpha must lie in [0, 1], got {alpha}.")
        if foreground_weight <= 0:
            raise ValueError(f"foreground_weight must be > 0, got {foreground_weight}.")
        if normalize not in NORMALIZATIONS:
            raise ValueError(f"normalize must be one of {NORMALIZATIONS}, got {normalize!r}.")
        if window_size < 1 or window_size % 2 == 0:
            raise ValueError(f"window_size must be odd and >= 1, got {window_size}.")
        if window_sigma <= 0:
            raise ValueError(f"window_sigma must be > 0, got {window_sigma}.")
        self.settings = alpha, foreground_weight, normalize, window_size, window_sigma

    def per_instance(self, preds: Tensor, targets: Tensor) -> Tensor:
        """Return one value per instance. 2 x (n, H, W) -> (n,)"""
        return raster_loss(preds, targets, *self.settings)


@MODELS.register_module()
class MaskOverlapLoss(_MaskLoss):
    """Dice or IoU loss of the rendered masks of matched instances, in place of Eq. 12.

    Args:
        loss_weight: Weight of the loss.
        kind: ``"dice"``, as MapVR (`dice_loss`), or ``"iou"``: 1 - sum min / sum max.
        last_layer_only: Leave it out of all decoder layers but the last.

    Raises:
        ValueError: If ``kind`` is unknown.
    """

    def __init__(
        self, loss_weight: float = 10.0, kind: str = "dice", last_layer_only: bool = False
    ) -> None:
        super().__init__(loss_weight, last_layer_only)
        if kind not in ("dice", "iou"):
            raise ValueError(f"kind must be 'dice' or 'iou', got {kind!r}.")
        self.kind = kind

    def per_instance(self, preds: Tensor, targets: Tensor) -> Tensor:
        """Return one value per instance. 2 x (n, H, W) -> (n,)"""
        if self.kind == "dice":
            return dice_loss(preds, targets)
        overlap = torch.minimum(preds, targets).sum((1, 2))
        return 1 - overlap / torch.maximum(preds, targets).sum((1, 2)).clamp(min=_EPS)
