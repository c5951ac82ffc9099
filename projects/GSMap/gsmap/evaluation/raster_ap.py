"""AP_raster of MapVR: drawn, dilated masks, greedy COCO matching, 101-point AP.

Rules (equal to MapVR's evaluator): 8 pixels per metre, points rounded to pixels, lines one pixel
thick and polygons filled, everything dilated 5 x 5; predictions with a score below 0.05 or fewer
than two points are dropped, and at most 100 per class and sample count.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmap.evaluation import raster_drawing as drawing
from gsmap.evaluation import raster_kernels as kernels
from gsmap.evaluation.average_precision import calibration_error, interpolated_ap
from gsmap.evaluation.matches import (
    ClassDetections,
    FrameMatches,
    MatchTable,
    as_table,
    detections_per_class,
    unique_by_token,
)
from gsmap.evaluation.report import UNDEFINED, Curve, MetricReport, threshold_key
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements

LINE_THRESHOLDS = (0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
POLYGON_THRESHOLDS = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75)
POLYGON_CLASSES = ("ped_crossing", "stop_line", "intersection", "carpark", "carpark_area")
RECALL_LIMITS = (1, 10, 100)
_FAR_PX = 2.0**20  # farther points are pulled in, so that they fit the integers of the drawing


@dataclass(frozen=True)
class RasterConfig:
    """Rules of AP_raster.

    Args:
        classes: Names of the classes; a label is an index into them.
        polygon_classes: Those of them that are filled; names that do not occur are allowed.
        x_range: Smallest and largest x of the canvas, in metres.
        y_range: Smallest and largest y of the canvas, in metres.
        px_per_m: Pixels per metre.
        line_thresholds: Smallest IoUs of a match of lines.
        polygon_thresholds: Smallest IoUs of a match of polygons, as many as of lines.
        dilation_px: Side of the square that masks are dilated by; odd.
        min_score: Predictions with a lower score are dropped.
        max_predictions: How many predictions of a class and sample count.

    Raises:
        ValueError: If a value is out of its range.
    """

    classes: tuple[str, ...]
    polygon_classes: tuple[str, ...] = POLYGON_CLASSES
    x_range: tuple[float, float] = (-15.0, 15.0)
    y_range: tuple[float, float] = (-30.0, 30.0)
    px_per_m: float = 8.0
    line_thresholds: tuple[float, ...] = LINE_THRESHOLDS
    polygon_thresholds: tuple[float, ...] = POLYGON_THRESHOLDS
    dilation_px: int = 5
    min_score: float = 0.05
    max_predictions: int = 100
    is_polygon: tuple[bool, ...] = field(init=False)

    def __post_init__(self) -> None:
        for name in ("classes", "polygon_classes", "x_range", "y_range"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("line_thresholds", "polygon_thresholds"):
            values = tuple(sorted(float(t) for t in getattr(self, name)))
            object.__setattr__(self, name, values)
            if not values or not 0 < values[0] <= values[-1] <= 1:
                raise ValueError(f"{name} must lie in (0, 1], got {values}.")
        if len(self.line_thresholds) != len(self.polygon_thresholds):
            raise ValueError(
                "line_thresholds and polygon_thresholds must be equally many, got "
                f"{self.line_thresholds} and {self.polygon_thresholds}."
            )
        if not self.classes:
            raise ValueError("classes must not be empty.")
        for name in ("x_range", "y_range"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} must be (low, high) with low < high, got {(low, high)}.")
        if self.px_per_m <= 0 or min(self.width, self.height) < 1:
            raise ValueError(f"px_per_m must give at least one pixel, got {self.px_per_m}.")
        if self.dilation_px < 1 or self.dilation_px % 2 == 0:
            raise ValueError(f"dilation_px must be odd and >= 1, got {self.dilation_px}.")
        polygons = tuple(name in self.polygon_classes for name in self.classes)
        object.__setattr__(self, "is_polygon", polygons)

    @property
    def width(self) -> int:
        """Columns of the canvas (along x)."""
        return round((self.x_range[1] - self.x_range[0]) * self.px_per_m)

    @property
    def height(self) -> int:
        """Rows of the canvas (along y)."""
        return round((self.y_range[1] - self.y_range[0]) * self.px_per_m)

    def thresholds_of(self, label: int) -> tuple[float, ...]:
        """Return the IoU thresholds of a class."""
        return self.polygon_thresholds if self.is_polygon[label] else self.line_thresholds


@dataclass(frozen=True)
class Masks:
    """The masks of N elements as crops of the canvas.

    Args:
        words: Packed pixels of all crops, one crop after another (``raster_drawing``). (M,)
        boxes: First row, first word, rows and words of each crop. (N, 4)
        starts: Where each crop starts in ``words``, and the size of it. (N + 1,)
        labels: Class indices. (N,)
    """

    words: drawing.WordArray
    boxes: IntArray
    starts: IntArray
    labels: IntArray

    def astuple(self) -> tuple[drawing.WordArray, IntArray, IntArray, IntArray]:
        """Return the fields in the order in which the kernels take them."""
        return self.words, self.boxes, self.starts, self.labels

    def full(self, index: int, height: int, width: int) -> BoolArray:
        """Return one mask on the whole canvas. (H, W)"""
        top, left, rows, words = self.boxes[index]
        packed = self.words[self.starts[index] : self.starts[index + 1]].astype("<u8")
        bits = np.unpackbits(packed.view(np.uint8), bitorder="little").reshape(rows, 64 * words)
        canvas = np.zeros((height, width), dtype=np.bool_)
        columns = min(64 * int(words), width - 64 * int(left))
        canvas[top : top + rows, 64 * left : 64 * left + columns] = bits[:, :columns]
        return canvas


def pixels_from_metres(points: FloatArray, config: RasterConfig) -> IntArray:
    """Round points to pixels, halves to even, with the arithmetic of the reference evaluator.

    Args:
        points: Points in metres. (M, 2)
        config: Rules.

    Returns:
        Column and row. (M, 2)
    """
    origin = np.array([config.x_range[0], config.y_range[0]])
    extent = np.array([config.x_range[1], config.y_range[1]]) - origin
    pixels = (points - origin) / extent * np.array([config.width, config.height])
    np.clip(pixels, -_FAR_PX, _FAR_PX, out=pixels)
    return np.rint(pixels).astype(np.int64)


def rasterize(elements: MapElements, config: RasterConfig) -> Masks:
    """Draw and dilate the elements of one sample.

    The parts of an element outside the canvas are cut off before the dilation.

    Args:
        elements: N elements with labels below the number of classes.
        config: Rules.
    """
    pixels = pixels_from_metres(elements.planar().points, config)
    radius = config.dilation_px // 2
    boxes, starts = drawing.crops(pixels, elements.offsets, config.height, config.width, radius)
    filled = np.array(config.is_polygon)[elements.labels]
    masks = drawing.draw(pixels, elements.offsets, boxes, starts, filled, config.width, radius)
    return Masks(masks, boxes, starts, elements.labels)


def _ranked_predictions(predictions: MapElements, config: RasterConfig) -> IntArray:
    """Return the predictions that count, in descending order of score."""
    labels = predictions.labels
    kept = (labels >= 0) & (labels < len(config.classes)) & (predictions.num_points >= 2)
    rows = np.flatnonzero(kept & (predictions.confidence >= config.min_score))
    rows = rows[np.argsort(-predictions.confidence[rows], kind="stable")]
    if len(rows) > config.max_predictions:
        labels = labels[rows]
        rank = np.zeros(len(rows), dtype=np.int64)
        for c in range(len(config.classes)):
            mine = labels == c
            rank[mine] = np.arange(mine.sum())
        rows = rows[rank < config.max_predictions]
    return rows


def match_raster(
    predictions: MapElements, ground_truth: MapElements, config: RasterConfig, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth by the IoU of their masks.

    Args:
        predictions: Predictions of the sample.
        ground_truth: Ground truth of the sample, at full resolution.
        config: Rules.
        token: Name of the sample.
    """
    num_classes = len(config.classes)
    rows = _ranked_predictions(predictions, config)
    known = (ground_truth.labels >= 0) & (ground_truth.labels < num_classes)
    gt_index = np.flatnonzero(known)
    pred = rasterize(predictions.select(rows), config)
    gt = rasterize(ground_truth.select(gt_index), config)
    ious = kernels.mask_ious(pred.astuple(), gt.astuple())
    thresholds = np.array([config.thresholds_of(c) for c in range(num_classes)])
    matched = kernels.assign(ious, pred.labels, gt.labels, thresholds)
    loosest = matched[:, 0]
    quality = np.full(len(rows), np.nan)
    quality[loosest >= 0] = ious[loosest >= 0, loosest[loosest >= 0]]
    return FrameMatches(
        token=token,
        pred_index=rows,
        labels=pred.labels,
        scores=predictions.confidence[rows],
        matched_gt=np.where(matched >= 0, gt_index[matched] if len(gt_index) else -1, -1),
        quality=quality,
        num_gts=np.bincount(gt.labels, minlength=num_classes),
        areas=kernels.union_areas(
            pred.astuple(), gt.astuple(), num_classes, config.height, config.width
        ),
    )


