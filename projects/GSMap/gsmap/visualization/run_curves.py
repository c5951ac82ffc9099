"""Curves and a table of training runs, from the JSON logs that mmengine writes."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_COLOURS = ("#2D8CFF", "#FF9500", "#1DB954", "#AF52DE", "#FF3B30", "#5AC8FA", "#A2845E", "#34495E")
_TIMING = ("data_time", "time", "step", "epoch", "iter", "memory")


@dataclass(frozen=True)
class RunLog:
    """What one run logged.

    Args:
        name: Name for legends and tables.
        train: Records of training, by iteration: ``step`` and every scalar, such as ``loss``.
        val: Records of validation, in order: ``step`` (epoch or iteration) and every metric.
    """

    name: str
    train: tuple[Mapping[str, float], ...]
    val: tuple[Mapping[str, float], ...]

    def series(self, key: str, validation: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return steps and finite values of one scalar, both (n,)."""
        records = self.val if validation else self.train
        pairs = [(r["step"], r[key]) for r in records if math.isfinite(r.get(key, math.nan))]
        steps, values = zip(*pairs, strict=True) if pairs else ((), ())
        return np.array(steps, dtype=float), np.array(values, dtype=float)

    @property
    def metrics(self) -> list[str]:
        """Names of the validation metrics; of those with "mAP" in a name, these summaries alone."""
        names = [k for record in self.val for k in record if k not in _TIMING]
        names = list(dict.fromkeys(names))
        return [name for name in names if "map" in name.lower()] or names


def _log_files(path: Path) -> list[Path]:
    """Return the scalar logs of a run, oldest first: one per start."""
    if path.is_file():
        return [path]
    files = sorted(path.glob("*/vis_data/scalars.json")) or sorted(
        path.glob("vis_data/scalars.json")
    )
    if not files:
        raise FileNotFoundError(
            f"No vis_data/scalars.json under {path}: give a work folder of tools/train.py, whose "
            "config keeps LocalVisBackend among the visualizer's vis_backends."
        )
    return files


def _records(path: Path) -> list[dict[str, float]]:
    """Read one JSON record per line; a last line that a killed run left unfinished is dropped."""
    lines = path.read_text().splitlines()
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
        except json.JSONDecodeError as error:
            if number == len(lines):
                break
            raise ValueError(f"{path}, line {number} is not JSON: {error}.") from error
        records.append({k: float(v) for k, v in record.items() if isinstance(v, int | float)})
    return [record for record in records if "step" in record]


def read_run(path: str | Path, name: str | None = None) -> RunLog:
    """Read the log of a run; of a step logged twice, as after a resume, the later record counts.

    Args:
        path: Work folder of the run, or a ``scalars.json``.
        name: Name for legends and tables; the folder's by default.

    Returns:
        The log.

    Raises:
        FileNotFoundError: If there is no log.
        ValueError: If a line is not JSON.
    """
    path = Path(path)
    train: dict[float, dict[str, float]] = {}
    val: dict[float, dict[str, float]] = {}
    for file in _log_files(path):
        for record in _records(file):
            (train if "loss" in record else val)[record["step"]] = record
    ordered = [tuple(part[step] for step in sorted(part)) for part in (train, val)]
    return RunLog(name or path.resolve().name, *ordered)


def smoothed(values: np.ndarray, window: int) -> np.ndarray:
    """Return the running mean over the last ``window`` values, fewer at the start. (n,)"""
    total = np.cumsum(np.concatenate([[0.0], values]))
    upper = np.arange(1, len(values) + 1)
    lower = np.maximum(upper - window, 0)
    return (total[upper] - total[lower]) / (upper - lower)


def _parts_of_loss(run: RunLog) -> list[str]:
    """Return the loss terms of the last decoder layer; those of earlier ones begin with d0., d1."""
    keys = dict.fromkeys(k for record in run.train for k in record if "loss" in k and k != "loss")
    return [key for key in keys if not (key[0] == "d" and key.split(".")[0][1:].isdigit())]


