"""Score a result file against a ground-truth file, sample by sample, in one or more processes."""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from gsmap.evaluation.evaluator import (
    METRIC_NAMES,
    EvaluationConfig,
    load_kernels,
    match_sample,
    table_reports,
    tables_of,
)
from gsmap.evaluation.json_index import JsonSamples
from gsmap.evaluation.matches import MatchTable, join_tables
from gsmap.evaluation.report import MetricReport
from gsmap.evaluation.results_json import GROUND_TRUTH_KEY, RESULTS_KEY, elements_from_vectors
from gsmap.evaluation.worker_pool import map_unordered, run_apart
from gsmap.structures.elements import MapElements

if TYPE_CHECKING:
    from gsmap.datasets.annotations.file import AnnotationFile

CHUNK = 32  # samples per task: large enough to hide the hand-over, small enough to share evenly


class Samples(Protocol):
    """Elements of many samples, by position."""

    @property
    def tokens(self) -> list[str]:
        """Names of the samples."""

    def elements(self, indices: Sequence[int]) -> tuple[list[MapElements], Counter[str]]:
        """Return the elements of some samples and what is to be said about them."""


@dataclass
class JsonElements:
    """Elements of a JSON file.

    Args:
        samples: The file.
        labels: Label of each class.
        scored: Whether its vectors have a confidence.
    """

    samples: JsonSamples
    labels: dict[str, int]
    scored: bool

    @property
    def tokens(self) -> list[str]:
        """Names of the samples."""
        return self.samples.tokens

    def elements(self, indices: Sequence[int]) -> tuple[list[MapElements], Counter[str]]:
        """Return the elements of some samples, with counts of 3D and of unknown elements.

        Args:
            indices: Positions in ``tokens``.

        Raises:
            ValueError: If a sample is malformed; the message names it.
        """
        # pyarrow starts a thread when it is loaded, which must not be before the workers are forked
        from gsmap.evaluation.json_batch import parse_batch

        pieces = [self.samples.piece(i) for i in indices]
        tokens = [self.tokens[i] for i in indices]
        batch = parse_batch(pieces, tokens, self.labels, self.scored)
        parsed = batch or [self._parse(i) for i in indices]
        notes: Counter[str] = Counter()
        for index, (elements, is_3d) in zip(indices, parsed, strict=True):
            notes["3D"] += len(elements) if is_3d else 0
            if (elements.labels < 0).any():
                names = (v["cls_name"] for v in self.samples.vectors(index))
                notes.update(name for name in names if name not in self.labels)
        return [elements for elements, _ in parsed], notes

    def _parse(self, index: int) -> tuple[MapElements, bool]:
        """Parse one sample of any form; the message of an error names it."""
        vectors = self.samples.vectors(index)
        try:
            elements = elements_from_vectors(vectors, self.labels, self.scored)
        except ValueError as error:
            token = self.tokens[index]
            raise ValueError(f"{self.samples.path}, sample {token!r}: {error}") from error
        return elements, any(len(p) == 3 for v in vectors for p in v["pts"][:1])


@dataclass(frozen=True)
class ArrowIndex:
    """What is read of an annotation file before its samples.

    Args:
        classes: Names of its classes.
        extent: Smallest x and y, largest x and y in metres.
        dim: Coordinates per point.
        tokens: Names of the samples.
    """

    classes: tuple[str, ...]
    extent: tuple[float, float, float, float]
    dim: int
    tokens: list[str]


def _arrow_index(path: str | Path) -> ArrowIndex:
    """Read the index in this process, which loads pyarrow and its threads."""
    from gsmap.datasets.annotations.file import AnnotationFile

    file = AnnotationFile(path)
    (x0, x1), (y0, y1) = file.meta.x_range, file.meta.y_range
    tokens: list[str] = file.column("token")
    return ArrowIndex(tuple(file.meta.classes), (x0, y0, x1, y1), file.meta.dim, tokens)


