"""PivotNet's head: points of lines, of which those that are pivots make the map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.models.base.coder import Tensors
from gsmap.models.base.layers import mlp
from gsmap.models.base.parts import PARTS
from gsmap.models.base.references import Reference
from gsmap.models.lines.decoder import ClassLines
from gsmap.models.lines.head import LineHead, LinePredictions, class_scores
from gsmap.models.pivotnet.losses import PIVOT, Lines, PivotLosses, TrueLines
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class PivotReference(Reference):
    """What points are: (u, v, logit of a pivot), and the lines that pivots make."""

    grid: BEVGrid
    outputs = ("pts", "num_pts")

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


def packed(lines: list[Lines]) -> LinePredictions:
    """Join what a layer says of the lines of each class; ends are pivots whatever it says."""
    references = []
    longest = max(own.points.shape[2] for own in lines)
    for own in lines:
        pivot = own.point_logits[..., PIVOT, None] - own.point_logits[..., 1 - PIVOT, None]
        ends = torch.ones_like(pivot[:, :, :1])
        pivot = torch.cat([ends, pivot[:, :, 1:-1], ends], 2)
        both = torch.cat([own.points, pivot], -1)
        references.append(F.pad(both, (0, 0, 0, longest - both.shape[2]), value=-1.0))
    scores = class_scores([own.logits for own in lines])
    return LinePredictions(scores, torch.cat(references, 1), lines)


@MODELS.register_module()
class PivotHead(LineHead):
    """Predict lines of classes that have queries and numbers of points of their own (PivotNet).

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        queries: Lines of each class, and points of each line.
        decoder: Settings of `PointLineDecoder`.
        losses: Settings of `PivotLosses`.
        embed_dims: Channels C.
        kwargs: Further arguments of `LineHead`.

    Raises:
        ValueError: If queries do not fit the classes, or there are more layers than weights.
    """

    transforms = ("FormatPivotTargets",)
    targets = "pivots"
    level_weights = (0.4, 0.8, 1.6, 2.4)

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        queries: Sequence[tuple[int, int]] = ((20, 10), (25, 2), (15, 30)),
        decoder: PARTS | None = None,
        losses: PARTS | None = None,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        if len(queries) != len(classes) or any(n < 1 or p < 2 for n, p in queries):
            raise InputError(
                "queries must be lines (>= 1) and their points (>= 2) for each of "
                f"{list(classes)}, got {list(queries)}."
            )
        own = {"queries": queries, **(decoder or {})}, PivotLosses(**(losses or {}))
        numbers = [n for n, _ in queries]
        super().__init__(grid, classes, numbers, *own, embed_dims=embed_dims, **kwargs)
        self.reference = PivotReference(grid)
        dims, both = [embed_dims] * 3, 2 * self.point_dims
        self.point_branches = nn.ModuleList(mlp(*dims, both) for _ in classes)
        self.kind_branches = nn.ModuleList(mlp(both, both, both, 2) for _ in classes)

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the head."""
        points = tuple(points for _, points in settings["queries"])
        return {"num_points": points, **super().target_settings(settings)}

    def predictions(self, layer: Sequence[ClassLines], mean: Tensor) -> LinePredictions:
        """Return the points, kinds and scores of a layer's lines."""
        lines = []
        parts = zip(layer, self.point_branches, self.kind_branches, strict=True)
        for own, point_branch, kind_branch in parts:
            feature = point_branch(own.states).float()
            points = (feature.unflatten(-1, (2, -1)) @ mean).sigmoid()  # (B, n, p, 2)
            kinds = kind_branch(feature).float()
            lines.append(Lines(own.logits.float(), points, kinds, own.masks.float()))
        return packed(lines)

    def truth(self, sample: Det3DDataSample) -> list[TrueLines]:
        """Return a sample's annotated lines, by class; ValueError if they are not of this head."""
        instances = self.annotated(sample)
        labels, numbers, masks = instances.labels_3d, instances.num_pts, instances.masks
        pivots, found = self.grid.front_from_metres(instances.pts.float()), []
        for label, (_, most) in enumerate(self.decoder.queries):
            own = labels == label
            if (numbers[own] > most).any():
                raise InputError(
                    f"a line of class {label} has {int(numbers[own].max())} pivots, but the head "
                    f"has {most} points: set num_points of FormatPivotTargets to those of its "
                    "queries."
                )
            found.append(TrueLines(pivots[own, :most], numbers[own], masks[own].float()))
        return found

    def semantic_loss(self, levels: Sequence[Tensor], truths: Sequence[Any]) -> Tensor:
        """Return the loss of the class masks, a mean over the classes. (B, classes, H, W) each"""
        return super().semantic_loss(levels, truths) / len(self.classes)
