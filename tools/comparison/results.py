"""What a comparison found: figures with their standard deviation, differences, cost, curves."""

import json
import re
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
from gsmap.evaluation.core.file_evaluation import evaluate_files
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import MetricReport, flat_metrics
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json
from gsmap.utils.parallel import default_workers
from gsmap.utils.words import markdown_table
from gsmap.visualization.plots import finish_panel, panel_grid
from gsmap.visualization.style import RUN_COLOURS
from mapdata.upstream_configs.fields import Fields
from mapdata.upstream_configs.reader import read_assignments

_COSTS = {
    "iterations": ".0f",
    "million parameters": ".2f",
    "seconds a step": ".3f",
    "peak MiB": ".0f",
    "seconds a sample": ".4f",
}
_BATCH_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")


@dataclass
class Result:
    """What one run's folder tells.

    Attributes:
        name: Name of its config in the comparison.
        seed: Its seed; None if its folder does not say.
        folder: Its work folder.
        state: ``done``, or what is wrong.
        figures: All figures of its test, by flat key; empty if it is not done.
        costs: Iterations, million parameters, seconds a step and a tested sample, peak memory in
            MiB, as far as the folder tells.
        record: Machine, load and commands, where the comparison ran it.
        log: Its training log; None if there is none.
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
        name: Name of its config in the comparison.
        folder: The folder; its metrics are ``metrics.json`` (``tools/test.py --metrics-out``).
        seed: Its seed; the folder's config says it if it is not given.
    """
    record = _json(folder / RECORD)
    figures = _json(folder / "metrics.json")
    log = read_run(folder, name) if any(folder.glob("2*/vis_data/scalars.json")) else None
    steps = [r["step"] for r in log.train] if log else []
    state = "done" if figures else record.get("state", "cut off" if steps else "not started")
    if not figures and steps:
        state += f", after {max(steps):.0f} iterations"
    costs = {}
    if log and steps:
        costs["iterations"] = max(steps)
        costs["seconds a step"] = float(np.median(log.series("time")[1]))
        memory = log.series("memory")[1]  # only logged on a GPU
        if len(memory) or "peak_mib" in record:
            costs["peak MiB"] = float(memory.max()) if len(memory) else record["peak_mib"]
    newest = newest_checkpoint(folder) if figures else None
    if newest:
        weights = read_weights(newest).items()
        counted = sum(w.numel() for key, w in weights if not key.endswith(_BATCH_STATISTICS))
        costs["million parameters"] = counted / 1e6
    tests = sorted(folder.glob("test/*/[0-9]*.json"))
    if tests:
        timing = json.loads(tests[-1].read_text().splitlines()[-1])
        costs["seconds a sample"] = timing["time"] - timing["data_time"]
    if seed is None and log:
        seed = _config(folder).section("randomness").get("seed")
        if not isinstance(seed, int | None):
            raise InputError(
                f"{folder}: the seed in its config must be a number, got {seed!r:.60}."
            )
    return Result(name, seed, folder, state, figures, costs, record, log)


def _json(path: Path) -> dict[str, Any]:
    """Read a JSON object; empty if there is no such file."""
    content = read_json(path) if path.is_file() else {}
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold a JSON object, got {content!r:.60}.")
    return content


def _config(folder: Path) -> Fields:
    """Return the config that a run noted in its folder, read as data: others may have written it.

    Raises:
        ValueError: If there is none, or it is more than assignments of plain values.
    """
    noted = sorted(folder.glob("2*/vis_data/config.py"))
    if not noted:
        raise InputError(
            f"{folder} does not say what it is a run of: it holds no 2*/vis_data/config.py, which "
            "tools/train.py writes. Copy the whole work folder."
        )
    return Fields(read_assignments(noted[-1]))


