"""The evaluations done the way the reference does them: slow on purpose, for the race alone.

Every line is resampled by one shapely call per point, every threshold computes all distances
again, strips are shapely buffers in a search tree; masks are whole canvases, dilated by a grey
morphology, compared as run-length codes.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import shapely
from pycocotools import mask as run_length
from scipy.ndimage import grey_dilation
from scipy.spatial.distance import cdist

from gsmap.evaluation.core.average_precision import area_ap, interpolated_ap
from gsmap.evaluation.core.raster_ap import (
    MAX_PREDICTIONS,
    MIN_SCORE,
    RasterConfig,
    pixels_from_metres,
    rasterize,
)
from gsmap.structures.elements import MapElements

Frame = tuple[MapElements, MapElements]  # predictions, ground truth
FILLS_AS_RELEASED = (4, 8) <= tuple(map(int, cv2.__version__.split(".")[:2])) <= (4, 10)
"""Whether the installed OpenCV fills polygons as those did that the released figures are of."""


def _resampled(line: np.ndarray) -> np.ndarray:
    string = shapely.LineString(line)
    distances = np.linspace(0, string.length, 100)
    points = [string.interpolate(distance).coords[0] for distance in distances]
    return np.array(points)


def _strip(line: np.ndarray) -> Any:
    return shapely.LineString(line).buffer(2.0, cap_style="flat", join_style="mitre")


def _chamfer_hits(pred: list[np.ndarray], gt: list[np.ndarray], threshold: float) -> list[bool]:
    """Match one frame and class at one threshold; predictions in descending order of score."""
    scores = np.full((len(pred), len(gt)), 100.0)
    strips = [_strip(line) for line in gt]
    tree = shapely.STRtree(strips)
    for i, line in enumerate(pred):
        strip = _strip(line)
        for k in tree.query(strip):
            if strips[k].intersects(strip):
                distances = cdist(line, gt[k])
                scores[i, k] = (distances.min(0).mean() + distances.min(1).mean()) / 2
    taken, hits = set(), []
    for i in range(len(pred)):
        best = int(scores[i].argmin()) if len(gt) else -1
        hit = best >= 0 and scores[i, best] <= threshold and best not in taken
        hits.append(hit)
        if hit:
            taken.add(best)
    return hits


def _ranked(elements: MapElements, label: int, minimum: float = 0.0) -> np.ndarray:
    rows = np.flatnonzero((elements.labels == label) & (elements.confidence >= minimum))
    ranked: np.ndarray = rows[np.argsort(-elements.confidence[rows], kind="stable")]
    return ranked


def chamfer_map(
    frames: Sequence[Frame], num_classes: int, thresholds: Sequence[float] = (0.5, 1.0, 1.5)
) -> float:
    """Return the mean AP_chamfer of some frames.

    Args:
        frames: Predictions and ground truth of each sample.
        num_classes: Number of classes.
        thresholds: Thresholds in metres.
    """
    aps = []
    for label in range(num_classes):
        rows = [_ranked(pred, label) for pred, _ in frames]
        truths = [np.flatnonzero(gt.labels == label) for _, gt in frames]
        preds = [
            [_resampled(pred.polylines[i]) for i in r]
            for (pred, _), r in zip(frames, rows, strict=True)
        ]
        gts = [
            [_resampled(gt.polylines[k]) for k in t]
            for (_, gt), t in zip(frames, truths, strict=True)
        ]
        scores = np.concatenate(
            [pred.confidence[r] for (pred, _), r in zip(frames, rows, strict=True)]
        )
        order = np.argsort(-scores, kind="stable")
        for threshold in thresholds:
            found = [_chamfer_hits(p, g, threshold) for p, g in zip(preds, gts, strict=True)]
            hits = np.array([hit for frame in found for hit in frame], dtype=bool)
            aps.append(area_ap(hits[order], sum(map(len, gts))))
    return float(np.mean(aps))


def _codes(
    elements: MapElements, rows: np.ndarray, polygon: bool, config: RasterConfig, by_opencv: bool
) -> list:
    if polygon and not by_opencv:
        words = rasterize(elements.select(rows), config)
        bits = np.unpackbits(words.view(np.uint8), axis=-1, bitorder="little")
        masks = bits[..., : config.size_px[0]]
        return [run_length.encode(np.asfortranarray(mask)) for mask in masks]
    codes = []
    for i in rows:
        canvas = np.zeros(config.size_px[::-1], np.uint8)
        points = pixels_from_metres(elements.polylines[i], config).astype(np.int32)
        if polygon:
            cv2.fillPoly(canvas, [points], (1,))
        else:
            cv2.polylines(canvas, [points], False, (1,))
        canvas = grey_dilation(canvas, (config.dilation_px, config.dilation_px))
        codes.append(run_length.encode(np.asfortranarray(canvas)))
    return codes


def _raster_hits(ious: np.ndarray, threshold: float) -> list[bool]:
    taken, hits = set(), []
    for row in ious:
        best, match = threshold, -1
        for k, iou in enumerate(row):
            if k not in taken and iou >= best:
                best, match = iou, k
        taken.add(match)
        hits.append(match >= 0)
    return hits


def raster_map(frames: Sequence[Frame], config: RasterConfig, by_opencv: bool = True) -> float:
    """Return the mean AP_raster of some frames.

    Args:
        frames: Predictions and ground truth of each sample.
        config: Rules.
        by_opencv: Whether the installed OpenCV fills polygons, whose versions differ along the
            outline (``FILLS_AS_RELEASED``); else the drawing of `gsmap.evaluation` does, whose
            pixels are those of the released figures. Lines are OpenCV's in both cases.
    """
    aps = []
    pairs = zip(config.is_polygon, config.thresholds.values(), strict=True)
    for label, (polygon, thresholds) in enumerate(pairs):
        scores, ious, num_gts = [], [], 0
        for pred, gt in frames:
            rows = _ranked(pred, label, MIN_SCORE)[:MAX_PREDICTIONS]
            truths = np.flatnonzero(gt.labels == label)
            num_gts += len(truths)
            codes = (
                _codes(pred, rows, polygon, config, by_opencv),
                _codes(gt, truths, polygon, config, by_opencv),
            )
            found = run_length.iou(*codes, [0] * len(truths))
            scores.append(pred.confidence[rows])
            ious.append(np.asarray(found).reshape(len(rows), len(truths)))
        order = np.argsort(-np.concatenate(scores), kind="stable")
        for threshold in thresholds:
            hits = [hit for frame in ious for hit in _raster_hits(frame, threshold)]
            aps.append(interpolated_ap(np.array(hits, dtype=bool)[order], num_gts))
    return float(np.mean([ap for ap in aps if ap >= 0]))
