"""AP per sample, a metric of older methods: lines are compared as masks, and AP is averaged.

The rules equal the public evaluation code of the methods that use this metric:

- The lines of a class in a sample are drawn to one mask with pixels of 0.15 m, in the order of the
  file. A pixel has the number of its line. A later line hides the pixels of earlier lines that it
  crosses.
- The directed distance from one line to another is the mean distance from the pixels of the first
  line to the nearest pixel of the second one. The distance of two lines is the mean of both
  directed distances.
- The closest pair below the threshold is matched first, regardless of its score.
- Predictions count in the order of *rising* score, and precision is taken at ten recalls.
- A sample with neither predictions nor ground truth of a class is left out for this class.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - reports that kernels are compiled
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
_FAR_PX = 2.0**20  # coordinates are clipped to this limit, as OpenCV draws with integers
# Distance in pixels in a column without pixels of the line. It is larger than any canvas.
_NO_PIXEL = 1e6
MaskArray = npt.NDArray[np.int32]
GapArray = npt.NDArray[np.float32]  # distances within the columns of a mask, in pixels


@dataclass(frozen=True)
class SampleAP(Metric):
    """Base class of AP per sample. Each method has a subclass in ``models/<method>/metric.py``.

    Attributes:
        ranks: Whether the metric ranks predictions over all samples. It is true, although AP is
            computed per sample: reports have the ranked ``detections`` of each class.
        takes_min_score: Whether the metric uses the setting ``min_score``.
        line_px: Thickness of lines in pixels.
        report_thresholds: Largest distances of a match in metres, by the name of the report.

    Args:
        classes: Names of the classes; a label is an index into them.
        grid: Extent of the canvas, the area of the masks, in metres; its raster is not used.
        min_score: Smallest score of a prediction that counts, in [0, 1]. With the default, all
            predictions count, as in the public code of the methods.

    Raises:
        ValueError: If ``classes`` has no names, or ``min_score`` is not in [0, 1].
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
    def from_settings(cls, settings: MetricSettings) -> "SampleAP":
        """Create the metric from the settings of a command or config.

        Raises:
            ValueError: If the settings have no extent of the map.
        """
        min_score = settings.min_score or 0.0  # None stands for the default
        return cls(classes=settings.classes, grid=settings.canvas, min_score=min_score)

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Thresholds of all reports in metres, ascending."""
        thresholds: set[float] = set()
        for report_thresholds in self.report_thresholds.values():
            thresholds.update(report_thresholds)
        return tuple(sorted(thresholds))

    def match(self, sample: Sample) -> FrameMatches:
        """Match the predictions of one sample with its ground truth (`match_sample_ap`)."""
        return match_sample_ap(
            sample.predictions, sample.ground_truth, config=self, token=sample.token
        )

    def reports(self, table: MatchTable) -> list[MetricReport]:
        """Compute the mean of AP over the samples (`sample_ap_reports`)."""
        return sample_ap_reports(table, self)

    @property
    def size_px(self) -> tuple[int, int]:
        """Columns (along x) and rows (along y) of the canvas."""
        x_m, y_m = self.grid.extent_m
        # 1e-6 is subtracted so that a rounding error does not add a column or a row.
        columns = int(np.ceil(x_m / PIXEL_M - 1e-6))
        rows = int(np.ceil(y_m / PIXEL_M - 1e-6))
        return columns, rows


def draw_numbers(elements: MapElements, label: int, config: SampleAP) -> MaskArray:
    """Draw the lines of a class to one mask of element indices. Later lines hide earlier ones.

    Pixel (0, 0) is at the corner of smallest x and y. Coordinates are truncated toward zero.

    Args:
        elements: Elements in metres; elements of fewer than two points are not drawn.
        label: Label of the class.
        config: Rules of the metric: extent of the canvas and thickness of lines.

    Returns:
        Index of the element at each pixel, or -1. (H, W)
    """
    import cv2  # imported here, because AP_chamfer and AP_raster do not need it

    columns, rows = config.size_px
    mask = np.zeros((rows, columns), dtype=np.int32)
    points = elements.with_coordinates(2).points
    origin = (config.grid.x_range[0], config.grid.y_range[0])
    pixels = (points - origin) / PIXEL_M
    pixels = np.clip(pixels, -_FAR_PX, _FAR_PX).astype(np.int32)
    is_drawn = (elements.labels == label) & (elements.num_points >= 2)
    for i in np.flatnonzero(is_drawn).tolist():
        line = pixels[elements.offsets[i] : elements.offsets[i + 1]]
        # Element i is drawn as i + 1, because the background is 0.
        cv2.polylines(mask, [line], isClosed=False, color=(i + 1,), thickness=config.line_px)
    return mask - 1


@dataclass(frozen=True)
class _MaskPixels:
    """Pixels of a mask of elements. The n elements that have a pixel get the numbers 0 to n - 1.

    Args:
        mask: Number of the element at each pixel, or -1. (H, W)
        indices: Index of each numbered element in the input of `draw_numbers`. (n,)
        rows: Row of each pixel. (M,)
        columns: Column of each pixel. (M,)
        owners: Number of the element of each pixel. The M pixels are sorted by it. (M,)
    """

    mask: MaskArray
    indices: IntArray
    rows: IntArray
    columns: IntArray
    owners: IntArray

    @classmethod
    def from_mask(cls, mask: MaskArray) -> "_MaskPixels":
        """List the pixels of a mask of element indices."""
        rows, columns = np.nonzero(mask >= 0)
        indices, owners = np.unique(mask[rows, columns], return_inverse=True)
        numbers = np.full(mask.shape, fill_value=-1, dtype=np.int32)
        numbers[rows, columns] = owners
        order = np.argsort(owners, kind="stable")
        return cls(
            mask=numbers,
            indices=indices.astype(np.int64),
            rows=rows[order],
            columns=columns[order],
            owners=owners[order],
        )

    @property
    def count(self) -> int:
        """Number of elements n."""
        return len(self.indices)

    def bounds(self, coordinates: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the smallest and the largest row, or column, of each element. (n,) each

        Args:
            coordinates: ``rows`` or ``columns``. (M,)
        """
        coordinates_px = coordinates.astype(np.float64)
        if not self.count:
            return coordinates_px, coordinates_px  # both are empty
        # The pixels are sorted by element. `starts` is the index of each element's first pixel.
        starts = np.searchsorted(self.owners, np.arange(self.count))
        smallest = np.minimum.reduceat(coordinates_px, starts)
        largest = np.maximum.reduceat(coordinates_px, starts)
        return smallest, largest


