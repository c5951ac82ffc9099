"""PivotNet's head: points of lines, of which those that are pivots make the map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.maptr.coder import MapCoder
from gsmap.models.maptr.head import DetectionHead, Samples, Tensors
from gsmap.models.maptr.layers import mlp
from gsmap.models.maptr.parts import PARTS
from gsmap.models.pivotnet.decoder import ClassLines, PointLineDecoder
from gsmap.models.pivotnet.front import front_size, turned
from gsmap.models.pivotnet.losses import LINE, PIVOT, Lines, PivotLosses, TrueLines, mask_distances
from gsmap.structures.grid import BEVGrid

_POINT_DIMS = 64  # channels of each coordinate of a point
LAYER_WEIGHTS = (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)
LEVEL_WEIGHTS = (0.4, 0.8, 1.6, 2.4)


@dataclass(frozen=True)
class PivotReference:
    """What points are: (u, v, logit of a pivot), and the lines that pivots make."""

    grid: BEVGrid
    outputs = ("pts", "num_pts")
    space = None
    metainfo: ClassVar[Mapping[str, Any]] = MappingProxyType({})

    def decode(self, references: Tensor) -> Tensors:
        """Keep the pivots of every line, those of positive logit, in order.

        ``pts`` (N, P, 2) are in metres, the last one repeated, ``num_pts`` (N,) their numbers.
        (N, P, 3)
        """
        dropped = references[..., 2] <= 0
        index = torch.arange(dropped.shape[1], device=dropped.device)
        order = (index + dropped * len(index)).argsort(-1)  # pivots first
        number = (~dropped).sum(-1)
        order = order.gather(1, index.minimum(number[:, None] - 1))
        points = references[..., :2].gather(1, order[..., None].expand(-1, -1, 2))
        return {"pts": self.grid.metres_from_front(points), "num_pts": number}


class PivotPredictions(NamedTuple):
    """What the head says after a layer."""

    scores: Tensor  # logits, -inf but for a query's own class (B, N, classes)
    references: Tensor  # (u, v, logit of a pivot) of each point (B, N, P, 3)
    lines: list[Lines]  # by class, (B, n, ...) each, masks as large as the BEV features


def packed(lines: list[Lines]) -> PivotPredictions:
    """Join what a layer says of the lines of each class; ends are pivots whatever it says."""
    scores, references = [], []
    longest = max(own.points.shape[2] for own in lines)
    for label, own in enumerate(lines):
        score = own.logits.new_full((*own.logits.shape[:2], len(lines)), -torch.inf)
        score[..., label] = own.logits[..., LINE] - own.logits[..., 1 - LINE]
        scores.append(score)
        pivot = own.point_logits[..., PIVOT] - own.point_logits[..., 1 - PIVOT]
        ends = torch.ones_like(pivot[..., :1])
        pivot = torch.cat([ends, pivot[..., 1:-1], ends], -1)
        both = torch.cat([own.points, pivot[..., None]], -1)
        references.append(F.pad(both, (0, 0, 0, longest - own.points.shape[2]), value=-1.0))
    return PivotPredictions(torch.cat(scores, 1), torch.cat(references, 1), lines)


@MODELS.register_module()
class PivotHead(DetectionHead):
    """Predict lines of classes that have queries and numbers of points of their own (PivotNet).

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        queries: Lines of each class, and points of each line.
        decoder: Settings of `PointLineDecoder`.
        mask_pixel_m: Side of a pixel of the losses' masks in metres, as in `FormatPivotTargets`.
        losses: Settings of `PivotLosses`.
        layer_weights: Weights of the losses of decoder layers; of fewer layers, the last ones.
        level_weights: Weights of the class masks of BEV levels; of fewer levels, the last ones.
        score_threshold: Lines of at most this score are dropped: 0.5 as long as there are just
            lines and none.
        embed_dims: Channels C.

    Raises:
        ValueError: If queries do not fit the classes, or layers have no weight.
    """

    transforms = ("FormatPivotTargets",)

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        queries: Sequence[tuple[int, int]] = ((20, 10), (25, 2), (15, 30)),
        decoder: PARTS | None = None,
        mask_pixel_m: float = 0.15,
        losses: PARTS | None = None,
        layer_weights: Sequence[float] = LAYER_WEIGHTS,
        level_weights: Sequence[float] = LEVEL_WEIGHTS,
        score_threshold: float = 0.5,
        embed_dims: int = 256,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if len(queries) != len(classes) or any(n < 1 or p < 2 for n, p in queries):
            raise ValueError(
                "queries must be lines (>= 1) and their points (>= 2) for each of "
                f"{list(classes)}, got {list(queries)}."
            )
        self.grid, self.classes, self.losses = grid, tuple(classes), PivotLosses(**(losses or {}))
        self.mask_size = front_size(grid.rasterized(mask_pixel_m))
        own = {"type": "PointLineDecoder", "queries": queries, "embed_dims": embed_dims}
        self.decoder: PointLineDecoder = MODELS.build({**own, **(decoder or {})})
        num_layers = len(self.decoder.layers)
        if not 0 < num_layers <= len(layer_weights):
            raise ValueError(
                f"layer_weights must hold one for each of {num_layers} layers, got {layer_weights}."
            )
        self.layer_weights, self.level_weights = layer_weights[-num_layers:], level_weights
        self.reference = PivotReference(grid)
        self.coder = MapCoder(grid, sum(n for n, _ in queries), None, score_threshold)
        dims, both = embed_dims, 2 * _POINT_DIMS
        self.semantic_branches, self.point_branches, self.kind_branches = (
            nn.ModuleList(make() for _ in classes)
            for make in (
                lambda: nn.Conv2d(dims, 2, 1),
                lambda: mlp(dims, dims, dims, both),
                lambda: mlp(both, both, both, 2),
            )
        )
        convs = [nn.Conv2d(a, b, 1) for a, b in ((2, 256), (256, 256), (256, _POINT_DIMS))]
        self.coordinates = nn.Sequential(convs[0], nn.ReLU(), convs[1], nn.ReLU(), convs[2])

    def coordinate_feature(self) -> Tensor:
        """Return the mean of the coordinates' features over the map. (64,)

        Differs from the paper, as released: points see the map's coordinates through this mean.
        """
        device = self.decoder.query.weight.device
        rows, cols = (torch.arange(n, device=device) / n for n in self.mask_size)
        places = torch.stack(torch.meshgrid(cols, rows, indexing="xy"))  # (2, H, W)
        hidden = self.coordinates[:-1](places[None]).mean((2, 3), keepdim=True)
        return self.coordinates[-1](hidden).flatten()

    def forward(self, bev_outputs: Tensors) -> list[PivotPredictions]:
        """Predict the lines after every decoder layer, from ``bev_feats`` (B, C, H, W)."""
        layers = self.decoder(turned(bev_outputs["bev_feats"], self.grid))[1:]
        mean = self.coordinate_feature().float()
        return [self.predictions(layer, mean) for layer in layers]

    def predictions(self, layer: Sequence[ClassLines], mean: Tensor) -> PivotPredictions:
        """Return the points, kinds and scores of a layer's lines."""
        lines = []
        branches = zip(layer, self.point_branches, self.kind_branches, strict=True)
        for own, point_branch, kind_branch in branches:
            feature = point_branch(own.states).float()
            points = (feature.unflatten(-1, (2, _POINT_DIMS)) @ mean).sigmoid()  # (B, n, p, 2)
            kinds = kind_branch(feature).float()
            lines.append(Lines(own.logits.float(), points, kinds, own.masks.float()))
        return packed(lines)

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Run the head and return its losses, sums of all layers."""
        outputs = self(bev_outputs)
        levels = bev_outputs.get("bev_levels") or [bev_outputs["bev_feats"]]
        weights = self.level_weights[-len(levels) :]
        tokens = [str(sample.metainfo.get("token")) for sample in batch_data_samples]
        with torch.autocast(levels[0].device.type, enabled=False):
            truths = [self.truth(sample) for sample in batch_data_samples]
            losses = self.line_losses(outputs, truths, tokens)[0]
            semantic: Any = sum(
                weight * self.semantic_loss(self.class_masks(level), truths)
                for weight, level in zip(weights, levels, strict=True)
            )
        losses["semantic"] = semantic / (len(levels) * len(self.classes))
        return {f"loss_{name}": value for name, value in losses.items()}

    def truth(self, sample: Any) -> list[TrueLines]:
        """Return a sample's annotated lines, by class; ValueError if they are not of this head."""
        instances = getattr(sample, "gt_instances_3d", ())
        if "num_pts" not in instances or "masks" not in instances:
            raise ValueError(
                f"sample {sample.metainfo.get('token')!r} has no pivots: put FormatPivotTargets in "
                "place of FormatMapTargets into the training pipeline."
            )
        return true_lines(instances, self.grid, self.decoder.queries, self.mask_size)

    def line_losses(
        self,
        outputs: Sequence[PivotPredictions],
        truths: Sequence[Sequence[TrueLines]],
        tokens: Sequence[str],
    ) -> tuple[Tensors, list[list[Any]]]:
        """Return the losses of all layers and classes, and the matches of each."""
        totals: Tensors = {}
        found: list[list[Any]] = []
        number = len(outputs) * len(self.classes)
        for weight, layer in zip(self.layer_weights, outputs, strict=True):
            found.append([])
            for label, lines in enumerate(layer.lines):
                masks = self.enlarged(lines.masks)
                samples = [
                    (Lines(*own), truth[label], token)
                    for own, truth, token in zip(
                        zip(*lines[:3], masks, strict=True), truths, tokens, strict=True
                    )
                ]
                losses, matches = self.losses.of_class(samples)
                found[-1].append(matches)
                for name, value in losses.items():
                    totals[name] = totals.get(name, 0) + weight * value / number
        return totals, found

    def class_masks(self, bev_feats: Tensor) -> Tensor:
        """Return the logits of the classes' masks. (B, C, H, W) -> (B, classes, rows, columns)"""
        front = turned(bev_feats, self.grid)
        # of the two channels of each class, the release trains the second alone
        return self.enlarged(torch.cat([conv(front)[:, 1:] for conv in self.semantic_branches], 1))

    def semantic_loss(self, logits: Tensor, truths: Sequence[Sequence[TrueLines]]) -> Tensor:
        """Return the weighted loss of one BEV level, summed over the classes."""
        terms = []
        for masks, truth in zip(logits.float(), truths, strict=True):
            for mask, own in zip(masks, truth, strict=True):
                drawn = own.masks.sum(0).clamp(max=1)
                terms.append(mask_distances(mask[None], drawn[None]).sum())
        return self.losses.semantic * torch.stack(terms).sum() / len(truths)

    def enlarged(self, masks: Tensor) -> Tensor:
        """Enlarge masks to the size of the targets. (B, n, h, w) -> (B, n, H, W)"""
        return F.interpolate(masks.float(), self.mask_size, mode="bilinear", align_corners=True)


def true_lines(
    instances: Any, grid: BEVGrid, queries: Sequence[tuple[int, int]], size: tuple[int, int]
) -> list[TrueLines]:
    """Return annotated lines by class.

    ValueError if they have more pivots than predictions have points, or masks of another size.
    """
    labels, numbers = instances["labels_3d"], instances["num_pts"]
    if tuple(instances["masks"].shape[1:]) != tuple(size):
        raise ValueError(
            f"masks of FormatPivotTargets are {tuple(instances['masks'].shape[1:])}, the head's "
            f"{tuple(size)}: set pixel_m there to the head's mask_pixel_m."
        )
    pivots = grid.front_from_metres(instances["pts"].float())
    found = []
    for label, (_, most) in enumerate(queries):
        own = labels == label
        if (numbers[own] > most).any():
            raise ValueError(
                f"a line of class {label} has {int(numbers[own].max())} pivots, but the head has "
                f"{most} points: set num_points of FormatPivotTargets to those of its queries."
            )
        found.append(TrueLines(pivots[own, :most], numbers[own], instances["masks"][own].float()))
    return found
