"""Curves and a table of runs: the JSON logs of their trainings, and what their tests found."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from gsmap.evaluation.core.average_precision import precision_recall
from gsmap.evaluation.core.report import MetricReport
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_text
from gsmap.visualization.plots import finish_panel, finish_shares, panel_grid
from gsmap.visualization.style import RUN_COLOURS, MapStyle

_TIMING = ("data_time", "time", "step", "epoch", "iter", "memory")


@dataclass(frozen=True)
class RunLog:
    """What one run logged.

    Args:
        name: Name for legends and tables.
        train: Records of training: ``step`` (iteration) and every scalar, such as ``loss``.
        val: Records of validation: ``step`` (epoch or iteration) and every metric.
    """

    name: str
    train: Sequence[Mapping[str, float]]
    val: Sequence[Mapping[str, float]]

    def series(self, key: str, validation: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return steps and finite values of one scalar, both (n,)."""
        records = self.val if validation else self.train
        pairs = [(r["step"], r[key]) for r in records if math.isfinite(r.get(key, math.nan))]
        steps, values = np.array(pairs, dtype=float).reshape(-1, 2).T
        return steps, values

    @property
    def metrics(self) -> list[str]:
        """Names of the validation metrics; of those with "mAP" in a name, these summaries alone."""
        names = list(dict.fromkeys(k for record in self.val for k in record if k not in _TIMING))
        return [name for name in names if "map" in name.lower()] or names


def _records(path: Path) -> list[dict[str, float]]:
    """Read one JSON record per line; a last line that a killed run left unfinished is dropped."""
    lines = read_text(path).splitlines()
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            if not isinstance(record, dict):
                raise InputError("it is no object")
            records.append({k: float(v) for k, v in record.items() if isinstance(v, int | float)})
        except (ValueError, OverflowError) as error:
            if number == len(lines):
                break
            raise InputError(f"{path}, line {number} is not JSON: {error}.") from error
    return [record for record in records if "step" in record]


def read_run(path: str | Path, name: str | None = None) -> RunLog:
    """Read the log of a run; of a step logged twice, as after a resume, the later record counts.

    Args:
        path: Work folder of the run, or a ``scalars.json``.
        name: Name for legends and tables; the folder's by default.

    Raises:
        FileNotFoundError: If there is no log.
        ValueError: If a line is not JSON, or there is no record.
    """
    path = Path(path)
    found = [*path.glob("*/vis_data/scalars.json"), *path.glob("vis_data/scalars.json")]
    files = [path] if path.is_file() else sorted(found)
    if not files:
        raise FileNotFoundError(
            f"No vis_data/scalars.json under {path}: give a work folder of tools/train.py, whose "
            "config keeps LocalVisBackend among the visualizer's vis_backends."
        )
    train: dict[float, dict[str, float]] = {}
    val: dict[float, dict[str, float]] = {}
    for file in files:  # oldest first: one per start
        for record in _records(file):
            (train if "loss" in record else val)[record["step"]] = record
    if not (train or val):
        raise InputError(f"{files[0]} holds no record of training: give a run's scalars.json.")
    ordered = [[part[step] for step in sorted(part)] for part in (train, val)]
    return RunLog(name or path.resolve().name, *ordered)


