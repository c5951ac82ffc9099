"""Evaluation of a result file against a ground-truth file, in one or more processes."""

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
from gsmap.evaluation.core.results_json import (
    GROUND_TRUTH_KEY,
    RESULTS_KEY,
    THREE_D,
    SampleFile,
    read_leading_meta,
)
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import PRIORS
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.shards import WHOLE, Shard
from gsmap.utils.split_lists import require_results_of
from gsmap.utils.words import format_count

_CANVAS_TOLERANCE_M = 0.5  # ground truth that leaves a canvas by less than this gives no note
# Samples per task of a process. Larger tasks cost less communication, and smaller tasks balance the
# work of the processes.
CHUNK = 64
Evaluation = tuple[list[MetricReport], list[str]]
"""Reports of all metrics, and notes on ignored elements, heights and samples."""
Note = tuple[int, str]
"""Number of elements, and text that follows it; 0 for a text without a number in front."""


def file_labels(file: AnnotationFile, classes: Sequence[str]) -> IntArray:
    """Evaluated label of each class of an annotation file.

    Args:
        file: Annotation file.
        classes: Names of the evaluated classes.

    Returns:
        Index into ``classes`` of each class of the file, -1 for other classes. (classes of the
        file,)

    Raises:
        ValueError: If the file lacks one of the classes.
    """
    names = file.meta.classes
    missing = [name for name in classes if name not in names]
    if missing:
        raise InputError(f"{file.path} has the classes {names}, not {missing}.")
    labels = np.full(len(names), fill_value=-1)
    for label, name in enumerate(names):
        if name in classes:
            labels[label] = classes.index(name)
    return labels


class AnnotatedTruth:
    """Ground truth of an annotation file, with the interface of ``SampleFile``.

    ``SampleFile`` reads ground truth and results in MapTR's JSON form.

    Args:
        path: Path of the file.
        classes: Names of the classes; elements of other classes get the label -1 and do not count.
        shard: Part of the samples to read.

    Attributes:
        ignored: Number of elements of each other class in the samples read so far, and number of
            samples with heights under the key ``THREE_D``.

    Raises:
        ValueError: If the file lacks one of the classes or, while iterating, a sample has no ground
            truth.
    """

    def __init__(self, path: str | Path, classes: Sequence[str], shard: Shard = WHOLE) -> None:
        self._file = AnnotationFile(path)
        # Index: label in the file. Entry: label in ``classes``, or -1 for other classes.
        self._labels = file_labels(self._file, classes)
        self._rows = shard.part(range(len(self._file)))
        has_heights = self._file.meta.dim == 3
        # `SampleFile` counts its samples with heights under the key THREE_D. Here all samples of a
        # file have heights, or none has.
        self.ignored = Counter({THREE_D: len(self._file) if has_heights else 0})

    def __iter__(self) -> Iterator[tuple[str, MapElements, int]]:
        """Yield token, elements and row of each sample. The row is an argument of `load`."""
        names = self._file.meta.classes
        for row in self._rows:
            sample = self._file[row]
            if sample.instances is None:
                raise InputError(
                    f"{self._file.path}, sample {sample.token!r} has no ground truth: it cannot "
                    "be scored."
                )
            for instance in sample.instances:
                if self._labels[instance.label] < 0:
                    self.ignored[names[instance.label]] += 1
            yield sample.token, self._elements(sample), row

    @property
    def split_list(self) -> str:
        """Name and digest of the list of scenes that defines the splits; empty if unknown."""
        return self._file.meta.split_list

    def tokens(self) -> list[str]:
        """Return the tokens of all samples of all shards."""
        return self._file.column("token")

    def load(self, _token: str, row: int) -> MapElements:
        """Read the elements of the sample in a row. ``SampleFile.load`` needs the token, too."""
        return self._elements(self._file[row])

    def _elements(self, sample: MapSample) -> MapElements:
        """Convert the instances of a sample to elements with labels of ``classes``."""
        elements = elements_of_instances(sample.instances or [])
        return replace(elements, labels=self._labels[elements.labels])


def scenes_of(path: str | Path) -> dict[str, str]:
    """Return the scene of each sample of an annotation file, by token.

    Raises:
        ValueError: If the file is JSON, which has no scenes.
    """
    if Path(path).suffix.lower() == ".json":
        raise InputError(f"{path} knows no scenes: give the annotation file (.arrow).")
    file = AnnotationFile(path)
    return dict(zip(file.column("token"), file.column("scene"), strict=True))


