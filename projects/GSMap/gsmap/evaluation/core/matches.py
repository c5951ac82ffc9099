"""What the metrics keep of one sample: scores and matches, never masks or points."""

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError

_COLUMNS = {  # of a table, with the codes of their numbers
    "length": "q",
    "labels": "q",
    "scores": "d",
    "quality": "d",
    "hits": "b",
    "num_gts": "q",
    "class_iou": "d",
}


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

    def if_two_sided(self) -> "FrameMatches":
        """Return this, or the matches of an empty sample if it lacks either side."""
        if len(self.labels) and self.num_gts.any():
            return self
        none = slice(0, 0)
        return FrameMatches(
            self.token,
            self.pred_index[none],
            self.labels[none],
            self.scores[none],
            self.matched_gt[none],
            self.quality[none],
            np.zeros_like(self.num_gts),
        )


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
        samples: Number of the prediction's sample, in the order of the tokens. (N,)
        gts_of_sample: Number of ground truths of each sample, in that order. (S,)
    """

    thresholds: Sequence[float]
    scores: FloatArray
    hits: BoolArray
    quality: FloatArray
    ranks: IntArray
    num_gts: int
    samples: IntArray
    gts_of_sample: IntArray

    def at(self, thresholds: Sequence[float]) -> "ClassDetections":
        """Return the same predictions at some of the thresholds."""
        columns = [list(self.thresholds).index(threshold) for threshold in thresholds]
        return replace(self, thresholds=tuple(thresholds), hits=self.hits[:, columns])


def checked_classes(classes: Iterable[str]) -> tuple[str, ...]:
    """Return names of classes; ValueError if they are none, or one text in place of several."""
    names = tuple(classes)
    if isinstance(classes, str) or not all(isinstance(name, str) for name in names) or not names:
        raise InputError(
            f"classes must be names, such as ('divider', 'boundary'), got {classes!r}."
        )
    return names


def check_pair(
    predictions: MapElements, ground_truth: MapElements, classes: Sequence[str], token: str
) -> None:
    """Raise ValueError unless predictions have scores and all labels are -1 (no class) or known.

    Args:
        predictions: Elements of a sample.
        ground_truth: Elements of the same sample.
        classes: Names that labels count.
        token: The sample's name, for the error.
    """
    for what, elements in (("prediction", predictions), ("ground truth", ground_truth)):
        beyond = (elements.labels < -1) | (elements.labels >= len(classes))
        if beyond.any():
            index = beyond.argmax()
            raise InputError(
                f"sample {token!r}: {what} {index} has the label {elements.labels[index]}, beyond "
                f"the {len(classes)} classes {', '.join(classes)}."
            )
    if len(predictions) and predictions.scores is None:
        raise InputError(f"sample {token!r}: predictions need scores, in [0, 1].")


def ranked_predictions(
    predictions: MapElements,
    num_classes: int,
    min_score: float = -np.inf,
    max_num: int | None = None,
) -> IntArray:
    """Return which predictions count, in descending order of score, at most N of each class. (n,)

    Args:
        predictions: Elements with scores; lines of known classes count.
        num_classes: How many classes are known.
        min_score: The least score that counts.
        max_num: N; all by default.
    """
    scores = predictions.confidence
    rows = np.flatnonzero((predictions.num_points >= 2) & (scores >= min_score))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    labels = predictions.labels[rows]
    counted = [np.flatnonzero(labels == label)[:max_num] for label in range(num_classes)]
    return rows[np.sort(np.concatenate(counted))]


class MatchTable:
    """The matches of many samples: what the figures need of them, in few bytes.

    No figure depends on repeats, order or processes: a token counts once, and equal scores keep
    the order of the tokens, then the order within the sample. (The reference evaluators leave it to
    an unstable sort, in AP_chamfer, or to the order of the file, in AP_raster.)
    """

    def __init__(self, matches: Iterable[FrameMatches] = ()) -> None:
        self._number: dict[str, int] = {}  # of each token
        self._columns = {name: array(code) for name, code in _COLUMNS.items()}
        for record in matches:
            self.add(record)

    def __len__(self) -> int:
        return len(self._number)

    def add(self, record: FrameMatches) -> None:
        """Add the matches of a sample; those of a token that is known are left out."""
        if record.token in self._number:
            return
        self._number[record.token] = len(self)
        values = vars(record) | {"length": len(record.labels), "hits": record.matched_gt >= 0}
        for name, column in self._columns.items():
            if values[name] is not None:
                column.frombytes(np.asarray(values[name], column.typecode).tobytes())

    @property
    def tokens(self) -> list[str]:
        """The tokens of all samples, in their order. (S,)"""
        return sorted(self._number)

    @property
    def _order(self) -> IntArray:
        """The samples in the order of their tokens. (S,)"""
        return np.array([self._number[token] for token in self.tokens], np.int64)

    def class_iou(self, label: int) -> FloatArray:
        """Return ``FrameMatches.class_iou`` of one class in all samples. (S,)"""
        values = np.asarray(self._columns["class_iou"]).reshape(len(self), -1)
        return values[self._order, label] if values.size else np.zeros(0)

    def detections(self, thresholds: Mapping[str, Sequence[float]]) -> dict[str, ClassDetections]:
        """Rank the predictions of each class over all samples by score.

        ``thresholds`` are those of each class, by its name, in the order of the labels. C x (T,)
        """
        columns = {name: np.asarray(column) for name, column in self._columns.items()}
        lengths = columns["length"]
        order, starts = self._order, np.cumsum(lengths) - lengths
        lengths = lengths[order]
        shifts = starts[order] - (np.cumsum(lengths) - lengths)
        by_token = np.repeat(shifts, lengths) + np.arange(lengths.sum())
        frame = np.repeat(np.arange(len(self)), lengths)
        labels, scores = columns["labels"][by_token], columns["scores"][by_token]
        hits = columns["hits"].reshape(-1, len(next(iter(thresholds.values())))) > 0
        num_gts = columns["num_gts"].reshape(-1, len(thresholds))[order]
        found = {}
        for label, (name, of_class) in enumerate(thresholds.items()):
            rows = np.flatnonzero(labels == label)
            ranks = np.arange(len(rows)) - np.searchsorted(frame[rows], frame[rows])
            best = np.argsort(-scores[rows], kind="stable")
            rows = rows[best]
            places = by_token[rows]
            found[name] = ClassDetections(
                of_class,
                scores[rows],
                hits[places],
                columns["quality"][places],
                ranks[best],
                int(num_gts[:, label].sum()),
                frame[rows],
                num_gts[:, label],
            )
        return found


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
