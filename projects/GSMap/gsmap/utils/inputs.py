"""The files that a command reads: plain files, none of which its outputs may replace."""

import os
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from gsmap.utils.errors import InputError, WorkError

_Identity = tuple[int, int, int]  # device and number of a file, and when it was last changed
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_OF_THE_SYSTEM = ("/dev/", "/proc/", "/sys/")  # pipes and devices that are no stranger's


class InputReplacedError(WorkError):
    """A command would write over a file that it reads."""


class _Command:
    """What the command that runs reads and writes."""

    runs = False
    inputs: ClassVar[dict[_Identity, Path]] = {}  # files that its arguments name
    outputs: ClassVar[dict[_Identity, str]] = {}  # files there already that an option names
    hooked = False


def watch_files() -> None:
    """Check every file that this process opens from now on (`heed_input`)."""
    _Command.runs = True
    if not _Command.hooked:
        sys.addaudithook(_on_event)
        _Command.hooked = True


@contextmanager
def inputs_kept() -> Iterator[None]:
    """Refuse, while the block runs, to write over an input (`declare_files`) or to read a pipe."""
    watch_files()
    try:
        yield
    finally:
        _Command.runs = False
        _Command.inputs.clear()
        _Command.outputs.clear()


def declare_files(inputs: Iterable[Path], outputs: Sequence[tuple[Path, str]]) -> None:
    """Tell which files a command's arguments name, before it begins to work.

    From then on reading a file that is an output ends the command, wherever it is read: by an
    argument, in a folder that is read, by a name in a config, also by another name of it (a link or
    a hard link). Writing over an input does, too.

    Args:
        inputs: Files that it reads.
        outputs: Files that it writes, each with the option that names it.

    Raises:
        InputReplacedError: If a file is an input and an output.
        ValueError: If two options name one output.
    """
    places: dict[str, str] = {}
    for path, option in outputs:
        if path.is_file() or not path.exists():  # a device may take several
            first = places.setdefault(os.path.realpath(path), option)
            if first != option:
                raise InputError(f"{first} and {option} both name {path}: give two names.")
    there = {i: f"{option} {path}" for path, option in outputs if (i := _identity(path))}
    for path in inputs:
        _require_other(path, there)
    if not _Command.runs:
        return
    _Command.inputs |= {i: path for path in inputs if (i := _identity(path))}
    _Command.outputs |= there


def heed_input(path: str | bytes | os.PathLike) -> None:
    """Check a file before it is read; for libraries that open files without Python.

    Args:
        path: The file.

    Raises:
        InputReplacedError: If it is an output of the command.
        ValueError: If it is a pipe, a socket or a device outside the folders of the system. A pipe
            in a data set would let the command wait forever, and a link to a device never ends.
    """
    if not _Command.runs:
        return
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # its reader says why
        return
    if stat.S_ISREG(status.st_mode):
        if _Command.outputs:
            _require_other(path, _Command.outputs)
    elif not stat.S_ISDIR(status.st_mode):
        name = os.fsdecode(path)
        if not os.path.abspath(name).startswith(_OF_THE_SYSTEM):
            raise InputError(f"{name} is a pipe, a socket or a device: give a plain file.")


def _require_other(path: str | bytes | os.PathLike, outputs: Mapping[_Identity, str]) -> None:
    found = _identity(path) if outputs else None
    if found is not None and found in outputs:
        output = outputs[found]
        raise InputReplacedError(
            f"{output} would replace what this command reads ({os.fsdecode(path)}): give another "
            "name."
        )


def require_no_input(path: Path) -> None:
    """Refuse to replace a file that the command's arguments name as an input.

    Raises:
        InputReplacedError: If it is one.
    """
    found = _identity(path) if _Command.inputs else None
    if found is not None and found in _Command.inputs:
        read = _Command.inputs[found]
        raise InputReplacedError(
            f"{path} would replace what this command reads ({read}): name another place for what "
            "it writes."
        )


def forget_output(path: Path) -> None:
    """Let a file be read again: it is to be replaced, and what takes its name is an output."""
    if _Command.outputs and (found := _identity(path)) is not None:
        _Command.outputs.pop(found, None)


def _on_event(event: str, arguments: tuple[Any, ...]) -> None:
    """Check each file that Python opens (an audit hook), and each of SQLite."""
    if not _Command.runs:
        return
    if event == "open":
        path, _, flags = arguments
        if isinstance(path, str | bytes) and not (flags or 0) & _WRITING:
            heed_input(path)
    elif event == "sqlite3.connect" and isinstance(arguments[0], str):
        heed_input(arguments[0].removeprefix("file:").partition("?")[0])


def _identity(path: str | bytes | os.PathLike) -> _Identity | None:
    """Return what tells a file from others, under any of its names; None if there is none."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # a name with a zero byte
        return None
    if not stat.S_ISREG(status.st_mode):
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns
