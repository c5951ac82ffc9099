"""Options and output paths of the commands that create data."""

import argparse
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from gsmap.datasets.annotations.record import CLASSES, RANGES, AnnotationMeta
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name
from gsmap.utils.parallel import default_workers
from gsmap.utils.shards import WHOLE, Shard, add_shard_options

Options = TypeVar("Options")  # a dataclass of options


@dataclass(frozen=True)
class FileOptions:
    """Options of every converter from a data set to annotation files.

    Args:
        root: Folder of the data set, which paths in annotation files are relative to.
        classes: Classes of map elements, in label order.
        x_range: Smallest and largest x of the ground truth in the annotation frame, in metres.
        y_range: Smallest and largest y of the ground truth in the annotation frame, in metres.
        max_sweeps: Number of earlier LiDAR sweeps per sample.
        out_dir: Folder of the annotation files; None for ``root``.
        tag: Suffix of the file names, such as ``_extended``; empty for none.
        workers: Number of processes.
        shard: Part of the samples to convert; ``WHOLE`` for all samples.
        command: Command line that creates the files, for messages about them.
        split_name: Name of a published split, which other authors have defined; empty for the
            official split of the data set.
        split_file: File that defines splits; None for a published split.
        allow_missing: Whether scenes of a published split may be missing.

    Raises:
        ValueError: If ``max_sweeps`` is negative.
    """

    root: Path
    _: KW_ONLY
    classes: tuple[str, ...] = CLASSES
    # Usual ranges of x and y in the LiDAR frame.
    x_range: tuple[float, float] = RANGES["lidar"][0]
    y_range: tuple[float, float] = RANGES["lidar"][1]
    max_sweeps: int = 0
    out_dir: Path | None = None
    tag: str = ""
    workers: int = 1
    shard: Shard = WHOLE
    command: str = ""
    split_name: str = ""
    split_file: Path | None = None
    allow_missing: bool = False

    def __post_init__(self) -> None:
        if self.max_sweeps < 0:
            raise InputError(f"max_sweeps must be >= 0, got {self.max_sweeps}.")

    def meta(self, dataset: str, frame: str, split: str, **more: Any) -> AnnotationMeta:
        """Create the description of a split's annotation file.

        Args:
            dataset: Name of the data set.
            frame: Annotation frame, ``lidar`` or ``ego``.
            split: Name of the split.
            **more: Further fields of ``AnnotationMeta``.

        Returns:
            The description.
        """
        return AnnotationMeta(
            dataset=dataset,
            frame=frame,
            split=split,
            classes=self.classes,
            x_range=self.x_range,
            y_range=self.y_range,
            command=self.command,
            **more,
        )

    def path_of(self, dataset: str, split: str) -> Path:
        """Path of a split's annotation file: ``gsmap_<dataset>_<split><tag>.arrow``.

        Without a tag, the file name ends in ``_<split_name>`` if a published split is selected.
        """
        split_tag = f"_{self.split_name}" if self.split_name else ""
        tag = self.tag or split_tag
        name = file_name(f"gsmap_{dataset}_{split}{tag}")
        return (self.out_dir or self.root) / f"{name}.arrow"


