"""Auxiliary heads that predict masks in bird's-eye and camera view, used in training only.

An auxiliary head improves the features in training, and has no output in prediction. Each head has
the name of its loss (``name``), the names of the pipeline transforms that make its target
(``transforms``), and a method ``loss(bev_outputs, samples)``.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.ops.soft_iou import dice_loss
from gsmap.structures.tensors import check_same_shape, constant
from gsmap.utils.errors import InputError
from gsmap.utils.targets import NeedsTargets

Samples = Sequence[Det3DDataSample]


def stack_targets(head: Any, samples: Samples, name: str, device: torch.device) -> Tensor:
    """Stack the training targets of all samples.

    Args:
        head: Auxiliary head. The first of its ``transforms`` is named in the error.
        samples: Samples of the batch, each with the target.
        name: Field of the target.
        device: Device of the result.

    Returns:
        The targets. (B, ...)

    Raises:
        ValueError: If a sample lacks the target.
    """
    targets = []
    for sample in samples:
        if name not in sample:
            raise InputError(
                f"sample {sample.metainfo.get('token')!r} has no {name}: add its transform "
                f"{head.transforms[0]} to the training pipeline, or remove its loss from the model."
            )
        targets.append(torch.as_tensor(sample.get(name)))
    return torch.stack(targets).to(device)


@MODELS.register_module()
class BEVMaskHead(nn.Sequential, NeedsTargets):
    """Head of masks of the map elements in bird's-eye view.

    Args:
        embed_dims: Channels C of the features.
        loss_weight: Weight of the cross-entropy.
        pos_weight: Weight of foreground cells in the cross-entropy.
        dice_weight: Weight of the dice loss, which treats the masks of a sample as one.
        num_masks: Number of predicted masks: the number of classes for one mask per class, or 1 for
            one mask of all elements. For 1, the masks of the classes in the target are united.
        name: Name of the loss.

    Attributes:
        feats: Key of the features in the outputs of the BEV encoder.
        target: Field of the target in a sample.
        transforms: Transforms of the training pipeline that make the target.
    """

    feats = "bev_feats"  # (B, C, H, W)
    target = "gt_seg"  # (B, classes or 1, H, W)
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
        network = self.layers(embed_dims, num_masks)
        super().__init__(*network)  # the layers are children of the head, with the keys 0 to 2
        if num_masks > 1:  # a mask per class
            mark_classes(self[-1])
        self.loss_weight = loss_weight
        self.pos_weight = pos_weight
        self.dice_weight = dice_weight
        self.num_masks = num_masks
        self.name = name

    @staticmethod
    def layers(embed_dims: int, num_masks: int) -> nn.Sequential:
        """Network of a 3x3 and a 1x1 convolution. (B, C, H, W) -> (B, num_masks, H, W)"""
        return nn.Sequential(
            nn.Conv2d(embed_dims, embed_dims, kernel_size=3, padding=1, bias=False),
            nn.ReLU(True),
            nn.Conv2d(embed_dims, num_masks, kernel_size=1),
        )

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Samples) -> Tensor:
        """Weighted loss of the masks that are predicted from the features of the encoder.

        Args:
            bev_outputs: Outputs of the BEV encoder.
            batch_data_samples: Samples with targets.

        Returns:
            The loss. ()

        Raises:
            ValueError: If a sample has no target, or its target does not have ``num_masks`` masks.
        """
        feats = bev_outputs[self.feats]
        target = stack_targets(self, batch_data_samples, name=self.target, device=feats.device)
        # All axes before the last three, (masks, H, W), become one. BEV targets keep their axis of
        # B samples; targets of V cameras, (B, V, masks, h, w), get one axis of B * V images.
        target = target.flatten(0, -4)
        if self.num_masks == 1:
            target = target.amax(1, keepdim=True)  # union of the masks of all classes
        elif target.shape[1] != self.num_masks:
            raise InputError(
                f"{self.target} has {target.shape[1]} channels, {self.num_masks} masks are "
                f"predicted: set num_classes={self.num_masks} in its transform."
            )
        logits = self(feats.flatten(0, -4))
        cross_entropy, dice = class_mask_losses(logits, target, pos_weight=self.pos_weight)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


@MODELS.register_module()
class PVMaskHead(BEVMaskHead):
    """Head of masks of the map elements in the view of each camera, from its image features.

    Args:
        embed_dims: Channels C of the features.
        loss_weight: Weight of the cross-entropy.
        pos_weight: Weight of foreground cells in the cross-entropy.
        name: Name of the loss.
        kwargs: ``dice_weight`` and ``num_masks`` of `BEVMaskHead`.
    """

    feats = "img_feats"  # (B, V, C, h, w)
    target = "gt_pv_seg"  # (B, V, classes or 1, h, w)
    transforms = ("MakePVMask",)

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 2.0,
        pos_weight: float = 1.0,
        name: str = "pv_seg",
        **kwargs: Any,
    ) -> None:
        super().__init__(embed_dims, loss_weight, pos_weight=pos_weight, name=name, **kwargs)


def class_mask_losses(
    logits: Tensor, targets: Tensor, pos_weight: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Binary cross-entropy and dice loss of class masks.

    Args:
        logits: Logits of the masks. (B, classes, H, W)
        targets: Masks of 0 and 1, of any dtype. (B, classes, H, W)
        pos_weight: Weight of the cells of 1 in the cross-entropy.

    Returns:
        The mean cross-entropy of the cells (), and the dice loss of all classes of a sample
        together, averaged over the samples. ()

    Raises:
        ValueError: If the shapes disagree.
    """
    check_same_shape(logits=logits, targets=targets)
    logits = logits.float()
    targets = targets.float()
    # `constant` caches the tensor. A new tensor in each step would wait for the GPU.
    weight = constant(logits, pos_weight, torch.float)
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, pos_weight=weight)
    # All classes of a sample count as one mask, (B, classes * H, W).
    dice = dice_loss(logits.sigmoid().flatten(1, 2), targets.flatten(1, 2))
    return cross_entropy, dice.mean()
