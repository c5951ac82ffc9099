"""PivotNet's losses of one map class: lines, masks, pivots and collinear points.

Pivots are the vertices of map elements. Collinear points lie on the segments between pivots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.models.base.matching import solve_assignment
from gsmap.models.lines.losses import Case, LineLosses
from gsmap.models.pivotnet.matching import match_pivots, sequence_costs
from gsmap.structures.tensors import constant

PIVOT = 1  # index of a pivot's logit; the other logit is of a collinear point


class Lines(NamedTuple):
    """Predicted lines of one class, in one sample (n, ...) or in a batch (B, n, ...)."""

    logits: Tensor  # logits of a line and of no line (n, 2)
    points: Tensor  # (from the front, from the left) in [0, 1] (n, p, 2)
    point_logits: Tensor  # logits of a collinear point and of a pivot (n, p, 2)
    masks: Tensor  # logits (n, H, W)


class TrueLines(NamedTuple):
    """Annotated lines of one class in one sample."""

    pivots: Tensor  # (from the front, from the left) in [0, 1]; unused ones at the end (K, P, 2)
    numbers: Tensor  # number of pivots (K,)
    masks: Tensor  # 0 and 1, float (K, H, W)


class Pairs(NamedTuple):
    """Matched lines of a case, which is one class in one sample."""

    rows: Tensor  # indices of the predicted lines (M,)
    cols: Tensor  # indices of the annotated lines (M,)
    is_pivot: Tensor  # True for points that are matched with a pivot (M, p)
    target_points: Tensor  # evenly spaced between pivots (M, p, 2)


@dataclass(frozen=True)
class PivotLosses(LineLosses):
    """PivotNet's losses and matching costs with their weights, by default as in the released code.

    Args:
        cls: Weight of the class in matching and loss.
        mask: Weight of the masks of lines in matching and loss.
        semantic: Weight of the masks of whole classes in the loss.
        none_weight: Weight of predictions without a matched line in the class loss.
        pivots: Weight of the matched pivots in the loss. In matching, weight of the mean difference
            between the pivots of a line and the points that are paired with them in order.
        collinear: Weight of the points between pivots in the loss.
        point_cls: Weight of the classification of points as pivots in the loss.
        end_weight: Additional weight of a line's ends among its pivots, in matching and loss.
        between_weight: Weight of points between pivots in ``point_cls``.
        point_cls_per_line: Whether ``point_cls`` is divided by the number of lines, as in the
            released code.
    """

    pivots: float = 30.0
    collinear: float = 10.0
    point_cls: float = 2.0
    end_weight: float = 5.0
    between_weight: float = 0.2
    point_cls_per_line: bool = True

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Compute the inputs of the matching of a case.

        Returns:
            Weighted costs of class and mask (2, n, K), differences ``|du| + |dv|`` of pivots and
            points (n, K, P, p), pivots (K, P, 2) and their numbers (K,).
        """
        pivots = case.truth.pivots
        offsets = pivots[None, :, :, None] - case.lines.points[:, None, None]  # (n, K, P, p, 2)
        differences = offsets.abs().sum(dim=-1)
        return self.line_costs(case), differences, pivots, case.truth.numbers

    def pairs(self, case: Case, costs: list[Tensor]) -> Pairs:
        """Match a case by its `costs`, on the CPU."""
        line_costs, differences, pivots, numbers = (part.double().numpy() for part in costs)
        counts = numbers.astype(int)
        sequences = sequence_costs(differences, counts, end_weight=self.end_weight)
        total = np.concatenate([line_costs, self.pivots * sequences[None]])
        names = ["class scores", "masks", "pivots"]
        rows, cols = solve_assignment(
            torch.from_numpy(total), names, img_meta={"token": case.token}
        )
        num_points = differences.shape[-1]
        is_pivot = torch.zeros(len(rows), num_points, dtype=torch.bool)
        target_points = torch.zeros(len(rows), num_points, 2)
        points = np.arange(num_points)
        for pair, (row, col) in enumerate(zip(rows.tolist(), cols.tolist(), strict=True)):
            line = pivots[col, : counts[col]]
            # `path` contains the index of the point that is matched with each pivot, ascending.
            path = match_pivots(differences[row, col, : len(line)])
            is_pivot[pair, path] = True
            # The targets of the points between two pivots are spaced evenly between them.
            u = np.interp(points, path, line[:, 0])
            v = np.interp(points, path, line[:, 1])
            target_points[pair] = torch.from_numpy(np.stack([u, v], axis=-1))
        return Pairs(rows, cols, is_pivot=is_pivot, target_points=target_points)

    def __call__(self, cases: Sequence[Case], matches: Sequence[Pairs]) -> dict[str, Tensor]:
        """Compute the weighted losses of one layer and class.

        Args:
            cases: Lines of the class in each sample.
            matches: Matched lines of each case.

        Returns:
            ``mask``, ``pivots`` and ``collinear``, divided by the number of annotated lines,
            ``cls``, and ``point_cls``, divided by this number if ``point_cls_per_line``.
        """
        num_annotated = 0
        rows = []
        mask_distances = []
        line_points = []
        line_logits = []
        pivot_masks = []
        expected_points = []
        for case, pairs in zip(cases, matches, strict=True):
            num_annotated += len(case.truth.numbers)
            rows.append(pairs.rows)
            mask_distances.append(case.mask_distances[pairs.rows, pairs.cols])
            line_points.append(case.lines.points[pairs.rows])
            line_logits.append(case.lines.point_logits[pairs.rows])
            pivot_masks.append(pairs.is_pivot)
            expected_points.append(pairs.target_points)
        number = max(num_annotated, 1)
        logits = torch.cat(line_logits)  # (M, p, 2)
        is_pivot = torch.cat(pivot_masks)
        offsets = (torch.cat(line_points) - torch.cat(expected_points)).abs().sum(dim=-1)  # (M, p)
        weight = is_pivot.float()
        weight[:, [0, -1]] += self.end_weight  # the ends of a line, which are always pivots
        is_between = (~is_pivot).float()
        pivots = (offsets * weight).sum(dim=1) / weight.sum(dim=1)
        collinear = (offsets * is_between).sum(dim=1) / is_between.sum(dim=1).clamp(min=1)
        point_cls = logits.sum()  # 0 without pairs
        if len(logits):
            class_weights = constant(logits, [self.between_weight, 1.0])
            target = is_pivot.flatten().long()
            point_cls = F.cross_entropy(logits.flatten(0, 1), target, weight=class_weights)
        point_cls_divisor = number if self.point_cls_per_line else 1
        return {
            "mask": self.mask * torch.cat(mask_distances).sum() / number,
            "pivots": self.pivots * pivots.sum() / number,
            "collinear": self.collinear * collinear.sum() / number,
            "cls": self.class_loss(cases, rows),
            "point_cls": self.point_cls * point_cls / point_cls_divisor,
        }
