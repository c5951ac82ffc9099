"""PivotNet's head: points of lines, of which those that are pivots make the map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.encoders.folded_backbone import tensor_versions
from gsmap.models.maptr.coder import DetectionHead, MapCoder, Samples, Tensors
from gsmap.models.maptr.layers import mlp
from gsmap.models.maptr.parts import PARTS
from gsmap.models.pivotnet.decoder import ClassLines, PointLineDecoder
from gsmap.models.pivotnet.front import front_size, turned
from gsmap.models.pivotnet.losses import (
    LINE,
    PIVOT,
    Case,
    Lines,
    Pairs,
    PivotLosses,
    TrueLines,
    mask_distances,
)
from gsmap.structures.grid import BEVGrid

_POINT_DIMS = 64  # channels of each coordinate of a point
# of the losses of decoder layers, and of the class masks of BEV levels; of fewer, the last ones
LAYER_WEIGHTS = (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)
LEVEL_WEIGHTS = (0.4, 0.8, 1.6, 2.4)


@dataclass(frozen=True)
class PivotReference:
    """What points are: (u, v, logit of a pivot), and the lines that pivots make."""

    grid: BEVGrid
    outputs = ("pts", "num_pts")
    space = None
    metainfo: ClassVar[dict[str, Any]] = {}

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
        score = own.logits[..., LINE, None] - own.logits[..., 1 - LINE, None]
        scores.append(F.pad(score, (label, len(lines) - 1 - label), value=-torch.inf))
        pivot = own.point_logits[..., PIVOT, None] - own.point_logits[..., 1 - PIVOT, None]
        ends = torch.ones_like(pivot[:, :, :1])
        pivot = torch.cat([ends, pivot[:, :, 1:-1], ends], 2)
        both = torch.cat([own.points, pivot], -1)
        references.append(F.pad(both, (0, 0, 0, longest - both.shape[2]), value=-1.0))
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
        score_threshold: Lines of at most this score are dropped: 0.5 as long as there are just
            lines and none.
        embed_dims: Channels C.

    Raises:
        ValueError: If queries do not fit the classes, or there are more layers than weights.
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
        if not 0 < num_layers <= len(LAYER_WEIGHTS):
            raise ValueError(
                f"decoder.num_layers must be 1 to {len(LAYER_WEIGHTS)}, which have weights in the "
                f"losses, got {num_layers}."
            )
        self.layer_weights = LAYER_WEIGHTS[-num_layers:]
        self.reference = PivotReference(grid)
        self.coder = MapCoder(grid, sum(n for n, _ in queries), None, score_threshold)
        dims, both = [embed_dims] * 3, 2 * _POINT_DIMS
        self.semantic_branches = nn.ModuleList(nn.Conv2d(embed_dims, 2, 1) for _ in classes)
        self.point_branches = nn.ModuleList(mlp(*dims, both) for _ in classes)
        self.kind_branches = nn.ModuleList(mlp(both, both, both, 2) for _ in classes)
        convs = [nn.Conv2d(a, b, 1) for a, b in ((2, 256), (256, 256), (256, _POINT_DIMS))]
        self.coordinates = nn.Sequential(convs[0], nn.ReLU(), convs[1], nn.ReLU(), convs[2])
        self._kept: tuple[Any, Tensor] | None = None  # state of the weights, their feature

    def coordinate_feature(self) -> Tensor:
        """Return the mean of the coordinates' features over the map, kept in inference. (64,)

        Differs from the paper, as released: points see the map's coordinates through this mean.
        """
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            return self._mean_feature()
        state = tensor_versions(self.coordinates)
        if self._kept is None or self._kept[0] != state:
            self._kept = state, self._mean_feature()
        return self._kept[1]

    def _mean_feature(self) -> Tensor:
        """Return the mean of the coordinates' features over the map. (64,)"""
        device = self.decoder.query.weight.device
        rows, cols = (torch.arange(n, device=device) / n for n in self.mask_size)
        places = torch.stack(torch.meshgrid(cols, rows, indexing="xy"))  # (2, H, W)
        hidden = self.coordinates[:-1](places[None]).mean((2, 3), keepdim=True)
        return self.coordinates[-1](hidden).flatten().float()

    def forward(self, bev_outputs: Tensors) -> list[PivotPredictions]:
        """Predict the lines after every decoder layer, from ``bev_feats`` (B, C, H, W)."""
        layers = self.decoder(turned(bev_outputs["bev_feats"], self.grid))[1:]
        mean = self.coordinate_feature()
        return [self.predictions(layer, mean) for layer in layers]

    def predictions(self, layer: Sequence[ClassLines], mean: Tensor) -> PivotPredictions:
        """Return the points, kinds and scores of a layer's lines."""
        lines = []
        parts = zip(layer, self.point_branches, self.kind_branches, strict=True)
        for own, point_branch, kind_branch in parts:
            feature = point_branch(own.states).float()
            points = (feature.unflatten(-1, (2, _POINT_DIMS)) @ mean).sigmoid()  # (B, n, p, 2)
            kinds = kind_branch(feature).float()
            lines.append(Lines(own.logits.float(), points, kinds, own.masks.float()))
        return packed(lines)

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Run the head and return its losses, sums of all layers."""
        outputs, feats = self(bev_outputs), bev_outputs["bev_feats"]
        tokens = [str(sample.metainfo.get("token")) for sample in batch_data_samples]
        with torch.autocast(feats.device.type, enabled=False):
            truths = [self.truth(sample) for sample in batch_data_samples]
            losses, _ = self.line_losses(outputs, truths, tokens)
            levels = [self.class_masks(level) for level in bev_outputs.get("bev_levels", [feats])]
            losses["semantic"] = self.semantic_loss(levels, truths)
        return {f"loss_{name}": value for name, value in losses.items()}

    def truth(self, sample: Det3DDataSample) -> list[TrueLines]:
        """Return a sample's annotated lines, by class; ValueError if they are not of this head."""
        instances = sample.get("gt_instances_3d", InstanceData())
        if "num_pts" not in instances or "masks" not in instances:
            raise ValueError(
                f"sample {sample.metainfo.get('token')!r} has no pivots: put FormatPivotTargets in "
                "place of FormatMapTargets into the training pipeline."
            )
        labels, numbers, masks = instances.labels_3d, instances.num_pts, instances.masks
        if tuple(masks.shape[1:]) != self.mask_size:
            raise ValueError(
                f"masks of FormatPivotTargets are {tuple(masks.shape[1:])}, the head's "
                f"{self.mask_size}: set pixel_m there to the head's mask_pixel_m."
            )
        pivots, found = self.grid.front_from_metres(instances.pts.float()), []
        for label, (_, most) in enumerate(self.decoder.queries):
            own = labels == label
            if (numbers[own] > most).any():
                raise ValueError(
                    f"a line of class {label} has {int(numbers[own].max())} pivots, but the head "
                    f"has {most} points: set num_points of FormatPivotTargets to those of its "
                    "queries."
                )
            found.append(TrueLines(pivots[own, :most], numbers[own], masks[own].float()))
        return found

    def line_losses(
        self,
        outputs: Sequence[PivotPredictions],
        truths: Sequence[Sequence[TrueLines]],
        tokens: Sequence[str],
    ) -> tuple[Tensors, list[list[Pairs]]]:
        """Return the losses of all layers and classes, and the pairs of each and every sample."""
        groups = [
            self.cases(lines, [truth[label] for truth in truths], tokens)
            for layer in outputs
            for label, lines in enumerate(layer.lines)
        ]
        pairs = iter(self.losses.match([case for group in groups for case in group]))
        matches = [[next(pairs) for _ in group] for group in groups]
        totals: Tensors = {}
        weights = [w / len(groups) for w in self.layer_weights for _ in self.classes]
        for weight, group, matched in zip(weights, groups, matches, strict=True):
            for name, value in self.losses(group, matched).items():
                totals[name] = totals.get(name, 0) + weight * value
        return totals, matches

    def cases(self, lines: Lines, truths: Sequence[TrueLines], tokens: Sequence[str]) -> list[Case]:
        """Return a layer's lines of a class by sample, with what is annotated."""
        samples = zip(*lines[:3], self.enlarged(lines.masks), truths, tokens, strict=True)
        return [
            Case(Lines(*own), truth, mask_distances(own[3], truth.masks), token)
            for *own, truth, token in samples
        ]

    def class_masks(self, bev_feats: Tensor) -> Tensor:
        """Return the logits of the classes' masks. (B, C, H, W) -> (B, classes, rows, columns)"""
        front = turned(bev_feats, self.grid)
        # of the two channels of each class, the release trains the second alone
        return self.enlarged(torch.cat([conv(front)[:, 1:] for conv in self.semantic_branches], 1))

    def semantic_loss(
        self, levels: Sequence[Tensor], truths: Sequence[Sequence[TrueLines]]
    ) -> Tensor:
        """Return the loss of the class masks of all BEV levels (B, classes, H, W)."""
        drawn = [torch.stack([own.masks.sum(0).clamp(max=1) for own in truth]) for truth in truths]
        terms = [
            weight * mask_distances(masks, own).diagonal().mean()
            for weight, level in zip(LEVEL_WEIGHTS[-len(levels) :], levels, strict=True)
            for masks, own in zip(level, drawn, strict=True)
        ]
        return self.losses.semantic * torch.stack(terms).mean()

    def enlarged(self, masks: Tensor) -> Tensor:
        """Enlarge masks to the size of the targets. (B, n, h, w) -> (B, n, H, W)"""
        return F.interpolate(masks.float(), self.mask_size, mode="bilinear", align_corners=True)
