"""Average precision from ranked hits: the area, 101-point and 10-point definitions, calibration."""

import numpy as np

from gsmap.structures.elements import BoolArray, FloatArray, IntArray

_RECALL_POINTS = np.linspace(0.0, 1.0, 101)


def precision_recall(hits: BoolArray, num_gts: int) -> tuple[FloatArray, FloatArray]:
    """Return recall and precision after each prediction, in descending order of score. 2 x (N,)"""
    found = np.cumsum(hits, dtype=np.float64)
    return found / max(num_gts, 1), found / np.arange(1, len(found) + 1)


def area_ap(hits: BoolArray, num_gts: int) -> float:
    """Return the area under the monotone precision envelope (VOC 2010, as MapTR computes it).

    ``hits`` (N,) are in descending order of score; without ground truths the result is 0.
    """
    if num_gts == 0:
        return 0.0
    recall, precision = precision_recall(hits, num_gts)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall, prepend=0.0) * envelope))


def interpolated_ap(hits: BoolArray, num_gts: int) -> float:
    """Return the mean of the precision envelope at 101 recalls (COCO).

    ``hits`` (N,) are in descending order of score; without ground truths the result is -1.
    """
    if num_gts == 0:
        return -1.0
    found = np.cumsum(hits, dtype=np.float64)
    # COCO adds the spacing of 1 to the denominator, so a perfect class gives 1 - 2e-16
    precision = found / (np.arange(1, len(found) + 1) + np.spacing(1.0))
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(found / num_gts, _RECALL_POINTS, side="left")
    return float(np.append(envelope, 0.0)[at].mean())


def ten_point_ap(hits: BoolArray, num_gts: int) -> float:
    """Return the mean of the precision envelope at the recalls 0.1, 0.2, ... 1.

    ``hits`` (N,) are in the order in which predictions count; ``num_gts`` is > 0. (A
    released evaluator compares recalls in float32, in which 7 of 10 are less than 0.7; here they
    are equal.)
    """
    _, precision = precision_recall(hits, num_gts)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    needed = -(-np.arange(1, 11) * num_gts // 10)  # hits, rounded up
    at = np.searchsorted(np.cumsum(hits), needed, side="left")
    return float(np.append(envelope, 0.0)[at].mean())


def reliability(scores: FloatArray, hits: BoolArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Compare scores in [0, 1] with the share of predictions that match, in ten equal bins.

    Mean score, share of matches and number of predictions of each bin that is not empty.
    2 x (N,) -> 3 x (<= 10,)
    """
    bins = np.clip((scores * 10).astype(np.int64), 0, 9)
    _, bins, counts = np.unique(bins, return_inverse=True, return_counts=True)
    total, found = np.bincount(bins, weights=scores), np.bincount(bins, weights=hits)
    return total / counts, found / counts, counts


def calibration_error(scores: FloatArray, hits: BoolArray) -> float:
    """Return the expected calibration error: the mean gap between score and share of matches.

    In [0, 1], of ten bins; -1 without predictions. 2 x (N,)
    """
    if not len(scores):
        return -1.0
    mean_score, share, counts = reliability(scores, hits)
    return float(np.sum(np.abs(mean_score - share) * counts) / len(scores))
