"""Inputs of costs and losses: predictions of all layers, ground truth, and matched pairs."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.decoder import Decoded, JoinedDecoded, MapDecoder
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.references import RefinedReference
from gsmap.utils.errors import InputError


class BuiltHead(Protocol):
    """Attributes of a built head that the checks of costs and losses may use."""

    classes: tuple[str, ...]
    reference: RefinedReference
    decoder: MapDecoder
    instance_embedding: nn.Embedding


class Predictions:
    """Predictions of the head after one or several decoder layers, for a batch.

    `join` concatenates the predictions of L layers along the queries. N is then the number of
    queries of all layers together.

    Args:
        scores: Class logits. (B, N, classes)
        decoded: Output of the decoder layer, with states and references.
        bev_feats: BEV features. (B, C, H, W)
        reference: Module that converts ``decoded.references`` to points and masks, and normalised
            points to metres.
        masks: Settings and rasters of the masks in losses and in matching costs.

    Attributes:
        references: References of points or Gaussians. (B, N, P, D)
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
        self.scores = scores
        self.decoded = decoded
        self.bev_feats = bev_feats
        self.reference = reference
        self.masks = masks
        self.references = decoded.references
        self.pts = decoded.references[..., : reference.coords]
        self._layers: Sequence[Predictions] = ()  # empty unless joined

    @property
    def layers(self) -> Sequence["Predictions"]:
        """Predictions of each of the L layers; only the object itself if it is of one layer."""
        return self._layers or [self]

    @classmethod
    def join(cls, layers: Sequence["Predictions"]) -> "Predictions":
        """Concatenate the predictions of several layers along the queries."""
        if len(layers) == 1:
            return layers[0]
        last = layers[-1]  # BEV features, reference and masks are equal in all layers
        scores = torch.cat([layer.scores for layer in layers], dim=1)
        decoded = JoinedDecoded([layer.decoded for layer in layers])
        all_layers = cls(
            scores=scores,
            decoded=decoded,
            bev_feats=last.bev_feats,
            reference=last.reference,
            masks=last.masks,
        )
        all_layers._layers = layers
        return all_layers

    @cached_property
    def cost_masks(self) -> Tensor:
        """Masks for matching costs, rendered without gradient. (B, N, h, w)"""
        return self.reference.render(self.references.detach(), self.masks.cost_grid)

    def of_queries(self, queries: slice) -> "Predictions":
        """Predictions of some instance queries, such as one group, with scores in float32."""
        return Predictions(
            scores=self.scores[:, queries].float(),
            decoded=self.decoded.of_queries(queries),
            bev_feats=self.bev_feats,
            reference=self.reference,
            masks=self.masks,
        )

    def sample(self, index: int) -> "SampleView":
        """Predictions of one sample, by its index in the batch, for matching costs."""
        return SampleView(self, index)


class GroundTruth:
    """Ground truth of a batch: T elements, sample after sample.

    Masks are drawn on first access and cached.

    Args:
        instances: Elements of each sample, with ``labels_3d`` (K,), ``pts`` (K, P, 2 or 3) and
            ``pts_shifts`` (K, S, P, 2 or 3) in metres, which are the points in S equivalent
            orders. Masks also need ``polylines`` (K, M, 2 or 3) in metres.
        reference: Module that normalises points to [0, 1] over the map.
        masks: Object that draws the masks.

    Attributes:
        counts: Number K of elements of each sample.
        first: Index of the first element of each sample among the T elements.
        labels: Class indices. (T,)
        pts_shifts: Points in all equivalent orders, [0, 1] over the map. (T, S, P, 2 or 3)
    """

    def __init__(
        self, instances: Sequence[InstanceData], reference: RefinedReference, masks: ElementMasks
    ) -> None:
        self._instances = instances
        self._reference = reference
        self._element_masks = masks
        self.counts: list[int] = []
        self.first: list[int] = []
        labels = []
        pts_shifts_m = []
        for sample in instances:
            self.first.append(sum(self.counts))
            self.counts.append(len(sample.labels_3d))
            labels.append(sample.labels_3d)
            pts_shifts_m.append(sample.pts_shifts)
        self.labels = torch.cat(labels)
        self.pts_shifts = reference.norm(torch.cat(pts_shifts_m).float())

    @cached_property
    def first_pts(self) -> Tensor:
        """Points in the annotated order, [0, 1] over the map. (T, P, 2 or 3)"""
        points_m = torch.cat([sample.pts for sample in self._instances])
        return self._reference.norm(points_m.float())

    @cached_property
    def masks(self) -> Tensor:
        """Masks for losses. (T, H, W)"""
        return self._element_masks.draw_batch(self._instances, self._element_masks.grid)

    @cached_property
    def cost_masks(self) -> Tensor:
        """Masks for matching costs, at a lower resolution. (T, h, w)"""
        return self._element_masks.draw_batch(self._instances, self._element_masks.cost_grid)

    @cached_property
    def pipeline_masks(self) -> Tensor:
        """Masks from the data pipeline. (T, H, W)

        Raises:
            ValueError: If the pipeline does not make masks.
        """
        masks = []
        for sample in self._instances:
            if "masks" not in sample:
                raise InputError(
                    "a loss needs gt_instances_3d.masks: add MakeInstanceMasks to the training "
                    "pipeline, behind FormatMapTargets, or remove the loss from the model."
                )
            masks.append(sample.masks)
        return torch.cat(masks)

    def sample(self, index: int) -> "SampleView":
        """Ground truth of one sample, by its index in the batch, for matching costs."""
        start = self.first[index]
        return SampleView(self, slice(start, start + self.counts[index]))


