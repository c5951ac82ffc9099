"""Tables, the JSON file and curves of a comparison of runs."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev

from matplotlib.figure import Figure

from comparison.results import COSTS, Result
from comparison.run_curves import RunLog
from gsmap.evaluation.core.evaluator import METRIC_NAMES
from gsmap.evaluation.core.report import UNDEFINED
from gsmap.utils.words import markdown_table
from gsmap.visualization.plots import finish_panel, panel_grid
from gsmap.visualization.style import RUN_COLOURS


def _columns(results: Sequence[Result]) -> list[str]:
    """Keys of the figures in a table: the AP of each class and the mean, for both metrics."""
    tested = _finished(results)
    if not tested:
        return []
    columns = []
    for metric in METRIC_NAMES:
        aps = []
        # Groups of classes have an AP too, but only classes have a number of ground truths.
        for key in tested[0].figures:
            if re.fullmatch(rf"{metric}/[^/]+/num_gts", key):
                aps.append(key.replace("num_gts", "AP"))
        if aps:
            columns += [*aps, f"{metric}/mAP"]
    return columns


def _finished(results: Sequence[Result]) -> list[Result]:
    """Results with figures, which failed runs do not have."""
    return [result for result in results if result.figures]


def _cell(values: Sequence[float], factor: float = 1.0, form: str = ".1f") -> str:
    """Format the mean and, for several values, the standard deviation for a cell of a table."""
    if not values:
        return "-"
    scaled = [factor * value for value in values]
    text = f"{mean(scaled):{form}}"
    if len(scaled) > 1:
        unsigned_form = form.lstrip("+")
        text += f" ± {stdev(scaled):{unsigned_form}}"
    return text


def pairs_with_first(results: Sequence[Result]) -> list[tuple[Result, Result]]:
    """Pair the finished runs of each config with the runs of the first config, seed by seed.

    A run is in no pair if its seed is unknown, or if its config has several runs of this seed.

    Returns:
        A run of the first config and a run of another config in each pair.
    """
    done = _finished(results)
    counts = Counter((result.name, result.seed) for result in done)
    first_runs: dict[int, Result] = {}  # runs of the first config by seed
    others: list[Result] = []
    for result in done:
        if result.seed is None or counts[result.name, result.seed] > 1:
            continue
        if result.name == results[0].name:
            first_runs[result.seed] = result
        else:
            others.append(result)
    pairs = []
    for other in others:
        if other.seed in first_runs:
            pairs.append((first_runs[other.seed], other))
    return pairs


def differences_to_first(results: Sequence[Result]) -> dict[str, dict[str, list[float]]]:
    """Differences of the figures between each config and the first one, seed by seed.

    Returns:
        Differences by name of the config, then by key of the figure, in one list with an entry for
        each pair of `pairs_with_first` in which the figure exists.
    """
    differences: dict[str, dict[str, list[float]]] = {}
    for first, result in pairs_with_first(results):
        by_figure = differences.setdefault(result.name, {})
        for key in _columns(results):
            known = by_figure.setdefault(key, [])
            if UNDEFINED not in (first.figures[key], result.figures[key]):
                known.append(result.figures[key] - first.figures[key])
    return differences


def folders_without_pair(results: Sequence[Result]) -> list[str]:
    """Folders of the finished runs in no pair of `pairs_with_first`, if there are two configs."""
    done = _finished(results)
    config_names = {result.name for result in done}
    if len(config_names) < 2:
        return []
    paired: set[Path] = set()
    for first, result in pairs_with_first(results):
        paired |= {first.folder, result.folder}
    return [str(result.folder) for result in done if result.folder not in paired]


def markdown(results: Sequence[Result], title: str, command: str) -> str:
    """Write the tables of a comparison in Markdown: figures, paired differences, costs, runs.

    Args:
        results: Results of all runs, failed ones included. Differences are computed to the config
            of the first result.
        title: Title of the document.
        command: Command line that made the comparison.
    """
    by_name: dict[str, list[Result]] = {}
    for result in results:
        by_name.setdefault(result.name, []).append(result)
    names = list(by_name)
    columns = _columns(results)
    heads = [key.replace("/AP", "") for key in columns]
    figure_rows = []
    cost_rows = []
    for name, config_results in by_name.items():
        done = _finished(config_results)
        failed = len(config_results) - len(done)
        seeds = f"{len(done)} ({failed} not done)" if failed else f"{len(done)}"
        figure_rows.append([name, seeds, *_figure_cells(done, columns)])
        cost_rows.append([name, *_cost_cells(done)])
    difference_rows = []
    num_seeds = Counter(result.name for _, result in pairs_with_first(results))  # of both configs
    for name, differences in differences_to_first(results).items():
        row = [name, str(num_seeds[name])]
        for key in columns:
            row.append(_cell(differences[key], factor=100, form="+.1f"))
        difference_rows.append(row)
    run_rows = [_run_row(result) for result in results]
    parts = [
        f"# {title}\n\n`{command}`",
        "AP in percent, mean and standard deviation over seeds.",
        markdown_table(["config", "seeds", *heads], figure_rows),
    ]
    if difference_rows:
        parts.append(f"Differences to {names[0]}, seed by seed.")
        parts.append(markdown_table(["config", "pairs", *heads], difference_rows))
    without_pair = folders_without_pair(results)
    if without_pair:
        parts.append(
            "Runs without a pair, because their seed is unknown, is used by several runs of the "
            f"config, or is missing in the other config: {', '.join(without_pair)}."
        )
    parts += [
        "Cost. Peak memory is the largest process's, or the GPU's.",
        markdown_table(["config", *COSTS], cost_rows),
        markdown_table(["config", "seed", "state", "folder", "machine", "load"], run_rows),
    ]
    return "\n\n".join(parts) + "\n"


def _figure_cells(done: Sequence[Result], columns: Sequence[str]) -> list[str]:
    """Cells of the figures of one config, over its finished runs."""
    cells = []
    for key in columns:
        values = []
        for result in done:
            value = result.figures[key]
            if value != UNDEFINED:
                values.append(value)
        cells.append(_cell(values, factor=100))
    return cells


def _cost_cells(done: Sequence[Result]) -> list[str]:
    """Cells of the costs of one config, over its finished runs."""
    cells = []
    for key, form in COSTS.items():
        known_costs = [result.costs[key] for result in done if key in result.costs]
        cells.append(_cell(known_costs, form=form))
    return cells


def _run_row(result: Result) -> list[str]:
    """Name, seed, state, folder, machine and load of a run."""
    loads = []
    for key in ("load_at_start", "load_at_end"):
        if key in result.record:
            loads.append(f"{result.record[key]:.1f}")
    machine = result.record.get("machine", "-")
    load = " to ".join(loads) or "-"
    return [result.name, str(result.seed), result.state, str(result.folder), machine, load]


def as_json(results: Sequence[Result], title: str, command: str) -> str:
    """Write all figures of a comparison as JSON text.

    Args:
        results: Results of all runs.
        title: Title of the comparison.
        command: Command line that made the comparison.
    """
    runs = []
    for result in results:
        run = {
            "name": result.name,
            "seed": result.seed,
            "state": result.state,
            "figures": result.figures,
            "costs": result.costs,
            "record": result.record,
            "folder": str(result.folder),
        }
        runs.append(run)
    content = {
        "title": title,
        "command": command,
        "differences": differences_to_first(results),
        "without_pair": folders_without_pair(results),
        "runs": runs,
    }
    return json.dumps(content, indent=1)


def plot_iterations(results: Sequence[Result]) -> Figure | None:
    """Draw the mAP of both metrics over the iterations; None if no run has a validation."""
    logs: dict[str, list[RunLog]] = {}
    for result in results:
        if result.log and result.log.val and result.log.train:
            logs.setdefault(result.name, []).append(result.log)
    if not logs:
        return None
    logged: set[str] = set()
    for runs in logs.values():
        for log in runs:
            logged.update(log.metrics)
    metrics = [metric for metric in METRIC_NAMES if f"{metric}/mAP" in logged]
    figure, axes = panel_grid(1, max(len(metrics), 1))
    for panel, metric in zip(axes[0], metrics, strict=False):
        colours = RUN_COLOURS * 9  # they repeat if there are more configs than colours
        for (name, runs), colour in zip(logs.items(), colours, strict=False):
            label: str | None = name
            for log in runs:
                steps, values = log.series(f"{metric}/mAP", validation=True)
                per_epoch = _iterations_per_epoch(log)
                if per_epoch is not None:
                    # The steps of the validation are epochs. Convert them to iterations.
                    steps = per_epoch * steps
                panel.plot(steps, 100 * values, ".-", color=colour, label=label)
                label = None  # one entry of the legend for all seeds
        panel.set_ylim(0)
        finish_panel(panel, f"mAP_{metric} (%)", "iteration")
    return figure


def _iterations_per_epoch(log: RunLog) -> float | None:
    """Iterations of an epoch; None if the training log counts no epochs.

    The number is exact if the last iteration of an epoch was logged. The ratio of an epoch that was
    cut off is smaller.
    """
    ratios = []
    for entry in log.train:
        if "epoch" in entry:
            ratios.append(entry["step"] / entry["epoch"])
    return max(ratios, default=None)
