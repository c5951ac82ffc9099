"""Confidence intervals of AP by the bootstrap over scenes.

A resample draws as many scenes with replacement as the data set has. A scene that is drawn k times
counts as k copies of its samples; the copies of a prediction have consecutive ranks. Matches do not
depend on the resample and are computed once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

import gsmap.utils.compilation  # noqa: F401 - reports that kernels are compiled
from gsmap.evaluation.core.report import UNDEFINED, MetricReport
from gsmap.structures.elements import BoolArray, FloatArray, IntArray
from gsmap.utils.errors import InputError

_RECALL_POINTS = np.linspace(0.0, 1.0, num=101)
_SPACING = np.spacing(1.0)  # COCO adds it to the denominator of the precision
_PERCENTILES = (2.5, 97.5)  # ends of the interval of 95 %


@dataclass(frozen=True)
class Interval:
    """Interval of 95 % of a figure (the value of a metric), or of the difference of two figures.

    Args:
        value: Figure or difference over all scenes.
        low: 2.5th percentile over the resamples.
        high: 97.5th percentile over the resamples.
    """

    value: float
    low: float
    high: float


class Weights(Protocol):
    """Interface of resamples: each of B resamples has copies of parts of the data set.

    The parts are, for example, its scenes.
    """

    def draw_copies(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Draw the numbers of copies.

        Args:
            tokens: Tokens of the samples. (S,)

        Returns:
            Index of the part of each sample (S,), and number of copies of each part. (B, parts)
        """


