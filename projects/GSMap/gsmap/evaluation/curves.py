"""Pictures of a result: precision over recall, and score against the share of matches."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsmap.evaluation.average_precision import precision_recall, reliability
from gsmap.evaluation.report import MetricReport


def draw_curves(reports: Sequence[MetricReport], path: str | Path) -> None:
    """Draw a row per metric: a PR panel per class, and the calibration of all classes.

    Args:
        reports: The metrics.
        path: Picture file; its suffix gives the format.
    """
    from matplotlib.figure import Figure  # heavy, and only wanted on request

    columns = len(reports[0].detections) + 1
    figure = Figure(figsize=(3.4 * columns, 3.2 * len(reports)), layout="constrained")
    axes = figure.subplots(len(reports), columns, squeeze=False)
    for row, report in zip(axes, reports, strict=True):
        loosest = -1 if report.name == "chamfer" else 0
        row[-1].plot([0, 1], [0, 1], color="0.7", linewidth=1)
        for panel, (name, found) in zip(row, report.detections.items(), strict=False):
            for threshold, hits in zip(found.thresholds, found.hits.T, strict=True):
                ap = report.metrics[f"{report.name}/{name}/AP@{threshold}"]
                curve = precision_recall(hits, found.num_gts)
                panel.plot(*curve, label=f"@{threshold}: {ap:.3f}", linewidth=1)
            _finish(panel, f"AP_{report.name}, {name}", "recall", "precision", "lower left")
            score, share, _ = reliability(found.scores, found.hits[:, loosest])
            row[-1].plot(score, share, marker="o", markersize=3, label=name)
        title = f"calibration, {report.name}"
        _finish(row[-1], title, "score", "share of matches", "upper left")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _finish(panel: Any, title: str, xlabel: str, ylabel: str, legend: str) -> None:
    panel.set(xlim=(0, 1), ylim=(0, 1.02), xlabel=xlabel, ylabel=ylabel)
    panel.set_title(title, fontsize=9)
    panel.legend(fontsize=7, loc=legend)