def read_arrow_index(path: str | Path, num_workers: int = 1) -> ArrowIndex:
    """Read the index of an annotation file.

    Args:
        path: The file.
        num_workers: Number of processes that will read the samples: with more than one the index is
            read in a process of its own, so that the workers can still be forked.
    """
    return run_apart(_arrow_index, path) if num_workers > 1 else _arrow_index(path)


class ArrowElements:
    """Ground truth of an annotation file; each process opens the file when it reads a sample.

    Args:
        path: The file.
        classes: Names of the classes to score.

    Raises:
        ValueError: If the file lacks one of the classes.
    """

    def __init__(self, path: str | Path, classes: Sequence[str]):
        index = _arrow_index(path)
        missing = [name for name in classes if name not in index.classes]
        if missing:
            raise ValueError(f"{path} has the classes {index.classes}, not {missing}.")
        self.path, self.tokens = path, index.tokens
        self._names, self._dim = index.classes, index.dim
        self._labels = [classes.index(name) if name in classes else -1 for name in index.classes]

    @cached_property
    def file(self) -> "AnnotationFile":
        """The file."""
        from gsmap.datasets.annotations.file import AnnotationFile

        return AnnotationFile(self.path)

    def elements(self, indices: Sequence[int]) -> tuple[list[MapElements], Counter[str]]:
        """Return the elements of some samples, with counts of 3D and of unknown elements.

        Args:
            indices: Positions in ``tokens``.

        Raises:
            ValueError: If a sample has no ground truth.
        """
        found = []
        notes: Counter[str] = Counter()
        for index in indices:
            sample = self.file[index]
            if sample.instances is None:
                raise ValueError(
                    f"{self.file.path}, sample {sample.token!r} has no ground truth: it cannot be "
                    "scored."
                )
            labels = [self._labels[instance.label] for instance in sample.instances]
            notes.update(
                self._names[i.label] for i in sample.instances if self._labels[i.label] < 0
            )
            notes["3D"] += len(labels) if self._dim == 3 else 0
            found.append(MapElements.from_polylines([i.points for i in sample.instances], labels))
        return found, notes


def open_ground_truth(path: str | Path, classes: Sequence[str], exact: bool = True) -> Samples:
    """Open ground truth: our annotation file, or MapTR's and MapVR's JSON.

    Args:
        path: ``*.json`` with ``{"GTs": [...]}``, or an annotation file.
        classes: Names of the classes to score.
        exact: See ``JsonSamples``.
    """
    if Path(path).suffix.lower() == ".json":
        labels = {name: i for i, name in enumerate(classes)}
        return JsonElements(JsonSamples(path, GROUND_TRUTH_KEY, exact), labels, scored=False)
    return ArrowElements(path, classes)


@dataclass
class _ChunkJob:
    """Matches the samples of one task; picklable."""

    results: Samples
    truth: Samples
    config: EvaluationConfig

    def __call__(
        self, pairs: Sequence[tuple[int, int]]
    ) -> tuple[dict[str, MatchTable], Counter[str], Counter[str]]:
        with_result = [pair[0] for pair in pairs if pair[0] >= 0]
        found, pred_notes = self.results.elements(with_result)
        predictions = dict(zip(with_result, found, strict=True))
        truth, gt_notes = self.truth.elements([pair[1] for pair in pairs])
        predictions[-1] = MapElements.from_polylines()
        matches = []
        for (result_index, truth_index), ground_truth in zip(pairs, truth, strict=True):
            gt_notes["degenerate"] += int((ground_truth.num_points < 2).sum())
            token = self.truth.tokens[truth_index]
            predicted = predictions[result_index]
            matches.append(match_sample(token, predicted, ground_truth, self.config))
        return tables_of(matches, self.config), pred_notes, gt_notes


@dataclass(frozen=True)
class Evaluation:
    """Outcome of an evaluation.

    Args:
        reports: One report per metric.
        notes: What the reader should know: elements left out, z ignored, samples without results.
    """

    reports: list[MetricReport]
    notes: list[str]


