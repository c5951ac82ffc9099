"""What an exception says to a user, where it is the user's affair and not a slip in the code."""

import errno
import re
import traceback
from collections.abc import Iterable
from difflib import get_close_matches
from io import IOBase
from pathlib import PurePath
from types import FrameType
from typing import Any

_FULL = "free some space there, or write elsewhere"
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
    errno.EMFILE: "use fewer processes (num_workers, --workers)",
}
_NO_MEMORY = re.compile(
    r"out of memory|(can't|Cannot|cannot) allocate memory|not enough memory|DataLoader worker \(pid"
)
_NO_DEVICE = re.compile(
    "not compiled with CUDA|no NVIDIA driver|No CUDA GPUs|invalid device ordinal|device string"
)
_NO_PEER = re.compile(r"gloo.*(closed|reset) by peer|NCCL.*remote process", re.DOTALL)
_UNEXPECTED = re.compile(r"([\w.]+)\(\) got an unexpected keyword argument '(\w+)'")
_IN_WORKER = "Original Traceback (most recent call last)"  # in texts of torch's DataLoader
_BUILDER = "build_from_cfg"  # mmengine's function that makes an object from a config's settings
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
    # a KeyError's own text is its message in quotes
    text = str(error.args[0] if type(error) is KeyError and error.args else error)
    if _IN_WORKER in text:
        raised, text = _is_raised(text), text.rstrip().splitlines()[-1].partition(": ")[2]
    elif type(error.__cause__).__name__ == "_RemoteTraceback":
        raised = _is_raised(str(error.__cause__))
    else:
        raised = _is_raised("".join(traceback.format_tb(error.__traceback__)))
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return (
        _of_the_machine(error, text)
        or _of_a_file(error, text, frames)
        or _of_a_config(error, text, frames, raised)
        or (text if raised and isinstance(error, _CHECKS) else None)
    )


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


def _is_raised(tracebacks: str) -> bool:
    """Whether a ``raise`` statement stands at the end, and not what Python itself found."""
    statements = re.findall(r'^  File ".*\n    (.*)', tracebacks, re.MULTILINE)
    return bool(statements) and statements[-1].startswith("raise ")


def _of_the_machine(error: BaseException, text: str) -> str | None:
    """Speak of memory that does not suffice, and of devices and processes that are not there."""
    reason = text.strip().splitlines()[0].rstrip(".") if text.strip() else type(error).__name__
    if isinstance(error, RuntimeError) and "signal: Bus error" in f"{text} {error.__cause__}":
        return (
            "bus error of a data loader's worker: a data file was shortened while it was read (end "
            "what writes there, make it again), or /dev/shm is full (take fewer num_workers)."
        )
    speaks = isinstance(error, (RuntimeError, OSError)) and _NO_MEMORY.search(text)
    if isinstance(error, MemoryError) or speaks:
        return (
            f"out of memory ({reason}): take a smaller batch (train_dataloader.batch_size=1), "
            "fewer processes (num_workers, --workers) or smaller images."
        )
    if isinstance(error, RuntimeError) and _NO_PEER.search(text):
        return "another rank has ended; its own words say why."
    if isinstance(error, (RuntimeError, AssertionError)) and _NO_DEVICE.search(text):
        return f"this machine does not have the device that was asked for ({reason}): give cpu."
    return None


def _of_a_file(error: BaseException, text: str, frames: list[FrameType]) -> str | None:
    """Speak of what the system or a parser says, with the file's name."""
    if isinstance(error, OSError):
        remedy = _REMEDIES.get(error.errno or 0)
        if not remedy or not text.startswith("[Errno"):
            return text
        parts = (value for frame in reversed(frames) for value in frame.f_locals.values())
        files = (getattr(part, "name", None) for part in parts if isinstance(part, IOBase))
        name = error.filename or next((name for name in files if isinstance(name, str)), "")
        named = "" if not name or str(name) in text else f": {name!r}"
        return f"{text}{named}; {remedy}."
    if frames and frames[-1].f_globals.get("__name__") == "json.decoder":
        text = "it is nested too deep" if isinstance(error, RecursionError) else text
    elif not isinstance(error, ValueError) or type(error) is ValueError:
        return None
    names = ("self", "path", "source")
    found = (frame.f_locals.get(name) for frame in reversed(frames) for name in names)
    path = next((str(value) for value in found if isinstance(value, PurePath)), "")
    return text if path in text else f"{path} cannot be read: {text}."


def _of_a_config(
    error: BaseException, text: str, frames: list[FrameType], raised: bool
) -> str | None:
    """Speak of settings that nothing can be made of."""
    built = [frame.f_locals for frame in frames if frame.f_code.co_name == _BUILDER]
    last = traceback.extract_tb(error.__traceback__)[-1:]
    source, line = (last[0].filename, last[0].line or "") if last else ("", "")
    where = _config_file(frames)
    if "/mmengine/config/" in source and isinstance(error, (KeyError, AttributeError)):
        return f"{where}a setting is missing: {text}."
    if (unknown := _UNEXPECTED.search(text)) and (built or "/mmengine/" in source or "**" in line):
        return where + _unknown_setting(unknown[1], unknown[2], built, frames)
    if not built or not isinstance(error, _SLIPS):
        return None
    if absent := re.match(r"(\S+) is not in the \S+ registry", text):
        registry = built[-1]["registry"]
        close = nearest(absent[1], registered(registry))
        return f"{where}there is no {registry.name} of type {absent[1]!r}{close or '.'}"
    if raised and isinstance(error, _CHECKS):
        return text if "/" in text else where + text
    kinds = [_name(frame["obj_cls"]) for frame in reversed(built) if frame.get("obj_cls")]
    return (
        f"{where}{' of '.join(kinds)} cannot be made from these settings: {type(error).__name__}: "
        f"{text} (GSMAP_TRACEBACK=1 shows where)."
    )


def _config_file(frames: list[FrameType]) -> str:
    """Return the name of the config that a command works with, and a colon."""
    for frame in reversed(frames):
        own = getattr(frame.f_locals.get("self"), "__dict__", {})
        for holder in (frame.f_locals.get("cfg"), own.get("cfg")):
            name = getattr(holder, "filename", None)
            if isinstance(name, str):
                return f"{name}: "
    return ""


def _unknown_setting(
    owner: str, name: str, built: list[dict[str, Any]], frames: list[FrameType]
) -> str:
    """Name a setting that a class or function does not know, and the nearest one that it does."""
    place, _, method = owner.rpartition(".")
    last = frames[-1]
    near = type(last.f_locals.get("self")), last.f_globals.get(place or owner)
    known: list[str] = []
    for kind in (*(frame.get("obj_cls") for frame in reversed(built)), *near):
        family = getattr(kind, "__mro__", (kind,))
        if (place or owner) in map(_name, family):
            parts = [vars(part).get(method) for part in family] if place else [kind]
            codes = [code for part in parts if (code := getattr(part, "__code__", None))]
            known = [n for c in codes for n in c.co_varnames[: c.co_argcount + c.co_kwonlyargcount]]
            break
    return f"{owner.removesuffix('.__init__')} has no setting {name!r}{nearest(name, known) or '.'}"


def _name(kind: Any) -> str:
    return getattr(kind, "__name__", str(kind))
