"""Class losses whose targets are the quality of the predicted geometry (DAMap, ICCV 2025)."""

from collections.abc import Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import PartConfig, check_classes
from gsmap.structures.tensors import constant


class ClassLoss(nn.Module):
    """Base class of classification losses that depend on matched pairs.

    A matched pair is a query and its ground truth. There are M pairs in all L decoder layers
    together, and N queries in each layer.
    """

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a head lacks an input of the loss. Called when the head is built."""

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Weighted loss of every logit. (B, L * N, classes)

        Args:
            pairs: Matched pairs of all L layers.
        """
        raise NotImplementedError


class Quality(nn.Module):
    """Base class of qualities of matched predictions, the targets of their class scores."""

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a head lacks an input of the quality. Called when it is built."""

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Quality of each matched pair, 0 to 1, without gradient. (M,)"""
        raise NotImplementedError


@MODELS.register_module()
class DistanceQuality(Quality):
    r"""Quality by the distance of points: :math:`\exp(-s \sum_c \overline{|p_c - t_c|})`.

    The mean is over the points of an element, and the sum is over the coordinates c. Predictions p
    and targets t are in [0, 1] over the map (DAMap).

    Args:
        scale: Factor s of the distance. DAMap takes the weight of its points loss, 5.
    """

    def __init__(self, scale: float = 5.0) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Quality of each matched pair. (M,)"""
        # `gt_pts` are in the point order that the matching has chosen. (M, P, 2 or 3)
        distances = (pairs.pred_pts.detach() - pairs.gt_pts).abs().mean(1).sum(-1)
        return (-self.scale * distances).exp()


@MODELS.register_module()
class QualityClassLoss(ClassLoss):
    r"""Quality focal loss for all decoder layers but the first, which has a plain loss (DAMap).

    With score s and quality q, the loss of the class of a matched ground truth is
    :math:`|q - s|^\beta \mathrm{BCE}(s, q)`, and of every other class and query
    :math:`s^\beta \mathrm{BCE}(s, 0)`. The first layer has a plain loss because its points are far
    from the ground truth, so that every quality would be close to 0.

    Args:
        quality: Config of a `Quality`.
        first_layer: Config of the loss of the first layer, on logits and one-hot targets.
        beta: Exponent of the distance between score and target.
        loss_weight: Weight of the loss.
        classes: Indices of the classes whose target is the quality. The target of other classes is
            1 for matched pairs. None means all classes.

    Raises:
        ValueError: If the head lacks a class or an input of the quality.
    """

    def __init__(
        self,
        quality: PartConfig,
        first_layer: PartConfig,
        beta: float = 2.0,
        loss_weight: float = 2.0,
        classes: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.quality = cast(Quality, MODELS.build(quality))
        self.first_layer = MODELS.build(first_layer)
        self.beta = beta
        self.loss_weight = loss_weight
        self.classes = classes

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head lacks a class or an input of the quality."""
        # Without a selection of classes, there is no index to check.
        check_classes("loss_cls.classes", self.classes or (), head.classes)
        self.quality.check(head)

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Weighted loss of every logit. (B, L * N, classes)

        Args:
            pairs: Matched pairs of all L layers.
        """
        scores = pairs.predictions.scores
        targets = self.targets(pairs)
        # The queries of all layers are concatenated, beginning with the first layer.
        num_queries = scores.shape[1] // pairs.num_layers
        # Class of the ground truth of each query, -1 without a match.
        first_labels = pairs.query_labels()[:, :num_queries]
        first_losses = plain_class_loss(
            self.first_layer, scores=scores[:, :num_queries], labels=first_labels
        )
        later_scores = scores[:, num_queries:]
        later_targets = targets[:, num_queries:]
        entropies = F.binary_cross_entropy_with_logits(
            later_scores, later_targets, reduction="none"
        )
        distances = (later_targets - later_scores.sigmoid()).abs()
        later_losses = self.loss_weight * (distances.pow(self.beta) * entropies)
        return torch.cat([first_losses, later_losses], dim=1)

    def targets(self, pairs: MatchedPairs) -> Tensor:
        """Targets of the scores, without gradient. (B, L * N, classes)"""
        scores = pairs.predictions.scores
        targets = torch.zeros_like(scores)
        quality = self.quality(pairs).detach().to(targets)
        if self.classes is not None:
            is_selected = [index in self.classes for index in range(scores.shape[-1])]
            # Table by class index. `constant` uploads it to the device once.
            has_quality = constant(pairs.gt_labels, is_selected, torch.bool)
            quality = torch.where(has_quality[pairs.gt_labels], quality, 1.0)
        targets[pairs.samples, pairs.query_inds, pairs.gt_labels] = quality
        return targets


def plain_class_loss(loss: Any, scores: Tensor, labels: Tensor) -> Tensor:
    """Compute a classification loss of mmdet without reduction.

    Args:
        loss: Loss module with logits and one-hot targets as inputs.
        scores: Class logits. (B, N, classes)
        labels: Class index of each query, -1 for no class. (B, N)

    Returns:
        Weighted loss of every logit. (B, N, classes)
    """
    # With one-hot targets, mmdet's focal loss does not need its compiled op. The shift by 1 gives
    # queries without a class (label -1) the column 0, which is then removed.
    one_hot = F.one_hot(labels + 1, scores.shape[-1] + 1)[..., 1:]
    values = loss(scores.flatten(0, 1), one_hot.flatten(0, 1), reduction_override="none")
    return values.view_as(scores)
