"""What costs and losses read: predictions of a layer, ground truth, and the pairs of both."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from mmdet.utils import reduce_mean
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.maptr.decoder import Decoded
from gsmap.models.maptr.masks import ElementMasks
from gsmap.models.maptr.matching import MapMatch
from gsmap.models.maptr.references import PointReference


@dataclass(eq=False)
class Predictions:
    """What the head predicts after one decoder layer, for all samples of a batch.

    Args:
        scores: Class logits. (B, N, classes)
        decoded: What the decoder layer returned: states and references.
        bev_feats: BEV features. (B, C, H, W)
        reference: What ``decoded.references`` stand for.
        masks: The rasters on which predictions and ground truth are compared.
    """

    scores: Tensor
    decoded: Decoded
    bev_feats: Tensor
    reference: PointReference
    masks: ElementMasks

    @property
    def references(self) -> Tensor:
        """What the decoder refines: a point, or a Gaussian. (B, N, P, D)"""
        return self.decoded.references

    @property
    def pts(self) -> Tensor:
        """Points, [0, 1] over the map. (B, N, P, 2 or 3)"""
        return self.decoded.references[..., : self.reference.coords]

    @cached_property
    def cost_masks(self) -> Tensor:
        """Rendered masks for matching, without gradient. (B, N, h, w)"""
        return self.reference.render(self.references.detach(), self.masks.cost_grid)

    def of_queries(self, queries: slice) -> "Predictions":
        """Return the predictions of some of the instance queries, scores in float32."""
        return replace(
            self,
            scores=self.scores[:, queries].float(),
            decoded=self.decoded.of_queries(queries),
        )

    def samples(self) -> list["SamplePredictions"]:
        """Return the predictions of each sample."""
        return [SamplePredictions(self, index) for index in range(len(self.scores))]


class SamplePredictions:
    """One sample's predictions, as matching costs read them.

    Args:
        batch: The predictions of the batch.
        index: Number of the sample in the batch.

    Attributes:
        scores: Class logits. (N, classes)
        pts: Points, [0, 1] over the map. (N, P, 2 or 3)
        references: What the decoder refines. (N, P, D)
    """

    def __init__(self, batch: Predictions, index: int) -> None:
        self._batch, self._index = batch, index
        self.scores, self.pts = batch.scores[index], batch.pts[index]
        self.references = batch.references[index]

    @property
    def cost_masks(self) -> Tensor:
        """Rendered masks, without gradient. (N, h, w)"""
        return self._batch.cost_masks[self._index]


class GroundTruth:
    """One sample's ground truth, as costs and losses read it; masks are drawn when first read.

    Args:
        instances: ``labels_3d`` (K,), ``pts`` (K, P, 2 or 3) and ``pts_shifts`` (K, S, P, 2 or 3)
            in metres; for masks also ``polylines`` (K, M, 2 or 3) in metres.
        reference: It brings points to [0, 1] over the map.
        masks: How masks are drawn.

    Attributes:
        labels: Class indices. (K,)
        pts_shifts: Equivalent point orders, [0, 1] over the map. (K, S, P, 2 or 3)
        first_pts: Points in the annotated order, [0, 1] over the map. (K, P, 2 or 3)
    """

    def __init__(
        self, instances: InstanceData, reference: PointReference, masks: ElementMasks
    ) -> None:
        self._instances, self._drawing = instances, masks
        self.labels: Tensor = instances.labels_3d
        self.pts_shifts = reference.norm(instances.pts_shifts.float())
        self.first_pts = reference.norm(instances.pts.float())

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def masks(self) -> Tensor:
        """Masks of the losses. (K, H, W)"""
        return self._drawing.draw_sample(self._instances, self._drawing.grid)

    @cached_property
    def cost_masks(self) -> Tensor:
        """Coarser masks, for matching. (K, h, w)"""
        return self._drawing.draw_sample(self._instances, self._drawing.cost_grid)


class MatchedPairs:
    """The M matched pairs of a batch, sample after sample; what is computed is so when first read.

    Args:
        predictions: Predictions of one layer and query group.
        truths: Ground truth of each sample.
        matches: Matches of each sample.

    Attributes:
        counts: Number of pairs of each sample.
        avg_factor: Number of pairs, averaged over the ranks, at least 1. ()
    """

    def __init__(
        self,
        predictions: Predictions,
        truths: Sequence[GroundTruth],
        matches: Sequence[MapMatch],
    ) -> None:
        self.predictions, self.truths, self.matches = predictions, truths, matches
        self.counts = [len(match.gt_inds) for match in matches]
        count = predictions.scores.new_tensor(float(sum(self.counts)))
        self.avg_factor: Tensor = reduce_mean(count).clamp(min=1.0)

    def of_queries(self, values: Tensor) -> Tensor:
        """Take what belongs to the matched queries. (B, N, ...) -> (M, ...)"""
        return values[self.samples, self.query_inds]

    def of_truths(self, values: Iterable[Tensor]) -> Tensor:
        """Take what belongs to the matched ground truths. B x (K, ...) -> (M, ...)"""
        pairs = zip(values, self.matches, strict=True)
        return torch.cat([value[match.gt_inds] for value, match in pairs])

    @cached_property
    def samples(self) -> Tensor:
        """Number of each pair's sample in the batch. (M,)"""
        numbers = torch.arange(len(self.counts)).repeat_interleave(torch.tensor(self.counts))
        return numbers.to(self.predictions.scores.device)

    @cached_property
    def query_inds(self) -> Tensor:
        """Number of each pair's query in its sample. (M,)"""
        return torch.cat([match.query_inds for match in self.matches])

    @cached_property
    def gt_inds(self) -> Tensor:
        """Number of each pair's ground truth in its sample. (M,)"""
        return torch.cat([match.gt_inds for match in self.matches])

    @cached_property
    def pred_references(self) -> Tensor:
        """What the decoder refines: a point, or a Gaussian. (M, P, D)"""
        return self.of_queries(self.predictions.references)

    @cached_property
    def pred_pts(self) -> Tensor:
        """Predicted points, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.of_queries(self.predictions.pts)

    @cached_property
    def pred_pts_m(self) -> Tensor:
        """Predicted points in metres. (M, P, 2 or 3)"""
        return self.predictions.reference.metres(self.pred_pts)

    @cached_property
    def pred_masks(self) -> Tensor:
        """Masks rendered from the predicted Gaussians. (M, H, W)"""
        return self.predictions.reference.render(self.pred_references, self.predictions.masks.grid)

    @cached_property
    def pred_instance_states(self) -> Tensor:
        """States of the matched instances, float32. (M, C)"""
        return self.of_queries(self.predictions.decoded.instance_states).float()

    @cached_property
    def gt_labels(self) -> Tensor:
        """Class indices. (M,)"""
        return self.of_truths(gt.labels for gt in self.truths)

    @cached_property
    def gt_pts(self) -> Tensor:
        """Annotated points in the matched order, [0, 1] over the map. (M, P, 2 or 3)"""
        pairs = zip(self.truths, self.matches, strict=True)
        return torch.cat([gt.pts_shifts[match.gt_inds, match.order_inds] for gt, match in pairs])

    @cached_property
    def gt_first_pts(self) -> Tensor:
        """Annotated points in the annotated order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.of_truths(gt.first_pts for gt in self.truths)

    @cached_property
    def gt_pts_m(self) -> Tensor:
        """Annotated points in the matched order, in metres. (M, P, 2 or 3)"""
        return self.predictions.reference.metres(self.gt_pts)

    @cached_property
    def gt_masks(self) -> Tensor:
        """Masks drawn of the ground truth. (M, H, W)"""
        masks = self.predictions.masks
        if masks.source == "points":
            return masks.draw(self.gt_pts_m, self.gt_labels, masks.grid)
        return self.of_truths(gt.masks for gt in self.truths)

    @property
    def bev_feats(self) -> Tensor:
        """BEV features of the batch. (B, C, H, W)"""
        return self.predictions.bev_feats

    def query_scores(self) -> Tensor:
        """Return the class logits of every query, matched or not. (B * N, classes)"""
        return self.predictions.scores.flatten(0, 1)

    def query_labels(self) -> Tensor:
        """Return the class that every query should say, -1 for none. (B * N,)"""
        scores = self.predictions.scores
        labels = torch.full(scores.shape[:2], -1, dtype=torch.long, device=scores.device)
        labels[self.samples, self.query_inds] = self.gt_labels
        return labels.flatten()