def _mean_iou(table: MatchTable, label: int) -> float:
    """Mean over the samples with predictions or ground truth of the class; -1 without any."""
    if not len(table):
        return UNDEFINED
    assert table.areas is not None
    shared, union = table.areas[:, label].T
    predicted = np.bincount(table.sample[table.labels == label], minlength=len(table))
    counts = (union > 0) | (table.num_gts[:, label] > 0) | (predicted > 0)
    ious = shared[counts] / np.maximum(union[counts], 1)  # nothing is shared where union is 0
    return float(np.mean(ious)) if len(ious) else UNDEFINED


def _class_figures(found: ClassDetections, thresholds: tuple[float, ...]) -> dict[str, float]:
    """Return the figures of one class, by the last part of their key."""
    figures: dict[str, float] = {}
    aps = [interpolated_ap(found.hits[:, t], found.num_gts) for t in range(len(thresholds))]
    for t, threshold in enumerate(thresholds):
        key, hits = threshold_key(threshold), found.hits[:, t]
        figures[f"AP@{key}"] = aps[t]
        figures[f"recall@{key}"] = _recall(hits, found.num_gts)
        figures[f"tp@{key}"] = float(hits.sum())
        figures[f"calibration_error@{key}"] = calibration_error(found.scores, hits)
    figures["AP"] = float(np.mean(aps))
    for limit in RECALL_LIMITS:
        recalls = [_recall(hits, found.num_gts) for hits in found.hits[found.ranks < limit].T]
        figures[f"AR@{limit}"] = float(np.mean(recalls))
    figures["num_gts"] = float(found.num_gts)
    figures["num_preds"] = float(len(found.scores))
    return figures


