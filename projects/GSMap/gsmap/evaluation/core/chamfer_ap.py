"""AP_chamfer of MapTR: nearest ground truth by Chamfer distance, area under the PR curve.

The Chamfer distance of two lines is the mean distance of the points of a line from the nearest
points of the other line, averaged over both directions.

Rules, equal to MapTR's evaluator:

- Every line is resampled to 100 points.
- A prediction is compared with its nearest ground truth alone. They match if their distance is
  within the threshold and no prediction with a higher score has taken the ground truth.
- Pairs whose 4 m wide strips do not touch never match.

With heights, distances are three-dimensional. Lines are still resampled at equal distances in the
plane, with interpolated heights, and strips are still compared in the plane.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.evaluation.core import chamfer_kernels as kernels
from gsmap.evaluation.core.average_precision import area_ap
from gsmap.evaluation.core.matches import (
    FrameMatches,
    MatchTable,
    assign,
    check_pair,
    checked_classes,
    ranked_predictions,
)
from gsmap.evaluation.core.metric import Metric, MetricSettings, Sample, register_metric
from gsmap.evaluation.core.report import MetricReport, distance_figures
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError

CHAMFER_THRESHOLDS = (0.5, 1.0, 1.5)  # in metres
HARD_CHAMFER_THRESHOLDS = (0.2, 0.5, 1.0)  # in metres
STRIP_HALF_WIDTH_M = 2.0


def checked_thresholds(thresholds: Sequence[float]) -> tuple[float, ...]:
    """Check the largest Chamfer distances of a match.

    Args:
        thresholds: Distances in metres, at least one, each > 0.

    Returns:
        The distances in ascending order, each once, rounded to micrometres.

    Raises:
        ValueError: If there is no distance, or a distance is not a finite number > 0.
    """
    try:
        rounded = sorted({round(float(value), ndigits=6) for value in thresholds})
    except (TypeError, ValueError):
        rounded = []  # reported by the next check
    if not (rounded and all(0 < value < math.inf for value in rounded)):  # false for NaN, too
        raise InputError(f"thresholds must be > 0 m, at least one, got {thresholds!r:.80}.")
    return tuple(rounded)


@register_metric
@dataclass(frozen=True)
class ChamferConfig(Metric):
    """Metric AP_chamfer with its rules.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Largest Chamfer distances of a match, in metres; stored in ascending order.
        num_points: Number of points that each line is resampled to.
        resample_predictions: Whether predictions are resampled.
        resample_ground_truth: Whether ground truth is resampled.
        dim: Number of coordinates that distances count: 2, or 3 if both sides have heights.

    Raises:
        ValueError: If a value is out of its range.
    """

    name: ClassVar[str] = "chamfer"
    ranks: ClassVar[bool] = True  # predictions are ranked over all samples
    has_curves: ClassVar[bool] = True  # precision-recall curves can be drawn
    takes_thresholds: ClassVar[bool] = True

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    num_points: int = 100
    resample_predictions: bool = True
    resample_ground_truth: bool = True
    dim: int = 2

    def __post_init__(self) -> None:
        # `object.__setattr__` is needed because the dataclass is frozen.
        object.__setattr__(self, "thresholds", checked_thresholds(self.thresholds))
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if self.num_points < 2:
            raise InputError(f"num_points must be >= 2, got {self.num_points}.")
        if self.dim not in (2, 3):
            raise InputError(f"dim must be 2 or 3, got {self.dim!r}.")

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "ChamferConfig":
        """Create the metric from the settings of a command or config."""
        return cls(
            classes=settings.classes,
            thresholds=settings.thresholds or CHAMFER_THRESHOLDS,
            resample_predictions=settings.resample_predictions,
            resample_ground_truth=settings.resample_ground_truth,
            dim=settings.dim,
        )

    @property
    def counts_heights(self) -> bool:
        """Whether heights (z) count, so that distances are three-dimensional."""
        return self.dim == 3

    def match(self, sample: Sample) -> FrameMatches:
        """Match the predictions of one sample with its ground truth (`match_chamfer`)."""
        return _match(sample, self)

    def reports(self, table: MatchTable) -> list[MetricReport]:
        """Compute AP_chamfer from the matches of all samples (`chamfer_report`)."""
        return [chamfer_report(table, self)]


@register_metric
@dataclass(frozen=True)
class HardChamferConfig(ChamferConfig):
    """AP_chamfer at 0.2, 0.5 and 1.0 m, reported together with AP_chamfer."""

    name: ClassVar[str] = "chamfer_hard"
    companions: ClassVar[tuple[str, ...]] = ("chamfer",)  # metrics that are reported, too
    takes_thresholds: ClassVar[bool] = False

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "HardChamferConfig":
        """Create the metric from the settings of a command or config, except the thresholds."""
        # All fields of the usual metric, with other thresholds.
        rules = vars(ChamferConfig.from_settings(settings)) | {
            "thresholds": HARD_CHAMFER_THRESHOLDS
        }
        return cls(**rules)


def _lines(elements: MapElements, config: ChamferConfig, resample: bool) -> kernels.Lines:
    """Convert the elements of one sample to the input format of the compiled kernels.

    Returns:
        Coordinates of the points of all lines in metres (3, M), offsets (N + 1,) and labels (N,).
        Line i has the points ``offsets[i]:offsets[i + 1]``.
    """
    points = elements.with_coordinates(config.dim).points  # (M, dim)
    offsets = elements.offsets
    if resample:
        coordinates = kernels.resample_lines(
            np.ascontiguousarray(points), offsets=offsets, num_points=config.num_points
        )
        offsets = np.arange(len(elements) + 1) * config.num_points
    else:
        coordinates = np.zeros((3, len(points)))  # z stays 0 if distances are in the plane
        coordinates[: config.dim] = points.T
    return coordinates, offsets, elements.labels


def _line(lines: kernels.Lines, index: int) -> FloatArray:
    """Return the points of one line. (3, P)"""
    points, offsets, _ = lines
    return points[:, offsets[index] : offsets[index + 1]]


def _strips_touch(first: FloatArray, second: FloatArray) -> bool:
    """Whether the 4 m wide strips around two lines intersect; ends are flat, corners mitred."""
    # Fast check for almost all pairs: a point of `first` beside a segment of `second` is in the
    # strips of both lines.
    if kernels.beside_a_segment(first, second, STRIP_HALF_WIDTH_M):
        return True
    import shapely  # only a handful of pairs per thousand frames reach this line

    lines = [shapely.LineString(line[:2].T) for line in (first, second)]
    first_strip, second_strip = shapely.buffer(
        lines, STRIP_HALF_WIDTH_M, quad_segs=16, cap_style="flat", join_style="mitre"
    )
    return bool(shapely.intersects(first_strip, second_strip))


def nearest_by_chamfer(
    predictions: MapElements,
    ground_truth: MapElements,
    config: ChamferConfig,
    max_distance: float = np.inf,
) -> tuple[IntArray, FloatArray]:
    """Find the nearest ground truth of each prediction by Chamfer distance.

    Only ground truths of the class of the prediction count, and only if the strips of both touch.

    Args:
        predictions: The N predicted elements.
        ground_truth: The K annotated elements.
        config: Rules of resampling and of heights.
        max_distance: Largest Chamfer distance in metres. Farther ground truths are ignored.

    Returns:
        Two arrays: index of the ground truth, and its Chamfer distance in metres. Without a ground
        truth within ``max_distance``, the index is -1 and the distance is infinite. (N,) each

    Raises:
        ValueError: If heights count, and the predictions or the ground truth have no heights.
    """
    pred = _lines(predictions, config, resample=config.resample_predictions)
    gt = _lines(ground_truth, config, resample=config.resample_ground_truth)
    # Distances (N, K + 1) are infinite for other classes and beyond `max_distance`. The last column
    # is infinite, so that argmin exists without ground truth.
    distances = kernels.pair_distances(pred, gt=gt, max_distance=max_distance)
    nearest = distances.argmin(axis=1)
    has_candidates = np.isfinite(distances).any(axis=1)
    for row in np.flatnonzero(has_candidates).tolist():
        line = _line(pred, index=row)
        k = nearest[row]
        # Exclude the nearest ground truth as long as its strip does not touch the prediction's.
        while np.isfinite(distances[row, k]) and not _strips_touch(line, _line(gt, index=k)):
            distances[row, k] = np.inf
            k = distances[row].argmin()
            nearest[row] = k
    distance = distances.min(axis=1)
    return np.where(np.isfinite(distance), nearest, -1), distance


def match_chamfer(
    predictions: MapElements, ground_truth: MapElements, config: ChamferConfig, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth.

    Args:
        predictions: Elements with scores. Elements of fewer than two points are dropped.
        ground_truth: Annotated elements. An element without length, or of fewer than two points,
            counts as ground truth that no prediction can match.
        config: Rules of the metric.
        token: Name of the sample.

    Raises:
        ValueError: If heights count, and the predictions or the ground truth have no heights; if a
            label does not fit the classes; or if predictions have no scores (`check_pair`).
    """
    return _match(Sample(token, predictions, ground_truth), config)


def _nearest(sample: Sample, config: ChamferConfig) -> tuple[IntArray, FloatArray]:
    """Return `nearest_by_chamfer` of a sample, cached for other metrics with equal rules."""
    rules = (
        config.num_points,
        config.resample_predictions,
        config.resample_ground_truth,
        config.dim,
    )
    limit = config.thresholds[-1]  # the loosest threshold
    # A cached result with a larger limit can be used, because the caller applies the thresholds.
    # Without a cached result, the limit is -inf, so the distances are computed.
    cached_limit, nearest = sample.cache.get(rules, (-np.inf, None))
    if cached_limit < limit:
        nearest = nearest_by_chamfer(
            sample.predictions, sample.ground_truth, config=config, max_distance=limit
        )
        sample.cache[rules] = (limit, nearest)
    index, distance = nearest
    return index, distance


def _match(sample: Sample, config: ChamferConfig) -> FrameMatches:
    """Match the predictions of one sample as `match_chamfer` does, with the cache of the sample."""
    token = sample.token
    predictions = sample.predictions
    ground_truth = sample.ground_truth
    check_pair(predictions, ground_truth, classes=config.classes, token=token)
    num_classes = len(config.classes)
    try:
        nearest, distance = _nearest(sample, config)
    except ValueError as error:
        raise InputError(f"sample {token!r}, AP_chamfer of dim {config.dim}: {error}") from error
    # Indices of the predictions that count, in descending order of score. (n,)
    rows = ranked_predictions(predictions, num_classes=num_classes)
    # `assign` matches in the order of the rows, and prefers the largest quality. Quality is the
    # negative distance of the nearest ground truth, and -inf for all others. Without a ground
    # truth, `nearest` is -1 and the infinite distance is written to the additional last column.
    quality = np.full((len(rows), len(ground_truth) + 1), -np.inf)
    quality[np.arange(len(rows)), nearest[rows]] = -distance[rows]
    min_quality = np.tile(np.negative(config.thresholds), reps=(len(rows), 1))
    matched_gt = assign(quality, thresholds=min_quality)  # -1 without a match. (n, T)
    is_match = (matched_gt >= 0).any(axis=1)
    num_gts = (ground_truth.labels == np.arange(num_classes)[:, None]).sum(axis=1)  # (C,)
    return FrameMatches(
        token=token,
        pred_index=rows,
        labels=predictions.labels[rows],
        scores=predictions.confidence[rows],
        matched_gt=matched_gt,
        quality=np.where(is_match, distance[rows], np.nan),
        num_gts=num_gts,
    )


