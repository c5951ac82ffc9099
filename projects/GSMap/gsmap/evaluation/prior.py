"""The "same map everywhere" prior: the best fixed set of elements, fitted on a training set.

A network that has learnt to look at its images must beat it. Each element is predicted, with the
same score, in every sample; the set is chosen greedily so that AP_chamfer on the training set is
as high as it gets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.evaluation.chamfer_ap import ChamferConfig, nearest_by_chamfer
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.polylines import resample_all

_LOWEST_SCORE = 0.05  # AP_raster drops lower ones; the order, which is all that counts, stays
_MIN_PRECISION = 1e-3  # an element that is right once in a thousand samples adds nothing


@dataclass(frozen=True)
class PriorConfig:
    """How the prior is fitted.

    Args:
        max_elements: Elements in the set, over all classes; a network of 50 queries predicts 50.
        max_candidates: Ground truths of a class that are tried, evenly drawn from the training set.
        num_points: Points of each element.
        refinements: How often a chosen element is moved to the mean of what it matches.
        seed: Draws the candidates.
    """

    max_elements: int = 50
    max_candidates: int = 400
    num_points: int = 20
    refinements: int = 3
    seed: int = 0


@dataclass
class _ClassTruth:
    """The training ground truth of one class, flat over all samples.

    Args:
        frames: Ground truth of each sample that has any of the class.
        first: Where each of these samples starts in the flat list. (F + 1,)
        points: Resampled elements. (K, P, 2)
    """

    frames: list[MapElements]
    first: IntArray
    points: FloatArray


def _class_truth(truth: Sequence[MapElements], label: int, num_points: int) -> _ClassTruth:
    frames = [t.select(t.labels == label) for t in truth]
    frames = [f for f in frames if len(f)]
    first = np.zeros(len(frames) + 1, dtype=np.int64)
    np.cumsum([len(f) for f in frames], out=first[1:])
    points = [resample_all(f.points, f.offsets, num_points) for f in frames]
    empty = np.empty((0, num_points, 2))
    return _ClassTruth(frames, first, np.concatenate(points) if points else empty)


def _matches(
    candidates: FloatArray, label: int, truth: _ClassTruth, config: ChamferConfig
) -> tuple[IntArray, FloatArray]:
    """Find what each candidate would match in each sample.

    Args:
        candidates: Lines in metres. (N, P, 2)
        label: Their class.
        truth: Ground truth of the class.
        config: Rules of AP_chamfer.

    Returns:
        Flat index of the nearest ground truth or -1 (N, F), and its distance in metres (N, F).
    """
    elements = MapElements.from_polylines(list(candidates), np.full(len(candidates), label))
    nearest = np.full((len(candidates), len(truth.frames)), -1, dtype=np.int64)
    distance = np.full(nearest.shape, np.inf)
    for i, frame in enumerate(truth.frames):
        best, d = nearest_by_chamfer(elements, frame, config, config.thresholds[-1])
        nearest[:, i] = np.where(best >= 0, best + truth.first[i], -1)
        distance[:, i] = d
    return nearest, distance


def _new_hits(
    nearest: IntArray, distance: FloatArray, taken: BoolArray, thresholds: FloatArray
) -> FloatArray:
    """Count the free ground truths that each candidate matches, averaged over the thresholds.

    Args:
        nearest: Flat index of the nearest ground truth, or -1. (N, F)
        distance: Its distance in metres. (N, F)
        taken: Ground truths that are matched already, at each threshold. (T, K)
        thresholds: Thresholds in metres. (T,)

    Returns:
        Mean number of new matches. (N,)
    """
    hits = np.zeros(len(nearest))
    for t, threshold in enumerate(thresholds):
        hits += ((distance <= threshold) & ~taken[t][nearest]).sum(axis=1)
    return hits / len(thresholds)


def _aligned_mean(line: FloatArray, others: FloatArray) -> FloatArray:
    """Return the mean of lines after bringing each into the point order nearest to the first.

    A closed ring may also start at any of its points.

    Args:
        line: The line that gives the order. (P, 2)
        others: Lines to average. (K, P, 2)
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

    def __init__(
        self,
        label: int,
        truth: _ClassTruth,
        num_samples: int,
        chamfer: ChamferConfig,
        config: PriorConfig,
    ) -> None:
        self.label, self.truth, self.chamfer, self.config = label, truth, chamfer, config
        self.num_samples = num_samples
        self.thresholds = np.asarray(chamfer.thresholds)
        total = len(truth.points)
        self.taken = np.zeros((len(self.thresholds), total), dtype=np.bool_)
        rng = np.random.default_rng(config.seed)
        drawn = rng.permutation(total)[: config.max_candidates]
        self.candidates = truth.points[np.sort(drawn)]
        self.nearest, self.distance = _matches(self.candidates, label, truth, chamfer)

    def propose(self) -> tuple[float, float, int]:
        """Return the gain in AP of the best candidate, its precision and its position."""
        if not len(self.candidates):
            return 0.0, 0.0, -1
        hits = _new_hits(self.nearest, self.distance, self.taken, self.thresholds)
        best = int(hits.argmax())
        precision = float(hits[best]) / self.num_samples
        recall = float(hits[best]) / self.taken.shape[1]
        return precision * recall, precision, best

    def take(self, index: int) -> tuple[FloatArray, float]:
        """Refine a candidate, mark what it matches as taken; return it and its precision."""
        line = self.candidates[index]
        nearest, distance = self.nearest[index], self.distance[index]
        best = self._hits(nearest, distance)
        for _ in range(self.config.refinements):
            near = (distance <= self.thresholds[-1]) & ~self.taken[-1][nearest]
            if not near.any():
                break
            moved = _aligned_mean(line, self.truth.points[nearest[near]])
            found = _matches(moved[None], self.label, self.truth, self.chamfer)
            hits = self._hits(found[0][0], found[1][0])
            if hits <= best:
                break
            line, best, nearest, distance = moved, hits, found[0][0], found[1][0]
        for t, threshold in enumerate(self.thresholds):
            self.taken[t][nearest[distance <= threshold]] = True
        return line, best / self.num_samples

    def _hits(self, nearest: IntArray, distance: FloatArray) -> float:
        return float(_new_hits(nearest[None], distance[None], self.taken, self.thresholds)[0])


