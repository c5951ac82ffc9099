"""The auxiliary head of depth. It only helps training."""

from typing import Any

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.mask_heads import Samples, stack_targets
from gsmap.models.maptrv2.depth import depth_bins, depth_loss
from gsmap.utils.targets import NeedsTargets


@MODELS.register_module()
class DepthSupervision(nn.Module, NeedsTargets):
    """The depth of an encoder that lifts features, from ``gt_depth`` (V, H, W) of a LiDAR.

    What other auxiliary heads take, ``kwargs``, is not used.
    """

    transforms = ("MakeDepthMap",)

    def __init__(self, loss_weight: float = 3.0, name: str = "depth", **kwargs: Any) -> None:
        super().__init__()
        self.loss_weight, self.name = loss_weight, name

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Samples) -> Tensor:
        """Return the loss on ``depth`` (B, V, D, h, w), probabilities of ``depth_range``'s bins."""
        probs, depth_range = bev_outputs["depth"], bev_outputs["depth_range"]
        target = stack_targets(self, batch_data_samples, "gt_depth", probs.device)
        bins = depth_bins(target, target.shape[-1] // probs.shape[-1], depth_range)
        return self.loss_weight * depth_loss(probs, bins)
