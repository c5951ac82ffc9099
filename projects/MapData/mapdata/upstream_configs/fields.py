"""The settings of an original config that still have to be placed."""

from collections.abc import Iterator
from typing import Any

from gsmap.utils.errors import InputError

_REQUIRED = object()


class Fields:
    """A config's settings by dotted name; what is taken or dropped is gone, the rest is left over.

    A number in a name is a place in a list. The dict that is given is used up.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def section(self, name: str) -> dict[str, Any]:
        """Return the settings below a name; an empty dict where there are none."""
        value: Any = self._values
        for key in name.split("."):
            if isinstance(value, (list, tuple)):
                value = dict(enumerate(value)).get(int(key))
            else:
                value = value.get(key) if isinstance(value, dict) else None
        return value if isinstance(value, dict) else {}

    def take(self, name: str, default: Any = _REQUIRED) -> Any:
        """Return a setting, which counts as placed; ValueError if it must be there and is not."""
        section, _, key = name.rpartition(".")
        values = self.section(section) if section else self._values
        if key not in values and default is _REQUIRED:
            raise InputError(f"{name} is missing.")
        return values.pop(key, default)

    def items(self, name: str) -> list[str]:
        """Return the names of a list's items; ValueError if there is no such list."""
        section, _, key = name.rpartition(".")
        values = self.section(section).get(key)
        if not isinstance(values, (list, tuple)):
            raise InputError(f"{name} must be a list, got {values!r}.")
        return [f"{name}.{i}" for i in range(len(values))]

    def move(self, places: dict[str, str], required: bool = True) -> dict[str, Any]:
        """Take settings by their names and return them by their new ones."""
        default = _REQUIRED if required else None
        found = {new: self.take(name, default) for name, new in places.items()}
        return {name: value for name, value in found.items() if required or value is not None}

    def drop(self, section: str, names: str = "", **fixed: Any) -> None:
        """Leave out settings of a section that mean nothing here, named with spaces between.

        Of those in ``fixed`` this holds for one value, which ours has too.
        """
        found = self.section(section)
        for name in names.split():
            found.pop(name, None)
        for name, value in fixed.items():
            if found.get(name) == value:
                found.pop(name)

    def left_over(self) -> list[str]:
        """Return dotted name and value of every setting that was not placed."""
        return [f"{name} = {v!r}" for name, v in _leaves(self._values, "") if v is not None]


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested dicts and lists of dicts; what is empty holds none."""
    if isinstance(value, (list, tuple)) and all(isinstance(inner, dict) for inner in value):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield path, value
        return
    for key, inner in value.items():
        yield from _leaves(inner, f"{path}.{key}" if path else str(key))
