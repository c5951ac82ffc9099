"""Plots of results, of uncertainty and of robustness, in one style.

Figures are created without pyplot, which would keep them in memory. The caller saves them.
"""

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

WIDTH_IN = 7.5
"""Width of figures in inches: text of 7.5 points is legible in a plot 800 px wide."""


def panel_grid(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """Create a figure with a grid of panels.

    Args:
        rows: Number of rows.
        columns: Number of columns.

    Returns:
        Figure and its axes. (rows, columns)
    """
    # Panels are about as high as wide, with 0.3 inches for the title, but at most 2.8 inches high.
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
    """Set the title, the labels and the style of a panel.

    Args:
        ax: Axes with all data.
        title: Title, at the left.
        x_label: Quantity along x, with its unit.
        y_label: Quantity along y, with its unit.
        colour: Colour of the title.
        legend: Options of the legend, such as its location. There is a legend only if the data have
            labels.
    """
    # Names may contain dollar signs, which matplotlib would read as formulas.
    ax.set_title(title, fontsize=9, loc="left", color=colour, parse_math=False)
    ax.set_xlabel(x_label, fontsize=8)
    ax.set_ylabel(y_label, fontsize=8)
    ax.tick_params(labelsize=7.5)
    ax.grid(True, color="#E3E6EA", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    if ax.get_legend_handles_labels()[0]:
        shown_legend = ax.legend(
            fontsize=7.5, frameon=False, handlelength=1.4, borderaxespad=0.2, **(legend or {})
        )
        for text in shown_legend.get_texts():
            text.set_parse_math(False)


def finish_shares(ax: Axes, title: str, x_label: str, y_label: str, colour: str = "black") -> None:
    """Set the title, the labels and the style of a panel whose axes run from 0 to 1.

    Args:
        ax: Axes with all data.
        title: Title, at the left.
        x_label: Quantity along x.
        y_label: Quantity along y.
        colour: Colour of the title.
    """
    ax.set(xlim=(0, 1), ylim=(0, 1.02), xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
    finish_panel(ax, title, x_label=x_label, y_label=y_label, colour=colour)


def plot_result(reports: Sequence[MetricReport]) -> Figure:
    """Plot precision over recall of each class, and the calibration of the scores.

    The figure has a row for each metric, with a panel for each class and a panel for the
    calibration. Lines have the colours of their classes, and are paler for stricter thresholds.
    Their labels are the threshold and the AP in percent.

    Args:
        reports: Reports of one result, one per metric, all with equal classes.

    Returns:
        Figure.
    """
    style = MapStyle(tuple(reports[0].detections))
    figure, axes = panel_grid(len(reports), len(style.classes) + 1)
    for row, report in zip(axes, reports, strict=True):
        calibration_panel = row[-1]
        # Thresholds ascend. The last one is the loosest distance, but the strictest overlap.
        loosest = -1 if report.by_distance else 0
        # The diagonal is perfect calibration.
        calibration_panel.plot([0, 1], [0, 1], color=style.grid, linewidth=1)
        for label, (name, detections) in enumerate(report.detections.items()):
            panel = row[label]
            colour = style.colour(label)
            num_thresholds = len(detections.thresholds)
            for index, threshold in enumerate(detections.thresholds):
                # From 1 for the strictest threshold.
                rank = index + 1 if report.by_distance else num_thresholds - index
                ap = 100 * report.metrics[f"{report.name}/{name}/AP@{threshold}"]
                recall, precision = precision_recall(detections.hits[:, index], detections.num_gts)
                panel.plot(
                    recall,
                    precision,
                    label=f"{threshold:g}: {ap:.1f}",
                    color=colour,
                    alpha=0.3 + 0.7 * rank / num_thresholds,
                    linewidth=1.3,
                )
            finish_shares(
                panel,
                style.title(label),
                x_label="recall",
                y_label="" if label else f"{report.name}: precision",  # only in the first panel
                colour=colour,
            )
            # Mean score and share of hits in each bin of scores, at the loosest threshold.
            score, share, _ = reliability(detections.scores, detections.hits[:, loosest])
            calibration_panel.plot(score, share, "o-", markersize=3, color=colour)
        finish_shares(calibration_panel, "calibration", x_label="score", y_label="share of hits")
    return figure


def plot_uncertainty(vertices: Vertices, classes: Sequence[str], law: str = "normal") -> Figure:
    """Plot coverage of intervals and sparsification, in one row for errors along and one across.

    Coverage is the share of errors that lie within an interval which, by the sigmas and the law,
    contains a given share of the errors. In a calibrated model, both shares are equal.

    Sparsification is the mean error of the remaining vertices when the vertices with the largest
    sigma are removed. The pale curve below it is the optimum: the vertices with the largest errors
    are removed.

    Args:
        vertices: Vertices of matched predictions, with errors and sigmas along and across the line.
        classes: Class names in label order.
        law: Distribution of the errors, ``normal`` or ``laplace``.

    Returns:
        Figure.
    """
    style = MapStyle(tuple(classes))
    figure, axes = panel_grid(len(AXES), 2)
    for axis, (name, (left, right)) in enumerate(zip(AXES, axes, strict=True)):
        left.plot([0, 1], [0, 1], color=style.grid, linewidth=1)  # perfect calibration
        for label, title in enumerate(classes):
            class_vertices = vertices.select(vertices.labels == label)
            if not len(class_vertices.labels):
                continue
            errors = class_vertices.errors[:, axis]
            sigmas = class_vertices.sigmas[:, axis]
            colour = style.colour(label)
            # Share of the errors within the interval of each of `LEVELS`, the predicted shares.
            covered = coverage(errors, sigmas, law)
            left.plot(LEVELS, covered, label=title, color=colour, linewidth=1.3)
            # Entry k - 1 of a curve is the mean error of the k vertices that remain, out of the
            # order of the second argument of `sparsification`, the smallest first.
            removed = 1 - np.arange(1, len(errors) + 1) / len(errors)
            optimum = sparsification(errors, errors)
            right.plot(removed, optimum, alpha=0.3, color=colour, linewidth=1.3)
            by_sigma = sparsification(errors, sigmas)
            right.plot(removed, by_sigma, color=colour, linewidth=1.3)
        finish_shares(
            left, f"reliability {name}, {law} law", x_label="interval", y_label="share of errors"
        )
        right.set(xlim=(0, 1), ylim=(0, None))
        finish_panel(
            right,
            f"sparsification {name}",
            x_label="share taken away",
            y_label="mean error (m)",
        )
    return figure


def plot_severities(
    values: Mapping[str, Sequence[float]], clean: float, severities: Sequence[int]
) -> Figure:
    """Plot the AP over the severity of each corruption.

    Args:
        values: APs of each corruption at the first severities, in percent. each (S or fewer,)
        clean: AP without corruption, in percent.
        severities: Severities in rising order. (S,)

    Returns:
        Figure.
    """
    figure, axes = panel_grid(1, 1)
    ax = axes[0, 0]
    for index, (name, aps) in enumerate(values.items()):
        ax.plot(
            [0, *severities[: len(aps)]],
            [clean, *aps],
            "o-",
            color=f"C{index}",
            label=name,
            linewidth=1.3,
            markersize=3,
        )
    ax.set_ylim(0, None)
    legend = {"loc": "center left", "bbox_to_anchor": (1, 0.5)}
    finish_panel(ax, "corruptions", x_label="severity", y_label="AP_chamfer (%)", legend=legend)
    return figure