def fingerprint(sizes: Mapping[str, int], contents: Iterable[Path] = ()) -> str:
    """Compute a digest of the source files of an annotation file, to recognise other source files.

    Args:
        sizes: Size of each source file in bytes, by its name. The order of the files counts.
        contents: Source files whose content is part of the digest. Other files count by their sizes
            alone.

    Returns:
        16 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for name, size in sizes.items():
        digest.update(f"{name} {size}\n".encode())
    for path in contents:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def add_file_options(parser: argparse.ArgumentParser, frame: str, max_sweeps: int) -> None:
    """Add the options of every converter of a data set.

    Args:
        parser: Parser of the command, changed in place.
        frame: Annotation frame, ``lidar`` or ``ego``, whose usual range is the default.
        max_sweeps: Default number of earlier LiDAR sweeps per sample.
    """
    add = parser.add_argument
    add_range_options(parser, RANGES[frame])
    sweeps = "earlier LiDAR sweeps to list per sample (default: %(default)s)"
    add("--max-sweeps", type=int, default=max_sweeps, help=sweeps)
    add("--out-dir", type=Path, help="folder of the annotation files (default: the data root)")
    add("--tag", default="", help="suffix of the file names, such as _extended")
    add_workers_option(parser)
    add_shard_options(parser)


def add_split_options(parser: argparse.ArgumentParser, names: tuple[str, ...]) -> None:
    """Add the options that select a split; ``names`` are the published splits."""
    add = parser.add_argument
    names_help = f"a published split by place: {', '.join(names)}"
    add("--split-name", default="", choices=names, metavar="NAME", help=names_help)
    add("--split-file", type=Path, help="file with the scenes of other splits (docs/data.md)")
    missing_help = "convert a published split even if scenes of it are missing"
    add("--allow-missing", action="store_true", help=missing_help)


def add_range_options(
    parser: argparse.ArgumentParser, ranges: tuple[tuple[float, float], ...] | None
) -> None:
    """Add the options for the range of the ground truth.

    Args:
        parser: Parser of the command, changed in place.
        ranges: Default range of x, then of y, in metres. None leaves the default to the command.
    """
    for axis, name in enumerate("xy"):
        default = None if ranges is None else ranges[axis]
        usual = f"{default[0]:g} {default[1]:g}" if default else "the usual one of the data set"
        parser.add_argument(
            f"--{name}-range", type=float, nargs=2, default=default, metavar=("MIN", "MAX"),
            help=f"{name} of the ground truth in metres (default: {usual})",
        )  # fmt: skip


def add_workers_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the number of processes."""
    cores = default_workers()
    parser.add_argument("--workers", type=int, default=cores, help="processes (default: all cores)")


def add_log_options(parser: argparse.ArgumentParser, usual_rate: str) -> None:
    """Add the options that select Argoverse 2 logs and their rate.

    Without the option ``--rate``, the parsed arguments have no ``rate_hz``.

    Args:
        parser: Parser of the command, changed in place.
        usual_rate: Description of the rate that the command uses by default.
    """
    add = parser.add_argument
    add("--root", type=Path, required=True, help="folder that holds train, val and test")
    add("--split", default="val", choices=("train", "val", "test"))
    logs_help = "use only these logs, given by their ids or the first characters of them"
    add("--logs", nargs="+", default=(), metavar="LOG", help=logs_help)
    rate_help = f"samples or pictures per second, such as 2.5hz, or all (default: {usual_rate})"
    add("--rate", type=parse_rate, default=argparse.SUPPRESS, dest="rate_hz", help=rate_help)


def parse_rate(text: str) -> float | None:
    """Parse samples per second, such as ``2.5hz`` or ``2``; ``all`` (every sample) gives None.

    Raises:
        ValueError: If the text is not a rate > 0.
    """
    if text.lower() == "all":
        return None
    rate = float(text.lower().removesuffix("hz"))
    if not rate > 0:  # also refuses NaN
        raise InputError(f"rate must be > 0, got {text}.")
    return rate


def options_from(kind: type[Options], arguments: argparse.Namespace, **more: Any) -> Options:
    """Build a dataclass of options from the arguments with the names of its fields.

    Args:
        kind: The dataclass.
        arguments: Arguments of a command. Lists become tuples.
        **more: Values that override the arguments.

    Returns:
        The options; fields without an argument have their default.
    """
    values = vars(arguments) | more  # entries of `more` replace arguments
    options = {}
    for field in fields(kind):  # type: ignore[arg-type]
        if field.name in values:
            value = values[field.name]
            options[field.name] = tuple(value) if isinstance(value, list) else value
    return kind(**options)