@njit(cache=True)
def _fill_gaps(gaps: GapArray, mask: MaskArray, number: int) -> None:
    """Measure the distance of each pixel to an element within the column of the pixel.

    Args:
        gaps: Output for the distances in pixels. (H, W)
        mask: Number of the element at each pixel, or -1. (H, W)
        number: Number of the element.
    """
    height, width = mask.shape
    # Row 0 has no row above. In the loop, it reads these distances in place of a row above.
    gaps[0] = _NO_PIXEL
    for r in range(height):  # distance from the nearest pixel above
        above = gaps[max(r - 1, 0)]
        for c in range(width):
            gaps[r, c] = 0.0 if mask[r, c] == number else above[c] + 1
    for r in range(height - 2, -1, -1):  # or from the nearest pixel below, if that is less
        for c in range(width):
            gaps[r, c] = min(gaps[r, c], gaps[r + 1, c] + 1)


@njit(cache=True)
def _distance_from_gaps(gaps: GapArray, column: int) -> float:
    """Compute the distance in pixels from a pixel to the nearest pixel of an element.

    Args:
        gaps: Distances from `_fill_gaps` in the row of the pixel. (W,)
        column: Column of the pixel.

    Returns:
        Distance in pixels.
    """
    # Squared distance to the nearest pixel of the element in the columns searched so far.
    best_sq = gaps[column] ** 2
    # The columns on both sides are searched. Pixels that are `step` columns away have at least the
    # distance `step`, so the search ends when `step` reaches the smallest distance so far.
    step = 1
    while step * step < best_sq and step < len(gaps):
        if column >= step:
            best_sq = min(best_sq, step * step + gaps[column - step] ** 2)
        if column + step < len(gaps):
            best_sq = min(best_sq, step * step + gaps[column + step] ** 2)
        step += 1
    return float(np.sqrt(best_sq))


