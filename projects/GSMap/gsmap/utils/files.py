"""Files that are whole or absent, whatever stops their writer."""

import fcntl
import hashlib
import logging
import os
import platform
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

SUFFIX = ".partial"
_END = f".{platform.node()}{SUFFIX}"  # another machine's writers on a shared disk cannot be judged
_DAY_S = 24 * 3600.0
_DEVICES = Path("/dev")
_LONGEST_NAME = 100  # bytes; a file system takes 255, with all that is appended


def file_name(foreign: str) -> str:
    """Make the name of a file or folder from a name that a file brings.

    It is one part of a path and leads nowhere else. Letters, digits and ``_.+=-`` stay. A name that
    has others, is empty or long, or begins with a dot or hyphen is changed and gets a digest, so
    that two names never make one file.
    """
    plain = re.sub(r"[^\w.+=-]", "_", foreign).lstrip(".-").encode()[:_LONGEST_NAME]
    name = plain.decode(errors="ignore") or "unnamed"
    if name == foreign:
        return name
    return f"{name}-{hashlib.sha256(foreign.encode(errors='surrogatepass')).hexdigest()[:8]}"


@contextmanager
def atomic_write(path: str | Path, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file that takes its name only when the block ends well.

    Until then it is ``PATH.<pid>.<host>.partial``, which any exception removes. What a killed
    writer left behind goes when anything is written to the same folder. A reader sees the old file
    or the new one. A device or a pipe, such as ``/dev/null``, is written to as it is. Parent
    folders are made; text is UTF-8.
    """
    path = Path(path)
    encoding = None if "b" in mode else "utf-8"
    if _is_special(path):
        with path.open(mode, encoding=encoding) as file:
            yield file
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(path)
    try:
        with partial.open(mode, encoding=encoding) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        if error.errno and str(error.filename or partial) == str(partial):
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in one step, in UTF-8."""
    with atomic_write(path) as file:
        file.write(text)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file in one step."""
    with atomic_write(path, "wb") as file:
        file.write(content)


def lock(file: IO[Any] | int, held: str) -> None:
    """Lock an open file or folder for as long as it is open.

    Raises:
        RuntimeError: If another process has locked it, with the text ``held``.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise RuntimeError(held) from error
    except OSError as error:  # a file system without locks
        text = "files cannot be locked here (%s): take care that one process works at a time."
        logging.getLogger("gsmap").warning(text, error)


def partial_path(path: Path) -> Path:
    """Return where a file or folder is made before it takes its name.

    What killed writers left in that folder is removed.
    """
    for name in os.listdir(path.parent):
        stale = path.parent / name
        if name.endswith(SUFFIX) and _is_stale(stale):
            shutil.rmtree(stale, True) if stale.is_dir() else stale.unlink(missing_ok=True)
    return path.with_name(f"{path.name}.{os.getpid()}{_END}")


def _is_stale(partial: Path) -> bool:
    """Whether a writer is dead: its process is none here, or on another machine it rested a day."""
    name, own = partial.name, partial.name.endswith(_END)
    found = re.fullmatch(r".+\.(\d+)", name[: -len(_END)]) if own else None
    if found and Path("/proc/self").exists():  # without /proc there is no way to tell
        return not Path("/proc", found[1]).exists()
    if own or not re.fullmatch(rf".+\.\d+\..+{re.escape(SUFFIX)}", name):
        return False
    try:
        return time.time() - partial.stat().st_mtime > _DAY_S
    except FileNotFoundError:
        return False


def _is_special(path: Path) -> bool:
    """Whether a path is a device, a pipe or the like, which must not be replaced by a file."""
    return path.exists() and not path.is_dir() and (not path.is_file() or path.parent == _DEVICES)