class SampleView:
    """View of the predictions or the ground truth of one sample, for matching costs.

    Reading an attribute selects the sample from that attribute of the batch. Predictions have
    ``scores`` (N, classes), ``pts`` (N, P, 2 or 3), ``references`` (N, P, D) and ``cost_masks``
    (N, h, w). Ground truth has ``labels`` (K,), ``first_pts`` (K, P, 2 or 3), ``pts_shifts``
    (K, S, P, 2 or 3) and ``cost_masks`` (K, h, w).

    Args:
        batch: Predictions or ground truth of the batch.
        rows: Index of the sample, or slice of its elements.
    """

    def __init__(self, batch: Predictions | GroundTruth, rows: int | slice) -> None:
        self._batch = batch
        self._rows = rows

    def __getattr__(self, name: str) -> Tensor:
        # Python calls this method for attributes that the view does not have.
        values: Tensor = getattr(self._batch, name)[self._rows]
        return values


class MapMatches(NamedTuple):
    """Indices of the matched pairs of L layers, each with M pairs sorted by sample and query.

    All layers have equally many queries and ground truths, and therefore equally many pairs.

    Attributes:
        samples: Index of the sample in the batch. (L, M)
        query_inds: Index of the query in its layer. (L, M)
        joined_inds: Index of the query among the queries of all layers. (L, M)
        gt_inds: Index of the ground truth in its sample. (L, M)
        rows: Index of the ground truth among all T elements of the batch. (L, M)
        order_inds: Index of the closest equivalent point order of the ground truth. (L, M)
        host_labels: Class index of the ground truth, kept on the CPU, where reading it does not
            wait for the GPU. (L, M)
        counts: Number of pairs of each sample, in one layer: B integers.
    """

    samples: Tensor
    query_inds: Tensor
    joined_inds: Tensor
    gt_inds: Tensor
    rows: Tensor
    order_inds: Tensor
    host_labels: Tensor
    counts: list[int]


