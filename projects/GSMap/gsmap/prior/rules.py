"""Rules that update the cells of a map prior with the prediction of a frame."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

Floats = NDArray[np.float32]
States = NDArray[np.uint8]


class WriteRule:
    """Rule that updates the cells in view and converts their states to values in [0, 1].

    The state of a cell consists of S stored numbers for each map class. The value of a cell is the
    belief in [0, 1] that the class is there. A prediction above 0 is a hit, and 0 is a miss.

    A subclass is a dataclass whose fields are numbers; the file of a prior stores them. In the
    shapes below, C is the number of map classes and n the number of cells.

    Attributes:
        num_states: Number S of stored numbers (uint8) per cell and class.
        empty: Stored number of a cell that has never been in view.
    """

    num_states: ClassVar[int] = 1
    empty: ClassVar[int] = 0

    def update(self, states: States, values: Floats) -> States:
        """Update cells that are in view.

        Args:
            states: States before the frame. (S, C, n)
            values: Prediction of the frame in [0, 1]; 0 is a miss. (C, n)

        Returns:
            States after the frame. (S, C, n)
        """
        raise NotImplementedError

    def read(self, states: States) -> Floats:
        """Convert states to values in [0, 1]. (S, C, ...) -> (C, ...)"""
        raise NotImplementedError


@dataclass(frozen=True)
class KeepMaximum(WriteRule):
    """Largest prediction so far, in steps of 1 / 255: the rule of HRMapNet's training.

    The value of a cell never decreases. Predictions are rounded down, as in HRMapNet's public code.
    """

    def update(self, states: States, values: Floats) -> States:
        """Update cells that are in view. (S, C, n), (C, n) -> (S, C, n)"""
        predicted = (values * 255).astype(np.uint8)
        return np.maximum(states, predicted[None])

    def read(self, states: States) -> Floats:
        """Convert states to values in [0, 1]. (S, C, ...) -> (C, ...)"""
        return states[0].astype(np.float32) / np.float32(255)


@dataclass(frozen=True)
class LastSeen(WriteRule):
    """Last prediction with a linear decay by each miss: the rule of HRMapNet's test.

    A cell has one stored number v, which starts at 100. A hit p > 0 raises v to at least
    100 + 30 p, so hits do not add up. A miss subtracts 1 if v is at least 100, and sets a lower v
    to 99. The value of the cell is (v - 100) / 30, clipped to [0, 1], so a certain prediction
    (p = 1) lasts for 30 misses.

    Args:
        gain: Rise of v by a certain prediction, and number of misses that it lasts (30 above).
        lowest: Smallest state.
        highest: Largest state.

    Raises:
        ValueError: If a setting is out of range.
    """

    empty: ClassVar[int] = 100
    gain: float = 30.0
    lowest: int = 2
    highest: int = 240

    def __post_init__(self) -> None:
        if not 1 <= self.gain <= 140:
            raise InputError(f"gain must be in [1, 140], got {self.gain}.")
        if not 0 <= self.lowest < 100 < self.highest <= 255:
            raise InputError(
                f"lowest and highest must be in [0, 99] and [101, 255], got {self.lowest} and "
                f"{self.highest}."
            )

    def update(self, states: States, values: Floats) -> States:
        """Update cells that are in view. (S, C, n), (C, n) -> (S, C, n)"""
        raised = self.empty + np.float32(self.gain) * values  # 100 for a miss
        new = np.maximum(states, raised[None])
        # As in HRMapNet's public code, a p so small that 100 + 30 p is rounded to 100 is a miss.
        is_miss = raised[None] <= self.empty
        new -= is_miss  # subtracts 1; a lower cell is 100 after the maximum and becomes 99
        return np.clip(new, self.lowest, self.highest).astype(np.uint8)

    def read(self, states: States) -> Floats:
        """Convert states to values in [0, 1]. (S, C, ...) -> (C, ...)"""
        values = (states[0].astype(np.float32) - self.empty) / np.float32(self.gain)
        return np.clip(values, 0, 1)


@dataclass(frozen=True)
class HitMissCounts(WriteRule):
    """Counts of hits and misses per cell, both with exponential decay.

    A frame with a cell in view multiplies both counts by ``decay``. It then adds its prediction p
    to the hits and 1 - p to the misses. Cells that are out of view or occluded keep their counts.
    The value of a cell is hits / (hits + misses + prior_count).

    The upper bound of a count, 1 / (1 - decay), is stored as 255. Counts are rounded to integers. A
    count to which nothing is added is rounded down, so that it decreases.

    Args:
        decay: Factor of older counts at each view, in [0.5, 0.98].
        prior_count: Number of misses that is added in the value, in [0.01, 100]. A cell with a
            single hit has the value 1 / (1 + prior_count).

    Raises:
        ValueError: If a setting is out of range.
    """

    num_states: ClassVar[int] = 2  # hits, misses
    decay: float = 0.95
    prior_count: float = 0.25

    def __post_init__(self) -> None:
        if not 0.5 <= self.decay <= 0.98:
            raise InputError(f"decay must be in [0.5, 0.98], got {self.decay}.")
        if not 0.01 <= self.prior_count <= 100:
            raise InputError(f"prior_count must be in [0.01, 100], got {self.prior_count}.")

    @property
    def _unit(self) -> np.float32:
        """Number that is stored for a count of 1, as 255 is stored for 1 / (1 - decay)."""
        return np.float32(255 * (1 - self.decay))

    def update(self, states: States, values: Floats) -> States:
        """Update cells that are in view. (S, C, n), (C, n) -> (S, C, n)"""
        added = np.stack([values, 1 - values])  # to hits and misses (2, C, n)
        counts = states * np.float32(self.decay)
        counts += self._unit * added
        # `astype` rounds down. With 0.5 added, it rounds to the nearest integer.
        counts += np.float32(0.5) * (added > 0)
        return counts.astype(np.uint8)

    def read(self, states: States) -> Floats:
        """Convert states to values in [0, 1]. (S, C, ...) -> (C, ...)"""
        hits = states[0].astype(np.float32)
        total = hits + states[1] + self._unit * np.float32(self.prior_count)
        return hits / total


RULES: dict[str, type[WriteRule]] = {
    "keep_maximum": KeepMaximum,
    "last_seen": LastSeen,
    "hit_miss_counts": HitMissCounts,
}
"""Rules by their names in files."""


def rule_settings(rule: Any, rules: Mapping[str, type] = RULES) -> dict[str, Any]:
    """Convert a rule to the settings that `rule_from_settings` reads: its name and its numbers."""
    names = {kind: name for name, kind in rules.items()}
    fields: dict[str, Any] = asdict(rule)
    return {"name": names[type(rule)]} | fields


def rule_from_settings(settings: Any, rules: Mapping[str, type] = RULES) -> Any:
    """Create a rule from untrusted settings.

    Args:
        settings: Name of the rule as ``name``, and its numbers.
        rules: Classes of rules by their names; their fields are numbers with defaults.

    Returns:
        The rule, an instance of one of the classes.

    Raises:
        ValueError: If the rule is unknown or its settings are invalid.
    """
    # A list, because the name may be of a type that cannot be a key, such as a dictionary.
    if not isinstance(settings, dict) or settings.get("name") not in list(rules):
        raise InputError(f"the rule must have a name that is one of {sorted(rules)}.")
    kind = rules[settings["name"]]
    numbers = {name: value for name, value in settings.items() if name != "name"}
    expected = set(rule_settings(kind(), rules)) - {"name"}  # names of the numbers of this rule
    if set(numbers) != expected:
        raise InputError(f"the rule {settings['name']} must have the settings {sorted(expected)}.")
    for name, number in numbers.items():
        if isinstance(number, bool) or not isinstance(number, (int, float)):  # a bool is an int
            raise InputError(f"the setting {name} of the rule must be a number.")
    return kind(**numbers)