@dataclass(frozen=True)
class Resamples:
    """Resamples of the scenes, drawn with replacement.

    Args:
        scene_of: Scene of each sample, by token.
        count: Number of resamples B, >= 2.
        seed: Seed of the random numbers, >= 0; equal seeds draw equal resamples.

    Raises:
        ValueError: If there are fewer than two scenes or resamples, or the seed is negative.
    """

    scene_of: Mapping[str, str]
    count: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        num_scenes = len(set(self.scene_of.values()))
        if num_scenes < 2 or self.count < 2 or self.seed < 0:
            raise InputError(
                "intervals need two scenes, two resamples and a seed >= 0 at least, got "
                f"{num_scenes} scenes, {self.count} resamples and seed {self.seed}."
            )

    def draw_copies(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Draw scenes for each resample.

        Args:
            tokens: Tokens of the samples. (S,)

        Returns:
            Index of the scene of each sample (S,), and number of copies of each scene (B, scenes).

        Raises:
            ValueError: If the scene of a sample is unknown.
        """
        scenes = []
        for token in tokens:
            if token not in self.scene_of:
                raise InputError(f"the scene of sample {token!r} is not known.")
            scenes.append(self.scene_of[token])
        names, scene_index = np.unique(np.array(scenes, dtype=str), return_inverse=True)
        num_scenes = len(names)
        probabilities = np.full(num_scenes, fill_value=1 / num_scenes)
        rng = np.random.default_rng(self.seed)
        copies = rng.multinomial(num_scenes, pvals=probabilities, size=self.count)
        return scene_index, copies.astype(np.float64)


@njit(cache=True)
def _weighted_ap(
    hit_rows: IntArray, copies: FloatArray, ranks: FloatArray, total: float, interpolated: bool
) -> float:
    """Compute the AP of predictions with copies.

    The loop over hits starts at the lowest score. The precision envelope at a hit, the largest
    precision at its recall or above, is then the largest precision of the hits so far.

    Args:
        hit_rows: Indices of the predictions that match, in descending order of score. (H,)
        copies: Number of copies of each prediction. (N,)
        ranks: Number of copies of each prediction and of all predictions with a higher score. (N,)
        total: Number of ground truths, each counted as often as it has copies, > 0.
        interpolated: Whether AP is the mean at 101 recalls; the area otherwise.
    """
    true_positives = 0.0
    for i in hit_rows:
        true_positives += copies[i]
    # Recall points above the recall of all predictions have a precision of 0.
    point = len(_RECALL_POINTS) - 1
    while _RECALL_POINTS[point] > true_positives / total:
        point -= 1
    envelope = 0.0
    ap = 0.0
    for i in hit_rows[::-1]:
        if copies[i] == 0:
            continue
        denominator = ranks[i] + _SPACING if interpolated else ranks[i]
        envelope = max(envelope, true_positives / denominator)
        true_positives -= copies[i]  # now the number before this hit
        if interpolated:
            # This hit raises the recall above these recall points: they have its envelope.
            while _RECALL_POINTS[point] > true_positives / total:
                ap += envelope
                point -= 1
        else:
            ap += envelope * copies[i] / total
    if interpolated:
        return (ap + envelope) / len(_RECALL_POINTS)  # recall point 0 has the last envelope
    return ap


@njit(cache=True)
def _aps(
    hit_rows: IntArray,
    ends: IntArray,
    scene: IntArray,
    scene_copies: FloatArray,
    gts: FloatArray,
    interpolated: bool,
) -> FloatArray:
    """Compute the AP of each resample at each threshold from the indices of the hits.

    Args:
        hit_rows: Indices of the predictions that match, for one threshold after the other. (H,)
        ends: End of each threshold in ``hit_rows``. (T,)
        scene: Scene of each prediction. (N,)
        scene_copies: Number of copies of each scene. (B, scenes)
        gts: Number of ground truths of each scene. (scenes,)
        interpolated: Whether AP is the mean at 101 recalls; the area otherwise.

    Returns:
        AP; NaN without ground truths. (B, T)
    """
    aps = np.full((len(scene_copies), len(ends)), np.nan)
    copies = np.empty(len(scene))
    ranks = np.empty(len(scene))
    for b in range(len(scene_copies)):
        total = (scene_copies[b] * gts).sum()
        if not total > 0:
            continue
        sum_of_copies = 0.0
        for i in range(len(scene)):
            copies[i] = scene_copies[b, scene[i]]
            sum_of_copies += copies[i]
            ranks[i] = sum_of_copies
        start = 0
        for t in range(len(ends)):
            threshold_rows = hit_rows[start : ends[t]]
            start = ends[t]
            aps[b, t] = _weighted_ap(
                threshold_rows, copies=copies, ranks=ranks, total=total, interpolated=interpolated
            )
    return aps


def resampled_aps(
    hits: BoolArray, scene: IntArray, scene_copies: FloatArray, gts: FloatArray, interpolated: bool
) -> FloatArray:
    """Compute the AP of each resample at each threshold.

    Args:
        hits: Whether each prediction matches, in descending order of score. (N, T)
        scene: Scene of each prediction. (N,)
        scene_copies: Number of copies of each scene. (B, scenes)
        gts: Number of ground truths of each scene. (scenes,)
        interpolated: Whether AP is the mean at 101 recalls; the area otherwise.

    Returns:
        AP; NaN without ground truths. (B, T)
    """
    ends = np.cumsum(hits.sum(axis=0))
    hit_rows = np.nonzero(hits.T)[1]  # ordered by threshold, then by score
    return _aps(
        hit_rows,
        ends=ends,
        scene=scene,
        scene_copies=scene_copies,
        gts=gts,
        interpolated=interpolated,
    )


def resampled_figures(report: MetricReport, resamples: Weights) -> dict[str, FloatArray]:
    """Compute every AP of a metric in each resample.

    Args:
        report: Report of the metric over all samples.
        resamples: The B resamples.

    Returns:
        AP by its flat key, NaN where it does not exist (B,); empty for a metric that ranks no
        predictions.
    """
    if not report.detections:
        return {}
    scenes, scene_copies = resamples.draw_copies(report.tokens)
    interpolated = not report.by_distance  # AP_chamfer is an area, AP_raster a mean at 101 recalls
    class_aps: dict[str, FloatArray] = {}
    figures: dict[str, FloatArray] = {}
    for name, ranked in report.detections.items():
        if report.sample_aps:  # the metric is the mean of AP over the samples
            aps = _mean_of_samples(
                report.sample_aps[name], scenes=scenes, scene_copies=scene_copies
            )
        else:
            gts = np.bincount(scenes, weights=ranked.gts_of_sample, minlength=scene_copies.shape[1])
            aps = resampled_aps(
                ranked.hits,
                scene=scenes[ranked.samples],
                scene_copies=scene_copies,
                gts=gts.astype(np.float64),
                interpolated=interpolated,
            )
        class_aps[name] = aps
        if report.by_distance and not report.sample_aps:
            # AP_chamfer of an absent class is 0, but does not count in the mean over the classes.
            aps = np.nan_to_num(aps)
        for t, threshold in enumerate(ranked.thresholds):
            figures[f"{name}/AP@{threshold}"] = aps[:, t]
        figures[f"{name}/AP"] = aps.mean(axis=1)
    for group, names in report.groups.items():
        # AP_chamfer has one group, all classes, whose keys have no prefix.
        prefix = f"{group}/" if interpolated else ""
        means = _mean([class_aps[name] for name in names])
        for t, threshold in enumerate(report.detections[names[0]].thresholds):
            figures[f"{prefix}AP@{threshold}"] = means[:, t]
        if interpolated:
            figures[f"{prefix}AP"] = _mean([figures[f"{name}/AP"] for name in names])
    figures["mAP"] = _mean([aps.mean(axis=1) for aps in class_aps.values()])
    return {f"{report.name}/{key}": values for key, values in figures.items()}


def _mean_of_samples(aps: FloatArray, scenes: IntArray, scene_copies: FloatArray) -> FloatArray:
    """Compute the mean AP over the samples of each resample.

    Args:
        aps: AP of each sample, NaN where it does not count. (S, T)
        scenes: Scene of each sample. (S,)
        scene_copies: Number of copies of each scene. (B, scenes)

    Returns:
        Mean AP; NaN if no sample of the resample counts. (B, T)
    """
    is_known = ~np.isnan(aps)
    num_scenes = scene_copies.shape[1]
    sums = np.zeros((num_scenes, aps.shape[1]))
    counts = np.zeros((num_scenes, aps.shape[1]))
    np.add.at(sums, scenes, np.where(is_known, aps, 0.0))
    np.add.at(counts, scenes, is_known)
    with np.errstate(invalid="ignore"):  # 0 / 0 is NaN
        return np.asarray((scene_copies @ sums) / (scene_copies @ counts))


def _mean(values: Sequence[FloatArray]) -> FloatArray:
    """Compute the mean of arrays of equal shape, entry by entry, over the values that are not NaN.

    An entry that is NaN in all arrays is NaN.
    """
    is_known = ~np.isnan(values)
    counts = is_known.sum(axis=0)
    total = np.where(is_known, values, 0.0).sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)


def _interval(value: float, values: FloatArray) -> Interval:
    """Create the interval of a figure from its values in the resamples; NaN values are left out."""
    known = values[~np.isnan(values)]
    if not len(known):
        return Interval(value, low=UNDEFINED, high=UNDEFINED)
    low, high = np.percentile(known, _PERCENTILES)
    return Interval(value, low=float(low), high=float(high))


def ap_intervals(reports: Sequence[MetricReport], resamples: Resamples) -> dict[str, Interval]:
    """Compute the interval of 95 % of every AP.

    Args:
        reports: Reports of all metrics over all samples.
        resamples: Resamples of the scenes.

    Returns:
        Intervals by flat key.
    """
    intervals = {}
    for report in reports:
        for key, values in resampled_figures(report, resamples).items():
            intervals[key] = _interval(report.metrics[key], values)
    return intervals


def ap_differences(
    first: Sequence[MetricReport], second: Sequence[MetricReport], resamples: Resamples
) -> dict[str, Interval]:
    """Compute the interval of 95 % of the difference of every AP, first minus second.

    A resample draws equal scenes for both results, so that the difficulty of the scenes cancels.

    Args:
        first: Reports of all metrics of the first result.
        second: Reports of all metrics of the second result, over equal samples.
        resamples: Resamples of the scenes.

    Returns:
        Intervals by flat key, of the figures that both results have.

    Raises:
        ValueError: If metrics or samples of the results differ.
    """
    if _samples_of_metrics(first) != _samples_of_metrics(second):
        raise InputError("two results can be compared only if their samples and metrics are equal.")
    intervals = {}
    for first_report, second_report in zip(first, second, strict=True):
        first_figures = resampled_figures(first_report, resamples)
        second_figures = resampled_figures(second_report, resamples)
        for key, values in first_figures.items():
            first_value = first_report.metrics[key]
            second_value = second_report.metrics[key]
            if UNDEFINED not in (first_value, second_value):
                difference = first_value - second_value
                intervals[key] = _interval(difference, values=values - second_figures[key])
    return intervals


def _samples_of_metrics(reports: Sequence[MetricReport]) -> list[tuple[str, list[str]]]:
    """Return the name of each metric and the tokens of its samples."""
    return [(report.name, list(report.tokens)) for report in reports]


def format_intervals(intervals: Mapping[str, Interval], title: str, signed: bool = False) -> str:
    """Format a table with a row per figure and its interval.

    Args:
        intervals: Intervals by key.
        title: First line of the table.
        signed: Whether values above 0 have a plus sign, for differences.
    """
    width = max((len(key) for key in intervals), default=0)  # width of the column of keys
    form = "+.4f" if signed else ".4f"
    rows = [title]
    for key, interval in intervals.items():
        value = format(interval.value, form)
        low = format(interval.low, form)
        high = format(interval.high, form)
        rows.append(f"{key:<{width}}  {value}  {low} to {high}")
    return "\n".join(rows)
