"""Auxiliary heads of MapTRv2: masks in bird's-eye and camera view, depth. They only help training.

Each has a ``name`` and ``loss(bev_outputs, batch_data_samples)``; predictions do not run them.
"""

from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.models.losses.auxiliary import depth_bins, depth_loss, mask_loss


def stack_targets(
    batch_data_samples: Sequence[Det3DDataSample], name: str, device: torch.device
) -> Tensor:
    """Stack a training target of all samples. (B, ...)

    Raises:
        ValueError: If a sample does not have it.
    """
    for sample in batch_data_samples:
        if name not in sample:
            raise ValueError(
                f"sample {sample.metainfo.get('token')!r} has no {name}: add its transform to the "
                "training pipeline, or remove its loss from the model."
            )
    return torch.stack([torch.as_tensor(s.get(name)) for s in batch_data_samples]).to(device)


@MODELS.register_module()
class BEVMaskHead(nn.Sequential):
    """All elements drawn in one mask in bird's-eye view: two convolutions and a cross-entropy.

    Args:
        embed_dims: Channels C of the features.
        loss_weight: Weight of the loss.
        pos_weight: Weight of the drawn cells in it.
        name: Name of its weights and of its loss.
    """

    feats, target = "bev_feats", "gt_seg"  # (B, C, H, W) and (B, 1, H, W)

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 1.0,
        pos_weight: float = 4.0,
        name: str = "seg",
    ) -> None:
        super().__init__(
            nn.Conv2d(embed_dims, embed_dims, 3, padding=1, bias=False),
            nn.ReLU(inplace=True),
            nn.Conv2d(embed_dims, 1, 1),
        )
        self.loss_weight, self.pos_weight, self.name = loss_weight, pos_weight, name

    def loss(
        self, bev_outputs: dict[str, Any], batch_data_samples: Sequence[Det3DDataSample]
    ) -> Tensor:
        """Return the weighted loss on the encoder's features."""
        feats = bev_outputs[self.feats]
        target = stack_targets(batch_data_samples, self.target, feats.device)
        logits = self(feats.reshape(-1, *feats.shape[-3:]))
        target = target.reshape(logits.shape)
        return self.loss_weight * mask_loss(logits, target, self.pos_weight)


@MODELS.register_module()
class PVMaskHead(BEVMaskHead):
    """The same in the view of each camera, on the encoder's image features."""

    feats, target = "img_feats", "gt_pv_seg"  # (B, V, C, h, w) and (B, V, 1, h, w)

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 2.0,
        pos_weight: float = 1.0,
        name: str = "pv_seg",
    ) -> None:
        super().__init__(embed_dims, loss_weight, pos_weight, name)


@MODELS.register_module()
class DepthSupervision(nn.Module):
    """The depth of an encoder that lifts features, from ``gt_depth`` (V, H, W) of a LiDAR.

    Args:
        loss_weight: Weight of the loss.
        name: Name of its loss.
        kwargs: What other auxiliary heads take; not used.
    """

    def __init__(self, loss_weight: float = 3.0, name: str = "depth", **kwargs: Any) -> None:
        super().__init__()
        self.loss_weight, self.name = loss_weight, name

    def loss(
        self, bev_outputs: dict[str, Any], batch_data_samples: Sequence[Det3DDataSample]
    ) -> Tensor:
        """Return the loss on ``depth`` (B, V, D, h, w), probabilities of ``depth_range``'s bins."""
        probs, depth_range = bev_outputs["depth"], bev_outputs["depth_range"]
        target = stack_targets(batch_data_samples, "gt_depth", probs.device)
        bins = depth_bins(target, target.shape[-1] // probs.shape[-1], depth_range)
        return self.loss_weight * depth_loss(probs, bins)