@njit(cache=True)
def _mean_distances(
    mask: MaskArray, is_near: BoolArray, rows: IntArray, columns: IntArray, owners: IntArray
) -> FloatArray:
    """Compute the mean distance from the pixels of m other elements to each of N elements.

    Args:
        mask: Number (below N) of the element at each pixel, or -1. (H, W)
        is_near: Whether to measure each pair of one of the N and one of the m elements. (N, m)
        rows: Row of each pixel of the other elements. (M,)
        columns: Column of each pixel of the other elements. (M,)
        owners: Number (below m) of the other element of each pixel. (M,)

    Returns:
        Mean distances in pixels, infinite where they are not measured. (N, m)
    """
    sums = np.zeros(is_near.shape)
    counts = np.zeros(is_near.shape[1])
    for j in owners:
        counts[j] += 1
    gaps = np.empty(mask.shape, dtype=np.float32)
    for i in range(len(is_near)):
        if not is_near[i].any():
            continue
        _fill_gaps(gaps, mask=mask, number=i)
        for p in range(len(rows)):
            j = owners[p]
            if is_near[i, j]:
                sums[i, j] += _distance_from_gaps(gaps[rows[p]], column=columns[p])
    return np.where(is_near, sums / counts, np.inf)


def _squared_gaps(first: _MaskPixels, second: _MaskPixels, axis: str) -> FloatArray:
    """Compute squared gaps in pixels between the bounds of elements along an axis.

    Args:
        first: Pixels of n elements.
        second: Pixels of k elements.
        axis: ``rows`` or ``columns``, the coordinates that are compared.

    Returns:
        Squared gaps, 0 where the bounds overlap. (n, k)
    """
    first_low, first_high = first.bounds(getattr(first, axis))
    second_low, second_high = second.bounds(getattr(second, axis))
    gaps = np.maximum(second_low - first_high[:, None], first_low[:, None] - second_high)
    squared: FloatArray = np.square(np.maximum(gaps, 0.0))
    return squared


def line_distances(
    pred_mask: MaskArray, gt_mask: MaskArray, limit_m: float = np.inf
) -> tuple[FloatArray, IntArray, IntArray]:
    """Compute the distance of each prediction from each ground truth, for elements with a pixel.

    Args:
        pred_mask: Index of the prediction at each pixel, or -1. (H, W)
        gt_mask: Index of the ground truth at each pixel, or -1. (H, W)
        limit_m: Limit in metres. Pairs that cannot be closer than this are not measured, which
            saves time.

    Returns:
        Distances in metres, infinite where they are not measured (n, k); indices of the predictions
        with a pixel (n,); and indices of the ground truths with a pixel (k,).
    """
    pred = _MaskPixels.from_mask(pred_mask)
    gt = _MaskPixels.from_mask(gt_mask)
    # The distance of the bounding boxes is at most the distance of the lines.
    box_distances = np.sqrt(
        _squared_gaps(gt, pred, axis="rows") + _squared_gaps(gt, pred, axis="columns")
    )  # (k, n)
    is_near = box_distances * PIXEL_M < limit_m
    from_pred = _mean_distances(
        gt.mask, is_near=is_near, rows=pred.rows, columns=pred.columns, owners=pred.owners
    ).T  # (n, k)
    # The distance is the mean of both directions, so it is at least half of one direction. This
    # also leaves out the pairs whose `from_pred` is infinite.
    is_near = from_pred * PIXEL_M / 2 < limit_m
    from_gt = _mean_distances(
        pred.mask, is_near=is_near, rows=gt.rows, columns=gt.columns, owners=gt.owners
    )
    return (from_pred + from_gt) / 2 * PIXEL_M, pred.indices, gt.indices


