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


def curves_of(
    found: Mapping[str, ClassDetections], thresholds: Mapping[str, Sequence[float]]
) -> list[Curve]:
    """Return one curve per class and threshold."""
    return [
        Curve(name, threshold, of_class.scores, of_class.hits[:, t], of_class.num_gts)
        for name, of_class in found.items()
        for t, threshold in enumerate(thresholds[name])
    ]


def _cell(value: float, digits: int = 4) -> str:
    return "-" if value == UNDEFINED or np.isnan(value) else f"{value:.{digits}f}"


def align(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of cells in columns: the first to the left, the others to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    rule = "-" * max(map(len, lines))
    return "\n".join([lines[0], rule, *lines[1:]])


def _class_rows(report: MetricReport, names: Sequence[str]) -> list[list[str]]:
    """One row per class that shares its thresholds with the others."""
    figures, rows = report.metrics, []
    loosest = 0 if report.name == "raster" else -1
    for name in names:
        keys = [threshold_key(t) for t in report.thresholds[name]]
        prefix = f"{report.name}/{name}"
        row = [name, _cell(figures[f"{prefix}/AP"])]
        row += [_cell(figures[f"{prefix}/AP@{key}"]) for key in keys]
        row.append(_cell(figures[f"{prefix}/recall@{keys[loosest]}"]))
        if report.name == "raster":
            row.append(_cell(figures[f"{prefix}/mIoU"]))
        else:
            row.append(_cell(figures[f"{prefix}/error_m@{keys[loosest]}"], 3))
        row.append(_cell(figures[f"{prefix}/calibration_error@{keys[loosest]}"], 3))
        row += [f"{figures[f'{prefix}/num_gts']:.0f}", f"{figures[f'{prefix}/num_preds']:.0f}"]
        rows.append(row)
    return rows


def format_table(report: MetricReport) -> str:
    """Return the table of a metric: a row per class, a column per threshold, the means below.

    Classes with the same thresholds stand together; the recall, the error and the calibration are
    those at the loosest threshold.
    """
    unit = "m" if report.name == "chamfer" else "IoU"
    last = "error m" if report.name == "chamfer" else "mIoU"
    blocks = [f"AP_{report.name}"]
    for group, names in report.groups.items():
        keys = [threshold_key(t) for t in report.thresholds[names[0]]]
        header = [group, "AP", *[f"@{k} {unit}" for k in keys], "recall", last, "calib. err."]
        rows = [[*header, "truths", "preds"], *_class_rows(report, names)]
        prefix = f"raster/{group}" if report.name == "raster" else "chamfer"
        mean = "chamfer/mAP" if report.name == "chamfer" else f"{prefix}/AP"
        row = [
            "mean",
            *[_cell(report.metrics[k]) for k in [mean, *[f"{prefix}/AP@{k}" for k in keys]]],
        ]
        rows.append(row + [""] * (len(rows[0]) - len(row)))
        blocks.append(align(rows))
    blocks.append(f"mAP_{report.name} = {_cell(report.metrics[f'{report.name}/mAP'], 6)}")
    return "\n".join(blocks)
