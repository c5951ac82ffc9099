"""Rows of the comparison with reference data, and the table of them."""

from collections.abc import Sequence
from dataclasses import dataclass

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


def _pair(ours: ArrayLike, reference: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return both as float64 arrays of one shape.

    Raises:
        ValueError: If the shapes differ.
    """
    ours, reference = np.asarray(ours, np.float64), np.asarray(reference, np.float64)
    if ours.shape != reference.shape:
        raise ValueError(f"the reference has shape {reference.shape}, ours has {ours.shape}.")
    return ours, reference


def largest_difference(ours: ArrayLike, reference: ArrayLike) -> float:
    """Return the largest absolute difference; infinite where shapes differ, zero if empty."""
    try:
        ours, reference = _pair(ours, reference)
    except ValueError:
        return float("inf")
    return float(np.abs(ours - reference).max(initial=0.0))


def largest_relative(ours: ArrayLike, reference: ArrayLike) -> float:
    """Return the largest difference over the reference's size there (at least 1e-6)."""
    try:
        ours, reference = _pair(ours, reference)
    except ValueError:
        return float("inf")
    return float((np.abs(ours - reference) / np.maximum(np.abs(reference), 1e-6)).max(initial=0.0))


def relative_norm(ours: ArrayLike, reference: ArrayLike) -> float:
    """Return the norm of the difference over the reference's norm (at least 1e-12)."""
    try:
        ours, reference = _pair(ours, reference)
    except ValueError:
        return float("inf")
    size = float(np.linalg.norm(reference))
    return float(np.linalg.norm(ours - reference)) / max(size, 1e-12)


def fraction_beyond(ours: ArrayLike, reference: ArrayLike, limit: float) -> float:
    """Return the fraction of entries that differ by more than ``limit``."""
    try:
        ours, reference = _pair(ours, reference)
    except ValueError:
        return float("inf")
    return float(1.0 - (np.abs(ours - reference) <= limit).mean()) if ours.size else 0.0


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
