"""Export of annotation files to JSON in MapTR's format, which ``tools/evaluate.py`` can read."""

import argparse
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.utils.cli import EachOnce, output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.words import format_count

_DECIMALS = 6
_GROUND_TRUTH = "GTs"  # key of the samples in MapTR's format


def _identity(sample: MapSample, row: int | None) -> dict[str, Any]:
    """Name, time and pose of a sample, in the keys of Argoverse 2 or of nuScenes.

    Args:
        sample: The sample.
        row: Its row in the pose table of its log, if samples were chosen by such rows. This is the
            case in Argoverse 2 only. None for all other samples.
    """
    pose = sample.global_from_frame
    if row is not None:
        return {
            "sample_token": sample.token,
            "log": sample.scene,
            "row": row,
            "timestamp_ns": sample.timestamp_ns,
            "city_from_ego": pose.tolist(),
        }
    return {
        "sample_token": sample.token,
        "scene": sample.scene,
        "location": sample.map_name,
        "timestamp": sample.timestamp_ns // 1000,  # in microseconds, as in nuScenes
        "lidar2global_xy": pose[:2, 3].tolist(),
        "patch_angle_deg": float(np.degrees(np.arctan2(pose[1, 0], pose[0, 0]))),
    }


def write_vectors(annotations: Sequence[Path], target: Path) -> int:
    """Write the ground truth of a data set's annotation files as one JSON file.

    Args:
        annotations: Annotation files.
        target: JSON file to write. It is created only when it is complete.

    Returns:
        Number of samples.

    Raises:
        ValueError: If a sample has no ground truth, or the files differ in data set, frame, classes
            or range.
    """
    files = [AnnotationFile(path) for path in annotations]
    meta = files[0].meta
    names = ("dataset", "frame", "classes", "x_range", "y_range")
    common = {name: getattr(meta, name) for name in names}
    for file in files:
        file.require(**common)  # raises an error if a value differs
    splits = [file.meta.split for file in files]
    head = {**common, "split": splits, "versions": meta.versions}
    # The samples are written one by one, so that they never are in memory together.
    with atomic_write(target) as out:
        out.write(f'{{"meta": {json.dumps(head)}, "{_GROUND_TRUTH}": [')
        count = 0
        for file in files:
            for record in _records(file):
                out.write(",\n" if count else "\n")
                json.dump(record, out)
                count += 1
        out.write("\n]}\n")
    return count


def _records(file: AnnotationFile) -> Iterator[dict[str, Any]]:
    """Yield the samples as JSON objects, with their rows in the pose table if these are known."""
    # With the option ``at="poses:N"``, every N-th row of the pose table of a log is a sample.
    match = re.fullmatch(r"poses:(\d+)", str(file.meta.options.get("at")))
    stride = int(match[1]) if match else None
    counts: Counter[str] = Counter()  # number of previous samples of each log
    for sample in file:
        if sample.instances is None:
            raise InputError(f"{file.path}: sample {sample.token!r} has no ground truth to export.")
        row = None if stride is None else stride * counts[sample.scene]
        counts[sample.scene] += 1
        vectors = []
        for instance in sample.instances:
            points = instance.points.astype(np.float64).round(_DECIMALS)
            vector = {
                "label": instance.label,
                "cls_name": file.meta.classes[instance.label],
                "pts": points.tolist(),
            }
            vectors.append(vector)
        yield {**_identity(sample, row), "vectors": vectors}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py export``."""
    parser.add_argument(
        "annotations", type=Path, nargs="+", action=EachOnce, help="annotation files (.arrow)"
    )
    parser.add_argument("target", type=output_file, help="JSON file to write")


def run(arguments: argparse.Namespace) -> str:
    """Run the command ``export`` and return its report."""
    count = write_vectors(arguments.annotations, arguments.target)
    return f"{format_count(count, 'sample')} written to {arguments.target}"
