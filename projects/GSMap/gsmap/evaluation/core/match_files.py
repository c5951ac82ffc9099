"""Matches of a part of the samples in a file, and the figures of all parts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsmap.evaluation.core.evaluator import MapEvaluator, SampleMatches
from gsmap.evaluation.core.metric import Matches, MetricSettings, arrays_of, matches_of
from gsmap.evaluation.core.report import MetricReport
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import DAMAGED_ZIP, atomic_write
from gsmap.utils.shards import Shard, ShardFile

SHARD_KIND = "matches"
_FAULTS = KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError
_TOKENS, _LENGTHS = "/tokens", "/lengths"
Arrays = Mapping[str, npt.NDArray[Any]]


def write_matches(
    target: Path,
    shard: Shard,
    matches: Sequence[SampleMatches],
    notes: Sequence[str],
    evaluator: MapEvaluator,
    settings: MetricSettings,
    source: str,
) -> Path:
    """Write the matches of a shard, and its manifest.

    Args:
        target: File for the figures of all shards.
        shard: Which shard.
        matches: Its matches, one a sample.
        notes: What to say besides.
        evaluator: The metrics, as `MapEvaluator.named` makes them of the settings.
        settings: Their settings.
        source: Digest of results and ground truth.

    Returns:
        The shard's file.
    """
    arrays = {"notes": np.array(notes, str)}
    for metric in matches[0] if matches else ():
        arrays |= _joined(metric, [sample[metric] for sample in matches])
    with atomic_write(shard.path_of(target), "wb") as file:
        np.savez_compressed(file, **arrays)
    rules = {
        "metrics": [metric.name for metric in evaluator.metrics],
        "settings": asdict(settings),
        "ground_truth_points": evaluator.ground_truth_points,
    }
    shard.seal(target, SHARD_KIND, source, {"evaluator": rules}, len(matches))
    return shard.path_of(target)


def _joined(metric: str, records: Sequence[Matches]) -> dict[str, npt.NDArray[Any]]:
    """Join the arrays of all samples along their first axes."""
    found = {f"{metric}{_TOKENS}": np.array([record.token for record in records])}
    parts = [arrays_of(record) for record in records]
    for name in parts[0]:
        values = [np.atleast_1d(part[name]) for part in parts]
        found[f"{metric}/{name}"] = np.concatenate(values)
        found[f"{metric}/{name}{_LENGTHS}"] = np.array([len(value) for value in values])
    return found


def report_shards(shards: Sequence[ShardFile]) -> tuple[list[MetricReport], list[str]]:
    """Compute the metrics from all shards: the figures are those of a run without shards.

    Args:
        shards: From ``find_shards``.

    Returns:
        A report per metric, and what the shards have to say, once each.

    Raises:
        ValueError: If a manifest tells no rules, or a shard's matches do not fit them.
    """
    try:
        evaluator = _evaluator(shards[0].manifest["options"]["evaluator"])
    except _FAULTS as error:
        raise InputError(
            f"the manifest of {shards[0].path} tells no rules of metrics ({error!r}): make that "
            "shard again."
        ) from error
    matches: list[SampleMatches] = []
    notes: list[str] = []
    for shard in shards:
        try:
            with np.load(shard.path) as file:
                notes += file["notes"].tolist()
                found = {name: file[name] for name in file.files}
            matches += _samples(found, evaluator) if len(found) > 1 else ()
        except (*_FAULTS, *DAMAGED_ZIP) as error:
            raise InputError(
                f"{shard.path} holds no matches by the rules of its manifest ({error!r}): make "
                "that shard again."
            ) from error
    return evaluator.reports(matches), list(dict.fromkeys(notes))


def _samples(arrays: Arrays, evaluator: MapEvaluator) -> list[SampleMatches]:
    """Cut the arrays of all metrics into samples."""
    metrics = {name.removesuffix(_TOKENS) for name in arrays if name.endswith(_TOKENS)}
    empty = evaluator.match_empty()
    if metrics != empty.keys():
        raise InputError(f"it has matches of {sorted(metrics)}, not of {sorted(empty)}")
    columns = [_records(arrays, metric, like) for metric, like in empty.items()]
    return [dict(zip(empty, of_sample, strict=True)) for of_sample in zip(*columns, strict=True)]


def _records(arrays: Arrays, metric: str, like: Matches) -> Iterator[Matches]:
    """Cut the arrays of one metric into samples."""
    tokens = arrays[f"{metric}{_TOKENS}"].tolist()
    columns = {}
    for name in arrays_of(like):
        ends = np.cumsum(arrays[f"{metric}/{name}{_LENGTHS}"])
        values = arrays[f"{metric}/{name}"]
        if len(ends) != len(tokens) or ends[-1] != len(values):
            raise InputError(f"{metric}/{name} has {len(values)} rows, its samples have {ends}")
        columns[name] = np.split(values, ends[:-1])
    for number, token in enumerate(tokens):
        own = {name: values[number] for name, values in columns.items()}
        yield matches_of(str(token), own, like)


def _evaluator(options: Mapping[str, Any]) -> MapEvaluator:
    """Make the evaluator whose rules a manifest tells."""
    values = options["settings"]
    lists = {key: tuple(value) for key, value in values.items() if isinstance(value, list)}
    canvas = {"grid": BEVGrid(**values["grid"])} if values.get("grid") else {}
    settings = MetricSettings(**{**values, **lists, **canvas})
    points = options["ground_truth_points"]
    return MapEvaluator.named(options["metrics"], settings, ground_truth_points=points)
