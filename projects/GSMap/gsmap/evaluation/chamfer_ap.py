"""AP_chamfer of MapTR: nearest ground truth by Chamfer distance, area under the PR curve.

Rules (equal to MapTR's evaluator): every line is resampled to 100 points; a prediction looks only
at its nearest ground truth and matches if the distance is within the threshold and no prediction
with a higher score has taken it; pairs whose 4 m wide strips do not touch never match. With
heights the distances are those in space, as in MapTRv2's; lines are resampled and strips touch in
the plane.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gsmap.evaluation import chamfer_kernels as kernels
from gsmap.evaluation.average_precision import area_ap
from gsmap.evaluation.matches import FrameMatches, detections_per_class, unique_by_token
from gsmap.evaluation.report import UNDEFINED, MetricReport, class_figures, threshold_key
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.polylines import resample_all

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
        dim: Coordinates that distances count: 2, or 3 with heights, which both sides must have.

    Raises:
        ValueError: If a value is out of its range.
    """

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    num_points: int = 100
    resample_predictions: bool = True
    resample_ground_truth: bool = True
    dim: int = 2

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
        if self.dim not in (2, 3):
            raise ValueError(f"dim must be 2 or 3, got {self.dim!r}.")


def _lines(elements: MapElements, config: ChamferConfig, resample: bool) -> kernels.Lines:
    """Resample, or keep, the lines of one sample; those of no length get the label -1."""
    points, offsets = elements.with_coordinates(config.dim).points, elements.offsets
    moved = np.append(0, np.cumsum((points[1:, :2] != points[:-1, :2]).any(axis=1)))
    long = elements.num_points >= 2
    long[long] = moved[offsets[1:][long] - 1] > moved[offsets[:-1][long]]
    if resample:
        points = resample_all(points, offsets, config.num_points).reshape(-1, config.dim)
        offsets = np.arange(len(elements) + 1) * config.num_points
    xyz = _with_z(*np.ascontiguousarray(points.T))
    return *xyz, offsets, np.where(long, elements.labels, -1)


def chamfer_distance(first: FloatArray, second: FloatArray) -> float:
    """Return the mean of the two directed mean nearest-neighbour distances.

    Args:
        first: Points in metres. (P, 2 or 3)
        second: Points in metres. (Q, 2 or 3)

    Raises:
        ValueError: If a point set is empty, or they are not both (n, 2) or both (n, 3).
    """
    for points in (first, second):
        if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
            raise ValueError(f"point sets must be (n, 2 or 3) with n >= 1, got {points.shape}.")
    if first.shape[1] != second.shape[1]:
        raise ValueError(f"both need as many coordinates, got {first.shape}, {second.shape}.")
    columns = (np.ascontiguousarray(points.T, np.float64) for points in (first, second))
    return float(kernels.chamfer(*(_with_z(*xyz) for xyz in columns)))


def _with_z(x: FloatArray, y: FloatArray, z: FloatArray | None = None) -> kernels.Points:
    """Return coordinates as the kernels take them: no heights are an empty array."""
    return x, y, np.empty(0) if z is None else z


def _strips_touch(first: FloatArray, second: FloatArray) -> bool:
    """Whether the strips around two lines intersect: flat ends, mitred corners, 4 m wide."""
    import shapely  # only a handful of pairs per thousand frames come here

    a, b = shapely.buffer(
        [shapely.LineString(first[:, :2]), shapely.LineString(second[:, :2])],
        STRIP_HALF_WIDTH_M,
        quad_segs=16,
        cap_style="flat",
        join_style="mitre",
    )
    return bool(shapely.intersects(a, b))


def _nearest_touching(
    pred: kernels.Lines, row: int, gt: kernels.Lines, max_distance: float
) -> tuple[int, float]:
    """Return the nearest ground truth whose strip touches the prediction's, or (-1, inf)."""
    best, distance = -1, np.inf
    line = _points(pred, row)
    for k in np.flatnonzero(gt[-1] == pred[-1][row]).tolist():
        other = _points(gt, k)
        d = chamfer_distance(line, other)
        if d < distance and d <= max_distance and _strips_touch(line, other):
            best, distance = k, d
    return best, distance


