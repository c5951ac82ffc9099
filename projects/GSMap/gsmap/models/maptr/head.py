"""The map head, composed of parts: queries, predictions of every layer, matching, losses."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.logging import print_log
from mmengine.model import BaseModule, bias_init_with_prob
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.maptr.coder import MapCoder
from gsmap.models.maptr.decoder import MapDecoder
from gsmap.models.maptr.layers import classification_branch, init_matrices
from gsmap.models.maptr.masks import ElementMasks
from gsmap.models.maptr.matching import MapAssigner
from gsmap.models.maptr.pairs import MatchedPairs
from gsmap.models.maptr.parts import by_name, check_parts
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32

_PRIOR_PROBABILITY = 0.01
PARTS = dict[str, Any]
Tensors = dict[str, Tensor]
Samples = Sequence[Det3DDataSample]
Instances = Sequence[InstanceData]
Metas = Sequence[dict[str, Any]]


@dataclass(frozen=True)
class QueryGroup:
    """Instance queries that are matched together; no group attends to another.

    Args:
        num: Instance queries.
        name: Suffix of its losses; empty for the group that predicts.
        repeats: How often each ground truth may be matched (k in MapTRv2).
        weight: Weight of its losses (lambda in MapTRv2).
        losses: Names of the losses that it has; None means all.

    Raises:
        ValueError: If a number is not positive.
    """

    num: int
    name: str = ""
    repeats: int = 1
    weight: float = 1.0
    losses: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.num < 1 or self.repeats < 1:
            raise ValueError(
                f"a query group needs num >= 1 and repeats >= 1, got {self.num} and {self.repeats}."
            )

    def has(self, loss: str) -> bool:
        """Return whether the group has a loss."""
        return self.losses is None or loss in self.losses


@MODELS.register_module()
class MapHead(BaseModule):
    """Predict N map elements of P ordered points from BEV features, as its parts say.

    A query is the sum of its instance's and its point's embedding (MapTR); half of its channels are
    position, half content. Methods are combined by their parts. A loss or a cost names the fields
    that it reads (``reads``); what nobody offers is an error when the head is built.

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        decoder: Config of the decoder.
        losses: Configs of the losses of matched pairs.
        match_costs: Configs of the matching costs.
        loss_cls: Config of the classification loss, on logits and one-hot targets.
        query_groups: Settings of each `QueryGroup`; the first one predicts.
        reference: Config of what the decoder refines (`PointReference`).
        masks: Settings of `ElementMasks`, for losses and costs that read masks.
        aux_heads: Configs of heads that only help training.
        coder: Settings of `MapCoder`.
        num_points: Points per instance P.
        embed_dims: Channels C.

    Raises:
        ValueError: If a loss or a cost reads a field that nothing here offers or names a class
            that there is not, or two parts have one name.
    """

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
        masks: PARTS | None = None,
        aux_heads: Sequence[PARTS] = (),
        coder: PARTS | None = None,
        num_points: int = 20,
        embed_dims: int = 256,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid, self.classes = grid, tuple(classes)
        self.num_points, self.embed_dims = num_points, embed_dims
        self.masks = ElementMasks(grid, **(masks or {}))
        self.query_groups = [QueryGroup(**group) for group in query_groups]
        num_instances = sum(group.num for group in self.query_groups)
        shared = {"embed_dims": embed_dims, "num_layers": decoder["num_layers"]}
        point = {"type": "PointReference", "grid": grid, **shared}
        self.reference = MODELS.build({**point, **(reference or {})})
        handed_on = {"num_points": num_points, "space": getattr(self.reference, "space", None)}
        self.decoder: MapDecoder = MODELS.build(
            {"type": "MapDecoder", "layer": {}, **shared, **handed_on, **decoder}
        )
        self.instance_embedding = nn.Embedding(num_instances, 2 * embed_dims)
        points = nn.Embedding(num_points, 2 * embed_dims) if self.decoder.point_queries else None
        self.pts_embedding = points
        self.cls_branches = nn.ModuleList(
            classification_branch(embed_dims, len(self.classes))
            for _ in range(decoder["num_layers"])
        )
        self.loss_cls = MODELS.build(loss_cls)
        self.losses = by_name([MODELS.build(loss) for loss in losses])
        self.aux_heads = by_name(
            [MODELS.build({"embed_dims": embed_dims, **head}) for head in aux_heads]
        )
        self.assigner = MapAssigner(match_costs)
        self.coder = MapCoder(grid=grid, **(coder or {}))
        self._reads = check_parts(self)

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
            both = (both[:, None] + self.pts_embedding.weight).flatten(0, 1)
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

    def forward(self, bev_outputs: Tensors) -> Tensors:
        """Predict the elements after every decoder layer from ``bev_feats`` (B, C, H, W).

        ``all_cls_scores`` are logits (L, B, N, classes), ``all_pts_preds`` normalised (L, B, N, P,
        2 or 3), with ``all_references`` (L, B, N, P, D), float32; ``all_instance_states`` (L, B, N,
        C) and the decoder's further ``fields``; ``states`` (L, B, N * P, C); ``bev_feats``.
        """
        bev_feats = bev_outputs["bev_feats"]
        query_pos, query = (part.expand(len(bev_feats), -1, -1) for part in self.queries())
        start, refine, mask = self.reference.start, self.reference.refine, self.attention_mask()
        decoded = self.decoder(query, query_pos, start(query_pos), bev_feats, refine, mask)
        by_point = (-1, self.num_points)
        fields = {name: decoded[name] for name in self.decoder.fields}
        if "instance_states" not in fields:
            fields["instance_states"] = decoded["point_states"].unflatten(2, by_point).mean(3)
        states = fields["instance_states"]  # (L, B, N, C)
        scores = [branch(layer) for branch, layer in zip(self.cls_branches, states, strict=True)]
        references = decoded["references"].unflatten(2, by_point)  # (L, B, N, P, D)
        return {
            "all_cls_scores": at_least_float32(torch.stack(scores)),
            "all_pts_preds": references[..., : self.reference.coords],
            "all_references": references,
            **{f"all_{name}": value for name, value in fields.items()},
            "states": decoded["point_states"],
            "bev_feats": bev_feats,
        }

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Run the head and return its losses, those of the auxiliary heads included."""
        gts = [sample.gt_instances_3d for sample in batch_data_samples]
        metas = [sample.metainfo for sample in batch_data_samples]
        losses = self.loss_by_feat(self(bev_outputs), gts, metas)
        for name, head in self.aux_heads.items():
            losses[f"loss_{name}"] = cast(Any, head).loss(bev_outputs, batch_data_samples)
        return losses

    def loss_by_feat(
        self, outputs: Tensors, batch_gt_instances: Instances, batch_img_metas: Metas
    ) -> Tensors:
        """Prepare the ground truth and return the losses of every decoder layer and query group.

        Ground truth is, per sample, ``labels_3d`` (K,), ``pts`` (K, P, 2), ``pts_shifts`` (K, S, P,
        2) in metres, and for masks ``polylines`` (K, M, 2). The last layer's losses have their
        names, the others' the prefix ``d<layer>.``; those of a further query group end in its name.

        Raises:
            FloatingPointError: If a matching cost is not finite.
        """
        losses: Tensors = {}
        with torch.autocast(outputs["all_pts_preds"].device.type, enabled=False):
            gts = [self.prepare_gt(gt) for gt in batch_gt_instances]
            for group, own in self.split_groups(outputs):
                losses.update(self.group_losses(group, own, gts, batch_img_metas))
        return losses

    def split_groups(self, outputs: Tensors) -> Iterator[tuple[QueryGroup, Tensors]]:
        """Yield each query group with its predictions, ``all_*`` (L, B, N of the group, ...)."""
        shared = {k: v for k, v in outputs.items() if k == "bev_feats"}
        start = 0
        for group in self.query_groups:
            end = start + group.num
            own = {k: v[:, :, start:end] for k, v in outputs.items() if k.startswith("all_")}
            yield group, own | shared
            start = end

    def group_losses(
        self, group: QueryGroup, outputs: Tensors, gts: Instances, metas: Metas
    ) -> Tensors:
        """Return every layer's losses of one query group."""
        losses: Tensors = {}
        last = len(outputs["all_cls_scores"]) - 1
        suffix = f"_{group.name}" if group.name else ""
        for layer in range(last + 1):
            predictions, feats = self.layer_predictions(outputs, layer), outputs.get("bev_feats")
            pairs = self.match(predictions, gts, metas, group.repeats, feats)
            prefix = "" if layer == last else f"d{layer}."
            for name, value in self.layer_losses(group, pairs, layer == last).items():
                weight = group.weight if name.startswith("loss_") else 1.0
                losses[f"{prefix}{name}{suffix}"] = weight * value
        return losses

    def prepare_gt(self, gt_instances: InstanceData) -> InstanceData:
        """Return one sample's ground truth as costs and losses read it.

        It has ``labels`` (K,), normalised ``pts_shifts`` (K, S, P, 2) and, in the annotated order,
        ``first_pts`` (K, P, 2); where they are read, ``rasters`` (K, h, w) for matching and
        ``masks`` (K, H, W).
        """
        gt = InstanceData(
            labels=gt_instances.labels_3d,
            pts_shifts=self.reference.norm(gt_instances.pts_shifts.float()),
            first_pts=self.reference.norm(gt_instances.pts.float()),
        )
        if "gt.rasters" in self._reads:
            gt.rasters = self.masks.draw_sample(gt_instances, self.masks.cost_grid)
        if "gt.masks" in self._reads and self.masks.source == "full":
            gt.masks = self.masks.draw_sample(gt_instances, self.masks.grid)
        return gt

    def layer_predictions(self, outputs: Tensors, layer: int) -> list[InstanceData]:
        """Return a layer's predictions, per sample, as costs and losses read them.

        They have ``scores`` (N, classes), normalised ``pts`` (N, P, 2), ``references`` (N, P, D),
        what else the decoder gives, and, where a cost reads them, ``rasters`` (N, h, w) without
        gradient.
        """
        names = {"all_cls_scores": "scores", "all_pts_preds": "pts", "all_references": "references"}
        fields = {
            names.get(name, name.removeprefix("all_")): value[layer].float()
            for name, value in outputs.items()
            if name.startswith("all_")
        }
        if "pred.rasters" in self._reads:
            means, scales, rotations = self.reference.space.decode(fields["references"].detach())
            fields["rasters"] = render_gaussians(means, scales, rotations, self.masks.cost_grid)
        batch = len(fields["scores"])
        return [InstanceData(**{k: v[i] for k, v in fields.items()}) for i in range(batch)]

    def match(
        self,
        predictions: Instances,
        gts: Instances,
        metas: Metas,
        repeats: int = 1,
        bev_feats: Tensor | None = None,
    ) -> MatchedPairs:
        """Match every sample's predictions with its ground truth."""
        samples = zip(predictions, gts, metas, strict=True)
        matches = [self.assigner.assign(*sample, repeats) for sample in samples]
        return MatchedPairs(predictions, gts, matches, self.reference, self.masks, bev_feats)

    def layer_losses(self, group: QueryGroup, pairs: MatchedPairs, is_last: bool) -> Tensors:
        """Return the losses of one layer's predictions."""
        losses: Tensors = {}
        first, avg_factor = group is self.query_groups[0], pairs.avg_factor
        if group.has("cls"):
            # one-hot targets take the plain path of mmdet's focal loss, which needs no compiled op
            one_hot = F.one_hot(pairs.query_labels() + 1, len(self.classes) + 1)[:, 1:]
            losses["loss_cls"] = self.loss_cls(pairs.query_scores(), one_hot, avg_factor=avg_factor)
        for name, loss in self.losses.items():
            late = is_last or not getattr(loss, "last_layer_only", False)
            if late and group.has(name) and (first or not getattr(loss, "first_group_only", False)):
                values = [pairs[field] for field in cast(Any, loss).reads]
                losses[f"loss_{name}"] = loss(*values, avg_factor=avg_factor)
        if is_last and first:
            losses.update(self.statistics(pairs))
        return losses

    def statistics(self, pairs: MatchedPairs) -> Tensors:
        """Return figures to log beside the losses; their names do not start with ``loss``."""
        return {}

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Run the head and return its detections."""
        metas = [sample.metainfo for sample in batch_data_samples]
        return self.predict_by_feat(self(bev_outputs), metas)

    def predict_by_feat(self, outputs: Tensors, batch_img_metas: Metas) -> list[InstanceData]:
        """Decode the last layer's predictions, best first.

        They are, per sample, ``scores_3d`` (M,), ``labels_3d`` (M,), ``pts`` (M, P, 2) in metres
        and what else the reference decodes.
        """
        results = []
        last = zip(outputs["all_cls_scores"][-1], outputs["all_references"][-1], strict=True)
        for scores, references in last:
            fields = self.reference.decode(references)
            best = self.coder.decode(scores, fields["pts"])
            chosen = {name: value[best.query_inds] for name, value in fields.items()}
            chosen.update(scores_3d=best.scores, labels_3d=best.labels)
            results.append(InstanceData(metainfo=self.reference.metainfo, **chosen))
        return results
