"""Clear errors for configs that cannot be read, and for settings that do not fit their classes."""

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
from gsmap.utils.extras import NOT_INSTALLED
from gsmap.utils.faults import registry_names, suggestion, user_message
from gsmap.utils.overrides import find_override
from gsmap.utils.shipped import shipped_path

_BUILDER = build_from_cfg.__code__  # every registry builds its objects with this function
_RUNNER = "mmengine.runner.runner"  # compared by name, since importing the runner is slow
_CONFIGS = "mmengine.config"  # package whose modules read configs
# Exceptions that wrong settings can cause in the classes that are built from them.
_SETTINGS_ERRORS = (
    ValueError, TypeError, LookupError, RuntimeError, AttributeError, AssertionError,
    ArithmeticError, ImportError,
)  # fmt: skip
# Messages of Python (groups: function and argument) and of mmengine (group: the unknown type).
_UNEXPECTED_ARGUMENT = re.compile(r"([\w.]+)\(\) got an unexpected keyword argument '(\w+)'")
_ABSENT_TYPE = re.compile(r"(\S+) is not in the .+? registry")


class _Part(NamedTuple):
    """Part of a config that is being built: settings with a ``type``, or an object of the runner.

    Attributes:
        registry: Registry that builds the part; None for a part that is built without one.
        kind: Class of the part, or its name; None for an object of the runner.
        settings: Settings that the part is built from; None without a registry.
    """

    registry: Registry | None
    kind: Any
    settings: Any = None

    @property
    def name(self) -> str:
        """Name of the class."""
        return getattr(self.kind, "__name__", str(self.kind))


@contextmanager
def reading_config(source: object) -> Iterator[None]:
    """Add the config's name to every exception that is raised while the config is read.

    Args:
        source: Path of the config, or a description of the part that is read.

    Raises:
        ValueError: If the block raises an exception. A config is Python code, so every class of
            exception is possible.
    """
    try:
        yield
    except Exception as error:
        file = str(Path(str(source)).absolute())
        place = ""
        for frame in traceback.extract_tb(error.__traceback__):
            if frame.filename == file:
                place = f", line {frame.lineno},"  # the last match is the innermost call
        reason: BaseException = error
        if isinstance(error, ImportError) and error.__context__ is not None:
            reason = error.__context__  # mmengine's ImportError omits the cause
        # In _base_, mmengine reads ``scope::config`` for a fixed list of scopes that lacks gsmap.
        if "load gsmap config" in str(reason):
            reason = ValueError(
                f"'gsmap::' is not read in _base_; write a path below {shipped_path('configs')} "
                "instead"
            )
        advice = f"; {NOT_INSTALLED}" if isinstance(reason, ModuleNotFoundError) else ""
        raise InputError(
            f"{source}{place} cannot be used: {type(reason).__name__}: {reason}{advice}."
        ) from error


@contextmanager
def building(cfg: Config, kind: type | None = None) -> Iterator[None]:
    """Add the names of the config and of its parts to errors that are raised while they are built.

    The parts under construction are read from the traceback. This covers nested parts, and parts
    that mmengine or mmdet3d build.

    Args:
        cfg: The config.
        kind: Class that the block builds from settings directly, without a registry; None if there
            is no such class.

    Raises:
        ValueError: In place of an exception that the settings cause. A `GsmapError` keeps its
            class. Errors of the machine, such as a lack of memory, are not changed.
    """
    where = f"{cfg.filename}: " if cfg.filename else ""
    try:
        yield
    except GsmapError as error:
        text = str(error)
        # An error that names a file, such as unreadable data, is not a fault of the config.
        names_a_path = "/" in text
        if names_a_path or not _parts_under_construction(error):
            raise
        raise type(error)(f"{where}{text}") from error
    except _SETTINGS_ERRORS as error:
        parts = _parts_under_construction(error)
        if kind is not None:
            parts.append(_Part(registry=None, kind=kind))  # the outermost part
        # Errors of the machine are not changed: `user_message` already describes them to users.
        fault = None if user_message(error) else _describe_fault(error, parts=parts, cfg=cfg)
        if fault is None:
            raise
        raise InputError(f"{where}{fault}") from error


def _frames(error: BaseException) -> list[FrameType]:
    """Frames of a traceback, the innermost first."""
    frames: list[FrameType] = []
    for frame, _ in traceback.walk_tb(error.__traceback__):
        frames.append(frame)
    frames.reverse()
    return frames


