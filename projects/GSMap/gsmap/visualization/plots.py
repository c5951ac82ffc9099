"""Plots: panels in one style, precision over recall of a result."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsmap.evaluation.analysis.calibration import AXES, LEVELS, Vertices, sparsification
from gsmap.evaluation.analysis.calibration import reliability as coverage
from gsmap.evaluation.core.average_precision import precision_recall, reliability
from gsmap.evaluation.core.report import MetricReport
from gsmap.visualization.style import MapStyle

_LINE: dict[str, Any] = {"linewidth": 1.3, "markersize": 3}
WIDTH_IN = 7.5  # so that text of 7.5 points stays legible where a plot is shown 800 px wide


def panel_grid(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels. (rows, columns)"""
    height_in = rows * min(2.8, 0.3 + WIDTH_IN / columns)
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=200, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def finish_panel(
    ax: Axes,
    title: str,
    x_label: str = "",
    y_label: str = "",
    colour: str = "black",
    legend: Mapping[str, Any] | None = None,
) -> None:
    """Set what all plots share.

    Args:
        ax: The finished plot.
        title: Its title, at the left.
        x_label: What is along x, with its unit.
        y_label: What is along y, with its unit.
        colour: Colour of the title.
        legend: Options of its legend, such as where it stands.
    """
    ax.set_title(title, fontsize=9, loc="left", color=colour)
    ax.set_xlabel(x_label, fontsize=8)
    ax.set_ylabel(y_label, fontsize=8)
    ax.tick_params(labelsize=7.5)
    ax.grid(True, color="#E3E6EA", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            **{"fontsize": 7.5, "frameon": False, "handlelength": 1.4, "borderaxespad": 0.2},
            **(legend or {}),
        )


def finish_shares(ax: Axes, *options: Any) -> None:
    """Finish a panel whose axes both run from 0 to 1, with the options of ``finish_panel``."""
    ax.set(xlim=(0, 1), ylim=(0, 1.02), xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
    finish_panel(ax, *options)


def plot_result(reports: Sequence[MetricReport]) -> Figure:
    """Draw a row per metric of a result: precision over recall of each class, and the calibration.

    Lines have the colours of their classes, those of stricter thresholds paler.
    """
    style = MapStyle(tuple(reports[0].detections))
    figure, axes = panel_grid(len(reports), len(style.classes) + 1)
    for row, report in zip(axes, reports, strict=True):
        loosest = -1 if report.by_distance else 0
        row[-1].plot([0, 1], [0, 1], color=style.grid, linewidth=1)
        for label, (name, found) in enumerate(report.detections.items()):
            count = len(found.thresholds)
            for i, (threshold, hits) in enumerate(zip(found.thresholds, found.hits.T, strict=True)):
                ap = 100 * report.metrics[f"{report.name}/{name}/AP@{threshold}"]
                opacity = 0.3 + 0.7 * (i + 1 if loosest else count - i) / count
                curve = precision_recall(hits, found.num_gts)
                line = {"color": style.colour(label), "alpha": opacity, "linewidth": 1.3}
                row[label].plot(*curve, label=f"{threshold:g}: {ap:.1f}", **line)
            y_label = "" if label else f"{report.name}: precision"
            finish_shares(row[label], style.title(label), "recall", y_label, style.colour(label))
            score, share, _ = reliability(found.scores, found.hits[:, loosest])
            row[-1].plot(score, share, "o-", markersize=3, color=style.colour(label))
        finish_shares(row[-1], "calibration", "score", "share of hits")
    return figure


def plot_uncertainty(vertices: Vertices, classes: Sequence[str], law: str = "normal") -> Figure:
    """Draw a row for errors along and across: coverage of intervals, and sparsification.

    Sparsification shows the mean error in metres of what is left when the vertices of the largest
    sigma are taken away, and below it, pale, of the largest errors.

    Args:
        vertices: Matched vertices.
        classes: Names of the classes.
        law: What the errors are distributed by, ``normal`` or ``laplace``.
    """
    style = MapStyle(tuple(classes))
    figure, axes = panel_grid(len(AXES), 2)
    for axis, (name, (left, right)) in enumerate(zip(AXES, axes, strict=True)):
        left.plot([0, 1], [0, 1], color=style.grid, linewidth=1)
        for label, title in enumerate(classes):
            own = vertices.of(vertices.labels == label)
            if not len(own.labels):
                continue
            errors, sigmas = own.errors[:, axis], own.sigmas[:, axis]
            line = {"color": style.colour(label), "linewidth": 1.3}
            left.plot(LEVELS, coverage(errors, sigmas, law), label=title, **line)
            taken = 1 - np.arange(1, len(errors) + 1) / len(errors)
            right.plot(taken, sparsification(errors, errors), alpha=0.3, **line)
            right.plot(taken, sparsification(errors, sigmas), **line)
        finish_shares(left, f"reliability {name}, {law} law", "interval", "share of errors")
        right.set(xlim=(0, 1), ylim=(0, None))
        finish_panel(right, f"sparsification {name}", "share taken away", "mean error (m)")
    return figure


def plot_severities(
    values: Mapping[str, Sequence[float]], clean: float, severities: Sequence[int]
) -> Figure:
    """Draw the AP over the severity of each corruption.

    Args:
        values: APs of each corruption, in percent.
        clean: AP without any, in percent.
        severities: Of the columns of ``values``.
    """
    figure, axes = panel_grid(1, 1)
    ax = axes[0, 0]
    for number, (kind, aps) in enumerate(values.items()):
        ax.plot([0, *severities], [clean, *aps], "o-", color=f"C{number}", label=kind, **_LINE)
    ax.set_ylim(0, None)
    legend = {"loc": "center left", "bbox_to_anchor": (1, 0.5)}
    finish_panel(ax, "corruptions", "severity", "AP_chamfer (%)", legend=legend)
    return figure
