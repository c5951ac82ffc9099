"""The map head, composed of parts: queries, predictions of every layer, matching, losses."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from inspect import signature
from typing import Any, cast

import torch
from mmdet.utils import reduce_mean
from mmdet3d.registry import MODELS
from mmengine.logging import print_log
from mmengine.model import bias_init_with_prob
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.class_losses import ClassLoss, plain_class_loss
from gsmap.models.base.coder import DetectionHead, MapCoder, Metas, Samples, Tensors
from gsmap.models.base.decoder import Decoded, MapDecoder, Queries
from gsmap.models.base.groups import QueryGroup
from gsmap.models.base.hooks import FlowHook, FlowPart, FlowStart
from gsmap.models.base.layers import classification_branch, init_matrices
from gsmap.models.base.losses import MapLoss
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.matching import MapAssigner, MapCost
from gsmap.models.base.pairs import GroundTruth, MapMatches, MatchedPairs, Predictions
from gsmap.models.base.parts import (
    PARTS,
    AuxHead,
    check_classes,
    check_unique_names,
    check_weight,
    class_of,
    modules_by_name,
)
from gsmap.models.base.queries import PointTable, resolve_added_settings
from gsmap.models.base.references import RefinedReference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32
from gsmap.utils.errors import InputError, InputTypeError

_PRIOR_PROBABILITY = 0.01
Instances = Sequence[InstanceData]


@MODELS.register_module()
class MapHead(DetectionHead):
    """Predict N map elements of P ordered points from BEV features, as its parts say.

    A query is the sum of its instance's and its point's embedding (MapTR); half of its channels are
    position, half content. The flow: queries, decoder, matched pairs, losses or prediction. Methods
    are combined by their parts.

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        decoder: Config of the decoder.
        losses: Configs of the losses of matched pairs (`MapLoss`).
        match_costs: Configs of the matching costs.
        loss_cls: Config of the classification loss: a `ClassLoss`, or one of mmdet's form on logits
            and one-hot targets.
        query_groups: Settings of each `QueryGroup`; the first one predicts.
        reference: Config of what the decoder refines (`PointReference`).
        masks: `ElementMasks` or their settings, for losses and costs that read masks.
        aux_heads: Configs of heads that only help training.
        flow_parts: Configs of parts that take part in the flow in training, such as queries made of
            the ground truth (`FlowPart`).
        coder: Settings of `MapCoder`.
        num_points: Points per instance P.
        embed_dims: Channels C.
        point_queries: Config of what makes the points' embeddings, built with ``num_points`` and
            ``embed_dims``; None means a table for all instances (`PointTable`).
        settings: Settings that methods add to every head (`head_setting`).

    Raises:
        TypeError: If a loss is no `MapLoss`.
        ValueError: If a loss or a cost lacks a part that it reads, a class or a loss is named that
            there is not, or two parts have one name.
    """

    transforms = ("FormatMapTargets",)

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        decoder: PARTS,
        losses: Sequence[PARTS],
        match_costs: Sequence[PARTS],
        loss_cls: PARTS,
        query_groups: Sequence[PARTS] = ({"num": 50},),
        reference: PARTS | None = None,
        masks: ElementMasks | PARTS | None = None,
        aux_heads: Sequence[PARTS] = (),
        flow_parts: Sequence[PARTS] = (),
        coder: PARTS | None = None,
        num_points: int = 20,
        embed_dims: int = 256,
        point_queries: PARTS | None = None,
        init_cfg: dict | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(init_cfg)
        point_queries = resolve_added_settings(settings).get("point_queries", point_queries)
        self.grid, self.classes = grid, tuple(classes)
        self.num_points, self.embed_dims = num_points, embed_dims
        self.masks = ElementMasks.of(grid, masks)
        self.query_groups = [QueryGroup(**group) for group in query_groups]
        num_instances = sum(group.num for group in self.query_groups)
        shared = {"embed_dims": embed_dims, "num_layers": decoder["num_layers"]}
        kind = class_of(decoder) or MapDecoder
        point = {"type": "PointReference", "grid": grid}
        if issubclass(kind, MapDecoder):
            point |= kind.reference_settings(num_points)
        self.reference: RefinedReference = MODELS.build({**point, **shared, **(reference or {})})
        handed_on = {"num_points": num_points, "space": self.reference.space}
        self.decoder: MapDecoder = MODELS.build(
            {"type": "MapDecoder", "layer": {}, **shared, **handed_on, **decoder}
        )
        if point_queries is not None and not self.decoder.point_queries:
            raise InputError(
                f"{type(self.decoder).__name__} has queries of instances, no embeddings of points: "
                f"leave out {', '.join(settings) or 'point_queries'}."
            )
        self.instance_embedding = nn.Embedding(num_instances, 2 * embed_dims)
        self.pts_embedding: nn.Module | None = None
        sizes = {"num_points": num_points, "embed_dims": embed_dims}
        if point_queries is not None:
            self.pts_embedding = MODELS.build({**sizes, **point_queries})
        elif self.decoder.point_queries:
            self.pts_embedding = PointTable(**sizes)
        self.cls_branches = nn.ModuleList(
            classification_branch(embed_dims, len(self.classes))
            for _ in range(decoder["num_layers"])
        )
        self.loss_cls = MODELS.build(loss_cls)
        self.losses = modules_by_name([MODELS.build(loss) for loss in losses if loss])
        self.aux_heads = modules_by_name(
            [MODELS.build({"embed_dims": embed_dims, **head}) for head in aux_heads]
        )
        own = {"embed_dims": embed_dims, "num_classes": len(self.classes)}
        self.flow_parts = modules_by_name([MODELS.build({**own, **part}) for part in flow_parts])
        self.assigner = MapAssigner(match_costs)
        self.coder = self.build_coder(coder or {})
        self.check_parts()

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the head."""
        return {"num_points": settings["num_points"]}

    def build_coder(self, settings: PARTS) -> MapCoder:
        """Return the coder that goes with the reference.

        Args:
            settings: Its settings.

        Raises:
            ValueError: If it has no such setting.
        """
        kind = self.reference.coder_class or MapCoder
        known = {name for base in kind.__mro__ for name in signature(base).parameters}
        unknown = sorted(set(settings) - known)
        if unknown:
            raise InputError(
                f"coder.{unknown[0]} is no setting of {kind.__name__}, the coder of "
                f"{type(self.reference).__name__}: leave it out, or take a head whose reference "
                "has a coder with it."
            )
        coder: MapCoder = kind(grid=self.grid, **settings)
        return coder

    def check_parts(self) -> None:
        """Refuse parts that do not fit together, see the class."""
        for loss in self.losses.values():
            if not isinstance(loss, MapLoss):
                raise InputTypeError(
                    f"{type(loss).__name__} is no MapLoss: derive it from "
                    "gsmap.models.base.losses.MapLoss (docs/add_a_method.md)."
                )
        names = ["cls", *self.losses]
        check_unique_names([*names, *self.aux_heads, *self.flow_parts], "losses")
        check_unique_names([group.name for group in self.query_groups], "query groups")
        for group in self.query_groups:
            unknown = sorted(set(group.losses or ()) - set(names))
            if unknown:
                raise InputError(
                    f"query group {group.name!r} names losses {unknown}; there are {names}."
                )
        for name, given in self.masks.class_settings.items():
            check_classes(f"masks.{name}", given, self.classes)
        check_classes("coder.unfold_classes", self.coder.unfold_classes, self.classes)
        if isinstance(self.loss_cls, ClassLoss):
            self.loss_cls.check(self)
        for loss in cast(Any, self.losses.values()):
            loss.check(self)
            check_weight(loss, loss.loss_weight, self.classes)
        for cost in self.assigner.match_costs:
            if isinstance(cost, MapCost):
                cost.check(self)
                check_weight(cost, cost.weight, self.classes)

    def init_weights(self) -> None:
        """Initialise the decoder's matrices (Xavier) and let every class start improbable."""
        init_matrices(self.decoder)
        for branch in self.cls_branches:
            *_, bias = branch.parameters()  # of the logits
            nn.init.constant_(bias, bias_init_with_prob(_PRIOR_PROBABILITY))
        super().init_weights()  # parts that start neutral have the last word

    def queries(self) -> tuple[Tensor, Tensor]:
        """Return position and content of the queries, 2 x (N * P, C), or (N, C) of instances.

        They are as the decoder takes them: all groups in training, else the one that predicts.
        """
        both = self.instance_embedding.weight
        if not self.training:
            both = both[: self.query_groups[0].num]
        if self.pts_embedding is not None:
            both = self.pts_embedding(both).flatten(0, 1)
        return both[:, : self.embed_dims], both[:, self.embed_dims :]

    def attention_mask(self) -> Tensor | None:
        """Return which instances may not attend to each other: those of two groups. (N, N)"""
        if not self.training or len(self.query_groups) == 1:
            return None
        device = self.instance_embedding.weight.device
        sizes = torch.tensor([group.num for group in self.query_groups], device=device)
        owner = torch.arange(len(sizes), device=device).repeat_interleave(sizes)
        return owner[:, None] != owner

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Fit a checkpoint's instance queries (N, 2 C) to the model's, in place.

        The first ones, which predict, are taken as they are. Surplus further queries are cut off;
        missing ones keep their initial values. A log line says so.
        """
        key, own = f"{prefix}instance_embedding.weight", self.instance_embedding.weight
        loaded, predicting = state.get(key), self.query_groups[0].num
        if loaded is None or len(loaded) < predicting or loaded.shape == own.shape:
            return
        kept = loaded[: len(own)]
        state[key] = torch.cat([kept, own.detach()[len(kept) :].to(kept)])
        print_log(
            f"{key}: the checkpoint has {len(loaded)} instance queries, the model {len(own)}; the "
            f"{predicting} that predict are taken, the further ones cut off or left as new.",
            "current",
            logging.WARNING,
        )

    def forward(
        self, bev_outputs: dict[str, Any], hooks: Sequence[FlowHook] = ()
    ) -> list[Predictions]:
        """Predict the elements after every decoder layer.

        Args:
            bev_outputs: What the BEV encoder returns: ``bev_feats`` (B, C, H, W) is read.
            hooks: What takes part in the flow, such as the memory of the frames before.

        Returns:
            The predictions of each layer, scores in float32 at least.
        """
        feats = bev_outputs["bev_feats"]
        query_pos, query = (part.expand(len(feats), -1, -1) for part in self.queries())
        queries = Queries(query, query_pos, self.reference.start(query_pos))
        start = FlowStart(queries, self.attention_mask())
        for hook in hooks:
            start = hook.start(self, start)

        def refine(layer: int, states: Tensor, reference: Tensor) -> Tensor:
            refined = self.reference.refine(layer, states, reference)
            for hook in hooks:
                refined = hook.refine(self, layer, refined)
            return refined

        def between(layer: int, queries: Queries) -> Queries:
            for hook in hooks:
                queries = hook.between(self, layer, queries)
            return queries

        state, position, reference = start.queries
        layers = self.decoder(state, position, reference, feats, refine, start.mask, between)
        outputs = [
            self.predictions(
                at_least_float32(self.cls_branches[number](layer.instance_states)), layer, feats
            )
            for number, layer in zip(self.decoder.branches, layers, strict=True)
        ]
        for hook in reversed(hooks):
            outputs = hook.outputs(self, outputs)
        return outputs

    def predictions(self, scores: Tensor, decoded: Decoded, bev_feats: Tensor) -> Predictions:
        """Return the predictions of a layer, with what decodes and renders them."""
        return Predictions(scores, decoded, bev_feats, self.reference, self.masks)

    def predict(
        self,
        bev_outputs: dict[str, Any],
        batch_data_samples: Samples,
        hooks: Sequence[FlowHook] = (),
    ) -> list[InstanceData]:
        """Run the head and return its detections; hooks as in `forward`."""
        metas = [sample.metainfo for sample in batch_data_samples]
        return self.predict_by_feat(self(bev_outputs, hooks), metas)

    def loss(
        self,
        bev_outputs: dict[str, Any],
        batch_data_samples: Samples,
        hooks: Sequence[FlowHook] = (),
    ) -> Tensors:
        """Run the head and return all losses, also of auxiliary heads, flow parts and hooks."""
        gts = [sample.gt_instances_3d for sample in batch_data_samples]
        metas = [sample.metainfo for sample in batch_data_samples]
        truths = self.prepare_gts(gts)
        parts = cast(Sequence[FlowPart], self.flow_parts.values())
        hooks = (*(part.hook(self, truths) for part in parts), *hooks)
        losses = self.losses_by_feat(self(bev_outputs, hooks), truths, metas, hooks)
        for hook in hooks:
            losses.update(hook.losses(self, truths))
        for name, head in self.aux_heads.items():
            losses[f"loss_{name}"] = cast(AuxHead, head).loss(bev_outputs, batch_data_samples)
        return losses

    def loss_by_feat(
        self,
        outputs: Sequence[Predictions],
        batch_gt_instances: Instances,
        batch_img_metas: Metas,
        hooks: Sequence[FlowHook] = (),
    ) -> Tensors:
        """Prepare the ground truth and return the losses of every decoder layer and query group.

        The last layer's losses have their names, the others' the prefix ``d<layer>.``; those of a
        further query group end in its name.

        Args:
            outputs: Predictions of each layer, of all query groups.
            batch_gt_instances: Ground truth of each sample, as `GroundTruth` takes it.
            batch_img_metas: Meta dict of each sample.
            hooks: They read what the predicting queries were matched to.

        Raises:
            FloatingPointError: If a matching cost is not finite.
        """
        truths = self.prepare_gts(batch_gt_instances)
        return self.losses_by_feat(outputs, truths, batch_img_metas, hooks)

    def losses_by_feat(
        self,
        outputs: Sequence[Predictions],
        truths: GroundTruth,
        metas: Metas,
        hooks: Sequence[FlowHook] = (),
    ) -> Tensors:
        """Return the losses of every decoder layer and query group, see `loss_by_feat`."""
        losses: Tensors = {}
        with torch.autocast(outputs[-1].scores.device.type, enabled=False):
            for group, layers in self.split_groups(outputs):
                pairs = self.match(layers, truths, metas, group.repeats)
                for hook in hooks if group is self.query_groups[0] else ():
                    hook.targets(self, pairs.layer(-1))
                losses.update(self.group_losses(group, pairs))
        return losses

    def known_losses(
        self,
        group: QueryGroup,
        layers: Sequence[Predictions],
        truths: GroundTruth,
        matches: Sequence[tuple[Tensor, Tensor]],
    ) -> Tensors:
        """Return the losses of a group of queries whose matches are known.

        All ranks call it in each step, for the number of pairs is averaged over them.

        Args:
            group: Name, weight and losses of the group.
            layers: Predictions of its queries, of each layer.
            truths: The ground truth of the batch.
            matches: Of each sample the numbers of its matched queries, increasing, and of the
                ground truth of each, on the CPU. 2 x (m,)
        """
        predictions = Predictions.join([layer.of_queries(slice(None)) for layer in layers])
        with torch.autocast(predictions.scores.device.type, enabled=False):
            known = self.assigner.assign_known(predictions, truths, matches)
            return self.group_losses(group, self.pairs(predictions, truths, *known))

    def split_groups(
        self, outputs: Sequence[Predictions]
    ) -> Iterator[tuple[QueryGroup, list[Predictions]]]:
        """Yield each query group with its predictions of each layer."""
        start = 0
        for group in self.query_groups:
            queries = slice(start, start + group.num)
            yield group, [layer.of_queries(queries) for layer in outputs]
            start += group.num

    def prepare_gts(self, batch_gt_instances: Instances) -> GroundTruth:
        """Return the ground truth of a batch as costs and losses read it."""
        with torch.autocast(self.instance_embedding.weight.device.type, enabled=False):
            return GroundTruth(batch_gt_instances, self.reference, self.masks)

    def match(
        self,
        layers: Sequence[Predictions],
        truths: GroundTruth,
        metas: Metas,
        repeats: int = 1,
    ) -> MatchedPairs:
        """Match every sample's predictions of each layer with its ground truth."""
        predictions = Predictions.join(layers)
        matches, counts = self.assigner.assign(predictions, truths, metas, repeats)
        return self.pairs(predictions, truths, matches, counts)

    def pairs(
        self,
        predictions: Predictions,
        truths: GroundTruth,
        matches: MapMatches,
        counts: Sequence[int],
    ) -> MatchedPairs:
        """Return matches as pairs, with their number averaged over the ranks.

        Args:
            predictions: Predictions of the matched layers.
            truths: The ground truth of the batch.
            matches: What is matched.
            counts: Number of pairs of each sample, in one layer.
        """
        count = torch.full((), float(sum(counts)), device=predictions.scores.device)
        avg_factor = reduce_mean(count).clamp(min=1.0)
        return MatchedPairs(predictions, truths, matches, counts, avg_factor)

    def group_losses(self, group: QueryGroup, pairs: MatchedPairs) -> Tensors:
        """Return the weighted losses of all layers of a query group, and figures to log."""
        numbers = range(pairs.num_layers)
        by_layer: list[Tensors] = [{} for _ in numbers]
        first = group is self.query_groups[0]
        chosen = ("cls", *self.losses) if group.losses is None else group.losses
        if "cls" in chosen:
            for found, value in zip(by_layer, self.class_losses(pairs), strict=True):
                found["loss_cls"] = group.weight * value
        for name, loss in cast(Any, self.losses.items()):
            if name not in chosen or (loss.first_group_only and not first):
                continue
            candidates = numbers[-1:] if loss.last_layer_only else numbers
            among = [number for number in candidates if loss.reads(pairs.layer(number))]
            if len(among) == len(numbers):
                values = list(loss.by_layer(pairs))
            else:
                values = [loss(pairs.layer(number)) for number in among]
            for number, value in zip(among, values, strict=True):
                by_layer[number][f"loss_{name}"] = group.weight * value
        if first:
            by_layer[-1].update(self.statistics(pairs.layer(-1)))
        suffix = f"_{group.name}" if group.name else ""
        losses = {}
        for number, found in enumerate(by_layer):
            prefix = "" if number == numbers[-1] else f"d{number}."
            losses.update({f"{prefix}{name}{suffix}": value for name, value in found.items()})
        return losses

    def class_losses(self, pairs: MatchedPairs) -> Tensor:
        """Classification loss of each layer. (L,)"""
        scores = pairs.predictions.scores  # (B, L * N, classes)
        if isinstance(self.loss_cls, ClassLoss):
            values = self.loss_cls(pairs)
        else:
            values = plain_class_loss(self.loss_cls, scores, pairs.query_labels())
        by_layer = values.view(len(scores), pairs.num_layers, -1).transpose(0, 1)
        return by_layer.flatten(1).sum(1) / pairs.avg_factor

    def statistics(self, pairs: MatchedPairs) -> Tensors:
        """Return figures to log beside the losses; their names do not start with ``loss``."""
        return {}
