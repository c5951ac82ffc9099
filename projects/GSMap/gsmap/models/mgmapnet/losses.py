"""MGMapNet's losses: of sampling locations, and of masks of instances."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.maptr.layers import mlp
from gsmap.models.maptr.losses import PointsLoss
from gsmap.ops.soft_iou import dice_loss
from gsmap.structures.tensors import check_same_shape

PAIRINGS = ("matched", "released")


def instance_mask_losses(
    logits: Tensor, targets: Tensor, avg_factor: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Return cross-entropy and dice of matched instances' masks, summed over ``avg_factor``.

    Masks in [0, 1], of any dtype, 2 x (M, H, W); an instance's cross-entropy is the mean over its
    cells; zero without matches. ValueError if the shapes disagree.
    """
    check_same_shape(logits=logits, targets=targets)
    logits, targets = logits.float(), targets.float()
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    dice = dice_loss(logits.sigmoid(), targets)
    return cross_entropy.mean((1, 2)).sum() / avg_factor, dice.sum() / avg_factor


@MODELS.register_module()
class InstanceMaskLoss(nn.Module):
    """Masks of matched instances, by the product of their states and the BEV features (MGMapNet).

    Args:
        embed_dims: Channels C of the states and of the BEV features.
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss.
        pairing: ``"matched"`` compares each query with the mask of its own ground truth;
            ``"released"``, as MGMapNet's released code, the i-th matched query with the i-th ground
            truth, which is right only if the matching happens to be sorted.

    Raises:
        ValueError: If ``pairing`` is unknown.
    """

    name = "ins_seg"
    reads = ("pred.instance_states", "gt.masks", "gt.inds", "gt.counts", "bev_feats")
    last_layer_only = True
    first_group_only = True

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 3.0,
        dice_weight: float = 3.0,
        pairing: str = "matched",
    ) -> None:
        super().__init__()
        if pairing not in PAIRINGS:
            raise ValueError(f"pairing must be one of {PAIRINGS}, got {pairing!r}.")
        self.embedding = mlp(embed_dims, embed_dims, embed_dims, embed_dims)
        self.loss_weight, self.dice_weight, self.pairing = loss_weight, dice_weight, pairing

    def logits(self, states: Tensor, bev_feats: Tensor) -> Tensor:
        """Return the masks of a sample's instances. (n, C), (C, H, W) -> (n, H, W)"""
        return torch.einsum("nc,chw->nhw", self.embedding(states), bev_feats.to(states))

    def forward(
        self,
        states: Tensor,
        masks: Tensor,
        gt_inds: Tensor,
        counts: Sequence[int],
        bev_feats: Tensor,
        avg_factor: float | Tensor,
    ) -> Tensor:
        """Return the weighted loss, 0 if nothing is matched.

        States (M, C) of matched queries, ascending in a sample of ``counts`` matches; masks (M, h,
        w) of their ground truths, averaged over the cells of the features (B, C, H, W);
        ``gt_inds`` (M,), each one's ground truth in its sample.
        """
        samples = zip(states.split(list(counts)), bev_feats, strict=True)
        logits = torch.cat([self.logits(*sample) for sample in samples])
        masks = masks.to(logits)
        if self.pairing == "released":
            split = zip(masks.split(list(counts)), gt_inds.split(list(counts)), strict=True)
            masks = torch.cat([own[inds.argsort()] for own, inds in split])
        if masks.shape != logits.shape and len(masks):
            masks = F.interpolate(masks[:, None], size=logits.shape[-2:], mode="area")[:, 0]
        masks = masks.reshape(logits.shape)
        cross_entropy, dice = instance_mask_losses(logits, masks, avg_factor)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


@MODELS.register_module()
class SamplingLocationLoss(PointsLoss):
    """The same of each point's mean sampling location, against the point itself (MGMapNet)."""

    name = "mean_loc"
    reads = ("pred.mean_locations", "gt.pts")

    def forward(self, pred: Tensor, target: Tensor, avg_factor: float | Tensor) -> Tensor:
        """Return the weighted loss in the plane. (M, P, 2), (M, P, 2 or 3) -> ()"""
        return super().forward(pred, target[..., :2], avg_factor)
