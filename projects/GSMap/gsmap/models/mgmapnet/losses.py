"""MGMapNet's losses of sampling locations and of instance masks."""

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

PAIRINGS = ("matched", "released")  # values of ``pairing`` of `InstanceMaskLoss`


def instance_mask_losses(
    logits: Tensor, targets: Tensor, avg_factor: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the cross-entropy and the dice loss of the masks of matched instances.

    Args:
        logits: Logits of the masks. (M, H, W)
        targets: Target masks in [0, 1], of any type. (M, H, W)
        avg_factor: Divisor of the sum over the instances: the number of matches, averaged over the
            ranks, at least 1.

    Returns:
        Cross-entropy, averaged over the cells of an instance, and dice loss; 0 without matches.

    Raises:
        ValueError: If the shapes differ.
    """
    check_same_shape(logits=logits, targets=targets)
    logits = logits.float()
    targets = targets.float()
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    dice = dice_loss(logits.sigmoid(), targets)
    mask_cross_entropy = cross_entropy.mean(dim=(1, 2))  # (M,)
    return mask_cross_entropy.sum() / avg_factor, dice.sum() / avg_factor


@MODELS.register_module()
class InstanceMaskLoss(MapLoss):
    """Loss of instance masks, the products of instance states and BEV features (MGMapNet).

    Args:
        embed_dims: Channels C of the states and of the BEV features.
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss.
        pairing: ``"matched"`` compares each query with the mask of its ground truth.
            ``"released"`` compares the i-th matched query with the i-th ground truth, as in the
            released code. This is correct only if the matched ground truths happen to be sorted.
        last_layer_only: Whether the loss is computed for the last decoder layer only.
        first_group_only: Whether the loss is computed for the first query group only.

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
        super().__init__(
            loss_weight, last_layer_only=last_layer_only, first_group_only=first_group_only
        )
        if pairing not in PAIRINGS:
            raise InputError(f"pairing must be one of {PAIRINGS}, got {pairing!r}.")
        self.embedding = mlp(embed_dims, embed_dims, embed_dims, embed_dims)
        self.dice_weight = dice_weight
        self.pairing = pairing

    def logits(self, states: Tensor, bev_feats: Tensor) -> Tensor:
        """Compute the mask logits of one sample's instances. (n, C), (C, H, W) -> (n, H, W)"""
        return torch.einsum("nc,chw->nhw", self.embedding(states), bev_feats.to(states))

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Compute the weighted loss of masks at the resolution of the BEV features."""
        # The M pairs are sorted by sample. `counts` is the number of pairs of each sample.
        sample_states = pairs.pred_instance_states.split(pairs.counts)
        sample_logits = []
        for states, feats in zip(sample_states, pairs.predictions.bev_feats, strict=True):
            sample_logits.append(self.logits(states, feats))
        logits = torch.cat(sample_logits)  # (M, H, W)
        masks = pairs.gt_masks.to(logits)  # the mask of the ground truth of each pair
        if self.pairing == "released":
            sample_masks = masks.split(pairs.counts)
            sample_indices = pairs.gt_inds.split(pairs.counts)  # of the ground truth in its sample
            sorted_masks = []
            for matched_masks, indices in zip(sample_masks, sample_indices, strict=True):
                # Masks in the order of the ground truth, while queries keep their order.
                sorted_masks.append(matched_masks[indices.argsort()])
            masks = torch.cat(sorted_masks)
        if masks.shape != logits.shape and len(masks):
            masks = F.interpolate(masks[:, None], size=logits.shape[-2:], mode="area")[:, 0]
        # Without a match, `masks` is empty and was not resized.
        masks = masks.reshape(logits.shape)
        cross_entropy, dice = instance_mask_losses(logits, masks, avg_factor=pairs.avg_factor)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


@MODELS.register_module()
class SamplingLocationLoss(MapLoss):
    """L1 distance between the mean sampling location of a point and its target (MGMapNet).

    Args:
        loss_weight: Weight of the loss.
        flags: Flags of `MapLoss`, ``last_layer_only`` and ``first_group_only``.
    """

    name = "mean_loc"

    def __init__(self, loss_weight: float = 5.0, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)

    def check(self, head: BuiltHead) -> None:
        """Check that the head has sampling locations.

        Raises:
            ValueError: If the decoder is not an `MGMapNetDecoder`.
        """
        if not isinstance(head.decoder, MGMapNetDecoder):
            raise InputError(
                "SamplingLocationLoss needs the sampling locations of MGMapNetDecoder, got "
                f"{type(head.decoder).__name__}: leave the loss out, or take MGMapHead."
            )

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Compute the distance of x and y, [0, 1] over the map. (M, P, 2)"""
        decoded = cast(MGMapNetDecoded, pairs.predictions.decoded)
        locations = pairs.of_queries(decoded.mean_locations)  # (M, P, 2)
        return (locations - pairs.gt_pts[..., :2]).abs()
