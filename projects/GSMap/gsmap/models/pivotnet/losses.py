"""PivotNet's losses of one map class: lines, their masks, pivots and the points between."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.maptr.matching import check_finite
from gsmap.models.pivotnet.lines import LINE
from gsmap.models.pivotnet.matching import Floats, match_pivots, sequence_costs

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


class Case(NamedTuple):
    """Lines of one class in one sample."""

    lines: Lines
    truth: TrueLines
    apart: Tensor  # distances of their masks (n, K)
    token: str


class Pairs(NamedTuple):
    """Matched lines of a case."""

    rows: Tensor  # numbers of the predicted ones (M,)
    cols: Tensor  # and of the annotated ones (M,)
    is_pivot: Tensor  # which points are matched with pivots (M, p)
    expected: Tensor  # where the points should be, evenly spaced between pivots (M, p, 2)


@dataclass(frozen=True)
class PivotLosses:
    """Weights of losses and of matching costs; the defaults are the released ones."""

    cls: float = 2.0  # class, of matching too
    mask: float = 5.0  # masks of lines, of matching too
    pivots: float = 30.0  # matched pivots, of the matching of sequences too
    collinear: float = 10.0  # points between pivots
    point_cls: float = 2.0  # kind of each point
    semantic: float = 3.0  # masks of whole classes
    end_weight: float = 5.0  # what ends weigh more than other pivots, of matching too
    none_weight: float = 0.5  # predictions of no line in ``cls``
    between_weight: float = 0.2  # points between pivots in ``point_cls``
    point_cls_per_line: bool = True  # divide ``point_cls`` by the number of lines, as released

    @torch.no_grad()
    def match(self, cases: Sequence[Case]) -> list[Pairs]:
        """Match the lines of each case; FloatingPointError if a cost is not a number."""
        parts = [part for case in cases for part in self.costs(case)]
        # all in one copy from the device
        values = torch.cat([part.flatten() for part in parts]).cpu().double()
        arrays = [
            own.view(part.shape).numpy()
            for own, part in zip(values.split([p.numel() for p in parts]), parts, strict=True)
        ]
        matched = zip(cases, arrays[::4], arrays[1::4], arrays[2::4], arrays[3::4], strict=True)
        return [self.pairs(*case) for case in matched]

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Return two costs (2, n, K), |du| + |dv| (n, K, m, p), pivots (K, m, 2), numbers (K,)."""
        score = case.lines.logits.softmax(-1)[:, LINE, None].expand_as(case.apart)
        plain = torch.stack([-self.cls * score, self.mask * case.apart])
        pivots = case.truth.pivots
        apart = pivots[None, :, :, None] - case.lines.points[:, None, None]
        return plain, apart.abs().sum(-1), pivots, case.truth.numbers

    def pairs(
        self, case: Case, plain: Floats, differences: Floats, pivots: Floats, numbers: Floats
    ) -> Pairs:
        """Match a case by what `costs` says."""
        counts = numbers.astype(int)
        sequences = self.pivots * sequence_costs(differences, counts, self.end_weight)
        costs = torch.from_numpy(np.concatenate([plain, sequences[None]]))
        check_finite(costs, ["class scores", "masks", "pivots"], {"token": case.token})
        rows, cols = linear_sum_assignment(costs.sum(0).numpy())
        points = np.arange(differences.shape[-1])
        is_pivot, expected = (
            np.zeros((len(rows), len(points))),
            np.zeros((len(rows), len(points), 2)),
        )
        for pair, (row, col) in enumerate(zip(rows, cols, strict=True)):
            line = pivots[col, : counts[col]]
            path = match_pivots(differences[row, col, : len(line)])
            is_pivot[pair, path] = 1
            expected[pair] = np.stack([np.interp(points, path, axis) for axis in line.T], -1)
        found = rows, cols, is_pivot.astype(bool), expected.astype(np.float32)
        return Pairs(*(torch.from_numpy(part).to(case.apart.device) for part in found))

    def __call__(self, cases: Sequence[Case], matches: Sequence[Pairs]) -> dict[str, Tensor]:
        """Return the weighted losses of a layer and class, from the cases of all samples."""
        number = max(sum(len(case.truth.numbers) for case in cases), 1)
        labels = [torch.full_like(case.lines.logits[:, 0], 1 - LINE).long() for case in cases]
        for label, pairs in zip(labels, matches, strict=True):
            label[pairs.rows] = LINE
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
            classes = kinds.new_tensor([self.between_weight, 1.0])
            point_cls = F.cross_entropy(kinds.flatten(0, 1), is_pivot.flatten().long(), classes)
        logits = torch.cat([case.lines.logits for case in cases])
        cls = F.cross_entropy(logits, torch.cat(labels), logits.new_tensor([1.0, self.none_weight]))
        return {
            "mask": self.mask * masks.sum() / number,
            "pivots": self.pivots * ((offsets * weight).sum(1) / weight.sum(1)).sum() / number,
            "collinear": self.collinear * collinear.sum() / number,
            "cls": self.cls * cls,
            "point_cls": self.point_cls * point_cls / (number if self.point_cls_per_line else 1),
        }


def mask_distances(logits: Tensor, masks: Tensor) -> Tensor:
    """Return mean cross-entropy + dice of all pairs of masks. (n, H, W), (K, H, W) -> (n, K)"""
    logits, masks = logits.flatten(1), masks.flatten(1)
    shares = logits.sigmoid()
    entropy = F.softplus(logits).sum(1, keepdim=True) - logits @ masks.T
    sizes = shares.sum(1, keepdim=True) + masks.sum(1)
    return entropy / logits.shape[1] + 1 - (2 * shares @ masks.T + 1) / (sizes + 1)
