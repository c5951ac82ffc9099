"""AP_raster of MapVR: drawn, dilated masks, greedy COCO matching, 101-point AP.

Rules (equal to MapVR's evaluator): 8 pixels per metre, points rounded to pixels, lines one pixel
thick and polygons filled, everything dilated 5 x 5; predictions with a score below 0.05 or fewer
than two points are dropped, and at most 100 per class and sample count.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.evaluation.core import raster_kernels as kernels
from gsmap.evaluation.core.average_precision import interpolated_ap
from gsmap.evaluation.core.matches import (
    FrameMatches,
    MatchTable,
    assign,
    check_pair,
    checked_classes,
    ranked_predictions,
)
from gsmap.evaluation.core.metric import Metric, MetricSettings, Sample, register_metric
from gsmap.evaluation.core.report import UNDEFINED, MetricReport, class_figures
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

LINE_THRESHOLDS = (0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
POLYGON_THRESHOLDS = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75)
MIN_SCORE = 0.05
MAX_PREDICTIONS = 100  # of a class and sample
RECALL_LIMITS = (1, 10, 100)
NUSCENES_GRID = BEVGrid((-15.0, 15.0), (-30.0, 30.0))
_MOST_PX = 2e7  # of a canvas: 560 m by 560 m at 8 pixels per metre
_FAR_PX = 2.0**20  # farther points are pulled in, so that they fit the integers of the drawing


@register_metric
@dataclass(frozen=True)
class RasterConfig(Metric):
    """AP_raster and its rules.

    Args:
        classes: Names of the classes; a label is an index into them.
        grid: Extent of the canvas; its raster is not used.
        polygon_classes: The classes that are filled; names that do not occur are allowed.
        px_per_m: Pixels per metre.
        dilation_px: Side of the square that masks are dilated by; odd.

    Raises:
        ValueError: If a value is out of its range.
    """

    name: ClassVar[str] = "raster"
    ranks: ClassVar[bool] = True
    has_curves: ClassVar[bool] = True

    classes: tuple[str, ...]
    grid: BEVGrid = NUSCENES_GRID
    polygon_classes: tuple[str, ...] = AREA_CLASSES
    px_per_m: float = 8.0
    dilation_px: int = 5

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", checked_classes(self.classes))
        if self.px_per_m <= 0 or min(self.size_px) < 1:
            raise InputError(f"px_per_m must give at least one pixel, got {self.px_per_m}.")
        if np.prod(self.size_px, dtype=np.float64) > _MOST_PX:
            columns, rows = self.size_px
            raise InputError(
                f"a canvas of AP_raster has at most {_MOST_PX:.0e} pixels, not {columns} x {rows}: "
                "give --range, or leave that metric out with --eval chamfer"
            )
        if self.dilation_px < 1 or self.dilation_px % 2 == 0:
            raise InputError(f"dilation_px must be odd and >= 1, got {self.dilation_px}.")

    @property
    def size_px(self) -> tuple[int, int]:
        """Columns (along x) and rows (along y) of the canvas."""
        x_m, y_m = self.grid.extent_m
        return round(x_m * self.px_per_m), round(y_m * self.px_per_m)

    @property
    def is_polygon(self) -> tuple[bool, ...]:
        """Whether each class is filled. (C,)"""
        return tuple(name in self.polygon_classes for name in self.classes)

    @property
    def thresholds(self) -> dict[str, tuple[float, ...]]:
        """Smallest IoUs of a match of each class, by its name. C x (T,)"""
        found = [POLYGON_THRESHOLDS if polygon else LINE_THRESHOLDS for polygon in self.is_polygon]
        return dict(zip(self.classes, found, strict=True))

    @classmethod
    def of(cls, settings: MetricSettings) -> "RasterConfig":
        """Return the metric by the settings of a command or config."""
        return cls(settings.classes, settings.canvas, settings.polygon_classes)

    def match(self, sample: Sample) -> FrameMatches:
        """Match the predictions of one sample with its ground truth (`match_raster`)."""
        return match_raster(sample.predictions, sample.ground_truth, self, sample.token)

    def reports(self, table: MatchTable) -> list[MetricReport]:
        """Compute AP_raster from the matches of all samples (`raster_report`)."""
        return [raster_report(table, self)]


def pixels_from_metres(points: FloatArray, config: RasterConfig) -> IntArray:
    """Round points to pixels, halves to even, with the arithmetic of the reference evaluator.

    (x, y) in metres (M, 2) -> column and row (M, 2)
    """
    origin = (config.grid.x_range[0], config.grid.y_range[0])
    pixels = (points - origin) / config.grid.extent_m * config.size_px
    np.clip(pixels, -_FAR_PX, _FAR_PX, out=pixels)
    return np.rint(pixels).astype(np.int64)


def rasterize(elements: MapElements, config: RasterConfig) -> kernels.WordArray:
    """Draw and dilate elements of known classes, 64 columns to a word. N -> (N, H, words)

    The parts of an element outside the canvas are cut off before the dilation.
    """
    pixels = pixels_from_metres(elements.with_coordinates(2).points, config)
    filled = np.array(config.is_polygon)[elements.labels]
    height_width = config.size_px[::-1]
    return kernels.draw(pixels, elements.offsets, filled, height_width, config.dilation_px // 2)


def match_raster(
    predictions: MapElements, ground_truth: MapElements, config: RasterConfig, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth by the IoU of their masks.

    Args:
        predictions: Elements with scores.
        ground_truth: Elements at full resolution.
        config: The metric's settings.
        token: The sample's name.

    Raises:
        ValueError: As of `check_pair`.
    """
    check_pair(predictions, ground_truth, config.classes, token)
    num_classes, gt_labels = len(config.classes), ground_truth.labels
    rows = ranked_predictions(predictions, num_classes, MIN_SCORE, MAX_PREDICTIONS)
    gt_index = np.flatnonzero(gt_labels >= 0)
    pred = rasterize(predictions.select(rows), config)
    gt = rasterize(ground_truth.select(gt_index), config)
    labels, gt_labels = predictions.labels[rows], gt_labels[gt_index]
    ious = kernels.mask_ious(pred, gt, labels, gt_labels)
    thresholds = np.array(list(config.thresholds.values()))
    matched = assign(ious, thresholds[labels])
    matched_iou = np.full((len(rows), len(gt_index) + 1), np.nan)  # column -1: no match
    matched_iou[:, :-1] = ious
    quality = matched_iou[np.arange(len(rows)), matched[:, 0]]
    matched_gt = np.append(gt_index, -1)[matched]
    num_gts = np.bincount(gt_labels, minlength=num_classes)
    class_iou = kernels.class_ious(pred, gt, labels, gt_labels, num_classes)
    scores = predictions.confidence[rows]
    return FrameMatches(token, rows, labels, scores, matched_gt, quality, num_gts, class_iou)


