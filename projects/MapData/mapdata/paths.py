"""Paths that files name."""

from pathlib import Path

from gsmap.utils.errors import InputError


def path_below(folder: Path, name: str, noun: str) -> Path:
    """Path that a file names, below a folder.

    Args:
        folder: Folder that the path is relative to.
        name: Relative path.
        noun: Place of the path in the file, for error messages.

    Returns:
        The path.

    Raises:
        ValueError: If the path leads out of the folder.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"{noun} must lie below {folder}, got {name!r}")
    return folder / name
