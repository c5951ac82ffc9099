"""Intervals of AP: scenes are drawn again and again, the matches of their samples stay.

A resample has as many scenes as there are, each as often as it was drawn. Its AP is that of a file
with copies of the samples, and no line is compared again. (Equal scores of one sample have no order
there: here the copies of each prediction stand in a row.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled
from gsmap.evaluation.core.report import UNDEFINED, MetricReport
from gsmap.structures.elements import BoolArray, FloatArray, IntArray
from gsmap.utils.errors import InputError

_RECALL_POINTS = np.linspace(0.0, 1.0, 101)
_SPACING = np.spacing(1.0)  # that COCO adds to a denominator
_LEVELS = (2.5, 97.5)  # percentiles of an interval of 95 %


@dataclass(frozen=True)
class Interval:
    """A figure with its interval of 95 %; or a difference of two.

    Args:
        value: The figure of all scenes.
        low: 2.5th percentile of the resamples.
        high: 97.5th percentile.
    """

    value: float
    low: float
    high: float


class Weights(Protocol):
    """Says how often each of some parts of the samples counts."""

    def draw(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Return the part of each sample (S,), and how often each part counts. (B, parts)"""


@dataclass(frozen=True)
class Resamples:
    """Scenes drawn with replacement.

    Args:
        scene_of: Scene of each sample, by token.
        count: Number of resamples.
        seed: Of the drawing; the same makes the same resamples of the same scenes.

    Raises:
        ValueError: If there are fewer than two scenes or resamples.
    """

    scene_of: Mapping[str, str]
    count: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        scenes = len(set(self.scene_of.values()))
        if scenes < 2 or self.count < 2 or self.seed < 0:
            raise InputError(
                "intervals need two scenes, two resamples and a seed >= 0 at least, got "
                f"{scenes}, {self.count} and {self.seed}."
            )

    def draw(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Return the scene of each sample (S,), and how often each scene is drawn. (B, scenes)"""
        if missing := next((token for token in tokens if token not in self.scene_of), None):
            raise InputError(f"the scene of sample {missing!r} is not known.")
        scenes = [self.scene_of[token] for token in tokens]
        names, numbers = np.unique(np.array(scenes, str), return_inverse=True)
        shares = np.full(len(names), 1 / len(names))
        rng = np.random.default_rng(self.seed)
        return numbers, rng.multinomial(len(names), shares, self.count).astype(np.float64)


@njit(cache=True)
def _weighted_ap(
    hits: IntArray, copies: FloatArray, counted: FloatArray, total: float, interpolated: bool
) -> float:
    """Return the AP of predictions of which each has some copies.

    From the lowest score on, the precision envelope is the largest precision so far.

    Args:
        hits: The predictions that match, in descending order of score. (H,)
        copies: Copies of each prediction. (N,)
        counted: Copies of all predictions up to each. (N,)
        total: Number of ground truths, > 0.
        interpolated: Whether AP is the mean at 101 recalls, else the area.
    """
    found, envelope, ap = 0.0, 0.0, 0.0
    for i in hits:
        found += copies[i]
    point = len(_RECALL_POINTS) - 1
    while _RECALL_POINTS[point] > found / total:
        point -= 1
    for i in hits[::-1]:
        if copies[i] == 0:
            continue
        envelope = max(envelope, found / (counted[i] + _SPACING if interpolated else counted[i]))
        found -= copies[i]
        if not interpolated:
            ap += envelope * copies[i] / total
        while interpolated and _RECALL_POINTS[point] > found / total:
            ap += envelope
            point -= 1
    return (ap + envelope) / len(_RECALL_POINTS) if interpolated else ap  # that of recall 0 is left


@njit(cache=True)
def _aps(
    rows: IntArray,
    ends: IntArray,
    scene: IntArray,
    drawn: FloatArray,
    gts: FloatArray,
    interpolated: bool,
) -> FloatArray:
    """Return the AP of each resample and threshold; arguments as in ``resampled_aps``. (B, T)

    ``rows`` are the hits of one threshold after another, ``ends`` where each ends.
    """
    aps = np.full((len(drawn), len(ends)), np.nan)
    copies, counted = np.empty(len(scene)), np.empty(len(scene))
    for b in range(len(drawn)):
        total, so_far = (drawn[b] * gts).sum(), 0.0
        for i in range(len(scene)):
            copies[i] = drawn[b, scene[i]]
            so_far += copies[i]
            counted[i] = so_far
        for t in range(len(ends) if total > 0 else 0):
            hits = rows[ends[t - 1] if t else 0 : ends[t]]
            aps[b, t] = _weighted_ap(hits, copies, counted, total, interpolated)
    return aps


def resampled_aps(
    hits: BoolArray, scene: IntArray, drawn: FloatArray, gts: FloatArray, interpolated: bool
) -> FloatArray:
    """Return the AP of each resample and threshold, NaN without ground truths. (B, T)

    Args:
        hits: Whether each prediction matches, in descending order of score. (N, T)
        scene: Scene of each prediction. (N,)
        drawn: How often each scene is drawn. (B, S)
        gts: Number of ground truths of each scene. (S,)
        interpolated: Whether AP is the mean at 101 recalls, else the area.
    """
    ends, rows = np.cumsum(hits.sum(axis=0)), np.nonzero(hits.T)[1]
    return _aps(rows, ends, scene, drawn, gts, interpolated)


def resampled_figures(report: MetricReport, resamples: Weights) -> dict[str, FloatArray]:
    """Return every AP of a metric in each resample, by its flat key; NaN where there is none. (B,)

    A report without ranked predictions has none.
    """
    if not report.detections:
        return {}
    scenes, drawn = resamples.draw(report.tokens)
    by_area, per_sample = report.by_distance, report.sample_aps
    of_class: dict[str, FloatArray] = {}
    figures: dict[str, FloatArray] = {}
    for name, found in report.detections.items():
        if per_sample:
            aps = _mean_of_samples(per_sample[name], scenes, drawn)
        else:
            gts = np.bincount(scenes, found.gts_of_sample, drawn.shape[1]).astype(np.float64)
            aps = resampled_aps(found.hits, scenes[found.samples], drawn, gts, not by_area)
        of_class[name] = aps
        zeros = by_area and not per_sample  # as the metric takes an absent class
        known = np.nan_to_num(aps) if zeros else aps
        for t, threshold in enumerate(found.thresholds):
            figures[f"{name}/AP@{threshold}"] = known[:, t]
        figures[f"{name}/AP"] = known.mean(axis=1)
    for group, names in report.groups.items():
        prefix = "" if by_area else f"{group}/"
        means = _mean([of_class[name] for name in names])
        for t, threshold in enumerate(report.detections[names[0]].thresholds):
            figures[f"{prefix}AP@{threshold}"] = means[:, t]
        if not by_area:
            figures[f"{prefix}AP"] = _mean([figures[f"{name}/AP"] for name in names])
    figures["mAP"] = _mean([aps.mean(axis=1) for aps in of_class.values()])
    return {f"{report.name}/{key}": values for key, values in figures.items()}


def _mean_of_samples(aps: FloatArray, scenes: IntArray, drawn: FloatArray) -> FloatArray:
    """Return the mean AP of the samples in each resample: aps (S, T), scenes (S,) -> (B, T)"""
    known = ~np.isnan(aps)
    sums, counts = np.zeros((2, drawn.shape[1], aps.shape[1]))
    np.add.at(sums, scenes, np.where(known, aps, 0.0))
    np.add.at(counts, scenes, known)
    with np.errstate(invalid="ignore"):  # 0 / 0: NaN, as none of the drawn samples counts
        return np.asarray((drawn @ sums) / (drawn @ counts))


def _mean(values: Sequence[FloatArray]) -> FloatArray:
    """Return the mean of those that are known; NaN without any."""
    known = ~np.isnan(values)
    counts = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)


def _interval(value: float, values: FloatArray) -> Interval:
    """Return a figure with the interval of its resamples, of those that have it."""
    known = values[~np.isnan(values)]
    low, high = np.percentile(known, _LEVELS) if len(known) else (UNDEFINED, UNDEFINED)
    return Interval(value, float(low), float(high))


def ap_intervals(reports: Sequence[MetricReport], resamples: Resamples) -> dict[str, Interval]:
    """Return every AP with its interval of 95 %, by its flat key."""
    return {
        key: _interval(report.metrics[key], values)
        for report in reports
        for key, values in resampled_figures(report, resamples).items()
    }


def ap_differences(
    first: Sequence[MetricReport], second: Sequence[MetricReport], resamples: Resamples
) -> dict[str, Interval]:
    """Return what the first result has more than the second, in every AP, with its interval.

    Each resample has the same scenes for both, so what makes scenes hard or easy for both takes no
    part.

    Args:
        first: A result's figures, a metric each.
        second: Another result's figures, of the same samples.
        resamples: The scenes of every resample.

    Raises:
        ValueError: If they are of other metrics or samples.
    """
    if [(r.name, list(r.tokens)) for r in first] != [(r.name, list(r.tokens)) for r in second]:
        raise InputError("two results can be compared on the same samples and metrics only.")
    found = {}
    for one, other in zip(first, second, strict=True):
        ours, theirs = (resampled_figures(report, resamples) for report in (one, other))
        for key, values in ours.items():
            if UNDEFINED not in (one.metrics[key], other.metrics[key]):
                difference = one.metrics[key] - other.metrics[key]
                found[key] = _interval(difference, values - theirs[key])
    return found


def format_intervals(intervals: Mapping[str, Interval], title: str, signed: bool = False) -> str:
    """Return a table: a row per figure, with its interval.

    Args:
        intervals: Value and interval of every figure, by its key.
        title: What the columns are of.
        signed: Whether values above 0 have a plus: of differences.
    """
    width, sign = max(map(len, intervals), default=0), "+" if signed else ""
    rows = [
        f"{key:<{width}}  {i.value:{sign}.4f}  {i.low:{sign}.4f} to {i.high:{sign}.4f}"
        for key, i in intervals.items()
    ]
    return "\n".join([title, *rows])
