"""Errors of configs: a config that cannot be read, and settings from which no part can be built."""

import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from mmengine.config import Config
from mmengine.registry import Registry, build_from_cfg

from gsmap.utils.errors import GsmapError, InputError
from gsmap.utils.faults import in_words, nearest, registered
from gsmap.utils.shipped import shipped

_BUILDER = build_from_cfg.__code__  # all registries end in it, also those that classes use inside
_RUNNER = "mmengine.runner.runner"  # module of a runner, which is slow to import
_CONFIGS = "mmengine.config"
_UNFIT = (
    ValueError, TypeError, LookupError, RuntimeError, AttributeError, AssertionError,
    ArithmeticError, ImportError,
)  # fmt: skip
_UNEXPECTED = re.compile(r"([\w.]+)\(\) got an unexpected keyword argument '(\w+)'")
_ABSENT = re.compile(r"(\S+) is not in the .+? registry")


class _Part(NamedTuple):
    """A part of a config that is being built.

    Attributes:
        registry: Registry that builds it; None for a part that the runner itself makes.
        kind: Its class, or the name of it.
    """

    registry: Registry | None
    kind: Any

    @property
    def name(self) -> str:
        """Name of the class."""
        return getattr(self.kind, "__name__", str(self.kind))


@contextmanager
def reading_config(what: object) -> Iterator[None]:
    """Name the config in every exception that it raises while it is read: a config is Python.

    Args:
        what: Path of the config, or words for the part of it that is read.

    Raises:
        ValueError: If the block raises an exception.
    """
    try:
        yield
    except Exception as error:
        file = str(Path(str(what)).absolute())
        place = ""
        for frame in traceback.extract_tb(error.__traceback__):
            if frame.filename == file:
                place = f", line {frame.lineno},"  # the innermost one counts
        reason: BaseException = error
        if isinstance(error, ImportError) and error.__context__ is not None:
            reason = error.__context__  # mmengine's own does not say why an import failed
        if "load gsmap config" in str(reason):  # the scopes that it knows are fixed
            reason = ValueError(
                f"'gsmap::' is not read in _base_; write a path below {shipped('configs')} instead"
            )
        raise InputError(
            f"{what}{place} cannot be used: {type(reason).__name__}: {reason}."
        ) from error


@contextmanager
def building(cfg: Config, kind: type | None = None) -> Iterator[None]:
    """Name the config and its parts in errors that come up while parts are built of settings.

    Which parts were being built is read from the traceback, so that parts inside of parts are
    named as well, also where mmengine and mmdet3d build them.

    Args:
        cfg: The config.
        kind: Class that the block makes of settings without a registry.

    Raises:
        ValueError: In place of an exception that the settings cause. Errors of ours keep their
            class, and errors of the machine stay as they are.
    """
    where = f"{cfg.filename}: " if cfg.filename else ""
    try:
        yield
    except GsmapError as error:
        text = str(error)
        if "/" in text or not _parts_under_way(error):  # a text with a path names its place
            raise
        raise type(error)(f"{where}{text}") from error
    except _UNFIT as error:
        parts = _parts_under_way(error)
        if kind is not None:
            parts.append(_Part(registry=None, kind=kind))
        fault = None if in_words(error) else _fault_in_settings(error, parts)
        if fault is None:
            raise
        raise InputError(f"{where}{fault}") from error


def _frames(error: BaseException) -> list[FrameType]:
    """Frames of a traceback, the innermost first."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return frames[::-1]


def _parts_under_way(error: BaseException) -> list[_Part]:
    """Parts that were being built where an error came up, the innermost first."""
    parts: list[_Part] = []
    for frame in _frames(error):
        name = frame.f_code.co_name
        if frame.f_code is _BUILDER:
            settings = frame.f_locals["cfg"]
            registry = frame.f_locals["registry"]
            kind = settings.get("type") if isinstance(settings, dict) else None
            kind = registry.get(kind) if isinstance(kind, str) else kind
            parts.append(_Part(registry, kind))
        elif frame.f_globals.get("__name__") == _RUNNER and name.startswith(("build_", "__init__")):
            parts.append(_Part(registry=None, kind=None))
    return parts


def _fault_in_settings(error: BaseException, parts: list[_Part]) -> str | None:
    """Return the fault in the settings that an error is due to; None if it is a bug.

    Args:
        error: An exception of Python or of a library.
        parts: Parts that were being built, the innermost first.
    """
    text = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    scope = _frames(error)[0].f_globals
    of_config = scope.get("__name__", "").startswith(_CONFIGS)
    if of_config and isinstance(error, KeyError | AttributeError):
        return f"a setting is missing: {text}."
    if not parts:
        return None
    kinds = [part for part in parts if part.kind is not None]
    unknown = _UNEXPECTED.search(text)
    if unknown is not None:
        return _unknown_setting(unknown[1], unknown[2], kinds, scope)
    absent = _ABSENT.match(text)
    if absent is not None and parts[0].registry is not None:
        registry = parts[0].registry
        close = nearest(absent[1], registered(registry))
        return f"there is no {registry.name} of type {absent[1]!r}{close or '.'}"
    named = " of ".join(part.name for part in kinds) or "the run"
    if type(error) is ValueError:  # a check of a class that is not ours
        return f"{named} cannot be made from these settings: {text}"
    return (
        f"{named} cannot be made from these settings: {type(error).__name__}: {text} "
        "(GSMAP_TRACEBACK=1 shows where)."
    )


def _unknown_setting(owner: str, name: str, parts: list[_Part], scope: dict[str, Any]) -> str:
    """Name a setting that a class or a function does not have, and the nearest that it has.

    Args:
        owner: Name of the class with its method, or of the function.
        name: The setting.
        parts: Parts that were being built, the innermost first.
        scope: Names of the module where the call stands.
    """
    place, _, method = owner.rpartition(".")
    called = place or owner
    candidates = [part.kind for part in parts]
    candidates.append(scope.get(called))
    known: list[str] = []
    for kind in candidates:
        family = getattr(kind, "__mro__", (kind,))
        if called in [getattr(member, "__name__", None) for member in family]:
            known = _settings_of(family, method)
            break
    return f"{owner.removesuffix('.__init__')} has no setting {name!r}{nearest(name, known) or '.'}"


def _settings_of(family: tuple[Any, ...], method: str) -> list[str]:
    """Names of the arguments of a method in a class and its bases, or of a function.

    Args:
        family: The class and its bases, or the function alone.
        method: Name of the method; empty for a function.
    """
    names: list[str] = []
    for member in family:
        function = vars(member).get(method) if method else member
        code = getattr(function, "__code__", None)
        if code is not None:
            names += code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return names
