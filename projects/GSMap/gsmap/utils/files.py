"""Files that are whole or absent, whatever stops their writer."""

import codecs
import hashlib
import io
import json
import logging
import os
import platform
import re
import secrets
import shutil
import stat
import time
import unicodedata
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal

from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.inputs import forget_output, require_no_input

try:
    import fcntl
except ImportError:  # Windows, where files are not locked
    fcntl = None  # type: ignore[assignment]

SUFFIX = ".gsmap-partial"  # no other program's name
_BOOT = Path("/proc/sys/kernel/random/boot_id")  # the same for all containers of a machine
_MACHINE = _BOOT.read_text()[:8] if _BOOT.exists() else secrets.token_hex(4)
_OURS = re.compile(rf".+\.([0-9a-f]{{8}})-[0-9a-f]{{8}}{re.escape(SUFFIX)}", re.DOTALL)
_DAY_S = 24 * 3600.0
_DEVICES = Path("/dev")
_STREAMS = Path("/dev/fd"), Path("/proc/self/fd")  # links to what a process has open
_OWN_FOLDERS: set[Path] = set()
_HOLDER = re.compile(r"(process \d+ on \S+ since [\d: -]+)?")  # what `lock_folder` writes
_CHANGED = re.compile(r"-[0-9a-f]{16}\Z")  # as `file_name` ends a changed name
DAMAGED_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError)  # what it raises
_LFS_POINTER = b"version https://git-lfs.github.com/"
_LONGEST_NAME = 100  # bytes; a file system takes 255, with all that is appended


def file_name(foreign: str) -> str:
    """Make the name of a file or folder from a name that a file brings.

    It is one part of a path and leads nowhere else. Letters, digits and ``_.+=-`` stay. A name that
    has others, is empty or long, begins with a dot or hyphen, ends with a dot, is not in Unicode's
    form NFC, or ends as a changed name does is changed and gets a digest, so that two names never
    make one file.
    """
    name = _plain_name(foreign)
    if name == foreign and not _CHANGED.search(name):
        return name
    return _changed_name(foreign)


def file_names(foreign: Iterable[str], endings: Sequence[str] = ("",)) -> dict[str, str]:
    """Make the names of several files (`file_name`), no two of which are one file.

    Where two differ in nothing but capitals, as some disks do not tell apart, or one is another
    with an ending, both get a digest.

    Args:
        foreign: The names that a file brings.
        endings: What is appended to each name.

    Returns:
        The name of the file of each.
    """
    names = {name: file_name(name) for name in foreign}
    while True:
        uses = Counter(f"{name}{e}".casefold() for name in names.values() for e in endings)
        met = [
            name
            for name, file in names.items()
            if any(uses[f"{file}{e}".casefold()] > 1 for e in endings)
        ]
        changed = {name: _changed_name(name) for name in met}
        if all(names[name] == new for name, new in changed.items()):
            return names
        names |= changed


def _plain_name(foreign: str) -> str:
    composed = unicodedata.normalize("NFC", foreign)  # some disks do not tell the forms apart
    letters = re.sub(r"[^\w.+=-]", "_", composed)
    plain = letters.lstrip(".-").encode()[:_LONGEST_NAME]
    return plain.decode(errors="ignore").rstrip(".") or "unnamed"


