"""Annotation files as JSON, in MapTR's form: ground truth for ``tools/evaluate.py`` and others."""

import argparse
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.words import counted

_DECIMALS = 6
_GROUND_TRUTH = "GTs"  # of a JSON file that `tools/evaluate.py` reads


def _identity(sample: MapSample, row: int | None) -> dict[str, Any]:
    """Return a sample's name, time and pose; ``row`` is its place in a pose table."""
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
        "timestamp": sample.timestamp_ns // 1000,
        "lidar2global_xy": pose[:2, 3].tolist(),
        "patch_angle_deg": float(np.degrees(np.arctan2(pose[1, 0], pose[0, 0]))),
    }


def write_vectors(annotations: Sequence[Path], target: Path) -> int:
    """Write the ground truth of one data set's annotation files as one JSON, when it is whole.

    Returns the number of samples written.

    Raises:
        ValueError: If a sample has no ground truth, or the files differ in data set, frame, classes
            or range.
    """
    files = [AnnotationFile(path) for path in annotations]
    meta = files[0].meta
    names = ("dataset", "frame", "classes", "x_range", "y_range")
    same = {name: getattr(meta, name) for name in names}
    for file in files:
        file.require(**same)
    head = {**same, "split": [file.meta.split for file in files], "versions": meta.versions}
    with atomic_write(target) as out:
        out.write(f'{{"meta": {json.dumps(head)}, "{_GROUND_TRUTH}": [')
        for number, record in enumerate(chain.from_iterable(_records(file) for file in files)):
            out.write(",\n" if number else "\n")
            json.dump(record, out)
        out.write("\n]}\n")
    return sum(len(file) for file in files)


def _records(file: AnnotationFile) -> Iterator[dict[str, Any]]:
    """Yield each sample as JSON: by log and row where the rows of the pose table are known."""
    stride = re.fullmatch(r"poses:(\d+)", str(file.meta.options.get("at")))
    position: Counter[str] = Counter()
    for sample in file:
        if sample.instances is None:
            raise InputError(f"{file.path}: sample {sample.token!r} has no ground truth to export.")
        # every N-th row was taken and none left out
        row = int(stride[1]) * position[sample.scene] if stride else None
        position[sample.scene] += 1
        vectors = [
            {
                "label": instance.label,
                "cls_name": file.meta.classes[instance.label],
                "pts": instance.points.astype(np.float64).round(_DECIMALS).tolist(),
            }
            for instance in sample.instances
        ]
        yield {**_identity(sample, row), "vectors": vectors}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py export``."""
    parser.add_argument("annotations", type=Path, nargs="+", help="annotation files (.arrow)")
    parser.add_argument("target", type=output_file, help="JSON file to write")


def run(arguments: argparse.Namespace) -> str:
    """Export as the command line asks and say how much was written."""
    count = write_vectors(arguments.annotations, arguments.target)
    return f"{counted(count, 'sample')} written to {arguments.target}"
