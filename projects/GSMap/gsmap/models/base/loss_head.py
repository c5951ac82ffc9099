"""Matching and losses of the predictions of all decoder layers and query groups.

Costs and losses are computed in float32, so autocast is disabled around them.
"""

from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from mmdet.utils import reduce_mean
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.class_losses import ClassLoss, plain_class_loss
from gsmap.models.base.coder import DetectionHead, Metas, Tensors
from gsmap.models.base.groups import QueryGroup
from gsmap.models.base.hooks import FlowHook
from gsmap.models.base.losses import MapLoss, check_layer_losses
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.matching import MapAssigner
from gsmap.models.base.pairs import GroundTruth, MapMatches, MatchedPairs, Predictions
from gsmap.models.base.references import RefinedReference

Instances = Sequence[InstanceData]


class LossHead(DetectionHead):
    """Base class of heads whose losses compare predictions with matched ground truth.

    Attributes:
        query_groups: Groups of queries. Each group is matched with the ground truth separately;
            only the first group is used at inference.
        instance_embedding: Embeddings of the instance queries.
        masks: Rasters for losses and costs of masks.
        loss_cls: Classification loss.
        losses: Further losses, by name.
        assigner: Assignment of predictions to the ground truth.
    """

    reference: RefinedReference
    query_groups: list[QueryGroup]
    instance_embedding: nn.Embedding
    masks: ElementMasks
    loss_cls: nn.Module
    losses: nn.ModuleDict
    assigner: MapAssigner

    def loss_by_feat(
        self,
        outputs: Sequence[Predictions],
        batch_gt_instances: Instances,
        batch_img_metas: Metas,
        hooks: Sequence[FlowHook] = (),
    ) -> Tensors:
        """Losses of every decoder layer and query group, from the annotations of the samples.

        This method prepares the ground truth and calls `losses_by_feat`.

        Names of losses are ``loss_<name>``. They have the prefix ``d<layer>.`` in all layers but
        the last, and the name of the group as suffix in all groups but the first.

        Args:
            outputs: Predictions of each layer, of all query groups.
            batch_gt_instances: Ground truth of each sample, see `GroundTruth`.
            batch_img_metas: Meta dict of each sample.
            hooks: Hooks that receive the matches of the first query group.

        Returns:
            Scalars by name.

        Raises:
            FloatingPointError: If a matching cost is not finite. The assigner checks the costs.
        """
        truths = self.prepare_gts(batch_gt_instances)
        return self.losses_by_feat(outputs, truths, metas=batch_img_metas, hooks=hooks)

    def losses_by_feat(
        self,
        outputs: Sequence[Predictions],
        truths: GroundTruth,
        metas: Metas,
        hooks: Sequence[FlowHook] = (),
    ) -> Tensors:
        """Losses of every decoder layer and query group, from prepared ground truth.

        `loss_by_feat` prepares the ground truth and calls this method.

        Args:
            outputs: Predictions of each layer, of all query groups.
            truths: Ground truth of the batch, from `prepare_gts`.
            metas: Meta dict of each sample.
            hooks: Hooks that receive the matches of the first query group.

        Returns:
            Scalars by name.
        """
        losses: Tensors = {}
        with torch.autocast(outputs[-1].scores.device.type, enabled=False):
            for group, layers in self.split_groups(outputs):
                # Pairs of a query and its ground truth, of all layers.
                pairs = self.match(layers, truths, metas=metas, repeats=group.repeats)
                if group is self.query_groups[0]:
                    for hook in hooks:
                        hook.targets(self, pairs.layer(-1))  # only the last layer
                losses.update(self.group_losses(group, pairs))
        return losses

    def known_losses(
        self,
        group: QueryGroup,
        layers: Sequence[Predictions],
        truths: GroundTruth,
        matches: Sequence[tuple[Tensor, Tensor]],
    ) -> Tensors:
        """Losses of a group of queries with known matches.

        All ranks must call it in each step, because the number of pairs is averaged over them.

        Args:
            group: Name, weight and losses of the group.
            layers: Predictions of the queries, after each layer.
            truths: Ground truth of the batch.
            matches: Matched pairs of each sample: indices of the queries, increasing, and indices
                of the ground truths, on the CPU. (m,) each

        Returns:
            Scalars by name.
        """
        # The slice selects all queries. `of_queries` is called because it converts the scores to
        # float32. `join` concatenates the queries of all layers.
        predictions = Predictions.join([layer.of_queries(slice(None)) for layer in layers])
        with torch.autocast(predictions.scores.device.type, enabled=False):
            known_matches = self.assigner.assign_known(predictions, truths, pairs=matches)
            pairs = self.pairs(predictions, truths, matches=known_matches)
            return self.group_losses(group, pairs)

    def split_groups(
        self, outputs: Sequence[Predictions]
    ) -> Iterator[tuple[QueryGroup, list[Predictions]]]:
        """Yield each query group with its predictions of each layer.

        The queries of the groups follow each other in the order of ``query_groups``.
        """
        start = 0
        for group in self.query_groups:
            queries = slice(start, start + group.num)
            yield group, [layer.of_queries(queries) for layer in outputs]
            start += group.num

    def prepare_gts(self, batch_gt_instances: Instances) -> GroundTruth:
        """Ground truth of a batch, for costs and losses."""
        with torch.autocast(self.instance_embedding.weight.device.type, enabled=False):
            return GroundTruth(batch_gt_instances, reference=self.reference, masks=self.masks)

    def match(
        self,
        layers: Sequence[Predictions],
        truths: GroundTruth,
        metas: Metas,
        repeats: int = 1,
    ) -> MatchedPairs:
        """Match the predictions of each layer with the ground truth.

        Args:
            layers: Predictions of a query group, after each layer.
            truths: Ground truth of the batch.
            metas: Meta dict of each sample.
            repeats: Number of queries to which each ground truth is matched.

        Returns:
            The pairs of all layers.

        Raises:
            FloatingPointError: If a matching cost is not finite.
        """
        predictions = Predictions.join(layers)
        matches = self.assigner.assign(predictions, truths, metas=metas, repeats=repeats)
        return self.pairs(predictions, truths, matches=matches)

    def pairs(
        self, predictions: Predictions, truths: GroundTruth, matches: MapMatches
    ) -> MatchedPairs:
        """Build the matched pairs, and average their number over the ranks.

        Args:
            predictions: Predictions of the matched layers.
            truths: Ground truth of the batch.
            matches: Indices of the pairs.
        """
        count = float(sum(matches.counts))  # pairs of one layer; all layers have equally many
        num_pairs = torch.full((), count, device=predictions.scores.device)
        avg_factor = reduce_mean(num_pairs).clamp(min=1.0)
        return MatchedPairs(predictions, truths, matches=matches, avg_factor=avg_factor)

    def group_losses(self, group: QueryGroup, pairs: MatchedPairs) -> Tensors:
        """Weighted losses of a query group in all layers; for the first group, also statistics.

        Args:
            group: Query group.
            pairs: Matched pairs of the group, of all layers.

        Returns:
            Scalars by name.
        """
        # Losses of each layer, by name.
        layer_losses: list[Tensors] = [{} for _ in range(pairs.num_layers)]
        is_first = group is self.query_groups[0]
        # A group may use only some of the losses. "cls" is the name of `loss_cls`.
        names = ("cls", *self.losses) if group.losses is None else group.losses
        if "cls" in names:
            for index, value in enumerate(group.weight * self.class_losses(pairs)):
                layer_losses[index]["loss_cls"] = value
        for name, loss in cast(Any, self.losses.items()):
            applies_to_group = is_first or not loss.first_group_only
            if name in names and applies_to_group:
                values = self._values_by_layer(loss, pairs, weight=group.weight)
                for index, value in values.items():
                    layer_losses[index][f"loss_{name}"] = value
        if is_first:
            layer_losses[-1].update(self.statistics(pairs.layer(-1)))
        suffix = f"_{group.name}" if group.name else ""
        losses = {}
        for index, named_values in enumerate(layer_losses):
            is_last = index == pairs.num_layers - 1
            prefix = "" if is_last else f"d{index}."
            for name, value in named_values.items():
                losses[f"{prefix}{name}{suffix}"] = value
        return losses

    @staticmethod
    def _values_by_layer(loss: MapLoss, pairs: MatchedPairs, weight: float) -> dict[int, Tensor]:
        """Values of a loss, by the index of each layer that has the inputs of the loss.

        Args:
            loss: Loss of the head.
            pairs: Matched pairs of all layers.
            weight: Factor of the values.

        Raises:
            ValueError: If the loss of a layer is not one value.
        """
        first = pairs.num_layers - 1 if loss.last_layer_only else 0
        layers = range(first, pairs.num_layers)
        layers_with_loss = [index for index in layers if loss.reads(pairs.layer(index))]
        if not layers_with_loss:
            return {}
        if len(layers_with_loss) == pairs.num_layers:  # all layers are computed in one call
            values = loss.by_layer(pairs)
        else:
            values = torch.stack([loss(pairs.layer(index)) for index in layers_with_loss])
        check_layer_losses(loss, values, num_layers=len(layers_with_loss))
        # One product of all layers is one launch on a GPU.
        return dict(zip(layers_with_loss, weight * values, strict=True))

    def class_losses(self, pairs: MatchedPairs) -> Tensor:
        """Classification loss of each layer, divided by the number of pairs. (L,)"""
        scores = pairs.predictions.scores  # (B, L * N, classes)
        # Both kinds of loss give one value for each logit. (B, L * N, classes)
        if isinstance(self.loss_cls, ClassLoss):  # reads the matched pairs
            values = self.loss_cls(pairs)
        else:  # a loss of mmdet, which reads logits and labels
            values = plain_class_loss(self.loss_cls, scores, labels=pairs.query_labels())
        # (B, L * N, classes) -> (L, B, N * classes)
        by_layer = values.view(len(scores), pairs.num_layers, -1).transpose(0, 1)
        return by_layer.flatten(1).sum(1) / pairs.avg_factor

    def statistics(self, pairs: MatchedPairs) -> Tensors:
        """Statistics to log, by names that do not start with ``loss``; none in this class.

        Args:
            pairs: Matched pairs of the last layer.
        """
        return {}