def _finish(ax: Axes, title: str, x_label: str) -> None:
    """Set what all plots share; the y axis is logarithmic if the values span a decade."""
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines])
    if len(values) and values.min() > 0 and values.max() > 10 * values.min():
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
    elif len(values) and values.min() >= 0:
        ax.set_ylim(0, 1.08 * max(values.max(), 1e-9))
    ax.set_title(title, fontsize=10, loc="left")
    ax.set_xlabel(x_label, fontsize=8)
    ax.tick_params(labelsize=8)
    ax.grid(True, color="#E3E6EA", linewidth=0.7)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.legend(fontsize=7.5, frameon=False)


def _plot_metrics(ax: Axes, runs: Sequence[RunLog]) -> None:
    """Draw the validation metrics, one colour per run."""
    for run, colour in zip(runs, _COLOURS * len(runs), strict=False):
        for name, style in zip(
            run.metrics, ("-", "--", ":", "-.") * len(run.metrics), strict=False
        ):
            label = f"{run.name}: {name}" if len(runs) > 1 else name
            series = run.series(name, validation=True)
            ax.plot(*series, style, color=colour, marker=".", label=label)
    by_epoch = any("epoch" in record for run in runs for record in run.train)
    _finish(ax, "validation", "epoch" if by_epoch else "iteration")


def plot_runs(runs: Sequence[RunLog]) -> Figure:
    """Draw total loss, the loss's parts, and the validation metrics of runs.

    Args:
        runs: At least one; the parts of the loss are drawn for the last.

    Returns:
        The figure.

    Raises:
        ValueError: If there is no run, or none that logged a loss.
    """
    if not any(run.train for run in runs):
        raise ValueError("plot_runs needs at least one run that logged a loss.")
    validated = any(run.val for run in runs)
    columns = 3 if validated else 2
    figure = Figure(figsize=(4.4 * columns, 3.8), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    total, parts, *metrics = figure.subplots(1, columns)
    for run, colour in zip(runs, _COLOURS * len(runs), strict=False):
        steps, values = run.series("loss")
        total.plot(steps, values, color=colour, alpha=0.25, linewidth=0.8)
        total.plot(steps, smoothed(values, 10), color=colour, linewidth=1.6, label=run.name)
    _finish(total, "training loss", "iteration")
    for name, colour in zip(_parts_of_loss(runs[-1]), _COLOURS * 8, strict=False):
        steps, values = runs[-1].series(name)
        parts.plot(steps, smoothed(values, 10), color=colour, linewidth=1.4, label=name)
    _finish(parts, f"its parts, last decoder layer ({runs[-1].name})", "iteration")
    if validated:
        _plot_metrics(metrics[0], runs)
    return figure


def plot_series(runs: Sequence[RunLog], keys: Sequence[str]) -> Figure:
    """Draw logged figures of training, a panel a figure, one colour per run.

    Args:
        runs: At least one.
        keys: Names of the figures, such as ``soft_iou/divider``.

    Returns:
        The figure.

    Raises:
        ValueError: If a figure is in no run's log.
    """
    logged = {key for run in runs for record in run.train for key in record}
    unknown = [key for key in keys if key not in logged]
    if unknown:
        raise ValueError(f"no run logged {unknown}; there are {sorted(logged - set(_TIMING))}.")
    figure = Figure(figsize=(3.6 * len(keys), 3.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(keys), squeeze=False)[0]
    for panel, key in zip(panels, keys, strict=True):
        for run, colour in zip(runs, _COLOURS * len(runs), strict=False):
            steps, values = run.series(key)
            panel.plot(steps, values, color=colour, alpha=0.25, linewidth=0.8)
            panel.plot(steps, smoothed(values, 5), color=colour, linewidth=1.6, label=run.name)
        _finish(panel, key, "iteration")
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
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)) + " |" for r in rows
    ]
    lines.insert(1, "| " + " | ".join("-" * width for width in widths) + " |")
    return "\n".join(lines)
