"""AP_chamfer of MapTR: nearest ground truth by Chamfer distance, area under the PR curve.

Rules (equal to MapTR's evaluator): every line is resampled to 100 points; a prediction looks only
at its nearest ground truth and matches if the distance is within the threshold and no prediction
with a higher score has taken it; pairs whose 4 m wide strips do not touch never match. With
heights, distances are in space; lines are resampled and strips touch in the plane.
"""

import math
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

CHAMFER_THRESHOLDS = (0.5, 1.0, 1.5)
HARD_CHAMFER_THRESHOLDS = (0.2, 0.5, 1.0)
STRIP_HALF_WIDTH_M = 2.0


@register_metric
@dataclass(frozen=True)
class ChamferConfig(Metric):
    """AP_chamfer and its rules.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Largest Chamfer distances of a match, in metres.
        num_points: Points that each line is resampled to.
        resample_predictions: If False, predictions are compared at the points they come with.
        resample_ground_truth: If False, ground truth is compared at its own vertices.
        dim: Coordinates that distances count: 2, or 3 with heights, which both sides must have.

    Raises:
        ValueError: If a value is out of its range.
    """

    name: ClassVar[str] = "chamfer"
    ranks: ClassVar[bool] = True
    has_curves: ClassVar[bool] = True

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    num_points: int = 100
    resample_predictions: bool = True
    resample_ground_truth: bool = True
    dim: int = 2

    def __post_init__(self) -> None:
        thresholds = tuple(sorted(round(float(t), 6) for t in self.thresholds))
        object.__setattr__(self, "thresholds", thresholds)
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if not (thresholds and 0 < thresholds[0] <= thresholds[-1] < math.inf):
            raise InputError(f"thresholds must be > 0 m, at least one, got {thresholds}.")
        if self.num_points < 2:
            raise InputError(f"num_points must be >= 2, got {self.num_points}.")
        if self.dim not in (2, 3):
            raise InputError(f"dim must be 2 or 3, got {self.dim!r}.")

    @classmethod
    def of(cls, settings: MetricSettings) -> "ChamferConfig":
        """Return the metric by the settings of a command or config."""
        return cls(
            settings.classes,
            settings.thresholds or CHAMFER_THRESHOLDS,
            resample_predictions=settings.resample_predictions,
            resample_ground_truth=settings.resample_ground_truth,
            dim=settings.dim,
        )

    @property
    def counts_heights(self) -> bool:
        """Whether distances are in space."""
        return self.dim == 3

    def match(self, sample: Sample) -> FrameMatches:
        """Match the predictions of one sample with its ground truth (`match_chamfer`)."""
        return _matches(sample, self)

    def reports(self, table: MatchTable) -> list[MetricReport]:
        """Compute AP_chamfer from the matches of all samples (`chamfer_report`)."""
        return [chamfer_report(table, self)]


@register_metric
@dataclass(frozen=True)
class HardChamferConfig(ChamferConfig):
    """AP_chamfer at 0.2, 0.5 and 1.0 m beside the other thresholds."""

    name: ClassVar[str] = "chamfer_hard"
    beside: ClassVar[tuple[str, ...]] = ("chamfer",)

    @classmethod
    def of(cls, settings: MetricSettings) -> "HardChamferConfig":
        """Return the metric by the settings of a command or config, but for the thresholds."""
        return cls(**vars(ChamferConfig.of(settings)) | {"thresholds": HARD_CHAMFER_THRESHOLDS})


def _lines(elements: MapElements, config: ChamferConfig, resample: bool) -> kernels.Lines:
    """Resample, or keep, the lines of one sample."""
    points, offsets = elements.with_coordinates(config.dim).points, elements.offsets
    if resample:
        rows = kernels.resampled(np.ascontiguousarray(points), offsets, config.num_points)
        return rows, np.arange(len(elements) + 1) * config.num_points, elements.labels
    rows = np.zeros((3, len(points)))
    rows[: config.dim] = points.T
    return rows, offsets, elements.labels


def _strips_touch(first: FloatArray, second: FloatArray) -> bool:
    """Whether the strips around two lines intersect: flat ends, mitred corners, 4 m wide."""
    if kernels.beside_a_segment(first, second, STRIP_HALF_WIDTH_M):
        return True
    import shapely  # only a handful of pairs per thousand frames come here

    lines = [shapely.LineString(line[:2].T) for line in (first, second)]
    strips = shapely.buffer(
        lines, STRIP_HALF_WIDTH_M, quad_segs=16, cap_style="flat", join_style="mitre"
    )
    return bool(shapely.intersects(*strips))