def _mean(values: Iterable[float]) -> float:
    """Return the mean of the values that are defined."""
    defined = [value for value in values if value != UNDEFINED]
    return float(np.mean(defined)) if defined else UNDEFINED


def raster_report(matches: MatchTable, config: RasterConfig) -> MetricReport:
    """Compute AP_raster from the matches of all samples.

    A class without ground truth is left out of the means.
    """
    detections = matches.detections(config.thresholds)
    figures: dict[str, dict[str, float]] = {}
    for c, (name, found) in enumerate(detections.items()):
        aps = [interpolated_ap(hits, found.num_gts) for hits in found.hits.T]
        figures[name] = of_class = class_figures(found, aps, absent=UNDEFINED)
        for limit in RECALL_LIMITS:
            hits = found.hits[found.ranks < limit].sum(axis=0)
            of_class[f"AR@{limit}"] = _mean(hits / found.num_gts if found.num_gts else ())
        ious = matches.class_iou(c)
        of_class["mIoU"] = _mean(ious[~np.isnan(ious)])
    groups: dict[str, list[str]] = {}
    for name, polygon in zip(config.classes, config.is_polygon, strict=True):
        groups.setdefault("polygon" if polygon else "line", []).append(name)
    metrics = {f"{name}/{key}": v for name, found in figures.items() for key, v in found.items()}
    for group, names in groups.items():
        for key in figures[names[0]]:
            if key.startswith(("AP", "AR", "recall", "mIoU")):
                metrics[f"{group}/{key}"] = _mean(figures[name][key] for name in names)
    metrics["mAP"] = _mean(found["AP"] for found in figures.values())
    metrics["mIoU"] = _mean(found["mIoU"] for found in figures.values())
    present = sum(found.num_gts > 0 for found in detections.values())
    metrics["num_absent_classes"] = float(len(config.classes) - present)
    metrics["num_samples"] = float(len(matches))
    flat = {f"raster/{key}": value for key, value in metrics.items()}
    tokens = matches.tokens
    return MetricReport("raster", groups, flat, detections, tokens, by_distance=False)