def check_one_test_set(results: Sequence[Result]) -> None:
    """Raise a ValueError if the results' numbers of samples or of elements differ."""
    counts = [
        (r.folder, {k: v for k, v in r.figures.items() if k.endswith(("num_gts", "num_samples"))})
        for r in results
        if r.figures
    ]
    for folder, found in counts[1:]:
        first, expected = counts[0]
        if found != expected:
            raise InputError(
                f"{first} and {folder} were tested on different data: {expected} and {found}."
            )


def evaluator_for(annotations: Path, changes: Mapping[str, Any]) -> MapEvaluator:
    """Return the rules of both metrics for an annotation file, which says classes and range.

    ``changes`` are fields of ``ChamferConfig`` or ``RasterConfig``, or ``ground_truth_points``;
    ValueError if there is no such field.
    """
    meta = AnnotationFile(annotations).meta
    own: dict[str, Any] = {"classes": meta.classes, "grid": BEVGrid(meta.x_range, meta.y_range)}
    own |= {k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()}
    known = [{f.name for f in fields(c)} for c in (ChamferConfig, RasterConfig)]
    known.append({"ground_truth_points"})
    unknown = own.keys() - set().union(*known)
    if unknown:
        allowed = sorted(set().union(*known))
        raise InputError(f"no metric has the setting {sorted(unknown)}; there are {allowed}.")
    chamfer, raster, both = ({k: v for k, v in own.items() if k in part} for part in known)
    return MapEvaluator(ChamferConfig(**chamfer), RasterConfig(**raster), **both)


def rescore(result: Result, changes: Mapping[str, Any]) -> list[MetricReport]:
    """Score a run's ``results.json`` again, under changed rules if any are given."""
    dataset = _config(result.folder).section("test_dataloader.dataset")
    if "ann_file" not in dataset:
        raise InputError(f"{result.folder}: its config does not name the data of its test.")
    annotations = Path(str(dataset.get("data_root", "")), str(dataset["ann_file"]))
    evaluator = evaluator_for(annotations, changes)
    predictions = result.folder / "results.json"
    return evaluate_files(predictions, annotations, evaluator, default_workers())[0]


def _columns(results: Sequence[Result]) -> list[str]:
    """Return the keys of a table's figures: the APs of each class and their mean, both metrics."""
    keys = next((list(r.figures) for r in results if r.figures), [])
    columns = []
    for metric in METRIC_NAMES:
        counted = [k for k in keys if re.fullmatch(rf"{metric}/[^/]+/num_gts", k)]
        columns += [key.replace("num_gts", "AP") for key in counted]
        columns += [f"{metric}/mAP"] * bool(counted)
    return columns


def _cell(values: Sequence[float], factor: float = 1.0, form: str = ".1f") -> str:
    """Write a mean and, of several values, their standard deviation."""
    if not values:
        return "-"
    scaled = [factor * value for value in values]
    spread = f" ± {stdev(scaled):{form.lstrip('+')}}" if len(scaled) > 1 else ""
    return f"{mean(scaled):{form}}{spread}"


def differences_to_first(results: Sequence[Result]) -> dict[str, dict[str, list[float]]]:
    """Return, by name and figure, each seed's difference to the first config with that seed."""
    done = [r for r in results if r.figures]
    if not done:
        return {}
    first = {r.seed: r.figures for r in done if r.name == results[0].name}
    found: dict[str, dict[str, list[float]]] = {}
    for r in done:
        if r.name != results[0].name and r.seed in first:
            for key in _columns(results):
                pairs = found.setdefault(r.name, {}).setdefault(key, [])
                pairs.append(r.figures[key] - first[r.seed][key])
    return found


