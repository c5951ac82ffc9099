"""Plots: panels in one style, precision over recall, maps of drives."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gsmap.evaluation.average_precision import precision_recall, reliability
from gsmap.evaluation.report import MetricReport
from gsmap.structures.elements import MapElements
from gsmap.visualization.bev_view import draw_lines
from gsmap.visualization.style import RUN_COLOURS, MapStyle

_WIDTH_IN = 7.5  # so that text of 7.5 points stays legible where a plot is shown 800 px wide


def panel_grid(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels. (rows, columns)"""
    height_in = rows * min(2.8, 0.3 + _WIDTH_IN / columns)
    figure = Figure(figsize=(_WIDTH_IN, height_in), dpi=200, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def finish_panel(
    ax: Axes,
    title: str,
    x_label: str = "",
    y_label: str = "",
    colour: str = "black",
    legend: Mapping[str, Any] | None = None,
) -> None:
    """Set what all plots share; ``legend`` says where its legend stands."""
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


def _finish_shares(ax: Axes, *options: str) -> None:
    """Finish a panel whose axes both run from 0 to 1."""
    ax.set(xlim=(0, 1), ylim=(0, 1.02), xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
    finish_panel(ax, *options)


def plot_result(reports: Sequence[MetricReport]) -> Figure:
    """Draw a row per metric of a result: precision over recall of each class, and the calibration.

    Lines have the colours of their classes, those of stricter thresholds paler.
    """
    style = MapStyle(tuple(reports[0].detections))
    figure, axes = panel_grid(len(reports), len(style.classes) + 1)
    for row, report in zip(axes, reports, strict=True):
        loosest = -1 if report.name == "chamfer" else 0
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
            _finish_shares(row[label], style.title(label), "recall", y_label, style.colour(label))
            score, share, _ = reliability(found.scores, found.hits[:, loosest])
            row[-1].plot(score, share, "o-", markersize=3, color=style.colour(label))
        _finish_shares(row[-1], "calibration", "score", "share of hits")
    return figure


def plot_precision_recall(reports: Mapping[str, Sequence[MetricReport]]) -> Figure:
    """Draw precision over recall of configs, by name, at the middle threshold.

    ``reports`` are of one run of each; a row is a metric, a panel a class.
    """
    first = next(iter(reports.values()))
    style = MapStyle(tuple(first[0].detections))
    figure, axes = panel_grid(len(first), len(style.classes))
    for index, row in enumerate(axes):
        for label, (name, found) in enumerate(first[index].detections.items()):
            middle = len(found.thresholds) // 2
            for of_run, colour in zip(reports.values(), RUN_COLOURS * 9, strict=False):
                of_class = of_run[index].detections[name]
                curve = precision_recall(of_class.hits[:, middle], of_class.num_gts)
                row[label].plot(*curve, color=colour, linewidth=1.3)
            unit = " m" if first[index].name == "chamfer" else " IoU"
            title = f"{style.title(label)}, {found.thresholds[middle]:g}{unit}"
            y_label = "" if label else "precision"
            _finish_shares(row[label], title, "recall", y_label, style.colour(label))
    lines, names = axes[0, 0].lines, list(reports)
    figure.legend(lines, names, loc="outside upper left", ncols=4, fontsize=8, frameon=False)
    return figure


def plot_maps(maps: Mapping[str, MapElements], track: np.ndarray, style: MapStyle) -> Figure:
    """Draw maps of one drive side by side (long ones one below the other), with the way driven.

    ``maps`` are in the global frame, by their titles; ``track`` holds the vehicle's positions in
    metres. (n, 2)
    """
    points = np.concatenate([track, *(elements.points[:, :2] for elements in maps.values())])
    low, high = points.min(axis=0) - 5, points.max(axis=0) + 5
    width, height = high - low
    rows = len(maps) if width > 2.5 * height else 1
    figure, axes = panel_grid(rows, len(maps) // rows)
    across = _WIDTH_IN * rows / len(maps) - 0.5  # without the labels
    figure.set_figheight(0.4 + rows * (across * min(height / width, 2) + 0.5))
    for ax, (title, elements) in zip(axes.ravel(), maps.items(), strict=True):
        lines = [line[:, :2] - low for line in elements.polylines]
        draw_lines(ax, lines, elements.labels, style, style.colours(elements.labels), 0.8)
        ax.plot(*(track - low).T, ".", color=style.ink, markersize=1.2)
        ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
        finish_panel(ax, title)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g} m")
    labels = sorted({int(label) for elements in maps.values() for label in elements.labels})
    lines = [Line2D([], [], color=style.colour(i), lw=2, label=style.title(i)) for i in labels]
    figure.legend(handles=lines, loc="outside upper right", ncols=4, fontsize=8, frameon=False)
    return figure
