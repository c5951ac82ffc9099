"""Complete check of annotation files, and of the images and LiDAR sweeps that they name."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pyarrow as pa

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import read_image
from gsmap.datasets.plausibility import calibration_warnings
from gsmap.datasets.pose_plausibility import pose_warnings
from gsmap.datasets.scene_places import place_warnings
from gsmap.utils.cli import EachOnce
from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_machine_error
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.words import format_count
from mapdata.command_line import add_workers_option

_MOST_PROBLEMS = 10  # largest number of broken files that a message names


def _open(path: Path) -> AnnotationFile:
    """Open and check an annotation file, and compare its batches with the batches in its footer.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged.
    """
    file = AnnotationFile(path)
    try:
        # `file` finds its batches without the footer. Other programs find them by the footer.
        reader = pa.ipc.open_file(pa.memory_map(str(path)))
        for number, batch in enumerate(file.batches):
            if not reader.get_batch(number).equals(batch):
                raise InputError(f"part {number} that it lists is not the one in the file")
    except (pa.ArrowException, OSError, ValueError) as error:
        if is_machine_error(error):
            raise
        raise InputError(
            f"{path}: the footer, by which other programs read the file, is damaged ({error}); "
            f"{file.remedy}"
        ) from error
    return file


def _broken_files(sample: MapSample, root: Path) -> list[str]:
    """Read every file that a sample names, and return a description of each broken file."""
    # Imported here, because the module imports slow libraries that other checks do not need.
    from gsmap.datasets.transforms.points import read_points

    problems = []
    for camera in sample.cameras:
        where = f"sample {sample.token!r}, camera {camera.name}"
        try:
            read_image(str(root / camera.path), where, size=(camera.width, camera.height))
        except BrokenSampleError as error:
            problems.append(str(error))
    lidar_paths = []
    if sample.lidar:
        lidar_paths.append(sample.lidar.path)
        lidar_paths += [sweep.path for sweep in sample.lidar.sweeps]
    # Values of a point in nuScenes: x, y, z, intensity and number of the laser.
    for path in lidar_paths:
        try:
            read_points(str(root / path), load_dim=5)
        except BrokenSampleError as error:
            problems.append(str(error))
    return problems


def _describe_content(file: AnnotationFile) -> list[str]:
    """Count the elements, and warn of implausible elements, cameras, poses and places."""
    counts = file.instance_counts()
    counts = counts[counts >= 0]  # a sample whose ground truth is not known has -1
    lines = []
    if len(counts):
        elements = format_count(int(counts.sum()), "map element")
        lines.append(
            f"{elements}, up to {counts.max()} in a sample (a model needs at least as many queries)"
        )
        empty = int((counts == 0).sum())
        if empty:
            lines.append(
                f"warning: {empty} of {format_count(len(counts), 'sample')} have no element in the "
                "range: are points in metres of the frame, not of the world?"
            )
    for warning in calibration_warnings(file, file.meta.frame, file.meta.ground_z_m):
        lines.append(f"warning: calibration: {warning}")
    if file.meta.has_poses:
        for warning in pose_warnings(file, file.meta.frame):
            lines.append(f"warning: poses: {warning}")
    places = zip(file.column("scene"), file.column("map_name"), strict=True)
    for warning in place_warnings(places):
        lines.append(f"warning: places: {warning}")
    return lines


def check_files(paths: Sequence[Path], root: Path | None, workers: int) -> str:
    """Check annotation files and, with a data root, the images and sweeps that they name.

    Args:
        paths: Annotation files.
        root: Folder that paths of images and sweeps are relative to. If None, images and sweeps are
            not read.
        workers: Number of processes that read images and sweeps.

    Returns:
        Report of the checks, with warnings.

    Raises:
        FileNotFoundError: If an annotation file does not exist.
        ValueError: If a file is damaged or missing; the message names the first few files.
    """
    lines = []
    for path in paths:
        file = _open(path)
        mark = "checksum right" if file.sealed else "no checksum, as it is of an earlier version"
        lines += [f"{path}: {line}" for line in _describe_content(file)]
        lines.append(f"{path}: {format_count(len(file), 'sample')}, values right, {mark}")
        if root is not None:
            samples = Progress(file, desc=path.name, unit="samples")
            problems = []
            # The workers read the samples at once, and the results keep the order of the samples.
            for sample_problems in ordered_map(partial(_broken_files, root=root), samples, workers):
                problems += sample_problems
            if problems:
                text = "; ".join(problems[:_MOST_PROBLEMS])
                if len(problems) > _MOST_PROBLEMS:
                    text += f", and {len(problems) - _MOST_PROBLEMS} more"
                raise InputError(f"{path} itself is right, but not all files that it names: {text}")
            lines[-1] += ", images and LiDAR files whole"
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py check``."""
    parser.add_argument(
        "annotations", type=Path, nargs="+", action=EachOnce, help="annotation files (.arrow)"
    )
    root_help = "also read all images and LiDAR files, whose paths are relative to this folder"
    parser.add_argument("--data-root", type=Path, help=root_help)
    add_workers_option(parser)


def run(arguments: argparse.Namespace) -> str:
    """Run the command ``check`` and return its report."""
    return check_files(arguments.annotations, root=arguments.data_root, workers=arguments.workers)
