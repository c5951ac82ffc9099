"""Pictures of samples: what they are called, and the options of the tools that draw them."""

import argparse
import re
from pathlib import Path

from matplotlib.figure import Figure

from gsmap.visualization.figure import save_figure

FORMATS = ("png", "jpg", "webp", "pdf", "svg")


def picture_name(token: str, suffix: str) -> str:
    """Return a file name made of a sample's token, without characters that a file system minds."""
    return re.sub(r"[^\w.+=-]", "_", token) + suffix


def save_picture(figure: Figure, folder: str | Path, token: str, suffix: str) -> Path:
    """Write a sample's picture.

    Args:
        figure: The picture.
        folder: Folder to write to; it is made if it does not exist.
        token: The sample's token, which gives the file its name.
        suffix: Format: a suffix that `save_figure` knows.

    Returns:
        The file's path.
    """
    return save_figure(figure, Path(folder) / picture_name(token, suffix))


def add_picture_arguments(
    parser: argparse.ArgumentParser, folder: str | None, picture_format: str
) -> None:
    """Add ``--show-dir``, ``--format`` and ``--order`` to a tool that draws samples.

    Args:
        parser: The tool's parser.
        folder: Where pictures go by default; None draws none.
        picture_format: One of `FORMATS`, the default.
    """
    default = None if folder is None else Path(folder)
    parser.add_argument("--show-dir", type=Path, default=default, help="folder for pictures")
    parser.add_argument("--format", default=picture_format, choices=FORMATS)
    parser.add_argument("--order", action="store_true", help="mark start and direction of elements")