def chamfer_report(matches: MatchTable, config: ChamferConfig) -> MetricReport:
    """Compute AP_chamfer from the matches of all samples.

    A class without ground truth is left out of the means, as in AP_raster; MapTR counts it as 0 in
    ``mAP``. ``num_absent_classes`` is the number of such classes.

    Args:
        matches: Matches of all samples by the rules of ``config``.
        config: Rules of the metric. Its name is the prefix of the keys of the figures.

    Returns:
        Report with keys such as ``chamfer/divider/AP@0.5`` and ``chamfer/mAP``. A mean is 0 if no
        class has ground truth.
    """
    thresholds = dict.fromkeys(config.classes, config.thresholds)
    # Predictions of each class, ranked over all samples, with their hits at each threshold. (N, T)
    detections = matches.detections(thresholds)
    metrics: dict[str, float] = {}
    present = []  # classes with ground truth
    for class_name, ranked in detections.items():
        aps = [area_ap(hits, num_gts=ranked.num_gts) for hits in ranked.hits.T]
        # The figures are the AP at each threshold and their mean, recalls, distances and counts.
        for key, value in distance_figures(ranked, aps).items():
            metrics[f"{class_name}/{key}"] = value
        if ranked.num_gts:
            present.append(class_name)
    keys = {"mAP": "AP"}  # from the key of a mean to the key of the averaged figure of each class
    for threshold in config.thresholds:
        keys[f"AP@{threshold}"] = f"AP@{threshold}"
    for mean_key, key in keys.items():
        class_aps = [metrics[f"{class_name}/{key}"] for class_name in present]
        metrics[mean_key] = float(np.mean(class_aps)) if class_aps else 0.0
    metrics["num_absent_classes"] = float(len(config.classes) - len(present))
    metrics["num_samples"] = float(len(matches))
    return MetricReport(
        name=config.name,
        groups={"class": config.classes},
        metrics={f"{config.name}/{key}": value for key, value in metrics.items()},
        detections=detections,
        tokens=matches.tokens,
    )
