"""What the metrics keep of one sample: scores and matches, never masks or points."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.evaluation.elements import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class FrameMatches:
    """The matches of one sample's predictions.

    Rows are the predictions that count, in descending order of score (equal scores in the order
    in which they were given).

    Args:
        token: Name of the sample.
        pred_index: Position among the predictions that were given. (N,)
        labels: Class index. (N,)
        scores: Confidence. (N,)
        matched_gt: Position of the matched ground truth among those given, or -1. (N, T)
        quality: Chamfer distance in metres of the match (NaN without one at any threshold), or IoU
            of the match at the loosest threshold (NaN without one). (N,)
        num_gts: Number of ground truths of each class. (C,)
        areas: Pixels in the intersection and in the union of all predictions and all ground truths
            of each class; only AP_raster fills it. (C, 2)
    """

    token: str
    pred_index: IntArray
    labels: IntArray
    scores: FloatArray
    matched_gt: IntArray
    quality: FloatArray
    num_gts: IntArray
    areas: IntArray | None = None


@dataclass(frozen=True)
class ClassDetections:
    """The predictions of one class over all samples, in descending order of score.

    Args:
        scores: Confidence. (N,)
        hits: Whether the prediction matches, at each threshold. (N, T)
        quality: As in ``FrameMatches``. (N,)
        ranks: Rank of the prediction among those of its class and sample, from 0. (N,)
        num_gts: Number of ground truths.
    """

    scores: FloatArray
    hits: BoolArray
    quality: FloatArray
    ranks: IntArray
    num_gts: int


def unique_by_token(matches: Iterable[FrameMatches]) -> list[FrameMatches]:
    """Return one record per token, in the order of the tokens.

    Samples that a sampler repeated to fill the last batch are counted once, and no figure depends
    on the order of the samples or on the rank that saw them.

    Args:
        matches: Records in any order.
    """
    first: dict[str, FrameMatches] = {}
    for record in matches:
        first.setdefault(record.token, record)
    return [first[token] for token in sorted(first)]


def _ranks_within_frames(frame: IntArray) -> IntArray:
    """Count up from 0 within each run of equal entries. (N,)"""
    if not len(frame):
        return np.zeros(0, dtype=np.int64)
    starts = np.flatnonzero(np.diff(frame, prepend=frame[0] - 1))
    lengths = np.diff(starts, append=len(frame))
    return np.arange(len(frame)) - np.repeat(starts, lengths)


def detections_per_class(
    matches: Sequence[FrameMatches], num_classes: int, num_thresholds: int
) -> list[ClassDetections]:
    """Gather the predictions of each class over all samples and rank them by score.

    Equal scores keep the order of the records, then the order within the sample: the reference
    evaluators leave their order to an unstable sort (AP_chamfer) or to the order of the file
    (AP_raster).

    Args:
        matches: One record per sample, from ``unique_by_token``.
        num_classes: Number of classes C.
        num_thresholds: Number of thresholds T.

    Returns:
        One entry per class. (C,)
    """
    if not matches:
        none = ClassDetections(
            np.zeros(0),
            np.zeros((0, num_thresholds), dtype=np.bool_),
            np.zeros(0),
            np.zeros(0, dtype=np.int64),
            0,
        )
        return [none] * num_classes
    labels = np.concatenate([m.labels for m in matches])
    scores = np.concatenate([m.scores for m in matches])
    hits = np.concatenate([m.matched_gt for m in matches]) >= 0
    quality = np.concatenate([m.quality for m in matches])
    frame = np.repeat(np.arange(len(matches)), [len(m.labels) for m in matches])
    num_gts = np.sum([m.num_gts for m in matches], axis=0)
    detections = []
    for c in range(num_classes):
        rows = np.flatnonzero(labels == c)
        ranks = _ranks_within_frames(frame[rows])
        order = np.argsort(-scores[rows], kind="stable")
        rows = rows[order]
        detections.append(
            ClassDetections(scores[rows], hits[rows], quality[rows], ranks[order], int(num_gts[c]))
        )
    return detections
