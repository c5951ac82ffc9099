"""PivotNet's losses of one map class: lines, masks, pivots and collinear points.

Pivots are the vertices of map elements. Collinear points lie on the segments between pivots. Each
pivot of an annotated line is matched with one point of the predicted line. The other points of the
predicted line are collinear points.
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
    """Predicted lines of one class, in one sample (n, ...) or in a batch (B, n, ...).

    A point is (u, v): its distances from the front and from the left edge of the map, as shares of
    the extent.
    """

    logits: Tensor  # logits of a line and of no line (n, 2)
    points: Tensor  # (u, v) in [0, 1] (n, p, 2)
    point_logits: Tensor  # logits of a collinear point and of a pivot (n, p, 2)
    masks: Tensor  # logits of the masks of lines (n, H, W)


class TrueLines(NamedTuple):
    """Annotated lines of one class in one sample."""

    pivots: Tensor  # (u, v) in [0, 1] as in `Lines`; unused ones at the end of a row (K, P, 2)
    numbers: Tensor  # number of pivots of each line (K,)
    masks: Tensor  # 0 and 1, float (K, H, W)


class Pairs(NamedTuple):
    """Matched lines of a case, which is one class in one sample."""

    rows: Tensor  # indices of the predicted lines (M,)
    cols: Tensor  # indices of the annotated lines (M,)
    is_pivot: Tensor  # True for points that are matched with a pivot (M, p)
    target_points: Tensor  # target (u, v) of each point, evenly spaced between pivots (M, p, 2)


@dataclass(frozen=True)
class PivotLosses(LineLosses):
    """PivotNet's losses and matching costs with their weights, by default as in the released code.

    Args:
        cls: Weight of the classification as line or no line in matching and loss.
        mask: Weight of the masks of lines in matching and loss.
        semantic: Weight of the masks of whole classes in the loss.
        none_weight: Weight, in the loss of ``cls``, of predictions without a matched line.
        pivots: Weight of the matched pivots in the loss. In matching, weight of the mean difference
            between the pivots of a line and the points that are paired with them in order.
        collinear: Weight of the points between pivots in the loss.
        point_cls: Weight of the classification of points as pivot or collinear in the loss.
        end_weight: Additional weight of a line's ends, in matching and in the loss of ``pivots``.
            Other pivots have the weight 1.
        between_weight: Weight, in the loss of ``point_cls``, of collinear points. Pivots have the
            weight 1.
        point_cls_per_line: Whether the loss of ``point_cls``, a mean over points, is also divided
            by the number of annotated lines, as in the released code.
    """

    pivots: float = 30.0
    collinear: float = 10.0
    point_cls: float = 2.0
    end_weight: float = 5.0
    between_weight: float = 0.2
    point_cls_per_line: bool = True

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Compute the inputs of the matching of a case.

        The base class copies the inputs of all cases to the CPU and passes them to `pairs`.

        Args:
            case: Lines of one class in one sample: ``lines`` (`Lines`) and ``truth`` (`TrueLines`).

        Returns:
            Weighted costs of class and mask (2, n, K), differences ``|du| + |dv|`` of pivots and
            points (n, K, P, p), pivots (K, P, 2) and their numbers (K,).
        """
        pivots = case.truth.pivots
        # Of each point of each predicted line from each pivot of each annotated line.
        offsets = pivots[None, :, :, None] - case.lines.points[:, None, None]  # (n, K, P, p, 2)
        differences = offsets.abs().sum(dim=-1)
        return self.line_costs(case), differences, pivots, case.truth.numbers

    def pairs(self, case: Case, costs: list[Tensor]) -> Pairs:
        """Match a case by its `costs`, on the CPU.

        Args:
            case: Lines of one class in one sample.
            costs: Result of `costs`, on the CPU.

        Returns:
            The matched lines, on the CPU.

        Raises:
            FloatingPointError: If a cost is not finite. This includes annotated lines with more
                pivots than a predicted line has points.
        """
        line_costs, differences, pivots, numbers = (tensor.double().numpy() for tensor in costs)
        counts = numbers.astype(int)
        # Mean difference of the pivots from the points that they are matched with. (n, K)
        pivot_costs = sequence_costs(differences, counts, end_weight=self.end_weight)
        all_costs = np.concatenate([line_costs, self.pivots * pivot_costs[None]])  # (3, n, K)
        names = ["class scores", "masks", "pivots"]  # for the message if a cost is not finite
        # The assignment has the least sum of all costs.
        rows, cols = solve_assignment(
            torch.from_numpy(all_costs), names, img_meta={"token": case.token}
        )
        num_points = differences.shape[-1]
        is_pivot = torch.zeros(len(rows), num_points, dtype=torch.bool)
        target_points = torch.zeros(len(rows), num_points, 2)
        point_indices = np.arange(num_points)
        for pair, (row, col) in enumerate(zip(rows.tolist(), cols.tolist(), strict=True)):
            line = pivots[col, : counts[col]]  # without unused pivots
            # `path` contains the index of the point that is matched with each pivot, ascending.
            path = match_pivots(differences[row, col, : len(line)])
            is_pivot[pair, path] = True
            # The targets of the points between two pivots are spaced evenly between them.
            u = np.interp(point_indices, path, line[:, 0])
            v = np.interp(point_indices, path, line[:, 1])
            target_points[pair] = torch.from_numpy(np.stack([u, v], axis=-1))
        return Pairs(rows, cols, is_pivot=is_pivot, target_points=target_points)

    def __call__(self, cases: Sequence[Case], matches: Sequence[Pairs]) -> dict[str, Tensor]:
        """Compute the weighted losses of one layer and class.

        Args:
            cases: Lines of the class in each sample.
            matches: Matched lines of each case.

        Returns:
            ``mask``, ``pivots``, ``collinear``, ``cls`` and ``point_cls``, all scalars. The first
            three are sums over the matched lines, divided by the number of annotated lines. The
            last one is also divided by this number if ``point_cls_per_line``.
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
        num_lines = max(num_annotated, 1)  # 1 avoids a division by 0
        logits = torch.cat(line_logits)  # (M, p, 2)
        is_pivot = torch.cat(pivot_masks)
        offsets = (torch.cat(line_points) - torch.cat(expected_points)).abs().sum(dim=-1)  # (M, p)
        weight = is_pivot.float()
        # The first and the last point are the ends of a line, which are always pivots.
        weight[:, [0, -1]] += self.end_weight
        is_between = (~is_pivot).float()
        pivots = (offsets * weight).sum(dim=1) / weight.sum(dim=1)
        collinear = (offsets * is_between).sum(dim=1) / is_between.sum(dim=1).clamp(min=1)
        point_cls = logits.sum()  # 0 with a gradient if there are no pairs
        if len(logits):
            class_weights = constant(logits, [self.between_weight, 1.0])  # collinear, pivot
            target = is_pivot.flatten().long()
            point_cls = F.cross_entropy(logits.flatten(0, 1), target, weight=class_weights)
        point_cls_divisor = num_lines if self.point_cls_per_line else 1
        return {
            "mask": self.mask * torch.cat(mask_distances).sum() / num_lines,
            "pivots": self.pivots * pivots.sum() / num_lines,
            "collinear": self.collinear * collinear.sum() / num_lines,
            "cls": self.class_loss(cases, rows),
            "point_cls": self.point_cls * point_cls / point_cls_divisor,
        }
