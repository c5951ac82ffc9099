"""AP_raster of MapVR: drawn and dilated masks, greedy COCO matching, 101-point AP.

Rules, equal to MapVR's evaluator:

- The canvas has 8 pixels per metre, and points are rounded to pixels.
- Lines are one pixel thick and polygons are filled; both are dilated by 5 x 5 pixels.
- Predictions with a score below 0.05 or fewer than two points are dropped.
- At most 100 predictions of a class count in a sample.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.evaluation.core import raster_kernels as kernels
from gsmap.evaluation.core.average_precision import interpolated_ap
from gsmap.evaluation.core.matches import (
    ClassDetections,
    FrameMatches,
    MatchTable,
    assign,
    check_group_names,
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
MAX_PREDICTIONS = 100  # largest number of predictions of a class in a sample
RECALL_LIMITS = (1, 10, 100)  # AR@n counts the n best predictions of a class in each sample
NUSCENES_GRID = BEVGrid(x_range=(-15.0, 15.0), y_range=(-30.0, 30.0))
_MOST_PX = 2e7  # largest canvas: 560 m by 560 m at 8 pixels per metre
_FAR_PX = 2.0**20  # pixel coordinates are clipped to this, to fit the integers of the drawing
_GROUP_FIGURES = ("AP", "AR", "recall", "mIoU")  # prefixes of the figures with a mean per group


@register_metric
@dataclass(frozen=True)
class RasterConfig(Metric):
    """Metric AP_raster (``--eval raster``) and its rules.

    Args:
        classes: Names of the classes; a label is an index into them.
        grid: Extent of the canvas in metres; its numbers of rows and columns are not used.
        polygon_classes: Names of the classes that are filled; unknown names are allowed.
        px_per_m: Pixels per metre.
        dilation_px: Side in pixels of the square that masks are dilated by; odd.

    Raises:
        ValueError: If a value is out of its range.
    """

    name: ClassVar[str] = "raster"
    ranks: ClassVar[bool] = True  # predictions are ranked over all samples
    has_curves: ClassVar[bool] = True  # precision-recall curves describe the metric

    classes: tuple[str, ...]
    grid: BEVGrid = NUSCENES_GRID
    polygon_classes: tuple[str, ...] = AREA_CLASSES
    px_per_m: float = 8.0
    dilation_px: int = 5

    def __post_init__(self) -> None:
        # The dataclass is frozen, which forbids a plain assignment.
        object.__setattr__(self, "classes", checked_classes(self.classes))
        check_group_names(self.classes, groups=["line", "polygon"])
        if not 0 < self.px_per_m < math.inf or min(self.size_px) < 1:  # `not` is true for NaN, too
            raise InputError(f"px_per_m must give at least one pixel, got {self.px_per_m}.")
        # Integers could overflow in the product.
        if np.prod(self.size_px, dtype=np.float64) > _MOST_PX:
            columns, rows = self.size_px
            raise InputError(
                f"a canvas of AP_raster has at most {_MOST_PX:.0e} pixels, not {columns} x {rows}: "
                "give --range, or leave AP_raster out with --eval chamfer"
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
        """The T smallest IoUs of a match for each class, by the name of the class."""
        thresholds: dict[str, tuple[float, ...]] = {}
        for name, is_polygon in zip(self.classes, self.is_polygon, strict=True):
            thresholds[name] = POLYGON_THRESHOLDS if is_polygon else LINE_THRESHOLDS
        return thresholds

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "RasterConfig":
        """Create the metric from the settings of a command or config."""
        return cls(
            classes=settings.classes,
            grid=settings.canvas,
            polygon_classes=settings.polygon_classes,
        )

    def match(self, sample: Sample) -> FrameMatches:
        """Match the predictions of one sample with its ground truth (`match_raster`)."""
        return match_raster(
            sample.predictions, sample.ground_truth, config=self, token=sample.token
        )

    def reports(self, table: MatchTable) -> list[MetricReport]:
        """Compute AP_raster from the matches of all samples (`raster_report`)."""
        return [raster_report(table, self)]


def pixels_from_metres(points: FloatArray, config: RasterConfig) -> IntArray:
    """Round points to pixels, halves to even, with the arithmetic of the reference evaluator.

    Args:
        points: Points (x, y) in metres. (M, 2)
        config: Rules of the metric.

    Returns:
        Column and row of each point. (M, 2)
    """
    origin = (config.grid.x_range[0], config.grid.y_range[0])
    pixels = (points - origin) / config.grid.extent_m * config.size_px
    np.clip(pixels, -_FAR_PX, _FAR_PX, out=pixels)
    return np.rint(pixels).astype(np.int64)


def rasterize(elements: MapElements, config: RasterConfig) -> kernels.WordArray:
    """Draw and dilate the elements of a sample, each to a separate mask.

    Parts of an element outside the canvas are cut off before the dilation.

    Args:
        elements: Elements with labels in [0, C). N in number.
        config: Rules of the metric.

    Returns:
        Masks with 64 columns to a word. (N, H, words)
    """
    pixels = pixels_from_metres(elements.with_coordinates(2).points, config)
    columns, rows = config.size_px
    return kernels.draw(
        pixels,
        offsets=elements.offsets,
        filled=np.array(config.is_polygon)[elements.labels],
        size=(rows, columns),
        radius=config.dilation_px // 2,
    )


def match_raster(
    predictions: MapElements, ground_truth: MapElements, config: RasterConfig, token: str = ""
) -> FrameMatches:
    """Match the predictions of one sample with its ground truth by the IoU of their masks.

    Args:
        predictions: Elements with scores.
        ground_truth: Annotated elements at full resolution.
        config: Rules of the metric.
        token: Name of the sample.

    Returns:
        Matches of the predictions that count, at the thresholds of the class of each prediction.

    Raises:
        ValueError: If a label is below -1 or beyond the classes, or predictions have no scores.
    """
    check_pair(predictions, ground_truth, classes=config.classes, token=token)
    num_classes = len(config.classes)
    # Indices of the predictions that count, in descending order of score, as `assign` requires.
    rows = ranked_predictions(
        predictions, num_classes=num_classes, min_score=MIN_SCORE, max_num=MAX_PREDICTIONS
    )
    gt_index = np.flatnonzero(ground_truth.labels >= 0)  # label -1 is no class
    pred_labels = predictions.labels[rows]
    gt_labels = ground_truth.labels[gt_index]
    pred_masks = rasterize(predictions.select(rows), config)
    gt_masks = rasterize(ground_truth.select(gt_index), config)
    ious = kernels.mask_ious(
        pred_masks, gts=gt_masks, pred_labels=pred_labels, gt_labels=gt_labels
    )  # (N, K)
    class_thresholds = np.array(list(config.thresholds.values()))
    # At each threshold, each prediction takes the best ground truth that is still free. (N, T)
    matched = assign(ious, thresholds=class_thresholds[pred_labels])
    # Without a match, ``matched`` is -1. As an index, it selects the last entry, appended here.
    padded_gt_index = np.append(gt_index, -1)
    padded_ious = np.full((len(rows), len(gt_index) + 1), fill_value=np.nan)
    padded_ious[:, :-1] = ious
    loosest_match = matched[:, 0]  # match at the first threshold, which is the smallest IoU
    return FrameMatches(
        token=token,
        pred_index=rows,
        labels=pred_labels,
        scores=predictions.confidence[rows],
        matched_gt=padded_gt_index[matched],
        quality=padded_ious[np.arange(len(rows)), loosest_match],
        num_gts=np.bincount(gt_labels, minlength=num_classes),
        class_iou=kernels.class_ious(pred_masks, gt_masks, pred_labels, gt_labels, num_classes),
    )


def _mean(values: Iterable[float]) -> float:
    """Compute the mean of the values that are not ``UNDEFINED`` (-1); -1 if there are none."""
    defined = [value for value in values if value != UNDEFINED]
    if not defined:
        return UNDEFINED
    return float(np.mean(defined))


def _class_figures(ranked: ClassDetections, ious: FloatArray) -> dict[str, float]:
    """Compute the figures of one class, by name.

    Args:
        ranked: Predictions of the class in all samples, by descending score. Their ``hits`` (N, T)
            are True where a prediction matches at a threshold.
        ious: IoU of the class in each sample, NaN in samples without the class. (S,)
    """
    aps = [interpolated_ap(hits, num_gts=ranked.num_gts) for hits in ranked.hits.T]
    # AP, recall and counts. Without ground truth, the recall is UNDEFINED (-1).
    figures = class_figures(ranked, aps=aps, absent=UNDEFINED)
    for limit in RECALL_LIMITS:
        figures[f"AR@{limit}"] = UNDEFINED
        if ranked.num_gts:
            # `ranked.ranks` counts the predictions of the class in each sample from 0.
            hits = ranked.hits[ranked.ranks < limit].sum(axis=0)  # (T,)
            figures[f"AR@{limit}"] = _mean(hits / ranked.num_gts)  # mean over the thresholds
    figures["mIoU"] = _mean(ious[~np.isnan(ious)])
    return figures


def raster_report(matches: MatchTable, config: RasterConfig) -> MetricReport:
    """Compute AP_raster from the matches of all samples.

    A class without ground truth is left out of the means.

    Args:
        matches: Matches of all samples by the rules of ``config``.
        config: Rules of the metric.
    """
    detections = matches.detections(config.thresholds)  # `ClassDetections` by name of the class
    figures: dict[str, dict[str, float]] = {}
    metrics: dict[str, float] = {}
    num_present = 0
    for label, (name, ranked) in enumerate(detections.items()):
        if ranked.num_gts > 0:
            num_present += 1
        figures[name] = _class_figures(ranked, matches.class_iou(label))
        for key, value in figures[name].items():
            metrics[f"{name}/{key}"] = value

    groups: dict[str, list[str]] = {}
    for name, is_polygon in zip(config.classes, config.is_polygon, strict=True):
        group = "polygon" if is_polygon else "line"
        groups.setdefault(group, []).append(name)
    for group, names in groups.items():
        for key in figures[names[0]]:
            if key.startswith(_GROUP_FIGURES):  # one of these prefixes
                metrics[f"{group}/{key}"] = _mean(figures[name][key] for name in names)
    metrics["mAP"] = _mean(values["AP"] for values in figures.values())
    metrics["mIoU"] = _mean(values["mIoU"] for values in figures.values())
    metrics["num_absent_classes"] = float(len(config.classes) - num_present)
    metrics["num_samples"] = float(len(matches))
    prefixed = {}
    for key, value in metrics.items():
        prefixed[f"raster/{key}"] = value
    return MetricReport(
        name="raster",
        groups=groups,
        metrics=prefixed,
        detections=detections,
        tokens=matches.tokens,
        by_distance=False,  # thresholds are IoUs, not distances
    )
