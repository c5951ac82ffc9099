"""Auxiliary heads of masks in bird's-eye and camera view. They only help training.

Each has a ``name``, the ``transforms`` that make its target, and ``loss(bev_outputs, samples)``;
predictions do not run them.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.ops.soft_iou import dice_loss
from gsmap.structures.tensors import check_same_shape, constant
from gsmap.utils.errors import InputError
from gsmap.utils.targets import NeedsTargets

Samples = Sequence[Det3DDataSample]


def stack_targets(head: Any, samples: Samples, name: str, device: torch.device) -> Tensor:
    """Training target of all samples, stacked.

    Args:
        head: Auxiliary head, for the name of its transform in the error.
        samples: Samples of the batch, each with the target.
        name: Field of the target.
        device: Device of the result.

    Returns:
        The targets. (B, ...)

    Raises:
        ValueError: If a sample lacks the target.
    """
    for sample in samples:
        if name not in sample:
            raise InputError(
                f"sample {sample.metainfo.get('token')!r} has no {name}: add its transform "
                f"{head.transforms[0]} to the training pipeline, or remove its loss from the model."
            )
    return torch.stack([torch.as_tensor(sample.get(name)) for sample in samples]).to(device)


@MODELS.register_module()
class BEVMaskHead(nn.Sequential, NeedsTargets):
    """Elements drawn in bird's-eye view, all in one mask or one mask a class.

    Args:
        embed_dims: Channels C of the features.
        loss_weight: Weight of the cross-entropy.
        pos_weight: Weight of the drawn cells in it.
        dice_weight: Weight of the dice loss of all masks together.
        num_masks: 1 for all elements in one mask, else the number of classes.
    """

    feats, target = "bev_feats", "gt_seg"  # (B, C, H, W) and (B, classes or 1, H, W)
    transforms = ("MakeBEVMask",)

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 1.0,
        pos_weight: float = 4.0,
        dice_weight: float = 0.0,
        num_masks: int = 1,
        name: str = "seg",
    ) -> None:
        super().__init__(*self.layers(embed_dims, num_masks))
        self.loss_weight, self.pos_weight, self.dice_weight = loss_weight, pos_weight, dice_weight
        self.num_masks, self.name = num_masks, name

    @staticmethod
    def layers(embed_dims: int, num_masks: int) -> nn.Sequential:
        """Return the network: a 3x3 and a 1x1 convolution. (B, C, H, W) -> (B, num_masks, H, W)"""
        return nn.Sequential(
            nn.Conv2d(embed_dims, embed_dims, 3, padding=1, bias=False),
            nn.ReLU(True),
            nn.Conv2d(embed_dims, num_masks, 1),
        )

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Samples) -> Tensor:
        """Return the weighted loss on the encoder's features."""
        feats = bev_outputs[self.feats]
        target = stack_targets(self, batch_data_samples, self.target, feats.device)
        target = target.reshape(-1, *target.shape[-3:])
        if self.num_masks == 1:
            target = target.amax(1, keepdim=True)
        elif target.shape[1] != self.num_masks:
            raise InputError(
                f"{self.target} has {target.shape[1]} channels, {self.num_masks} masks are "
                f"predicted: set num_classes={self.num_masks} in its transform."
            )
        logits = self(feats.reshape(-1, *feats.shape[-3:]))
        cross_entropy, dice = class_mask_losses(logits, target, self.pos_weight)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


@MODELS.register_module()
class PVMaskHead(BEVMaskHead):
    """Elements drawn in the view of each camera; learned from the encoder's image features."""

    feats, target = "img_feats", "gt_pv_seg"  # (B, V, C, h, w) and (B, V, classes or 1, h, w)
    transforms = ("MakePVMask",)

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 2.0,
        pos_weight: float = 1.0,
        name: str = "pv_seg",
        **kwargs: Any,
    ) -> None:
        super().__init__(embed_dims, loss_weight, pos_weight, name=name, **kwargs)


def class_mask_losses(
    logits: Tensor, targets: Tensor, pos_weight: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Return the mean binary cross-entropy of class masks, and the dice of all classes together.

    Targets are 0 or 1, of any dtype; ``pos_weight`` is the weight of cells of 1 in the
    cross-entropy; dice is a mean over samples. ValueError if the shapes disagree.
    2 x (B, classes, H, W) -> (), ()
    """
    check_same_shape(logits=logits, targets=targets)
    logits, targets = logits.float(), targets.float()
    weight = constant(logits, pos_weight, torch.float)
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, pos_weight=weight)
    return cross_entropy, dice_loss(logits.sigmoid().flatten(1, 2), targets.flatten(1, 2)).mean()
