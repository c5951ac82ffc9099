"""Errors that a user can cause, in words; every other exception is a bug."""

import errno
import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from gsmap.utils.errors import GsmapError

_FULL = "free some space there, or write elsewhere"
_LESS = (
    "take a smaller batch (train_dataloader.batch_size=1), fewer processes (num_workers, "
    "--workers) or smaller images"
)
_SHORTENED = (
    "a data file was shortened while it was read (end what writes there, make it again), or "
    "/dev/shm is full (take fewer num_workers)"
)
_FEWER = "use fewer processes (num_workers, --workers)"
_REMEDIES = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EACCES: "choose a place that you may read and write",
    errno.EPERM: "choose a place that you may read and write",
    errno.EROFS: "choose a place where you may write",
    errno.EISDIR: "name a file in it",
    errno.ENOTDIR: "a part of that path is a file",
    errno.EEXIST: "choose another name or remove it",
    errno.ENOENT: "check the path",
    errno.EMFILE: _FEWER,
    errno.ENFILE: _FEWER,
    errno.ENOMEM: _FEWER,
}
_NO_MEMORY = re.compile(
    r"out of memory|(can't|Cannot|cannot) allocate memory|not enough memory|DataLoader worker \(pid"
)
_NO_HANDLES = re.compile("Too many open files. Communication with the workers")  # torch's words
_NO_DEVICE = re.compile(
    "not compiled with CUDA|no NVIDIA driver|No CUDA GPUs|invalid device ordinal|device string"
)
_NO_PEER = re.compile(r"gloo.*(closed|reset) by peer|NCCL.*remote process", re.DOTALL)
_IN_WORKER = "Original Traceback (most recent call last)"  # in texts of torch's DataLoader


def in_words(error: BaseException) -> str | None:
    """Return the text of an error that a user can cause.

    These are errors of ours (`GsmapError`), of the system (``OSError``), and those of libraries by
    which a machine says that it lacks memory, a device or a process. Whoever calls a library with
    a user's content turns its other errors into ours on the spot.

    Args:
        error: Exception that ended a command.

    Returns:
        The text; None for a bug, which keeps its traceback.
    """
    text = str(error)
    if _IN_WORKER in text:  # torch hands on the class, and the text within a traceback
        text = text.rstrip().splitlines()[-1]
        text = text.partition(": ")[2]
    return (
        _of_the_machine(error, text)
        or _of_the_system(error, text)
        or (text if isinstance(error, GsmapError) else None)
    )


def is_of_the_machine(error: BaseException) -> bool:
    """Whether an error tells what the system lacks or refuses, and nothing of a file's content."""
    if isinstance(error, MemoryError):  # also Arrow's
        return True
    if isinstance(error, OSError) and error.errno:
        return error.errno != errno.EINVAL  # as a damaged file leads to a place before its start
    return isinstance(error, RuntimeError | OSError) and bool(_NO_MEMORY.search(str(error)))


def nearest(name: str, names: Iterable[str]) -> str:
    """Return ``; did you mean ...?`` with the nearest name, or nothing if none is near."""
    close = get_close_matches(name, list(names), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def registry_names(registry: Any) -> list[str]:
    """Return the names in a registry of mmengine, its parents and their children."""
    while registry.parent is not None:
        registry = registry.parent
    family = [registry]
    for member in family:
        family += member.children.values()
    return [name for member in family for name in member.module_dict]


def _of_the_machine(error: BaseException, text: str) -> str | None:
    """Speak of memory that does not suffice, and of devices and processes that are not there."""
    reason = text.strip().splitlines()[0].rstrip(".") if text.strip() else type(error).__name__
    signals = f"{text} {error.__cause__}"
    if isinstance(error, RuntimeError) and "signal: Bus error" in signals:
        return f"bus error of a data loader's worker: {_SHORTENED}."
    if (
        isinstance(error, RuntimeError)
        and "exited unexpectedly" in text
        and "signal:" not in signals
    ):
        return f"{reason}, by a signal unknown: out of memory ({_LESS}), or {_SHORTENED}."
    if isinstance(error, RuntimeError) and _NO_HANDLES.match(text):
        return f"too many open files: raise their limit (ulimit -n), or {_FEWER}."
    speaks = isinstance(error, (RuntimeError, OSError)) and _NO_MEMORY.search(text)
    if isinstance(error, MemoryError) or speaks:
        return f"out of memory ({reason}): {_LESS}."
    if isinstance(error, RuntimeError) and _NO_PEER.search(text):
        return "another rank has ended; its own words say why."
    if isinstance(error, (RuntimeError, AssertionError)) and _NO_DEVICE.search(text):
        return f"this machine does not have the device that was asked for ({reason}): give cpu."
    return None


def _of_the_system(error: BaseException, text: str) -> str | None:
    """Speak of what the system refuses."""
    if not isinstance(error, OSError):
        return None
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{text}; {remedy}." if remedy and text.startswith("[Errno") else text
