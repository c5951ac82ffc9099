"""One-line messages for errors that a user can cause; every other exception is a bug."""

import errno
import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from gsmap.utils.errors import GsmapError

# The constants below are parts of messages to the user.
_FREE_SPACE = "free some space there, or write elsewhere"
_REDUCE_MEMORY = (
    "take a smaller batch (train_dataloader.batch_size=1), fewer processes (num_workers, "
    "--workers) or smaller images"
)
_BUS_ERROR_ADVICE = (
    "a data file was shortened while it was read (stop the program that writes to it, and make the "
    "file again), or /dev/shm is full (take fewer num_workers)"
)
_FEWER_PROCESSES = "use fewer processes (num_workers, --workers)"
# Remedy for each code of a system error.
_REMEDIES = {
    errno.ENOSPC: _FREE_SPACE,
    errno.EDQUOT: _FREE_SPACE,
    errno.EFBIG: _FREE_SPACE,
    errno.EACCES: "choose a place that you may read and write",
    errno.EPERM: "choose a place that you may read and write",
    errno.EROFS: "choose a place where you may write",
    errno.EISDIR: "name a file in it",
    errno.ENOTDIR: "a part of that path is a file",
    errno.EEXIST: "choose another name or remove it",
    errno.ENOENT: "check the path",
    errno.EMFILE: _FEWER_PROCESSES,
    errno.ENFILE: _FEWER_PROCESSES,
    errno.ENOMEM: _FEWER_PROCESSES,
}
# Patterns that recognise the messages of torch and other libraries. The libraries raise general
# classes such as ``RuntimeError`` for these faults.
_NO_MEMORY = re.compile(
    r"out of memory|(can't|Cannot|cannot) allocate memory|not enough memory|DataLoader worker \(pid"
)
_NO_HANDLES = re.compile("Too many open files. Communication with the workers")  # message of torch
_NO_DEVICE = re.compile(
    "not compiled with CUDA|no NVIDIA driver|No CUDA GPUs|invalid device ordinal|device string"
)
# A rank is a process of distributed training. It raises such an error after another one has died.
_NO_PEER = re.compile(r"gloo.*(closed|reset) by peer|NCCL.*remote process", flags=re.DOTALL)
# Part of the message of an error that was raised in a worker process of a DataLoader.
_IN_WORKER = "Original Traceback (most recent call last)"


def user_message(error: BaseException) -> str | None:
    """Return the message of an error that a user can cause.

    Such errors are this package's errors (`GsmapError`), system errors (``OSError``), and library
    errors that report a lack of memory, a missing device or a dead process. Code that calls a
    library with a user's content converts other library errors to `GsmapError` itself.

    Args:
        error: Exception that ended a command.

    Returns:
        The message, or None for a bug, which keeps its traceback.
    """
    text = str(error)
    if _IN_WORKER in text:  # torch re-raises the class with a traceback as its message
        # The last line of a traceback is "class: message".
        last_line = text.rstrip().splitlines()[-1]
        _, _, text = last_line.partition(": ")
    # The more specific description comes first: a lack of memory may also be a system error.
    message = _describe_machine_error(error=error, text=text)
    if message is None:
        message = _describe_system_error(error=error, text=text)
    if message:
        return message
    return text if isinstance(error, GsmapError) else None


def is_machine_error(error: BaseException) -> bool:
    """Whether an error comes from the machine, not from the content of a file.

    Examples are a lack of memory, a missing file and missing permissions. Code that reports damaged
    files uses this function to leave such errors unchanged.
    """
    if isinstance(error, MemoryError):  # also raised by Arrow
        return True
    if isinstance(error, OSError) and error.errno:
        # EINVAL is raised for a negative position in a file, which a damaged file can cause.
        return error.errno != errno.EINVAL
    # An error without a code of the system, such as an error of a library.
    return isinstance(error, RuntimeError | OSError) and bool(_NO_MEMORY.search(str(error)))


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return ``; did you mean ...?`` with the most similar name, or an empty text without one.

    Args:
        name: Unknown name.
        names: Known names.
    """
    matches = get_close_matches(word=name, possibilities=list(names), n=1)
    return f"; did you mean {matches[0]!r}?" if matches else ""


def registry_names(registry: Any) -> list[str]:
    """Return the names in a registry of mmengine, its root and all registries below the root.

    mmengine searches all of them for the class of a part, so each name is a possible suggestion.
    """
    root = registry
    while root.parent is not None:
        root = root.parent
    family = [root]
    for member in family:  # the list grows during the loop
        family.extend(member.children.values())
    names = []
    for member in family:
        names.extend(member.module_dict)
    return names


def _describe_machine_error(error: BaseException, text: str) -> str | None:
    """Describe a lack of memory or of file handles, a missing device or a dead process.

    Args:
        error: Exception.
        text: Message of the exception, without the traceback of a worker.

    Returns:
        The description with a remedy, or None for other errors.
    """
    is_runtime_error = isinstance(error, RuntimeError)
    reason = type(error).__name__  # for an error without a message
    if text.strip():
        first_line = text.strip().splitlines()[0]
        reason = first_line.rstrip(".")
    # When a worker has died, the message of torch's DataLoader is either "DataLoader worker (pid 7)
    # is killed by signal: Bus error." or "DataLoader worker (pid(s) 7) exited unexpectedly". An
    # error with the second message may be caused by one with the first, which names the signal.
    text_and_cause = f"{text} {error.__cause__}"
    if is_runtime_error and "signal: Bus error" in text_and_cause:
        return f"bus error of a data loader's worker: {_BUS_ERROR_ADVICE}."
    if is_runtime_error and "exited unexpectedly" in text and "signal:" not in text_and_cause:
        return (
            f"{reason}, and its signal is unknown: either the memory was full ({_REDUCE_MEMORY}), "
            f"or {_BUS_ERROR_ADVICE}."
        )
    if is_runtime_error and _NO_HANDLES.match(text):
        return f"too many open files: raise their limit (ulimit -n), or {_FEWER_PROCESSES}."
    reports_memory = isinstance(error, (RuntimeError, OSError)) and _NO_MEMORY.search(text)
    if isinstance(error, MemoryError) or reports_memory:
        return f"out of memory ({reason}): {_REDUCE_MEMORY}."
    if is_runtime_error and _NO_PEER.search(text):
        return "another rank has ended; its own message says why."
    if isinstance(error, (RuntimeError, AssertionError)) and _NO_DEVICE.search(text):
        return f"this machine does not have the device that was asked for ({reason}): give cpu."
    return None


def _describe_system_error(error: BaseException, text: str) -> str | None:
    """Describe an error of the operating system, with a remedy if there is one for its code.

    Messages with another beginning than ``[Errno`` are texts of this package, which have a remedy.

    Returns:
        The description, or None for other errors.
    """
    if not isinstance(error, OSError):
        return None
    remedy = _REMEDIES.get(error.errno or 0)  # 0, which is no code, for an error without a code
    if remedy and text.startswith("[Errno"):
        return f"{text}; {remedy}."
    return text
