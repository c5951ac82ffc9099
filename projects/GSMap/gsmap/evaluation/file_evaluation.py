"""Score a result file against a ground-truth file, in one or more processes."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.evaluator import EvaluationConfig, SampleMatches, match_sample, reports
from gsmap.evaluation.report import MetricReport
from gsmap.evaluation.results_json import GROUND_TRUTH_KEY, RESULTS_KEY, THREE_D, read_samples
from gsmap.structures.elements import MapElements
from gsmap.utils.parallel import ordered_map

CHUNK = 64  # samples per task: large enough to hide the hand-over, small enough to share evenly
Samples = Mapping[str, MapElements]
Task = list[tuple[str, MapElements, MapElements]]  # token, predictions, ground truth


@dataclass(frozen=True)
class Evaluation:
    """Outcome of an evaluation.

    Args:
        reports: One report per metric.
        notes: What the reader should know: elements left out, z ignored, samples without results.
    """

    reports: list[MetricReport]
    notes: list[str]


def read_annotations(
    path: str | Path, classes: Sequence[str]
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read the ground truth of an annotation file.

    Args:
        path: The file.
        classes: Names of the classes to score.

    Returns:
        As ``read_samples``.

    Raises:
        ValueError: If the file lacks one of the classes, or a sample has no ground truth.
    """
    file = AnnotationFile(path)
    names = file.meta.classes
    missing = [name for name in classes if name not in names]
    if missing:
        raise ValueError(f"{path} has the classes {names}, not {missing}.")
    labels = np.array([classes.index(name) if name in classes else -1 for name in names])
    samples: dict[str, MapElements] = {}
    ignored: Counter[str] = Counter()
    for sample in file:
        if sample.instances is None:
            raise ValueError(
                f"{path}, sample {sample.token!r} has no ground truth: it cannot be scored."
            )
        elements = elements_of_instances(sample.instances)
        samples[sample.token] = replace(elements, labels=labels[elements.labels])
        ignored.update(names[i.label] for i in sample.instances if labels[i.label] < 0)
        ignored[THREE_D] += int(file.meta.dim == 3 and len(elements) > 0)
    return samples, ignored


def read_ground_truth(
    path: str | Path, classes: Sequence[str]
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read ground truth: our annotation file, or MapTR's and MapVR's JSON (``*.json``)."""
    if Path(path).suffix.lower() == ".json":
        return read_samples(path, GROUND_TRUTH_KEY, classes)
    return read_annotations(path, classes)


def mismatch_notes(results: Samples, truth: Samples, allow_mismatch: bool) -> list[str]:
    """Compare the tokens of results and ground truth.

    Args:
        results: The results.
        truth: The ground truth.
        allow_mismatch: A sample without results counts as without predictions, and results without
            ground truth are left out; otherwise both are errors.

    Raises:
        ValueError: If the tokens differ and that is not allowed.
    """
    notes = []
    for tokens, what, consequence in (
        (
            [t for t in truth if t not in results],
            "samples have no results",
            "counted as without predictions",
        ),
        ([t for t in results if t not in truth], "results have no ground truth", "left out"),
    ):
        if tokens:
            notes.append((f"{len(tokens)} {what}, such as {tokens[0]!r}", consequence))
    if notes and not allow_mismatch:
        raise ValueError(
            "; ".join(text for text, _ in notes)
            + ": score the split that was predicted, or allow the mismatch."
        )
    return [": ".join(note) for note in notes]


def _content_notes(
    truth: Samples, ignored: Mapping[str, Counter[str]], config: EvaluationConfig
) -> list[str]:
    """Say what is ignored."""
    notes = []
    with_height = sum(counts.pop(THREE_D, 0) for counts in ignored.values())
    if with_height and not (config.chamfer and config.chamfer.dim == 3):
        notes.append("some elements have 3D points: z is ignored (AP_chamfer can count it: dim 3)")
    degenerate = sum(int((elements.num_points < 2).sum()) for elements in truth.values())
    if degenerate:
        notes.append(
            f"{degenerate} ground truths have fewer than two points: they count, nothing can match"
        )
    for what, counts in ignored.items():
        notes += [f"{n} {what} of class {c!r} are not scored" for c, n in sorted(counts.items())]
    return notes


def _match_all(config: EvaluationConfig, task: Task) -> list[SampleMatches]:
    return [match_sample(*sample, config) for sample in task]


def evaluate_files(
    results_path: str | Path,
    truth_path: str | Path,
    config: EvaluationConfig,
    num_workers: int = 1,
    allow_mismatch: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Score a result file.

    Args:
        results_path: Results in MapTR's JSON form.
        truth_path: Ground truth: an annotation file, or MapTR's JSON.
        config: Metrics and their rules.
        num_workers: Number of processes.
        allow_mismatch: See ``mismatch_notes``.
        progress: Called with the number of samples done and in all.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed or the samples differ.
    """
    ignored: dict[str, Counter[str]] = {}
    results, ignored["predictions"] = read_samples(results_path, RESULTS_KEY, config.classes)
    truth, ignored["ground truths"] = read_ground_truth(truth_path, config.classes)
    notes = mismatch_notes(results, truth, allow_mismatch)
    notes += _content_notes(truth, ignored, config)
    return Evaluation(score(results, truth, config, num_workers, progress), notes)


def score(
    results: Samples,
    truth: Samples,
    config: EvaluationConfig,
    num_workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[MetricReport]:
    """Match all samples of the ground truth and compute the metrics.

    Args:
        results: Predictions by token; those of samples without ground truth are left out.
        truth: Ground truth by token.
        config: Metrics and their rules.
        num_workers: Number of processes.
        progress: Called with the number of samples done and in all.
    """
    nothing = MapElements.from_polylines()
    pairs = [(token, results.get(token, nothing), of_token) for token, of_token in truth.items()]
    tasks = [pairs[i : i + CHUNK] for i in range(0, len(pairs), CHUNK)]
    matches: list[SampleMatches] = []
    for found in ordered_map(partial(_match_all, config), tasks, num_workers):
        matches += found
        if progress is not None:
            progress(len(matches), len(pairs))
    return reports(matches, config)
