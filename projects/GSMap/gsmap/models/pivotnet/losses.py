"""PivotNet's losses of one map class: lines, their masks, pivots and the points between."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.maptr.matching import check_finite
from gsmap.models.pivotnet.matching import Floats, match_pivots, sequence_costs

PIVOT, LINE = 1, 0  # the places of their logits; the others are a point between and none


class Lines(NamedTuple):
    """Predicted lines of one class, in one sample (n, ...) or in a batch (B, n, ...)."""

    logits: Tensor  # of a line and of none (n, 2)
    points: Tensor  # [0, 1] from the front and from the left (n, p, 2)
    point_logits: Tensor  # of a point between pivots and of a pivot (n, p, 2)
    masks: Tensor  # logits (n, H, W)


class TrueLines(NamedTuple):
    """Annotated lines of one class in one sample."""

    pivots: Floats  # [0, 1] from the front and from the left; beyond their number unused (K, P, 2)
    numbers: NDArray[np.int64]  # of pivots (K,)
    masks: Tensor  # 0 and 1, float (K, H, W)


class Pairs(NamedTuple):
    """Matched lines of one class in one sample."""

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
    def match(self, lines: Lines, truth: TrueLines, token: str) -> Pairs:
        """Match the lines of a sample; FloatingPointError if a cost is not a number."""
        masks = mask_distances(lines.masks, truth.masks)
        scores = lines.logits.softmax(-1)[:, LINE, None].expand_as(masks)
        points = lines.points.double().cpu().numpy()
        differences = np.abs(truth.pivots[:, :, None] - points[:, None, None]).sum(-1)
        sequences = torch.from_numpy(sequence_costs(differences, truth.numbers, self.end_weight))
        parts = -self.cls * scores.cpu(), self.mask * masks.cpu(), self.pivots * sequences
        costs = torch.stack([part.double() for part in parts])  # (3, n, K)
        check_finite(costs, ["class scores", "masks", "pivots"], {"token": token})
        rows, cols = linear_sum_assignment(costs.sum(0).numpy())
        index = np.arange(points.shape[1])
        is_pivot = np.zeros((len(rows), len(index)), bool)
        expected = np.zeros((len(rows), len(index), 2), np.float32)
        for pair, (row, col) in enumerate(zip(rows, cols, strict=True)):
            line = truth.pivots[col, : truth.numbers[col]]
            path = match_pivots(differences[row, col, : len(line)])
            is_pivot[pair, path] = True
            expected[pair] = np.stack([np.interp(index, path, axis) for axis in line.T], -1)
        found = rows, cols, is_pivot, expected
        return Pairs(*(torch.from_numpy(part).to(masks.device) for part in found))

    def __call__(
        self, lines: Lines, truths: Sequence[TrueLines], tokens: Sequence[str]
    ) -> tuple[dict[str, Tensor], list[Pairs]]:
        """Return the weighted losses of a layer's lines of a class, and the pairs of each sample.

        The masks of lines (B, n, H, W) are as large as the annotated ones.
        """
        samples = zip(map(Lines, *lines), truths, tokens, strict=True)
        pairs = [self.match(*sample) for sample in samples]
        chosen = [
            torch.cat([own[found.rows] for own, found in zip(part, pairs, strict=True)])
            for part in lines
        ]
        _, points, kinds, masks = chosen  # of matched lines (M, ...)
        drawn = torch.cat([own.masks[p.cols] for own, p in zip(truths, pairs, strict=True)])
        is_pivot = torch.cat([found.is_pivot for found in pairs])
        offsets = (points - torch.cat([found.expected for found in pairs])).abs().sum(-1)
        weight = is_pivot.float()
        weight[:, [0, -1]] += self.end_weight
        between = (~is_pivot).float()
        collinear = (offsets * between).sum(1) / between.sum(1).clamp(min=1)
        point_cls = kinds.sum()  # 0 without pairs
        if len(kinds):
            classes = kinds.new_tensor([self.between_weight, 1.0])
            point_cls = F.cross_entropy(kinds.flatten(0, 1), is_pivot.flatten().long(), classes)
        labels = torch.full_like(lines.logits[..., 0], 1 - LINE).long()
        for own, found in zip(labels, pairs, strict=True):
            own[found.rows] = LINE
        classes = lines.logits.new_tensor([1.0, self.none_weight])
        cls = F.cross_entropy(lines.logits.flatten(0, 1), labels.flatten(), classes)
        number = max(sum(len(own.numbers) for own in truths), 1)
        losses = {
            "mask": self.mask * mask_distances(masks, drawn).diagonal().sum() / number,
            "pivots": self.pivots * ((offsets * weight).sum(1) / weight.sum(1)).sum() / number,
            "collinear": self.collinear * collinear.sum() / number,
            "cls": self.cls * cls,
            "point_cls": self.point_cls * point_cls / (number if self.point_cls_per_line else 1),
        }
        return losses, pairs


def mask_distances(logits: Tensor, masks: Tensor) -> Tensor:
    """Return mean cross-entropy + dice of all pairs of masks. (n, H, W), (K, H, W) -> (n, K)"""
    logits, masks = logits.flatten(1), masks.flatten(1)
    shares = logits.sigmoid()
    entropy = F.softplus(logits).sum(1, keepdim=True) - logits @ masks.T
    sizes = shares.sum(1, keepdim=True) + masks.sum(1)
    return entropy / logits.shape[1] + 1 - (2 * shares @ masks.T + 1) / (sizes + 1)
