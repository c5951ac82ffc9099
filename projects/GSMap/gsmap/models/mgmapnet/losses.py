"""MGMapNet's losses: of sampling locations, and of masks of instances."""

from typing import cast

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.layers import mlp
from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.mgmapnet.decoder import MGMapNetDecoded, MGMapNetDecoder
from gsmap.ops.soft_iou import dice_loss
from gsmap.structures.tensors import check_same_shape
from gsmap.utils.errors import InputError

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
class InstanceMaskLoss(MapLoss):
    """Masks of matched instances, by the product of their states and the BEV features (MGMapNet).

    Args:
        embed_dims: Channels C of the states and of the BEV features.
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss.
        pairing: ``"matched"`` compares each query with the mask of its own ground truth;
            ``"released"``, as MGMapNet's released code, the i-th matched query with the i-th ground
            truth, which is right only if the matching happens to be sorted.
        last_layer_only: As in `MapLoss`.
        first_group_only: As in `MapLoss`.

    Raises:
        ValueError: If ``pairing`` is unknown.
    """

    name = "ins_seg"

    def __init__(
        self,
        embed_dims: int = 256,
        loss_weight: float = 3.0,
        dice_weight: float = 3.0,
        pairing: str = "matched",
        last_layer_only: bool = True,
        first_group_only: bool = True,
    ) -> None:
        super().__init__(loss_weight, last_layer_only, first_group_only)
        if pairing not in PAIRINGS:
            raise InputError(f"pairing must be one of {PAIRINGS}, got {pairing!r}.")
        self.embedding = mlp(embed_dims, embed_dims, embed_dims, embed_dims)
        self.dice_weight, self.pairing = dice_weight, pairing

    def logits(self, states: Tensor, bev_feats: Tensor) -> Tensor:
        """Return the masks of a sample's instances. (n, C), (C, H, W) -> (n, H, W)"""
        return torch.einsum("nc,chw->nhw", self.embedding(states), bev_feats.to(states))

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Return the weighted loss; masks are averaged over the cells of the BEV features."""
        states, feats = pairs.pred_instance_states, pairs.predictions.bev_feats
        samples = zip(states.split(pairs.counts), feats, strict=True)
        logits = torch.cat([self.logits(*sample) for sample in samples])  # (M, H, W)
        masks = pairs.gt_masks.to(logits)
        if self.pairing == "released":
            split = zip(masks.split(pairs.counts), pairs.gt_inds.split(pairs.counts), strict=True)
            masks = torch.cat([own[inds.argsort()] for own, inds in split])
        if masks.shape != logits.shape and len(masks):
            masks = F.interpolate(masks[:, None], size=logits.shape[-2:], mode="area")[:, 0]
        masks = masks.reshape(logits.shape)
        cross_entropy, dice = instance_mask_losses(logits, masks, pairs.avg_factor)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


@MODELS.register_module()
class SamplingLocationLoss(MapLoss):
    """L1 distance of each point's mean sampling location to the point itself (MGMapNet).

    Args:
        loss_weight: Weight of the loss.
        flags: As in `MapLoss`.
    """

    name = "mean_loc"

    def __init__(self, loss_weight: float = 5.0, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the decoder does not say where it samples."""
        if not isinstance(head.decoder, MGMapNetDecoder):
            raise InputError(
                "SamplingLocationLoss needs the sampling locations of MGMapNetDecoder, got "
                f"{type(head.decoder).__name__}: leave the loss out, or take MGMapHead."
            )

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Return the distance of each coordinate in the plane, [0, 1] over the map. (M, P, 2)"""
        decoded = cast(MGMapNetDecoded, pairs.predictions.decoded)
        return (pairs.of_queries(decoded.mean_locations) - pairs.gt_pts[..., :2]).abs()
