"""PivotNet's head. It predicts lines of points, and which points are pivots (vertices)."""

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
from gsmap.models.base.parts import PartConfig
from gsmap.models.base.references import Reference
from gsmap.models.lines.decoder import ClassLines
from gsmap.models.lines.head import LineHead, LinePredictions, class_scores
from gsmap.models.pivotnet.losses import PIVOT, Lines, PivotLosses, TrueLines
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class PivotReference(Reference):
    """References (u, v, logit): a point, with u and v in [0, 1], and its logit of being a pivot.

    Args:
        grid: Extent of the map, in metres.
    """

    grid: BEVGrid
    outputs = ("pts", "num_pts")

    def decode(self, references: Tensor) -> Tensors:
        """Select the pivots of each line in order. Pivots are the points with a positive logit.

        Args:
            references: Points (u from the front, v from the left) with logits. (N, P, 3)

        Returns:
            ``pts``, the pivots in metres, where the last pivot is repeated up to P points
            (N, P, 2), and ``num_pts``, the number of pivots of each line (N,).
        """
        is_dropped = references[..., 2] <= 0
        index = torch.arange(is_dropped.shape[1], device=is_dropped.device)
        sort_keys = index + is_dropped * len(index)  # pivots first, then the others, in order
        order = sort_keys.argsort(dim=-1)
        num_pivots = (~is_dropped).sum(dim=-1)
        last_pivot = num_pivots[:, None] - 1
        # Each line has a pivot, because its ends are pivots. The last pivot is repeated.
        order = order.gather(1, index.minimum(last_pivot))
        points = references[..., :2].gather(1, order[..., None].expand(-1, -1, 2))
        return {"pts": self.grid.metres_from_front(points), "num_pts": num_pivots}


def pack_lines(lines: list[Lines]) -> LinePredictions:
    """Join the lines of all classes to predictions. The ends of a line are always pivots.

    A reference is a point (u, v) with the logit of being a pivot, for `PivotReference.decode`. The
    classes have different numbers of points p, so all lines are filled to the largest number P.
    """
    longest = max(class_lines.points.shape[2] for class_lines in lines)
    references = []
    logits = []
    for class_lines in lines:
        # One logit of being a pivot, at the index `PIVOT`, and one of being no pivot. (B, n, p, 2)
        point_logits = class_lines.point_logits
        pivot_logit = point_logits[..., PIVOT, None] - point_logits[..., 1 - PIVOT, None]
        ends = torch.ones_like(pivot_logit[:, :, :1])  # any positive logit makes a pivot
        pivot_logit = torch.cat([ends, pivot_logit[:, :, 1:-1], ends], dim=2)  # (B, n, p, 1)
        reference = torch.cat([class_lines.points, pivot_logit], dim=-1)  # (B, n, p, 3)
        num_missing = longest - reference.shape[2]
        # Rows of -1 fill shorter lines. Their logit is not > 0, so `decode` drops them.
        references.append(F.pad(reference, (0, 0, 0, num_missing), value=-1.0))
        logits.append(class_lines.logits)
    return LinePredictions(
        scores=class_scores(logits), references=torch.cat(references, dim=1), lines=lines
    )


