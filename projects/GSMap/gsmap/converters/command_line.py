"""What the commands that make data share: common options, and how they end."""

import argparse
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from gsmap.utils.parallel import default_workers


def add_file_options(
    parser: argparse.ArgumentParser,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    max_sweeps: int,
) -> None:
    """Add what every converter to annotation files asks: range, sweeps, name and folder.

    Args:
        parser: Parser to add to.
        x_range: Default smallest and largest x of the ground truth in metres.
        y_range: Default smallest and largest y of the ground truth in metres.
        max_sweeps: Default number of earlier LiDAR sweeps per sample.
    """
    for name, default in (("x", x_range), ("y", y_range)):
        parser.add_argument(
            f"--{name}-range", type=float, nargs=2, default=default, metavar=("MIN", "MAX"),
            help=f"{name} of the ground truth in metres (default: {default[0]:g} {default[1]:g})",
        )  # fmt: skip
    parser.add_argument(
        "--max-sweeps",
        type=int,
        default=max_sweeps,
        help="earlier LiDAR sweeps to list per sample (default: %(default)s)",
    )
    parser.add_argument(
        "--out-dir", type=Path, help="where the annotation files go (default: the data root)"
    )
    parser.add_argument("--tag", default="", help="appended to the file names, such as _extended")
    add_workers_option(parser)


def add_workers_option(parser: argparse.ArgumentParser) -> None:
    """Add the number of processes."""
    parser.add_argument(
        "--workers", type=int, default=default_workers(), help="processes (default: all cores)"
    )


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add which Argoverse 2 logs to take, and how often per second."""
    parser.add_argument(
        "--root", type=Path, required=True, help="folder that holds train, val and test"
    )
    parser.add_argument("--split", default="val", choices=("train", "val", "test"))
    parser.add_argument(
        "--logs", nargs="+", default=(), metavar="LOG", help="only these (ids, or how they begin)"
    )
    parser.add_argument(
        "--rate",
        type=parse_rate,
        default=2.0,
        help="samples or pictures per second, such as 2hz, or all (default: %(default)s)",
    )


def parse_rate(text: str) -> float | None:
    """Read a rate such as ``2hz``, ``2.5`` or ``all``.

    Args:
        text: What the user wrote.

    Returns:
        Samples per second, or None for all.

    Raises:
        ValueError: If it is neither a positive number nor ``all``.
    """
    if text.lower() == "all":
        return None
    rate = float(text.lower().removesuffix("hz"))
    if not rate > 0:
        raise ValueError(f"rate must be > 0, got {text}.")
    return rate


def run_command(command: Callable[[], str | None]) -> None:
    """Run a command of a tool, print what it reports, and leave in words whatever happens.

    Bad input ends with ``error: ...`` and exit code 1, Ctrl-C with one line and 130, ``kill`` with
    143; each after the clean-up of half-written files.

    Args:
        command: Returns what to print.

    Raises:
        SystemExit: If the command fails or is interrupted.
    """
    signal.signal(signal.SIGTERM, _leave)
    try:
        report = command()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: nothing half-written is left\n")
        sys.exit(128 + signal.SIGINT)
    except (OSError, ValueError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    if report is not None:
        sys.stdout.write(f"{report}\n")


def _leave(number: int, _frame: object) -> None:
    """Leave through the clean-up of half-written files, as Ctrl-C does."""
    sys.exit(128 + number)
