"""Overrides of a config (``--cfg-options``): checks of their kinds, and the errors they cause."""

import os
import traceback
from collections.abc import Iterator, Mapping
from types import FrameType
from typing import Any, ClassVar

from gsmap.utils.errors import InputError

_NUMBER_WORDS = ("auto", "cores", "dynamic")  # texts that some settings take in place of a number
# Number of frames (calls on the stack) that are searched, from the one that raises the error.
_SEARCHED_FRAMES = 10
# Last parts of the names that are not searched, because other options of commands set these values.
_UNSUSPECTED = ("data_root", "image_scale")


class _Command:
    """Overrides of the running command, by dotted name, such as ``model.map_head.num_points``.

    The class is never instantiated. It holds the one value of the process.
    """

    overrides: ClassVar[dict[str, Any]] = {}


def declare_overrides(overrides: Mapping[str, Any]) -> None:
    """Declare the overrides of the running command, for `describe_override`.

    Args:
        overrides: Values by dotted name; empty at the end of a command.
    """
    _Command.overrides = dict(overrides)


def check_kinds(settings: Any, overrides: Mapping[str, Any], source: str) -> None:
    """Refuse overrides whose kind differs from the kind of the value that they replace.

    A number cannot become a dictionary, nor a text other than ``auto``, ``cores`` or ``dynamic``. A
    boolean cannot become a text, a dictionary or a list. A list cannot become a text. A
    dictionary or a list of dictionaries can only become a dictionary or a list of dictionaries.
    Every value may become None. The value None, and a value that the settings do not have, may
    become anything.

    Args:
        settings: Config before the overrides.
        overrides: Values by dotted name.
        source: Name of the config, for the error.

    Raises:
        ValueError: If the kinds differ.
    """
    for name, value in overrides.items():
        old_value = _find_value(settings, keys=name.split("."))
        wanted = _wanted_kind(old_value, value)
        if wanted is not None:
            raise InputError(
                f"--cfg-options {name} must be {wanted}, got {value!r:.60}: it is "
                f"{old_value!r:.60} in {source}."
            )


def _find_value(settings: Any, keys: list[str]) -> Any:
    """Return the value under nested keys and indices; None if there is no such value."""
    for key in keys:
        if isinstance(settings, Mapping):
            settings = settings.get(key)
        elif isinstance(settings, list | tuple) and key.isdigit() and int(key) < len(settings):
            settings = settings[int(key)]
        else:
            return None
    return settings


def _wanted_kind(old_value: Any, value: Any) -> str | None:
    """Return the kind that a new value must have; None if it can replace the old one."""
    if value is None:
        return None
    is_number = isinstance(old_value, int | float) and not isinstance(old_value, bool)
    if is_number and isinstance(value, str | dict) and value not in _NUMBER_WORDS:
        return "a number"
    if isinstance(old_value, bool) and isinstance(value, str | list | tuple | dict):
        return "True or False"
    if _holds_sections(old_value):
        fits = _is_section(value) or _holds_sections(value)
        return None if fits else "dict(...) or a list of it"
    if isinstance(old_value, list | tuple) and isinstance(value, str):
        return f"a list, such as [{value}]"
    return None


def _is_section(value: Any) -> bool:
    """Whether a value is a section (a dictionary), or an empty list of sections."""
    return isinstance(value, dict) or value in ([], ())


def _holds_sections(value: Any) -> bool:
    """Whether a value is a section (a dictionary), or a list of sections that is not empty."""
    if isinstance(value, dict):
        return True
    is_list = isinstance(value, list | tuple) and len(value) > 0
    return is_list and all(isinstance(item, dict) for item in value)


def find_override(error: BaseException) -> str | None:
    """Find the override that the code used when it raised an error.

    The innermost frames of the error and of its cause are searched, up to the loop over batches,
    for a variable, an attribute of ``self`` or an entry of a dictionary with the name and the value
    of an override.

    Args:
        error: Exception.

    Returns:
        The override as ``NAME=VALUE``; None if no frame uses one.
    """
    suspects = {}  # last part of the name, and value, of each override by its full name
    for name, value in _Command.overrides.items():
        keys = [key for key in name.split(".") if not key.isdigit()]
        if keys and keys[-1] not in _UNSUSPECTED:
            suspects[name] = (keys[-1], value)
    if not suspects:
        return None
    for number, frame in enumerate(_frames(error)):
        # mmengine's loop has the settings of all parts, so a value that is found there does not
        # show which code uses it. The frame that raises the error is searched even if it is of the
        # loop.
        reaches_loop = number > 0 and _is_of_loop(frame)
        if number == _SEARCHED_FRAMES or reaches_loop:
            break
        scopes = list(_scopes(frame))
        for name, (key, value) in suspects.items():
            if any(_has_value(scope, key=key, value=value) for scope in scopes):
                return f"{name}={value!r:.60}"
    return None


def describe_override(error: BaseException) -> str | None:
    """Describe an error that an override causes.

    Args:
        error: Exception that ended a command, and that no other code describes to the user.

    Returns:
        One sentence with the override; None if no override is involved, or if
        ``GSMAP_TRACEBACK`` asks for tracebacks.
    """
    if os.environ.get("GSMAP_TRACEBACK"):
        return None
    override = find_override(error)
    if override is None:
        return None
    reason = type(error).__name__
    text, _, _ = str(error).strip().partition("\n")
    if text:
        reason = f"{reason}: {text:.300}"
    return (
        f"{reason}, in code that uses --cfg-options {override}: check this value "
        "(GSMAP_TRACEBACK=1 shows where)."
    )


def _frames(error: BaseException) -> Iterator[FrameType]:
    """Yield the frames of an error after the frames of its cause, both from the innermost one."""
    # For an error of a hook, mmengine raises another error, whose cause is the original one.
    cause = error.__cause__ or error.__context__
    if cause is not None:
        yield from _frames(cause)
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    yield from reversed(frames)


def _is_of_loop(frame: FrameType) -> bool:
    """Whether a frame is of mmengine's runner or loops, which have the settings of all parts."""
    return str(frame.f_globals.get("__name__")).startswith("mmengine.runner")


def _scopes(frame: FrameType) -> Iterator[Mapping[str, Any]]:
    """Yield the variables of a frame, the attributes of ``self``, and dictionaries in both."""
    scopes: list[Mapping[str, Any]] = [frame.f_locals]
    owner = frame.f_locals.get("self")
    if hasattr(owner, "__dict__"):
        scopes.append(vars(owner))
    for scope in scopes:
        yield scope
        for value in list(scope.values()):
            if isinstance(value, dict):
                yield value


def _has_value(scope: Mapping[str, Any], key: str, value: Any) -> bool:
    """Whether a scope has a value under a name, with or without a leading underscore."""
    for name in (key, f"_{key}"):
        candidate = scope.get(name)
        # A part may convert a list of the config to a tuple, so containers may differ in type.
        # Otherwise types must be equal, because True == 1. Texts are compared, because == does not
        # return a boolean for arrays in a container.
        may_be_equal = type(candidate) is type(value) or isinstance(candidate, list | tuple | dict)
        if may_be_equal and repr(_plain(candidate)) == repr(_plain(value)):
            return True
    return False


def _plain(value: Any) -> Any:
    """Convert tuples and subclasses of dictionaries in a value to lists and dictionaries."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value
