"""The checks, by the reference files that they recompute."""

import importlib
from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from reference import report
from reference.golden import Golden

Check = Callable[[Golden, str], Iterable[report.Row]]
CHECKS: list[tuple[str, Check]] = []


def check(*patterns: str) -> Callable[[Check], Check]:
    """Register a function that recomputes files.

    Args:
        patterns: File-name patterns; ``{variant}`` stands for the variant.

    Returns:
        A decorator for a function of the reference data and a file name that yields rows.
    """

    def register(function: Check) -> Check:
        CHECKS.extend((pattern, function) for pattern in patterns)
        return function

    return register


METHODS = Path(__file__).resolve().parents[1] / "methods"


def load_checks() -> None:
    """Import the methods' modules of checks, ``methods/<method>/reference*.py``."""
    importlib.import_module("reference.maptr")
    for path in sorted(METHODS.glob("*/reference*.py")):
        importlib.import_module(f"methods.{path.parent.name}.{path.stem}")


def plan(golden: Golden) -> tuple[list[tuple[str, Check]], list[str]]:
    """Return the checks of the files in a folder, and the variant's files that have no check."""
    load_checks()
    names = sorted(path.name for path in golden.folder.iterdir() if path.is_file())
    chosen = [
        (name, function)
        for name in names
        for pattern, function in CHECKS
        if fnmatchcase(name, pattern.format(variant=golden.variant))
    ]
    covered = {name for name, _ in chosen}
    unchecked = [
        name
        for name in names
        if name.endswith((f"_{golden.variant}.npz", "_state.json")) and name not in covered
    ]
    return chosen, unchecked


def run_checks(golden: Golden, only: str = "*") -> Iterator[report.Row]:
    """Recompute the files of a folder.

    Args:
        golden: The reference data.
        only: Pattern of the file names to recompute.

    Yields:
        The compared quantities.

    Raises:
        ValueError: If no file of the variant has a check.
    """
    chosen = [(name, function) for name, function in plan(golden)[0] if fnmatchcase(name, only)]
    if not chosen:
        raise ValueError(
            f"{golden.folder} holds no reference file of variant {golden.variant!r} that matches "
            f"{only!r}."
        )
    for name, function in chosen:
        yield from function(golden, name)
