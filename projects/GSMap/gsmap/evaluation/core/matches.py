"""Matches of predictions with ground truth: of one sample, and of all samples in one table."""

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - logs a notice while numba compiles `assign`
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError

# Columns of a `MatchTable` and their type codes of Python's `array` ("q" int64, "d" float64, "b"
# int8). Each column is flat, with the values of all samples one after another. "length" has one
# value per sample, its number of predictions. The last two columns have C values per sample. "hits"
# has T values per prediction, and the other columns have one.
_COLUMNS = {
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
    """Matches of the predictions of one sample, in descending order of score.

    Predictions that a metric leaves out have no entry. Predictions with equal scores keep the order
    of the input.

    Args:
        token: Name of the sample.
        pred_index: Index of each prediction in the input of the metric. (N,)
        labels: Class index. (N,)
        scores: Confidence in [0, 1]. (N,)
        matched_gt: At each threshold, index of the matched ground truth in the input of the metric,
            or -1 without a match. (N, T)
        quality: For AP_chamfer, distance of the match in metres, NaN without a match at any
            threshold. For AP_raster, IoU of the match at the loosest threshold, NaN without a
            match. (N,)
        num_gts: Number of ground truths of each class. (C,)
        class_iou: IoU of all predictions of a class with all its ground truths, NaN if the sample
            has neither; only AP_raster has it. (C,)
    """

    token: str
    pred_index: IntArray
    labels: IntArray
    scores: FloatArray
    matched_gt: IntArray
    quality: FloatArray
    num_gts: IntArray
    class_iou: FloatArray | None = None

    def empty_if_one_sided(self) -> "FrameMatches":
        """Return the matches of an empty sample if there are no predictions or no ground truths.

        Otherwise, return these matches. VectorMapNet's metric ignores such samples.
        """
        if len(self.labels) and self.num_gts.any():
            return self
        no_rows = slice(0, 0)
        return FrameMatches(
            token=self.token,
            pred_index=self.pred_index[no_rows],
            labels=self.labels[no_rows],
            scores=self.scores[no_rows],
            matched_gt=self.matched_gt[no_rows],
            quality=self.quality[no_rows],
            num_gts=np.zeros_like(self.num_gts),
        )


@dataclass(frozen=True)
class ClassDetections:
    """Predictions of one class over all samples, in descending order of score.

    Args:
        thresholds: Thresholds of a match, ascending: metres for AP_chamfer, IoU for AP_raster. (T,)
        scores: Confidence in [0, 1]. (N,)
        hits: Whether the prediction matches, at each threshold. (N, T)
        quality: Distance of the match in metres for AP_chamfer, IoU for AP_raster; NaN without a
            match. (N,)
        ranks: Rank of the prediction within its class and sample, from 0. (N,)
        num_gts: Number of ground truths.
        samples: Index of the prediction's sample, in the order of the tokens. (N,)
        gts_of_sample: Number of ground truths of each sample, in the order of the tokens. (S,)
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
        """Return the detections at some of the thresholds.

        Raises:
            ValueError: If a threshold is not one of ``self.thresholds``.
        """
        columns = [list(self.thresholds).index(threshold) for threshold in thresholds]
        return replace(self, thresholds=tuple(thresholds), hits=self.hits[:, columns])


def checked_classes(classes: Iterable[str]) -> tuple[str, ...]:
    """Return names of classes as a tuple.

    Raises:
        ValueError: If there is no name, one text in place of several names, or two equal names.
    """
    names = tuple(classes)
    are_texts = all(isinstance(name, str) for name in names)
    if isinstance(classes, str) or not names or not are_texts or len(set(names)) < len(names):
        raise InputError(
            f"classes must be different names, such as ('divider', 'boundary'), got {classes!r}."
        )
    return names


def check_group_names(classes: Sequence[str], groups: Sequence[str]) -> None:
    """Require that no class has the name of a group of classes, whose figures have equal keys.

    Raises:
        ValueError: If a class has the name of a group.
    """
    for name in groups:
        if name in classes:
            raise InputError(
                f"a class cannot be called {name!r}, since figures of this name are means over "
                f"several classes: give it another name, or leave it out of the classes."
            )


def check_pair(
    predictions: MapElements, ground_truth: MapElements, classes: Sequence[str], token: str
) -> None:
    """Check the labels of both sides of a sample, and that predictions have scores.

    Args:
        predictions: Predicted elements of the sample.
        ground_truth: Annotated elements of the sample.
        classes: Names of the classes; labels index into them, -1 is no class.
        token: Name of the sample, for the message.

    Raises:
        ValueError: If a label is below -1 or beyond the classes, or predictions have no scores.
    """
    for kind, elements in (("prediction", predictions), ("ground truth", ground_truth)):
        beyond = (elements.labels < -1) | (elements.labels >= len(classes))
        if beyond.any():
            index = beyond.argmax()
            raise InputError(
                f"sample {token!r}: {kind} {index} has the label {elements.labels[index]}, beyond "
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
    """Rank the predictions of one sample that count in a metric.

    Predictions of one point, or of an unknown class, are left out.

    Args:
        predictions: N elements with scores.
        num_classes: Number of classes C; labels in [0, C) are known.
        min_score: Smallest score that counts, in [0, 1].
        max_num: Largest number of predictions of each class; all by default.

    Returns:
        Indices into ``predictions``, in descending order of score. (n,), n <= N
    """
    scores = predictions.confidence
    rows = np.flatnonzero((predictions.num_points >= 2) & (scores >= min_score))
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    labels = predictions.labels[rows]
    places = []  # indices into `rows`, which are in descending order of score
    for label in range(num_classes):
        places_of_class = np.flatnonzero(labels == label)
        places.append(places_of_class[:max_num])  # all of them if `max_num` is None
    return rows[np.sort(np.concatenate(places))]


class MatchTable:
    """Matches of many samples in compact columns.

    Metrics of the table do not depend on repeated samples, on the order of the samples or on the
    number of processes: a token counts once, and predictions with equal scores are in the order of
    their tokens, then in their order within the sample. The reference evaluators order equal scores
    by an unstable sort (AP_chamfer) or by the order of the file (AP_raster).

    Args:
        matches: Matches to add.
    """

    def __init__(self, matches: Iterable[FrameMatches] = ()) -> None:
        # Index of each sample by its token, in the order in which the samples were added.
        self._index_of: dict[str, int] = {}
        self._columns = {name: array(code) for name, code in _COLUMNS.items()}
        for record in matches:
            self.add(record)

    def __len__(self) -> int:
        return len(self._index_of)

    def add(self, record: FrameMatches) -> None:
        """Add the matches of a sample; a token that the table already has is ignored."""
        if record.token in self._index_of:
            return
        self._index_of[record.token] = len(self)
        values = vars(record) | {"length": len(record.labels), "hits": record.matched_gt >= 0}
        for name, column in self._columns.items():
            if values[name] is not None:  # `class_iou` may be None
                cells = np.asarray(values[name], dtype=column.typecode)
                column.frombytes(cells.tobytes())

    @property
    def tokens(self) -> list[str]:
        """Tokens of all samples, sorted. (S,)"""
        return sorted(self._index_of)

    @property
    def _order(self) -> IntArray:
        """Index of each sample in the columns, in the order of the tokens. (S,)"""
        return np.array([self._index_of[token] for token in self.tokens], dtype=np.int64)

    def class_iou(self, label: int) -> FloatArray:
        """Return ``FrameMatches.class_iou`` of one class in all samples. (S,)

        The order is the order of `tokens`. The result is empty if the metric has no such IoU.
        """
        values = np.asarray(self._columns["class_iou"])
        if not values.size:
            return np.zeros(0)
        return values.reshape(len(self), -1)[self._order, label]

    def detections(self, thresholds: Mapping[str, Sequence[float]]) -> dict[str, ClassDetections]:
        """Rank the predictions of each class over all samples by score.

        Args:
            thresholds: Thresholds of each class by its name, in the order of the labels. C x (T,)

        Returns:
            Detections of each class by its name.
        """
        columns = {name: np.asarray(column) for name, column in self._columns.items()}
        num_thresholds = len(next(iter(thresholds.values())))  # equal in all classes
        order = self._order

        # Row in the columns of each prediction, with the samples in the order of their tokens. The
        # rows of a sample are consecutive in both orders, so they differ by one shift per sample.
        lengths = columns["length"]
        starts = np.cumsum(lengths) - lengths  # first row of each sample in the columns
        sorted_lengths = lengths[order]
        sorted_starts = np.cumsum(sorted_lengths) - sorted_lengths
        shifts = starts[order] - sorted_starts
        rows_by_token = np.repeat(shifts, sorted_lengths) + np.arange(sorted_lengths.sum())

        # Labels and scores are in the order of the tokens, and `places` are indices into them. Hits
        # and quality stay in the order of the columns, and `rows` are indices into those.
        samples = np.repeat(np.arange(len(self)), sorted_lengths)
        labels = columns["labels"][rows_by_token]
        scores = columns["scores"][rows_by_token]
        hits = columns["hits"].reshape(-1, num_thresholds) > 0
        num_gts = columns["num_gts"].reshape(-1, len(thresholds))[order]
        detections = {}
        for label, (name, class_thresholds) in enumerate(thresholds.items()):
            places = np.flatnonzero(labels == label)
            samples_of_class = samples[places]  # ascending
            # The predictions of a sample are in descending order of score. So the rank of a
            # prediction is its distance from the first prediction of its sample.
            first_of_sample = np.searchsorted(samples_of_class, samples_of_class)
            ranks = np.arange(len(places)) - first_of_sample
            by_score = np.argsort(-scores[places], kind="stable")  # equal scores keep their order
            places = places[by_score]
            rows = rows_by_token[places]
            detections[name] = ClassDetections(
                thresholds=class_thresholds,
                scores=scores[places],
                hits=hits[rows],
                quality=columns["quality"][rows],
                ranks=ranks[by_score],
                num_gts=int(num_gts[:, label].sum()),
                samples=samples[places],
                gts_of_sample=num_gts[:, label],
            )
        return detections


@njit(cache=True)
def assign(quality: FloatArray, thresholds: FloatArray) -> IntArray:
    """Match greedily: each prediction takes the best ground truth that is still free.

    Among equally good ground truths, the last one is taken.

    Args:
        quality: IoU or negative distance of each pair, so that larger values are better (unlike
            ``FrameMatches.quality``). The predictions are in descending order of score. (N, K)
        thresholds: Smallest quality of a match, inclusive, for each prediction, in the unit of
            ``quality``. (N, T)

    Returns:
        Index of the matched ground truth, or -1 without a match. (N, T)
    """
    matched_gt = np.full(thresholds.shape, -1)
    for t in range(thresholds.shape[1]):
        is_taken = np.zeros(quality.shape[1], dtype=np.bool_)
        for i in range(len(quality)):
            best_quality = thresholds[i, t]
            best_gt = -1
            for k in range(quality.shape[1]):
                if not is_taken[k] and quality[i, k] >= best_quality:
                    best_quality = quality[i, k]
                    best_gt = k
            if best_gt >= 0:
                is_taken[best_gt] = True
                matched_gt[i, t] = best_gt
    return matched_gt
