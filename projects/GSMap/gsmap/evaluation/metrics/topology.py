"""Topological errors that AP hardly penalises: broken, joined and folded lines."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
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

_POINTS = 128  # number of points P to which elements and lines are resampled, at equal distances
# Columns of the counts of a class. `Topology.reports` defines the first three.
_COUNTS = ("breaks", "false_joints", "folds", "num_gts", "num_preds")
_FOLD_CHORD_M = 2.0  # length of the chords before and after a fold
_FOLD_COS = -0.5  # cosine of 120 degrees, the smallest angle between both chords at a fold


@register_metric
@dataclass(frozen=True)
class Topology(Metric):
    """Counts of breaks, false joints and folds.

    Args:
        classes: Names of the classes; a label is an index into them.
        area_labels: Labels of classes whose elements enclose an area.
        min_score: Smallest score of a prediction that counts, in [0, 1].
        tolerance_m: Largest distance in metres at which a line covers a point of another line.
        min_piece_m: Length in metres of the shortest piece that counts, > 2 ``tolerance_m``. A line
            that crosses another line at a right angle is within the tolerance over a length of
            2 ``tolerance_m``. This is too short to count as a piece.

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
    def from_settings(cls, settings: MetricSettings) -> "Topology":
        """Create the metric from the settings of a command or config."""
        metric = cls(classes=settings.classes, area_labels=settings.areas)
        if settings.min_score is None:
            return metric
        return replace(metric, min_score=settings.min_score)

    def match(self, sample: Sample) -> SampleValues:
        """Count the errors of one sample.

        Args:
            sample: Predictions with scores, and ground truth.

        Returns:
            ``counts`` of each class, with the columns ``_COUNTS``. (C, 5)

        Raises:
            ValueError: If a label does not fit the classes, or predictions have no scores.
        """
        token, predictions, truth = sample
        check_pair(predictions, truth, self.classes, token)  # raises the errors
        counts = np.zeros((len(self.classes), len(_COUNTS)))
        for label in range(len(self.classes)):
            is_confident = predictions.confidence >= self.min_score
            preds = _lines(predictions, chosen=(predictions.labels == label) & is_confident)
            gts = _lines(truth, chosen=truth.labels == label)
            num_folds = 0
            for line in preds:
                num_folds += count_folds(line, is_area=label in self.area_labels)
            counts[label] = (  # in the order of _COUNTS
                # A break is a further prediction along one ground truth. A false joint is a further
                # ground truth along one prediction.
                _count_excess_pieces(gts, lines=preds, config=self),
                _count_excess_pieces(preds, lines=gts, config=self),
                num_folds,
                len(gts),
                len(preds),
            )
        return SampleValues(token, {"counts": counts})

    def reports(self, table: ValueTable) -> list[MetricReport]:
        """Add up the counts of all samples.

        The keys of figures are ``CLASS/NAME``. If different predictions cover n pieces of a ground
        truth, it has n - 1 ``breaks``. If a prediction follows n ground truths, it has n - 1
        ``false_joints``. ``folds`` are counted as in `count_folds`. ``num_gts`` and ``num_preds``
        are the numbers of ground truths and predictions.

        Args:
            table: Records of `match` for all samples.

        Returns:
            One report.
        """
        totals = np.sum(table.column("counts"), axis=0)  # (C, 5)
        figures = {}
        for label, name in enumerate(self.classes):
            for column, key in enumerate(_COUNTS):
                figures[f"{name}/{key}"] = totals[label, column]
        return [MetricReport.of_figures(self.name, figures=figures, tokens=table.tokens)]


def count_pieces(covered: BoolArray, step_m: float, min_piece_m: float) -> int:
    """Count the lines that are needed to cover an element.

    Lines are chosen greedily. The gain of a line is the number of points that it covers and that
    no chosen line covers yet. The next line is the one with the largest gain. The choice ends when
    the gain, as a length, is smaller than ``min_piece_m``.

    Args:
        covered: Whether each of M lines covers each point of the element, at equal distances.
            (M, P)
        step_m: Distance of neighbouring points in metres.
        min_piece_m: Length in metres of the shortest piece that counts.
    """
    is_free = np.ones(covered.shape[1], dtype=bool)  # points that no chosen line covers. (P,)
    num_pieces = 0
    while len(covered):  # without lines, there is no piece
        gains = (covered & is_free).sum(axis=1)  # (M,)
        best = int(gains.argmax())
        # `not >=` also ends the loop for NaN, which is the product of 0 points and an infinite step
        # (of a line with huge coordinates).
        if not gains[best] * step_m >= min_piece_m:
            break
        is_free &= ~covered[best]
        num_pieces += 1
    return num_pieces


def _count_excess_pieces(
    elements: Sequence[FloatArray], lines: Sequence[FloatArray], config: Topology
) -> int:
    """Count the excess pieces of elements.

    If different lines cover n pieces of an element, it has n - 1 excess pieces.
    """
    if not lines:
        return 0
    # Distances are measured from the points of an element to whole lines, not to their points.
    curves = shapely.linestrings([_resample_flat(line) for line in lines])
    num_excess = 0
    for element in elements:
        points = shapely.points(_resample_flat(element))
        covered = shapely.distance(points[None], curves[:, None]) <= config.tolerance_m  # (M, P)
        step_m = arc_lengths(element)[-1] / (_POINTS - 1)
        num_pieces = count_pieces(covered, step_m=step_m, min_piece_m=config.min_piece_m)
        num_excess += max(num_pieces - 1, 0)
    return num_excess


def _resample_flat(line: FloatArray) -> FloatArray:
    """Resample a line and project it to the plane. (P, 2)"""
    return resample(line, _POINTS)[:, :2]


def count_folds(line: FloatArray, is_area: bool) -> int:
    """Count the folds of a line. For an area, the count is 1 if its outline crosses itself, else 0.

    A line folds where its directions over 2 m before and after a point differ by more than 120
    degrees.

    Args:
        line: Vertices in metres. (n, 2 or 3)
        is_area: Whether the line encloses an area.
    """
    if is_area:
        # The first point is appended, so that the outline is closed.
        ring = shapely.LineString(np.concatenate([line[:, :2], line[:1, :2]]))
        return int(not ring.is_simple)
    points = _resample_flat(line)
    length = arc_lengths(line)[-1]
    if not 2 * _FOLD_CHORD_M <= length < np.inf:  # too short for two chords, or of infinite length
        return 0
    span = max(round(_FOLD_CHORD_M / length * (_POINTS - 1)), 1)  # steps between points per chord
    chords = points[span:] - points[:-span]
    before = chords[:-span]  # each one ends where the chord of equal index in `after` starts
    after = chords[span:]
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    # The scalar product of two chords is the cosine of their angle times their lengths.
    is_fold = (before * after).sum(axis=1) < _FOLD_COS * lengths
    # A fold at several successive points counts once, at the first of them.
    starts_fold = is_fold[1:] & ~is_fold[:-1]
    return int(is_fold[:1].sum() + starts_fold.sum())


def _lines(elements: MapElements, chosen: BoolArray) -> list[FloatArray]:
    """Return the vertices of the chosen elements of two points or more."""
    is_line = elements.num_points >= 2
    return elements.select(chosen & is_line).polylines
