"""The outcome of a metric: flat figures, curves, and one table to read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.evaluation.average_precision import calibration_error
from gsmap.evaluation.matches import ClassDetections
from gsmap.structures.elements import BoolArray, FloatArray

UNDEFINED = -1.0  # as in COCO: the figure does not exist (a class without ground truth, no match)


def threshold_key(threshold: float) -> str:
    """Return a threshold as it stands in keys and tables: 0.5, 1.0, 0.25."""
    return str(round(float(threshold), 6))


@dataclass(frozen=True)
class Curve:
    """Ranked predictions of one class at one threshold, from which a curve is drawn.

    Args:
        class_name: The class.
        threshold: Metres for AP_chamfer, IoU for AP_raster.
        scores: Confidence, descending. (N,)
        hits: Whether each prediction matches. (N,)
        num_gts: Number of ground truths.
    """

    class_name: str
    threshold: float
    scores: FloatArray
    hits: BoolArray
    num_gts: int


@dataclass(frozen=True)
class MetricReport:
    """Everything that one metric says about a result.

    Args:
        name: ``chamfer`` or ``raster``.
        groups: Classes that share their thresholds and a mean, by the name of the group.
        thresholds: Thresholds of each class, ascending.
        metrics: Figures by flat keys such as ``chamfer/divider/AP@0.5``; -1 marks a figure that
            does not exist. The keys are listed in docs/evaluation.md.
        curves: One per class and threshold.
    """

    name: str
    groups: Mapping[str, Sequence[str]]
    thresholds: Mapping[str, tuple[float, ...]]
    metrics: dict[str, float]
    curves: list[Curve]

    @classmethod
    def of(
        cls,
        name: str,
        groups: Mapping[str, Sequence[str]],
        thresholds: Mapping[str, tuple[float, ...]],
        metrics: Mapping[str, float],
        found: Mapping[str, ClassDetections],
    ) -> "MetricReport":
        """Put the name of the metric before its keys, and add the curves of all classes."""
        curves = [
            Curve(class_name, threshold, of_class.scores, of_class.hits[:, t], of_class.num_gts)
            for class_name, of_class in found.items()
            for t, threshold in enumerate(thresholds[class_name])
        ]
        prefixed = {f"{name}/{key}": value for key, value in metrics.items()}
        return cls(name, groups, thresholds, prefixed, curves)


def class_figures(
    found: ClassDetections,
    thresholds: Sequence[float],
    average_precision: Callable[[BoolArray, int], float],
    absent: float,
) -> dict[str, float]:
    """Return the figures of one class that both metrics have, by the last part of their key.

    Args:
        found: The predictions of the class.
        thresholds: Thresholds of its hits. (T,)
        average_precision: Turns hits (N,) and the number of ground truths into an AP.
        absent: Recall of a class without ground truth.
    """
    figures: dict[str, float] = {}
    for t, threshold in enumerate(thresholds):
        key, hits = threshold_key(threshold), found.hits[:, t]
        figures[f"AP@{key}"] = average_precision(hits, found.num_gts)
        figures[f"recall@{key}"] = float(hits.sum()) / found.num_gts if found.num_gts else absent
        figures[f"tp@{key}"] = float(hits.sum())
        figures[f"calibration_error@{key}"] = calibration_error(found.scores, hits)
    figures["AP"] = float(np.mean([figures[f"AP@{threshold_key(t)}"] for t in thresholds]))
    figures["num_gts"] = float(found.num_gts)
    figures["num_preds"] = float(len(found.scores))
    return figures


def format_table(report: MetricReport) -> str:
    """Return the table of a metric: a row per class, a column per threshold, the means below.

    Classes with the same thresholds stand together; the recall, the error and the calibration are
    those at the loosest threshold.
    """
    chamfer = report.name == "chamfer"
    unit, last = ("m", "error m") if chamfer else ("IoU", "mIoU")
    blocks = [f"AP_{report.name}"]
    for group, names in report.groups.items():
        keys = [threshold_key(t) for t in report.thresholds[names[0]]]
        loosest = keys[-1 if chamfer else 0]
        aps = ["AP", *(f"AP@{key}" for key in keys)]
        details = {
            f"recall@{loosest}": 4,
            (f"error_m@{loosest}" if chamfer else "mIoU"): 3 if chamfer else 4,
            f"calibration_error@{loosest}": 3,
            "num_gts": 0,
            "num_preds": 0,
        }
        header = [group, "AP", *(f"@{key} {unit}" for key in keys), "recall", last]
        rows = [[*header, "calib. err.", "truths", "preds"]]
        for name in names:
            columns = [*((key, 4) for key in aps), *details.items()]
            figures = [(report.metrics[f"{report.name}/{name}/{key}"], n) for key, n in columns]
            rows.append([name, *(_cell(value, digits) for value, digits in figures)])
        means = ["mAP", *aps[1:]] if chamfer else [f"{group}/{key}" for key in aps]
        row = ["mean", *(_cell(report.metrics[f"{report.name}/{key}"]) for key in means)]
        blocks.append(_aligned([*rows, row + [""] * (len(rows[0]) - len(row))]))
    blocks.append(f"mAP_{report.name} = {_cell(report.metrics[f'{report.name}/mAP'], 6)}")
    return "\n".join(blocks)


def _cell(value: float, digits: int = 4) -> str:
    return "-" if value == UNDEFINED or np.isnan(value) else f"{value:.{digits}f}"


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of cells in columns: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [cell.rjust(w) for cell, w in zip(row, widths, strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])
