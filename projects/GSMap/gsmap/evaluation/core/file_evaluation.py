"""Score a result file against a ground-truth file, in one or more processes."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.core.evaluator import MapEvaluator, SampleMatches
from gsmap.evaluation.core.metric import Sample
from gsmap.evaluation.core.report import MetricReport
from gsmap.evaluation.core.results_json import GROUND_TRUTH_KEY, RESULTS_KEY, THREE_D, SampleFile
from gsmap.structures.elements import MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.shards import WHOLE, Shard
from gsmap.utils.split_lists import require_results_of
from gsmap.utils.words import counted

CHUNK = 64  # samples per task: large enough to hide the hand-over, small enough to share evenly
Evaluation = tuple[list[MetricReport], list[str]]
"""A report per metric, and notes: elements left out, z ignored, samples without results."""


class AnnotatedTruth:
    """The ground truth of an annotation file, in the form of ``SampleFile``.

    Args:
        path: The file.
        classes: Names of the classes; elements of others get the label -1.
        shard: Which part of the samples to read.

    Raises:
        ValueError: If it lacks one of the classes, or, when read, a sample has no ground truth.
    """

    def __init__(self, path: str | Path, classes: Sequence[str], shard: Shard = WHOLE) -> None:
        self._file = AnnotationFile(path)
        names = self._file.meta.classes
        missing = [name for name in classes if name not in names]
        if missing:
            raise InputError(f"{path} has the classes {names}, not {missing}.")
        self._labels = np.array([classes.index(n) if n in classes else -1 for n in names])
        self._rows = shard.part(range(len(self._file)))
        self.ignored = Counter({THREE_D: len(self._file) * (self._file.meta.dim == 3)})

    def __iter__(self) -> Iterator[tuple[str, MapElements, int]]:
        """Yield token, elements and row of each sample."""
        names = self._file.meta.classes
        for row in self._rows:
            sample = self._file[row]
            if sample.instances is None:
                raise InputError(
                    f"{self._file.path}, sample {sample.token!r} has no ground truth: it cannot "
                    "be scored."
                )
            self.ignored.update(
                names[i.label] for i in sample.instances if self._labels[i.label] < 0
            )
            yield sample.token, self._elements(sample), row

    @property
    def split_list(self) -> str:
        """The list of scenes behind the file; empty if unknown."""
        return self._file.meta.split_list

    def tokens(self) -> list[str]:
        """Return the tokens of all samples, whatever the shard."""
        return self._file.column("token")

    def load(self, _token: str, row: int) -> MapElements:
        """Read the elements of one sample again."""
        return self._elements(self._file[row])

    def _elements(self, sample: MapSample) -> MapElements:
        elements = elements_of_instances(sample.instances or [])
        return replace(elements, labels=self._labels[elements.labels])


def scenes_of(path: str | Path) -> dict[str, str]:
    """Return the scene of each sample of an annotation file, by token; ValueError for JSON."""
    if Path(path).suffix.lower() == ".json":
        raise InputError(f"{path} knows no scenes: give the annotation file (.arrow).")
    file = AnnotationFile(path)
    return dict(zip(file.column("token"), file.column("scene"), strict=True))


def open_ground_truth(
    path: str | Path, classes: Sequence[str], shard: Shard = WHOLE
) -> AnnotatedTruth | SampleFile:
    """Open an annotation file, of which a shard is read, or MapTR's JSON, which is read whole."""
    if Path(path).suffix.lower() == ".json":
        return SampleFile(path, GROUND_TRUTH_KEY, classes)
    return AnnotatedTruth(path, classes, shard)


