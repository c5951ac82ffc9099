"""What costs and losses read: predictions of a layer, ground truth, and the pairs of both."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from mmdet.utils import reduce_mean
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.maptr.decoder import Decoded, MapDecoder
from gsmap.models.maptr.masks import ElementMasks
from gsmap.models.maptr.references import PointReference


class BuiltHead(Protocol):
    """What a cost or a loss may ask of the head that it belongs to, once that is built."""

    classes: tuple[str, ...]
    reference: PointReference
    decoder: MapDecoder
    instance_embedding: nn.Embedding


class Predictions:
    """What the head predicts after one decoder layer, for all samples of a batch.

    Args:
        scores: Class logits. (B, N, classes)
        decoded: What the decoder layer returned: states and references.
        bev_feats: BEV features. (B, C, H, W)
        reference: What ``decoded.references`` stand for.
        masks: The rasters on which predictions and ground truth are compared.

    Attributes:
        references: What the decoder refines: a point, or a Gaussian. (B, N, P, D)
        pts: Points, [0, 1] over the map. (B, N, P, 2 or 3)
    """

    def __init__(
        self,
        scores: Tensor,
        decoded: Decoded,
        bev_feats: Tensor,
        reference: PointReference,
        masks: ElementMasks,
    ) -> None:
        self.scores, self.decoded, self.bev_feats = scores, decoded, bev_feats
        self.reference, self.masks = reference, masks
        self.references = decoded.references
        self.pts = decoded.references[..., : reference.coords]

    @cached_property
    def cost_masks(self) -> Tensor:
        """Rendered masks for matching, without gradient. (B, N, h, w)"""
        return self.reference.render(self.references.detach(), self.masks.cost_grid)

    def of_queries(self, queries: slice) -> "Predictions":
        """Return the predictions of some of the instance queries, scores in float32."""
        scores, decoded = self.scores[:, queries].float(), self.decoded.of_queries(queries)
        return Predictions(scores, decoded, self.bev_feats, self.reference, self.masks)


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
        self.scores, self.pts = batch.scores[index], batch.pts[index]
        self.references = batch.references[index]
        self._batch, self._index = batch, index

    @property
    def cost_masks(self) -> Tensor:
        """Rendered masks, without gradient. (N, h, w)"""
        return self._batch.cost_masks[self._index]


class SampleTruth:
    """One sample's ground truth, as matching costs read it; masks are drawn when first read.

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
    def pipeline_masks(self) -> Tensor:
        """Masks that the pipeline drew; ValueError if it did not. (K, H, W)"""
        if "masks" not in self._instances:
            raise ValueError(
                "a loss needs gt_instances_3d.masks: add MakeInstanceMasks to the training "
                "pipeline, behind FormatMapTargets, or remove the loss from the model."
            )
        return self._instances.masks

    @cached_property
    def cost_masks(self) -> Tensor:
        """Coarser masks, for matching. (K, h, w)"""
        return self._drawing.draw_sample(self._instances, self._drawing.cost_grid)


class GroundTruth:
    """The ground truth of a batch: of each sample, and all of it in one, T elements.

    Args:
        samples: Ground truth of each sample.

    Attributes:
        labels: Class indices. (T,)
        pts_shifts: Equivalent point orders, [0, 1] over the map. (T, S, P, 2 or 3)
        first_pts: Points in the annotated order, [0, 1] over the map. (T, P, 2 or 3)
        first: Number of each sample's first element. (B,)
    """

    def __init__(self, samples: Sequence[SampleTruth]) -> None:
        self.samples = samples
        self.labels = torch.cat([sample.labels for sample in samples])
        self.pts_shifts = torch.cat([sample.pts_shifts for sample in samples])
        self.first_pts = torch.cat([sample.first_pts for sample in samples])
        counts = torch.tensor([len(sample) for sample in samples])
        self.first = (counts.cumsum(0) - counts).to(self.labels.device)

    @cached_property
    def masks(self) -> Tensor:
        """Masks of the losses. (T, H, W)"""
        return torch.cat([sample.masks for sample in self.samples])


