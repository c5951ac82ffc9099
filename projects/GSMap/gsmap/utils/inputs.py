"""Protection of input files and of files of other programs from the outputs of a command."""

import os
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from gsmap.utils.errors import InputError, WorkError

_Identity = tuple[int, int, int]  # device, inode and modification time of a file
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_SYSTEM_FOLDERS = ("/dev/", "/proc/", "/sys/")  # pipes and devices there may be read
_MARKED_BYTES = 1 << 16  # length of the start and of the end of a file that `has_mark` searches


class InputReplacedError(WorkError):
    """Error of a command that would overwrite a file that it reads."""


class _Command:
    """Input and output files of the running command."""

    is_running = False
    inputs: ClassVar[dict[_Identity, Path]] = {}  # files that arguments name
    outputs: ClassVar[dict[_Identity, str]] = {}  # option and path of existing output files
    has_hook = False


def watch_files() -> None:
    """Check every file that this process opens after this call (`check_input`)."""
    _Command.is_running = True
    if not _Command.has_hook:
        sys.addaudithook(_on_event)
        _Command.has_hook = True


@contextmanager
def protect_inputs() -> Iterator[None]:
    """Context in which overwriting an input or reading a pipe is an error.

    `declare_files` names the inputs. The writers of `gsmap.utils.files` check them
    (`require_no_input`), and an audit hook checks each file that is read.
    """
    watch_files()
    try:
        yield
    finally:
        _Command.is_running = False
        _Command.inputs.clear()
        _Command.outputs.clear()


def declare_files(inputs: Iterable[Path], outputs: Sequence[tuple[Path, str]]) -> None:
    """Declare the files that a command's arguments name, before the command begins.

    Afterwards, reading a declared output and overwriting a declared input raise an error. This
    includes files that are found in a folder or named in a config, and other names of a file
    (symbolic and hard links).

    Args:
        inputs: Files that the command reads.
        outputs: Files that the command writes, each with the option that names it.

    Raises:
        InputReplacedError: If a file is an input and an output.
        ValueError: If two options name one output.
    """
    places: dict[str, str] = {}
    for path, option in outputs:
        if path.is_file() or not path.exists():  # a device may receive several outputs
            first = places.setdefault(os.path.realpath(path), option)
            if first != option:
                raise InputError(f"{first} and {option} both name {path}: give two names.")
    existing_outputs: dict[_Identity, str] = {}
    for path, option in outputs:
        identity = _identity(path)
        if identity is not None:
            existing_outputs[identity] = f"{option} {path}"
    for path in inputs:
        _refuse_output(path=path, outputs=existing_outputs)
    if not _Command.is_running:
        return
    for path in inputs:
        identity = _identity(path)
        if identity is not None:
            _Command.inputs[identity] = path
    _Command.outputs |= existing_outputs


def check_input(path: str | bytes | os.PathLike) -> None:
    """Check a file before it is read.

    Code calls this for libraries that do not open files through Python.

    Args:
        path: Path of the file.

    Raises:
        InputReplacedError: If the file is an output of the command.
        ValueError: If the file is a pipe, a socket or a device outside of the system folders. With
            a pipe in a data set the command would wait forever, and a device may have no end.
    """
    if not _Command.is_running:
        return
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # the reader reports it
        return
    if stat.S_ISREG(status.st_mode):
        if _Command.outputs:
            _refuse_output(path=path, outputs=_Command.outputs)
    elif not stat.S_ISDIR(status.st_mode):
        name = os.fsdecode(path)
        if not os.path.abspath(name).startswith(_SYSTEM_FOLDERS):
            raise InputError(f"{name} is a pipe, a socket or a device: give a plain file.")


def _refuse_output(path: str | bytes | os.PathLike, outputs: Mapping[_Identity, str]) -> None:
    """Raise an error if a file to read is one of the outputs."""
    identity = _identity(path) if outputs else None
    if identity is not None and identity in outputs:
        raise InputReplacedError(
            f"{outputs[identity]} would replace what this command reads ({os.fsdecode(path)}): "
            "give another name."
        )


def require_no_input(path: Path) -> None:
    """Refuse to replace a file that the command's arguments name as an input.

    Raises:
        InputReplacedError: If the file is an input.
    """
    identity = _identity(path) if _Command.inputs else None
    if identity is not None and identity in _Command.inputs:
        raise InputReplacedError(
            f"{path} would replace what this command reads ({_Command.inputs[identity]}): name "
            "another place for what it writes."
        )


def has_mark(path: Path, mark: bytes) -> bool:
    """Whether the first or the last 64 KiB of a file contain a mark.

    Args:
        path: Plain file.
        mark: Bytes that only the writer of a kind of files writes.
    """
    with path.open("rb") as file:
        if mark in file.read(_MARKED_BYTES):
            return True
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _MARKED_BYTES))
        return mark in file.read()


def require_own_file(path: Path, mark: bytes) -> None:
    """Require that no other program's file is at a path at which a command writes.

    The command may replace a file that an earlier run of it has written. It may also replace a
    link: `atomic_write` replaces the link itself, and the target of the link does not change.

    Args:
        path: Path of the file. The user has named its folder, and the command its name.
        mark: Bytes at the start or at the end of each such file of the command.

    Raises:
        ValueError: If another program's file, or no plain file, has this name.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if stat.S_ISLNK(mode):
        return
    if not stat.S_ISREG(mode) or not has_mark(path, mark):
        raise InputError(
            f"{path} exists and is no file of this command, which would replace it: remove it, or "
            "give another output."
        )


def forget_output(path: Path) -> None:
    """Allow a file to be read again, because an output is about to replace it."""
    if not _Command.outputs:
        return
    identity = _identity(path)
    if identity is not None:
        _Command.outputs.pop(identity, None)


def _on_event(event: str, arguments: tuple[Any, ...]) -> None:
    """Check each file that Python or SQLite opens; an audit hook."""
    if not _Command.is_running:
        return
    if event == "open":
        path, _, flags = arguments
        if isinstance(path, str | bytes) and not (flags or 0) & _WRITING:
            check_input(path)
    elif event == "sqlite3.connect" and isinstance(arguments[0], str):
        path, _, _ = arguments[0].removeprefix("file:").partition("?")
        check_input(path)


def _identity(path: str | bytes | os.PathLike) -> _Identity | None:
    """Return a value that identifies a file under all of its names; None if it is not a file."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # a name with a zero byte
        return None
    if not stat.S_ISREG(status.st_mode):
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns
