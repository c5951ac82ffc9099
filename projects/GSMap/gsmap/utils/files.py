"""Atomic writes, safe file names, locks, and reading of text and JSON files."""

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
import weakref
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

SUFFIX = ".gsmap-partial"  # ending of temporary files, which no other program uses
_BOOT = Path("/proc/sys/kernel/random/boot_id")  # an ID shared by all containers of a machine
# Eight digits that identify this machine until its next start.
_MACHINE = _BOOT.read_text()[:8] if _BOOT.exists() else secrets.token_hex(nbytes=4)
# Name of a temporary file. The group is the machine of its writer.
_PARTIAL_NAME = re.compile(
    rf".+\.([0-9a-f]{{8}})-[0-9a-f]{{8}}{re.escape(SUFFIX)}", flags=re.DOTALL
)
_DAY_S = 24 * 3600.0
_DEVICES = Path("/dev")
_STREAMS = Path("/dev/fd"), Path("/proc/self/fd")  # links to the open files of a process
_REGISTERED_FOLDERS: set[Path] = set()  # folders of the running command, see `register_folder`
_HOLDER = re.compile(r"(process \d+ on \S+ since [\d: -]+)?")  # content of a lock file
_DIGEST_ENDING = re.compile(r"-[0-9a-f]{16}\Z")  # ending of names that `file_name` has changed
# Exceptions of `zipfile` for a damaged archive
DAMAGED_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError)
_LFS_POINTER = b"version https://git-lfs.github.com/"
_LONGEST_NAME = 100  # bytes; file systems allow 255, including all suffixes


def file_name(foreign: str) -> str:
    """Convert a name from a file to a safe name of a file or folder.

    The result is a single path component. Letters, digits and ``_.+=-`` are kept. The name is
    changed if it has other characters, is empty or longer than 100 bytes, begins with a dot or
    hyphen, ends with a dot, is not in Unicode form NFC, or ends like a changed name. A changed name
    ends with a digest of the original, so that different names make different files.

    Args:
        foreign: Untrusted name.
    """
    name = _plain_name(foreign)
    if name == foreign and not _DIGEST_ENDING.search(name):
        return name
    return _changed_name(foreign)


def file_names(foreign: Iterable[str], endings: Sequence[str] = ("",)) -> dict[str, str]:
    """Convert names from a file to safe names of distinct files (`file_name`).

    Names also get a digest in two cases: if two files would differ only in upper and lower case,
    which some file systems do not distinguish, or if a name with an ending equals another file.

    Args:
        foreign: Untrusted names.
        endings: Suffixes that the caller appends to each name.

    Returns:
        The safe name of each name.
    """
    names = {name: file_name(name) for name in foreign}
    # A changed name may coincide with another file, so all names are checked again after a change.
    # A name that has its digest does not change again. So each name changes at most once, and the
    # loop ends.
    while True:
        uses: Counter[str] = Counter()
        for name in names.values():
            uses.update(_folded_names(name=name, endings=endings))
        has_changes = False
        new_names = dict(names)
        for original, name in names.items():
            files = _folded_names(name=name, endings=endings)
            if all(uses[file] == 1 for file in files):
                continue
            new_names[original] = _changed_name(original)
            if new_names[original] != name:
                has_changes = True
        if not has_changes:
            return names
        names = new_names


def _folded_names(name: str, endings: Sequence[str]) -> list[str]:
    """Return a file name with each ending, converted so that upper and lower case are equal."""
    return [f"{name}{ending}".casefold() for ending in endings]


def _plain_name(foreign: str) -> str:
    """Make a name safe, without a digest (see `file_name`)."""
    # Some file systems do not distinguish the normal forms of Unicode.
    composed = unicodedata.normalize("NFC", foreign)
    safe = re.sub(r"[^\w.+=-]", repl="_", string=composed)
    start = safe.lstrip(".-").encode()[:_LONGEST_NAME]
    # The limit may cut a character of several bytes, which "ignore" drops.
    return start.decode(errors="ignore").rstrip(".") or "unnamed"


def _changed_name(foreign: str) -> str:
    """Make a name safe, with a digest of the original at its end."""
    content = foreign.encode(errors="surrogatepass")
    digest = hashlib.sha256(content).hexdigest()
    return f"{_plain_name(foreign)}-{digest[:16]}"


@contextmanager
def add_path_to_errors(path: Path) -> Iterator[None]:
    """Context that adds a path to system errors without one, such as a failed write.

    Args:
        path: File or folder that the block writes to.
    """
    try:
        yield
    except OSError as error:
        if not error.errno or error.filename:
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error


def register_folder(path: Path) -> Path:
    """Register a folder whose name is chosen by a command, not by the user, and return it.

    Afterwards `atomic_write` raises ``ValueError`` if a link would lead a file out of the folder.
    """
    require_no_link(path)
    _REGISTERED_FOLDERS.add(path)
    return path


@contextmanager
def atomic_write(path: str | Path, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file for writing that replaces ``path`` when the block ends without an exception.

    The content is written to a temporary file beside ``path`` (`partial_path`), which is removed
    after an exception. A reader therefore opens either the old file or the complete new one. The
    new file keeps the permissions of the old one. A link is replaced, not followed. A device or a
    pipe, such as ``/dev/null``, is written directly. Missing parent folders are created. Text is
    encoded in UTF-8.

    Args:
        path: File to create or replace.
        mode: ``"w"`` for text, ``"wb"`` for bytes.

    Raises:
        InputReplacedError: If the file is an input of the command (`inputs.declare_files`).
    """
    path = Path(path)
    require_no_input(path)  # raises InputReplacedError
    for folder in _REGISTERED_FOLDERS:
        if path.is_relative_to(folder):
            require_no_link(path.parent, below=folder.parent)
    encoding = None if "b" in mode else "utf-8"
    is_special = _is_special(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    failures: list[OSError] = []  # write errors, which `_RawFile` appends
    try:
        with (
            nullcontext(path) if is_special else partial_path(path) as partial_file,
            io.BufferedWriter(_RawFile(partial_file, failures=failures)) as buffer,
            buffer if encoding is None else io.TextIOWrapper(buffer, encoding=encoding) as file,
        ):
            if not is_special:  # the temporary file replaces `path`
                _keep_mode(path=path, handle=file.fileno())
            yield file
            file.flush()
            if not is_special:
                os.fsync(file.fileno())
                # A command must not read a file that it will replace (`inputs.declare_files`). From
                # here on the file is the new one, which may be read.
                forget_output(path)
                os.replace(partial_file, path)
    except Exception as raised:
        # A system error about the temporary file, or without a path, gets the path that the caller
        # knows. All other errors pass unchanged.
        error = failures[0] if failures else raised
        if not isinstance(error, OSError) or not error.errno:
            raise
        if error.filename and not _PARTIAL_NAME.fullmatch(str(error.filename)):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from raised


class _RawFile(io.FileIO):
    """File that records its write errors, because some libraries raise an error of another type."""

    def __init__(self, path: Path, failures: list[OSError]) -> None:
        super().__init__(str(path), mode="w", opener=_open_unlinked)
        self._failures = failures

    def write(self, data: Any) -> int | None:  # type: ignore[override]
        try:
            return super().write(data)
        except OSError as error:
            self._failures.append(error)
            raise


def _open_unlinked(path: str, flags: int) -> int:
    """Open a file for writing. Links are followed only to devices and pipes."""
    may_be_link = _is_special(Path(path))  # such as /dev/stdout
    if not may_be_link:
        flags |= os.O_NOFOLLOW
    return os.open(path, flags=flags, mode=0o666)


def _keep_mode(path: Path, handle: int) -> None:
    """Copy the permissions of a file to the open file that will replace it."""
    with suppress(FileNotFoundError):
        old_mode = path.lstat().st_mode
        new_mode = os.fstat(handle).st_mode
        permissions = stat.S_IMODE(old_mode) & 0o777
        if stat.S_ISREG(old_mode) and stat.S_IMODE(new_mode) != permissions:
            os.fchmod(handle, mode=permissions)


def open_to_append(path: Path) -> io.FileIO:
    """Open a file for reading and appending, unbuffered; create it if it does not exist.

    Raises:
        ValueError: If the path is a link, a pipe or a folder, or a file with several hard links.
    """
    # O_NONBLOCK: opening a pipe does not wait. The type is checked again after opening, because
    # another process may have replaced the file in between.
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    status = None
    with suppress(FileNotFoundError):
        status = path.lstat()
    if status is None or _is_plain(status):
        file = io.FileIO(os.open(path, flags=flags, mode=0o666), mode="a+")
        if _is_plain(os.fstat(file.fileno())):
            return file
        file.close()
    raise InputError(
        f"{path} is a link, a pipe or a folder, and no file of this program: remove it, or "
        "write elsewhere."
    )


def require_no_link(path: Path, below: Path | None = None) -> None:
    """Raise ValueError if a folder, or a folder between it and ``below``, is a link.

    Args:
        path: Folder whose name is chosen by the command.
        below: Folder above ``path`` that was named by the user, by default the parent of ``path``.
            It may be a link or have links in its path.

    Raises:
        ValueError: If one of these folders is a link.
    """
    top = path.parent if below is None else below  # not checked
    for folder in (path, *path.parents):
        if folder == top:
            return
        if folder.is_symlink():
            raise InputError(
                f"{folder} is a link, and what is written there would go elsewhere: remove it, "
                "or write elsewhere."
            )


def remove_link(path: Path) -> None:
    """Remove a link, or one of several hard links, before a library writes to this path."""
    with suppress(FileNotFoundError):
        if not _is_plain(path.lstat()):
            path.unlink()


def _is_plain(status: os.stat_result) -> bool:
    """Whether a status belongs to a regular file (not a link) with only one hard link."""
    return stat.S_ISREG(status.st_mode) and status.st_nlink == 1


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 atomically."""
    with atomic_write(path) as file:
        file.write(text)


def is_hidden(path: Path) -> bool:
    """Whether a file or folder is hidden, such as the ``._a.jpg`` that macOS adds to ``a.jpg``."""
    return path.name.startswith(".")


def fetch_advice(start: bytes, otherwise: str) -> str:
    """Return advice for a file that is a Git LFS pointer or a web page instead of its content.

    Args:
        start: First bytes of the file, at least 100.
        otherwise: Advice for all other files.
    """
    if start.startswith(_LFS_POINTER):
        return "it is a pointer of Git LFS: fetch the file itself with `git lfs pull`"
    if start[:100].lstrip().lower().startswith((b"<!doctype html", b"<html")):
        return "it is a web page: download the file itself"
    return otherwise


def read_text(path: str | Path) -> str:
    """Read a text file in UTF-8, without its byte order mark.

    Raises:
        ValueError: If the file has another encoding.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        is_utf16 = error.object.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        reason = "it is UTF-16" if is_utf16 else str(error)
        raise InputError(f"{path} cannot be read: {reason}; save it as UTF-8.") from error


def read_json(path: str | Path) -> Any:
    """Read a JSON file.

    Raises:
        ValueError: If the file is not valid JSON.
    """
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
    except RecursionError:
        raise InputError(f"{path} cannot be read: it is nested too deep.") from None


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_write(path, mode="wb") as file:
        file.write(content)


_touch = partial(Path.touch, exist_ok=False)  # does not follow links


@contextmanager
def partial_path(path: Path, make: Callable[[Path], object] = _touch) -> Iterator[Path]:
    """Context with a temporary file or folder beside ``path``, which the block fills and renames.

    Its name is ``PATH.<machine>-<random>.gsmap-partial``. It is locked during the block and removed
    at the end of the block. Before the block, temporary files that no process has locked are
    removed from the folder, because their writers were killed.

    Args:
        path: Final path of the file or folder.
        make: Function that creates the empty file or folder at a path, by default a file.
    """
    _remove_leftovers(path.parent)
    while True:
        temporary = path.with_name(f"{path.name}.{_MACHINE}-{secrets.token_hex(nbytes=4)}{SUFFIX}")
        make(temporary)
        # Before the file is locked, another process may mistake it for a leftover and remove it. In
        # this case, the loop tries again.
        with suppress(FileNotFoundError):
            handle = _open(temporary)
            # None, a file system without locks, is accepted.
            if try_lock(handle) is not False and temporary.exists():
                break
            os.close(handle)
    try:
        yield temporary
    finally:
        _remove(temporary)
        os.close(handle)


def try_lock(file: IO[Any] | int) -> bool | None:
    """Lock an open file or folder for as long as it is open.

    Returns:
        True on success, False if another process holds the lock, None if the file system has no
        locks.
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


def lock(file: IO[Any] | int, message: str) -> None:
    """Lock an open file or folder for as long as it is open; warn if there are no locks.

    Args:
        file: Open file, or the handle of a file or folder.
        message: Text of the error if another process holds the lock.

    Raises:
        RuntimeError: If another process holds the lock.
    """
    is_locked = try_lock(file)
    if is_locked is False:
        raise WorkError(message)
    if is_locked is None:
        text = "files cannot be locked here: take care that one process works at a time."
        logging.getLogger("gsmap").warning(text)


# Open lock files of this process. Weak references do not keep a file open that its user has
# dropped.
_LOCK_FILES: "weakref.WeakSet[IO[str]]" = weakref.WeakSet()


def _close_lock_files() -> None:
    """Close the lock files in a forked worker, so that it does not keep the locks of its parent."""
    for file in list(_LOCK_FILES):
        file.close()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_close_lock_files)


def lock_folder(folder: Path, name: str, advice: str) -> IO[str]:
    """Reserve a folder for this process until the returned file is closed.

    Args:
        folder: Folder; created if it does not exist.
        name: Name of the lock file in the folder, which describes the process that holds it.
        advice: Remedy if another process holds the folder, for the message.

    Returns:
        The open lock file.

    Raises:
        ValueError: If another program has written the lock file.
        RuntimeError: If another process holds the folder; the message has its process ID, its
            machine and its start.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return lock_file(folder / name, subject=folder, advice=advice)


def lock_file(path: Path, subject: Path, advice: str) -> IO[str]:
    """Reserve a file or folder for this process by a lock file until the returned file is closed.

    Args:
        path: Lock file, which describes the process that holds it; its folder exists.
        subject: File or folder that is reserved, for the message.
        advice: Remedy if another process holds it, for the message.

    Returns:
        The open lock file.

    Raises:
        ValueError: If another program has written the lock file.
        RuntimeError: If another process holds the lock; the message has its process ID, its machine
            and its start.
    """
    raw = open_to_append(path)
    file = io.TextIOWrapper(io.BufferedRandom(raw), encoding="utf-8", errors="replace")
    _LOCK_FILES.add(file)
    file.seek(0)
    holder = file.read(200)  # text of the last process that held the lock; empty in a new file
    if not _HOLDER.fullmatch(holder):
        raise InputError(f"{path} is another program's file: write elsewhere.")
    lock(file, message=f"{subject} is in use by {holder or 'another process'}: {advice}.")
    file.truncate(0)
    file.write(f"process {os.getpid()} on {platform.node()} since {time.strftime('%F %T')}")
    file.flush()
    return file


def _remove_leftovers(folder: Path) -> None:
    """Remove temporary files of killed writers.

    Locks of other machines may be invisible on this one, so files of other machines are removed
    only after a day.
    """
    for name in os.listdir(folder):
        match = _PARTIAL_NAME.fullmatch(name)
        if match is None:
            continue
        with suppress(OSError):  # removed in the meantime, or owned by another user
            handle = _open(folder / name)
            try:
                age_s = time.time() - os.fstat(handle).st_mtime
                is_of_this_machine = match[1] == _MACHINE
                # A lock on success only: without locks (None), a writer may still be at work.
                if (is_of_this_machine or age_s > _DAY_S) and try_lock(handle):
                    _remove(folder / name)
            finally:
                os.close(handle)


def _open(path: Path) -> int:
    """Open a file or folder to lock it; network file systems lock only files open for writing."""
    access = os.O_RDONLY if path.is_dir() else os.O_RDWR
    return os.open(path, flags=os.O_NOFOLLOW | access)


def _remove(path: Path) -> None:
    """Remove a file or a folder, if it still exists."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _is_special(path: Path) -> bool:
    """Whether a path is a device, a pipe or a socket, which a file must not replace.

    A link to one of them counts only if the link is in ``/dev`` or in a folder of open files
    (`_STREAMS`). Links elsewhere may be replaced.
    """
    follow = path.parent in (_DEVICES, *_STREAMS)
    try:
        mode = path.stat(follow_symlinks=follow).st_mode
    except OSError:
        return False
    if stat.S_ISREG(mode):
        # A link in /dev, such as /dev/stdout, counts as special even if it leads to a regular file.
        return path.parent == _DEVICES
    return not stat.S_ISDIR(mode) and not stat.S_ISLNK(mode)
