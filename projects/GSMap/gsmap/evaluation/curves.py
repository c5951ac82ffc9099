"""Pictures of a result: precision over recall, and score against the share of matches."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.evaluation.average_precision import precision_recall, reliability
from gsmap.evaluation.report import MetricReport, threshold_key


def draw_curves(reports: Sequence[MetricReport], path: str | Path) -> None:
    """Draw a row per metric: a PR panel per class, and the calibration of all classes.

    Args:
        reports: The metrics.
        path: Picture file; its suffix gives the format.
    """
    from matplotlib.figure import Figure  # heavy, and only wanted on request

    columns = max(len(r.thresholds) for r in reports) + 1
    figure = Figure(figsize=(3.4 * columns, 3.2 * len(reports)), layout="constrained")
    axes = figure.subplots(len(reports), columns, squeeze=False)
    for row, report in zip(axes, reports, strict=True):
        for panel in row[len(report.thresholds) : -1]:
            panel.set_axis_off()
        for panel, name in zip(row, report.thresholds, strict=False):
            for curve in (c for c in report.curves if c.class_name == name):
                recall, precision = precision_recall(curve.hits, curve.num_gts)
                key = threshold_key(curve.threshold)
                ap = report.metrics[f"{report.name}/{name}/AP@{key}"]
                panel.plot(recall, precision, label=f"@{key}: {ap:.3f}", linewidth=1)
            panel.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
            panel.set_title(f"AP_{report.name}, {name}", fontsize=9)
            panel.legend(fontsize=7, loc="lower left")
        _draw_calibration(row[-1], report)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _draw_calibration(panel: Any, report: MetricReport) -> None:
    """Draw the share of matches at the loosest threshold over the score, class by class."""
    panel.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for name, thresholds in report.thresholds.items():
        loosest = thresholds[0] if report.name == "raster" else thresholds[-1]
        curve = next(c for c in report.curves if c.class_name == name and c.threshold == loosest)
        score, share, counts = reliability(curve.scores, curve.hits)
        filled = counts > 0
        panel.plot(score[filled], share[filled], marker="o", markersize=3, label=name)
    panel.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="score", ylabel="share of matches")
    panel.set_title(f"calibration, {report.name}", fontsize=9)
    panel.legend(fontsize=7, loc="upper left")
    panel.set_xticks(np.linspace(0, 1, 6))
