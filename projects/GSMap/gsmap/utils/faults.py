"""What an exception says to a user, where it is the user's affair and not a slip in the code."""

import dis
import errno
import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from gsmap.utils.inputs import InputReplacedError

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
_UNEXPECTED = re.compile(r"([\w.]+)\(\) got an unexpected keyword argument '(\w+)'")
_IN_WORKER = "Original Traceback (most recent call last)"  # in texts of torch's DataLoader
_CHECKS = ValueError, TypeError, KeyError, RuntimeError, FloatingPointError
_SLIPS = (
    *_CHECKS, IndexError, AttributeError, AssertionError, ArithmeticError, NotImplementedError,
    ImportError,
)  # fmt: skip


def in_words(error: BaseException) -> str | None:
    """Say what is wrong, in which file, and what to do.

    Args:
        error: What a command ended with, with its traceback.

    Returns:
        The text; None for a slip in the code, whose traceback is worth more.
    """
    if hasattr(error, "words"):  # a worker of `ordered_map` had the traceback
        return error.words
    # a KeyError's own text is its message in quotes
    text = str(error.args[0] if type(error) is KeyError and error.args else error)
    scope, last = _raised_in(error)
    of_parser = isinstance(error, ValueError) and type(error) is not ValueError  # such as Arrow's
    meant = last == "RAISE_VARARGS" or of_parser  # Python itself finds the others
    if _IN_WORKER in text:  # all that torch hands on
        meant = isinstance(error, ValueError | InputReplacedError)
        text = text.rstrip().splitlines()[-1]
        text = text.partition(": ")[2]
    return (
        _of_the_machine(error, text)
        or _of_the_system(error, text)
        or _of_a_config(error, text, scope, last)
        or (text if meant and isinstance(error, _CHECKS) else None)
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


def registered(registry: Any) -> list[str]:
    """Return the names in a registry of mmengine, its parents and their children."""
    while registry.parent is not None:
        registry = registry.parent
    family = [registry]
    for member in family:
        family += member.children.values()
    return [name for member in family for name in member.module_dict]


def _raised_in(error: BaseException) -> tuple[dict[str, Any], str]:
    """Return the names of the module that an error came up in, and the instruction."""
    step = error.__traceback__
    if step is None:
        return {}, ""
    while step.tb_next is not None:
        step = step.tb_next
    return step.tb_frame.f_globals, dis.opname[step.tb_frame.f_code.co_code[step.tb_lasti]]


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


def _of_a_config(
    error: BaseException, text: str, scope: dict[str, Any], instruction: str
) -> str | None:
    """Speak of settings that nothing can be made of; `checkpoints.building` notes which."""
    config, built = getattr(error, "config", None), getattr(error, "built", [])
    where = f"{config}: " if config else ""
    module = scope.get("__name__", "")
    if module.startswith("mmengine.config.") and isinstance(error, (KeyError, AttributeError)):
        return f"{where}a setting is missing: {text}."
    handed_over = built or instruction == "CALL_FUNCTION_EX" or module.startswith("mmengine.")
    kinds = [kind for _, kind in built if kind]
    if (unknown := _UNEXPECTED.search(text)) and handed_over:
        return where + _unknown_setting(unknown[1], unknown[2], kinds, scope)
    if not built or not isinstance(error, _SLIPS):
        return None
    if absent := re.match(r"(\S+) is not in the \S+ registry", text):
        registry = built[0][0]
        close = nearest(absent[1], registered(registry))
        return f"{where}there is no {registry.name} of type {absent[1]!r}{close or '.'}"
    if instruction == "RAISE_VARARGS" and isinstance(error, _CHECKS):
        return text if "/" in text else where + text
    return (
        f"{where}{' of '.join(map(_name, kinds))} cannot be made from these settings: "
        f"{type(error).__name__}: {text} (GSMAP_TRACEBACK=1 shows where)."
    )


def _unknown_setting(owner: str, name: str, kinds: list[Any], scope: dict[str, Any]) -> str:
    """Name a setting that a class or function does not know, and the nearest one that it does."""
    place, _, method = owner.rpartition(".")
    known: list[str] = []
    for kind in (*kinds, scope.get(place or owner)):
        family = getattr(kind, "__mro__", (kind,))
        if (place or owner) in map(_name, family):
            parts = [vars(part).get(method) for part in family] if place else [kind]
            codes = [code for part in parts if (code := getattr(part, "__code__", None))]
            known = [n for c in codes for n in c.co_varnames[: c.co_argcount + c.co_kwonlyargcount]]
            break
    return f"{owner.removesuffix('.__init__')} has no setting {name!r}{nearest(name, known) or '.'}"


def _name(kind: Any) -> str:
    return getattr(kind, "__name__", str(kind))
