"""Auxiliary head of depth supervision, used in training only."""

from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.mask_heads import Samples, stack_targets
from gsmap.models.maptrv2.depth import depth_bins, depth_loss
from gsmap.utils.targets import NeedsTargets


@MODELS.register_module()
class DepthSupervision(nn.Module, NeedsTargets):
    """Auxiliary head that supervises the depth in a lifting encoder by LiDAR.

    Args:
        loss_weight: Weight of the loss.
        name: Name of the loss.
        kwargs: Arguments that a map head passes to every auxiliary head (``embed_dims``); not used.
    """

    transforms = ("MakeDepthMap",)  # required in the training pipeline

    def __init__(self, loss_weight: float = 3.0, name: str = "depth", **kwargs: Any) -> None:
        super().__init__()
        self.loss_weight = loss_weight
        self.name = name

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Samples) -> Tensor:
        """Weighted depth loss.

        Args:
            bev_outputs: Outputs of the encoder: ``depth``, the probabilities of the bins
                (B, V, D, h, w), and ``depth_range``, the start of the first bin, the end of the
                last bin and the size of a bin, in metres.
            batch_data_samples: Samples with ``gt_depth`` in metres. (V, H, W) each
        """
        probs = bev_outputs["depth"]
        target = stack_targets(self, batch_data_samples, name="gt_depth", device=probs.device)
        stride = target.shape[-1] // probs.shape[-1]  # pixels of the target per cell of `probs`
        bins = depth_bins(target, stride=stride, depth_range=bev_outputs["depth_range"])
        return self.loss_weight * depth_loss(probs, bins)
