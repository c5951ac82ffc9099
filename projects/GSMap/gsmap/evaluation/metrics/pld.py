"""SOSPA and PLD: how far apart two lines are when order counts, and two maps with their scores.

Lehocine et al., "Beyond Chamfer Distance", arXiv 2605.22578; the figures are those of its evaluator
(zenseact/SOSPA). Both are in [0, 1], and smaller is better.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS
from gsmap.evaluation.core.matches import check_pair, checked_classes
from gsmap.evaluation.core.metric import (
    Metric,
    MetricSettings,
    Sample,
    SampleValues,
    ValueTable,
    register_metric,
)
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.elements import FloatArray
from gsmap.structures.polylines import arc_lengths
from gsmap.utils.errors import InputError

_STEP_M = 0.5  # between the points that are compared
_MOST_STEPS = 2000  # of a line; the work grows with the square
_CLOSED_M = 0.1  # largest gap between the ends of a ring
_PARTS = ("PLD", "localisation", "cardinality")


def spaced(line: FloatArray) -> FloatArray:
    """Return the points of a line at every half metre, and its end; none of a single point.

    A line of more than a kilometre has 2,001 points.

    Args:
        line: Vertices in metres. (n, D)
    """
    if len(line) < 2:
        return line[:0]
    along = arc_lengths(line)
    step_m = max(_STEP_M, along[-1] / _MOST_STEPS)
    at = np.append(np.arange(0.0, max(along[-1], np.finfo(float).tiny), step_m), along[-1])
    return np.stack([np.interp(at, along, column) for column in line.T], axis=-1)


@njit(cache=True)
def _aligned(distances: FloatArray, gap: float) -> tuple[float, float]:
    """Return the least cost of pairing points in order, and the distances in it. (m, n)"""
    cost, apart = gap * np.arange(distances.shape[1] + 1), np.zeros(distances.shape[1] + 1)
    for row in distances:
        before, before_apart = cost[0], apart[0]
        cost[0] += gap
        for j in range(len(row)):
            least, least_apart = before + row[j], before_apart + row[j]
            if cost[j + 1] + gap < least:
                least, least_apart = cost[j + 1] + gap, apart[j + 1]
            if cost[j] + gap < least:
                least, least_apart = cost[j] + gap, apart[j]
            before, before_apart = cost[j + 1], apart[j + 1]
            cost[j + 1], apart[j + 1] = least, least_apart
    return cost[-1], apart[-1]


@njit(cache=True)
def _best_order(distances: FloatArray, gap: float, turns: int) -> tuple[float, float]:
    """Return `_aligned` of the best start and direction of the first line. (m, n)"""
    best, best_apart = np.inf, 0.0
    for turn in range(turns):
        turned = np.concatenate((distances[turn:], distances[:turn]))
        for way in (1, -1):
            cost, apart = _aligned(turned[::way], gap)
            if cost < best:
                best, best_apart = cost, apart
    return best, best_apart


def sospa(first: FloatArray, second: FloatArray, cutoffs_m: Sequence[float]) -> FloatArray:
    """Return the SOSPA distance of two lines, and the part of it that paired points have.

    Points are paired in order. A pair costs its distance, a point without partner c / 2, and C is
    the least sum over both directions, and over all starts of the first line if one of both is
    closed (ends within 0.1 m). With G = c / 2 (m + n), the sum without any pair, the distance is
    2 C / (G + C): 0 of equal lines, 1 of lines that have no points within c.

    Args:
        first: Points at equal distances (`spaced`) in metres. (m, D)
        second: Likewise. (n, D)
        cutoffs_m: Cut-offs c in metres, > 0. (T,)

    Returns:
        Distance and part of the paired points at each cut-off. (T, 2)
    """
    rings = [
        len(p) > 2 and bool(np.linalg.norm(p[-1] - p[0]) <= _CLOSED_M) for p in (first, second)
    ]
    first, second = (p[:-1] if ring else p for p, ring in zip((first, second), rings, strict=True))
    found = np.tile([1.0, 0.0], (len(cutoffs_m), 1))
    if not (len(first) and len(second)):
        return found
    distances = cdist(first, second)
    for row, cutoff in enumerate(cutoffs_m):
        if distances.min() < cutoff:
            turns = len(first) if any(rings) else 1
            sums = np.array(_best_order(distances, cutoff / 2, turns))
            found[row] = 2 * sums / (cutoff / 2 * sum(distances.shape) + sums[0])
    return found


def _paired(
    found: Sequence[FloatArray],
    scores: FloatArray,
    wanted: Sequence[FloatArray],
    cutoffs_m: Sequence[float],
) -> FloatArray:
    """Return the sums of r (1 - s) and of r times the localisation over the best pairs. (T, 2)"""
    apart = np.array([[sospa(a, b, cutoffs_m) for b in wanted] for a in found])
    apart = apart.reshape(len(found), len(wanted), len(cutoffs_m), 2)
    sums = np.zeros((len(cutoffs_m), 2))
    for row in range(len(cutoffs_m)):
        gains, errors = (
            scores[:, None] * (1 - apart[:, :, row, 0]),
            scores[:, None] * apart[:, :, row, 1],
        )
        pairs = linear_sum_assignment(gains, maximize=True)
        sums[row] = gains[pairs].sum(), errors[pairs].sum()
    return sums


@register_metric
@dataclass(frozen=True)
class PLD(Metric):
    """PLD, the distance of predicted maps with scores from the true ones.

    In each sample and class, predictions of score r are paired with ground truths so that the
    cost is least: r s + (1 - r) / 2 of a pair with SOSPA s, r / 2 of a prediction without partner,
    1 / 2 of a ground truth without. The sums D of all samples are divided like SOSPA's:
    2 D / (M + D), with M = (sum of scores + number of ground truths) / 2, the sum without pairs.

    Args:
        classes: Names of the classes; a label is an index into them.
        cutoffs_m: Cut-offs of SOSPA in metres. Lines are compared in the plane.
    """

    name: ClassVar[str] = "pld"

    classes: tuple[str, ...]
    cutoffs_m: tuple[float, ...] = CHAMFER_THRESHOLDS

    def __post_init__(self) -> None:
        cutoffs = tuple(sorted(round(float(c), 6) for c in self.cutoffs_m))
        object.__setattr__(self, "classes", checked_classes(self.classes))
        object.__setattr__(self, "cutoffs_m", cutoffs)
        if not (cutoffs and 0 < cutoffs[0] <= cutoffs[-1] < np.inf):
            raise InputError(f"cutoffs_m must be > 0 m, at least one, got {cutoffs}.")

    @classmethod
    def of(cls, settings: MetricSettings) -> "PLD":
        """Return the metric by the settings of a command or config."""
        return cls(settings.classes, settings.thresholds or CHAMFER_THRESHOLDS)

    def match(self, sample: Sample) -> SampleValues:
        """Pair the elements of one sample.

        Predictions of less than two points are left out; ground truths of less than two have no
        partner.
        """
        token, predictions, truth = sample
        check_pair(predictions, truth, self.classes, token)
        kept = predictions.select(predictions.num_points >= 2)
        sides = [[spaced(line[:, :2]) for line in side.polylines] for side in (kept, truth)]
        sums = np.zeros((len(self.classes), len(self.cutoffs_m), 2))
        masses = np.zeros((len(self.classes), 1))
        for label in range(len(self.classes)):
            found, wanted = (np.flatnonzero(s.labels == label).tolist() for s in (kept, truth))
            scores = kept.confidence[found]
            masses[label] = (scores.sum() + len(wanted)) / 2
            lines = [sides[0][i] for i in found], scores, [sides[1][i] for i in wanted]
            sums[label] = _paired(*lines, self.cutoffs_m)
        return SampleValues(token, {"sums": sums, "masses": masses})

    def reports(self, table: ValueTable) -> list[MetricReport]:
        """Compute PLD from the sums of all samples.

        Figures are ``CLASS/PLD@CUTOFF``; ``localisation``, its part that distances of paired points
        have, and ``cardinality``, the rest, for points, lines and scores too many or too few;
        without cut-off the mean over them, without class the mean over the classes. A class that
        occurs nowhere has 0.
        """
        sums = np.sum(table.column("sums"), axis=0)
        masses = np.sum(table.column("masses"), axis=0)
        gains, errors = sums[..., 0], sums[..., 1]
        whole = np.maximum(2 * masses - gains, np.finfo(float).tiny)
        pld = 2 * (masses - gains) / whole  # D = M - gains
        localisation = 2 * errors / whole
        figures: dict[str, float] = {}
        for part, values in zip(_PARTS, (pld, localisation, pld - localisation), strict=True):
            for name, row in zip(self.classes, values, strict=True):
                for cutoff, value in zip(self.cutoffs_m, row, strict=True):
                    figures[f"{name}/{part}@{cutoff}"] = float(value)
                figures[f"{name}/{part}"] = float(row.mean())
            figures[part] = float(values.mean())
        return [MetricReport.of_figures(self.name, figures, table.tokens)]