def _changed_name(foreign: str) -> str:
    digest = hashlib.sha256(foreign.encode(errors="surrogatepass")).hexdigest()[:16]
    return f"{_plain_name(foreign)}-{digest}"


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Say which file it was where the system refuses to write to one that is open."""
    try:
        yield
    except OSError as error:
        if not error.errno or error.filename:
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error


def own_folder(path: Path) -> Path:
    """Return a folder whose name a command chooses, and let no link below it be followed.

    From then on `atomic_write` refuses (``ValueError``) what a link would lead out of it.
    """
    require_no_link(path)
    _OWN_FOLDERS.add(path)
    return path


@contextmanager
def atomic_write(path: str | Path, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file that takes its name only when the block ends well.

    Until then it is another file beside it (`partial_path`), which any exception removes. A reader
    sees the old file or the new one. It has the mode of the file that it replaces. A link is
    replaced, not followed. A device or a pipe, such as ``/dev/null``, is written to as it is.
    Parent folders are made; text is UTF-8.

    Raises:
        InputReplacedError: If the file is an input of the command (`inputs.declare_files`).
    """
    path = Path(path)
    require_no_input(path)
    for folder in _OWN_FOLDERS:
        if path.is_relative_to(folder):
            require_no_link(path.parent, folder.parent)
    encoding = None if "b" in mode else "utf-8"
    special = _is_special(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    failures: list[OSError] = []
    try:
        with (
            nullcontext(path) if special else partial_path(path) as made,
            io.BufferedWriter(_Raw(made, failures)) as buffer,
            buffer if encoding is None else io.TextIOWrapper(buffer, encoding) as file,
        ):
            if not special:
                _keep_mode(path, file.fileno())
            yield file
            file.flush()
            if not special:
                os.fsync(file.fileno())
                forget_output(path)
                os.replace(made, path)
    except Exception as raised:
        error = failures[0] if failures else raised
        if not isinstance(error, OSError) or not error.errno:
            raise
        if error.filename and not _OURS.fullmatch(str(error.filename)):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from raised


class _Raw(io.FileIO):
    """A file that notes why it cannot be written: some libraries tell it in words of their own."""

    def __init__(self, path: Path, failures: list[OSError]) -> None:
        super().__init__(str(path), "w", opener=_open_unlinked)
        self._failures = failures

    def write(self, data: Any) -> int | None:  # type: ignore[override]
        try:
            return super().write(data)
        except OSError as error:
            self._failures.append(error)
            raise


def _open_unlinked(path: str, flags: int) -> int:
    """Open a file, or a pipe that somebody reads from, for writing; no file elsewhere by a link."""
    follows = _is_special(Path(path))  # /dev/stdout
    return os.open(path, flags | (0 if follows else os.O_NOFOLLOW), 0o666)


def _keep_mode(path: Path, handle: int) -> None:
    """Give an open file the permissions of the one that it is to replace."""
    with suppress(FileNotFoundError):
        before, own = path.lstat().st_mode, os.fstat(handle).st_mode
        wanted = stat.S_IMODE(before) & 0o777
        if stat.S_ISREG(before) and stat.S_IMODE(own) != wanted:
            os.fchmod(handle, wanted)


def open_to_append(path: Path) -> io.FileIO:
    """Open a file to read it and add to it, unbuffered; it is made if there is none.

    Raises:
        ValueError: If it is no plain file of one name: a link leads elsewhere, and a pipe or a
            folder holds no text.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    status = None
    with suppress(FileNotFoundError):
        status = path.lstat()
    if status is None or _is_plain(status):
        file = io.FileIO(os.open(path, flags, 0o666), "a+")
        if _is_plain(os.fstat(file.fileno())):
            return file
        file.close()
    raise InputError(
        f"{path} is a link, a pipe or a folder, and no file of this program: take it away, or "
        "write elsewhere."
    )


def require_no_link(path: Path, below: Path | None = None) -> None:
    """Refuse a folder that a link leads elsewhere from.

    Args:
        path: A folder whose name the command chooses.
        below: A folder above it that the user named, through whatever links; by default its parent.

    Raises:
        ValueError: If it, or a folder between the two, is a link.
    """
    top = path.parent if below is None else below
    for folder in (path, *path.parents):
        if folder == top:
            return
        if folder.is_symlink():
            raise InputError(
                f"{folder} is a link, and what is written there would go elsewhere: take it away, "
                "or write elsewhere."
            )


def take_from_link(path: Path) -> None:
    """Free a name that a library is to write to from what leads elsewhere: a link, a hard link."""
    with suppress(FileNotFoundError):
        if not _is_plain(path.lstat()):
            path.unlink()


def _is_plain(status: os.stat_result) -> bool:
    return stat.S_ISREG(status.st_mode) and status.st_nlink == 1


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in one step, in UTF-8."""
    with atomic_write(path) as file:
        file.write(text)


def is_hidden(path: Path) -> bool:
    """Whether a file or folder is of the kind that systems leave beside others, as ``._a.jpg``."""
    return path.name.startswith(".")


def fetch_advice(start: bytes, otherwise: str) -> str:
    """Return how to get a file that is not what its name says, by the bytes it starts with."""
    if start.startswith(_LFS_POINTER):
        return "it is a pointer of Git LFS: fetch the file itself with `git lfs pull`"
    if start[:100].lstrip().lower().startswith((b"<!doctype html", b"<html")):
        return "it is a web page: download the file itself"
    return otherwise


def read_text(path: str | Path) -> str:
    """Return the content of a text file in UTF-8, without a byte order mark.

    Raises:
        ValueError: With its name and the remedy, if it is in another encoding.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        wide = error.object.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        reason = "it is UTF-16" if wide else str(error)
        raise InputError(f"{path} cannot be read: {reason}; save it as UTF-8.") from error


def read_json(path: str | Path) -> Any:
    """Return the value in a JSON file; ValueError with its name if it is none."""
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
    except RecursionError:
        raise InputError(f"{path} cannot be read: it is nested too deep.") from None


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file in one step."""
    with atomic_write(path, "wb") as file:
        file.write(content)


_touch = partial(Path.touch, exist_ok=False)  # not through a link


@contextmanager
def partial_path(path: Path, make: Callable[[Path], object] = _touch) -> Iterator[Path]:
    """Make an empty file or folder beside ``path``, which the block fills and gives that name.

    It is ``PATH.<machine>-<random>.gsmap-partial``, locked while the block runs, and goes with its
    end. Those of killed writers in that folder go first: who gets their lock may remove them.
    """
    _remove_leftovers(path.parent)
    while True:
        made = path.with_name(f"{path.name}.{_MACHINE}-{secrets.token_hex(4)}{SUFFIX}")
        make(made)
        with suppress(FileNotFoundError):  # removed by another writer that locked it first
            handle = _open(made)
            if try_lock(handle) is not False and made.exists():
                break
            os.close(handle)
    try:
        yield made
    finally:
        _remove(made)
        os.close(handle)


def try_lock(file: IO[Any] | int) -> bool | None:
    """Lock an open file or folder for as long as it is open.

    Returns:
        False if another process has locked it, None if the file system has no locks.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def lock(file: IO[Any] | int, held: str) -> None:
    """Lock an open file or folder for as long as it is open; warn where there are no locks.

    Raises:
        RuntimeError: If another process has locked it, with the text ``held``.
    """
    if (locked := try_lock(file)) is False:
        raise WorkError(held)
    if locked is None:
        text = "files cannot be locked here: take care that one process works at a time."
        logging.getLogger("gsmap").warning(text)


def lock_folder(folder: Path, name: str, advice: str) -> IO[str]:
    """Keep a folder for this process alone until the file that is returned is closed.

    Args:
        folder: The folder; it is made.
        name: Name of a file in it, for the lock and for who holds it.
        advice: What to do if another process has it.

    Raises:
        RuntimeError: If another process has it; its number, its machine and since when.
    """
    folder.mkdir(parents=True, exist_ok=True)
    raw = open_to_append(folder / name)
    file = io.TextIOWrapper(io.BufferedRandom(raw), "utf-8", "replace")
    os.register_at_fork(after_in_child=file.close)  # workers must not hold it for a killed parent
    file.seek(0)
    holder = file.read(200)
    if not _HOLDER.fullmatch(holder):
        raise InputError(f"{folder / name} is another program's file: write elsewhere.")
    lock(file, f"{folder} is in use by {holder or 'another process'}: {advice}.")
    file.truncate(0)
    file.write(f"process {os.getpid()} on {platform.node()} since {time.strftime('%F %T')}")
    file.flush()
    return file


def _remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left; another machine's, whose lock may not reach, after a day."""
    for name in os.listdir(folder):
        if not (found := _OURS.fullmatch(name)):
            continue
        with suppress(OSError):  # it has gone meanwhile, or is another user's
            handle = _open(folder / name)
            try:
                rested_s = time.time() - os.fstat(handle).st_mtime
                if (found[1] == _MACHINE or rested_s > _DAY_S) and try_lock(handle):
                    _remove(folder / name)
            finally:
                os.close(handle)


def _open(path: Path) -> int:
    """Open a file or folder to lock it; network disks lock files only for who may write."""
    return os.open(path, os.O_NOFOLLOW | (os.O_RDONLY if path.is_dir() else os.O_RDWR))


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _is_special(path: Path) -> bool:
    """Whether a path is a device, a pipe or the like, which must not be replaced by a file.

    A link to one is a file's name like any other, but for those that the system makes.
    """
    follow = path.parent in (_DEVICES, *_STREAMS)
    try:
        mode = path.stat(follow_symlinks=follow).st_mode
    except OSError:
        return False
    plain = stat.S_ISREG(mode) and path.parent != _DEVICES
    return not (plain or stat.S_ISDIR(mode) or stat.S_ISLNK(mode))
