"""Settings of a method's original config that are not converted to GSMap settings yet."""

from collections.abc import Collection, Iterator
from typing import Any

from gsmap.utils.errors import InputError

_REQUIRED = object()  # default of a setting that must exist, as None may be a value


class Fields:
    """Settings of a config by dotted name.

    Settings that are taken or dropped are removed from ``values``. The settings that remain after
    the conversion have no counterpart in GSMap. A number in a name is an index of a list.

    Args:
        values: Settings of the config, nested dicts and lists. Modified in place.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values
        self._notes: list[str] = []

    def section(self, name: str) -> dict[str, Any]:
        """Look up the settings below a name.

        Args:
            name: Dotted name, such as ``model.pts_bbox_head``.

        Returns:
            The dict in the config itself, not a copy, so that entries can be removed from it. An
            empty dict if the name does not exist or is not the name of a dict.
        """
        value: Any = self._values
        for key in name.split("."):
            if isinstance(value, (list, tuple)):
                value = dict(enumerate(value)).get(int(key))  # None beyond the end of the list
            elif isinstance(value, dict):
                value = value.get(key)
            else:
                return {}
        return value if isinstance(value, dict) else {}

    def take(self, name: str, default: Any = _REQUIRED) -> Any:
        """Remove a setting and return its value.

        Args:
            name: Dotted name.
            default: Value if the setting is missing.

        Raises:
            ValueError: If the setting is missing and there is no default.
        """
        section, _, key = name.rpartition(".")
        values = self.section(section) if section else self._values
        if key not in values and default is _REQUIRED:
            raise InputError(f"{name} is missing.")
        return values.pop(key, default)

    def items(self, name: str) -> list[str]:
        """List the dotted names of the items of a list, such as ``data.train.pipeline.0``.

        Args:
            name: Dotted name of the list, with at least one dot.

        Raises:
            ValueError: If the setting is missing or not a list.
        """
        section, _, key = name.rpartition(".")
        values = self.section(section).get(key)
        if not isinstance(values, (list, tuple)):
            raise InputError(f"{name} must be a list, got {values!r}.")
        return [f"{name}.{i}" for i in range(len(values))]

    def move(self, new_names: dict[str, str], required: bool = True) -> dict[str, Any]:
        """Take settings and rename them.

        Args:
            new_names: Dotted names in GSMap, by dotted name.
            required: Whether a missing setting is an error. Otherwise missing settings and None
                are left out.

        Returns:
            Values by dotted name in GSMap.

        Raises:
            ValueError: If a required setting is missing.
        """
        default = _REQUIRED if required else None
        settings = {}
        for name, new_name in new_names.items():
            value = self.take(name, default=default)
            if required or value is not None:
                settings[new_name] = value
        return settings

    def drop(self, section: str, names: str = "", **fixed: Any) -> None:
        """Remove settings without a counterpart in GSMap.

        Args:
            section: Dotted name of the section of the settings.
            names: Names of settings to remove, separated by spaces.
            fixed: Settings to remove if they have the given values, the only values that GSMap
                supports.
        """
        values = self.section(section)
        for name in names.split():
            values.pop(name, None)
        for name, value in fixed.items():  # any other value remains, and is reported as left over
            if name in values and _as_list(values[name]) == _as_list(value):
                values.pop(name)

    def drop_type(self, section: str, types: Collection[str]) -> None:
        """Remove the type of a part if it is supported. Another type remains.

        Args:
            section: Dotted name of the section of the part.
            types: Supported types.
        """
        values = self.section(section)
        if values.get("type") in types:
            values.pop("type")

    def note(self, name: str, value: Any) -> None:
        """Add a line to the remaining settings, for a value that is not in the config itself.

        Args:
            name: Dotted name.
            value: Value, also None, which is the value of a missing setting.
        """
        self._notes.append(f"{name} = {value!r}")

    def left_over(self) -> list[str]:
        """List the remaining settings except None, and the notes, each as ``name = value``."""
        lines = []
        for name, value in _leaves(self._values, path=""):
            if value is not None:
                lines.append(f"{name} = {value!r}")
        return lines + self._notes


def _as_list(value: Any) -> Any:
    """Convert a tuple to a list, since configs have either."""
    return list(value) if isinstance(value, tuple) else value


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of each leaf of nested dicts and lists of dicts.

    Other lists are leaves. Empty dicts and lists have no leaves.

    Args:
        value: Dict, list or leaf.
        path: Dotted name of ``value``.
    """
    if isinstance(value, (list, tuple)) and all(isinstance(inner, dict) for inner in value):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield path, value
        return
    for key, inner in value.items():
        yield from _leaves(inner, path=f"{path}.{key}" if path else str(key))