def markdown(results: Sequence[Result], title: str, command: str) -> str:
    """Write the tables of a comparison in Markdown: figures, paired differences, cost, runs.

    Runs that failed are there, too. Differences are to the config of the first result.
    """
    names = list(dict.fromkeys(r.name for r in results))
    columns = _columns(results)
    heads = [key.replace("/AP", "") for key in columns]
    figures, costs = [], []
    for name in names:
        done = [r for r in results if r.name == name and r.figures]
        cells = [_cell([r.figures[key] for r in done], 100) for key in columns]
        failed = sum(r.name == name and not r.figures for r in results)
        figures.append([name, f"{len(done)}" + f" ({failed} not done)" * bool(failed), *cells])
        spent = {key: [r.costs[key] for r in done if key in r.costs] for key in _COSTS}
        costs.append([name, *(_cell(spent[key], form=form) for key, form in _COSTS.items())])
    paired = differences_to_first(results)
    changes = [
        [name, str(len(of[columns[0]])), *(_cell(of[key], 100, "+.1f") for key in columns)]
        for name, of in paired.items()
    ]
    runs = []
    for r in results:
        at = [f"{r.record[k]:.1f}" for k in ("load_at_start", "load_at_end") if k in r.record]
        where = [str(r.folder), r.record.get("machine", "-"), " to ".join(at) or "-"]
        runs.append([r.name, str(r.seed), r.state, *where])
    parts = [
        f"# {title}\n\n`{command}`",
        "AP in percent, mean and standard deviation over seeds.",
        markdown_table(["config", "seeds", *heads], figures),
    ]
    if changes:
        parts.append(f"Differences to {names[0]}, seed by seed.")
        parts.append(markdown_table(["config", "pairs", *heads], changes))
    parts += [
        "Cost. Peak memory is the largest process's, or the GPU's.",
        markdown_table(["config", *_COSTS], costs),
        markdown_table(["config", "seed", "state", "folder", "machine", "load"], runs),
    ]
    return "\n\n".join(parts) + "\n"


def as_json(results: Sequence[Result], title: str, command: str) -> str:
    """Write all figures of a comparison."""
    keys = ("name", "seed", "state", "figures", "costs", "record")
    runs = [{key: getattr(r, key) for key in keys} | {"folder": str(r.folder)} for r in results]
    content = {"title": title, "command": command, "differences": differences_to_first(results)}
    return json.dumps({**content, "runs": runs}, indent=1)


def plot_iterations(results: Sequence[Result]) -> Figure | None:
    """Draw both metrics' mean over the iterations; None if no run was validated while training."""
    runs = [r for r in results if r.log and r.log.val and r.log.train]
    if not runs:
        return None
    drawn = [m for m in METRIC_NAMES if any(f"{m}/mAP" in r.log.metrics for r in runs if r.log)]
    figure, axes = panel_grid(1, max(len(drawn), 1))
    for panel, metric in zip(axes[0], drawn, strict=False):
        for name, colour in zip(dict.fromkeys(r.name for r in runs), RUN_COLOURS * 9, strict=False):
            for index, run in enumerate(r for r in runs if r.name == name):
                assert run.log is not None
                per_step = 1.0
                if "epoch" in run.log.train[-1]:  # validation counts epochs
                    per_step = run.log.train[-1]["step"] / run.log.train[-1]["epoch"]
                steps, values = run.log.series(f"{metric}/mAP", validation=True)
                label = None if index else name
                panel.plot(per_step * steps, 100 * values, ".-", color=colour, label=label)
        panel.set_ylim(0)
        finish_panel(panel, f"mAP_{metric} (%)", "iteration")
    return figure


def apply_rescoring(
    results: Sequence[Result], changes: Mapping[str, Any]
) -> dict[str, list[MetricReport]]:
    """Score again what the curves need: one run of each config, or all runs if rules change.

    With changed rules (`evaluator_for`) the results' figures become the new ones. Returns the
    reports of each config's first run that is done, by its name.
    """
    reports: dict[str, list[MetricReport]] = {}
    for result in results:
        if result.figures and (changes or result.name not in reports):
            found = rescore(result, changes)
            reports.setdefault(result.name, found)
            if changes:
                result.figures = flat_metrics(found)
    return reports
