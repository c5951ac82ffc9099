"""What AP hardly sees: elements in pieces, elements joined, lines that fold back, wrong heights."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from gsmap.evaluation.core.chamfer_ap import ChamferConfig, match_chamfer
from gsmap.evaluation.core.evaluator import Sample
from gsmap.evaluation.core.matches import check_pair, checked_classes
from gsmap.evaluation.core.report import UNDEFINED
from gsmap.structures.elements import BoolArray, FloatArray, MapElements
from gsmap.structures.polylines import arc_lengths, resample, resample_all

_POINTS = 128  # that an element is looked at, at equal distances
_FOLD_CHORD_M = 2.0  # before and after a fold
_FOLD_COS = -0.5  # of the angle between both chords: 120 degrees


@dataclass(frozen=True)
class TopologyConfig:
    """Rules of the counts.

    Args:
        classes: Names of the classes; a label is an index into them.
        area_labels: Labels of classes whose elements enclose an area.
        min_score: Smallest score of a prediction that counts.
        tolerance_m: Within which a line covers a point of another.
        min_piece_m: Shortest piece that counts; more than a line covers of one that it crosses.

    Raises:
        ValueError: If a value is out of its range.
    """

    classes: tuple[str, ...]
    area_labels: tuple[int, ...] = ()
    min_score: float = 0.4
    tolerance_m: float = 1.0
    min_piece_m: float = 3.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if not (0 <= self.min_score <= 1 and 0 < 2 * self.tolerance_m < self.min_piece_m < np.inf):
            raise ValueError(
                "min_score must be in [0, 1], tolerance_m > 0 and min_piece_m more than twice "
                f"that, got {self.min_score}, {self.tolerance_m} and {self.min_piece_m}."
            )


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
    elements: Sequence[FloatArray], lines: Sequence[FloatArray], config: TopologyConfig
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


def topology_figures(samples: Iterable[Sample], config: TopologyConfig) -> dict[str, float]:
    """Count breaks, false joints and folds of all samples.

    Args:
        samples: Token, predictions and ground truth of each.
        config: Rules.

    Returns:
        By ``CLASS/NAME``: ``breaks``, pieces beyond the first that ground truths are found in;
        ``false_joints``, ground truths beyond the first that a prediction runs along; ``folds``;
        ``num_gts`` and ``num_preds``.
    """
    totals: dict[str, float] = defaultdict(float)
    for token, predictions, truth in samples:
        check_pair(predictions, truth, config.classes, token)
        for label, name in enumerate(config.classes):
            chosen = (predictions.labels == label) & (predictions.confidence >= config.min_score)
            found = _lines(predictions, chosen)
            wanted = _lines(truth, truth.labels == label)
            totals[f"{name}/breaks"] += _excess_pieces(wanted, found, config)
            totals[f"{name}/false_joints"] += _excess_pieces(found, wanted, config)
            is_area = label in config.area_labels
            totals[f"{name}/folds"] += sum(count_folds(line, is_area) for line in found)
            totals[f"{name}/num_gts"] += len(wanted)
            totals[f"{name}/num_preds"] += len(found)
    return dict(totals)


def _lines(elements: MapElements, chosen: BoolArray) -> list[FloatArray]:
    """Return the chosen elements of two points or more."""
    lines = elements.polylines
    return [lines[i] for i in np.flatnonzero(chosen & (elements.num_points >= 2)).tolist()]


def height_figures(samples: Iterable[Sample], config: ChamferConfig) -> dict[str, float]:
    """Measure the heights of predictions that match in the plane, at the loosest threshold.

    Each of the 100 points of a prediction is compared with the nearest of its ground truth's.

    Args:
        samples: Token, predictions and ground truth of each, all with heights.
        config: Rules of AP_chamfer.

    Returns:
        By ``CLASS/NAME``: ``height_error_m``, the mean absolute difference, ``height_bias_m``,
        its mean with sign (predictions too high: > 0), ``plane_error_m``, the mean distance in
        the plane, and ``num_matches``; -1 without matches.

    Raises:
        ValueError: If a side has no heights.
    """
    flat = ChamferConfig(config.classes, config.thresholds, config.num_points)
    apart: dict[int, list[FloatArray]] = {label: [] for label in range(len(config.classes))}
    for token, predictions, truth in samples:
        matches = match_chamfer(predictions, truth, flat, token)
        pred, gt = (
            resample_all(side.with_coordinates(3).points, side.offsets, config.num_points)
            for side in (predictions, truth)
        )
        matched = matches.matched_gt[:, -1]
        for row in np.flatnonzero(matched >= 0).tolist():
            line, other = pred[matches.pred_index[row]], gt[matched[row]]
            distance = np.linalg.norm(line[:, None, :2] - other[None, :, :2], axis=-1)  # (P, P)
            nearest = distance.argmin(axis=1)
            values = line[:, 2] - other[nearest, 2], distance.min(axis=1)
            apart[matches.labels[row]].append(np.stack(values))
    figures: dict[str, float] = {}
    for label, name in enumerate(config.classes):
        heights, plane = np.concatenate([np.empty((2, 0)), *apart[label]], axis=1)
        for key, values in (
            ("height_error_m", abs(heights)), ("height_bias_m", heights), ("plane_error_m", plane),
        ):  # fmt: skip
            figures[f"{name}/{key}"] = float(values.mean()) if len(values) else UNDEFINED
        figures[f"{name}/num_matches"] = float(len(apart[label]))
    return figures
