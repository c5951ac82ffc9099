"""The "same map everywhere" prior: the best fixed set of elements, fitted on a training set.

A network that has learnt to look at its images must beat it. Each element is predicted, with the
same score, in every sample; the set is chosen greedily for AP_chamfer on the training set.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.core.chamfer_ap import ChamferConfig, nearest_by_chamfer
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import Evaluation, match_samples, read_ground_truth
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.raster_ap import MIN_SCORE
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.polylines import resample_all
from gsmap.utils.errors import InputError
from gsmap.utils.split_lists import require_same_list

_MIN_PRECISION = 1e-3  # an element that is right once in a thousand samples adds nothing
_REFINEMENTS = 3  # how often a chosen element is moved to the mean of what it matches
_NUM_POINTS = 20  # of each element
_MAX_CANDIDATES = 400  # of a class, drawn at random
_MAX_TRAINING_SAMPLES = 2000  # evenly spread over the file


def _aligned_mean(line: FloatArray, others: FloatArray) -> FloatArray:
    """Return the mean of lines (K, P, 2), each in the point order nearest to ``line`` (P, 2).

    A closed ring may also start at any of its points.
    """
    orders = [others, others[:, ::-1]]
    if np.allclose(line[0], line[-1]) and np.allclose(others[:, 0], others[:, -1]):
        ring = others[:, :-1]
        for shift in range(1, ring.shape[1]):
            turned = np.roll(ring, shift, axis=1)
            turned = np.concatenate([turned, turned[:, :1]], axis=1)
            orders += [turned, turned[:, ::-1]]
    stacked = np.stack(orders)  # (S, K, P, 2)
    gaps = np.square(stacked - line).sum(axis=(2, 3))
    mean: FloatArray = stacked[gaps.argmin(axis=0), np.arange(len(others))].mean(axis=0)
    return mean


class _ClassFit:
    """Greedy choice of the elements of one class."""

    def __init__(self, label: int, truth: Sequence[MapElements], chamfer: ChamferConfig) -> None:
        self.label, self.chamfer, self.num_samples = label, chamfer, len(truth)
        self.thresholds = np.asarray(chamfer.thresholds)
        truth = [elements.with_coordinates(chamfer.dim) for elements in truth]
        frames = [elements.select(elements.labels == label) for elements in truth]
        self.frames = [frame for frame in frames if len(frame)]
        self.first = np.cumsum([0, *map(len, self.frames)])  # where each frame starts, (F + 1,)
        points = [resample_all(f.points, f.offsets, _NUM_POINTS) for f in self.frames]
        none = np.empty((0, _NUM_POINTS, chamfer.dim))
        self.points = np.concatenate([none, *points])  # (K, P, 2 or 3)
        self.taken = np.zeros((len(self.thresholds), len(self.points)), dtype=np.bool_)
        drawn = np.random.default_rng(0).permutation(len(self.points))
        self.candidates = self.points[np.sort(drawn[:_MAX_CANDIDATES])]
        self.nearest, self.distance = self._compare(self.candidates)

    def _compare(self, lines: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the ground truth nearest to each line in each frame, or -1; metres. 2 x (N, F)"""
        elements = MapElements.from_polylines(lines, np.full(len(lines), self.label))
        nearest = np.full((len(lines), len(self.frames)), -1)
        distance = np.full(nearest.shape, np.inf)
        for i, frame in enumerate(self.frames):
            best, d = nearest_by_chamfer(elements, frame, self.chamfer, self.thresholds[-1])
            nearest[:, i] = np.where(best >= 0, best + self.first[i], -1)
            distance[:, i] = d
        return nearest, distance

    def _new_hits(self, nearest: IntArray, distance: FloatArray) -> FloatArray:
        """Count the free ground truths that each line matches, averaged over thresholds. (N,)"""
        hits = [
            ((distance <= threshold) & ~taken[nearest]).sum(axis=-1)
            for threshold, taken in zip(self.thresholds, self.taken, strict=True)
        ]
        return np.asarray(np.mean(hits, axis=0))

    def propose(self) -> tuple[float, float, int]:
        """Return the gain in AP of the best candidate, its precision and its position."""
        if not len(self.candidates):
            return 0.0, 0.0, -1
        hits = self._new_hits(self.nearest, self.distance)
        best = int(hits.argmax())
        precision = float(hits[best]) / self.num_samples
        return precision * float(hits[best]) / len(self.points), precision, best

    def take(self, index: int) -> tuple[FloatArray, float]:
        """Refine a candidate, mark what it matches as taken; return it and its precision."""
        line, nearest, distance = self.candidates[index], self.nearest[index], self.distance[index]
        best = float(self._new_hits(nearest, distance))
        for _ in range(_REFINEMENTS):
            near = (distance <= self.thresholds[-1]) & ~self.taken[-1][nearest]
            if not near.any():
                break
            moved = _aligned_mean(line, self.points[nearest[near]])
            (new_nearest,), (new_distance,) = self._compare(moved[None])
            hits = float(self._new_hits(new_nearest, new_distance))
            if hits <= best:
                break
            line, best, nearest, distance = moved, hits, new_nearest, new_distance
        for t, threshold in enumerate(self.thresholds):
            self.taken[t][nearest[distance <= threshold]] = True
        return line, best / self.num_samples


