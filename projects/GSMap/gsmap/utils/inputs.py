"""Protection of a command's inputs, and of other programs' files, from being overwritten."""

import os
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from gsmap.utils.errors import InputError, WorkError

_Identity = tuple[int, int, int]  # device, inode and modification time of a file
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT  # a file opened with one of these flags is written
_SYSTEM_FOLDERS = ("/dev/", "/proc/", "/sys/")  # pipes and devices there may be read
_MARKED_BYTES = 1 << 16  # number of bytes that `has_mark` searches at each end of a file


class InputReplacedError(WorkError):
    """Error that is raised when a command would overwrite a file that it reads."""


class _Command:
    """Input and output files of the running command, as class attributes without any object."""

    is_running = False
    inputs: ClassVar[dict[_Identity, Path]] = {}  # files that arguments name
    outputs: ClassVar[dict[_Identity, str]] = {}  # option and path of existing output files
    has_hook = False  # Python cannot remove an audit hook, so it is added once per process


def watch_files() -> None:
    """Check every file that this process opens for reading after this call (`check_input`)."""
    _Command.is_running = True
    if not _Command.has_hook:
        sys.addaudithook(_on_event)
        _Command.has_hook = True


@contextmanager
def protect_inputs() -> Iterator[None]:
    """Context manager in which overwriting an input or reading a pipe raises an error.

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

    Afterwards, reading a declared output or overwriting a declared input raises an error. This also
    holds if the file is found in a folder, is named in a config, or has another name (a symbolic or
    hard link).

    Args:
        inputs: Files that the command reads.
        outputs: Files that the command writes, each with the option that names it.

    Raises:
        InputReplacedError: If an existing file is both an input and an output.
        ValueError: If two options name one output.
    """
    option_of_path: dict[str, str] = {}
    for path, option in outputs:
        if path.is_file() or not path.exists():  # a device may receive several outputs
            first_option = option_of_path.setdefault(os.path.realpath(path), option)
            if first_option != option:
                raise InputError(f"{first_option} and {option} both name {path}: give two names.")
    existing_outputs: dict[_Identity, str] = {}
    for path, option in outputs:
        identity = _identity(path)
        if identity is not None:
            existing_outputs[identity] = f"{option} {path}"
    for path in inputs:
        _refuse_output(path=path, outputs=existing_outputs)
    # Outside of `protect_inputs` the files are checked, but later accesses are not watched.
    if not _Command.is_running:
        return
    for path in inputs:
        identity = _identity(path)
        if identity is not None:
            _Command.inputs[identity] = path
    _Command.outputs |= existing_outputs


def check_input(path: str | bytes | os.PathLike) -> None:
    """Check a file before it is read.

    It must be called before a library reads a file without Python's ``open``.

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
    except (OSError, ValueError):  # the code that reads the file will report the error
        return
    if stat.S_ISREG(status.st_mode):
        if _Command.outputs:
            _refuse_output(path=path, outputs=_Command.outputs)
    elif not stat.S_ISDIR(status.st_mode):
        name = os.fsdecode(path)
        if not os.path.abspath(name).startswith(_SYSTEM_FOLDERS):
            raise InputError(f"{name} is a pipe, a socket or a device: give a plain file.")


def _refuse_output(path: str | bytes | os.PathLike, outputs: Mapping[_Identity, str]) -> None:
    """Raise an error if a file to read is one of the outputs (option and path of each)."""
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
    """Require that the path to which a command writes does not have another program's file.

    The command may replace a file that an earlier run of the command has written. It may also
    replace a link: `atomic_write` replaces the link itself, and the target of the link does not
    change.

    Args:
        path: Path of the file. The user has chosen the folder, and the command the file name.
        mark: Bytes near the start or the end of each such file of the command.

    Raises:
        ValueError: If the path is another program's file, or exists and is not a plain file.
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
    """Allow the reading of a file that was declared as an output and is about to be replaced.

    The writers of `gsmap.utils.files` call this.
    """
    if not _Command.outputs:
        return
    identity = _identity(path)
    if identity is not None:
        _Command.outputs.pop(identity, None)


def forget_input(path: Path) -> None:
    """Allow the replacing of a file that was declared as an input and that the command updates."""
    identity = _identity(path) if _Command.inputs else None
    if identity is not None:
        _Command.inputs.pop(identity, None)


def _on_event(event: str, arguments: tuple[Any, ...]) -> None:
    """Audit hook that checks each file that Python opens for reading or that SQLite opens."""
    if not _Command.is_running:
        return
    if event == "open":
        path, _, flags = arguments
        if isinstance(path, str | bytes):
            # `flags` may be None, and reading is the absence of all flags of `_WRITING`.
            is_written = ((flags or 0) & _WRITING) != 0
            if not is_written:
                check_input(path)
    elif event == "sqlite3.connect" and isinstance(arguments[0], str):
        # The argument may be a URI such as "file:drive.db3?mode=ro".
        path, _, _ = arguments[0].removeprefix("file:").partition("?")
        check_input(path)


def _identity(path: str | bytes | os.PathLike) -> _Identity | None:
    """Return a value that identifies a file under all of its names; None if it is no plain file."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):  # ValueError for a name with a zero byte
        return None
    if not stat.S_ISREG(status.st_mode):
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns
