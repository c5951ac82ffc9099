"""MGMap's losses of the masks that activate the queries, and of the segmentation."""

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
    """Cross-entropy and dice loss of the masks that activate the queries (MGMap).

    As in the released code, the cross-entropy is averaged over all queries, with empty targets for
    unmatched queries, and multiplied by the share of matched queries. The dice loss is summed over
    the matched queries and divided by the number of all queries.

    Args:
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss.
        flags: Flags ``last_layer_only`` and ``first_group_only`` of `MapLoss`.
    """

    name = "ins"
    transforms = ("MakeInstanceMasks",)  # step of the data pipeline that makes the masks

    def __init__(self, loss_weight: float = 1.0, dice_weight: float = 2.0, **flags: bool) -> None:
        super().__init__(loss_weight, **flags)
        self.dice_weight = dice_weight

    def check(self, head: BuiltHead) -> None:
        """Check that the head has a mask for each query.

        Raises:
            ValueError: If the decoder has no masks, or not as many as there are queries.
        """
        num_queries = len(head.instance_embedding.weight)
        num_masks = get_decoder(self, head).num_masks
        if num_queries != num_masks:
            raise InputError(
                f"decoder.num_masks is {num_masks}, and there are {num_queries} queries: set both "
                "to one number."
            )

    def reads(self, pairs: MatchedPairs) -> bool:
        """Return True for decoder layers, False for refinement stages, which have no masks."""
        return isinstance(pairs.predictions.decoded, MaskedDecoded)

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Compute the weighted loss of one layer."""
        decoded = cast(MaskedDecoded, pairs.predictions.decoded)
        logits = decoded.mask_logits.float()  # (B, N, H, W)
        matched_logits = pairs.of_queries(logits)  # (M, H, W)
        # Masks of the matched ground truths, in the type of the logits. (M, H, W)
        masks = pairs.of_truths(pairs.truths.pipeline_masks).to(matched_logits)
        check_same_shape(logits=matched_logits, gt_masks=masks)
        targets = torch.zeros_like(logits)
        targets[pairs.samples, pairs.query_inds] = masks
        num_queries = logits.shape[0] * logits.shape[1]
        # Mean over all queries, times M. The division by `num_queries` below gives the share.
        cross_entropy = F.binary_cross_entropy_with_logits(logits, targets) * len(matched_logits)
        dice = dice_loss(matched_logits.sigmoid(), masks, reduction="sum")
        return (self.loss_weight * cross_entropy + self.dice_weight * dice) / num_queries


@MODELS.register_module()
class ForegroundLoss(MapLoss):
    """Cross-entropy and dice loss of the segmentation into elements and background (MGMap).

    Args:
        loss_weight: Weight of the cross-entropy.
        dice_weight: Weight of the dice loss of the two masks, elements and background.
        pos_weight: Weight of the positive cells of a mask in its cross-entropy.
    """

    name = "seg"
    transforms = ("MakeInstanceMasks",)  # step of the data pipeline that makes the masks

    def __init__(
        self, loss_weight: float = 1.0, dice_weight: float = 15.0, pos_weight: float = 4.0
    ) -> None:
        # Only refinement stages, which follow the decoder layers, have a segmentation. All queries
        # share it, so one query group is enough.
        super().__init__(loss_weight, last_layer_only=True, first_group_only=True)
        self.dice_weight = dice_weight
        self.pos_weight = pos_weight

    def check(self, head: BuiltHead) -> None:
        """Check that the head has a segmentation.

        Raises:
            ValueError: If the decoder has no refinement, whose segmentation the loss requires.
        """
        if not len(get_decoder(self, head).refinements):
            raise InputError("ForegroundLoss needs a refinement: set decoder.refinements.")

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Compute the weighted loss of the last refinement stage."""
        decoded = cast(RefinedDecoded, pairs.predictions.decoded)
        logits = decoded.segmentation.float()  # (B, 2, H, W)
        targets = []
        # `truths.counts` has the number of elements of each sample.
        for masks in pairs.truths.pipeline_masks.split(pairs.truths.counts):
            foreground = masks.bool().any(dim=0)  # (H, W)
            targets.append(torch.stack([foreground, ~foreground]))
        target = torch.stack(targets).to(logits)
        check_same_shape(logits=logits, gt_masks=target)
        weight = constant(logits, self.pos_weight)  # tensor on the device, made once
        cross_entropy = F.binary_cross_entropy_with_logits(logits, target, pos_weight=weight)
        dice = dice_loss(logits.sigmoid(), target)
        return self.loss_weight * cross_entropy + self.dice_weight * dice


def get_decoder(loss: MapLoss, head: BuiltHead) -> MGMapDecoder:
    """Return the decoder of a head.

    Raises:
        ValueError: If it is not an `MGMapDecoder`, whose masks the loss requires.
    """
    if not isinstance(head.decoder, MGMapDecoder):
        raise InputError(
            f"{type(loss).__name__} needs the masks of MGMapDecoder, got "
            f"{type(head.decoder).__name__}: leave the loss out, or set decoder.type."
        )
    return head.decoder