def fit_prior(
    truth: Sequence[MapElements], chamfer: ChamferConfig, max_elements: int = 50
) -> MapElements:
    """Fit the fixed set of elements that scores best on a training set.

    Each step adds the element whose new matches raise the area under the precision-recall curve the
    most (precision times recall of the new matches, each class by its own count of ground truths);
    its score rises with the share of samples in which it is a new match. An element is a ground
    truth of the training set, moved to the mean of what it matches where that helps.

    Args:
        truth: Ground truth of each training sample.
        chamfer: Rules of AP_chamfer.
        max_elements: Elements in the set, over all classes; a network of 50 queries predicts 50.

    Raises:
        ValueError: If the training set holds no ground truth.
    """
    fits = [_ClassFit(label, truth, chamfer) for label in range(len(chamfer.classes))]
    if not any(len(fit.candidates) for fit in fits):
        raise InputError("the training set holds no ground truth of these classes.")
    chosen: list[tuple[FloatArray, int, float]] = []  # line, label, score
    while len(chosen) < max_elements:
        proposals = [fit.propose() for fit in fits]
        label = int(np.argmax([gain for gain, _, _ in proposals]))
        _, precision, index = proposals[label]
        if precision < _MIN_PRECISION:
            break
        line, share = fits[label].take(index)
        # AP_raster drops lower scores; the order, which is all that counts, stays
        chosen.append((line, label, MIN_SCORE + (1.0 - MIN_SCORE) * min(share, 1.0)))
    return MapElements.from_polylines(*zip(*chosen, strict=True))


def evaluate_prior(
    train_path: str | Path,
    truth_path: str | Path,
    evaluator: MapEvaluator,
    max_elements: int = 50,
    allow_other_split: bool = False,
) -> Evaluation:
    """Fit a prior on one file of ground truth and score it on another.

    Args:
        train_path: Annotation file or MapTR's JSON, to fit on.
        truth_path: Annotation file or MapTR's JSON, to score on.
        evaluator: The metrics.
        max_elements: Elements of the prior.
        allow_other_split: Whether both files may be of different splits of a data set.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed, or the splits differ.
    """
    paths = [path for path in (train_path, truth_path) if Path(path).suffix.lower() != ".json"]
    metas = [AnnotationFile(path).meta for path in paths]
    if len({meta.dataset for meta in metas}) < len(metas) and not allow_other_split:
        train_list, truth_list = (meta.split_list for meta in metas)
        subject = f"the prior of {train_path}"
        require_same_list(train_list, truth_list, subject, "--allow-other-split")
    named = {metric.name: metric for metric in evaluator.metrics}
    chamfer = named.get("chamfer")
    if not isinstance(chamfer, ChamferConfig):
        chamfer = ChamferConfig(evaluator.classes)
    everything, _ = read_ground_truth(train_path, evaluator.classes)
    step = max(1, -(-len(everything) // _MAX_TRAINING_SAMPLES))
    train = dict(list(everything.items())[::step])
    truth, _ = read_ground_truth(truth_path, evaluator.classes)
    fitted = fit_prior(list(train.values()), chamfer, max_elements)
    alone = MapEvaluator(chamfer)
    (on_train,) = alone.reports(
        match_samples([Sample(token, fitted, found) for token, found in train.items()], alone)
    )
    note = (
        f"the same {len(fitted)} elements in every sample, fitted on {len(train)} training "
        f"samples; mAP_chamfer there {on_train.metrics['chamfer/mAP']:.6f}"
    )
    pairs = [Sample(token, fitted, found) for token, found in truth.items()]
    return evaluator.reports(match_samples(pairs, evaluator)), [note]
