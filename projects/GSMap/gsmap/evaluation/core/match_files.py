"""Files with the matches of one shard (a part of the samples), and evaluation of all shards.

A file is an npz archive with the arrays ``notes`` and ``note_numbers``, and for each metric the
tokens of the samples as ``<metric>/tokens``. The arrays of all samples are concatenated to
``<metric>/<name>``, and the length of each sample's part is in ``<metric>/<name>/lengths``. The
manifest beside the file has the rules of the evaluation: names and settings of the metrics, and
resampling of the ground truth.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsmap.evaluation.core.evaluator import MapEvaluator, SampleMatches
from gsmap.evaluation.core.file_evaluation import Note, joined_notes
from gsmap.evaluation.core.metric import Matches, MetricSettings, arrays_of, matches_of
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import DAMAGED_ZIP, atomic_write
from gsmap.utils.shards import Shard, ShardFile

SHARD_KIND = "matches"
# Errors of code that reads a manifest or arrays of another form than expected.
_FAULTS = (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError)
# Endings of the names of arrays.
_TOKENS = "/tokens"
_LENGTHS = "/lengths"
Arrays = Mapping[str, npt.NDArray[Any]]


def require_own_matches(target: Path, shard: Shard) -> None:
    """Require that the file of a shard replaces no other program's file.

    Args:
        target: File for the figures of all shards; it determines the path of the shard.
        shard: Index of the shard, and number of shards.

    Raises:
        ValueError: If another program's file has the name of the shard or of its manifest.
    """
    # A file of matches is recognised by the name of its first array, which is near the start.
    shard.require_own(target, mark=b"notes.npy")


def write_matches(
    target: Path,
    shard: Shard,
    matches: Sequence[SampleMatches],
    notes: Sequence[Note],
    evaluator: MapEvaluator,
    settings: MetricSettings,
    source: str,
) -> Path:
    """Write the matches of a shard and its manifest.

    Args:
        target: File for the figures of all shards; it determines the path of the shard.
        shard: Index of the shard, and number of shards.
        matches: For each sample of the shard, the record of each metric by the metric's name.
        notes: Notes for the user, as `SamplePairs.notes` returns them.
        evaluator: Evaluator, as `MapEvaluator.from_names` creates it from ``settings``.
        settings: Settings of the metrics.
        source: Digest of results and ground truth, by which the shards of one evaluation are
            recognised.

    Returns:
        Path of the file of the shard.
    """
    note_texts = []
    note_numbers = []
    for number, text in notes:
        note_numbers.append(number)
        note_texts.append(text)
    arrays: dict[str, npt.NDArray[Any]] = {
        "notes": np.array(note_texts, dtype=str),
        "note_numbers": np.array(note_numbers, dtype=np.int64),
    }
    for metric in evaluator.metrics:
        records = [sample[metric.name] for sample in matches]
        if records:  # a shard without samples has only the notes
            arrays |= _join_records(metric.name, records=records)
    with atomic_write(shard.path_of(target), mode="wb") as file:
        np.savez_compressed(file, **arrays)
    rules = {
        "metrics": [metric.name for metric in evaluator.metrics],
        "settings": asdict(settings),
        "ground_truth_points": evaluator.ground_truth_points,
    }
    options = {"evaluator": rules}
    shard.write_manifest(
        target, kind=SHARD_KIND, source=source, options=options, samples=len(matches)
    )
    return shard.path_of(target)


def _join_records(metric: str, records: Sequence[Matches]) -> dict[str, npt.NDArray[Any]]:
    """Concatenate the arrays of all samples along the first axis, and add their lengths."""
    tokens = []
    columns: dict[str, list[npt.NDArray[Any]]] = {}  # by name: an array for each sample
    for record in records:
        tokens.append(record.token)
        for name, values in arrays_of(record).items():
            columns.setdefault(name, []).append(values)
    joined: dict[str, npt.NDArray[Any]] = {f"{metric}{_TOKENS}": np.array(tokens)}
    for name, parts in columns.items():
        joined[f"{metric}/{name}"] = np.concatenate(parts)
        joined[f"{metric}/{name}{_LENGTHS}"] = np.array(list(map(len, parts)))
    return joined


def report_shards(shards: Sequence[ShardFile]) -> tuple[list[MetricReport], list[str]]:
    """Compute the metrics from all shards, with figures equal to a run without shards.

    Args:
        shards: Finished shards, at least one, as ``find_shards`` returns them. All have equal
            rules, so the manifest of the first one is enough.

    Returns:
        Reports of all metrics, and the notes of all shards. Numbers of elements are added up, and
        notes on samples and on the range are those of each shard.

    Raises:
        ValueError: If a manifest contains no rules, or the matches of a shard do not fit the rules.
    """
    try:
        evaluator = _evaluator(shards[0].manifest["options"]["evaluator"])
    except _FAULTS as error:
        raise InputError(
            f"the manifest of {shards[0].path} contains no rules of metrics ({error!r}): "
            "create this shard again."
        ) from error
    matches: list[SampleMatches] = []
    notes: list[Note] = []
    for shard in shards:
        try:
            with np.load(shard.path) as file:
                arrays = dict(file)  # reads all arrays before the file is closed
            texts = arrays.pop("notes").tolist()
            # Shards of earlier versions have the numbers in the texts.
            numbers = arrays.pop("note_numbers", np.zeros(len(texts), dtype=np.int64))
            notes += zip(numbers.tolist(), texts, strict=True)
            if arrays:  # the shard has samples
                matches += _split_samples(arrays, evaluator)
        except (*_FAULTS, *DAMAGED_ZIP) as error:
            raise InputError(
                f"the matches in {shard.path} do not fit the rules of its manifest ({error!r}): "
                "make that shard again."
            ) from error
    return evaluator.reports(matches), joined_notes(notes)


def _split_samples(arrays: Arrays, evaluator: MapEvaluator) -> list[SampleMatches]:
    """Split the arrays of all metrics into records of samples."""
    stored_metrics = set()
    for name in arrays:
        if name.endswith(_TOKENS):
            stored_metrics.add(name.removesuffix(_TOKENS))
    # Record of a sample without elements, by metric: it has the names and shapes of the arrays.
    empty = evaluator.match_empty()
    if stored_metrics != empty.keys():
        raise InputError(f"it has matches of {sorted(stored_metrics)}, not of {sorted(empty)}")
    records_of_metrics = []
    for metric, like in empty.items():
        records_of_metrics.append(_split_records(arrays, metric=metric, like=like))
    samples = []
    # An error is raised if the metrics have different numbers of samples.
    for records in zip(*records_of_metrics, strict=True):
        samples.append(dict(zip(empty, records, strict=True)))
    return samples


def _split_records(arrays: Arrays, metric: str, like: Matches) -> Iterator[Matches]:
    """Split the arrays of one metric into records of samples.

    Args:
        arrays: Arrays of the file, by name.
        metric: Name of the metric.
        like: Record of an empty sample of the metric.

    Raises:
        ValueError: If lengths, names or shapes do not fit.
    """
    tokens = arrays[f"{metric}{_TOKENS}"].tolist()
    columns = {}  # by name: an array for each sample
    for name in arrays_of(like):
        ends = np.cumsum(arrays[f"{metric}/{name}{_LENGTHS}"])
        values = arrays[f"{metric}/{name}"]
        if len(ends) != len(tokens) or ends[-1] != len(values):
            raise InputError(f"{metric}/{name} has {len(values)} rows, its samples have {ends}")
        columns[name] = np.split(values, ends[:-1])
    for number, token in enumerate(tokens):
        sample_arrays = {}
        for name, parts in columns.items():
            sample_arrays[name] = parts[number]
        yield matches_of(str(token), arrays=sample_arrays, like=like)


def _evaluator(options: Mapping[str, Any]) -> MapEvaluator:
    """Create an evaluator from the rules of a manifest."""
    values = dict(options["settings"])
    for key, value in values.items():
        if isinstance(value, list):  # JSON has no tuples
            values[key] = tuple(value)
    if values.get("grid"):  # a dictionary of its fields in JSON
        values["grid"] = BEVGrid(**values["grid"])
    settings = MetricSettings(**values)
    points = options["ground_truth_points"]
    return MapEvaluator.from_names(options["metrics"], settings, ground_truth_points=points)
