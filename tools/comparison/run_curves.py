"""Curves and a table of runs, from the JSON logs of trainings and the reports of tests."""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
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

# A record is one line of a log: the scalars that were logged at one step. Keys of records that are
# not metrics:
_TIMING = ("data_time", "time", "step", "epoch", "iter", "memory")


@dataclass(frozen=True)
class RunLog:
    """Log of one training.

    Args:
        name: Name for legends and tables.
        train: Records of training, with ``step`` (iteration) and scalars such as ``loss``.
        val: Records of validation, with ``step`` (epoch or iteration) and metrics.
        num_replaced: Number of earlier trainings in the work folder, which are left out.
    """

    name: str
    train: Sequence[Mapping[str, float]]
    val: Sequence[Mapping[str, float]]
    num_replaced: int = 0

    def series(self, key: str, validation: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Steps and finite values of one scalar.

        Args:
            key: Name of the scalar.
            validation: Whether to read the records of validation instead of training.

        Returns:
            Steps and values; records without a finite value are left out. (n,) each
        """
        records = self.val if validation else self.train
        steps = []
        values = []
        for record in records:
            value = record.get(key, math.nan)
            if math.isfinite(value):
                steps.append(record["step"])
                values.append(value)
        return np.array(steps, dtype=float), np.array(values, dtype=float)

    @property
    def metrics(self) -> list[str]:
        """Names of the validation metrics: the mAPs, or all metrics if there is no mAP."""
        names = []
        for key in logged_keys(self.val):
            if key not in _TIMING:
                names.append(key)
        mean_names = [name for name in names if _is_mean_ap(name)]
        return mean_names or names


def _is_mean_ap(name: str) -> bool:
    """Whether a figure is a mAP of any kind. A metric or a class may have "map" in its name."""
    return "map" in name.rpartition("/")[2].lower()


def logged_keys(records: Iterable[Mapping[str, float]]) -> list[str]:
    """Keys of all records, in the order of their first use."""
    keys: dict[str, None] = {}
    for record in records:
        keys.update(dict.fromkeys(record))
    return list(keys)


def _records(path: Path) -> list[dict[str, float]]:
    """Read one JSON record per line, without an unfinished last line of a killed run."""
    lines = read_text(path).splitlines()
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            if not isinstance(record, dict):
                raise InputError("it is not a JSON object")
            scalars = {}
            for key, value in record.items():
                if isinstance(value, int | float):
                    scalars[key] = float(value)
            if "step" in scalars:
                records.append(scalars)
        # An `InputError` is a ValueError. A number beyond the range of float is an OverflowError.
        except (ValueError, OverflowError) as error:
            if number == len(lines):  # the unfinished last line
                break
            raise InputError(f"{path}, line {number} is not JSON: {error}.") from error
    return records


def read_run(path: str | Path, name: str | None = None) -> RunLog:
    """Read the log of a run.

    A resumed run goes on from a checkpoint: earlier records from its first step on are left out.
    If the run began anew in the work folder, these are all records of the earlier training.

    Args:
        path: Work folder of the run, or a ``scalars.json``.
        name: Name for legends and tables; by default the name of the folder.

    Raises:
        FileNotFoundError: If there is no log.
        ValueError: If a line is not JSON, or there is no record.
    """
    path = Path(path)
    if path.is_file():
        files = [path]
    else:
        logs = [*path.glob("*/vis_data/scalars.json"), *path.glob("vis_data/scalars.json")]
        files = sorted(logs)
    if not files:
        raise FileNotFoundError(
            f"No vis_data/scalars.json under {path}: give a work folder of tools/train.py, whose "
            "config keeps LocalVisBackend among the visualizer's vis_backends."
        )
    train: dict[float, dict[str, float]] = {}
    val: dict[float, dict[str, float]] = {}
    num_replaced = 0
    for file in files:  # one for each start of the run, oldest first
        records = _records(file)
        first = next((record for record in records if "loss" in record), None)
        if first is not None and train:
            start = first["step"]
            num_replaced += start <= min(train)
            train = {step: record for step, record in train.items() if step < start}
            # Validations have the number of their epoch, if the training counts epochs.
            start = first.get("epoch", start)
            val = {step: record for step, record in val.items() if step < start}
        for record in records:
            of_kind = train if "loss" in record else val
            of_kind[record["step"]] = record
    if not (train or val):
        raise InputError(f"{files[0]} holds no record of training: give a run's scalars.json.")
    return RunLog(
        name=name or path.resolve().name,
        train=[train[step] for step in sorted(train)],
        val=[val[step] for step in sorted(val)],
        num_replaced=num_replaced,
    )


def smooth(values: np.ndarray) -> np.ndarray:
    """Centred moving average over a tenth of the values; the window narrows at both ends. (n,)"""
    # The sum of the values i to j - 1 is total[j] - total[i].
    total = np.cumsum(np.concatenate([[0.0], values]))
    index = np.arange(len(values))
    to_nearest_end = np.minimum(index, index[::-1])
    half = np.minimum(to_nearest_end, len(values) // 20)  # values on each side in the window
    return (total[index + half + 1] - total[index - half]) / (2 * half + 1)


def _draw_training(ax: Axes, runs: Sequence[RunLog], key: str, title: str) -> None:
    """Draw a scalar of training for each run: all values faintly, and a smoothed curve."""
    # Here and below, colours are repeated in case there are more curves than colours. The longer
    # list of colours is cut by `zip`.
    for run, colour in zip(runs, RUN_COLOURS * len(runs), strict=False):
        steps, values = run.series(key)
        ax.plot(steps, values, color=colour, alpha=0.25, linewidth=0.8)
        ax.plot(steps, smooth(values), color=colour, linewidth=1.6, label=run.name)
    _finish(ax, title)


def _draw_parts_of_loss(ax: Axes, run: RunLog) -> None:
    """Draw the loss terms of the last decoder layer, which have no prefix such as ``d0.``."""
    last_layer = []
    for key in logged_keys(run.train):
        is_term = "loss" in key and key != "loss"
        if is_term and not re.match(r"d\d+\.", key):
            last_layer.append(key)
    for name, colour in zip(last_layer, RUN_COLOURS * 8, strict=False):
        steps, values = run.series(name)
        ax.plot(steps, smooth(values), color=colour, linewidth=1.4, label=name)
    _finish(ax, f"its parts, last decoder layer ({run.name})")


def _draw_metrics(ax: Axes, runs: Sequence[RunLog]) -> None:
    """Draw the validation metrics, one colour per run and one line style per metric."""
    for run, colour in zip(runs, RUN_COLOURS * len(runs), strict=False):
        styles = ("-", "--", ":", "-.") * len(run.metrics)
        for name, style in zip(run.metrics, styles, strict=False):
            label = f"{run.name}: {name}" if len(runs) > 1 else name
            steps, values = run.series(name, validation=True)
            ax.plot(steps, values, style, color=colour, marker=".", label=label)
    by_epoch = any("epoch" in logged_keys(run.train) for run in runs)
    x_label = "epoch" if by_epoch else "iteration"
    _finish(ax, "validation", x_label)
    ax.xaxis.set_major_locator(MaxNLocator("auto", integer=True))


def _finish(ax: Axes, title: str, x_label: str = "iteration") -> None:
    """Set the y axis, the labels and the legend of a panel.

    The y axis is logarithmic if the values span more than a factor of ten.
    """
    curves = [np.asarray(line.get_ydata()) for line in ax.lines]
    values = np.concatenate([np.empty(0), *curves])  # the empty array is for panels without curves
    if len(values) and values.min() > 0 and values.max() > 10 * values.min():
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
    elif len(values) and values.min() >= 0:
        ax.set_ylim(0, 1.08 * (values.max() or 1.0))  # up to 1.08 if all values are 0
    finish_panel(ax, title, x_label, legend={"loc": "upper left", "bbox_to_anchor": (1, 1)})


def _fill_row(axes: np.ndarray, panels: int) -> None:
    """Remove unused panels, and widen the last used panel to the end of its row.

    ``panels`` is the number of used panels.
    """
    for panel in axes.ravel()[panels:]:
        panel.remove()
    last = axes.ravel()[panels - 1]
    row, column = divmod(panels - 1, axes.shape[1])
    last.set_subplotspec(last.get_gridspec()[row, column:])


def plot_runs(runs: Sequence[RunLog]) -> Figure:
    """Draw the total loss of runs, the loss terms of the last run, and the validation metrics.

    Raises:
        ValueError: If no run has logged a loss.
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
    """Draw logged scalars of training: a panel for each scalar, one colour per run.

    Raises:
        ValueError: If no run has logged one of the scalars.
    """
    logged: set[str] = set()
    for run in runs:
        logged.update(logged_keys(run.train))
    unknown = [key for key in keys if key not in logged]
    if unknown:
        raise InputError(f"no run logged {unknown}; there are {sorted(logged - set(_TIMING))}.")
    columns = min(len(keys), 2)
    rows = math.ceil(len(keys) / columns)
    figure, axes = panel_grid(rows, columns)
    for panel, key in zip(axes.ravel(), keys, strict=False):
        _draw_training(panel, runs, key, key)
    _fill_row(axes, len(keys))
    return figure


def plot_precision_recall(reports: Mapping[str, Sequence[MetricReport]]) -> Figure:
    """Draw precision over recall at the middle threshold: a row per metric, a panel per class.

    Args:
        reports: For each config by its name, the reports of one run, one report per metric.
    """
    # All configs have the metrics and the classes of the first one.
    first_reports = next(iter(reports.values()))
    style = MapStyle(tuple(first_reports[0].detections))
    figure, axes = panel_grid(len(first_reports), len(style.classes))
    for index, row in enumerate(axes):  # index of the metric
        unit = " m" if first_reports[index].name == "chamfer" else " IoU"
        # The detections of a class are its predictions over all samples, by descending score.
        for label, (name, detections) in enumerate(first_reports[index].detections.items()):
            panel = row[label]
            middle = len(detections.thresholds) // 2
            for run_reports, colour in zip(reports.values(), RUN_COLOURS * 9, strict=False):
                ranked = run_reports[index].detections[name]
                # Whether each prediction is a match at the middle threshold.
                recall, precision = precision_recall(ranked.hits[:, middle], ranked.num_gts)
                panel.plot(recall, precision, color=colour, linewidth=1.3)
            if not detections.num_gts:
                panel.text(0.5, 0.5, "no ground truth", ha="center", fontsize=8)
            title = f"{style.title(label)}, {detections.thresholds[middle]:g}{unit}"
            y_label = "" if label else "precision"  # only at the first panel of the row
            finish_shares(panel, title, "recall", y_label, style.colour(label))
    figure.legend(
        axes[0, 0].lines,
        list(reports),
        loc="outside upper left",
        ncols=4,
        fontsize=8,
        frameon=False,
    )
    return figure


def summary_table(runs: Sequence[RunLog]) -> str:
    """Markdown table of runs: length, loss, speed, and the last value of each metric.

    A mAP has its best value, too. Of other metrics, the smallest may be the best. A value that a
    run has not logged is ``-``.
    """
    names: list[str] = []
    for run in runs:
        names += [name for name in run.metrics if name not in names]
    header = ["run", "iterations", "loss (first)", "loss (last)", "s / iteration"]
    for name in names:
        header.append(f"{name} (last / best)" if _is_mean_ap(name) else f"{name} (last)")
    rows = [header]
    for run in runs:
        steps, loss = run.series("loss")
        _, seconds = run.series("time")
        row = [run.name]
        if len(steps):
            row += [f"{steps[-1]:g}", f"{loss[0]:.3g}", f"{loss[-1]:.3g}"]
        else:
            row += ["-", "-", "-"]
        median = f"{np.median(seconds):.3g}" if len(seconds) else "-"
        row.append(median)
        for name in names:
            _, values = run.series(name, validation=True)
            cell = f"{values[-1]:.4g}" if len(values) else "-"
            if len(values) and _is_mean_ap(name):
                cell += f" / {values.max():.4g}"
            row.append(cell)
        rows.append(row)
    widths = [0] * len(header)
    for row in rows:
        for column, cell in enumerate(row):
            widths[column] = max(widths[column], len(cell))
    separator = ["-" * width for width in widths]
    rows.insert(1, separator)
    lines = []
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