def _points(lines: kernels.Lines, index: int) -> FloatArray:
    """Return the points of one line. (P, 2 or 3)"""
    *xyz, offsets, _ = lines
    part = slice(offsets[index], offsets[index + 1])
    return np.stack([values[part] for values in xyz if len(values)], axis=1)


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
        max_distance: Farther pairs are passed over, in metres.

    Returns:
        Index of the nearest ground truth, or -1 if none is within ``max_distance`` (N,), and its
        Chamfer distance in metres, or infinity (N,).

    Raises:
        ValueError: If heights count, and a side has none.
    """
    pred = _lines(predictions, config, config.resample_predictions)
    gt = _lines(ground_truth, config, config.resample_ground_truth)
    best, distance, touching = kernels.nearest_ground_truth(
        pred, gt, max_distance, STRIP_HALF_WIDTH_M
    )
    for row in np.flatnonzero((best >= 0) & ~touching).tolist():
        best[row], distance[row] = _nearest_touching(pred, row, gt, max_distance)
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

    Raises:
        ValueError: If heights count, and a side has none.
    """
    num_classes, scores = len(config.classes), predictions.confidence
    try:
        found = nearest_by_chamfer(predictions, ground_truth, config, config.thresholds[-1])
    except ValueError as error:
        raise ValueError(f"sample {token!r}, AP_chamfer of dim {config.dim}: {error}") from error
    best, distance = found
    kept = (predictions.num_points >= 2) & _known(predictions.labels, num_classes)
    rows = np.flatnonzero(kept)
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    thresholds = np.asarray(config.thresholds)
    matched = kernels.assign(best[rows], distance[rows], len(ground_truth), thresholds)
    known_gts = ground_truth.labels[_known(ground_truth.labels, num_classes)]
    return FrameMatches(
        token=token,
        pred_index=rows,
        labels=predictions.labels[rows],
        scores=scores[rows],
        matched_gt=matched,
        quality=np.where((matched >= 0).any(axis=1), distance[rows], np.nan),
        num_gts=np.bincount(known_gts, minlength=num_classes),
    )


def _known(labels: IntArray, num_classes: int) -> BoolArray:
    return (labels >= 0) & (labels < num_classes)


def chamfer_report(matches: Iterable[FrameMatches], config: ChamferConfig) -> MetricReport:
    """Compute AP_chamfer from the matches of all samples.

    A class without ground truth counts as 0 in ``mAP``, as in MapTR, but not in the mean per
    threshold.

    Args:
        matches: All samples, in any order; repeated tokens count once.
        config: Rules.
    """
    classes, thresholds = config.classes, config.thresholds
    records = unique_by_token(matches)
    found = detections_per_class(records, classes, len(thresholds))
    metrics: dict[str, float] = {}
    for name, of_class in found.items():
        figures = class_figures(of_class, thresholds, area_ap, absent=0.0)
        for t, threshold in enumerate(thresholds):
            errors = of_class.quality[of_class.hits[:, t]]
            figures[f"error_m@{threshold_key(threshold)}"] = (
                float(errors.mean()) if len(errors) else UNDEFINED
            )
        metrics |= {f"{name}/{key}": value for key, value in figures.items()}
    for key in map(threshold_key, thresholds):
        aps = [metrics[f"{name}/AP@{key}"] for name in classes if found[name].num_gts]
        metrics[f"AP@{key}"] = float(np.mean(aps)) if aps else 0.0
    metrics["mAP"] = float(np.mean([metrics[f"{name}/AP"] for name in classes]))
    metrics["num_samples"] = float(len(records))
    by_class = dict.fromkeys(classes, thresholds)
    return MetricReport.of("chamfer", {"class": classes}, by_class, metrics, found)
