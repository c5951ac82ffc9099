"""AP per sample of older methods: lines drawn as masks, then the mean over samples.

Rules (those of both released evaluators): the lines of a class and sample are drawn into one mask
of 0.15 m pixels in the order of the file, so a later line hides what it crosses. The distance of
two lines is the mean of both mean distances from a pixel of one to the nearest of the other. The
closest pair below the threshold matches first, whatever its score. Predictions are then counted in
the order of RISING score, and precision is taken at ten recalls. A sample with either predictions
or ground truth of the class counts, one without both does not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.evaluation.core.average_precision import ten_point_ap
from gsmap.evaluation.core.matches import (
    ClassDetections,
    FrameMatches,
    MatchTable,
    check_pair,
    checked_classes,
)
from gsmap.evaluation.core.metric import Metric, MetricSettings, Sample
from gsmap.evaluation.core.report import UNDEFINED, MetricReport, distance_figures
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

PIXEL_M = 0.15
_FAR_PX = 2.0**20  # farther points are pulled in, so that they fit the integers of the drawing
_NO_PIXEL = 1e6  # distance in pixels where a column has none, beyond any canvas
MaskArray = npt.NDArray[np.int32]
GapArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class SampleAP(Metric):
    """AP per sample; a method's own is a subclass in its folder.

    Attributes:
        line_px: Thickness of lines in pixels.
        report_thresholds: Thresholds of a match in metres, by the name of the figures.

    Args:
        classes: Names of the classes; a label is an index into them.
        grid: Extent of the canvas; its raster is not used.
        min_score: Predictions with a lower score are left out. The released evaluators count all.

    Raises:
        ValueError: If a value is out of its range.
    """

    ranks: ClassVar[bool] = True
    takes_min_score: ClassVar[bool] = True
    line_px: ClassVar[int]
    report_thresholds: ClassVar[Mapping[str, tuple[float, ...]]]

    classes: tuple[str, ...]
    grid: BEVGrid
    min_score: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if not 0 <= self.min_score <= 1:
            raise InputError(f"min_score must be in [0, 1], got {self.min_score}.")

    @classmethod
    def of(cls, settings: MetricSettings) -> "SampleAP":
        """Return the metric by the settings of a command or config."""
        return cls(settings.classes, settings.canvas, settings.min_score or 0.0)

    @property
    def thresholds(self) -> tuple[float, ...]:
        """All thresholds, ascending."""
        return tuple(sorted({t for own in self.report_thresholds.values() for t in own}))

    def match(self, sample: Sample) -> FrameMatches:
        """Match the predictions of one sample with its ground truth (`match_sample_ap`)."""
        return match_sample_ap(sample.predictions, sample.ground_truth, self, sample.token)

    def reports(self, table: MatchTable) -> list[MetricReport]:
        """Compute the mean of AP over the samples (`sample_ap_reports`)."""
        return sample_ap_reports(table, self)

    @property
    def size_px(self) -> tuple[int, int]:
        """Columns (along x) and rows (along y) of the canvas."""
        columns, rows = (int(np.ceil(extent / PIXEL_M - 1e-6)) for extent in self.grid.extent_m)
        return columns, rows


def draw_numbers(elements: MapElements, label: int, config: SampleAP) -> MaskArray:
    """Draw the lines of a class into one mask, each with its number; later ones hide earlier ones.

    Points are cut to whole pixels toward zero, counted from the corner of least x and y.

    Args:
        elements: N elements; those of fewer than two points are not drawn.
        label: The class.
        config: The metric's settings.

    Returns:
        Index of the element that a pixel belongs to, or -1. (H, W)
    """
    import cv2  # AP_chamfer and AP_raster do without it

    columns, rows = config.size_px
    mask = np.zeros((rows, columns), np.int32)
    points = elements.with_coordinates(2).points
    pixels = (points - (config.grid.x_range[0], config.grid.y_range[0])) / PIXEL_M
    pixels = np.clip(pixels, -_FAR_PX, _FAR_PX).astype(np.int32)
    for i in np.flatnonzero((elements.labels == label) & (elements.num_points >= 2)).tolist():
        line = pixels[elements.offsets[i] : elements.offsets[i + 1]]
        cv2.polylines(mask, [line], isClosed=False, color=(i + 1,), thickness=config.line_px)
    return mask - 1


@dataclass(frozen=True)
class _Pixels:
    """The pixels of all elements of a mask.

    Args:
        mask: Number of the element that a pixel belongs to, or -1. (H, W)
        indices: What the elements are called outside, by their numbers. (n,)
        rows: Rows of all pixels that belong to one. (M,)
        columns: Their columns. (M,)
        owners: Numbers of their elements, ascending. (M,)
    """

    mask: MaskArray
    indices: IntArray
    rows: IntArray
    columns: IntArray
    owners: IntArray

    @classmethod
    def of(cls, mask: MaskArray) -> "_Pixels":
        """Number the elements of a mask anew, without those that have no pixel."""
        rows, columns = np.nonzero(mask >= 0)
        indices, owners = np.unique(mask[rows, columns], return_inverse=True)
        numbered = np.full(mask.shape, -1, np.int32)
        numbered[rows, columns] = owners
        order = np.argsort(owners, kind="stable")
        return cls(numbered, indices.astype(np.int64), rows[order], columns[order], owners[order])

    @property
    def count(self) -> int:
        """How many elements there are."""
        return len(self.indices)

    def bounds(self, along: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest of the rows, or of the columns, of each. 2 x (n,)"""
        starts = np.searchsorted(self.owners, np.arange(self.count))
        values = along.astype(np.float64)
        if not self.count:
            return values, values
        return np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)