def pair_by_token(
    results: Sequence[str], truth: Sequence[str], allow_mismatch: bool
) -> tuple[list[tuple[int, int]], list[str]]:
    """Pair results with ground truth.

    Args:
        results: Tokens of the results.
        truth: Tokens of the ground truth.
        allow_mismatch: Count a sample without results as without predictions, and leave results
            without ground truth out; otherwise both are errors.

    Returns:
        Positions in both lists, -1 for no result, one pair per ground-truth sample; and notes.

    Raises:
        ValueError: If the tokens differ and that is not allowed.
    """
    position = {token: i for i, token in enumerate(results)}
    pairs = [(position.pop(token, -1), i) for i, token in enumerate(truth)]
    missing = [truth[i] for result, i in pairs if result < 0]
    notes = []
    if missing:
        notes.append(f"{len(missing)} samples have no results, such as {missing[0]!r}")
    if position:
        notes.append(
            f"{len(position)} results have no ground truth, such as {next(iter(position))!r}"
        )
    if notes and not allow_mismatch:
        raise ValueError(
            "; ".join(notes) + ": score the split that was predicted, or allow the mismatch."
        )
    if missing:
        notes[0] += ": counted as without predictions"
    if position:
        notes[-1] += ": left out"
    return pairs, notes


def _notes(pred: Counter[str], truth: Counter[str]) -> list[str]:
    """Say what was counted on the way."""
    notes = []
    if pred.pop("3D", 0) + truth.pop("3D", 0):
        notes.append("some elements have 3D points: z is ignored, both metrics are planar")
    degenerate = truth.pop("degenerate", 0)
    if degenerate:
        notes.append(
            f"{degenerate} ground truths have fewer than two points: they count, nothing can match"
        )
    for name, counts in (("predictions", pred), ("ground truths", truth)):
        for cls, number in sorted((+counts).items()):
            notes.append(f"{number} {name} of class {cls!r} are not scored")
    return notes


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
        allow_mismatch: See ``pair_by_token``.
        progress: Called with the number of samples done and in all.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed or the samples differ.
    """

    def read(exact: bool) -> tuple[_ChunkJob, list[tuple[int, int]], list[str]]:
        labels = {name: i for i, name in enumerate(config.classes)}
        samples = JsonSamples(results_path, RESULTS_KEY, exact)
        results = JsonElements(samples, labels, scored=True)
        truth = open_ground_truth(truth_path, config.classes, exact)
        pairs, notes = pair_by_token(results.tokens, truth.tokens, allow_mismatch)
        return _ChunkJob(results, truth, config), pairs, notes

    def evaluate(exact: bool) -> Evaluation:
        if num_workers > 1:  # what workers share is loaded while another process reads the indices
            found = run_apart(read, exact, meanwhile=lambda: load_kernels(config))
        else:
            found = read(exact)
        return _score(*found, num_workers, progress)

    if not allow_mismatch:  # with it some samples are never parsed, which alone proves a quick cut
        with suppress(ValueError):  # what is wrong, if anything is, the exact way tells
            return evaluate(exact=False)
    return evaluate(exact=True)


def _score(
    job: _ChunkJob,
    pairs: Sequence[tuple[int, int]],
    notes: list[str],
    num_workers: int,
    progress: Callable[[int, int], None] | None,
) -> Evaluation:
    """Match all pairs of samples and compute the metrics."""
    chunks = [pairs[i : i + CHUNK] for i in range(0, len(pairs), CHUNK)]
    tables: list[dict[str, MatchTable]] = []
    pred_notes: Counter[str] = Counter()
    gt_notes: Counter[str] = Counter()
    done = 0
    for found, of_pred, of_gt in map_unordered(job, chunks, num_workers):
        tables.append(found)
        pred_notes.update(of_pred)
        gt_notes.update(of_gt)
        done += len(next(iter(found.values())))
        if progress is not None:
            progress(done, len(pairs))
    joined = {name: join_tables([t[name] for t in tables if name in t]) for name in METRIC_NAMES}
    return Evaluation(table_reports(joined, job.config), notes + _notes(pred_notes, gt_notes))
