"""Groups of samples by the share of the map that boxes hide, for ``evaluate.py --by``."""

import argparse
import json
import math
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, MapSample
from gsmap.structures.frames import FrameView, frame_view
from gsmap.structures.polylines import arc_lengths, resample
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.words import format_count
from mapdata.nuscenes.tables import pose_of, read_table

LIMITS = (10, 20)  # limits between the groups, hidden share of the map in per cent
_NEAR_M = 0.3  # smallest depth of a visible point
_STEP_M = 1.0  # distance between the sampled points of a map

Array = NDArray[np.float64]


class Boxes(NamedTuple):
    """B annotated boxes of a sample.

    Args:
        box_from_global: Transforms from the global frame to the boxes in metres. (B, 4, 4)
        halves_m: Half the length, width and height of the boxes in metres. (B, 3)
    """

    box_from_global: Array
    halves_m: Array


def read_boxes(folder: Path, tokens: Collection[str]) -> dict[str, Boxes]:
    """Read the annotated boxes of samples, of all categories.

    Args:
        folder: Folder of the tables, such as ``v1.0-trainval``.
        tokens: Tokens of the samples.

    Returns:
        Boxes by token of the sample.

    Raises:
        FileNotFoundError: If the folder has no ``sample_annotation.json``.
        ValueError: If the table is damaged, or has no box of any of the samples.
    """
    poses: dict[str, list[Array]] = {token: [] for token in tokens}
    halves_m: dict[str, list[Array]] = {token: [] for token in poses}
    for record in read_table(folder, "sample_annotation"):
        token = record["sample_token"]
        if token in poses:
            width, length, height = record["size"]  # metres; the x axis is along the length
            poses[token].append(pose_of(record))  # global_from_box (4, 4)
            halves_m[token].append(np.array([length, width, height]) / 2)
    if not any(poses.values()):
        raise InputError(
            f"{folder} has no box of these samples: give the tables from which the annotation file "
            "was made."
        )
    boxes = {}
    for token in poses:
        # The shapes are given for samples without boxes.
        global_from_box = np.array(poses[token]).reshape(-1, 4, 4)
        halves = np.array(halves_m[token]).reshape(-1, 3)
        boxes[token] = Boxes(invert_rigid(global_from_box), halves)
    return boxes


def cuts_sight(origin: Array, points: Array, boxes: Boxes) -> NDArray[np.bool_]:
    """Compute which boxes intersect the line of sight to each point.

    Each line of sight is clipped to the three slabs of a box (slab method).

    Args:
        origin: Position of the camera in metres, global frame. (3,)
        points: Observed points in metres, global frame. (n, 3)
        boxes: B boxes.

    Returns:
        True where the segment from the origin to a point intersects a box. (n, B)
    """
    rotations = boxes.box_from_global[:, :3, :3]
    translations = boxes.box_from_global[:, :3, 3]
    # The camera, and the vectors from the camera to the points, in the frame of each box.
    start = np.einsum("bij,j->bi", rotations, origin) + translations  # (B, 3)
    direction = np.einsum("bij,nj->nbi", rotations, points - origin)  # (n, B, 3)
    # The direction of a line parallel to a slab has a component of 0. The quotients are infinite,
    # or NaN for a line in a side of the box. Comparisons with NaN are false: no hit.
    with np.errstate(divide="ignore", invalid="ignore"):
        to_lower = (-boxes.halves_m - start) / direction  # (n, B, 3)
        to_upper = (boxes.halves_m - start) / direction  # (n, B, 3)
    crossings = np.stack([to_lower, to_upper])  # fractions of the segment. (2, n, B, 3)
    # A line is inside of the box where it is inside of all three slabs.
    enter = crossings.min(axis=0).max(axis=-1)  # (n, B)
    leave = crossings.max(axis=0).min(axis=-1)  # (n, B)
    is_line_in_box = enter <= leave
    is_between_ends = (leave > 0) & (enter < 1)
    return is_line_in_box & is_between_ends


def ground_view(meta: AnnotationMeta) -> FrameView:
    """Create the view of an annotation file, with the ground of vehicles in nuScenes tables.

    The origin of these vehicles' frame is on the road, so the ground is at z = 0 of this frame.

    Args:
        meta: Metadata of the annotation file.
    """
    ground_z_m = meta.ground_z_m
    if ground_z_m is None and meta.frame == "ego":  # a file of an earlier version
        ground_z_m = 0.0
    return frame_view(meta.frame, ground_z_m)