def _recall(hits: BoolArray, num_gts: int) -> float:
    return float(hits.sum()) / num_gts if num_gts else UNDEFINED


def _mean_of_defined(values: Iterable[float]) -> float:
    defined = [v for v in values if v != UNDEFINED]
    return float(np.mean(defined)) if defined else UNDEFINED


def _group_figures(metrics: dict[str, float], names: Sequence[str]) -> dict[str, float]:
    """Average the figures of the classes of one group that have ground truth."""
    keys = [key.split("/")[1] for key in metrics if key.startswith(f"{names[0]}/")]
    averaged = [k for k in keys if k.startswith(("AP", "AR", "recall")) or k == "mIoU"]
    return {k: _mean_of_defined(metrics[f"{name}/{k}"] for name in names) for k in averaged}


def raster_report(
    matches: MatchTable | Iterable[FrameMatches], config: RasterConfig
) -> MetricReport:
    """Compute AP_raster from the matches of all samples.

    A class without ground truth is left out of the means.

    Args:
        matches: All samples, in any order; repeated tokens count once.
        config: Rules.
    """
    table = unique_by_token(as_table(matches))
    num_thresholds = len(config.line_thresholds)
    per_class = detections_per_class(table, len(config.classes), num_thresholds)
    metrics: dict[str, float] = {}
    curves: list[Curve] = []
    for c, (name, found) in enumerate(zip(config.classes, per_class, strict=True)):
        thresholds = config.thresholds_of(c)
        figures = {**_class_figures(found, thresholds), "mIoU": _mean_iou(table, c)}
        metrics.update({f"{name}/{key}": value for key, value in figures.items()})
        curves += [
            Curve(name, threshold, found.scores, found.hits[:, t], found.num_gts)
            for t, threshold in enumerate(thresholds)
        ]
    metrics["mAP"] = _mean_of_defined(metrics[f"{name}/AP"] for name in config.classes)
    metrics["mIoU"] = _mean_of_defined(metrics[f"{name}/mIoU"] for name in config.classes)
    groups: dict[str, list[str]] = {}
    for name, polygon in zip(config.classes, config.is_polygon, strict=True):
        groups.setdefault("polygon" if polygon else "line", []).append(name)
    for group, names in groups.items():
        means = _group_figures(metrics, names)
        metrics.update({f"{group}/{key}": value for key, value in means.items()})
    metrics["num_samples"] = float(len(table))
    by_class = {name: config.thresholds_of(c) for c, name in enumerate(config.classes)}
    return MetricReport(
        "raster", groups, by_class, {f"raster/{k}": v for k, v in metrics.items()}, curves
    )
