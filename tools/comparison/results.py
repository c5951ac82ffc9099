"""Results of a comparison of runs: figures (values of metrics), differences, costs and curves."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from comparison.plan import RECORD
from comparison.run_curves import RunLog, read_run
from gsmap.checkpoints.reading import read_weights
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.engine.launch import newest_checkpoint
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import METRIC_NAMES, MapEvaluator
from gsmap.evaluation.core.file_evaluation import SamplePairs, match_samples
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import UNDEFINED, MetricReport, flat_metrics
from gsmap.evaluation.core.results_json import RESULTS_KEY, SampleFile
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json
from gsmap.utils.parallel import default_workers
from gsmap.utils.words import markdown_table
from gsmap.visualization.plots import finish_panel, panel_grid
from gsmap.visualization.style import RUN_COLOURS
from mapdata.upstream_configs.fields import Fields
from mapdata.upstream_configs.reader import read_assignments

_TABLE_PREFIXES = tuple(f"{name}/" for name in METRIC_NAMES)  # of the keys of figures in tables
_COSTS = {  # number formats of the costs in the table, by cost
    "iterations": ".0f",
    "million parameters": ".2f",
    "seconds a step": ".3f",
    "peak MiB": ".0f",
    "seconds a test batch": ".4f",
}
# Last words of the keys of statistics of batch norms, which are stored like weights.
_BATCH_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")


@dataclass
class Result:
    """Contents of the work folder of one run.

    Attributes:
        name: Name of the config in the comparison.
        seed: The seed; None if it is unknown.
        folder: The work folder.
        state: ``done``, or how far the run came, such as ``not started``.
        figures: All figures of the test, by flat key; empty if the run is not done.
        costs: Iterations, million parameters, seconds per step and per tested sample, peak memory
            in MiB, as far as they are known; keys of ``_COSTS``.
        record: Machine, load and commands of the run; empty if `comparison.jobs.execute` did not
            start it.
        log: The training log; None if there is none.
    """

    name: str
    seed: int | None
    folder: Path
    state: str
    figures: dict[str, float]
    costs: dict[str, float]
    record: dict[str, Any]
    log: RunLog | None


def read_result(name: str, folder: Path, seed: int | None = None) -> Result:
    """Read the work folder of a run that ``tools/train.py`` and ``tools/test.py`` made.

    Args:
        name: Name of the config in the comparison.
        folder: The folder, with ``metrics.json`` (``tools/test.py --metrics-out``).
        seed: The seed; None reads it from the config in the folder.

    Raises:
        ValueError: If a file is damaged, the config is missing and its seed is needed, or this seed
            is no number.
    """
    record = _json(folder / RECORD)
    figures = _json(folder / "metrics.json")
    # The folder of a training log is named by the date of its start, such as 20260131_120000.
    log = read_run(folder, name) if any(folder.glob("2*/vis_data/scalars.json")) else None
    steps = []
    if log:
        steps = [entry["step"] for entry in log.train]
    state = "done" if figures else _unfinished_state(record, steps)
    costs = {}
    if log and steps:
        costs = _training_costs(log, steps, record=record)
    newest = newest_checkpoint(folder) if figures else None
    if newest:
        costs["million parameters"] = _count_parameters(newest) / 1e6
    # The log of a test is named by its date. Its last line has the mean times per batch.
    tests = sorted(folder.glob("test/*/[0-9]*.json"))
    if tests:
        lines = tests[-1].read_text().splitlines()
        timing = json.loads(lines[-1])
        costs["seconds a test batch"] = timing["time"] - timing["data_time"]  # without loading
    if seed is None and log:
        seed = _config(folder).section("randomness").get("seed")
        if not isinstance(seed, int | None):
            raise InputError(
                f"{folder}: the seed in its config must be a number, got {seed!r:.60}."
            )
    return Result(
        name=name,
        seed=seed,
        folder=folder,
        state=state,
        figures=figures,
        costs=costs,
        record=record,
        log=log,
    )


def _unfinished_state(record: Mapping[str, Any], steps: Sequence[float]) -> str:
    """State of a run without figures, given its logged iterations."""
    default_state = "cut off" if steps else "not started"
    state = record.get("state", default_state)
    if steps:
        state += f", after {max(steps):.0f} iterations"
    return state


def _training_costs(
    log: RunLog, steps: Sequence[float], record: Mapping[str, Any]
) -> dict[str, float]:
    """Costs of a training that has begun, by keys of ``_COSTS``.

    Args:
        log: The training log.
        steps: The iterations in the log.
        record: Record of the run, with ``peak_mib`` if its memory was measured.
    """
    _, seconds = log.series("time")
    costs = {"iterations": max(steps), "seconds a step": float(np.median(seconds))}
    _, memory = log.series("memory")  # only logged on a GPU
    if len(memory):
        costs["peak MiB"] = float(memory.max())
    elif "peak_mib" in record:
        costs["peak MiB"] = record["peak_mib"]
    return costs


def _count_parameters(checkpoint: Path) -> int:
    """Number of weights, without the statistics of batch normalization."""
    count = 0
    for key, weight in read_weights(checkpoint).items():
        if not key.endswith(_BATCH_STATISTICS):
            count += weight.numel()
    return count


def _json(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one if there is no such file."""
    content = read_json(path) if path.is_file() else {}
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold a JSON object, got {content!r:.60}.")
    return content