def _map_points(sample: MapSample, view: FrameView) -> Array:
    """Points along the map elements of a sample, about a metre apart, in its frame. (n, 3)

    Elements without heights are placed on the ground. A tilt of the sensor is respected.

    Raises:
        ValueError: If the sample has no ground truth.
    """
    if sample.instances is None:
        raise InputError(
            f"sample {sample.token!r} has no ground truth: give a file with map elements."
        )
    mounted_view = view.with_mounting(sample.ego_from_frame)
    elements = [np.empty((0, 3))]
    for instance in sample.instances:
        length_m = arc_lengths(instance.points)[-1]
        num_steps = max(math.ceil(length_m / _STEP_M), 1)
        points = resample(instance.points, num_steps + 1)
        elements.append(mounted_view.lift(points))  # points with heights keep them
    return np.concatenate(elements)


def _in_image(points: Array, camera: CameraRecord) -> NDArray[np.bool_]:
    """Mask of the points that project into a camera's image. (n,)

    Args:
        points: Points in metres, annotation frame. (n, 3)
        camera: Camera record.
    """
    projection = camera.img_from_frame
    # `u` and `v` are pixels times depth, so no division by a depth of 0 is needed.
    u, v, depth = (points @ projection[:3, :3].T + projection[:3, 3]).T
    inside = (u >= 0) & (u < depth * camera.width) & (v >= 0) & (v < depth * camera.height)
    return inside & (depth > _NEAR_M)


def hidden_share(sample: MapSample, boxes: Boxes, view: FrameView) -> float:
    """Compute the share of a sample's map that boxes hide.

    Only map points inside at least one image are counted. A point is hidden if, for each camera
    whose image contains the point, a box intersects the line of sight from the camera to the point.

    Args:
        sample: Sample with cameras and ground truth. Elements without heights are placed on the
            ground.
        boxes: Boxes around the sample.
        view: View of the annotation frame (`ground_view`), which has the ground plane.

    Returns:
        Share in [0, 1]; 0 if no map point is inside an image.

    Raises:
        ValueError: If the sample has no ground truth.
    """
    points = _map_points(sample, view)
    global_from_frame = sample.global_from_frame
    global_points = points @ global_from_frame[:3, :3].T + global_from_frame[:3, 3]
    is_in_image = np.zeros(len(points), dtype=bool)
    is_visible = np.zeros(len(points), dtype=bool)
    for camera in sample.cameras:
        inside = np.flatnonzero(_in_image(points, camera))
        global_from_cam = global_from_frame @ invert_rigid(camera.cam_from_frame)
        origin = global_from_cam[:3, 3]
        is_in_image[inside] = True
        # Whether any box is between this camera and each point in its image.
        is_hidden = cuts_sight(origin, global_points[inside], boxes=boxes).any(axis=1)
        is_visible[inside] |= ~is_hidden
    # A point is visible if at least one camera has a free line of sight to it.
    num_hidden = (is_in_image & ~is_visible).sum()
    num_in_image = is_in_image.sum()
    return float(num_hidden / max(num_in_image, 1))


def word_for(share: float, limits: Sequence[int] = LIMITS) -> str:
    """Name the group of a hidden share, such as ``00-10 % hidden``.

    Args:
        share: Hidden share in [0, 1].
        limits: Ascending limits between the groups, per cent, between 0 and 100.
    """
    # Find the first upper limit above the share. A share of 1 belongs to the last group.
    low = 0
    for high in (*limits, 100):
        if 100 * share < high or high == 100:
            break
        low = high
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
    """Write the group of each sample to a JSON file.

    Args:
        arguments: Parsed options of `add_arguments`.

    Returns:
        Sizes of the groups as text.

    Raises:
        FileNotFoundError: If the annotation file or the table of boxes is missing.
        ValueError: If the limits do not ascend, the file has no ground truth, or the table is
            damaged or has no box of the samples.
    """
    limits = arguments.limits
    if any(low >= high for low, high in pairwise((0, *limits, 100))):
        raise InputError(f"--limits must rise between 0 and 100, got {limits}.")
    file = AnnotationFile(arguments.annotations)
    boxes = read_boxes(arguments.tables, file.column("token"))
    view = ground_view(file.meta)
    groups = {}
    for sample in file:
        share = hidden_share(sample, boxes[sample.token], view=view)
        groups[sample.token] = word_for(share, limits)
    write_text(arguments.target, json.dumps(groups, indent=0) + "\n")
    sizes = sorted(Counter(groups.values()).items())
    text = ", ".join(f"{group}: {format_count(size, 'sample')}" for group, size in sizes)
    return f"{text}. Written to {arguments.target}"
