"""Matches of a part of the samples in a file, and the figures of all parts."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator, SampleMatches
from gsmap.evaluation.core.matches import FrameMatches
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.evaluation.core.report import MetricReport
from gsmap.evaluation.core.sample_ap import SampleAPConfig
from gsmap.structures.grid import BEVGrid
from gsmap.utils.files import DAMAGED_ZIP, atomic_write
from gsmap.utils.shards import Shard, ShardFile

SHARD_KIND = "matches"
_FAULTS = KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError
_FIELDS = [field.name for field in fields(FrameMatches) if field.name != "token"]


def write_matches(
    target: Path,
    shard: Shard,
    matches: Sequence[SampleMatches],
    notes: Sequence[str],
    evaluator: MapEvaluator,
    source: str,
) -> Path:
    """Write the matches of a shard, and its manifest.

    Args:
        target: File for the figures of all shards.
        shard: Which shard.
        matches: Its matches, one a sample.
        notes: What to say besides.
        evaluator: Metrics and their rules.
        source: Digest of results and ground truth.

    Returns:
        The shard's file.
    """
    arrays = {"notes": np.array(notes, str)}
    for metric in matches[0] if matches else ():
        records = [sample[metric] for sample in matches]
        arrays[f"{metric}/token"] = np.array([record.token for record in records])
        arrays[f"{metric}/length"] = np.array([len(record.labels) for record in records])
        for name in _FIELDS:
            values = [getattr(record, name) for record in records]
            if values[0] is not None:
                arrays[f"{metric}/{name}"] = np.concatenate(values)
    with atomic_write(shard.path_of(target), "wb") as file:
        np.savez_compressed(file, **arrays)
    shard.seal(target, SHARD_KIND, source, {"evaluator": asdict(evaluator)}, len(matches))
    return shard.path_of(target)


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
        raise ValueError(
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
            metrics = [name.split("/")[0] for name in found if name.endswith("/token")]
            by_metric = zip(*(_records(found, metric) for metric in metrics), strict=True)
            records = [dict(zip(metrics, of_sample, strict=True)) for of_sample in by_metric]
            for of_sample in records[:1]:
                evaluator.require_fitting(of_sample)
        except (*_FAULTS, *DAMAGED_ZIP) as error:
            raise ValueError(
                f"{shard.path} holds no matches by the rules of its manifest ({error!r}): make "
                "that shard again."
            ) from error
        matches += records
    return evaluator.reports(matches), list(dict.fromkeys(notes))


def _records(arrays: dict[str, Any], metric: str) -> Iterator[FrameMatches]:
    """Cut the arrays of one metric into samples."""
    tokens, ends = arrays[f"{metric}/token"], np.cumsum(arrays[f"{metric}/length"])[:-1]
    columns = {}
    for name in _FIELDS:
        values = arrays.get(f"{metric}/{name}")
        per_class = name in ("num_gts", "class_iou")
        cuts = len(tokens) if per_class else ends
        columns[name] = [None] * len(tokens) if values is None else np.split(values, cuts)
    for token, *values in zip(tokens.tolist(), *columns.values(), strict=True):
        yield FrameMatches(token, **dict(zip(_FIELDS, values, strict=True)))


def _evaluator(options: dict[str, Any]) -> MapEvaluator:
    """Make the evaluator whose rules a manifest tells."""

    def rules(kind: Any, values: Any) -> Any:
        if values is None:
            return None
        lists = {key: tuple(v) for key, v in values.items() if isinstance(v, list)}
        for key in {"classes", "polygon_classes"} & values.keys():
            if not all(isinstance(name, str) for name in lists[key]):
                raise TypeError(f"{key} must be names")
        canvas = {"grid": BEVGrid(**values["grid"])} if "grid" in values else {}
        return kind(**(values | lists | canvas))

    shrunk = options["shrunk"]
    return MapEvaluator(
        rules(ChamferConfig, options["chamfer"]),
        rules(RasterConfig, options["raster"]),
        options["ground_truth_points"],
        options["hard"],
        options["two_sided"],
        tuple(rules(SampleAPConfig, values) for values in options["drawn"]),
        shrunk and BEVGrid(**shrunk),
    )