class MatchedPairs:
    """Matched pairs of a batch: M pairs in total, concatenated from L layers.

    Each layer has M / L pairs, sorted by sample and query. (In `MapMatches`, M is the number of
    pairs of one layer.) Properties are computed on first access and cached.

    Args:
        predictions: Predictions of the layers, of one query group.
        truths: Ground truth of the batch.
        matches: Indices of the pairs.
        avg_factor: Divisor of losses: the number of pairs of one layer, averaged over the ranks,
            at least 1. ()

    Attributes:
        num_layers: Number L of layers.
        counts: Number of pairs of each sample, in every layer: L * B integers.
        samples: Index of the sample in the batch. (M,)
        query_inds: Index of the query among the queries of all layers. (M,)
        gt_inds: Index of the ground truth in its sample. (M,)
        order_inds: Index of the point order of the ground truth. (M,)
        host_labels: Class indices, on the CPU. (M,)
    """

    def __init__(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        matches: MapMatches,
        avg_factor: Tensor,
    ) -> None:
        self.predictions = predictions
        self.truths = truths
        self.avg_factor = avg_factor
        self.num_layers = len(predictions.layers)
        self.counts = matches.counts * self.num_layers  # the list, once for each layer
        self.samples = matches.samples.flatten()
        self.query_inds = matches.joined_inds.flatten()
        self.gt_inds = matches.gt_inds.flatten()
        self.order_inds = matches.order_inds.flatten()
        self.host_labels = matches.host_labels.flatten()
        self._rows = matches.rows.flatten()
        self._matches = matches
        self._layer_pairs: dict[int, MatchedPairs] = {}

    def layer(self, number: int) -> "MatchedPairs":
        """Pairs of one layer.

        Cached properties of all pairs are reused and not computed again. Repeated calls return one
        object for each layer.

        Args:
            number: Index of the layer. Negative indices count from the last layer.
        """
        if self.num_layers == 1:
            return self
        number %= self.num_layers  # -1 becomes the index of the last layer
        if number not in self._layer_pairs:
            self._layer_pairs[number] = self._select_layer(number)
        layer_pairs = self._layer_pairs[number]
        # `cached_property` stores a computed value in `vars` under its name. Writing the part of
        # the layer to `vars(layer_pairs)` fills the cache of the layer.
        for name, values in vars(self).items():
            is_property = isinstance(getattr(type(self), name, None), cached_property)
            if is_property and name not in vars(layer_pairs):
                vars(layer_pairs)[name] = self.by_layer(values)[number]
        return layer_pairs

    def _select_layer(self, number: int) -> "MatchedPairs":
        """Pairs of one of several layers."""
        row = slice(number, number + 1)  # keeps the axis of layers, with length 1
        matches = MapMatches(
            samples=self._matches.samples[row],
            query_inds=self._matches.query_inds[row],
            joined_inds=self._matches.query_inds[row],  # one layer alone is not joined
            gt_inds=self._matches.gt_inds[row],
            rows=self._matches.rows[row],
            order_inds=self._matches.order_inds[row],
            host_labels=self._matches.host_labels[row],
            counts=self._matches.counts,
        )
        return MatchedPairs(
            predictions=self.predictions.layers[number],
            truths=self.truths,
            matches=matches,
            avg_factor=self.avg_factor,
        )

    def by_layer(self, values: Tensor) -> Tensor:
        """Split values of the pairs by layer. (M, ...) -> (L, M / L, ...)

        Raises:
            ValueError: If there is no row for each pair.
        """
        if values.shape[:1] != self._rows.shape:
            raise InputError(
                f"values of a loss must have a row for each of the {len(self._rows)} pairs, got "
                f"the shape {tuple(values.shape)} (GSMAP_TRACEBACK=1 shows the loss)."
            )
        return values.unflatten(0, self._matches.rows.shape)

    def of_queries(self, values: Tensor) -> Tensor:
        """Select values of the matched queries. (B, N, ...) -> (M, ...)"""
        return values[self.samples, self.query_inds]

    def of_truths(self, values: Tensor) -> Tensor:
        """Select values of the matched ground truths. (T, ...) -> (M, ...)"""
        return values[self._rows]

    @cached_property
    def gt_labels(self) -> Tensor:
        """Class indices. (M,)"""
        return self.of_truths(self.truths.labels)

    @cached_property
    def pred_references(self) -> Tensor:
        """Predicted references of points or Gaussians. (M, P, D)"""
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
        reference = self.predictions.reference
        masks = self.predictions.masks
        references = masks.rendered_references(
            self.pred_references, self.gt_labels, reference.coords
        )
        return reference.render(references, masks.grid)

    @cached_property
    def pred_instance_states(self) -> Tensor:
        """States of the matched instances in float32. (M, C)"""
        return self.of_queries(self.predictions.decoded.instance_states).float()

    @cached_property
    def gt_pts(self) -> Tensor:
        """Ground-truth points in the matched order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.truths.pts_shifts[self._rows, self.order_inds]

    @cached_property
    def gt_first_pts(self) -> Tensor:
        """Ground-truth points in the annotated order, [0, 1] over the map. (M, P, 2 or 3)"""
        return self.of_truths(self.truths.first_pts)

    @cached_property
    def gt_pts_m(self) -> Tensor:
        """Ground-truth points in the matched order, in metres. (M, P, 2 or 3)"""
        return self.predictions.reference.metres(self.gt_pts)

    @cached_property
    def gt_masks(self) -> Tensor:
        """Masks of the ground truth. (M, H, W)"""
        masks = self.predictions.masks
        if masks.of_points:  # drawn from the P points in the matched order, not from the polylines
            return masks.draw(self.gt_pts_m, self.gt_labels, masks.grid)
        return self.of_truths(self.truths.masks)

    def query_labels(self) -> Tensor:
        """Target class index of every query, -1 for queries without a match. (B, N)"""
        scores = self.predictions.scores
        labels = torch.full(scores.shape[:2], -1, dtype=torch.long, device=scores.device)
        labels[self.samples, self.query_inds] = self.gt_labels
        return labels