class MapMatch(NamedTuple):
    """Matched pairs of one sample, sorted by query. (M,) each"""

    query_inds: Tensor
    gt_inds: Tensor  # the ground truth of each
    order_inds: Tensor  # the closest equivalent point order of that ground truth


class MatchedPairs:
    """The M matched pairs of a batch, sample after sample; what is computed is so when first read.

    Args:
        predictions: Predictions of one layer and query group.
        truths: Ground truth of the batch.
        matches: Matches of each sample.

    Attributes:
        counts: Number of pairs of each sample.
        samples: Number of each pair's sample in the batch. (M,)
        query_inds: Number of each pair's query in its sample. (M,)
        gt_inds: Number of each pair's ground truth in its sample. (M,)
        gt_labels: Class indices. (M,)
        avg_factor: Number of pairs, averaged over the ranks, at least 1. ()
    """

    def __init__(
        self, predictions: Predictions, truths: GroundTruth, matches: Sequence[MapMatch]
    ) -> None:
        self.predictions, self.truths, self.matches = predictions, truths, matches
        queries, gts, orders = zip(*matches, strict=True)
        self.counts = list(map(len, queries))
        self.query_inds, self.gt_inds = torch.cat(queries), torch.cat(gts)
        numbers = torch.arange(len(matches)).repeat_interleave(torch.tensor(self.counts))
        self.samples = numbers.to(self.gt_inds.device)
        self._order_inds = torch.cat(orders)
        self._rows = self.gt_inds + truths.first[self.samples]  # in the batch's ground truth
        self.gt_labels = truths.labels[self._rows]
        count = predictions.scores.new_tensor(float(sum(self.counts)))
        self.avg_factor: Tensor = reduce_mean(count).clamp(min=1.0)

    def of_queries(self, values: Tensor) -> Tensor:
        """Take what belongs to the matched queries. (B, N, ...) -> (M, ...)"""
        return values[self.samples, self.query_inds]

    def of_truths(self, values: Tensor) -> Tensor:
        """Take what belongs to the matched ground truths. (T, ...) -> (M, ...)"""
        return values[self._rows]

    @cached_property
    def pred_references(self) -> Tensor:
        """What the decoder refines: a point, or a Gaussian. (M, P, D)"""
        return self.predictions.references[self.samples, self.query_inds]

    @cached_property
    def pred_pts(self) -> Tensor:
        """Predicted points, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.predictions.pts[self.samples, self.query_inds]

    @cached_property
    def pred_pts_m(self) -> Tensor:
        """Predicted points in metres. (M, P, 2 or 3)"""
        return self.predictions.reference.metres(self.pred_pts)

    @cached_property
    def pred_masks(self) -> Tensor:
        """Masks rendered from the predicted Gaussians. (M, H, W)"""
        reference, masks = self.predictions.reference, self.predictions.masks
        references = masks.held(self.pred_references, self.gt_labels, reference.coords)
        return reference.render(references, masks.grid)

    @cached_property
    def pred_instance_states(self) -> Tensor:
        """States of the matched instances, float32. (M, C)"""
        return self.of_queries(self.predictions.decoded.instance_states).float()

    @cached_property
    def gt_pts(self) -> Tensor:
        """Annotated points in the matched order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.truths.pts_shifts[self._rows, self._order_inds]

    @cached_property
    def gt_first_pts(self) -> Tensor:
        """Annotated points in the annotated order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.truths.first_pts[self._rows]

    @cached_property
    def gt_pts_m(self) -> Tensor:
        """Annotated points in the matched order, in metres. (M, P, 2 or 3)"""
        return self.predictions.reference.metres(self.gt_pts)

    @cached_property
    def gt_masks(self) -> Tensor:
        """Masks drawn of the ground truth. (M, H, W)"""
        masks = self.predictions.masks
        if masks.of_points:
            return masks.draw(self.gt_pts_m, self.gt_labels, masks.grid)
        return self.truths.masks[self._rows]

    def query_labels(self) -> Tensor:
        """Return the class that every query should say, -1 for none. (B, N)"""
        scores = self.predictions.scores
        labels = torch.full(scores.shape[:2], -1, dtype=torch.long, device=scores.device)
        labels[self.samples, self.query_inds] = self.gt_labels
        return labels
