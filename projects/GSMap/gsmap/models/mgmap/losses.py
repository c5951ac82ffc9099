"""MGMap's losses: of the masks that activate the queries, and of the segmentation."""

from typing import cast

import torch
import torch.nn.functional as F
from mmdet.models.losses.dice_loss import dice_loss
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.mgmap.decoder import MaskedDecoded, MGMapDecoder, RefinedDecoded
from gsmap.structures.tensors import check_same_shape, constant
from gsmap.utils.errors import InputError


@MODELS.register_module()
class QueryMaskLoss(MapLoss):
    """The masks that activate the queries, against those of the matched ground truth (MGMap).

    As released, the cross-entropy is a mean over all queries, of which those without a match should
    be empty, times the share of matched ones; dice counts the matched ones over all.

    Args:
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss.
        flags: As in `MapLoss`.
    """

    name = "ins"
    transforms = ("MakeInstanceMasks",)

    def __init__(self, loss_weight: float = 1.0, dice_weight: float = 2.0, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)
        self.dice_weight = dice_weight

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if there are other queries than masks, or none of both."""
        queries, masks = len(head.instance_embedding.weight), decoder_of(self, head).num_masks
        if queries != masks:
            raise InputError(f"decoder.num_masks is {masks}, and there are {queries} queries.")

    def reads(self, pairs: MatchedPairs) -> bool:
        """Return whether it is a decoder layer: the refinement has no masks of its own."""
        return isinstance(pairs.predictions.decoded, MaskedDecoded)

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Return the weighted loss."""
        logits = cast(MaskedDecoded, pairs.predictions.decoded).mask_logits.float()
        own = pairs.of_queries(logits)  # (M, H, W)
        masks = pairs.of_truths(pairs.truths.pipeline_masks).to(own)
        check_same_shape(logits=own, gt_masks=masks)
        targets = torch.zeros_like(logits)
        targets[pairs.samples, pairs.query_inds] = masks
        queries = logits.shape[0] * logits.shape[1]
        cross_entropy = F.binary_cross_entropy_with_logits(logits, targets) * len(own)
        dice = dice_loss(own.sigmoid(), masks, reduction="sum")
        return (self.loss_weight * cross_entropy + self.dice_weight * dice) / queries


@MODELS.register_module()
class ForegroundLoss(MapLoss):
    """The segmentation of a sample into elements and background (MGMap).

    Args:
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss of both masks together.
        pos_weight: Weight of the cells of a mask in its cross-entropy.
    """

    name = "seg"
    transforms = ("MakeInstanceMasks",)

    def __init__(
        self, loss_weight: float = 1.0, dice_weight: float = 15.0, pos_weight: float = 4.0
    ) -> None:
        super().__init__(loss_weight, last_layer_only=True, first_group_only=True)
        self.dice_weight, self.pos_weight = dice_weight, pos_weight

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if there is no segmentation."""
        if not len(decoder_of(self, head).refinements):
            raise InputError("ForegroundLoss needs a refinement: set decoder.refinements.")

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Return the weighted loss."""
        logits = cast(RefinedDecoded, pairs.predictions.decoded).segmentation.float()
        truths = pairs.truths
        drawn = [own.bool().any(0) for own in truths.pipeline_masks.split(truths.counts)]
        targets = torch.stack([torch.stack([own, ~own]) for own in drawn]).to(logits)
        check_same_shape(logits=logits, gt_masks=targets)  # (B, 2, H, W)
        weight = constant(logits, self.pos_weight)
        cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, pos_weight=weight)
        dice = dice_loss(logits.sigmoid(), targets)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


def decoder_of(loss: MapLoss, head: BuiltHead) -> MGMapDecoder:
    """Return the head's decoder; ValueError if it has no masks for the loss."""
    if not isinstance(head.decoder, MGMapDecoder):
        raise InputError(
            f"{type(loss).__name__} needs the masks of MGMapDecoder, got "
            f"{type(head.decoder).__name__}: leave the loss out, or set decoder.type."
        )
    return head.decoder
