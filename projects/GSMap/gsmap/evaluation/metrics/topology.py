"""What AP hardly sees: elements in pieces, elements joined, lines that fold back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import shapely

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
from gsmap.structures.elements import BoolArray, FloatArray, MapElements
from gsmap.structures.polylines import arc_lengths, resample
from gsmap.utils.errors import InputError

_POINTS = 128  # that an element is looked at, at equal distances
_FOLD_CHORD_M = 2.0  # before and after a fold
_COUNTS = ("breaks", "false_joints", "folds", "num_gts", "num_preds")
_FOLD_COS = -0.5  # of the angle between both chords: 120 degrees


@register_metric
@dataclass(frozen=True)
class Topology(Metric):
    """Counts of breaks, false joints and folds.

    Args:
        classes: Names of the classes; a label is an index into them.
        area_labels: Labels of classes whose elements enclose an area.
        min_score: Smallest score of a prediction that counts.
        tolerance_m: Within which a line covers a point of another.
        min_piece_m: Shortest piece that counts; more than a line covers of one that it crosses.

    Raises:
        ValueError: If a value is out of its range.
    """

    name: ClassVar[str] = "topology"
    takes_min_score: ClassVar[bool] = True

    classes: tuple[str, ...]
    area_labels: tuple[int, ...] = ()
    min_score: float = 0.4
    tolerance_m: float = 1.0
    min_piece_m: float = 3.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if not (0 <= self.min_score <= 1 and 0 < 2 * self.tolerance_m < self.min_piece_m < np.inf):
            raise InputError(
                "min_score must be in [0, 1], tolerance_m > 0 and min_piece_m more than twice "
                f"that, got {self.min_score}, {self.tolerance_m} and {self.min_piece_m}."
            )

    @classmethod
    def of(cls, settings: MetricSettings) -> "Topology":
        """Return the metric by the settings of a command or config."""
        own = {} if settings.min_score is None else {"min_score": settings.min_score}
        return cls(settings.classes, settings.areas, **own)

    def match(self, sample: Sample) -> SampleValues:
        """Count in one sample."""
        token, predictions, truth = sample
        check_pair(predictions, truth, self.classes, token)
        counts = np.zeros((len(self.classes), len(_COUNTS)))
        for label in range(len(self.classes)):
            chosen = (predictions.labels == label) & (predictions.confidence >= self.min_score)
            found = _lines(predictions, chosen)
            wanted = _lines(truth, truth.labels == label)
            is_area = label in self.area_labels
            counts[label] = (
                _excess_pieces(wanted, found, self),
                _excess_pieces(found, wanted, self),
                sum(count_folds(line, is_area) for line in found),
                len(wanted),
                len(found),
            )
        return SampleValues(token, {"counts": counts})

    def reports(self, table: ValueTable) -> list[MetricReport]:
        """Add up the counts of all samples.

        Figures are, by ``CLASS/NAME``: ``breaks``, pieces beyond the first that ground truths are
        found in; ``false_joints``, ground truths beyond the first that a prediction runs along;
        ``folds``; ``num_gts`` and ``num_preds``.
        """
        totals = np.sum(table.column("counts"), axis=0)
        figures = {
            f"{name}/{key}": total
            for name, of_class in zip(self.classes, totals, strict=True)
            for key, total in zip(_COUNTS, of_class, strict=True)
        }
        return [MetricReport.of_figures(self.name, figures, table.tokens)]


def count_pieces(covered: BoolArray, step_m: float, min_piece_m: float) -> int:
    """Return of how many lines an element is made up: each adds a piece that no other covers.

    Args:
        covered: Which points of the element, at equal distances, each line covers. (M, P)
        step_m: Distance of the points in metres.
        min_piece_m: Shortest piece that counts.
    """
    free, pieces = np.ones(covered.shape[1], bool), 0
    while len(covered):
        gains = (covered & free).sum(axis=1)
        best = int(gains.argmax())
        if not gains[best] * step_m >= min_piece_m:
            break
        free &= ~covered[best]
        pieces += 1
    return pieces


def _excess_pieces(
    elements: Sequence[FloatArray], lines: Sequence[FloatArray], config: Topology
) -> int:
    """Return how many pieces beyond the first the elements are made up of."""
    if not lines:
        return 0
    drawn, excess = shapely.linestrings([*map(_flat, lines)]), 0
    for element in elements:
        points = shapely.points(resample(element, _POINTS)[:, :2])
        covered = shapely.distance(points[None], drawn[:, None]) <= config.tolerance_m  # (M, P)
        step_m = arc_lengths(element)[-1] / (_POINTS - 1)
        excess += max(count_pieces(covered, step_m, config.min_piece_m) - 1, 0)
    return excess


def _flat(line: FloatArray) -> FloatArray:
    """Return a line's course in the plane. (P, 2)"""
    return resample(line, _POINTS)[:, :2]


def count_folds(line: FloatArray, is_area: bool) -> int:
    """Return how often a line turns back on itself; of an area 1 if its outline crosses itself.

    A line turns back where its courses over 2 m before and after differ by more than 120 degrees.

    Args:
        line: Vertices in metres. (n, 2 or 3)
        is_area: Whether it encloses an area.
    """
    if is_area:
        ring = shapely.LineString(np.concatenate([line[:, :2], line[:1, :2]]))
        return int(not ring.is_simple)
    points, length = _flat(line), arc_lengths(line)[-1]
    if not 2 * _FOLD_CHORD_M <= length < np.inf:
        return 0
    span = max(round(_FOLD_CHORD_M / length * (_POINTS - 1)), 1)
    chords = points[span:] - points[:-span]
    before, after = chords[:-span], chords[span:]
    sizes = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    turned = (before * after).sum(axis=1) < _FOLD_COS * sizes
    return int(turned[:1].sum() + (turned[1:] & ~turned[:-1]).sum())


def _lines(elements: MapElements, chosen: BoolArray) -> list[FloatArray]:
    """Return the chosen elements of two points or more."""
    lines = elements.polylines
    return [lines[i] for i in np.flatnonzero(chosen & (elements.num_points >= 2)).tolist()]
