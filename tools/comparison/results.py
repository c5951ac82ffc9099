"""Results of the runs of a comparison: figures (values of metrics), costs and logs."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from comparison.plan import RECORD
from comparison.run_curves import RunLog, read_run
from gsmap.checkpoints.reading import read_weights
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.engine.launch import newest_checkpoint
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import METRIC_NAMES, MapEvaluator
from gsmap.evaluation.core.file_evaluation import SamplePairs, match_samples
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import MetricReport, flat_metrics
from gsmap.evaluation.core.results_json import RESULTS_KEY, SampleFile
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.faults import user_message
from gsmap.utils.files import read_json
from gsmap.utils.parallel import default_workers
from gsmap.utils.progress import Progress
from mapdata.upstream_configs.fields import Fields
from mapdata.upstream_configs.reader import read_assignments

_TABLE_PREFIXES = tuple(f"{name}/" for name in METRIC_NAMES)  # of the keys of figures in tables
COSTS = {  # number formats of the costs in the table, by cost
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
            in MiB, as far as they are known; keys of ``COSTS``.
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
    """Costs of a training that has begun, by keys of ``COSTS``.

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


def evaluator_for(
    annotations: Path, changes: Mapping[str, Any], dim: int | None = 2
) -> MapEvaluator:
    """Build AP_chamfer and AP_raster for an annotation file, with its classes and range.

    Args:
        annotations: The annotation file.
        changes: Changed rules: values of fields of ``ChamferConfig`` or ``RasterConfig``, or
            ``ground_truth_points``, the number of points to which ground truth is resampled.
        dim: Number of coordinates in distances, 2 or 3, unless ``changes`` has one; None for that
            of the file.

    Raises:
        ValueError: If there is no such field, or a value is of another type or out of range.
    """
    meta = AnnotationFile(annotations).meta
    settings: dict[str, Any] = {"classes": meta.classes}
    settings["grid"] = BEVGrid(meta.x_range, meta.y_range)
    examples: dict[str, Any] = {"classes": meta.classes, "ground_truth_points": 20}
    for config in (ChamferConfig, RasterConfig):
        for field in fields(config):
            if field.name not in settings:
                examples[field.name] = field.default
    for key, value in changes.items():
        if key not in examples:
            raise InputError(f"no metric has the setting {key!r}; there are {sorted(examples)}.")
        setting = tuple(value) if isinstance(value, list) else value
        expected = (int, float) if isinstance(examples[key], float) else (type(examples[key]),)
        if type(setting) not in expected:  # True is no number
            raise InputError(f"{key} must be a value such as {examples[key]}, got {value!r:.40}.")
        settings[key] = setting
    settings.setdefault("dim", dim or meta.dim)
    points = settings.pop("ground_truth_points", None)
    configs = []
    for config in (ChamferConfig, RasterConfig):
        config_settings = {}
        for field in fields(config):
            if field.name in settings:
                config_settings[field.name] = settings[field.name]
        configs.append(config(**config_settings))
    return MapEvaluator(*configs, ground_truth_points=points)


def rescore(result: Result, changes: Mapping[str, Any]) -> list[MetricReport]:
    """Score the ``results.json`` of a run again, with the changed rules of `evaluator_for`.

    The samples are those of the test, which may be a part of the annotation file (``indices``).

    Raises:
        FileNotFoundError: If there are no predictions or no annotation file.
        ValueError: If the config in the folder is missing or names no annotation file, if the
            results cannot be evaluated, or if they have other samples than the test.
    """
    predictions = result.folder / "results.json"
    if not predictions.is_file():
        raise FileNotFoundError(
            f"{predictions} is missing, the predictions of the test (tools/test.py --out): test "
            "the model again."
        )
    dataset = _config(result.folder).section("test_dataloader.dataset")
    if "ann_file" not in dataset:
        raise InputError(f"{result.folder}: its config does not name the data of its test.")
    annotations = Path(str(dataset.get("data_root", "")), str(dataset["ann_file"]))
    # The data set of the test decides whether its metric counts heights.
    evaluator = evaluator_for(annotations, changes, dim=dataset.get("dim", 2))
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


def apply_rescoring(
    results: Sequence[Result], changes: Mapping[str, Any]
) -> dict[str, list[MetricReport]]:
    """Score runs again.

    With changed rules, all runs are scored. Otherwise one run of each config is scored, for its
    precision-recall curves; a run that cannot be scored is named in a note.

    Args:
        results: Results of all runs. Their figures are replaced if rules change.
        changes: Changed rules, as in `evaluator_for`.

    Returns:
        Reports of the first finished run of each config, by name.
    """
    reports: dict[str, list[MetricReport]] = {}
    for result in results:
        if result.figures and (changes or result.name not in reports):
            try:
                rescored = rescore(result, changes)
            except (InputError, FileNotFoundError) as error:
                if changes:
                    raise
                note = user_message(error)
                Progress.write(f"{result.folder}: no precision-recall curves. {note}")
                continue
            reports.setdefault(result.name, rescored)
            if changes:
                result.figures = flat_metrics(rescored)
    return reports