def _config(folder: Path) -> Fields:
    """Read the config in the folder of a run without running it, as its origin may be unknown.

    Raises:
        ValueError: If there is no config, or it has more than assignments of plain values.
    """
    configs = sorted(folder.glob("2*/vis_data/config.py"))
    if not configs:
        raise InputError(
            f"{folder} does not contain the config of its run, 2*/vis_data/config.py, which "
            "tools/train.py writes. Copy the whole work folder."
        )
    return Fields(read_assignments(configs[-1]))


def check_one_test_set(results: Sequence[Result]) -> None:
    """Check that all runs were tested on equal numbers of samples and elements.

    Only the metrics of the tables count.

    Raises:
        ValueError: If the numbers differ, or a run was tested by none of the metrics.
    """
    first_folder = None
    expected: dict[str, float] = {}
    for result in results:
        if not result.figures:
            continue
        counts = {}
        for key, value in result.figures.items():
            if key.startswith(_TABLE_PREFIXES) and key.endswith(("num_gts", "num_samples")):
                counts[key] = value
        if not counts:
            raise InputError(
                f"{result.folder}/metrics.json has no figures of {' or '.join(METRIC_NAMES)}: test "
                "the model again (tools/test.py --eval chamfer raster --metrics-out)."
            )
        if first_folder is None:
            first_folder = result.folder
            expected = counts
        elif counts != expected:
            raise InputError(
                f"{first_folder} and {result.folder} were tested on different data or by different "
                f"metrics: {expected} and {counts}."
            )


def evaluator_for(annotations: Path, changes: Mapping[str, Any]) -> MapEvaluator:
    """Build AP_chamfer and AP_raster for an annotation file, with its classes and range.

    Args:
        annotations: The annotation file.
        changes: Changed rules: values of fields of ``ChamferConfig`` or ``RasterConfig``, or
            ``ground_truth_points``, the number of points to which ground truth is resampled.

    Raises:
        ValueError: If there is no such field.
    """
    meta = AnnotationFile(annotations).meta
    settings: dict[str, Any] = {"classes": meta.classes}
    settings["grid"] = BEVGrid(meta.x_range, meta.y_range)
    for key, value in changes.items():
        settings[key] = tuple(value) if isinstance(value, list) else value
    points = settings.pop("ground_truth_points", None)
    configs = []
    allowed = {"ground_truth_points"}
    for config in (ChamferConfig, RasterConfig):
        config_settings = {}
        for field in fields(config):
            allowed.add(field.name)
            if field.name in settings:
                config_settings[field.name] = settings[field.name]
        configs.append(config(**config_settings))
    unknown = settings.keys() - allowed
    if unknown:
        raise InputError(
            f"no metric has the setting {sorted(unknown)}; there are {sorted(allowed)}."
        )
    return MapEvaluator(*configs, ground_truth_points=points)


def rescore(result: Result, changes: Mapping[str, Any]) -> list[MetricReport]:
    """Score the ``results.json`` of a run again, with the changed rules of `evaluator_for`.

    The samples are those of the test, which may be a part of the annotation file (``indices``).

    Raises:
        ValueError: If the config in the folder is missing or names no annotation file, if the
            results cannot be evaluated, or if they have other samples than the test.
    """
    dataset = _config(result.folder).section("test_dataloader.dataset")
    if "ann_file" not in dataset:
        raise InputError(f"{result.folder}: its config does not name the data of its test.")
    annotations = Path(str(dataset.get("data_root", "")), str(dataset["ann_file"]))
    evaluator = evaluator_for(annotations, changes)
    predictions = result.folder / "results.json"
    # The test has compared the split of the model with the split of the annotations.
    pairs = SamplePairs(
        predictions,
        annotations,
        classes=evaluator.classes,
        allow_mismatch=True,
        allow_other_split=True,
    )
    tested = set(SampleFile(predictions, RESULTS_KEY, evaluator.classes).tokens())
    samples = (sample for sample in pairs if sample.token in tested)
    reports = evaluator.reports(match_samples(samples, evaluator, default_workers()))
    for key, value in flat_metrics(reports).items():
        if key.endswith("/num_samples") and result.figures.get(key, value) != value:
            raise InputError(
                f"{predictions} has {value:.0f} samples of {annotations}, and "
                f"{result.figures[key]:.0f} were tested: test the model again."
            )
    return reports


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
        markdown_table(["config", *_COSTS], cost_rows),
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
    for key, form in _COSTS.items():
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


def apply_rescoring(
    results: Sequence[Result], changes: Mapping[str, Any]
) -> dict[str, list[MetricReport]]:
    """Score runs again.

    With changed rules, all runs are scored. Otherwise one run of each config is scored, for its
    precision-recall curves.

    Args:
        results: Results of all runs. Their figures are replaced if rules change.
        changes: Changed rules, as in `evaluator_for`.

    Returns:
        Reports of the first finished run of each config, by name.
    """
    reports: dict[str, list[MetricReport]] = {}
    for result in results:
        if result.figures and (changes or result.name not in reports):
            rescored = rescore(result, changes)
            reports.setdefault(result.name, rescored)
            if changes:
                result.figures = flat_metrics(rescored)
    return reports
