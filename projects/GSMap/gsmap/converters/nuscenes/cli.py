"""Command line of the nuScenes converter: ``tools/create_data.py nuscenes``."""

import argparse
from pathlib import Path

from tqdm import tqdm

from gsmap.converters.command_line import add_file_options
from gsmap.converters.nuscenes.convert import NuScenesOptions, convert_nuscenes
from gsmap.converters.nuscenes.map import MAP_CLASSES
from gsmap.datasets.annotations.record import CLASSES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the converter's options to a parser."""
    parser.add_argument(
        "--root", type=Path, required=True, help="data root with maps, samples, v1.0-..."
    )
    parser.add_argument(
        "--version", default="v1.0-trainval", help="version folder (default: %(default)s)"
    )
    parser.add_argument("--dataset", help="name in the files (default: minicity or nuscenes)")
    parser.add_argument("--split-file", type=Path, help="own splits as JSON (docs/data.md)")
    parser.add_argument(
        "--classes", nargs="+", default=list(CLASSES), choices=MAP_CLASSES, metavar="CLASS",
        help=f"classes in label order, of {', '.join(MAP_CLASSES)} (default: the first three)",
    )  # fmt: skip
    add_file_options(parser, x_range=(-15.0, 15.0), y_range=(-30.0, 30.0), max_sweeps=10)


def dataset_name(root: Path) -> str:
    """Tell MiniCity, which says so in its root, from nuScenes."""
    return "minicity" if (root / "minicity.json").is_file() else "nuscenes"


class ProgressBar:
    """A bar that appears when the work begins.

    Args:
        title: What it shows on its left.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: tqdm | None = None

    def __call__(self, kind: str, count: int) -> None:
        """Take ("samples", total) once, then ("", done) as often as needed."""
        if kind:
            self._bar = tqdm(desc=self._title, unit="sample", total=count, smoothing=0.05)
        elif self._bar is not None:
            self._bar.update(count)

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


def run(arguments: argparse.Namespace, command: str) -> str:
    """Convert as the command line asks.

    Args:
        arguments: Parsed options.
        command: The command line as typed.

    Returns:
        The summary as text.
    """
    options = NuScenesOptions(
        root=arguments.root,
        version=arguments.version,
        out_dir=arguments.out_dir,
        dataset=arguments.dataset or dataset_name(arguments.root),
        split_file=arguments.split_file,
        classes=tuple(arguments.classes),
        x_range=tuple(arguments.x_range),
        y_range=tuple(arguments.y_range),
        max_sweeps=arguments.max_sweeps,
        workers=arguments.workers,
        tag=arguments.tag,
        command=command,
    )
    with ProgressBar(f"{options.dataset} {options.version}") as progress:
        summary = convert_nuscenes(options, progress)
    return summary.text()