@njit(cache=True)
def _fill_gaps(gap: GapArray, mask: MaskArray, number: int) -> None:
    """Write the distance in pixels to the nearest one of an element in the same column. (H, W)"""
    height, width = mask.shape
    gap[0] = _NO_PIXEL
    for r in range(height):
        above = gap[max(r - 1, 0)]
        for c in range(width):
            gap[r, c] = 0.0 if mask[r, c] == number else above[c] + 1
    for r in range(height - 2, -1, -1):
        for c in range(width):
            gap[r, c] = min(gap[r, c], gap[r + 1, c] + 1)


@njit(cache=True)
def _nearest(gaps: GapArray, column: int) -> float:
    """Return the distance in pixels to the nearest one of an element, from gaps of a row. (W,)"""
    best, step = gaps[column] ** 2, 1
    while step * step < best and step < len(gaps):
        if column >= step:
            best = min(best, step * step + gaps[column - step] ** 2)
        if column + step < len(gaps):
            best = min(best, step * step + gaps[column + step] ** 2)
        step += 1
    return float(np.sqrt(best))


@njit(cache=True)
def _mean_distances(
    mask: MaskArray, wanted: BoolArray, rows: IntArray, columns: IntArray, owners: IntArray
) -> FloatArray:
    """Return the mean distance from the pixels of other elements to each element of a mask.

    Args:
        mask: Number of the element that a pixel belongs to, or -1. (H, W)
        wanted: Which pairs to measure; the others are infinitely far. (N, m)
        rows: Rows of all pixels of the other elements. (M,)
        columns: Their columns. (M,)
        owners: Numbers of the elements that they belong to. (M,)

    Returns:
        Mean distances in pixels. (N, m)
    """
    sums, counts = np.zeros(wanted.shape), np.zeros(wanted.shape[1])
    for j in owners:
        counts[j] += 1
    gap = np.empty(mask.shape, np.float32)
    for i in range(len(wanted)):
        if not wanted[i].any():
            continue
        _fill_gaps(gap, mask, i)
        for p in range(len(rows)):
            if wanted[i, owners[p]]:
                sums[i, owners[p]] += _nearest(gap[rows[p]], columns[p])
    return np.where(wanted, sums / counts, np.inf)


def _box_distances(first: _Pixels, second: _Pixels) -> FloatArray:
    """Return the distance of the boxes around every two elements, in pixels. (n, k)"""
    total = np.zeros((first.count, second.count))
    for one, other in ((first.rows, second.rows), (first.columns, second.columns)):
        (low, high), (other_low, other_high) = first.bounds(one), second.bounds(other)
        apart = np.maximum(other_low - high[:, None], low[:, None] - other_high)
        total += np.maximum(apart, 0.0) ** 2
    return np.sqrt(total)


