"""Map head: queries, and predictions of every decoder layer."""

import logging
from collections.abc import Mapping, Sequence
from inspect import signature
from typing import Any, cast

import torch
from mmdet3d.registry import MODELS
from mmengine.logging import print_log
from mmengine.model import bias_init_with_prob
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.models.base.class_losses import ClassLoss
from gsmap.models.base.coder import MapCoder, Samples, Tensors
from gsmap.models.base.decoder import Decoded, MapDecoder, Queries
from gsmap.models.base.groups import QueryGroup
from gsmap.models.base.hooks import FlowHook, FlowPart, FlowStart
from gsmap.models.base.layers import classification_branch, init_matrices
from gsmap.models.base.loss_head import LossHead
from gsmap.models.base.losses import MapLoss
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.matching import MapAssigner, MapCost
from gsmap.models.base.pairs import Predictions
from gsmap.models.base.parts import (
    AuxHead,
    PartConfig,
    build_part,
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

_PRIOR_PROBABILITY = 0.01  # of each class before training, as in RetinaNet


@MODELS.register_module()
class MapHead(LossHead):
    """Head that predicts N map elements of P ordered points from BEV features.

    Map models are combinations of the parts of this head: decoder, references, losses and others.
    Point queries are the sums of embeddings of instances and points (MapTR); half of their channels
    are positional. The decoder refines the queries, and the predictions of its layers are matched
    with the ground truth for the losses.

    Args:
        grid: Extent of the map.
        classes: Names of the classes.
        decoder: Config of the decoder.
        losses: Configs of the losses of matched pairs (`MapLoss`).
        match_costs: Configs of the matching costs.
        loss_cls: Config of the classification loss: a `ClassLoss`, or a loss of mmdet with logits
            and one-hot targets.
        query_groups: Settings of each `QueryGroup`. The first group predicts.
        reference: Config of the references, which the decoder refines. Default: `PointReference`.
        masks: `ElementMasks` or their settings, for losses and costs of masks.
        aux_heads: Configs of auxiliary heads, for training.
        flow_parts: Configs of modules (`FlowPart`) that create hooks in training. A hook changes
            the queries of the decoder, for example by adding queries from the ground truth.
        coder: Settings of `MapCoder`.
        num_points: Points per instance P.
        embed_dims: Channels C.
        point_queries: Config of the embeddings of points, built with ``num_points`` and
            ``embed_dims``. None means a table for all instances (`PointTable`).
        settings: Settings that map models add to every head with `head_setting`.

    Raises:
        TypeError: If a loss is no `MapLoss`, or a setting does not exist.
        ValueError: If a loss or a cost lacks an input, a class or a loss does not exist, two parts
            have one name, a setting of the coder does not exist, or a decoder with instance queries
            gets embeddings of points.
    """

    transforms = ("FormatMapTargets",)  # steps of the data pipeline that make the targets

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        decoder: PartConfig,
        losses: Sequence[PartConfig],
        match_costs: Sequence[PartConfig],
        loss_cls: PartConfig,
        query_groups: Sequence[PartConfig] = ({"num": 50},),
        reference: PartConfig | None = None,
        masks: ElementMasks | PartConfig | None = None,
        aux_heads: Sequence[PartConfig] = (),
        flow_parts: Sequence[PartConfig] = (),
        coder: PartConfig | None = None,
        num_points: int = 20,
        embed_dims: int = 256,
        point_queries: PartConfig | None = None,
        init_cfg: dict | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(init_cfg)
        # A map model may have added a setting from which the config of `point_queries` follows. An
        # unknown setting raises an error.
        point_queries = resolve_added_settings(settings).get("point_queries", point_queries)
        self.grid = grid
        self.classes = tuple(classes)
        self.num_points = num_points
        self.embed_dims = embed_dims
        self.bev_dims = embed_dims  # a subclass may have other channels in its queries
        self.masks = ElementMasks.of(grid, masks)
        self.query_groups = [QueryGroup(**group) for group in query_groups]
        num_instances = sum(group.num for group in self.query_groups)
        num_layers = decoder["num_layers"]
        reference_defaults = {
            "type": "PointReference",
            "grid": grid,
            "embed_dims": embed_dims,
            "num_layers": num_layers,
        }
        decoder_class = class_of(decoder) or MapDecoder
        if issubclass(decoder_class, MapDecoder):
            # Settings of the reference that depend on the decoder.
            reference_defaults.update(decoder_class.reference_settings(num_points))
        self.reference: RefinedReference = build_part(reference, **reference_defaults)
        self.decoder: MapDecoder = build_part(
            decoder,
            type="MapDecoder",
            layer={},
            embed_dims=embed_dims,
            num_points=num_points,
            space=self.reference.space,
        )
        if point_queries is not None and not self.decoder.point_queries:
            raise InputError(
                f"{type(self.decoder).__name__} has instance queries, which need no embeddings of "
                f"points: leave out {', '.join(settings) or 'point_queries'}."
            )
        # The first half of the channels is positional, the second half is content.
        self.instance_embedding = nn.Embedding(num_instances, 2 * embed_dims)
        self.pts_embedding = self._build_point_embedding(point_queries)
        num_classes = len(self.classes)
        self.cls_branches = nn.ModuleList()
        for _ in range(num_layers):
            branch = classification_branch(embed_dims, num_classes)
            mark_classes(branch[-1])
            self.cls_branches.append(branch)
        self.loss_cls = MODELS.build(loss_cls)
        self.losses = _build_losses(losses)
        self.aux_heads = _build_parts(aux_heads, embed_dims=embed_dims)
        self.flow_parts = _build_parts(flow_parts, embed_dims=embed_dims, num_classes=num_classes)
        self.assigner = MapAssigner(match_costs)
        self.coder = self.build_coder(coder or {})
        self.check_parts()

    def _build_point_embedding(self, config: PartConfig | None) -> nn.Module | None:
        """Build the embeddings of points; None for a decoder with instance queries."""
        if config is not None:
            embedding: nn.Module = build_part(
                config, num_points=self.num_points, embed_dims=self.embed_dims
            )
            return embedding
        if self.decoder.point_queries:
            return PointTable(self.num_points, self.embed_dims)
        return None

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Settings of the transform in ``transforms`` that follow from the settings of the head.

        Args:
            settings: Settings of the head, with ``num_points``.
        """
        return {"num_points": settings["num_points"]}

    def build_coder(self, settings: PartConfig) -> MapCoder:
        """Build the coder that belongs to the reference.

        Args:
            settings: Settings of the coder.

        Raises:
            ValueError: If a setting does not exist.
        """
        coder_class = self.reference.coder_class or MapCoder
        valid_names: set[str] = set()  # of all base classes: subclasses pass settings on to them
        for base in coder_class.__mro__:
            valid_names.update(signature(base).parameters)
        unknown = sorted(set(settings) - valid_names)
        if unknown:
            raise InputError(
                f"coder.{unknown[0]} is no setting of {coder_class.__name__}, the coder of "
                f"{type(self.reference).__name__}: leave it out, or take a head whose coder has "
                "this setting."
            )
        coder: MapCoder = coder_class(grid=self.grid, **settings)
        return coder

    def check_parts(self) -> None:
        """Check that the parts fit together.

        Raises:
            TypeError: If a loss is no `MapLoss`.
            ValueError: If a loss or a cost lacks an input, a class or a loss does not exist, or two
                parts have one name.
        """
        for loss in self.losses.values():
            if not isinstance(loss, MapLoss):
                raise InputTypeError(
                    f"{type(loss).__name__} is no MapLoss: derive it from "
                    "gsmap.models.base.losses.MapLoss (docs/add_a_method.md)."
                )
        names = ["cls", *self.losses]
        check_unique_names([*names, *self.aux_heads, *self.flow_parts], "losses")
        group_names = [group.name for group in self.query_groups]
        check_unique_names(group_names, "query groups")
        for group in self.query_groups:
            unknown = sorted(set(group.losses or ()) - set(names))
            if unknown:
                raise InputError(
                    f"query group {group.name!r} names losses {unknown}; there are {names}."
                )
        for name, indices in self.masks.class_settings.items():
            check_classes(f"masks.{name}", indices, classes=self.classes)
        check_classes("coder.unfold_classes", self.coder.unfold_classes, classes=self.classes)
        if isinstance(self.loss_cls, ClassLoss):
            self.loss_cls.check(self)
        # `check` of a part raises an error if the head lacks an input of the part.
        for loss in cast(Any, self.losses.values()):
            loss.check(self)
            check_weight(loss, loss.loss_weight, classes=self.classes)
        for cost in self.assigner.match_costs:
            if isinstance(cost, MapCost):
                cost.check(self)
                check_weight(cost, cost.weight, classes=self.classes)

    def init_weights(self) -> None:
        """Initialise matrices of the decoder (Xavier) and class logits with a low probability.

        The parts initialise their weights last, so that parts that start without effect keep
        their zeros.
        """
        init_matrices(self.decoder)
        for branch in self.cls_branches:
            *_, bias = branch.parameters()  # the last one: bias of the logits
            nn.init.constant_(bias, bias_init_with_prob(_PRIOR_PROBABILITY))
        super().init_weights()

    def queries(self) -> tuple[Tensor, Tensor]:
        """Positional queries and content of the queries, as inputs of the decoder.

        In training, the queries of all query groups are returned; in prediction, only the queries
        of the first group.

        Returns:
            Two tensors (N * P, C) for point queries, or (N, C) for instance queries.
        """
        embeddings = self.instance_embedding.weight  # (N, 2 C)
        if not self.training:
            embeddings = embeddings[: self.query_groups[0].num]
        if self.pts_embedding is not None:
            embeddings = self.pts_embedding(embeddings).flatten(0, 1)  # (N * P, 2 C)
        return embeddings[:, : self.embed_dims], embeddings[:, self.embed_dims :]

    def attention_mask(self) -> Tensor | None:
        """Self-attention mask that separates the query groups.

        Returns:
            True where attention is blocked, or None for a single group. (N, N)
        """
        if not self.training or len(self.query_groups) == 1:
            return None
        device = self.instance_embedding.weight.device
        sizes = torch.tensor([group.num for group in self.query_groups], device=device)
        group_inds = torch.arange(len(sizes), device=device).repeat_interleave(sizes)
        return group_inds[:, None] != group_inds

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Adapt the number of instance queries in a checkpoint to the model, in place.

        The queries of the first group, which predicts, are loaded. The number of queries of the
        other groups may differ: surplus queries are dropped, and missing ones keep their initial
        values, with a warning in the log.

        Args:
            state: Tensors of the checkpoint, by name. Instance queries are (N, 2 C).
            prefix: Prefix of the names of the head.
        """
        key = f"{prefix}instance_embedding.weight"
        loaded = state.get(key)
        initial = self.instance_embedding.weight
        num_predicting = self.query_groups[0].num
        if loaded is None or loaded.shape == initial.shape:
            return
        # With too few queries, the state cannot be made to fit, and torch reports the shapes.
        if len(loaded) < num_predicting:
            return
        common = loaded[: len(initial)]
        missing = initial.detach()[len(common) :].to(common)  # empty if the checkpoint has more
        state[key] = torch.cat([common, missing])
        print_log(
            f"{key}: the checkpoint has {len(loaded)} instance queries, the model "
            f"{len(initial)}; the first {num_predicting}, which predict, are loaded, the others "
            "are cut off or keep their initial values. If more of the checkpoint's predicted, set "
            "model.map_head.query_groups.0.num to their number.",
            logger="current",
            level=logging.WARNING,
        )

    def forward(
        self, bev_outputs: dict[str, Any], hooks: Sequence[FlowHook] = ()
    ) -> list[Predictions]:
        """Predict the elements after every decoder layer.

        Args:
            bev_outputs: Outputs of the BEV encoder, with ``bev_feats`` (B, C, H, W).
            hooks: Hooks into the flow of the queries, for example to add queries from previous
                frames.

        Returns:
            The predictions of each layer, with scores in at least float32.
        """
        feats = bev_outputs["bev_feats"]
        position, content = self.queries()
        query_pos = position.expand(len(feats), -1, -1)
        query = content.expand(len(feats), -1, -1)
        queries = Queries(query, query_pos, self.reference.start(query_pos))
        group_mask = self.attention_mask()
        start = FlowStart(queries, group_mask)
        for hook in hooks:
            start = hook.start(self, start)

        # After each layer, the decoder calls `refine` for the new references, and then `between`
        # for the queries of the next layer.
        def refine(layer: int, states: Tensor, reference: Tensor) -> Tensor:
            refined = self.reference.refine(layer, states, reference)
            for hook in hooks:
                refined = hook.refine(self, layer, refined)
            return refined

        def between(layer: int, queries: Queries) -> Queries:
            for hook in hooks:
                queries = hook.between(self, layer, queries)
            return queries

        layers = self.decoder(
            query=start.queries.state,
            query_pos=start.queries.position,
            reference=start.queries.reference,
            bev_feats=feats,
            refine=refine,
            attn_mask=self.decoder.layer_mask(start.mask, group_mask),
            between=between,
        )
        outputs = []
        # A decoder may use the branches of one layer for several outputs.
        for index, decoded in zip(self.decoder.branches, layers, strict=True):
            scores = at_least_float32(self.cls_branches[index](decoded.instance_states))
            outputs.append(self.predictions(scores, decoded=decoded, bev_feats=feats))
        # Each hook removes the queries that it has appended, the last appended ones first.
        for hook in reversed(hooks):
            outputs = hook.outputs(self, outputs)
        return outputs

    def predictions(self, scores: Tensor, decoded: Decoded, bev_feats: Tensor) -> Predictions:
        """Create the predictions of a layer.

        Args:
            scores: Class logits. (B, N, classes)
            decoded: Output of the decoder layer.
            bev_feats: BEV features. (B, C, H, W)
        """
        return Predictions(
            scores, decoded, bev_feats=bev_feats, reference=self.reference, masks=self.masks
        )

    def predict(
        self,
        bev_outputs: dict[str, Any],
        batch_data_samples: Samples,
        hooks: Sequence[FlowHook] = (),
    ) -> list[InstanceData]:
        """Run the head and decode its detections.

        Args:
            bev_outputs: Outputs of the BEV encoder, with ``bev_feats`` (B, C, H, W).
            batch_data_samples: Samples of the batch.
            hooks: Hooks into the flow of the queries.

        Returns:
            The detections of each sample.
        """
        metas = [sample.metainfo for sample in batch_data_samples]
        layers = self(bev_outputs, hooks)
        return self.predict_by_feat(layers, metas)

    def loss(
        self,
        bev_outputs: dict[str, Any],
        batch_data_samples: Samples,
        hooks: Sequence[FlowHook] = (),
        layers: Sequence[Predictions] | None = None,
    ) -> Tensors:
        """Run the head and compute all losses, including the losses of auxiliary heads and hooks.

        Args:
            bev_outputs: Outputs of the BEV encoder, with ``bev_feats`` (B, C, H, W).
            batch_data_samples: Samples with ground truth.
            hooks: Hooks into the flow of the queries, called after the hooks of ``flow_parts``.
            layers: Predictions of each layer, if the head has already been run without hooks. None
                runs the head.

        Returns:
            Scalars by name.
        """
        annotated = [sample.gt_instances_3d for sample in batch_data_samples]
        truths = self.prepare_gts(annotated)
        metas = [sample.metainfo for sample in batch_data_samples]
        part_hooks = []
        for part in cast(Sequence[FlowPart], self.flow_parts.values()):
            part_hooks.append(part.hook(self, truths))
        hooks = (*part_hooks, *hooks)
        if layers is None:
            layers = self(bev_outputs, hooks)
        losses = self.losses_by_feat(layers, truths, metas=metas, hooks=hooks)
        for hook in hooks:
            losses.update(hook.losses(self, truths))
        for name, head in self.aux_heads.items():
            losses[f"loss_{name}"] = cast(AuxHead, head).loss(bev_outputs, batch_data_samples)
        return losses


def _build_losses(configs: Sequence[PartConfig]) -> nn.ModuleDict:
    """Losses by name, without inherited ones that a config removes by setting them to None."""
    losses = []
    for config in configs:
        if config:
            losses.append(MODELS.build(config))
    return modules_by_name(losses)


def _build_parts(configs: Sequence[PartConfig], **defaults: Any) -> nn.ModuleDict:
    """Parts by name."""
    parts = [build_part(config, **defaults) for config in configs]
    return modules_by_name(parts)