def closest_pairs(distance_m: FloatArray, limit_m: float) -> IntArray:
    """Pair rows with columns greedily, the closest pair first.

    Args:
        distance_m: Distance of every pair in metres. (n, k)
        limit_m: Limit in metres. Only pairs with a smaller distance are matched.

    Returns:
        Column of each row, or -1. (n,)
    """
    remaining = distance_m.copy()  # matched rows and columns become infinite
    partners = np.full(len(distance_m), fill_value=-1)
    while remaining.size:
        row, column = np.unravel_index(remaining.argmin(), remaining.shape)
        if not remaining[row, column] < limit_m:  # the closest pair is too far apart
            break
        partners[row] = column
        remaining[row] = np.inf
        remaining[:, column] = np.inf
    return partners


def match_sample_ap(
    predictions: MapElements, ground_truth: MapElements, config: SampleAP, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth by the distance of their masks.

    Predictions and ground truths without a visible pixel do not count.

    Args:
        predictions: Elements with scores, in metres.
        ground_truth: Annotated elements at full resolution, in metres.
        config: Rules of the metric.
        token: Name of the sample.

    Returns:
        Visible predictions in descending order of score, with their matches at each of the T
        thresholds and the distances of their matches in metres, NaN without a match.

    Raises:
        ValueError: If a label is below -1 or beyond the classes, or predictions have no scores.
    """
    check_pair(predictions, ground_truth, classes=config.classes, token=token)
    thresholds = np.array(config.thresholds)
    limit_m = thresholds[-1]  # the largest one
    partners = np.full(len(predictions), fill_value=-1)  # ground truth of each prediction
    quality = np.full(len(predictions), fill_value=np.nan)  # distance of each match in metres
    is_visible = np.zeros(len(predictions), dtype=np.bool_)
    num_gts = np.zeros(len(config.classes), dtype=np.int64)
    confident = np.flatnonzero(predictions.confidence >= config.min_score)
    confident_predictions = predictions.select(confident)
    for label in range(len(config.classes)):
        pred_mask = draw_numbers(confident_predictions, label=label, config=config)
        gt_mask = draw_numbers(ground_truth, label=label, config=config)
        distance, pred_indices, gts = line_distances(pred_mask, gt_mask, limit_m=limit_m)
        preds = confident[pred_indices]  # index in `predictions` of each row of `distance`
        matched = closest_pairs(distance, limit_m)  # column of each row of `distance`, or -1
        is_match = matched >= 0
        is_visible[preds] = True
        num_gts[label] = len(gts)
        partners[preds[is_match]] = gts[matched[is_match]]
        quality[preds[is_match]] = distance[is_match, matched[is_match]]
    visible = np.flatnonzero(is_visible)
    ranked = visible[np.argsort(-predictions.confidence[visible], kind="stable")]
    within = quality[ranked, None] < thresholds  # False for NaN, without a match. (n, T)
    return FrameMatches(
        token=token,
        pred_index=ranked,
        labels=predictions.labels[ranked],
        scores=predictions.confidence[ranked],
        matched_gt=np.where(within, partners[ranked, None], -1),
        quality=quality[ranked],
        num_gts=num_gts,
    )


def sample_aps(detections: ClassDetections) -> FloatArray:
    """Compute the AP of a class in each sample.

    Predictions count in the order of rising score, as in the public code. Among equal scores,
    matched predictions come first.

    Args:
        detections: Predictions of the class in all S samples, in descending order of score, with
            their matches at T thresholds.

    Returns:
        AP in [0, 1]; NaN for a sample with neither predictions nor ground truth. (S, T)
    """
    num_gts = detections.gts_of_sample
    num_samples = len(num_gts)
    scores = detections.scores
    samples = detections.samples
    num_preds = np.bincount(samples, minlength=num_samples)
    aps = np.full((num_samples, len(detections.thresholds)), fill_value=np.nan)
    aps[num_preds + num_gts > 0] = 0.0  # replaced below in samples with a match
    # After `order` below, the predictions of sample s are entries starts[s] to ends[s] - 1.
    ends = np.cumsum(num_preds)
    starts = ends - num_preds
    for t, hits in enumerate(detections.hits.T):
        order = np.lexsort((~hits, scores, samples))  # by sample, then score, then matches first
        sorted_hits = hits[order]
        num_hits = np.bincount(samples, weights=hits, minlength=num_samples)  # (S,)
        for s in np.flatnonzero(num_hits > 0).tolist():
            hits_in_sample = sorted_hits[starts[s] : ends[s]]
            aps[s, t] = ten_point_ap(hits_in_sample, num_gts=int(num_gts[s]))
    return aps


def _mean(aps: FloatArray) -> float:
    """Compute the mean of the APs that are not NaN; `UNDEFINED` (-1) if there are none."""
    defined_aps = aps[~np.isnan(aps)]
    return float(defined_aps.mean()) if len(defined_aps) else UNDEFINED


def sample_ap_reports(matches: MatchTable, config: SampleAP) -> list[MetricReport]:
    """Compute the mean of AP over the samples, for each report of the method.

    Samples that have neither predictions nor ground truth of a class are left out for the class. A
    class that occurs in no sample is left out of the means.

    Args:
        matches: Matches of all samples by the rules of ``config``.
        config: Rules of the metric.

    Returns:
        One report per entry of ``config.report_thresholds``, in their order.
    """
    # All classes have the thresholds of all reports. `at` below selects the thresholds of a report.
    all_thresholds = dict.fromkeys(config.classes, config.thresholds)
    all_detections = matches.detections(all_thresholds)
    reports = []
    for name, thresholds in config.report_thresholds.items():
        detections: dict[str, ClassDetections] = {}
        aps: dict[str, FloatArray] = {}
        metrics: dict[str, float] = {}
        means = np.full((len(config.classes), len(thresholds)), fill_value=np.nan)
        for row, class_name in enumerate(all_detections):
            ranked = all_detections[class_name].at(thresholds)
            class_aps = sample_aps(ranked)
            class_means = [_mean(column) for column in class_aps.T]  # one column per threshold
            # Figures such as the AP and the mean distance of the matches at each threshold.
            for key, value in distance_figures(ranked, class_means).items():
                metrics[f"{class_name}/{key}"] = value
            # Whether the AP of a sample is defined does not depend on the threshold.
            num_samples = (~np.isnan(class_aps[:, 0])).sum()  # samples with a defined AP
            metrics[f"{class_name}/num_samples"] = float(num_samples)
            # An undefined mean is reported as UNDEFINED. Here it becomes NaN, so that `_mean` below
            # leaves it out.
            means[row] = np.where(np.equal(class_means, UNDEFINED), np.nan, class_means)
            detections[class_name] = ranked
            aps[class_name] = class_aps
        for t, threshold in enumerate(thresholds):
            metrics[f"AP@{threshold}"] = _mean(means[:, t])
        metrics["mAP"] = _mean(means.mean(axis=1))
        metrics["num_samples"] = float(len(matches))
        report = MetricReport(
            name=name,
            groups={"class": config.classes},
            metrics={f"{name}/{key}": value for key, value in metrics.items()},
            detections=detections,
            tokens=matches.tokens,
            sample_aps=aps,
        )
        reports.append(report)
    return reports
