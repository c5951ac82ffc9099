"""AP_chamfer and AP_raster by the algorithms of the reference evaluators, for comparison.

The algorithms are slow. AP_chamfer resamples lines by one shapely call per point, and computes all
distances again for each threshold. It compares two lines only if the strips around them touch; the
strips are shapely buffers in a search tree. AP_raster draws and dilates a whole canvas for each
element, and compares run-length codes of the canvases.
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
_OPENCV_VERSION = tuple(int(part) for part in cv2.__version__.split(".")[:2])
# The tuples are the major and the minor version.
FILLS_AS_RELEASED = (4, 8) <= _OPENCV_VERSION <= (4, 10)
"""Whether the installed OpenCV fills polygons like the versions of the published AP_raster."""


def _resample(line: np.ndarray) -> np.ndarray:
    """Resample a polyline to 100 points, in metres. (P, 2) -> (100, 2)"""
    string = shapely.LineString(line)
    distances = np.linspace(0, string.length, num=100)
    points = [string.interpolate(distance).coords[0] for distance in distances]
    return np.array(points)


def _strip(line: np.ndarray) -> Any:
    """Shapely polygon of 4 m width around a polyline (P, 2) in metres."""
    return shapely.LineString(line).buffer(2.0, cap_style="flat", join_style="mitre")


def _chamfer_hits(pred: list[np.ndarray], gt: list[np.ndarray], threshold: float) -> list[bool]:
    """Match the predictions of one frame and class at one threshold.

    Args:
        pred: Predicted lines in descending order of score, in metres. Each (100, 2)
        gt: Ground truths in metres. Each (100, 2)
        threshold: Greatest Chamfer distance of a match, in metres.

    Returns:
        Whether the nearest ground truth of each prediction is within the threshold and not matched
        by an earlier prediction.
    """
    # Lines whose strips do not touch stay at 100 m, farther than each threshold.
    distances = np.full((len(pred), len(gt)), 100.0)
    strips = [_strip(line) for line in gt]
    tree = shapely.STRtree(strips)
    for i, line in enumerate(pred):
        strip = _strip(line)
        for k in tree.query(strip):  # strips whose bounding boxes touch
            if strips[k].intersects(strip):
                point_distances = cdist(line, gt[k])  # (100, 100)
                to_gt = point_distances.min(axis=1).mean()
                from_gt = point_distances.min(axis=0).mean()
                distances[i, k] = (from_gt + to_gt) / 2
    matched = set()  # indices of the ground truths that have a match
    hits = []
    for distances_to_gt in distances:
        hit = False
        if len(gt):
            nearest = int(distances_to_gt.argmin())
            hit = bool(distances_to_gt[nearest] <= threshold) and nearest not in matched
            if hit:
                matched.add(nearest)
        hits.append(hit)
    return hits


def _rank(elements: MapElements, label: int, minimum: float = 0.0) -> np.ndarray:
    """Indices of the elements of a class that score at least ``minimum``, best first. (n,)"""
    rows = np.flatnonzero((elements.labels == label) & (elements.confidence >= minimum))
    ranked: np.ndarray = rows[np.argsort(-elements.confidence[rows], kind="stable")]
    return ranked


def chamfer_map(
    frames: Sequence[Frame], num_classes: int, thresholds: Sequence[float] = (0.5, 1.0, 1.5)
) -> float:
    """Mean AP_chamfer of some frames.

    Args:
        frames: Predictions and ground truth of each sample.
        num_classes: Number of classes.
        thresholds: Thresholds in metres.

    Returns:
        Mean over classes and thresholds, in [0, 1]. A class without ground truth counts as 0.
    """
    aps = []
    for label in range(num_classes):
        preds = []
        gts = []
        confidences = []
        for pred, gt in frames:
            ranked = _rank(pred, label)
            truths = np.flatnonzero(gt.labels == label)
            preds.append([_resample(pred.polylines[i]) for i in ranked])
            gts.append([_resample(gt.polylines[k]) for k in truths])
            confidences.append(pred.confidence[ranked])
        # Hits are listed frame by frame; `order` sorts the hits of all frames by score.
        order = np.argsort(-np.concatenate(confidences), kind="stable")
        num_gts = sum(map(len, gts))
        for threshold in thresholds:
            hits: list[bool] = []
            for frame_preds, frame_gts in zip(preds, gts, strict=True):
                hits += _chamfer_hits(frame_preds, frame_gts, threshold=threshold)
            aps.append(area_ap(np.array(hits, dtype=bool)[order], num_gts))
    return float(np.mean(aps))


def _encode_masks(
    elements: MapElements, rows: np.ndarray, polygon: bool, config: RasterConfig, by_opencv: bool
) -> list:
    """Run-length codes of the dilated masks of some elements.

    Args:
        elements: All elements of a frame.
        rows: Indices of the elements to encode, all of one class. (n,)
        polygon: Whether to draw the elements as filled polygons; otherwise, as lines. It is the
            setting of their class in ``config``.
        config: Rules of AP_raster.
        by_opencv: Whether OpenCV fills polygons, instead of the rasterizer of `gsmap.evaluation`.

    Returns:
        One code per element, a dictionary of pycocotools.
    """
    width, height = config.size_px
    if polygon and not by_opencv:
        words = rasterize(elements.select(rows), config)  # dilated masks. (n, H, words)
        # A word has one bit per column, and the lowest bit is the first column. The last word may
        # have unused bits, which are cut off below.
        bits = np.unpackbits(words.view(np.uint8), axis=-1, bitorder="little")
        # `run_length.encode` requires Fortran order.
        return [run_length.encode(np.asfortranarray(mask)) for mask in bits[..., :width]]
    codes = []
    for i in rows:
        canvas = np.zeros((height, width), dtype=np.uint8)
        points = pixels_from_metres(elements.polylines[i], config).astype(np.int32)
        if polygon:
            cv2.fillPoly(canvas, [points], color=(1,))
        else:
            cv2.polylines(canvas, [points], isClosed=False, color=(1,))
        canvas = grey_dilation(canvas, size=(config.dilation_px, config.dilation_px))
        codes.append(run_length.encode(np.asfortranarray(canvas)))
    return codes


def _raster_hits(ious: np.ndarray, threshold: float) -> list[bool]:
    """Match each prediction, best first, with the unmatched ground truth of highest IoU.

    Args:
        ious: IoU of each prediction, in descending order of score, with each ground truth. (N, K)
        threshold: Smallest IoU of a match.

    Returns:
        Whether each prediction has a match. (N,)
    """
    matched = set()
    hits = []
    for row in ious:
        best_iou = threshold
        match = None
        for k, iou in enumerate(row):
            if k not in matched and iou >= best_iou:
                best_iou = iou
                match = k
        if match is not None:
            matched.add(match)
        hits.append(match is not None)
    return hits


def raster_map(frames: Sequence[Frame], config: RasterConfig, by_opencv: bool = True) -> float:
    """Mean AP_raster of some frames.

    Args:
        frames: Predictions and ground truth of each sample.
        config: Rules of AP_raster.
        by_opencv: Whether the installed OpenCV fills polygons. Versions of OpenCV differ in pixels
            along the outline (``FILLS_AS_RELEASED``). If False, `gsmap.evaluation` fills polygons
            with the pixels of the published AP. OpenCV draws lines in both cases.

    Returns:
        Mean over classes and thresholds, in [0, 1]; classes without ground truth are left out.
    """
    aps = []
    rules = zip(config.is_polygon, config.thresholds.values(), strict=True)
    for label, (polygon, thresholds) in enumerate(rules):
        confidences = []
        ious = []
        num_gts = 0
        for pred, gt in frames:
            # Best predictions of the class, by the limits of AP_raster on score and number.
            rows = _rank(pred, label, minimum=MIN_SCORE)[:MAX_PREDICTIONS]
            truths = np.flatnonzero(gt.labels == label)
            num_gts += len(truths)
            pred_codes = _encode_masks(
                pred, rows, polygon=polygon, config=config, by_opencv=by_opencv
            )
            gt_codes = _encode_masks(
                gt, truths, polygon=polygon, config=config, by_opencv=by_opencv
            )
            is_crowd = [0] * len(truths)  # no ground truth of COCO's kind "crowd"
            frame_ious = run_length.iou(pred_codes, gt_codes, is_crowd)
            confidences.append(pred.confidence[rows])
            ious.append(np.asarray(frame_ious).reshape(len(rows), len(truths)))
        # Hits are listed frame by frame; `order` sorts the hits of all frames by score.
        order = np.argsort(-np.concatenate(confidences), kind="stable")
        for threshold in thresholds:
            hits: list[bool] = []
            for frame_ious in ious:
                hits += _raster_hits(frame_ious, threshold)
            aps.append(interpolated_ap(np.array(hits, dtype=bool)[order], num_gts))
    aps_with_truth = [ap for ap in aps if ap >= 0]  # a class without ground truth has -1
    return float(np.mean(aps_with_truth))