def open_ground_truth(
    path: str | Path, classes: Sequence[str], shard: Shard = WHOLE
) -> AnnotatedTruth | SampleFile:
    """Open a file of ground truth.

    Args:
        path: Annotation file, or ground truth in MapTR's JSON form.
        classes: Names of the classes; elements of other classes get the label -1.
        shard: Part of the samples to read from an annotation file; JSON is read as a whole.

    Returns:
        Iterable of the token, the elements and the place in the file of each sample.

    Raises:
        ValueError: If an annotation file lacks one of the classes. JSON is checked while iterating.
    """
    if Path(path).suffix.lower() == ".json":
        return SampleFile(path, key=GROUND_TRUTH_KEY, classes=classes)
    return AnnotatedTruth(path, classes, shard)


def read_ground_truth(
    path: str | Path, classes: Sequence[str]
) -> tuple[dict[str, MapElements], Counter[str]]:
    """Read all ground truth of a file.

    Args:
        path: Annotation file, or ground truth in MapTR's JSON form.
        classes: Names of the classes; elements of other classes get the label -1.

    Returns:
        Elements of each sample by token, and the number of ignored elements of each other class,
        with the number of samples with heights under the key ``THREE_D``.
    """
    file = open_ground_truth(path, classes)
    samples = {token: elements for token, elements, _ in file}
    return samples, file.ignored


def mismatch_notes(results: Collection[str], truth: Collection[str], allowed: bool) -> list[str]:
    """Describe the samples that have no results or no ground truth.

    Args:
        results: Tokens of samples with results.
        truth: Tokens of samples with ground truth.
        allowed: Whether both sides may differ.

    Returns:
        Notes for the user; none if both sides have equal tokens.

    Raises:
        ValueError: If both sides differ and ``allowed`` is False.
    """
    notes = []
    no_results = [token for token in truth if token not in results]
    if no_results:
        verb = "has" if len(no_results) == 1 else "have"
        number = format_count(len(no_results), "sample")
        note = f"{number} {verb} no results, such as {no_results[0]!r}"
        notes.append(f"{note}: counted as without predictions" if allowed else note)
    no_truth = [token for token in results if token not in truth]
    if no_truth:
        verb = "has" if len(no_truth) == 1 else "have"
        number = format_count(len(no_truth), "result")
        note = f"{number} {verb} no ground truth, such as {no_truth[0]!r}"
        notes.append(f"{note}: left out" if allowed else note)
    if notes and not allowed:
        raise InputError(
            "; ".join(notes) + ": score the split that was predicted, or allow the mismatch "
            "(--allow-mismatch)."
        )
    return notes


def _require_leading_settings(truth: SampleFile) -> None:
    """Require that classes and range of ground truth in JSON stand before its samples.

    Args:
        truth: Ground truth, after its last sample was read.

    Raises:
        ValueError: If they stand behind the samples, where they were not known during the scoring.
    """
    settings = truth.about.keys() & {"classes", "x_range", "y_range"}
    if settings and not read_leading_meta(truth.path, GROUND_TRUTH_KEY):
        raise InputError(
            f"meta of {truth.path} ({', '.join(sorted(settings))}) stands behind the samples, so "
            f'these were read without it: write "meta" before "{GROUND_TRUTH_KEY}".'
        )


