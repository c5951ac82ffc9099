"""AP_chamfer of MapTR: nearest ground truth by Chamfer distance, area under the PR curve.

Rules (equal to MapTR's evaluator): every line is resampled to 100 points; a prediction looks only
at its nearest ground truth and matches if the distance is within the threshold and no prediction
with a higher score has taken it; pairs whose 4 m wide strips do not touch never match.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gsmap.evaluation import chamfer_kernels as kernels
from gsmap.evaluation.average_precision import area_ap, calibration_error
from gsmap.evaluation.matches import (
    ClassDetections,
    FrameMatches,
    MatchTable,
    as_table,
    detections_per_class,
    unique_by_token,
)
from gsmap.evaluation.report import Curve, MetricReport, threshold_key
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements

CHAMFER_THRESHOLDS = (0.5, 1.0, 1.5)
HARD_CHAMFER_THRESHOLDS = (0.2, 0.5, 1.0)
STRIP_HALF_WIDTH_M = 2.0


@dataclass(frozen=True)
class ChamferConfig:
    """Rules of AP_chamfer.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Largest Chamfer distances of a match, in metres.
        num_points: Points that each line is resampled to.
        resample_predictions: If False, predictions are compared at the points they come with.
        resample_ground_truth: If False, ground truth is compared at its own vertices.

    Raises:
        ValueError: If a value is out of its range.
    """

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    num_points: int = 100
    resample_predictions: bool = True
    resample_ground_truth: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", tuple(self.classes))
        object.__setattr__(self, "thresholds", tuple(sorted(float(t) for t in self.thresholds)))
        if not self.classes or not self.thresholds or self.thresholds[0] <= 0:
            raise ValueError(
                "classes and thresholds must not be empty and thresholds must be > 0 m, got "
                f"{self.classes} and {self.thresholds}."
            )
        if self.num_points < 2:
            raise ValueError(f"num_points must be >= 2, got {self.num_points}.")


@dataclass(frozen=True)
class _Lines:
    """Lines ready for comparison: x and y of all points, offsets, labels, which can match."""

    x: FloatArray
    y: FloatArray
    offsets: IntArray
    labels: IntArray
    valid: BoolArray

    def astuple(self) -> tuple[FloatArray, FloatArray, IntArray, IntArray, BoolArray]:
        return self.x, self.y, self.offsets, self.labels, self.valid

    def points(self, index: int) -> FloatArray:
        part = slice(self.offsets[index], self.offsets[index + 1])
        return np.stack([self.x[part], self.y[part]], axis=1)


def resample_polylines(elements: MapElements, num_points: int) -> FloatArray:
    """Place points at equal arc lengths on every polyline, both ends included.

    Args:
        elements: N polylines. An element of zero length gives copies of its first point, one
            without points gives zeros.
        num_points: Number of points P.

    Returns:
        The new points in metres. (N, P, 2)
    """
    elements = elements.planar()
    lengths = kernels.line_lengths(elements.points, elements.offsets)
    x, y = kernels.resample(elements.points, elements.offsets, lengths, num_points)
    return np.stack([x, y], axis=1).reshape(len(elements), num_points, 2)


def _prepare(elements: MapElements, num_points: int, resample: bool) -> _Lines:
    """Resample, or keep, the lines of one sample."""
    elements = elements.planar()
    lengths = kernels.line_lengths(elements.points, elements.offsets)
    valid = (lengths > 0.0) & (elements.num_points >= 2)
    if resample:
        x, y = kernels.resample(elements.points, elements.offsets, lengths, num_points)
        offsets = np.arange(len(elements) + 1, dtype=np.int64) * num_points
    else:
        x, y = np.ascontiguousarray(elements.points.T)
        offsets = elements.offsets
    return _Lines(x, y, offsets, elements.labels, valid)


def chamfer_distance(first: FloatArray, second: FloatArray) -> float:
    """Return the mean of the two directed mean nearest-neighbour distances.

    Args:
        first: Points in metres. (P, 2)
        second: Points in metres. (Q, 2)

    Raises:
        ValueError: If a point set is empty or not (n, 2).
    """
    for points in (first, second):
        if points.ndim != 2 or points.shape[1] != 2 or not len(points):
            raise ValueError(f"point sets must be (n, 2) with n >= 1, got {points.shape}.")
    ax, ay = np.ascontiguousarray(first.T, dtype=np.float64)
    bx, by = np.ascontiguousarray(second.T, dtype=np.float64)
    return float(kernels.chamfer(ax, ay, bx, by, np.empty(len(ax)), np.empty(len(bx))))


def _strips_touch(first: FloatArray, second: FloatArray) -> bool:
    """Whether the strips around two lines intersect: flat ends, mitred corners, 4 m wide."""
    import shapely  # only a handful of pairs per thousand frames come here

    lines = (
        shapely.linestrings([first, second])
        if first.shape == second.shape
        else [
            shapely.LineString(first),
            shapely.LineString(second),
        ]
    )
    a, b = shapely.buffer(
        lines, STRIP_HALF_WIDTH_M, quad_segs=16, cap_style="flat", join_style="mitre"
    )
    return bool(shapely.intersects(a, b))


def _nearest_touching(pred: _Lines, row: int, gt: _Lines) -> tuple[int, float]:
    """Return the nearest ground truth whose strip touches the prediction's, or (-1, inf)."""
    best, distance = -1, np.inf
    line = pred.points(row)
    for k in np.flatnonzero(gt.valid & (gt.labels == pred.labels[row])):
        other = gt.points(int(k))
        d = chamfer_distance(line, other)
        if d < distance and _strips_touch(line, other):
            best, distance = int(k), d
    return best, distance