def smoothed(values: np.ndarray) -> np.ndarray:
    """Return the centred mean over a tenth of the values; it starts and ends as they do. (n,)"""
    total, at = np.cumsum(np.concatenate([[0.0], values])), np.arange(len(values))
    half = np.minimum(np.minimum(at, at[::-1]), len(values) // 20)
    return (total[at + half + 1] - total[at - half]) / (2 * half + 1)


def _draw_training(ax: Axes, runs: Sequence[RunLog], key: str, title: str) -> None:
    """Draw a figure of training, faintly as it was logged and smoothed, one colour per run."""
    for run, colour in zip(runs, RUN_COLOURS * len(runs), strict=False):
        steps, values = run.series(key)
        ax.plot(steps, values, color=colour, alpha=0.25, linewidth=0.8)
        ax.plot(steps, smoothed(values), color=colour, linewidth=1.6, label=run.name)
    _finish(ax, title)


def _draw_parts_of_loss(ax: Axes, run: RunLog) -> None:
    """Draw the terms of the last decoder layer; those of earlier ones begin with d0., d1."""
    keys = dict.fromkeys(k for record in run.train for k in record if "loss" in k and k != "loss")
    last = [key for key in keys if not re.match(r"d\d+\.", key)]
    for name, colour in zip(last, RUN_COLOURS * 8, strict=False):
        steps, values = run.series(name)
        ax.plot(steps, smoothed(values), color=colour, linewidth=1.4, label=name)
    _finish(ax, f"its parts, last decoder layer ({run.name})")


def _draw_metrics(ax: Axes, runs: Sequence[RunLog]) -> None:
    """Draw the validation metrics, one colour per run and one line style per metric."""
    for run, colour in zip(runs, RUN_COLOURS * len(runs), strict=False):
        styles = ("-", "--", ":", "-.") * len(run.metrics)
        for name, style in zip(run.metrics, styles, strict=False):
            label = f"{run.name}: {name}" if len(runs) > 1 else name
            series = run.series(name, validation=True)
            ax.plot(*series, style, color=colour, marker=".", label=label)
    by_epoch = any("epoch" in record for run in runs for record in run.train)
    _finish(ax, "validation", "epoch" if by_epoch else "iteration")
    ax.xaxis.set_major_locator(MaxNLocator("auto", integer=True))


def _finish(ax: Axes, title: str, x_label: str = "iteration") -> None:
    """Finish a panel; its y axis is logarithmic if the values span a decade.

    The legend stands beside the panel, off the curves.
    """
    values = np.concatenate([np.empty(0), *(np.asarray(line.get_ydata()) for line in ax.lines)])
    if len(values) and values.min() > 0 and values.max() > 10 * values.min():
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
    elif len(values) and values.min() >= 0:
        ax.set_ylim(0, 1.08 * (values.max() or 1.0))
    finish_panel(ax, title, x_label, legend={"loc": "upper left", "bbox_to_anchor": (1, 1)})


def _fill_row(axes: np.ndarray, panels: int) -> None:
    """Remove the panels that are not used; the last one that is takes the rest of its row."""
    for panel in axes.ravel()[panels:]:
        panel.remove()
    last, columns = axes.ravel()[panels - 1], axes.shape[1]
    row, column = divmod(panels - 1, columns)
    last.set_subplotspec(last.get_gridspec()[row, column:])


def plot_runs(runs: Sequence[RunLog]) -> Figure:
    """Draw total loss, the loss's parts (of the last run), and the validation metrics of runs.

    Raises:
        ValueError: If there is no run, or none that logged a loss.
    """
    if not any(run.train for run in runs):
        raise InputError("plot_runs needs at least one run that logged a loss.")
    validated = any(run.val for run in runs)
    figure, axes = panel_grid(2 if validated else 1, 2)
    _draw_training(axes[0, 0], runs, "loss", "training loss")
    _draw_parts_of_loss(axes[0, 1], runs[-1])
    if validated:
        _draw_metrics(axes[1, 0], runs)
        _fill_row(axes, 3)
    return figure


def plot_series(runs: Sequence[RunLog], keys: Sequence[str]) -> Figure:
    """Draw logged figures of training, such as ``at_floor``, a panel each, one colour per run.

    Raises:
        ValueError: If a figure is in no run's log.
    """
    logged = {key for run in runs for record in run.train for key in record}
    unknown = [key for key in keys if key not in logged]
    if unknown:
        raise InputError(f"no run logged {unknown}; there are {sorted(logged - set(_TIMING))}.")
    columns = min(len(keys), 2)
    figure, axes = panel_grid(-(-len(keys) // columns), columns)
    for panel, key in zip(axes.ravel(), keys, strict=False):
        _draw_training(panel, runs, key, key)
    _fill_row(axes, len(keys))
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
            if not found.num_gts:
                row[label].text(0.5, 0.5, "no ground truth", ha="center", fontsize=8)
            unit = " m" if first[index].name == "chamfer" else " IoU"
            title = f"{style.title(label)}, {found.thresholds[middle]:g}{unit}"
            y_label = "" if label else "precision"
            finish_shares(row[label], title, "recall", y_label, style.colour(label))
    lines, names = axes[0, 0].lines, list(reports)
    figure.legend(lines, names, loc="outside upper left", ncols=4, fontsize=8, frameon=False)
    return figure


def summary_table(runs: Sequence[RunLog]) -> str:
    """Return a Markdown table: per run its length, loss, speed, and last and best metrics."""
    names = list(dict.fromkeys(name for run in runs for name in run.metrics))
    header = ["run", "iterations", "loss (first)", "loss (last)", "s / iteration"]
    rows = [header + [f"{name} (last / best)" for name in names]]
    for run in runs:
        steps, loss = run.series("loss")
        seconds = run.series("time")[1]
        row = [run.name, f"{steps[-1]:g}" if len(steps) else "-"]
        row += [f"{loss[i]:.3g}" if len(loss) else "-" for i in (0, -1)]
        row.append(f"{np.median(seconds):.3g}" if len(seconds) else "-")
        for name in names:
            values = run.series(name, validation=True)[1]
            row.append(f"{values[-1]:.4g} / {values.max():.4g}" if len(values) else "-")
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    padded = ([c.ljust(w) for c, w in zip(row, widths, strict=True)] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)
