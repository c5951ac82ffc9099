"""PivotNet's losses of one map class: lines, their masks, pivots and the points between."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.models.base.matching import assigned
from gsmap.models.lines.losses import Case, LineLosses
from gsmap.models.pivotnet.matching import match_pivots, sequence_costs
from gsmap.structures.tensors import constant

PIVOT = 1  # the place of its logit; the other one is of a point between


class Lines(NamedTuple):
    """Predicted lines of one class, in one sample (n, ...) or in a batch (B, n, ...)."""

    logits: Tensor  # of a line and of none (n, 2)
    points: Tensor  # [0, 1] from the front and from the left (n, p, 2)
    point_logits: Tensor  # of a point between pivots and of a pivot (n, p, 2)
    masks: Tensor  # logits (n, H, W)


class TrueLines(NamedTuple):
    """Annotated lines of one class in one sample."""

    pivots: Tensor  # [0, 1] from the front and from the left; beyond their number unused (K, P, 2)
    numbers: Tensor  # of pivots (K,)
    masks: Tensor  # 0 and 1, float (K, H, W)


class Pairs(NamedTuple):
    """Matched lines of a case."""

    rows: Tensor  # numbers of the predicted ones (M,)
    cols: Tensor  # and of the annotated ones (M,)
    is_pivot: Tensor  # which points are matched with pivots (M, p)
    expected: Tensor  # where the points should be, evenly spaced between pivots (M, p, 2)


@dataclass(frozen=True)
class PivotLosses(LineLosses):
    """Weights of losses and of matching costs; the defaults are the released ones.

    Further ones are ``cls``, ``mask``, ``semantic`` and ``none_weight`` of `LineLosses`.
    """

    pivots: float = 30.0  # matched pivots, of the matching of sequences too
    collinear: float = 10.0  # points between pivots
    point_cls: float = 2.0  # kind of each point
    end_weight: float = 5.0  # what ends weigh more than other pivots, of matching too
    between_weight: float = 0.2  # points between pivots in ``point_cls``
    point_cls_per_line: bool = True  # divide ``point_cls`` by the number of lines, as released

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Return two costs (2, n, K), |du| + |dv| (n, K, m, p), pivots (K, m, 2), numbers (K,)."""
        pivots = case.truth.pivots
        apart = pivots[None, :, :, None] - case.lines.points[:, None, None]
        return self.line_costs(case), apart.abs().sum(-1), pivots, case.truth.numbers

    def pairs(self, case: Case, costs: list[Tensor]) -> Pairs:
        """Match a case by its `costs`, on the CPU."""
        plain, differences, pivots, numbers = (part.double().numpy() for part in costs)
        counts = numbers.astype(int)
        sequences = self.pivots * sequence_costs(differences, counts, self.end_weight)
        total = torch.from_numpy(np.concatenate([plain, sequences[None]]))
        names = ["class scores", "masks", "pivots"]
        rows, cols = assigned(total, names, {"token": case.token})
        points = np.arange(differences.shape[-1])
        is_pivot = torch.zeros(len(rows), len(points), dtype=torch.bool)
        expected = torch.zeros(*is_pivot.shape, 2)
        for pair, (row, col) in enumerate(zip(rows.tolist(), cols.tolist(), strict=True)):
            line = pivots[col, : counts[col]]
            path = match_pivots(differences[row, col, : len(line)])
            is_pivot[pair, path] = True
            places = np.stack([np.interp(points, path, axis) for axis in line.T], -1)
            expected[pair] = torch.from_numpy(places)
        return Pairs(rows, cols, is_pivot, expected)

    def __call__(self, cases: Sequence[Case], matches: Sequence[Pairs]) -> dict[str, Tensor]:
        """Return the weighted losses of a layer and class, from the cases of all samples."""
        number = max(sum(len(case.truth.numbers) for case in cases), 1)
        both = list(zip(cases, matches, strict=True))
        masks = torch.cat([case.apart[pairs.rows, pairs.cols] for case, pairs in both])
        points = torch.cat([case.lines.points[pairs.rows] for case, pairs in both])
        kinds = torch.cat([case.lines.point_logits[pairs.rows] for case, pairs in both])
        is_pivot = torch.cat([pairs.is_pivot for pairs in matches])
        offsets = (points - torch.cat([pairs.expected for pairs in matches])).abs().sum(-1)
        weight = is_pivot.float()
        weight[:, [0, -1]] += self.end_weight
        between = (~is_pivot).float()
        collinear = (offsets * between).sum(1) / between.sum(1).clamp(min=1)
        point_cls = kinds.sum()  # 0 without pairs
        if len(kinds):
            classes = constant(kinds, [self.between_weight, 1.0])
            point_cls = F.cross_entropy(kinds.flatten(0, 1), is_pivot.flatten().long(), classes)
        return {
            "mask": self.mask * masks.sum() / number,
            "pivots": self.pivots * ((offsets * weight).sum(1) / weight.sum(1)).sum() / number,
            "collinear": self.collinear * collinear.sum() / number,
            "cls": self.class_loss(cases, [pairs.rows for pairs in matches]),
            "point_cls": self.point_cls * point_cls / (number if self.point_cls_per_line else 1),
        }
