"""What the commands that make data share: options, and where files go."""

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

Options = TypeVar("Options")


@dataclass(frozen=True)
class FileOptions:
    """What every converter of a data set to annotation files is told.

    Paths are relative to ``root``, classes are in label order, and ``command`` is the command line,
    for messages of readers. The others are the options of ``add_file_options``.
    """

    root: Path
    _: KW_ONLY
    classes: tuple[str, ...] = CLASSES
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

    def meta(self, dataset: str, frame: str, split: str, **more: Any) -> AnnotationMeta:
        """Describe a split's annotation file; ``more`` are further fields."""
        return AnnotationMeta(
            dataset,
            frame,
            split,
            self.classes,
            self.x_range,
            self.y_range,
            command=self.command,
            **more,
        )

    def path_of(self, dataset: str, split: str) -> Path:
        """Return where a split goes: ``gsmap_<dataset>_<split><tag>.arrow``.

        Without a tag, files of a published split end in its name.
        """
        tag = self.tag or (f"_{self.split_name}" if self.split_name else "")
        name = file_name(f"gsmap_{dataset}_{split}{tag}")
        return (self.out_dir or self.root) / f"{name}.arrow"


def fingerprint(sizes: Mapping[str, int], contents: Iterable[Path] = ()) -> str:
    """Return a digest of what a file is made from: names with their sizes, and whole files."""
    digest = hashlib.sha256("".join(f"{name} {size}\n" for name, size in sizes.items()).encode())
    for path in contents:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def add_file_options(parser: argparse.ArgumentParser, frame: str, max_sweeps: int) -> None:
    """Add what every converter of a data set asks.

    Args:
        parser: Gets the options.
        frame: Annotation frame, whose usual range is the default.
        max_sweeps: Default of the number of earlier LiDAR sweeps per sample.
    """
    add = parser.add_argument
    add_range_options(parser, RANGES[frame])
    sweeps = "earlier LiDAR sweeps to list per sample (default: %(default)s)"
    add("--max-sweeps", type=int, default=max_sweeps, help=sweeps)
    add("--out-dir", type=Path, help="where the annotation files go (default: the data root)")
    add("--tag", default="", help="appended to the file names, such as _extended")
    add_workers_option(parser)
    add_shard_options(parser)


def add_split_options(parser: argparse.ArgumentParser, names: tuple[str, ...]) -> None:
    """Add which list of scenes to take; ``names`` are those of the published ones."""
    add = parser.add_argument
    text = f"a published split by place: {', '.join(names)}"
    add("--split-name", default="", choices=names, metavar="NAME", help=text)
    add("--split-file", type=Path, help="own splits as JSON (docs/data.md)")
    text = "convert a published split of which scenes are missing"
    add("--allow-missing", action="store_true", help=text)


def add_range_options(
    parser: argparse.ArgumentParser, ranges: tuple[tuple[float, float], ...] | None
) -> None:
    """Add the range of the ground truth; None leaves the default to the command."""
    for axis, name in enumerate("xy"):
        default = ranges and ranges[axis]
        usual = f"{default[0]:g} {default[1]:g}" if default else "the data set's usual"
        parser.add_argument(
            f"--{name}-range", type=float, nargs=2, default=default, metavar=("MIN", "MAX"),
            help=f"{name} of the ground truth in metres (default: {usual})",
        )  # fmt: skip


def add_workers_option(parser: argparse.ArgumentParser) -> None:
    """Add the number of processes."""
    cores = default_workers()
    parser.add_argument("--workers", type=int, default=cores, help="processes (default: all cores)")


def add_log_options(parser: argparse.ArgumentParser, usual_rate: str) -> None:
    """Add which Argoverse 2 logs to take, and how often per second; nothing given is no entry."""
    add = parser.add_argument
    add("--root", type=Path, required=True, help="folder that holds train, val and test")
    add("--split", default="val", choices=("train", "val", "test"))
    which = "only these (ids, or their first characters)"
    add("--logs", nargs="+", default=(), metavar="LOG", help=which)
    rate = f"samples or pictures per second, such as 2.5hz, or all (default: {usual_rate})"
    add("--rate", type=parse_rate, default=argparse.SUPPRESS, dest="rate_hz", help=rate)


def parse_rate(text: str) -> float | None:
    """Read samples per second, such as ``2.5hz`` or ``2``; ``all`` gives None."""
    if text.lower() == "all":
        return None
    rate = float(text.lower().removesuffix("hz"))
    if not rate > 0:
        raise InputError(f"rate must be > 0, got {text}.")
    return rate


def options_from(kind: type[Options], arguments: argparse.Namespace, **more: Any) -> Options:
    """Build a dataclass of options from the arguments that have the names of its fields.

    Lists become tuples; ``more`` are fields that come before the arguments.
    """
    given = vars(arguments) | more
    names = {field.name for field in fields(kind)} & given.keys()  # type: ignore[arg-type]
    return kind(**{n: tuple(v) if isinstance(v := given[n], list) else v for n in names})
