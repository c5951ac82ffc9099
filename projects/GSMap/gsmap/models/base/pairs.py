"""What costs and losses read: predictions of all layers, ground truth, and the pairs of both."""

from collections.abc import Sequence
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple, Protocol

import torch
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, JoinedDecoded, MapDecoder
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.references import RefinedReference
from gsmap.utils.errors import InputError


class BuiltHead(Protocol):
    """What a cost or a loss may ask of the head that it belongs to, once that is built."""

    classes: tuple[str, ...]
    reference: RefinedReference
    decoder: MapDecoder
    instance_embedding: nn.Embedding


class Predictions:
    """What the head predicts after one decoder layer, or after several, for a batch.

    Several layers count as further queries: N is L * N then, layer after layer (`joined`).

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
        reference: RefinedReference,
        masks: ElementMasks,
    ) -> None:
        self.scores, self.decoded, self.bev_feats = scores, decoded, bev_feats
        self.reference, self.masks = reference, masks
        self.references = decoded.references
        self.pts = decoded.references[..., : reference.coords]
        self._layers: Sequence[Predictions] = ()

    @property
    def layers(self) -> Sequence["Predictions"]:
        """The predictions of each layer, L of them."""
        return self._layers or [self]

    @classmethod
    def join(cls, layers: Sequence["Predictions"]) -> "Predictions":
        """Return the predictions of several layers as one."""
        if len(layers) == 1:
            return layers[0]
        last = layers[-1]
        scores = torch.cat([layer.scores for layer in layers], 1)
        decoded = JoinedDecoded([layer.decoded for layer in layers])
        all_layers = cls(scores, decoded, last.bev_feats, last.reference, last.masks)
        all_layers._layers = layers
        return all_layers

    @cached_property
    def cost_masks(self) -> Tensor:
        """Rendered masks for matching, without gradient. (B, N, h, w)"""
        return self.reference.render(self.references.detach(), self.masks.cost_grid)

    def of_queries(self, queries: slice) -> "Predictions":
        """Return the predictions of some of the instance queries, scores in float32."""
        scores, decoded = self.scores[:, queries].float(), self.decoded.of_queries(queries)
        return Predictions(scores, decoded, self.bev_feats, self.reference, self.masks)

    def sample(self, index: int) -> "SampleView":
        """Return the predictions of one sample, as matching costs read them."""
        return SampleView(self, index)


class GroundTruth:
    """The ground truth of a batch, T elements, sample after sample; masks are drawn when read.

    Args:
        instances: Of each sample ``labels_3d`` (K,), ``pts`` (K, P, 2 or 3) and ``pts_shifts``
            (K, S, P, 2 or 3) in metres; for masks also ``polylines`` (K, M, 2 or 3) in metres.
        reference: It brings points to [0, 1] over the map.
        masks: How masks are drawn.

    Attributes:
        counts: Number K of elements of each sample.
        first: Number of each sample's first element.
        labels: Class indices. (T,)
        pts_shifts: Equivalent point orders, [0, 1] over the map. (T, S, P, 2 or 3)
    """

    def __init__(
        self, instances: Sequence[InstanceData], reference: RefinedReference, masks: ElementMasks
    ) -> None:
        self._instances, self._reference, self._drawing = instances, reference, masks
        self.counts = [len(sample.labels_3d) for sample in instances]
        self.first = list(accumulate(self.counts, initial=0))[:-1]
        self.labels = torch.cat([sample.labels_3d for sample in instances])
        shifts = torch.cat([sample.pts_shifts for sample in instances])
        self.pts_shifts = reference.norm(shifts.float())

    @cached_property
    def first_pts(self) -> Tensor:
        """Points in the annotated order, [0, 1] over the map. (T, P, 2 or 3)"""
        return self._reference.norm(torch.cat([own.pts for own in self._instances]).float())

    @cached_property
    def masks(self) -> Tensor:
        """Masks of the losses. (T, H, W)"""
        return self._drawing.draw_batch(self._instances, self._drawing.grid)

    @cached_property
    def cost_masks(self) -> Tensor:
        """Coarser masks, for matching. (T, h, w)"""
        return self._drawing.draw_batch(self._instances, self._drawing.cost_grid)

    @cached_property
    def pipeline_masks(self) -> Tensor:
        """Masks that the pipeline drew; ValueError if it did not. (T, H, W)"""
        if any("masks" not in sample for sample in self._instances):
            raise InputError(
                "a loss needs gt_instances_3d.masks: add MakeInstanceMasks to the training "
                "pipeline, behind FormatMapTargets, or remove the loss from the model."
            )
        return torch.cat([sample.masks for sample in self._instances])

    def sample(self, index: int) -> "SampleView":
        """Return the ground truth of one sample, as matching costs read it."""
        start = self.first[index]
        return SampleView(self, slice(start, start + self.counts[index]))


class SampleView:
    """One sample's part of predictions or ground truth, as matching costs read it.

    Its attributes are those of the batch, without the other samples. Of predictions: ``scores``
    (N, classes), ``pts`` (N, P, 2 or 3), ``references`` (N, P, D) and ``cost_masks`` (N, h, w). Of
    ground truth: ``labels`` (K,), ``first_pts`` (K, P, 2 or 3), ``pts_shifts`` (K, S, P, 2 or 3)
    and ``cost_masks`` (K, h, w).

    Args:
        batch: Predictions or ground truth of the batch.
        rows: Where the sample's are.
    """

    def __init__(self, batch: Predictions | GroundTruth, rows: int | slice) -> None:
        self._batch, self._rows = batch, rows

    def __getattr__(self, name: str) -> Tensor:
        values: Tensor = getattr(self._batch, name)[self._rows]
        return values


class MapMatches(NamedTuple):
    """The matched pairs of L layers; a layer has as many as any other, M. (L, M) each

    They are sorted by sample and query.
    """

    samples: Tensor  # number of the sample in the batch
    query_inds: Tensor  # number of the query in its layer
    joined_inds: Tensor  # number of the query among those of all layers
    gt_inds: Tensor  # number of the ground truth in its sample
    rows: Tensor  # number of the ground truth in the batch
    order_inds: Tensor  # the closest equivalent point order of that ground truth
    host_labels: Tensor  # class of the ground truth, on the host


class MatchedPairs:
    """Matched pairs of a batch, of one layer or of several, layer after layer: M in all.

    A layer's are sorted by sample and query, and as many as any other's. Their attributes are
    computed when they are first read.

    Args:
        predictions: Predictions of the layers, of one query group.
        truths: Ground truth of the batch.
        matches: What is matched.
        counts: Number of pairs of each sample, in one layer.
        avg_factor: Number of pairs of a layer, averaged over the ranks, at least 1. ()

    Attributes:
        num_layers: Number L of layers.
        counts: Number of pairs of each sample, in every layer: (L * B,) integers.
        samples: Number of each pair's sample in the batch. (M,)
        query_inds: Number of each pair's query among the sample's of all layers. (M,)
        gt_inds: Number of each pair's ground truth in its sample. (M,)
        order_inds: Number of its point order. (M,)
        host_labels: Class indices, on the host. (M,)
    """

    def __init__(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        matches: MapMatches,
        counts: Sequence[int],
        avg_factor: Tensor,
    ) -> None:
        self.predictions, self.truths, self.avg_factor = predictions, truths, avg_factor
        self.num_layers = len(predictions.layers)
        self.counts = list(counts) * self.num_layers
        self.samples = matches.samples.flatten()
        self.query_inds, self.gt_inds = matches.joined_inds.flatten(), matches.gt_inds.flatten()
        self.order_inds, self._rows = matches.order_inds.flatten(), matches.rows.flatten()
        self.host_labels = matches.host_labels.flatten()
        self._matches, self._by_layer = matches, dict[int, MatchedPairs]()

    def layer(self, number: int) -> "MatchedPairs":
        """Return the pairs of one layer, with what is computed of them already."""
        if self.num_layers == 1:
            return self
        number %= self.num_layers
        if number not in self._by_layer:
            matches = MapMatches(*(values[number, None] for values in self._matches))
            self._by_layer[number] = MatchedPairs(
                self.predictions.layers[number],
                self.truths,
                matches._replace(joined_inds=matches.query_inds),
                self.counts[: len(self.counts) // self.num_layers],
                self.avg_factor,
            )
        own = vars(self._by_layer[number])
        for name, values in vars(self).items():
            if isinstance(getattr(type(self), name, None), cached_property):
                own.setdefault(name, self.by_layer(values)[number])
        return self._by_layer[number]

    def by_layer(self, values: Tensor) -> Tensor:
        """Sort values of the pairs by layer. (M, ...) -> (L, M / L, ...)"""
        return values.unflatten(0, self._matches.rows.shape)

    def of_queries(self, values: Tensor) -> Tensor:
        """Take what belongs to the matched queries. (B, N, ...) -> (M, ...)"""
        return values[self.samples, self.query_inds]

    def of_truths(self, values: Tensor) -> Tensor:
        """Take what belongs to the matched ground truths. (T, ...) -> (M, ...)"""
        return values[self._rows]

    @cached_property
    def gt_labels(self) -> Tensor:
        """Class indices. (M,)"""
        return self.of_truths(self.truths.labels)

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
        reference, masks = self.predictions.reference, self.predictions.masks
        references = masks.rendered_references(
            self.pred_references, self.gt_labels, reference.coords
        )
        return reference.render(references, masks.grid)

    @cached_property
    def pred_instance_states(self) -> Tensor:
        """States of the matched instances, float32. (M, C)"""
        return self.of_queries(self.predictions.decoded.instance_states).float()

    @cached_property
    def gt_pts(self) -> Tensor:
        """Annotated points in the matched order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.truths.pts_shifts[self._rows, self.order_inds]

    @cached_property
    def gt_first_pts(self) -> Tensor:
        """Annotated points in the annotated order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.of_truths(self.truths.first_pts)

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
        return self.of_truths(self.truths.masks)

    def query_labels(self) -> Tensor:
        """Return the class that every query should say, -1 for none. (B, N)"""
        scores = self.predictions.scores
        labels = torch.full(scores.shape[:2], -1, dtype=torch.long, device=scores.device)
        labels[self.samples, self.query_inds] = self.gt_labels
        return labels