def _parts_under_construction(error: BaseException) -> list[_Part]:
    """Parts that were under construction when an error was raised, the innermost first."""
    parts: list[_Part] = []
    for frame in _frames(error):
        name = frame.f_code.co_name
        if frame.f_code is _BUILDER:
            settings = frame.f_locals["cfg"]
            registry = frame.f_locals["registry"]
            kind = settings.get("type") if isinstance(settings, dict) else None
            if isinstance(kind, str):
                kind = registry.get(kind)
            parts.append(_Part(registry=registry, kind=kind, settings=settings))
        elif frame.f_globals.get("__name__") == _RUNNER and name.startswith(("build_", "__init__")):
            parts.append(_Part(registry=None, kind=None))  # the runner builds an object itself
    return parts


def _describe_fault(error: BaseException, parts: list[_Part], cfg: Config) -> str | None:
    """Describe the fault in the settings that caused an error.

    Args:
        error: Exception of Python or of a library.
        parts: Parts under construction, the innermost first.
        cfg: The config.

    Returns:
        The description; None if the error is a bug.
    """
    text = str(error)
    if isinstance(error, KeyError) and error.args:
        text = str(error.args[0])  # without the quotes of a KeyError
    scope = _frames(error)[0].f_globals  # names of the module that raised the error
    is_config_error = scope.get("__name__", "").startswith(_CONFIGS)
    if is_config_error and isinstance(error, KeyError | AttributeError):
        return f"a setting is missing: {text}."
    if not parts:  # nothing was being built, so the settings are not the cause
        return None
    typed_parts = [part for part in parts if part.kind is not None]
    unexpected = _UNEXPECTED_ARGUMENT.search(text)
    if unexpected is not None:
        return _describe_unknown_setting(
            owner=unexpected[1], name=unexpected[2], parts=typed_parts, scope=scope
        )
    absent = _ABSENT_TYPE.match(text)
    if absent is not None and parts[0].registry is not None:
        registry = parts[0].registry
        # `suggestion` starts with "; did you mean", and is empty if no name is similar.
        hint = suggestion(absent[1], names=registry_names(registry)) or "."
        return f"there is no {registry.name} of type {absent[1]!r}{hint}"
    subject = " of ".join(part.name for part in typed_parts) or "the run"
    # Place of the fault: the override of the command line that caused the error, or else the dotted
    # name of the settings of the part.
    place = find_override(error) or _find_place(cfg, parts=parts)
    settings = f"these settings ({place})" if place else "these settings"
    # A check of arguments raises ValueError itself, and its message is enough. For other classes,
    # also subclasses such as UnicodeDecodeError, the name of the class is added.
    if type(error) is ValueError:
        return f"{subject} cannot be made from {settings}: {text}"
    return (
        f"{subject} cannot be made from {settings}: {type(error).__name__}: {text} "
        "(GSMAP_TRACEBACK=1 shows where)."
    )


def _find_place(cfg: Config, parts: list[_Part]) -> str | None:
    """Find the dotted name of the innermost part whose settings are in a config."""
    for part in parts:
        if isinstance(part.settings, dict):
            for name, settings in _sections(cfg, prefix=""):
                # The part may have been built from a copy, so settings are compared by value.
                if settings == part.settings:
                    return name
    return None


def _sections(settings: Any, prefix: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the dictionaries with a ``type`` in nested settings, with their dotted names.

    Args:
        settings: Nested dictionaries and lists.
        prefix: Dotted name of ``settings``, with a final dot; empty at the top level.
    """
    items = enumerate(settings) if isinstance(settings, list | tuple) else settings.items()
    for key, value in items:
        # Names with "_" are variables of the config file. The settings have copies of them.
        if str(key).startswith("_"):
            continue
        if isinstance(value, dict) and "type" in value:
            yield f"{prefix}{key}", value
        if isinstance(value, dict | list | tuple):
            yield from _sections(value, prefix=f"{prefix}{key}.")


def _describe_unknown_setting(
    owner: str, name: str, parts: list[_Part], scope: dict[str, Any]
) -> str:
    """Describe a setting that a class or a function does not accept, with the nearest valid name.

    Args:
        owner: Name of the class with its method, or of the function.
        name: Name of the setting.
        parts: Parts under construction, the innermost first.
        scope: Global names of the module that contains the call.
    """
    class_name, _, method = owner.rpartition(".")
    target = class_name or owner
    # The module may also call the class or function directly, without a registry.
    parts = [*parts, _Part(registry=None, kind=scope.get(target))]
    valid_names: list[str] = []
    for part in parts:
        family = getattr(part.kind, "__mro__", (part.kind,))  # a function has no base classes
        if any(getattr(member, "__name__", None) == target for member in family):
            valid_names = _argument_names(family, method=method)
            break
    hint = suggestion(name, names=valid_names) or "."
    return f"{owner.removesuffix('.__init__')} has no setting {name!r}{hint}"


def _argument_names(family: tuple[Any, ...], method: str) -> list[str]:
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
            # The arguments come first among the local variables.
            names += code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return names