def fit_prior(
    truth: Sequence[MapElements],
    chamfer: ChamferConfig,
    config: PriorConfig | None = None,
    progress: Callable[[str], None] | None = None,
) -> MapElements:
    """Fit the fixed set of elements that scores best on a training set.

    At every step the element is added whose new matches raise the area under the precision-recall
    curve the most (precision times recall of the new matches, each class by its own count of ground
    truths); its score rises with the share of samples in which it is a new match. An element of the
    set is a ground truth of the training set, moved to the mean of what it matches where that
    helps.

    Args:
        truth: Ground truth of each training sample.
        chamfer: Rules of AP_chamfer.
        config: How the prior is fitted.
        progress: Called with a line of text at each stage.

    Returns:
        The elements, with their scores.

    Raises:
        ValueError: If the training set holds no ground truth.
    """
    config = config or PriorConfig()
    say = progress or (lambda _: None)
    fits = []
    for label, name in enumerate(chamfer.classes):
        of_class = _class_truth(truth, label, config.num_points)
        say(f"{name}: comparing candidates with {len(of_class.points)} ground truths")
        fits.append(_ClassFit(label, of_class, len(truth), chamfer, config))
    if not any(len(fit.candidates) for fit in fits):
        raise ValueError("the training set holds no ground truth of these classes.")
    lines: list[FloatArray] = []
    labels: list[int] = []
    scores: list[float] = []
    while len(lines) < config.max_elements:
        proposals = [fit.propose() for fit in fits]
        label = int(np.argmax([gain for gain, _, _ in proposals]))
        _, precision, index = proposals[label]
        if precision < _MIN_PRECISION:
            break
        line, score = fits[label].take(index)
        lines.append(line)
        labels.append(label)
        scores.append(score)
    say(f"{len(lines)} elements chosen")
    lifted = _LOWEST_SCORE + (1.0 - _LOWEST_SCORE) * np.clip(scores, 0.0, 1.0)
    return MapElements.from_polylines(lines, labels, lifted)