@MODELS.register_module()
class PivotHead(LineHead):
    """Head of PivotNet, with a number of lines and a number of points per line for each class.

    Args:
        grid: Extent of the map, in metres.
        classes: Names of the classes.
        queries: Number of lines and number of points of each line, as a pair for each class.
        decoder: Settings of `PointLineDecoder`.
        losses: Settings of `PivotLosses`.
        embed_dims: Channels C of the points and of the BEV features.
        kwargs: Further arguments of `LineHead`.

    Raises:
        ValueError: If queries do not fit the classes, or if there are more decoder layers than loss
            weights.
    """

    transforms = ("FormatPivotTargets",)
    targets = "pivots"  # for error messages
    level_weights = (0.4, 0.8, 1.6, 2.4)  # of the losses of class masks, by BEV level

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        queries: Sequence[tuple[int, int]] = ((20, 10), (25, 2), (15, 30)),
        decoder: PartConfig | None = None,
        losses: PartConfig | None = None,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        is_too_small = any(num_lines < 1 or num_points < 2 for num_lines, num_points in queries)
        if len(queries) != len(classes) or is_too_small:
            raise InputError(
                "queries must be two numbers for each class, of lines (>= 1) and of points per "
                f"line (>= 2). The classes are {list(classes)}, got {list(queries)}."
            )
        super().__init__(
            grid,
            classes,
            numbers=[num_lines for num_lines, _ in queries],
            decoder={"queries": queries, **(decoder or {})},
            losses=PivotLosses(**(losses or {})),
            embed_dims=embed_dims,
            **kwargs,
        )
        self.reference = PivotReference(grid)
        feature_dims = 2 * self.point_dims  # one vector for u and one for v
        self.point_branches = nn.ModuleList()
        self.kind_branches = nn.ModuleList()  # kinds of points: pivots and others
        # Two loops, because the order of creation determines the random initial weights.
        for _ in classes:
            self.point_branches.append(mlp(embed_dims, embed_dims, embed_dims, feature_dims))
        for _ in classes:
            self.kind_branches.append(mlp(feature_dims, feature_dims, feature_dims, 2))

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of `FormatPivotTargets` that follow from the head's settings."""
        num_points = tuple(num_points for _, num_points in settings["queries"])
        return {"num_points": num_points, **super().target_settings(settings)}

    def predictions(self, layer: Sequence[ClassLines], mean: Tensor) -> LinePredictions:
        """Predict the points, the pivots and the scores of lines.

        Args:
            layer: Lines of each class from one decoder layer.
            mean: Mean over all cells of the map of the D features that encode the coordinates of a
                cell (`LineHead.coordinate_feature`). (D,)
        """
        lines = []
        for label, class_lines in enumerate(layer):
            feature = self.point_branches[label](class_lines.states).float()  # (B, n, p, 2 D)
            points = self.coordinates_of(feature.unflatten(-1, (2, -1)), mean).sigmoid()
            predicted_lines = Lines(
                logits=class_lines.logits.float(),
                points=points,  # (B, n, p, 2)
                point_logits=self.kind_branches[label](feature).float(),
                masks=class_lines.masks.float(),
            )
            lines.append(predicted_lines)
        return pack_lines(lines)

    def truth(self, sample: Det3DDataSample) -> list[TrueLines]:
        """Return the annotated lines of a sample for each class.

        Raises:
            ValueError: If the sample has no targets, or targets that do not fit the head.
        """
        instances = self.line_targets(sample)
        pivots = self.grid.front_from_metres(instances.pts.float())  # (u from front, v from left)
        truths = []
        for label, (_, num_points) in enumerate(self.decoder.queries):
            is_class = instances.labels_3d == label
            num_pivots = instances.num_pts[is_class]
            if (num_pivots > num_points).any():
                raise InputError(
                    f"a line of class {label} has {int(num_pivots.max())} pivots, but the head "
                    f"has {num_points} points: set num_points of FormatPivotTargets to the points "
                    "in the head's queries."
                )
            class_truth = TrueLines(
                pivots=pivots[is_class, :num_points],
                numbers=num_pivots,
                masks=instances.masks[is_class].float(),
            )
            truths.append(class_truth)
        return truths

    def semantic_loss(self, levels: Sequence[Tensor], truths: Sequence[Any]) -> Tensor:
        """Compute the loss of the class masks, averaged over the classes.

        Args:
            levels: Logits of the class masks of each BEV level. (B, classes, H, W) each
            truths: Annotated lines of each class for each sample.

        Returns:
            Weighted scalar.

        Raises:
            ValueError: If there are more levels than ``level_weights``.
        """
        return super().semantic_loss(levels, truths) / len(self.classes)