def read_ground_truth(
    path: str | Path, classes: Sequence[str]
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read all ground truth of an annotation file, or of MapTR's JSON, as ``read_samples`` does."""
    truth = open_ground_truth(path, classes)
    return {token: elements for token, elements, _ in truth}, truth.ignored


def mismatch_notes(results: Collection[str], truth: Collection[str], allowed: bool) -> list[str]:
    """Say which tokens of samples have no results or no ground truth.

    Args:
        results: Tokens of samples with results.
        truth: Tokens of samples with ground truth.
        allowed: Whether they may differ.

    Raises:
        ValueError: If they differ and may not.
    """
    notes = []
    for these, others, what, lack, treatment in (
        (truth, results, "sample", "no results", "counted as without predictions"),
        (results, truth, "result", "no ground truth", "left out"),
    ):
        alone = [token for token in these if token not in others]
        if alone:
            verb = "has" if len(alone) == 1 else "have"
            said = f"{counted(len(alone), what)} {verb} {lack}, such as {alone[0]!r}"
            notes.append(f"{said}: {treatment}" if allowed else said)
    if notes and not allowed:
        raise InputError(
            "; ".join(notes) + ": score the split that was predicted, or allow the mismatch."
        )
    return notes


class SamplePairs:
    """Predictions and ground truth of each sample of two files, for one walk through both.

    Few samples are in memory at a time: where the files have other orders, a sample waits by its
    place in the file, and is read again for its partner.

    Args:
        results_path: Results in MapTR's JSON form.
        truth_path: Ground truth, as ``open_ground_truth`` takes it.
        classes: Names of the classes.
        allow_mismatch: A sample without results counts as without predictions, and results without
            ground truth are left out; otherwise both are errors, after the last pair.
        shard: Which part of the ground truth's samples to take.
        allow_other_split: Whether results may be of a model that was trained on another split than
            that of the annotation file; otherwise that is an error, after the last pair.
        gaussians: Whether to read the Gaussians of results.
    """

    def __init__(
        self,
        results_path: str | Path,
        truth_path: str | Path,
        classes: Sequence[str],
        allow_mismatch: bool = False,
        shard: Shard = WHOLE,
        allow_other_split: bool = False,
        gaussians: bool = False,
    ) -> None:
        self._allow_other_split = allow_other_split
        self._results = SampleFile(results_path, RESULTS_KEY, classes, gaussians)
        self._truth = open_ground_truth(truth_path, classes, shard)
        self._allow_mismatch = allow_mismatch
        self._elsewhere: set[str] = set()  # what belongs to other shards is theirs
        if shard.count:
            tokens = self._truth.tokens()
            self._elsewhere = set(tokens).difference(shard.part(tokens))
        self._mismatches: list[str] = []
        self._degenerate = 0

    def __iter__(self) -> Iterator[Sample]:
        """Yield token, predictions and ground truth of each sample.

        Raises:
            FileNotFoundError: If a file does not exist.
            ValueError: If a file is malformed or the samples differ.
        """
        sides = self._results, self._truth
        waiting: tuple[dict[str, Any], dict[str, Any]] = {}, {}  # elements, or places of them
        mine = ((item for item in side if item[0] not in self._elsewhere) for side in sides)
        for items in zip_longest(*mine):
            if None not in items and items[0][0] == items[1][0]:
                yield self._counted(items[0][0], items[0][1], items[1][1])
                continue
            for own, item in enumerate(items):
                if item is None:
                    continue
                token, elements, place = item
                other = 1 - own
                if token in waiting[other]:
                    pair = [elements, self._load(sides[other], token, waiting[other].pop(token))]
                    yield self._counted(token, pair[own], pair[other])
                else:
                    waiting[own][token] = elements if len(waiting[own]) < CHUNK else place
        if isinstance(self._truth, AnnotatedTruth) and not self._allow_other_split:
            require_results_of(self._truth.split_list, self.about, self._results.path)
        self._mismatches = mismatch_notes(*waiting, self._allow_mismatch)
        nothing = MapElements.from_polylines()
        for token, kept in waiting[1].items():
            yield self._counted(token, nothing, self._load(self._truth, token, kept))

    @property
    def about(self) -> dict[str, Any]:
        """What the result file says of itself, after the walk."""
        return self._results.about

    def _load(self, side: Any, token: str, kept: Any) -> MapElements:
        """Return the elements of a sample that waited."""
        return kept if isinstance(kept, MapElements) else side.load(token, kept)

    def _counted(self, token: str, predictions: MapElements, truth: MapElements) -> Sample:
        self._degenerate += int((truth.num_points < 2).sum())
        return Sample(token, predictions, truth)

    def notes(self, counts_heights: bool) -> list[str]:
        """Say, after the walk, what was left out: elements, heights, samples without results."""
        notes = list(self._mismatches)
        ignored = [Counter(side.ignored) for side in (self._results, self._truth)]
        if sum(counts.pop(THREE_D, 0) for counts in ignored) and not counts_heights:
            notes.append(
                "some elements have 3D points: z is ignored (AP_chamfer can count it: dim 3)"
            )
        if self._degenerate:
            notes.append(
                f"{self._degenerate} ground truths have fewer than two points: they count, nothing "
                "can match"
            )
        for what, counts in zip(("predictions", "ground truths"), ignored, strict=True):
            notes += [
                f"{n} {what} of class {c!r} are not scored" for c, n in sorted(counts.items())
            ]
        return notes


def evaluate_files(
    results_path: str | Path,
    truth_path: str | Path,
    evaluator: MapEvaluator,
    num_workers: int = 1,
    allow_mismatch: bool = False,
    allow_other_split: bool = False,
) -> Evaluation:
    """Score a result file against ground truth.

    Args:
        results_path: Results in MapTR's JSON form.
        truth_path: Annotation file, or ground truth in MapTR's JSON form.
        evaluator: Metrics and their rules.
        num_workers: Number of processes.
        allow_mismatch: Whether the files may have different samples: one without results counts as
            without predictions, results without ground truth are left out.
        allow_other_split: Whether the model may be of another split than the annotation file.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed, or samples or splits differ.
    """
    pairs = SamplePairs(
        results_path, truth_path, evaluator.classes, allow_mismatch, WHOLE, allow_other_split
    )
    reports = evaluator.reports(match_samples(pairs, evaluator, num_workers))
    return reports, pairs.notes(evaluator.counts_heights)


def match_samples(
    pairs: Iterable[Sample], evaluator: MapEvaluator, num_workers: int = 1
) -> Iterator[SampleMatches]:
    """Match the samples in their order.

    Args:
        pairs: Token, predictions and ground truth of each.
        evaluator: The metrics.
        num_workers: Processes.
    """
    stream = iter(pairs)
    tasks = iter(lambda: list(islice(stream, CHUNK)), [])
    with Progress(unit="samples") as bar:
        for found in ordered_map(evaluator.match_all, tasks, num_workers):
            yield from found
            bar.update(len(found))