class SamplePairs:
    """Iterable of samples, each with its results and its ground truth; iterate only once.

    Few samples are in memory at a time. Where the orders of the files differ, the position of a
    sample in its file is stored, and the sample is read a second time when its partner arrives.

    Args:
        results_path: Results in MapTR's JSON form.
        truth_path: Annotation file, or ground truth in MapTR's JSON form.
        classes: Names of the classes; elements of other classes get the label -1.
        allow_mismatch: Whether samples of the files may differ. A sample without results then
            counts as without predictions, and results without ground truth are left out. If False,
            a difference raises an error after the last pair.
        shard: Part of the samples of the ground truth to evaluate.
        allow_other_split: Whether the split of the annotation file may differ from the split with
            which the model was trained and tested. If False, a difference raises an error after the
            last pair.
        gaussians: Whether to read the Gaussians of results.

    Raises:
        ValueError: If an annotation file lacks one of the classes.
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
        self._results = SampleFile(
            results_path, key=RESULTS_KEY, classes=classes, gaussians=gaussians
        )
        self._truth = open_ground_truth(truth_path, classes=classes, shard=shard)
        self._allow_mismatch = allow_mismatch
        if shard.count:
            tokens = self._truth.tokens()
            self._results.left_out = set(tokens).difference(shard.part(tokens))
            if isinstance(self._truth, SampleFile):  # `AnnotatedTruth` has the part itself
                self._truth.left_out = self._results.left_out
        self._mismatches: list[str] = []
        self._short_truths = 0  # number of ground truths of fewer than two points
        # Smallest and largest x and y of the ground truth in metres.
        self._low = np.full(2, np.inf)
        self._high = np.full(2, -np.inf)

    def __iter__(self) -> Iterator[Sample]:
        """Yield token, predictions and ground truth of each sample.

        Raises:
            FileNotFoundError: If a file does not exist.
            ValueError: If a file is malformed or the samples differ.
        """
        # Samples that were read from one file, but not yet from the other, by token. Up to CHUNK of
        # them are stored with their elements, and further ones with their places in the file.
        pending_results: dict[str, Any] = {}
        pending_truth: dict[str, Any] = {}
        for result_item, truth_item in zip_longest(self._results, self._truth):
            # An item is None after the end of its file. Otherwise, it has token, elements and
            # place.
            has_both = bool(result_item) and bool(truth_item)
            if has_both and result_item[0] == truth_item[0]:  # the tokens
                token, predictions, _ = result_item
                yield self._pair(token, predictions, truth=truth_item[1])
                continue
            if result_item:
                token, predictions, place = result_item
                if token in pending_truth:
                    elements = _load(self._truth, token, pending_truth.pop(token))
                    yield self._pair(token, predictions, truth=elements)
                else:
                    is_full = len(pending_results) >= CHUNK
                    pending_results[token] = place if is_full else predictions
            if truth_item:
                token, elements, place = truth_item
                if token in pending_results:
                    predictions = _load(self._results, token, pending_results.pop(token))
                    yield self._pair(token, predictions, truth=elements)
                else:
                    is_full = len(pending_truth) >= CHUNK
                    pending_truth[token] = place if is_full else elements
        if isinstance(self._truth, AnnotatedTruth) and not self._allow_other_split:
            # Raises an error if the results are from another split, or their model was trained on
            # another one. `about` is complete only now, after the samples have been read.
            require_results_of(self._truth.split_list, self.about, self._results.path)
        if isinstance(self._truth, SampleFile):
            _require_leading_settings(self._truth)
        self._mismatches = mismatch_notes(
            pending_results, pending_truth, allowed=self._allow_mismatch
        )
        # The samples without results that remain, unless `mismatch_notes` has raised an error.
        no_predictions = MapElements.from_polylines()
        for token, pending in pending_truth.items():
            elements = _load(self._truth, token, pending)
            yield self._pair(token, no_predictions, truth=elements)

    @property
    def about(self) -> dict[str, Any]:
        """Metadata of the result file; complete after iterating."""
        return self._results.about

    def _pair(self, token: str, predictions: MapElements, truth: MapElements) -> Sample:
        """Create a sample, and update the count of ground truths without a line and the bounds."""
        self._short_truths += int((truth.num_points < 2).sum())
        if len(truth.points):
            points = np.asarray(truth.points)[:, :2]
            self._low = np.minimum(self._low, points.min(axis=0))
            self._high = np.maximum(self._high, points.max(axis=0))
        return Sample(token, predictions, truth)

    def notes(self, counts_heights: bool, canvas: BEVGrid | None = None) -> list[Note]:
        """Return notes on ignored elements, heights, range, samples and priors, after iterating.

        Args:
            counts_heights: Whether heights (z) count in a metric; if not, a note says so.
            canvas: Canvas of a metric that draws elements.

        Returns:
            Notes for `joined_notes`.
        """
        notes = [(0, note) for note in (*self._mismatches, *self._prior_notes())]
        ignored_predictions = Counter(self._results.ignored)
        ignored_truth = Counter(self._truth.ignored)
        num_with_heights = ignored_predictions.pop(THREE_D, 0) + ignored_truth.pop(THREE_D, 0)
        if num_with_heights and not counts_heights:
            text = "some elements have 3D points: z is ignored (AP_chamfer can count it: dim 3)"
            notes.append((0, text))
        if self._results.num_short:
            text = "predictions have fewer than two points: they are left out"
            notes.append((self._results.num_short, text))
        if self._short_truths:
            text = (
                "ground truths have fewer than two points: they count, but no prediction can match "
                "them"
            )
            notes.append((self._short_truths, text))
        if canvas is not None:
            notes += [(0, note) for note in self._canvas_notes(canvas)]
        for name, number in sorted(ignored_predictions.items()):
            notes.append((number, f"predictions of class {name!r} are not scored"))
        for name, number in sorted(ignored_truth.items()):
            notes.append((number, f"ground truths of class {name!r} are not scored"))
        return notes

    def _prior_notes(self) -> list[str]:
        """Return a note if the predictions were made with a prior of their own samples."""
        priors = self.about.get(PRIORS)
        largest_count = 0
        for prior in priors if isinstance(priors, list) else []:
            count = prior.get("also_predicted") if isinstance(prior, dict) else None
            if type(count) is int:
                largest_count = max(largest_count, count)
        if not largest_count:
            return []
        return [
            f"leak: {format_count(largest_count, 'sample')} had gone into the map of earlier "
            "drives that the model read (--prior), so these figures are too good"
        ]

    def _canvas_notes(self, canvas: BEVGrid) -> list[str]:
        """Return a note if the ground truth leaves a canvas."""
        low = np.array([canvas.x_range[0], canvas.y_range[0]])
        high = np.array([canvas.x_range[1], canvas.y_range[1]])
        is_outside = (self._low < low - _CANVAS_TOLERANCE_M).any()
        is_outside |= (self._high > high + _CANVAS_TOLERANCE_M).any()
        if not is_outside:
            return []
        truth_range = _range_text(self._low, self._high)
        return [
            f"ground truth reaches {truth_range}, and the canvas of raster metrics is "
            f"{_range_text(low, high)}: they do not count parts outside (--range)"
        ]


def joined_notes(notes: Iterable[Note]) -> list[str]:
    """Return notes as texts, with the sum of the numbers of equal texts, and without repeats."""
    numbers: dict[str, int] = {}  # in the order of the first occurrence of a text
    for number, text in notes:
        numbers[text] = numbers.get(text, 0) + number
    return [f"{number} {text}" if number else text for text, number in numbers.items()]


def _range_text(low: FloatArray, high: FloatArray) -> str:
    """Text of a rectangle in metres."""
    return f"x {low[0]:.0f} to {high[0]:.0f} and y {low[1]:.0f} to {high[1]:.0f} m"


def _load(side: Any, token: str, pending: Any) -> MapElements:
    """Return the elements of a pending sample, read from its file if only its place is stored."""
    return pending if isinstance(pending, MapElements) else side.load(token, pending)


def evaluate_files(
    results_path: str | Path,
    truth_path: str | Path,
    evaluator: MapEvaluator,
    num_workers: int = 1,
    allow_mismatch: bool = False,
    allow_other_split: bool = False,
) -> Evaluation:
    """Evaluate a result file against ground truth.

    Args:
        results_path: Results in MapTR's JSON form.
        truth_path: Annotation file, or ground truth in MapTR's JSON form.
        evaluator: Evaluator of the metrics.
        num_workers: Number of processes.
        allow_mismatch: Whether samples of the files may differ. A sample without results counts as
            without predictions, and results without ground truth are left out.
        allow_other_split: Whether the split of the annotation file may differ from the split with
            which the model was trained and tested.

    Returns:
        Reports of all metrics, and notes on ignored elements, heights and samples.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is malformed, or samples or splits differ.
    """
    pairs = SamplePairs(
        results_path,
        truth_path,
        classes=evaluator.classes,
        allow_mismatch=allow_mismatch,
        allow_other_split=allow_other_split,
    )
    matches = match_samples(pairs, evaluator, num_workers=num_workers)
    reports = evaluator.reports(matches)  # iterates over the pairs, which completes the notes
    return reports, joined_notes(pairs.notes(evaluator.counts_heights, evaluator.canvas))


def match_samples(
    pairs: Iterable[Sample], evaluator: MapEvaluator, num_workers: int = 1
) -> Iterator[SampleMatches]:
    """Match samples, in their order, in one or more processes.

    Args:
        pairs: Samples with predictions and ground truth.
        evaluator: Evaluator of the metrics.
        num_workers: Number of processes.

    Yields:
        Matches of each sample, by the name of the metric.
    """
    with Progress(unit="samples") as bar:
        # `ordered_map` yields the result of each chunk, in the order of the chunks.
        for chunk_matches in ordered_map(evaluator.match_all, _chunks(pairs), num_workers):
            yield from chunk_matches
            bar.update(len(chunk_matches))


def _chunks(pairs: Iterable[Sample]) -> Iterator[list[Sample]]:
    """Yield lists of up to ``CHUNK`` consecutive samples."""
    stream = iter(pairs)
    while True:
        chunk = list(islice(stream, CHUNK))
        if not chunk:
            return
        yield chunk
