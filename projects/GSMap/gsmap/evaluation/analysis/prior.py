"""Baseline that predicts one constant map, the prior, in every sample, fitted on a training set.

A network that uses its images must be better than this baseline. The elements and their scores are
constant; they are chosen greedily for AP_chamfer on the training set. A frame is a training sample.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.core.chamfer_ap import ChamferConfig, nearest_by_chamfer
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import Evaluation, match_samples, read_ground_truth
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.raster_ap import MIN_SCORE
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.polylines import resample_all
from gsmap.utils.errors import InputError
from gsmap.utils.split_lists import require_same_list

MAX_ELEMENTS = 50  # default of the largest number of elements of a prior
_MIN_PRECISION = 1e-3  # the fit ends if an element matches in fewer than 1 of 1000 samples
_REFINEMENTS = 3  # iterations that move an element to the mean of its matches
_NUM_POINTS = 20  # points of each element
_MAX_CANDIDATES = 400  # candidates of a class, drawn at random
_MAX_TRAINING_SAMPLES = 2000  # at equal distances in the file


def _aligned_mean(line: FloatArray, others: FloatArray) -> FloatArray:
    """Compute the mean of lines, each in the point order that is nearest to a given line.

    Closed rings may start at any of their points.

    Args:
        line: Points in metres. (P, 2)
        others: Points of K lines in metres. (K, P, 2)

    Returns:
        Mean line in metres. (P, 2)
    """
    orders = [others, others[:, ::-1]]  # S orders of the points, each of all lines
    if np.allclose(line[0], line[-1]) and np.allclose(others[:, 0], others[:, -1]):
        ring = others[:, :-1]  # without the last point, which repeats the first one
        for shift in range(1, ring.shape[1]):
            rolled = np.roll(ring, shift=shift, axis=1)
            closed = np.concatenate([rolled, rolled[:, :1]], axis=1)
            orders += [closed, closed[:, ::-1]]
    stacked = np.stack(orders)  # (S, K, P, 2)
    gaps = np.square(stacked - line).sum(axis=(2, 3))  # (S, K)
    nearest_order = gaps.argmin(axis=0)
    mean: FloatArray = stacked[nearest_order, np.arange(len(others))].mean(axis=0)
    return mean


class _ClassFit:
    """Greedy choice of the elements of one class.

    Args:
        label: Label of the class.
        truth: Ground truth of each training sample.
        chamfer: Rules of AP_chamfer.
    """

    def __init__(self, label: int, truth: Sequence[MapElements], chamfer: ChamferConfig) -> None:
        self.label = label
        self.chamfer = chamfer
        self.num_samples = len(truth)
        self.thresholds = np.asarray(chamfer.thresholds)
        self.frames: list[MapElements] = []  # samples with ground truth of the class
        # The empty first array gives the result its shape if no sample has ground truth.
        lines = [np.empty((0, _NUM_POINTS, chamfer.dim))]
        for elements in truth:
            frame = elements.with_coordinates(chamfer.dim)
            frame = frame.select(frame.labels == label)
            if len(frame):
                self.frames.append(frame)
                lines.append(resample_all(frame.points, frame.offsets, num_points=_NUM_POINTS))
        # Index of the first ground truth of each frame. The last entry is the number K of ground
        # truths in all F frames. (F + 1,)
        self.first = np.cumsum([0, *map(len, self.frames)])
        self.points = np.concatenate(lines)  # ground truths of all frames, (K, P, 2 or 3)
        # Whether an element of the prior has matched a ground truth, at each of the T thresholds.
        self.is_taken = np.zeros((len(self.thresholds), len(self.points)), dtype=np.bool_)  # (T, K)
        # Candidates for elements are ground truths, drawn at random with a fixed seed. Their order
        # in the data is kept.
        order = np.random.default_rng(0).permutation(len(self.points))
        self.candidates = self.points[np.sort(order[:_MAX_CANDIDATES])]
        self.nearest, self.distance = self._compare(self.candidates)

    def _compare(self, lines: FloatArray) -> tuple[IntArray, FloatArray]:
        """Find the ground truth that is nearest to each line in each frame.

        Args:
            lines: Points in metres. (N, P, 2 or 3)

        Returns:
            Two arrays: index of the ground truth in ``self.points``, or -1 if no ground truth is
            within the largest threshold, and its Chamfer distance in metres, or infinity. (N, F)
            each
        """
        labels = np.full(len(lines), fill_value=self.label)
        elements = MapElements.from_polylines(lines, labels=labels)
        nearest = np.full((len(lines), len(self.frames)), fill_value=-1)
        distance = np.full(nearest.shape, fill_value=np.inf)
        for i, frame in enumerate(self.frames):
            # `in_frame` has indices into the ground truths of the frame, or -1.
            in_frame, distance[:, i] = nearest_by_chamfer(
                elements, frame, config=self.chamfer, max_distance=self.thresholds[-1]
            )
            nearest[:, i] = np.where(in_frame >= 0, in_frame + self.first[i], -1)
        return nearest, distance

    def _new_hits(self, nearest: IntArray, distance: FloatArray) -> FloatArray:
        """Count the ground truths that each line matches and that are not taken yet.

        Args:
            nearest: Index of the nearest ground truth in each frame, or -1. (..., F)
            distance: Its Chamfer distance in metres. (..., F)

        Returns:
            Numbers of ground truths, averaged over the thresholds. (...)
        """
        hits = []
        for t, threshold in enumerate(self.thresholds):
            # Without a ground truth in reach, ``nearest`` is -1, which reads the last entry of
            # ``is_taken``. The distance is infinite then, so there is no hit.
            is_new = (distance <= threshold) & ~self.is_taken[t][nearest]
            hits.append(is_new.sum(axis=-1))
        return np.asarray(np.mean(hits, axis=0))

    def propose(self) -> tuple[float, float, int]:
        """Return the gain in AP of the best candidate, its precision and its index.

        The precision is the share of samples in which the candidate has a new match. Without
        candidates, the index is -1, and the gain and the precision are 0.
        """
        if not len(self.candidates):
            return 0.0, 0.0, -1
        hits = self._new_hits(self.nearest, self.distance)
        best = int(hits.argmax())
        num_hits = float(hits[best])
        precision = num_hits / self.num_samples
        gain = precision * num_hits / len(self.points)  # precision times recall
        return gain, precision, best

    def take(self, index: int) -> tuple[FloatArray, float]:
        """Refine a candidate and mark its matches as taken.

        Args:
            index: Index of the candidate, from `propose`.

        Returns:
            Refined line in metres (P, 2 or 3), and its precision: the share of samples in which it
            has a new match.
        """
        line = self.candidates[index]
        nearest = self.nearest[index]
        distance = self.distance[index]
        num_hits = float(self._new_hits(nearest, distance))
        for _ in range(_REFINEMENTS):
            # New matches at the largest threshold. The thresholds are in ascending order.
            is_new = (distance <= self.thresholds[-1]) & ~self.is_taken[-1][nearest]
            if not is_new.any():
                break
            refined = _aligned_mean(line, self.points[nearest[is_new]])
            all_nearest, all_distances = self._compare(refined[None])
            refined_hits = float(self._new_hits(all_nearest[0], all_distances[0]))
            if refined_hits <= num_hits:  # the mean is no better than the line before
                break
            line = refined
            num_hits = refined_hits
            nearest = all_nearest[0]
            distance = all_distances[0]
        for t, threshold in enumerate(self.thresholds):
            self.is_taken[t][nearest[distance <= threshold]] = True
        return line, num_hits / self.num_samples


def fit_prior(
    truth: Sequence[MapElements], chamfer: ChamferConfig, max_elements: int = MAX_ELEMENTS
) -> MapElements:
    """Fit the constant set of elements with the best AP on a training set.

    Each step adds the element that increases the area under the precision-recall curve of its class
    the most. The increase is precision times recall, both of the element's new matches alone. The
    score of an element increases with its precision, the share of samples in which it has a new
    match. An element is a ground truth of the training set, moved to the mean of its matches if the
    moved element has more matches.

    Args:
        truth: Ground truth of each training sample.
        chamfer: Rules of AP_chamfer.
        max_elements: Largest number of elements of all classes; a network with 50 queries
            predicts 50.

    Returns:
        The elements with scores, in the order in which they were chosen.

    Raises:
        ValueError: If the training set contains no ground truth.
    """
    fits = [_ClassFit(label, truth, chamfer) for label in range(len(chamfer.classes))]
    if not any(len(fit.candidates) for fit in fits):
        raise InputError("the training set holds no ground truth of these classes.")
    lines: list[FloatArray] = []
    labels: list[int] = []
    scores: list[float] = []
    while len(lines) < max_elements:
        proposals = [fit.propose() for fit in fits]
        gains = [gain for gain, _, _ in proposals]
        label = int(np.argmax(gains))
        # Gains of different classes are comparable, since mAP is the mean over the classes.
        _, precision, index = proposals[label]
        if precision < _MIN_PRECISION:
            break
        line, refined_precision = fits[label].take(index)
        lines.append(line)
        labels.append(label)
        # AP_raster drops scores below MIN_SCORE; otherwise only the order of scores matters.
        scores.append(MIN_SCORE + (1.0 - MIN_SCORE) * refined_precision)
    return MapElements.from_polylines(lines, labels=labels, scores=scores)


def evaluate_prior(
    train_path: str | Path,
    truth_path: str | Path,
    evaluator: MapEvaluator,
    max_elements: int = MAX_ELEMENTS,
    allow_other_split: bool = False,
) -> Evaluation:
    """Fit a prior on one file of ground truth and evaluate it on another.

    Args:
        train_path: Ground truth to fit on: annotation file or MapTR's JSON.
        truth_path: Ground truth to evaluate on: annotation file or MapTR's JSON.
        evaluator: Evaluator of the metrics.
        max_elements: Largest number of elements of the prior.
        allow_other_split: Whether the files may belong to different splits of a data set.

    Returns:
        Reports of all metrics, and a note on the fit.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed, or the splits differ.
    """
    if not allow_other_split:
        _check_splits(train_path, truth_path)
    # The prior is fitted for AP_chamfer of the evaluator, or else with default rules.
    chamfer = ChamferConfig(evaluator.classes)
    for metric in evaluator.metrics:
        if metric.name == "chamfer" and isinstance(metric, ChamferConfig):
            chamfer = metric
    # Elements by token. The second result counts elements of other classes, which are ignored.
    all_train, _ = read_ground_truth(train_path, evaluator.classes)
    step = max(1, math.ceil(len(all_train) / _MAX_TRAINING_SAMPLES))
    train_items = list(all_train.items())[::step]
    train = dict(train_items)
    truth, _ = read_ground_truth(truth_path, evaluator.classes)
    prior = fit_prior(list(train.values()), chamfer=chamfer, max_elements=max_elements)

    chamfer_evaluator = MapEvaluator(chamfer)
    # The evaluator has one metric, so there is one report.
    train_report = _evaluate_constant(prior, truth=train, evaluator=chamfer_evaluator)[0]
    note = (
        f"the same {len(prior)} elements in every sample, fitted on {len(train)} training "
        f"samples; mAP_chamfer there {train_report.metrics['chamfer/mAP']:.6f}"
    )
    return _evaluate_constant(prior, truth=truth, evaluator=evaluator), [note]


def _evaluate_constant(
    prior: MapElements, truth: Mapping[str, MapElements], evaluator: MapEvaluator
) -> list[MetricReport]:
    """Evaluate constant predictions against the ground truth of each sample, by token."""
    samples = []
    for token, elements in truth.items():
        samples.append(Sample(token, predictions=prior, ground_truth=elements))
    return evaluator.reports(match_samples(samples, evaluator))


def _check_splits(train_path: str | Path, truth_path: str | Path) -> None:
    """Raise ValueError if two annotation files belong to different splits of a data set.

    A split is a division of the data set into parts such as ``train`` and ``val``. Parts of
    different splits may share places.
    """
    for path in (train_path, truth_path):
        if Path(path).suffix.lower() == ".json":  # a JSON file has no split
            return
    train_meta = AnnotationFile(train_path).meta
    truth_meta = AnnotationFile(truth_path).meta
    if train_meta.dataset == truth_meta.dataset:
        require_same_list(
            train_meta.split_list,
            truth_meta.split_list,
            f"the prior of {train_path}",
            "--allow-other-split",
        )