def line_distances(
    found: MaskArray, true: MaskArray, limit_m: float = np.inf
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the distance of every two lines of two masks.

    Args:
        found: Index of the prediction that a pixel belongs to, or -1. (H, W)
        true: Index of the ground truth, likewise. (H, W)
        limit_m: Pairs that cannot be closer are not measured to the end.

    Returns:
        Distances in metres, infinite beyond the limit (n, k); the indices of the predictions that
        have a pixel (n,) and of the ground truths that have one (k,).
    """
    pred, gt = _Pixels.of(found), _Pixels.of(true)
    near = _box_distances(gt, pred) * PIXEL_M < limit_m  # (k, n)
    from_pred = _mean_distances(gt.mask, near, pred.rows, pred.columns, pred.owners).T
    near = from_pred * PIXEL_M / 2 < limit_m  # (n, k)
    from_gt = _mean_distances(pred.mask, near, gt.rows, gt.columns, gt.owners)
    return (from_pred + from_gt) / 2 * PIXEL_M, pred.indices, gt.indices


def closest_pairs(distance_m: FloatArray, limit_m: float) -> IntArray:
    """Pair the closest of two sides again and again while they are below a limit.

    Args:
        distance_m: Distance of every pair. (n, k)
        limit_m: What it must be below.

    Returns:
        Partner of each row, or -1. (n,)
    """
    free, partner = distance_m.copy(), np.full(len(distance_m), -1)
    while free.size:
        i, j = np.unravel_index(free.argmin(), free.shape)
        if not free[i, j] < limit_m:
            break
        partner[i] = j
        free[i], free[:, j] = np.inf, np.inf
    return partner


def match_sample_ap(
    predictions: MapElements, ground_truth: MapElements, config: SampleAP, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth by the distance of their masks.

    Only elements that have a pixel left count, on both sides.

    Args:
        predictions: Elements with scores.
        ground_truth: Elements at full resolution.
        config: The metric's settings.
        token: The sample's name.

    Raises:
        ValueError: As of `check_pair`.
    """
    check_pair(predictions, ground_truth, config.classes, token)
    thresholds = np.array(config.thresholds)
    partner = np.full(len(predictions), -1)
    quality = np.full(len(predictions), np.nan)
    visible = np.zeros(len(predictions), np.bool_)
    num_gts = np.zeros(len(config.classes), np.int64)
    chosen = np.flatnonzero(predictions.confidence >= config.min_score)
    for label in range(len(config.classes)):
        masks = (
            draw_numbers(predictions.select(chosen), label, config),
            draw_numbers(ground_truth, label, config),
        )
        distance, drawn, true = line_distances(*masks, thresholds[-1])
        own = chosen[drawn]
        matched = closest_pairs(distance, thresholds[-1])
        hits = matched >= 0
        visible[own], num_gts[label] = True, len(true)
        partner[own[hits]] = true[matched[hits]]
        quality[own[hits]] = distance[hits, matched[hits]]
    rows = np.flatnonzero(visible)
    rows = rows[np.argsort(-predictions.confidence[rows], kind="stable")]
    matched_gt = np.where(quality[rows, None] < thresholds, partner[rows, None], -1)
    labels, scores = predictions.labels[rows], predictions.confidence[rows]
    return FrameMatches(token, rows, labels, scores, matched_gt, quality[rows], num_gts)


def sample_aps(found: ClassDetections) -> FloatArray:
    """Return the AP of a class in each sample, NaN where it has neither side. (S, T)

    Predictions count in the order of rising score, as released; of equal scores matches go first.
    """
    gts = found.gts_of_sample
    numbers = np.bincount(found.samples, minlength=len(gts))
    aps = np.where((numbers + gts > 0)[:, None], np.zeros(len(found.thresholds)), np.nan)
    ends = np.cumsum(numbers)
    for t, hits in enumerate(found.hits.T):
        ordered = hits[np.lexsort((~hits, found.scores, found.samples))]
        some = np.bincount(found.samples, hits, len(gts)) > 0
        for s in np.flatnonzero(some).tolist():
            aps[s, t] = ten_point_ap(ordered[ends[s] - numbers[s] : ends[s]], int(gts[s]))
    return aps


def _mean(values: FloatArray) -> float:
    """Return the mean of the values that are defined."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else UNDEFINED


def sample_ap_reports(matches: MatchTable, config: SampleAP) -> list[MetricReport]:
    """Compute the mean of AP over the samples, at each set of thresholds of the method.

    Samples without predictions and ground truth of a class do not count for it; a class that
    occurs nowhere is left out of the means.
    """
    classes = config.classes
    everything = matches.detections(dict.fromkeys(classes, config.thresholds))
    reports = []
    for name, thresholds in config.report_thresholds.items():
        detections = {of_class: found.at(thresholds) for of_class, found in everything.items()}
        aps = {of_class: sample_aps(found) for of_class, found in detections.items()}
        metrics: dict[str, float] = {}
        means = np.full((len(classes), len(thresholds)), np.nan)
        for row, (of_class, found) in enumerate(detections.items()):
            own = [_mean(values) for values in aps[of_class].T]
            metrics |= {f"{of_class}/{k}": v for k, v in distance_figures(found, own).items()}
            metrics[f"{of_class}/num_samples"] = float((~np.isnan(aps[of_class][:, 0])).sum())
            means[row] = [np.nan if ap == UNDEFINED else ap for ap in own]
        for t, threshold in enumerate(thresholds):
            metrics[f"AP@{threshold}"] = _mean(means[:, t])
        metrics["mAP"] = _mean(means.mean(axis=1))
        metrics["num_samples"] = float(len(matches))
        flat = {f"{name}/{key}": value for key, value in metrics.items()}
        groups = {"class": classes}
        reports.append(MetricReport(name, groups, flat, detections, matches.tokens, aps))
    return reports
