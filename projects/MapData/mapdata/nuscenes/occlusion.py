"""How much of each sample's map the annotated boxes hide, as groups for ``evaluate.py --by``."""

import argparse
import json
import math
from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.structures.polylines import arc_lengths, resample
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.words import counted
from mapdata.nuscenes.tables import pose_of, read_table

LIMITS = (10, 20)  # per cent of a map
_NEAR_M = 0.3  # smallest depth in an image
_STEP_M = 1.0  # between the points of a map

Array = NDArray[np.float64]


class Boxes(NamedTuple):
    """Boxes of a sample: from the global frame into each, (B, 4, 4); half of each side. (B, 3)"""

    box_from_global: Array
    halves_m: Array


def read_boxes(folder: Path, tokens: Collection[str]) -> dict[str, Boxes]:
    """Read the annotated boxes of samples, of any category.

    Args:
        folder: Folder of the tables, such as ``v1.0-trainval``.
        tokens: The samples.

    Raises:
        FileNotFoundError: If there is no ``sample_annotation.json``.
        ValueError: If it is damaged, or has no box of any of the samples.
    """
    found: dict[str, list[tuple[Array, Array]]] = {token: [] for token in tokens}
    for record in read_table(folder, "sample_annotation"):
        if (boxes := found.get(record["sample_token"])) is not None:
            width, length, height = record["size"]
            boxes.append((pose_of(record), np.array([length, width, height]) / 2))
    if not any(found.values()):
        raise InputError(f"{folder} has no box of these samples: give the tables of their data.")
    return {
        token: Boxes(
            invert_rigid(np.array([pose for pose, _ in boxes]).reshape(-1, 4, 4)),
            np.array([halves for _, halves in boxes]).reshape(-1, 3),
        )
        for token, boxes in found.items()
    }


def cuts_sight(origin: Array, points: Array, boxes: Boxes) -> NDArray[np.bool_]:
    """Say which boxes the straight line to each point passes through.

    Args:
        origin: Where one looks from, in metres in the global frame. (3,)
        points: What one looks at. (n, 3)
        boxes: B boxes.

    Returns:
        (n, B)
    """
    turns, shifts = boxes.box_from_global[:, :3, :3], boxes.box_from_global[:, :3, 3]
    start = np.einsum("bij,j->bi", turns, origin) + shifts  # (B, 3)
    way = np.einsum("bij,nj->nbi", turns, points - origin)  # (n, B, 3)
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel to a side
        sides = np.stack([(half - start) / way for half in (-boxes.halves_m, boxes.halves_m)])
    enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
    return (enter <= leave) & (leave > 0) & (enter < 1)


def _map_points(sample: MapSample) -> Array:
    """Return the points of a sample's map, every metre, on the ground if it is flat. (n, 3)

    ValueError if it has no ground truth.
    """
    if sample.instances is None:
        raise InputError(f"sample {sample.token!r} has no ground truth, of which parts could hide.")
    height_m = 0.0 if sample.ego_from_frame is None else sample.ego_from_frame[2, 3]
    lines = [
        resample(i.points, max(math.ceil(arc_lengths(i.points)[-1] / _STEP_M), 1) + 1)
        for i in sample.instances
    ]
    flat = [np.column_stack([line, np.full(len(line), -height_m)])[:, :3] for line in lines]
    return np.concatenate([np.empty((0, 3)), *flat])


def _in_image(points: Array, camera: CameraRecord) -> NDArray[np.bool_]:
    """Say which points (n, 3) of the annotation frame lie in a camera's image. (n,)"""
    u, v, w = (points @ camera.img_from_frame[:3, :3].T + camera.img_from_frame[:3, 3]).T
    inside = (u >= 0) & (u < w * camera.width) & (v >= 0) & (v < w * camera.height)
    return inside & (w > _NEAR_M)


def hidden_share(sample: MapSample, boxes: Boxes) -> float:
    """Return the share of a map that is in an image, but behind boxes for each such camera.

    Args:
        sample: With its cameras and map; heights are those of its points, or level ground.
        boxes: The boxes around it.

    Returns:
        In [0, 1]; 0 if no image holds any of the map.
    """
    points = _map_points(sample)
    in_global = points @ sample.global_from_frame[:3, :3].T + sample.global_from_frame[:3, 3]
    held, seen = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for camera in sample.cameras:
        inside = np.flatnonzero(_in_image(points, camera))
        origin = (sample.global_from_frame @ invert_rigid(camera.cam_from_frame))[:3, 3]
        held[inside] = True
        seen[inside] |= ~cuts_sight(origin, in_global[inside], boxes).any(axis=1)
    return float((held & ~seen).sum() / max(held.sum(), 1))


def word_for(share: float, limits: Sequence[int] = LIMITS) -> str:
    """Return the group of a share: ``00-10 % hidden`` for the first limit of 10 and so on."""
    edges = (0, *limits, 100)
    low, high = next(pair for pair in pairwise(edges) if 100 * share < pair[1] or pair[1] == 100)
    return f"{low:02d}-{high:02d} % hidden"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py occlusion``."""
    parser.add_argument("annotations", type=Path, help="annotation file (.arrow)")
    parser.add_argument("tables", type=Path, help="folder of nuScenes' tables (v1.0-trainval)")
    parser.add_argument("target", type=output_file, help="JSON file to write")
    parser.add_argument(
        "--limits",
        type=int,
        nargs="+",
        default=list(LIMITS),
        help="per cent of a map at which a new group begins (10 20)",
    )


def run(arguments: argparse.Namespace) -> str:
    """Write the group of each sample, and say how large the groups are.

    Raises:
        ValueError: If the limits do not rise, or the file has no ground truth.
    """
    limits = arguments.limits
    if any(low >= high for low, high in pairwise((0, *limits, 100))):
        raise InputError(f"--limits must rise between 0 and 100, got {limits}.")
    file = AnnotationFile(arguments.annotations)
    boxes = read_boxes(arguments.tables, file.column("token"))
    groups = {s.token: word_for(hidden_share(s, boxes[s.token]), limits) for s in file}
    write_text(arguments.target, json.dumps(groups, indent=0) + "\n")
    sizes = sorted((word, list(groups.values()).count(word)) for word in {*groups.values()})
    said = ", ".join(f"{word}: {counted(number, 'sample')}" for word, number in sizes)
    return f"{said}. Written to {arguments.target}"
