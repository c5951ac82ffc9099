"""The settings of an original config that still have to be placed."""

from collections.abc import Iterator
from typing import Any

_REQUIRED = object()


class Fields:
    """A section of a config; what is taken or dropped is gone, the rest is left over.

    Args:
        rest: The section; changed in place.
        path: Its dotted name, for messages.
    """

    # top-level names that mean something by themselves; others are variables of the file
    RUN = (
        "_base_", "model", "data", "optimizer", "optimizer_config", "lr_config", "total_epochs",
        "runner", "evaluation", "fp16", "checkpoint_config", "log_config", "load_from",
        "resume_from", "custom_hooks", "momentum_config",
    )  # fmt: skip

    def __init__(self, rest: dict[str, Any], path: str = "") -> None:
        self.rest = rest
        self.path = path

    def section(self, *names: str) -> "Fields":
        """Return a section below this one; an empty one where there is none."""
        fields = self
        for name in names:
            value = fields.rest.get(name)
            fields = Fields(value if isinstance(value, dict) else {}, f"{fields.path}{name}.")
        return fields

    def items(self, name: str) -> list["Fields"]:
        """Return the sections of a list.

        Raises:
            ValueError: If there is no such list.
        """
        values = self.rest.get(name)
        if not isinstance(values, (list, tuple)):
            raise ValueError(f"{self.path}{name} must be a list, got {values!r}.")
        return [Fields(value, f"{self.path}{name}.{i}.") for i, value in enumerate(values)]

    def take(self, name: str, default: Any = _REQUIRED) -> Any:
        """Return a setting, which counts as placed.

        Raises:
            ValueError: If it is missing and there is no default.
        """
        if name not in self.rest and default is _REQUIRED:
            raise ValueError(f"{self.path}{name} is missing.")
        return self.rest.pop(name, default)

    def drop(self, *names: str) -> None:
        """Leave out settings that mean nothing here."""
        for name in names:
            self.rest.pop(name, None)

    def only(self, **values: Any) -> None:
        """Leave out settings that have the one value that ours has too."""
        for name, value in values.items():
            if self.rest.get(name) == value:
                self.rest.pop(name)

    def drop_without_weight(self, name: str, weight: str) -> None:
        """Leave out a part whose weight is zero."""
        if self.section(name).rest.get(weight) == 0:
            self.rest.pop(name)

    def left_over(self) -> list[str]:
        """Return dotted name and value of every setting that was not placed."""
        leaves = _leaves(self.rest, self.path.rstrip("."))
        return [f"{name} = {value!r}" for name, value in leaves if value is not None]


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested dicts and lists of dicts; what is empty holds none."""
    if isinstance(value, dict):
        pairs = [(str(key), inner) for key, inner in value.items()]
    elif isinstance(value, (list, tuple)) and all(isinstance(inner, dict) for inner in value):
        pairs = [(str(key), inner) for key, inner in enumerate(value)]
    else:
        yield path, value
        return
    for key, inner in pairs:
        yield from _leaves(inner, f"{path}.{key}" if path else key)