def nearest_by_chamfer(
    predictions: MapElements,
    ground_truth: MapElements,
    config: ChamferConfig,
    max_distance: float = np.inf,
) -> tuple[IntArray, FloatArray]:
    """Find the nearest ground truth of each prediction among those whose strips touch its own.

    Args:
        predictions: N predictions.
        ground_truth: K ground truths.
        config: Rules.
        max_distance: Farther pairs are not searched, in metres.

    Returns:
        Index of the nearest ground truth, or -1 if none is within ``max_distance`` (N,), and its
        Chamfer distance in metres, or infinity (N,).
    """
    pred = _prepare(predictions, config.num_points, config.resample_predictions)
    gt = _prepare(ground_truth, config.num_points, config.resample_ground_truth)
    best, distance, touching = kernels.nearest_ground_truth(
        pred.astuple(), gt.astuple(), max_distance, STRIP_HALF_WIDTH_M
    )
    for row in np.flatnonzero((distance <= max_distance) & ~touching & (best >= 0)):
        best[row], distance[row] = _nearest_touching(pred, int(row), gt)
    beyond = distance > max_distance
    best[beyond], distance[beyond] = -1, np.inf
    return best, distance


def match_chamfer(
    predictions: MapElements, ground_truth: MapElements, config: ChamferConfig, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth.

    Predictions with fewer than two points are dropped. Ground truth of zero length, or of fewer
    than two points, counts as a ground truth that nobody can match.

    Args:
        predictions: Predictions of the sample.
        ground_truth: Ground truth of the sample.
        config: Rules.
        token: Name of the sample.
    """
    num_classes = len(config.classes)
    kept = (predictions.num_points >= 2) & _known(predictions.labels, num_classes)
    best, distance = nearest_by_chamfer(predictions, ground_truth, config, config.thresholds[-1])
    rows = np.flatnonzero(kept)
    rows = rows[np.argsort(-predictions.confidence[rows], kind="stable")]
    best, distance = best[rows], distance[rows]
    thresholds = np.asarray(config.thresholds)
    matched = kernels.assign(best, distance, len(ground_truth), thresholds)
    known_gts = ground_truth.labels[_known(ground_truth.labels, num_classes)]
    return FrameMatches(
        token=token,
        pred_index=rows,
        labels=predictions.labels[rows],
        scores=predictions.confidence[rows],
        matched_gt=matched,
        quality=np.where((matched >= 0).any(axis=1), distance, np.nan),
        num_gts=np.bincount(known_gts, minlength=num_classes),
    )


def _known(labels: IntArray, num_classes: int) -> BoolArray:
    return (labels >= 0) & (labels < num_classes)


def _class_figures(found: ClassDetections, thresholds: tuple[float, ...]) -> dict[str, float]:
    """Return the figures of one class, by the last part of their key."""
    figures: dict[str, float] = {}
    aps = [area_ap(found.hits[:, t], found.num_gts) for t in range(len(thresholds))]
    for t, threshold in enumerate(thresholds):
        key, hits = threshold_key(threshold), found.hits[:, t]
        figures[f"AP@{key}"] = aps[t]
        figures[f"recall@{key}"] = float(hits.sum()) / max(found.num_gts, 1)
        figures[f"tp@{key}"] = float(hits.sum())
        figures[f"error_m@{key}"] = float(found.quality[hits].mean()) if hits.any() else -1.0
        figures[f"calibration_error@{key}"] = calibration_error(found.scores, hits)
    figures["AP"] = float(np.mean(aps))
    figures["num_gts"] = float(found.num_gts)
    figures["num_preds"] = float(len(found.scores))
    return figures


def chamfer_report(
    matches: MatchTable | Iterable[FrameMatches], config: ChamferConfig
) -> MetricReport:
    """Compute AP_chamfer from the matches of all samples.

    A class without ground truth counts as 0 in ``mAP``, as in MapTR, but not in the mean per
    threshold.

    Args:
        matches: All samples, in any order; repeated tokens count once.
        config: Rules.
    """
    table = unique_by_token(as_table(matches))
    per_class = detections_per_class(table, len(config.classes), len(config.thresholds))
    metrics: dict[str, float] = {}
    curves: list[Curve] = []
    for name, found in zip(config.classes, per_class, strict=True):
        figures = _class_figures(found, config.thresholds)
        metrics.update({f"{name}/{key}": value for key, value in figures.items()})
        curves += [
            Curve(name, threshold, found.scores, found.hits[:, t], found.num_gts)
            for t, threshold in enumerate(config.thresholds)
        ]
    present = [n for n, f in zip(config.classes, per_class, strict=True) if f.num_gts]
    for key in map(threshold_key, config.thresholds):
        aps = [metrics[f"{name}/AP@{key}"] for name in present]
        metrics[f"AP@{key}"] = float(np.mean(aps)) if aps else 0.0
    metrics["mAP"] = float(np.mean([metrics[f"{name}/AP"] for name in config.classes]))
    metrics["num_samples"] = float(len(table))
    return MetricReport(
        "chamfer",
        {"class": config.classes},
        dict.fromkeys(config.classes, config.thresholds),
        {f"chamfer/{k}": v for k, v in metrics.items()},
        curves,
    )
