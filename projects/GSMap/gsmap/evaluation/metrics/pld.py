"""SOSPA, a distance of lines that depends on the order of points, and PLD, a distance of maps.

Lehocine et al., "Beyond Chamfer Distance", arXiv 2605.22578. The evaluator of the paper
(zenseact/SOSPA) computes equal figures. Both distances are in [0, 1], and smaller is better.
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

_STEP_M = 0.5  # distance between neighbouring points of a sampled line
_MOST_STEPS = 2000  # largest number of steps of a line; the time grows with its square
_CLOSED_M = 0.1  # largest gap between the ends of a ring
_PARTS = ("PLD", "localisation", "cardinality")  # PLD is the sum of the other two


def sample_line(line: FloatArray) -> FloatArray:
    """Sample a line at every half metre and at its end.

    A line of more than a kilometre is sampled with a longer step, such that it has 2,001 points.

    Args:
        line: Vertices in metres. (n, D)

    Returns:
        Points in metres; empty for a line of a single vertex. (m, D)
    """
    if len(line) < 2:
        return line[:0]
    along = arc_lengths(line)
    length_m = along[-1]
    step_m = max(_STEP_M, length_m / _MOST_STEPS)
    stop = max(length_m, np.finfo(float).tiny)  # > 0, so that a line of length 0 keeps its start
    positions = np.append(np.arange(0.0, stop, step=step_m), length_m)
    # The columns are x, y and, in 3-D, z.
    return np.stack([np.interp(positions, along, column) for column in line.T], axis=-1)


@njit(cache=True)
def _align_points(distances: FloatArray, gap_cost: float) -> tuple[float, float]:
    """Pair the points of two lines in order at the smallest cost, by dynamic programming.

    Args:
        distances: Distance of every pair of points in metres. (m, n)
        gap_cost: Cost of a point without partner, in metres.

    Returns:
        Total cost, and the part of it that is the sum of the distances of the pairs.
    """
    # cost[j] is the smallest cost of pairing the rows so far with the first j columns. paired[j] is
    # the sum of the distances of the pairs in this cost. Each row overwrites both arrays from left
    # to right. `diagonal_cost` and `diagonal_paired` are the previous row's values at column j.
    num_columns = distances.shape[1] + 1
    cost = gap_cost * np.arange(num_columns)
    paired = np.zeros(num_columns)
    for row in distances:
        diagonal_cost = cost[0]
        diagonal_paired = paired[0]
        cost[0] += gap_cost
        for j in range(len(row)):
            best_cost = diagonal_cost + row[j]
            best_paired = diagonal_paired + row[j]
            if cost[j + 1] + gap_cost < best_cost:  # the point of the row has no partner
                best_cost = cost[j + 1] + gap_cost
                best_paired = paired[j + 1]
            if cost[j] + gap_cost < best_cost:  # the point of the column has no partner
                best_cost = cost[j] + gap_cost
                best_paired = paired[j]
            diagonal_cost = cost[j + 1]
            diagonal_paired = paired[j + 1]
            cost[j + 1] = best_cost
            paired[j + 1] = best_paired
    return cost[-1], paired[-1]


@njit(cache=True)
def _align_lines(distances: FloatArray, gap_cost: float, num_starts: int) -> tuple[float, float]:
    """Return the result of `_align_points` for the best start and direction of the first line.

    Args:
        distances: Distance of every pair of points in metres. (m, n)
        gap_cost: Cost of a point without partner, in metres.
        num_starts: Number of points at which the first line may start: all points of a ring, and 1
            for an open line.

    Returns:
        Smallest total cost, and the part of it that is the sum of the distances of the pairs.
    """
    best_cost = np.inf
    best_paired = 0.0
    for start in range(num_starts):
        # numba does not support `np.roll` with an axis.
        rolled = np.concatenate((distances[start:], distances[:start]))
        for direction in (1, -1):
            cost, paired = _align_points(rolled[::direction], gap_cost=gap_cost)
            if cost < best_cost:
                best_cost = cost
                best_paired = paired
    return best_cost, best_paired


def sospa(first: FloatArray, second: FloatArray, cutoffs_m: Sequence[float]) -> FloatArray:
    """Compute the SOSPA distance of two lines, and its localisation part.

    Points are paired in order. A pair costs its distance. A point without partner costs c / 2. C is
    the smallest sum of costs, over both directions of the first line. If one of the lines is closed
    (ends within 0.1 m), C is the smallest sum over all starts of the first line as well. The sum of
    costs without any pair is G = c / 2 (m + n). The distance is 2 C / (G + C). It is 0 for equal
    lines, and 1 for lines without points within c of each other. The localisation part is
    2 D / (G + C), where D is the sum of the distances of the pairs.

    Args:
        first: Points at equal distances (`sample_line`), in metres. (m, D)
        second: Points at equal distances (`sample_line`), in metres. (n, D)
        cutoffs_m: Cut-offs c in metres, > 0. (T,)

    Returns:
        Distance and localisation part at each cut-off; 1 and 0 if a line has no points. (T, 2)
    """
    first_is_closed = _is_closed(first)
    second_is_closed = _is_closed(second)
    if first_is_closed:
        first = first[:-1]  # without the repeated first point
    if second_is_closed:
        second = second[:-1]
    figures = np.tile([1.0, 0.0], reps=(len(cutoffs_m), 1))
    if not (len(first) and len(second)):
        return figures
    distances = cdist(first, second)
    num_starts = len(first) if first_is_closed or second_is_closed else 1
    for row, cutoff in enumerate(cutoffs_m):
        # Points at the cut-off or beyond cost no less as a pair than without partners.
        if distances.min() < cutoff:
            gap_cost = cutoff / 2
            sums = np.array(_align_lines(distances, gap_cost, num_starts))  # C, distances of pairs
            without_pairs = gap_cost * sum(distances.shape)  # G: the shape is (m, n)
            figures[row] = 2 * sums / (without_pairs + sums[0])
    return figures


def _is_closed(points: FloatArray) -> bool:
    """Whether the ends of a line are within 0.1 m."""
    return len(points) > 2 and bool(np.linalg.norm(points[-1] - points[0]) <= _CLOSED_M)


def _pair_sums(
    preds: Sequence[FloatArray],
    scores: FloatArray,
    gts: Sequence[FloatArray],
    cutoffs_m: Sequence[float],
) -> FloatArray:
    """Sum r (1 - s), and r times the localisation part of s, over the best pairs of one class.

    A pair of score r and SOSPA distance s costs r s + (1 - r) / 2 (`PLD`). Without partners, its
    two elements would cost r / 2 and 1 / 2. The difference, r (1 - s), is the gain of the pair.

    Args:
        preds: Points of each prediction. n x (m, 2)
        scores: Score r of each prediction. (n,)
        gts: Points of each ground truth. k x (m, 2)
        cutoffs_m: Cut-offs of SOSPA in metres. (T,)

    Returns:
        Both sums at each cut-off. (T, 2)
    """
    distances = np.empty((len(preds), len(gts), len(cutoffs_m), 2))
    for i, pred in enumerate(preds):
        for k, gt in enumerate(gts):
            distances[i, k] = sospa(pred, gt, cutoffs_m=cutoffs_m)
    sums = np.zeros((len(cutoffs_m), 2))
    for row in range(len(cutoffs_m)):
        gains = scores[:, None] * (1 - distances[:, :, row, 0])
        errors = scores[:, None] * distances[:, :, row, 1]
        # The best pairs have the largest sum of gains. `pairs` has their rows and their columns.
        pairs = linear_sum_assignment(gains, maximize=True)
        sums[row, 0] = gains[pairs].sum()
        sums[row, 1] = errors[pairs].sum()
    return sums


@register_metric
@dataclass(frozen=True)
class PLD(Metric):
    """PLD, the distance of predicted maps with scores from annotated maps.

    In each sample and class, predictions of score r are paired with ground truths at the smallest
    cost. A pair with SOSPA s costs r s + (1 - r) / 2, a prediction without partner r / 2, and a
    ground truth without partner 1 / 2. D is the sum of the costs over all samples. PLD is
    2 D / (M + D), where M = (sum of scores + number of ground truths) / 2 is the sum of the costs
    without any pair. Lines are compared in the plane.

    Args:
        classes: Names of the classes; a label is an index into them.
        cutoffs_m: Cut-offs of SOSPA in metres, > 0.

    Raises:
        ValueError: If a value is out of its range.
    """

    name: ClassVar[str] = "pld"
    takes_thresholds: ClassVar[bool] = True

    classes: tuple[str, ...]
    cutoffs_m: tuple[float, ...] = CHAMFER_THRESHOLDS

    def __post_init__(self) -> None:
        cutoffs = tuple(sorted(round(float(cutoff), ndigits=6) for cutoff in self.cutoffs_m))
        object.__setattr__(self, "classes", checked_classes(self.classes))
        object.__setattr__(self, "cutoffs_m", cutoffs)
        if not (cutoffs and 0 < cutoffs[0] <= cutoffs[-1] < np.inf):
            raise InputError(f"cutoffs_m must be > 0 m, at least one, got {cutoffs}.")

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "PLD":
        """Create the metric from the settings of a command or config."""
        cutoffs_m = settings.thresholds or CHAMFER_THRESHOLDS
        return cls(classes=settings.classes, cutoffs_m=cutoffs_m)

    def match(self, sample: Sample) -> SampleValues:
        """Pair the elements of one sample.

        Predictions of fewer than two points are left out. Ground truths of fewer than two points
        have no partner.

        Returns:
            ``sums`` (classes, T, 2): the two results of `_pair_sums` at each cut-off. ``masses``
            (classes, 1): the sum of the costs without any pair, M in the description of the class.
        """
        token, predictions, truth = sample
        check_pair(predictions, truth, classes=self.classes, token=token)
        predictions = predictions.select(predictions.num_points >= 2)
        # Only the plane counts, so heights are cut off.
        pred_lines = [sample_line(line[:, :2]) for line in predictions.polylines]
        gt_lines = [sample_line(line[:, :2]) for line in truth.polylines]
        sums = np.zeros((len(self.classes), len(self.cutoffs_m), 2))
        masses = np.zeros((len(self.classes), 1))
        for label in range(len(self.classes)):
            preds = np.flatnonzero(predictions.labels == label).tolist()
            gts = np.flatnonzero(truth.labels == label).tolist()
            scores = predictions.confidence[preds]
            masses[label] = (scores.sum() + len(gts)) / 2
            sums[label] = _pair_sums(
                preds=[pred_lines[i] for i in preds],
                scores=scores,
                gts=[gt_lines[k] for k in gts],
                cutoffs_m=self.cutoffs_m,
            )
        return SampleValues(token, {"sums": sums, "masses": masses})

    def reports(self, table: ValueTable) -> list[MetricReport]:
        """Compute PLD from the sums of all samples.

        The keys of the figures are ``CLASS/PLD@CUTOFF``, ``CLASS/localisation@CUTOFF`` and
        ``CLASS/cardinality@CUTOFF``. ``localisation`` is the part of PLD due to the distances of
        paired points. ``cardinality`` is the rest, which is due to points and lines without
        partners and to scores below 1. Figures without cut-off are means over the cut-offs. Figures
        without class are means over the classes. The figures of a class that occurs in no sample
        are 0.

        Args:
            table: Values of all samples.
        """
        sums = np.sum(table.column("sums"), axis=0)
        masses = np.sum(table.column("masses"), axis=0)
        gains = sums[..., 0]
        errors = sums[..., 1]  # distances of the pairs, as parts of SOSPA times the scores
        # D = M - gains, so M + D = 2 M - gains.
        denominator = np.maximum(2 * masses - gains, np.finfo(float).tiny)
        pld = 2 * (masses - gains) / denominator
        localisation = 2 * errors / denominator
        figures: dict[str, float] = {}
        for part, values in zip(_PARTS, (pld, localisation, pld - localisation), strict=True):
            for name, row in zip(self.classes, values, strict=True):
                for cutoff, value in zip(self.cutoffs_m, row, strict=True):
                    figures[f"{name}/{part}@{cutoff}"] = float(value)
                figures[f"{name}/{part}"] = float(row.mean())
            figures[part] = float(values.mean())
        return [MetricReport.of_figures(self.name, figures=figures, tokens=table.tokens)]