def nearest_by_chamfer(
    predictions: MapElements,
    ground_truth: MapElements,
    config: ChamferConfig,
    max_distance: float = np.inf,
) -> tuple[IntArray, FloatArray]:
    """Find the nearest ground truth of each prediction among those whose strips touch its own.

    Args:
        predictions: N elements.
        ground_truth: Elements they may be.
        config: How lines are resampled and whether heights count.
        max_distance: Chamfer distance beyond which there is none, in metres.

    Returns:
        Its index, or -1 if none is within ``max_distance`` metres, and its Chamfer distance in
        metres, or infinity. 2 x (N,)

    Raises:
        ValueError: If heights count, and a side has none.
    """
    pred = _lines(predictions, config, config.resample_predictions)
    gt = _lines(ground_truth, config, config.resample_ground_truth)
    distances = kernels.pair_distances(pred, gt, max_distance)
    best = distances.argmin(axis=1)
    for row in np.flatnonzero(np.isfinite(distances).any(axis=1)).tolist():
        line, k = _line(pred, row), best[row]
        while np.isfinite(distances[row, k]) and not _strips_touch(line, _line(gt, k)):
            distances[row, k] = np.inf
            k = best[row] = distances[row].argmin()
    distance = distances.min(axis=1)
    return np.where(np.isfinite(distance), best, -1), distance


def _line(lines: kernels.Lines, index: int) -> FloatArray:
    """Return the points of one line. (3, P)"""
    points, offsets, _ = lines
    return points[:, offsets[index] : offsets[index + 1]]


def match_chamfer(
    predictions: MapElements, ground_truth: MapElements, config: ChamferConfig, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth.

    Args:
        predictions: Elements with scores; those of fewer than two points are dropped.
        ground_truth: Elements; one of zero length, or of fewer than two points, counts as one that
            nobody can match.
        config: The metric's settings.
        token: The sample's name.

    Raises:
        ValueError: If heights count, and a side has none; or as of `check_pair`.
    """
    return _matches(Sample(token, predictions, ground_truth), config)


def _nearest(sample: Sample, config: ChamferConfig) -> tuple[IntArray, FloatArray]:
    """Return `nearest_by_chamfer` of a sample, which metrics by the same rules share."""
    rules = config.num_points, config.resample_predictions, config.resample_ground_truth, config.dim
    limit = config.thresholds[-1]
    known = sample.shared.get(rules)
    if known is None or known[0] < limit:
        nearest = nearest_by_chamfer(sample.predictions, sample.ground_truth, config, limit)
        known = sample.shared[rules] = limit, nearest
    best, distance = known[1]
    return best, distance


def _matches(sample: Sample, config: ChamferConfig) -> FrameMatches:
    """Match the predictions of one sample with its ground truth."""
    token, predictions, ground_truth = sample
    check_pair(predictions, ground_truth, config.classes, token)
    num_classes = len(config.classes)
    try:
        best, distance = _nearest(sample, config)
    except ValueError as error:
        raise InputError(f"sample {token!r}, AP_chamfer of dim {config.dim}: {error}") from error
    rows = ranked_predictions(predictions, num_classes)
    fit = np.full((len(rows), len(ground_truth) + 1), -np.inf)
    fit[np.arange(len(rows)), best[rows]] = -distance[rows]  # in the last column without a nearest
    matched = assign(fit, np.tile(np.negative(config.thresholds), (len(rows), 1)))
    quality = np.where((matched >= 0).any(axis=1), distance[rows], np.nan)
    num_gts = (ground_truth.labels == np.arange(num_classes)[:, None]).sum(axis=1)
    labels, scores = predictions.labels[rows], predictions.confidence[rows]
    return FrameMatches(token, rows, labels, scores, matched, quality, num_gts)


def chamfer_report(matches: MatchTable, config: ChamferConfig) -> MetricReport:
    """Compute AP_chamfer from the matches of all samples.

    A class without ground truth counts in no mean, as in AP_raster; in MapTR it is 0 in ``mAP``.
    ``num_absent_classes`` is the number of such classes.

    Args:
        matches: Matches at the thresholds of ``config``.
        config: Rules that they were made by; keys of figures begin with its name.
    """
    classes = config.classes
    detections = matches.detections(dict.fromkeys(classes, config.thresholds))
    metrics: dict[str, float] = {}
    for of_class, found in detections.items():
        aps = [area_ap(hits, found.num_gts) for hits in found.hits.T]
        figures = distance_figures(found, aps)
        metrics |= {f"{of_class}/{key}": value for key, value in figures.items()}
    present = [of_class for of_class, found in detections.items() if found.num_gts]
    means = {"mAP": "AP"} | {
        f"AP@{threshold}": f"AP@{threshold}" for threshold in config.thresholds
    }
    for mean, of_one in means.items():
        aps = [metrics[f"{of_class}/{of_one}"] for of_class in present]
        metrics[mean] = float(np.mean(aps)) if aps else 0.0
    metrics["num_absent_classes"] = float(len(classes) - len(present))
    metrics["num_samples"] = float(len(matches))
    flat = {f"{config.name}/{key}": value for key, value in metrics.items()}
    return MetricReport(config.name, {"class": classes}, flat, detections, matches.tokens)
