"""Rows of the comparison with reference data, and the table of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Row:
    """One compared quantity.

    Attributes:
        file: Name of the reference file.
        quantity: What was compared.
        deviation: Largest deviation.
        tolerance: Largest deviation allowed.
    """

    file: str
    quantity: str
    deviation: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the deviation is within the tolerance; one that is not a number is not."""
        return bool(self.deviation <= self.tolerance)


def _of_one_shape(deviation: Callable[..., float]) -> Callable[..., float]:
    """Pass both arrays in float64.

    The deviation is infinite if their shapes differ. It is also infinite in place of NaN, which
    Python's ``max`` over several deviations could drop.
    """

    @wraps(deviation)
    def compare(ours: ArrayLike, reference: ArrayLike, *more: float) -> float:
        ours = np.asarray(ours, np.float64)
        reference = np.asarray(reference, np.float64)
        if ours.shape != reference.shape:
            return float("inf")
        value = float(deviation(ours, reference, *more))
        return float("inf") if np.isnan(value) else value

    return compare


@_of_one_shape
def largest_difference(ours: np.ndarray, reference: np.ndarray) -> float:
    """Return the largest absolute difference, zero if empty."""
    return np.abs(ours - reference).max(initial=0.0)


@_of_one_shape
def largest_relative(ours: np.ndarray, reference: np.ndarray) -> float:
    """Return the largest difference over the reference's size there (at least 1e-6)."""
    return (np.abs(ours - reference) / np.maximum(np.abs(reference), 1e-6)).max(initial=0.0)


@_of_one_shape
def relative_norm(ours: np.ndarray, reference: np.ndarray) -> float:
    """Return the norm of the difference over the reference's norm (at least 1e-12)."""
    return np.linalg.norm(ours - reference) / max(np.linalg.norm(reference), 1e-12)


@_of_one_shape
def fraction_beyond(ours: np.ndarray, reference: np.ndarray, limit: float) -> float:
    """Return the fraction of entries that differ by more than ``limit``, zero if empty."""
    return 1.0 - (np.abs(ours - reference) <= limit).mean() if ours.size else 0.0


def format_table(rows: Sequence[Row]) -> str:
    """Lay out the rows as a table of file, quantity, deviation, tolerance and verdict."""
    cells = [("file", "quantity", "largest deviation", "tolerance", "verdict")]
    cells += [
        (
            r.file,
            r.quantity,
            f"{r.deviation:.2e}",
            f"{r.tolerance:.0e}",
            "ok" if r.passed else "MISS",
        )
        for r in rows
    ]
    widths = [max(len(row[column]) for row in cells) for column in range(5)]
    lines = [
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in cells
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)
