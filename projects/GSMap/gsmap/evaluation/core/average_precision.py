"""Average precision of ranked predictions, and the calibration of their scores.

Three definitions of AP are in use: the area under the precision envelope (VOC 2010, MapTR), the
mean of the envelope at 101 recalls (COCO), and the mean of the envelope at ten recalls (methods
whose evaluators compute AP per sample).
"""

import numpy as np

from gsmap.structures.elements import BoolArray, FloatArray, IntArray

_RECALL_POINTS = np.linspace(0.0, 1.0, num=101)


def precision_recall(hits: BoolArray, num_gts: int) -> tuple[FloatArray, FloatArray]:
    """Compute recall and precision after each prediction.

    Args:
        hits: Whether each prediction matches, in descending order of score. (N,)
        num_gts: Number of ground truths.

    Returns:
        Two arrays, recall first (unlike in the name of the function): recall and precision in
        [0, 1]. (N,) each
    """
    true_positives = np.cumsum(hits, dtype=np.float64)
    recall = true_positives / max(num_gts, 1)
    precision = true_positives / np.arange(1, len(true_positives) + 1)
    return recall, precision


def _envelope(precision: FloatArray) -> FloatArray:
    """Precision envelope: the largest precision at each prediction or a later one. (N,)"""
    envelope: FloatArray = np.maximum.accumulate(precision[::-1])[::-1]
    return envelope


def area_ap(hits: BoolArray, num_gts: int) -> float:
    """Compute the area under the monotone precision envelope (VOC 2010), as MapTR does.

    Args:
        hits: Whether each prediction matches, in descending order of score. (N,)
        num_gts: Number of ground truths.

    Returns:
        AP in [0, 1]; 0 without ground truths.
    """
    if num_gts == 0:
        return 0.0
    recall, precision = precision_recall(hits, num_gts)
    recall_steps = np.diff(recall, prepend=0.0)
    return float(np.sum(recall_steps * _envelope(precision)))


def interpolated_ap(hits: BoolArray, num_gts: int) -> float:
    """Compute the mean of the precision envelope at 101 recalls (COCO).

    Args:
        hits: Whether each prediction matches, in descending order of score. (N,)
        num_gts: Number of ground truths.

    Returns:
        AP in [0, 1]; -1 without ground truths.
    """
    if num_gts == 0:
        return -1.0
    true_positives = np.cumsum(hits, dtype=np.float64)
    # COCO adds the spacing of 1 to the denominator, so a perfect class gives 1 - 2e-16.
    precision = true_positives / (np.arange(1, len(true_positives) + 1) + np.spacing(1.0))
    # Index of the first prediction that reaches each recall. If no prediction reaches it, the index
    # is N, and `np.append` adds a precision of 0 there.
    ranks = np.searchsorted(true_positives / num_gts, _RECALL_POINTS, side="left")
    return float(np.append(_envelope(precision), 0.0)[ranks].mean())


def ten_point_ap(hits: BoolArray, num_gts: int) -> float:
    """Compute the mean of the precision envelope at the recalls 0.1, 0.2, ... 1.

    The public evaluators of the methods compare recalls in float32, in which 7 matches out of 10 do
    not reach the recall 0.7. Here they do.

    Args:
        hits: Whether each prediction matches, in the order in which the metric ranks them. (N,)
        num_gts: Number of ground truths, > 0.

    Returns:
        AP in [0, 1].
    """
    _, precision = precision_recall(hits, num_gts)
    # Matches that reach each recall: recall * num_gts, rounded up.
    min_true_positives = -(-np.arange(1, 11) * num_gts // 10)
    # Index of the first prediction with as many matches. As in `interpolated_ap`, the precision is
    # 0 at recalls that no prediction reaches.
    ranks = np.searchsorted(np.cumsum(hits), min_true_positives, side="left")
    return float(np.append(_envelope(precision), 0.0)[ranks].mean())


def reliability(scores: FloatArray, hits: BoolArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Compare scores with the share of predictions that match, in ten bins of equal width.

    Args:
        scores: Confidence of each prediction in [0, 1]. (N,)
        hits: Whether each prediction matches. (N,)

    Returns:
        Three arrays: mean score, share of matches, and number of predictions of each bin that is
        not empty. (<= 10,) each
    """
    bins = np.clip((scores * 10).astype(np.int64), 0, 9)  # a score of 1 is in the last bin
    # Give consecutive numbers to the bins that are not empty.
    _, bins, counts = np.unique(bins, return_inverse=True, return_counts=True)
    score_sums = np.bincount(bins, weights=scores)
    hit_sums = np.bincount(bins, weights=hits)
    return score_sums / counts, hit_sums / counts, counts


def calibration_error(scores: FloatArray, hits: BoolArray) -> float:
    """Compute the expected calibration error over ten bins.

    It is the mean gap between score and share of matches, weighted by the predictions of each bin.

    Args:
        scores: Confidence of each prediction in [0, 1]. (N,)
        hits: Whether each prediction matches. (N,)

    Returns:
        Error in [0, 1]; -1 without predictions.
    """
    if not len(scores):
        return -1.0
    mean_score, hit_share, counts = reliability(scores, hits)
    return float(np.sum(np.abs(mean_score - hit_share) * counts) / len(scores))
