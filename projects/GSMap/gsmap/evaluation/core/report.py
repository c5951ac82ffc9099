"""The outcome of a metric: flat figures, the ranked predictions, and one table to read."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsmap.evaluation.core.average_precision import calibration_error
from gsmap.evaluation.core.matches import ClassDetections
from gsmap.structures.elements import FloatArray
from gsmap.utils.files import write_text

UNDEFINED = -1.0  # as in COCO: the figure does not exist (a class without ground truth, no match)


@dataclass(frozen=True)
class MetricReport:
    """Everything that one metric says about a result.

    Args:
        name: Of the metric, such as ``chamfer`` or ``raster``.
        groups: Classes that share their thresholds and a mean, by the name of the group.
        metrics: Figures by flat keys such as ``chamfer/divider/AP@0.5``; -1 marks a figure that
            does not exist. The keys are listed in docs/evaluation.md.
        detections: The ranked predictions of each class, from which curves are drawn.
        tokens: The samples, sorted.
        sample_aps: Of a metric that is the mean over samples: the AP of each class in each sample,
            NaN where it does not count. C x (S, T)
        by_distance: Whether thresholds are distances, of which the last is the loosest; IoU if not.
    """

    name: str
    groups: Mapping[str, Sequence[str]]
    metrics: Mapping[str, float]
    detections: Mapping[str, ClassDetections]
    tokens: Sequence[str] = ()
    sample_aps: Mapping[str, FloatArray] = field(default_factory=dict)
    by_distance: bool = True

    @classmethod
    def of_figures(
        cls, name: str, figures: Mapping[str, float], tokens: Sequence[str] = ()
    ) -> "MetricReport":
        """Return the report of a metric that has figures alone.

        Args:
            name: Of the metric.
            figures: By their keys, without the name.
            tokens: The samples, sorted.
        """
        flat = {f"{name}/{key}": float(value) for key, value in figures.items()}
        return cls(name, {}, flat, {}, tokens)


def flat_metrics(reports: Iterable[MetricReport]) -> dict[str, float]:
    """Join the figures of several metrics under their flat keys."""
    return {key: value for report in reports for key, value in report.metrics.items()}


def write_figures(path: Path, reports: Iterable[MetricReport]) -> None:
    """Write the figures of several metrics as flat JSON."""
    write_text(path, json.dumps(flat_metrics(reports), indent=1) + "\n")


def class_figures(found: ClassDetections, aps: Sequence[float], absent: float) -> dict[str, float]:
    """Return the figures of one class that all metrics have, by the last part of their key.

    Args:
        found: Detections of the class.
        aps: Its AP at each threshold. (T,)
        absent: Recall of a class without ground truth.
    """
    figures: dict[str, float] = {}
    for threshold, hits, ap in zip(found.thresholds, found.hits.T, aps, strict=True):
        figures[f"AP@{threshold}"] = ap
        figures[f"recall@{threshold}"] = hits.sum() / found.num_gts if found.num_gts else absent
        figures[f"tp@{threshold}"] = float(hits.sum())
        figures[f"calibration_error@{threshold}"] = calibration_error(found.scores, hits)
    figures["AP"] = float(np.mean([figures[f"AP@{threshold}"] for threshold in found.thresholds]))
    figures["num_gts"] = float(found.num_gts)
    figures["num_preds"] = float(len(found.scores))
    return figures


def distance_figures(found: ClassDetections, aps: Sequence[float]) -> dict[str, float]:
    """Return ``class_figures`` of a metric by distance, and the mean distance of matches."""
    figures = class_figures(found, aps, absent=0.0)
    for t, threshold in enumerate(found.thresholds):
        errors = found.quality[found.hits[:, t]]
        figures[f"error_m@{threshold}"] = float(errors.mean()) if len(errors) else UNDEFINED
    return figures


def format_table(report: MetricReport) -> str:
    """Return the table of a metric: a row per class, a column per threshold, the means below.

    Classes with the same thresholds stand together; the recall, the error and the calibration are
    those at the loosest threshold. A metric that ranks no predictions has a row per figure.
    """
    if not report.groups:
        return "\n".join(f"{key:<44} {value:.4f}" for key, value in report.metrics.items())
    chamfer = report.by_distance
    unit, quality = ("m", "error m") if chamfer else ("IoU", "mIoU")
    lines = [f"AP_{report.name}"]
    for group, names in report.groups.items():
        thresholds = report.detections[names[0]].thresholds
        loosest = thresholds[-1 if chamfer else 0]
        aps = ["AP", *(f"AP@{t}" for t in thresholds)]
        error = f"error_m@{loosest}" if chamfer else "mIoU"
        details = [f"recall@{loosest}", error, f"calibration_error@{loosest}"]
        titles = ["AP", *(f"@{t} {unit}" for t in thresholds), "recall", quality, "calib. err."]
        means = ["mAP", *aps[1:]] if chamfer else [f"{group}/{key}" for key in aps]
        rows = {group: [*titles, "truths", "preds"]}
        for name in names:
            keys = [f"{name}/{key}" for key in (*aps, *details, "num_gts", "num_preds")]
            rows[name] = [_cell(report, key) for key in keys]
        rows["mean"] = [_cell(report, key) for key in means]
        widths = [max(len(title), 6) + 2 for title in rows[group]]
        for name, cells in rows.items():
            aligned = (cell.rjust(w) for cell, w in zip(cells, widths, strict=False))
            lines.append(name.ljust(max(map(len, rows))) + "".join(aligned))
        lines.insert(-len(rows) + 1, "-" * len(lines[-2]))
    absent = [name for name, found in report.detections.items() if not found.num_gts]
    if absent and len(absent) < len(report.detections) and not report.sample_aps:
        lines.append(f"without ground truth, and in no mean: {', '.join(absent)}")
    lines.append(f"mAP_{report.name} = {report.metrics[f'{report.name}/mAP']:.6f}")
    return "\n".join(lines)


def _cell(report: MetricReport, key: str) -> str:
    value = report.metrics[f"{report.name}/{key}"]
    return "-" if value == UNDEFINED else f"{value:.{0 if '/num_' in key else 4}f}"
