"""Confidence intervals of AP by the bootstrap over scenes.

A resample draws scenes with replacement, as many as the data set has. A scene that is drawn k times
counts as k copies of its samples. In the ranking by score, the copies of a prediction follow each
other. Matches do not depend on the resample and are computed once.
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
_PERCENTILES = (2.5, 97.5)  # ends of the 95 % interval
_SAME_AP = 1e-6  # APs that differ by less are equal up to rounding


@dataclass(frozen=True)
class Interval:
    """95 % confidence interval of a figure (value of a metric), or of a difference of two figures.

    ``UNDEFINED`` (-1) marks ends of an interval that do not exist, because the figure is defined in
    no resample.

    Args:
        value: Figure or difference over all scenes.
        low: 2.5th percentile over the resamples.
        high: 97.5th percentile over the resamples.
    """

    value: float
    low: float
    high: float


class Weights(Protocol):
    """Interface of B resamples, each of which counts every part of the data set a number of times.

    The parts are, for example, the scenes.
    """

    def draw_copies(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Draw the number of copies of each part in each resample.

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
        # The numbers of copies in a draw with replacement have a multinomial distribution.
        copies = rng.multinomial(num_scenes, pvals=probabilities, size=self.count)
        return scene_index, copies.astype(np.float64)


@njit(cache=True)
def _weighted_ap(
    hit_rows: IntArray, copies: FloatArray, ranks: FloatArray, total: float, interpolated: bool
) -> float:
    """Compute the AP of predictions, each of which counts as a number of copies.

    The precision envelope at a hit is the largest precision at its recall or a higher one. The loop
    goes from the hit with the lowest score to the one with the highest, so the envelope is the
    largest precision of the hits so far.

    Args:
        hit_rows: Indices of the predictions that match, in descending order of score. (H,)
        copies: Number of copies of each prediction. (N,)
        ranks: Number of copies of each prediction plus all copies of predictions before it. (N,)
        total: Number of ground truths, each counted as often as it has copies, > 0.
        interpolated: Whether AP is the mean precision at 101 recalls, instead of the area under
            the envelope.

    Returns:
        AP in [0, 1].
    """
    true_positives = 0.0  # hits down to the current one, first all of them
    for i in hit_rows:
        true_positives += copies[i]
    # Recall points above the recall of all predictions have a precision of 0.
    point = len(_RECALL_POINTS) - 1
    while _RECALL_POINTS[point] > true_positives / total:
        point -= 1
    envelope = 0.0
    ap = 0.0
    for i in hit_rows[::-1]:
        if copies[i] == 0:  # not in this resample
            continue
        denominator = ranks[i] + _SPACING if interpolated else ranks[i]
        envelope = max(envelope, true_positives / denominator)
        true_positives -= copies[i]  # now the number before this hit
        if interpolated:
            # Recall points that are reached with this hit, but not without it, have its envelope.
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
        hit_rows: Indices of the predictions that match at the first threshold, followed by the
            other thresholds. (H,)
        ends: End (exclusive) of each threshold in ``hit_rows``. (T,)
        scene: Scene of each prediction. (N,)
        scene_copies: Number of copies of each scene. (B, scenes)
        gts: Number of ground truths of each scene. (scenes,)
        interpolated: Whether AP is the mean precision at 101 recalls, instead of the area.

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
        interpolated: Whether AP is the mean precision at 101 recalls, instead of the area.

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
        AP in each resample (B,) by its flat key, such as ``<metric>/<class>/AP@<threshold>``; NaN
        if the resample has no ground truth of the class. Empty for a metric that ranks no
        predictions.

    Raises:
        ValueError: If ``resamples`` does not know the scene of a sample, or the AP of a metric of
            a user is computed by another rule than here.
    """
    if not report.detections:
        return {}
    # Intervals and groups are of the AP that is computed here, so it must be the metric's own.
    for key, (value,) in _figures(report, _Whole()).items():
        own_value = report.figure(key)
        if abs(value - own_value) > _SAME_AP:
            rule = "area below the curve" if report.by_distance else "mean at 101 recalls"
            raise InputError(
                f"{key} of the metric {report.name!r} is {own_value:.4f}, but its predictions have "
                f"the AP {value:.4f} ({rule}), so intervals and groups would be of another figure: "
                "set `by_distance` of its report, or leave `groups` and `detections` empty."
            )
    return _figures(report, resamples)


