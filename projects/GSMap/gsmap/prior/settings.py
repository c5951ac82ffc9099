"""Settings of a map prior: its classes, its global frame and its cells."""

from dataclasses import dataclass
from typing import Any

from gsmap.utils.errors import InputError

_MOST_CLASSES = 64
_MOST_TILE_CELLS = 1024
_LONGEST_NAME = 200  # letters


@dataclass(frozen=True)
class PriorSettings:
    """Classes, global frame and cells of a map prior.

    Args:
        classes: Names of the classes. Each class is a channel of the prior.
        place: Name of the global frame of the poses, such as the name of a city or a map.
        cell_m: Side of a cell in metres, in [0.01, 10].
        tile_m: Side of a tile (square of cells) in metres: a multiple of ``cell_m``, 1 to 1024
            cells.

    Raises:
        ValueError: If there are no classes, more than 64, or two of one name; if a name is not
            printable, empty or longer than 200 letters; or if ``cell_m`` or ``tile_m`` is no number
            or out of range.
    """

    classes: tuple[str, ...]
    place: str
    cell_m: float = 0.3
    tile_m: float = 60.0

    def __post_init__(self) -> None:
        classes = tuple(self.classes)  # a list is accepted, too
        object.__setattr__(self, "classes", classes)  # the dataclass is frozen
        if not 1 <= len(classes) <= _MOST_CLASSES or len(set(classes)) != len(classes):
            raise InputError(
                f"classes must be 1 to {_MOST_CLASSES} different names, got {len(classes)}."
            )
        for name in (*classes, self.place):
            _require_name(name)
        for name in ("cell_m", "tile_m"):
            _require_number(name, getattr(self, name))
        if not 0.01 <= self.cell_m <= 10:
            raise InputError(f"cell_m must be in [0.01, 10], got {self.cell_m}.")
        cells = self.tile_m / self.cell_m
        is_possible = 0.5 < cells < _MOST_TILE_CELLS + 0.5
        if not is_possible or abs(cells - round(cells)) > 1e-6:  # the quotient is rounded
            raise InputError(
                f"tile_m must be 1 to {_MOST_TILE_CELLS} cells of {self.cell_m:g} m, got "
                f"{self.tile_m:g} m."
            )

    @property
    def tile_cells(self) -> int:
        """Number of cells along a side of a tile."""
        return round(self.tile_m / self.cell_m)

    def require_equal(self, other: "PriorSettings", where: str) -> None:
        """Check that the settings of another prior are equal to these settings.

        Args:
            other: Settings of the other prior, such as one that was read from a file.
            where: Name of the file or of the other prior, for the message.

        Raises:
            ValueError: If a value differs.
        """
        for name in ("classes", "place", "cell_m", "tile_m"):
            expected = getattr(self, name)
            other_value = getattr(other, name)
            if other_value != expected:
                raise InputError(
                    f"{where} has {name} {other_value!r}, and {expected!r} is needed: give a prior "
                    f"with {name} {expected!r}, or build one."
                )


def _require_name(name: Any) -> None:
    """Check that a value is a printable name of 1 to 200 letters."""
    if not isinstance(name, str) or not name.isprintable() or not 1 <= len(name) <= _LONGEST_NAME:
        raise InputError(
            f"classes and place must be printable names of 1 to {_LONGEST_NAME} letters."
        )


def _require_number(name: str, value: Any) -> None:
    """Check that a value is a number, and not True or False, which are integers in Python."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{name} must be a number.")
