"""Check annotation files completely: their own content, and the files that they name."""

import argparse
from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path

import pyarrow as pa

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import read_image
from gsmap.datasets.plausibility import calibration_warnings
from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_of_the_machine
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.words import counted
from mapdata.command_line import add_workers_option

_SHOWN = 10


def _open(path: Path) -> AnnotationFile:
    """Open an annotation file, which checks it, and compare what its footer leads to."""
    file = AnnotationFile(path)
    try:
        reader = pa.ipc.open_file(pa.memory_map(str(path)))
        for number, batch in enumerate(file.batches):
            if not reader.get_batch(number).equals(batch):
                raise InputError(f"part {number} is another one")
    except (pa.ArrowException, OSError, ValueError) as error:
        if is_of_the_machine(error):
            raise
        raise InputError(
            f"{path}: the footer, by which other programs read the file, is damaged ({error}); "
            f"{file.remedy}"
        ) from error
    return file


def _broken_files(sample: MapSample, root: Path) -> list[str]:
    """Read every file that a sample names, and return what is wrong with them."""
    from gsmap.datasets.transforms.points import read_points

    where, problems = f"sample {sample.token!r}", []
    reads = [
        partial(read_image, str(root / c.path), f"{where}, camera {c.name}", (c.width, c.height))
        for c in sample.cameras
    ]
    lidar = sample.lidar
    paths = [lidar.path, *(sweep.path for sweep in lidar.sweeps)] if lidar else []
    reads += [partial(read_points, str(root / path), 5) for path in paths]
    for read in reads:
        try:
            read()
        except BrokenSampleError as error:
            problems.append(str(error))
    return problems


def _doubts(file: AnnotationFile) -> list[str]:
    """Count the elements, and say what is implausible about them and the cameras."""
    counts, meta = file.instance_counts(), file.meta
    known = counts[counts >= 0]
    lines = []
    if len(known):
        lines.append(
            f"{counted(int(known.sum()), 'map element')}, up to {known.max()} in a sample (a model "
            "needs at least as many queries)"
        )
        if empty := int((known == 0).sum()):
            lines.append(
                f"warning: {empty} of {counted(len(known), 'sample')} have no element in the range:"
                " are points in metres of the frame, not of the world?"
            )
    doubts = calibration_warnings(file, meta.frame, meta.ground_z_m)
    return lines + [f"warning: calibration: {line}" for line in doubts]


def check_files(paths: Sequence[Path], root: Path | None, workers: int) -> str:
    """Check annotation files and, with a data root, the images and sweeps that they name.

    Returns what was found to be right.

    Raises:
        FileNotFoundError: If an annotation file does not exist.
        ValueError: If something is wrong; the message names the first few files.
    """
    lines = []
    for path in paths:
        file = _open(path)
        mark = "checksum right" if file.sealed else "no checksum, as it is of an earlier version"
        lines += [f"{path}: {line}" for line in _doubts(file)]
        lines.append(f"{path}: {counted(len(file), 'sample')}, values right, {mark}")
        if root is not None:
            samples = Progress(file, desc=path.name, unit="samples")
            found = ordered_map(partial(_broken_files, root=root), samples, workers)
            if problems := list(chain.from_iterable(found)):
                more = f", and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
                shown = "; ".join(problems[:_SHOWN])
                raise InputError(f"{path} is right, but: {shown}{more}")
            lines[-1] += ", images and LiDAR files whole"
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py check``."""
    parser.add_argument("annotations", type=Path, nargs="+", help="annotation files (.arrow)")
    root = "read every image and LiDAR file below this folder too"
    parser.add_argument("--data-root", type=Path, help=root)
    add_workers_option(parser)


def run(arguments: argparse.Namespace) -> str:
    """Check as the command line asks and say what is right."""
    return check_files(arguments.annotations, arguments.data_root, arguments.workers)