class _Whole:
    """The whole data set as a resample."""

    def draw_copies(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Return one part with all samples, and one copy of it; see `Weights`."""
        return np.zeros(len(tokens), dtype=np.int64), np.ones((1, 1))


def _figures(report: MetricReport, resamples: Weights) -> dict[str, FloatArray]:
    """Compute what `resampled_figures` returns, for a metric that ranks predictions."""
    scenes, scene_copies = resamples.draw_copies(report.tokens)
    # AP_chamfer, whose matches are by distance, is an area. AP_raster is a mean at 101 recalls.
    interpolated = not report.by_distance
    class_aps: dict[str, FloatArray] = {}
    figures: dict[str, FloatArray] = {}
    # `ranked` has the predictions of a class by descending score: their matches at each threshold
    # (``hits``), the indices of their samples, and the number of ground truths of each sample.
    for name, ranked in report.detections.items():
        if report.sample_aps:  # the metric is the mean of AP over the samples
            aps = _mean_of_samples(
                report.sample_aps[name], scenes=scenes, scene_copies=scene_copies
            )
        else:
            # Number of ground truths of each scene, as the sum over its samples.
            gts = np.bincount(scenes, weights=ranked.gts_of_sample, minlength=scene_copies.shape[1])
            aps = resampled_aps(
                ranked.hits,
                scene=scenes[ranked.samples],
                scene_copies=scene_copies,
                gts=gts.astype(np.float64),
                interpolated=interpolated,
            )
        class_aps[name] = aps
        for t, threshold in enumerate(ranked.thresholds):
            figures[f"{name}/AP@{threshold}"] = aps[:, t]
        figures[f"{name}/AP"] = aps.mean(axis=1)
    for group, names in report.groups.items():
        # A group has common thresholds. AP_chamfer has one group, all classes, whose keys have no
        # prefix.
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
        aps: AP of each sample; NaN for samples that do not count. (S, T)
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
    """Create the interval of a figure from its values in the resamples, without NaN values."""
    known = values[~np.isnan(values)]
    if not len(known):
        return Interval(value, low=UNDEFINED, high=UNDEFINED)
    low, high = np.percentile(known, _PERCENTILES)
    return Interval(value, low=float(low), high=float(high))


def ap_intervals(reports: Sequence[MetricReport], resamples: Resamples) -> dict[str, Interval]:
    """Compute the 95 % confidence interval of every AP.

    Args:
        reports: Reports of all metrics over all samples.
        resamples: Resamples of the scenes.

    Returns:
        Intervals by flat key, see `resampled_figures`.

    Raises:
        ValueError: If the scene of a sample is unknown.
    """
    intervals = {}
    for report in reports:
        for key, values in resampled_figures(report, resamples).items():
            intervals[key] = _interval(report.figure(key), values)
    return intervals


def ap_differences(
    first: Sequence[MetricReport], second: Sequence[MetricReport], resamples: Resamples
) -> dict[str, Interval]:
    """Compute the 95 % confidence interval of the difference of every AP, first minus second.

    Each resample has equal scenes in both results, so the difficulty of the scenes cancels.

    Args:
        first: Reports of all metrics of the first result.
        second: Reports of all metrics of the second result, over equal samples.
        resamples: Resamples of the scenes.

    Returns:
        Intervals by flat key, for the AP that is defined in both results and a resample.

    Raises:
        ValueError: If metrics or samples of the results differ, or the scene of a sample is
            unknown.
    """
    if _samples_of_metrics(first) != _samples_of_metrics(second):
        raise InputError("two results can be compared only if their samples and metrics are equal.")
    intervals = {}
    for first_report, second_report in zip(first, second, strict=True):
        first_figures = resampled_figures(first_report, resamples)
        # Equal samples and an equal seed give equal resamples.
        second_figures = resampled_figures(second_report, resamples)
        for key, values in first_figures.items():
            first_value = first_report.figure(key)
            second_value = second_report.figure(key)
            differences = values - second_figures[key]
            if UNDEFINED in (first_value, second_value) or np.isnan(differences).all():
                continue
            intervals[key] = _interval(first_value - second_value, values=differences)
    return intervals


def _samples_of_metrics(reports: Sequence[MetricReport]) -> list[tuple[str, list[str]]]:
    """Return the name of each metric and the tokens of its samples."""
    return [(report.name, list(report.tokens)) for report in reports]


def format_intervals(intervals: Mapping[str, Interval], title: str, signed: bool = False) -> str:
    """Format a table with one row for each figure: its key, value and interval.

    Args:
        intervals: Intervals by key.
        title: First line of the table.
        signed: Whether values above 0 have a plus sign, for differences. Otherwise, a figure whose
            interval does not exist is ``-``.
    """
    width = max((len(key) for key in intervals), default=0)  # width of the column of keys
    form = "+.4f" if signed else ".4f"
    rows = [title]
    for key, interval in intervals.items():
        value = format(interval.value, form)
        if interval.low == interval.high == UNDEFINED and not signed:
            rows.append(f"{key:<{width}}  -")
            continue
        low = format(interval.low, form)
        high = format(interval.high, form)
        rows.append(f"{key:<{width}}  {value}  {low} to {high}")
    return "\n".join(rows)
