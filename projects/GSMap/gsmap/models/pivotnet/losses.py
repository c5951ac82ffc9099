"""PivotNet's losses of one map class: lines, their masks, pivots and the points between."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.maptr.matching import check_finite
from gsmap.models.pivotnet.matching import match_pivots, sequence_costs

PIVOT, LINE = 1, 0  # the places of their logits; the others are a point between and none


class Lines(NamedTuple):
    """Predicted lines of one class in one sample."""

    logits: Tensor  # of a line and of none (n, 2)
    points: Tensor  # [0, 1] from the front and from the left (n, p, 2)
    point_logits: Tensor  # of a point between pivots and of a pivot (n, p, 2)
    masks: Tensor  # logits (n, H, W)


class TrueLines(NamedTuple):
    """Annotated lines of one class in one sample."""

    pivots: Tensor  # [0, 1] from the front and from the left; beyond their number unused (K, P, 2)
    numbers: Tensor  # of pivots (K,)
    masks: Tensor  # 0 and 1, float (K, H, W)


@dataclass(frozen=True)
class PivotLosses:
    """Weights of losses and of matching costs; the defaults are the released ones.

    Args:
        cls: Weight of the class, of matching too.
        mask: Weight of the lines' masks, of matching too.
        pivots: Weight of matched pivots, of the matching of sequences too.
        collinear: Weight of the points between.
        point_cls: Weight of the kind of each point.
        semantic: Weight of the masks of whole classes.
        end_weight: What the ends of a line weigh more than its other pivots, of matching too.
        none_weight: Weight of predictions of no line in ``cls``.
        between_weight: Weight of points between pivots in ``point_cls``.
        point_cls_per_line: Divide the mean of ``point_cls`` by the number of lines, as released.
    """

    cls: float = 2.0
    mask: float = 5.0
    pivots: float = 30.0
    collinear: float = 10.0
    point_cls: float = 2.0
    semantic: float = 3.0
    end_weight: float = 5.0
    none_weight: float = 0.5
    between_weight: float = 0.2
    point_cls_per_line: bool = True

    def match(
        self, lines: Lines, truth: TrueLines, masks: Tensor, token: str
    ) -> tuple[Tensor, Tensor]:
        """Return the matched predictions and annotations. 2 x (M,)

        ``masks`` are the distances of the masks (n, K). FloatingPointError, with the sample's
        ``token``, if a cost is not a number.
        """
        differences = distances(lines.points, truth.pivots)
        numbers = truth.numbers.cpu().numpy()
        parts = torch.stack(
            [
                -self.cls * lines.logits.softmax(-1)[:, LINE, None].expand_as(masks).cpu(),
                self.mask * masks.cpu(),
                self.pivots
                * torch.from_numpy(sequence_costs(differences, numbers, self.end_weight)),
            ]
        ).detach()
        check_finite(parts, ["class scores", "masks", "pivots"], {"token": token})
        rows, cols = linear_sum_assignment(parts.sum(0).numpy())
        return torch.from_numpy(rows), torch.from_numpy(cols)

    def of_class(
        self, samples: list[tuple[Lines, TrueLines, str]]
    ) -> tuple[dict[str, Tensor], list[tuple[Tensor, Tensor]]]:
        """Return the weighted losses of the lines of one class in a batch, and the matches."""
        number = max(sum(len(truth.numbers) for _, truth, _ in samples), 1)
        logits = torch.cat([lines.logits for lines, _, _ in samples])
        zero = logits.sum() * 0
        sums = {"mask": zero, "pivots": zero, "collinear": zero}
        labels, kinds, matches = [], [], []
        for lines, truth, token in samples:
            masks = mask_distances(lines.masks, truth.masks)
            rows, cols = self.match(lines, truth, masks, token)
            matches.append((rows, cols))
            label = torch.full((len(lines.logits),), 1 - LINE, device=logits.device)
            label[rows] = LINE
            labels.append(label)
            sums["mask"] = sums["mask"] + masks[rows, cols].sum()
            is_pivot, expected = spaced(lines, truth, rows, cols)
            offsets = (lines.points[rows] - expected).abs().sum(-1)  # (M, p)
            weight = is_pivot.float()
            weight[:, [0, -1]] += self.end_weight
            sums["pivots"] = sums["pivots"] + ((offsets * weight).sum(1) / weight.sum(1)).sum()
            between = (~is_pivot).float()
            means = (offsets * between).sum(1) / between.sum(1).clamp(min=1)
            sums["collinear"] = sums["collinear"] + means.sum()
            kinds.append((lines.point_logits[rows], is_pivot.long()))
        losses = {name: getattr(self, name) * value / number for name, value in sums.items()}
        weight = logits.new_tensor([1.0, self.none_weight])
        losses["cls"] = self.cls * F.cross_entropy(logits, torch.cat(labels), weight)
        point_logits, is_pivot = (
            torch.cat(parts).flatten(0, 1) for parts in zip(*kinds, strict=True)
        )
        weight = logits.new_tensor([self.between_weight, 1.0])
        point_cls = F.cross_entropy(point_logits, is_pivot, weight) if len(is_pivot) else zero
        divisor = number if self.point_cls_per_line else 1
        losses["point_cls"] = self.point_cls * point_cls / divisor
        return losses, matches


def distances(points: Tensor, pivots: Tensor) -> NDArray[np.float64]:
    """Return |du| + |dv| of all pivots and points. (n, p, 2), (K, m, 2) -> (n, K, m, p)"""
    apart = pivots.detach()[None, :, :, None] - points.detach()[:, None, None]
    return apart.abs().sum(-1).double().cpu().numpy()


def spaced(lines: Lines, truth: TrueLines, rows: Tensor, cols: Tensor) -> tuple[Tensor, Tensor]:
    """Return which points of the pairs are pivots, and where all should be. (M, p), (M, p, 2)

    Between two pivots, points should be spaced evenly by their index.
    """
    num_points = lines.points.shape[1]
    is_pivot = np.zeros((len(rows), num_points), bool)
    expected = np.zeros((len(rows), num_points, 2))
    pivots, numbers = truth.pivots.double().cpu().numpy(), truth.numbers.tolist()
    for pair, (row, col) in enumerate(zip(rows.tolist(), cols.tolist(), strict=True)):
        own = truth.pivots[None, col, : numbers[col]]
        path = match_pivots(distances(lines.points[row, None], own)[0, 0])
        is_pivot[pair, path] = True
        for axis in (0, 1):
            line = pivots[col, : numbers[col], axis]
            expected[pair, :, axis] = np.interp(np.arange(num_points), path, line)
    placed = torch.from_numpy(expected).to(lines.points)
    return torch.from_numpy(is_pivot).to(placed.device), placed


def mask_distances(logits: Tensor, masks: Tensor) -> Tensor:
    """Return mean cross-entropy + dice of all pairs of masks. (n, H, W), (K, H, W) -> (n, K)"""
    logits, masks = logits.flatten(1), masks.flatten(1)
    shares = logits.sigmoid()
    entropy = F.softplus(logits).sum(1, keepdim=True) - logits @ masks.T
    sizes = shares.sum(1, keepdim=True) + masks.sum(1)
    return entropy / logits.shape[1] + 1 - (2 * shares @ masks.T + 1) / (sizes + 1)
