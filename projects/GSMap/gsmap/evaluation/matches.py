"""What the metrics keep of one sample: scores and matches, never masks or points."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements


@dataclass(frozen=True)
class FrameMatches:
    """The matches of one sample's predictions: those that count, in descending order of score.

    Equal scores keep the order in which they were given.

    Args:
        token: Name of the sample.
        pred_index: Position among the predictions that were given. (N,)
        labels: Class index. (N,)
        scores: Confidence. (N,)
        matched_gt: Position of the matched ground truth among those given, or -1. (N, T)
        quality: Chamfer distance in metres of the match (NaN without one at any threshold), or IoU
            of the match at the loosest threshold (NaN without one). (N,)
        num_gts: Number of ground truths of each class. (C,)
        class_iou: IoU of all predictions of a class with all its ground truths, NaN if the sample
            has neither; only AP_raster fills it. (C,)
    """

    token: str
    pred_index: IntArray
    labels: IntArray
    scores: FloatArray
    matched_gt: IntArray
    quality: FloatArray
    num_gts: IntArray
    class_iou: FloatArray | None = None


@dataclass(frozen=True)
class ClassDetections:
    """The predictions of one class over all samples, in descending order of score.

    Args:
        thresholds: Thresholds of a match, ascending: metres for AP_chamfer, IoU for AP_raster. (T,)
        scores: Confidence. (N,)
        hits: Whether the prediction matches, at each threshold. (N, T)
        quality: As in ``FrameMatches``. (N,)
        ranks: Rank of the prediction among those of its class and sample, from 0. (N,)
        num_gts: Number of ground truths.
    """

    thresholds: Sequence[float]
    scores: FloatArray
    hits: BoolArray
    quality: FloatArray
    ranks: IntArray
    num_gts: int


def ranked_predictions(
    predictions: MapElements,
    num_classes: int,
    min_score: float = -np.inf,
    max_num: int | None = None,
) -> IntArray:
    """Return which predictions count, in descending order of score, at most N of each class. (n,)

    They are lines of known classes with ``min_score`` or more.
    """
    scores = predictions.confidence
    rows = np.flatnonzero((predictions.num_points >= 2) & (scores >= min_score))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    labels = predictions.labels[rows]
    counted = [np.flatnonzero(labels == label)[:max_num] for label in range(num_classes)]
    return rows[np.sort(np.concatenate(counted))]


def gather(
    matches: Iterable[FrameMatches], thresholds: Mapping[str, Sequence[float]]
) -> tuple[list[FrameMatches], dict[str, ClassDetections]]:
    """Rank the predictions of each class over all samples by score.

    No figure depends on repeats, order or processes: a token counts once, and equal scores keep
    the order of the tokens, then the order within the sample. (The reference evaluators leave it to
    an unstable sort, in AP_chamfer, or to the order of the file, in AP_raster.) ``thresholds`` are
    those of each class, by its name, in the order of the labels. C x (T,)

    Returns one record per token, sorted, and the ranked predictions of each class.
    """
    unique = {record.token: record for record in reversed(list(matches))}
    records = [unique[token] for token in sorted(unique)]
    none = np.zeros(0)
    num_thresholds = len(next(iter(thresholds.values())))
    labels = np.concatenate([none, *(m.labels for m in records)])
    scores = np.concatenate([none, *(m.scores for m in records)])
    quality = np.concatenate([none, *(m.quality for m in records)])
    matched = np.concatenate([np.zeros((0, num_thresholds)), *(m.matched_gt for m in records)])
    frame = np.repeat(np.arange(len(records)), [len(m.labels) for m in records])
    detections = {}
    for label, (name, of_class) in enumerate(thresholds.items()):
        rows = np.flatnonzero(labels == label)
        ranks = np.arange(len(rows)) - np.searchsorted(frame[rows], frame[rows])
        order = np.argsort(-scores[rows], kind="stable")
        rows, num_gts = rows[order], sum(int(m.num_gts[label]) for m in records)
        detections[name] = ClassDetections(
            of_class, scores[rows], matched[rows] >= 0, quality[rows], ranks[order], num_gts
        )
    return records, detections


@njit(cache=True)
def assign(quality: FloatArray, thresholds: FloatArray) -> IntArray:
    """Match greedily: each prediction takes its best free ground truth, the later one of equals.

    Args:
        quality: How well each pair fits, predictions in descending order of score. (N, K)
        thresholds: Smallest quality of a match, inclusive, for each prediction. (N, T)

    Returns:
        The matched ground truth, or -1. (N, T)
    """
    matched = np.full(thresholds.shape, -1)
    for t in range(thresholds.shape[1]):
        taken = np.zeros(quality.shape[1], np.bool_)
        for i in range(len(quality)):
            best, match = thresholds[i, t], -1
            for k in range(quality.shape[1]):
                if not taken[k] and quality[i, k] >= best:
                    best, match = quality[i, k], k
            if match >= 0:
                taken[match], matched[i, t] = True, match
    return matched
