"""Score a result file against a ground-truth file, in one or more processes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.evaluator import MapEvaluator, SampleMatches
from gsmap.evaluation.report import MetricReport
from gsmap.evaluation.results_json import GROUND_TRUTH_KEY, RESULTS_KEY, THREE_D, read_samples
from gsmap.structures.elements import MapElements
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.shards import WHOLE, Shard

CHUNK = 64  # samples per task: large enough to hide the hand-over, small enough to share evenly
Samples = Mapping[str, MapElements]
Evaluation = tuple[list[MetricReport], list[str]]
"""A report per metric, and notes: elements left out, z ignored, samples without results."""


def read_ground_truth(
    path: str | Path, classes: Sequence[str], shard: Shard = WHOLE
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read a shard of ground truth: an annotation file, or MapTR's JSON; as ``read_samples`` does.

    Raises:
        ValueError: If an annotation file lacks one of the classes, or a sample has no ground truth.
    """
    if Path(path).suffix.lower() == ".json":
        everything, ignored = read_samples(path, GROUND_TRUTH_KEY, classes)
        return {token: everything[token] for token in shard.part(list(everything))}, ignored
    file = AnnotationFile(path)
    names = file.meta.classes
    missing = [name for name in classes if name not in names]
    if missing:
        raise ValueError(f"{path} has the classes {names}, not {missing}.")
    labels = np.array([classes.index(name) if name in classes else -1 for name in names])
    samples: dict[str, MapElements] = {}
    ignored = Counter({THREE_D: len(file) * (file.meta.dim == 3)})
    for sample in map(file.__getitem__, shard.part(range(len(file)))):
        if sample.instances is None:
            raise ValueError(
                f"{path}, sample {sample.token!r} has no ground truth: it cannot be scored."
            )
        elements = elements_of_instances(sample.instances)
        samples[sample.token] = replace(elements, labels=labels[elements.labels])
        ignored.update(names[i.label] for i in sample.instances if labels[i.label] < 0)
    return samples, ignored


def mismatch_notes(results: Samples, truth: Samples, allowed: bool) -> list[str]:
    """Say which samples have no results or no ground truth.

    Raises:
        ValueError: If the tokens differ and that is not ``allowed``.
    """
    notes = []
    for these, others, what, treatment in (
        (truth, results, "samples have no results", "counted as without predictions"),
        (results, truth, "results have no ground truth", "left out"),
    ):
        alone = [token for token in these if token not in others]
        if alone:
            said = f"{len(alone)} {what}, such as {alone[0]!r}"
            notes.append(f"{said}: {treatment}" if allowed else said)
    if notes and not allowed:
        raise ValueError(
            "; ".join(notes) + ": score the split that was predicted, or allow the mismatch."
        )
    return notes


def evaluate_files(
    results_path: str | Path,
    truth_path: str | Path,
    evaluator: MapEvaluator,
    num_workers: int = 1,
    allow_mismatch: bool = False,
) -> Evaluation:
    """Score a result file; arguments as of ``match_files``."""
    matches, notes = match_files(results_path, truth_path, evaluator, num_workers, allow_mismatch)
    return evaluator.reports(matches), notes


def match_files(
    results_path: str | Path,
    truth_path: str | Path,
    evaluator: MapEvaluator,
    num_workers: int = 1,
    allow_mismatch: bool = False,
    shard: Shard = WHOLE,
) -> tuple[list[SampleMatches], list[str]]:
    """Match the samples of a result file.

    Args:
        results_path: Results in MapTR's JSON form.
        truth_path: Ground truth, as ``read_ground_truth`` reads it.
        evaluator: Metrics and their rules.
        num_workers: Number of processes.
        allow_mismatch: A sample without results counts as without predictions, and results without
            ground truth are left out; otherwise both are errors.
        shard: Which part of the ground truth's samples to match.

    Returns:
        The matches, and notes: elements left out, z ignored, samples without results.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed or the samples differ.
    """
    results, other_results = read_samples(results_path, RESULTS_KEY, evaluator.classes)
    truth, other_truth = read_ground_truth(truth_path, evaluator.classes, shard)
    if shard.count:  # what belongs to other shards is theirs
        if Path(truth_path).suffix.lower() == ".json":
            everywhere = set(read_samples(truth_path, GROUND_TRUTH_KEY, ())[0])
        else:
            everywhere = set(AnnotationFile(truth_path).column("token"))
        results = {t: found for t, found in results.items() if t in truth or t not in everywhere}
    notes = mismatch_notes(results, truth, allow_mismatch)
    with_height = other_results.pop(THREE_D, 0) + other_truth.pop(THREE_D, 0)
    if with_height and not (evaluator.chamfer and evaluator.chamfer.dim == 3):
        notes.append("some elements have 3D points: z is ignored (AP_chamfer can count it: dim 3)")
    degenerate = sum(int((elements.num_points < 2).sum()) for elements in truth.values())
    if degenerate:
        notes.append(
            f"{degenerate} ground truths have fewer than two points: they count, nothing can match"
        )
    for what, counts in (("predictions", other_results), ("ground truths", other_truth)):
        notes += [f"{n} {what} of class {c!r} are not scored" for c, n in sorted(counts.items())]
    return match_samples(results, truth, evaluator, num_workers), notes


def match_samples(
    results: Samples, truth: Samples, evaluator: MapEvaluator, num_workers: int = 1
) -> list[SampleMatches]:
    """Match all samples of the ground truth, by token; other results are left out."""
    nothing = MapElements.from_polylines()
    pairs = [(token, results.get(token, nothing), of_token) for token, of_token in truth.items()]
    tasks = [pairs[i : i + CHUNK] for i in range(0, len(pairs), CHUNK)]
    matches: list[SampleMatches] = []
    with Progress(total=len(pairs), unit="samples") as bar:
        for found in ordered_map(evaluator.match_all, tasks, num_workers):
            matches += found
            bar.update(len(found))
    return matches
