"""Reports of metrics: figures (named numbers), ranked predictions, and tables for people."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsmap.evaluation.core.average_precision import calibration_error
from gsmap.evaluation.core.matches import ClassDetections
from gsmap.structures.elements import FloatArray
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text

UNDEFINED = -1.0
"""Value of a figure that does not exist (a class without ground truth, no match), as in COCO."""


@dataclass(frozen=True)
class MetricReport:
    """Figures of one metric over all samples of a result.

    Args:
        name: Name of the metric, such as ``chamfer`` or ``raster``.
        groups: Classes with common thresholds and a common mean, by the name of the group.
        metrics: Figures by flat keys such as ``chamfer/divider/AP@0.5``; -1 marks a figure that
            does not exist. The keys are listed in docs/evaluation.md.
        detections: Ranked predictions of each class, for curves and intervals.
        tokens: Tokens of the samples, sorted.
        sample_aps: AP of each class in each of S samples at each of T thresholds, for a metric that
            is the mean over samples; NaN where a sample does not count. (S, T) per class
        by_distance: True if thresholds are distances in metres, and the last one is the loosest;
            False if thresholds are IoUs, and the first one is the loosest.
    """

    name: str
    groups: Mapping[str, Sequence[str]]
    metrics: Mapping[str, float]
    detections: Mapping[str, ClassDetections]
    tokens: Sequence[str] = ()
    sample_aps: Mapping[str, FloatArray] = field(default_factory=dict)
    by_distance: bool = True

    def figure(self, key: str) -> float:
        """Return a figure by its flat key.

        Raises:
            ValueError: If there is no such figure. A metric of a user can lack it.
        """
        if key not in self.metrics:
            raise InputError(
                f"the metric {self.name!r} ranks predictions, but its report has no {key!r}: let "
                "it have the figures of `distance_figures` for each class, and the means of the "
                "APs. A metric without an AP leaves `groups` and `detections` empty."
            )
        return self.metrics[key]

    @classmethod
    def of_figures(
        cls, name: str, figures: Mapping[str, float], tokens: Sequence[str] = ()
    ) -> "MetricReport":
        """Create the report of a metric that ranks no predictions.

        Args:
            name: Name of the metric.
            figures: Figures by their keys, without the name of the metric.
            tokens: Tokens of the samples, sorted.

        Returns:
            Report without groups and detections. `format_table` lists its figures in rows.
        """
        metrics = {}
        for key, value in figures.items():
            metrics[f"{name}/{key}"] = float(value)
        return cls(name, groups={}, metrics=metrics, detections={}, tokens=tokens)


def flat_metrics(reports: Iterable[MetricReport]) -> dict[str, float]:
    """Join the figures of several reports in one dictionary."""
    figures: dict[str, float] = {}
    for report in reports:
        figures.update(report.metrics)
    return figures


def write_figures(path: Path, reports: Iterable[MetricReport]) -> None:
    """Write the figures of several reports as flat JSON."""
    write_text(path, json.dumps(flat_metrics(reports), indent=1) + "\n")


def class_figures(
    detections: ClassDetections, aps: Sequence[float], absent: float
) -> dict[str, float]:
    """Compute the figures of one class that all metrics have in common.

    Args:
        detections: Predictions of the class.
        aps: AP of the class at each threshold. (T,)
        absent: Recall of a class without ground truth.

    Returns:
        Figures by the last part of their key, such as ``AP@0.5``.
    """
    num_gts = detections.num_gts
    figures: dict[str, float] = {}
    for t, threshold in enumerate(detections.thresholds):
        hits = detections.hits[:, t]
        # Mean gap between score and share of matches; -1 without predictions, as `UNDEFINED`.
        error = calibration_error(detections.scores, hits)
        figures[f"AP@{threshold}"] = aps[t]
        figures[f"recall@{threshold}"] = hits.sum() / num_gts if num_gts else absent
        figures[f"tp@{threshold}"] = float(hits.sum())
        figures[f"calibration_error@{threshold}"] = error
    figures["AP"] = float(np.mean(aps))
    figures["num_gts"] = float(num_gts)
    figures["num_preds"] = float(len(detections.scores))
    return figures


def distance_figures(detections: ClassDetections, aps: Sequence[float]) -> dict[str, float]:
    """Compute ``class_figures`` and the mean distance of the matches at each threshold.

    Args:
        detections: Predictions of one class under a metric by distance.
        aps: AP of the class at each threshold. (T,)

    Returns:
        Figures by the last part of their key, such as ``error_m@0.5``.
    """
    figures = class_figures(detections, aps, absent=0.0)
    for t, threshold in enumerate(detections.thresholds):
        # Under a metric by distance, ``quality`` is the distance of each match in metres.
        errors_m = detections.quality[detections.hits[:, t]]
        figures[f"error_m@{threshold}"] = float(errors_m.mean()) if len(errors_m) else UNDEFINED
    return figures


def format_table(report: MetricReport) -> str:
    """Format the table of a metric: a row per class, a column per threshold, the means below.

    Each group of classes has a table. Recall, error and calibration are at the loosest threshold.
    A metric that ranks no predictions has a row per figure.
    """
    if not report.groups:
        figure_lines = [f"{key:<44} {value:.4f}" for key, value in report.metrics.items()]
        return "\n".join(figure_lines)

    lines = [f"AP_{report.name}"]
    for group in report.groups:
        lines += _group_lines(report, group)
    absent = [name for name, ranked in report.detections.items() if not ranked.num_gts]
    some_are_absent = 0 < len(absent) < len(report.detections)
    # If the AP is a mean over samples, the predictions of an absent class count. Such a class is
    # therefore not left out of the means.
    if some_are_absent and not report.sample_aps:
        lines.append(f"without ground truth, left out of the means: {', '.join(absent)}")
    mean_ap = report.figure(f"{report.name}/mAP")
    lines.append(f"mAP_{report.name} = {mean_ap:.6f}")
    return "\n".join(lines)


def _group_lines(report: MetricReport, group: str) -> list[str]:
    """Format the table of one group of classes."""
    names = report.groups[group]
    thresholds = report.detections[names[0]].thresholds  # equal for all classes of a group
    if report.by_distance:
        unit = "m"
        loosest = thresholds[-1]
        error_title = "error m"
        error_key = f"error_m@{loosest}"
        # The keys of the means contain no group: "mAP" and "AP@0.5", for example.
        mean_keys = ["mAP"]
        mean_prefix = ""
    else:
        unit = "IoU"
        loosest = thresholds[0]
        error_title = "mIoU"
        error_key = "mIoU"
        # Each group has means, such as "line/AP" and "line/AP@0.5".
        mean_keys = [f"{group}/AP"]
        mean_prefix = f"{group}/"

    titles = ["AP"]
    class_keys = ["AP"]
    for threshold in thresholds:
        titles.append(f"@{threshold} {unit}")
        class_keys.append(f"AP@{threshold}")
        mean_keys.append(f"{mean_prefix}AP@{threshold}")
    titles += ["recall", error_title, "calib. err.", "truths", "preds"]
    class_keys += [f"recall@{loosest}", error_key, f"calibration_error@{loosest}"]
    class_keys += ["num_gts", "num_preds"]
    rows = [(group, titles)]
    for name in names:
        class_cells = [_cell(report, f"{name}/{key}") for key in class_keys]
        rows.append((name, class_cells))
    mean_cells = [_cell(report, key) for key in mean_keys]
    rows.append(("mean", mean_cells))

    name_width = max(len(name) for name, _ in rows)
    lines = []
    for name, cells in rows:
        line = name.ljust(name_width)
        # The row of means has cells for the AP columns only.
        for cell, title in zip(cells, titles, strict=False):
            line += cell.rjust(max(len(title), 6) + 2)  # a figure such as 0.1234 has 6 characters
        lines.append(line)
    last_class_line = lines[-2]  # before the line of the means
    # Below the titles. It is as wide as the row of a class, since the row of means is shorter.
    lines.insert(1, "-" * len(last_class_line))
    return lines


def _cell(report: MetricReport, key: str) -> str:
    """Format one figure; ``-`` if it does not exist."""
    value = report.figure(f"{report.name}/{key}")
    decimals = 0 if "/num_" in key else 4  # numbers of truths and predictions are counts
    return "-" if value == UNDEFINED else f"{value:.{decimals}f}"
