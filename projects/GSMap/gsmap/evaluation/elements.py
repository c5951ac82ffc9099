"""Map elements of one sample as flat arrays, the form in which both metrics read them."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class MapElements:
    """Polylines and rings of one sample, one after another in one array.

    Args:
        points: The points of all elements, (x, y) in metres in the frame of the annotations.
            (M, 2)
        offsets: Element i owns the points ``offsets[i]:offsets[i + 1]``. (N + 1,)
        labels: Index of each element's class. (N,)
        scores: Confidence of each element in [0, 1]; ones for ground truth. (N,)
    """

    points: FloatArray
    offsets: IntArray
    labels: IntArray
    scores: FloatArray

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def num_points(self) -> IntArray:
        """Number of points of each element. (N,)"""
        return np.diff(self.offsets)

    def polyline(self, index: int) -> FloatArray:
        """Return the points of one element. (P, 2)"""
        return self.points[self.offsets[index] : self.offsets[index + 1]]

    def select(self, index: IntArray | BoolArray) -> "MapElements":
        """Return some of the elements, in the order that is asked for.

        Args:
            index: Positions, or a mask. (K,) or (N,)
        """
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else np.asarray(index)
        if len(rows) == len(self) and bool((rows == np.arange(len(self))).all()):
            return self
        counts = self.num_points[rows]
        offsets = np.zeros(len(rows) + 1, dtype=np.int64)
        np.cumsum(counts, out=offsets[1:])
        take = np.repeat(self.offsets[rows] - offsets[:-1], counts) + np.arange(offsets[-1])
        return MapElements(self.points[take], offsets, self.labels[rows], self.scores[rows])


def _flatten(polylines: Sequence[Any]) -> tuple[FloatArray, list[int]]:
    """Return all points as (M, 2) and the number of points of each polyline."""
    counts = [len(p) for p in polylines]
    if isinstance(polylines[0], np.ndarray):
        filled = [np.asarray(p, dtype=np.float64)[:, :2] for p in polylines if len(p)]
        return np.concatenate(filled) if filled else np.empty((0, 2)), counts
    rows = list(chain.from_iterable(polylines))
    dims = set(map(len, rows))
    if not dims:
        return np.empty((0, 2)), counts
    if not dims <= {2, 3}:
        raise ValueError(f"points have {sorted(dims)} coordinates")
    if len(dims) > 1:
        rows, dims = [row[:2] for row in rows], {2}
    flat = array("d", chain.from_iterable(rows))  # twice as fast as np.array on nested lists
    return np.frombuffer(flat).reshape(len(rows), dims.pop())[:, :2], counts


def map_elements(
    polylines: Sequence[Any],
    labels: npt.ArrayLike,
    scores: npt.ArrayLike | None = None,
) -> MapElements:
    """Build the elements of one sample from separate polylines.

    A third coordinate (z) is dropped: both metrics are defined in the plane.

    Args:
        polylines: Points of each element in metres; arrays or nested lists. N x (P, 2 or 3)
        labels: Index of each element's class. (N,)
        scores: Confidence of each element; ones if left out. (N,)

    Returns:
        The elements.

    Raises:
        ValueError: If the lengths disagree, the points are not (x, y[, z]), or a point or a score
            is not finite.
    """
    label_array = np.asarray(labels, dtype=np.int64).reshape(-1)
    n = len(label_array)
    score_array = np.ones(n) if scores is None else np.asarray(scores, np.float64).reshape(-1)
    if not len(polylines) == n == len(score_array):
        raise ValueError(
            "polylines, labels and scores must have one entry per element, got "
            f"{len(polylines)}, {n} and {len(score_array)}."
        )
    try:
        points, counts = _flatten(polylines) if n else (np.empty((0, 2)), [])
    except (TypeError, IndexError, ValueError) as error:
        raise ValueError(f"polylines must be lists of (x, y) or (x, y, z): {error}") from error
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"polylines must be lists of (x, y) or (x, y, z), got {points.shape}.")
    offsets = np.zeros(n + 1, dtype=np.int64)
    np.cumsum(counts, out=offsets[1:])
    _require_finite(points, offsets, score_array)
    return MapElements(np.ascontiguousarray(points), offsets, label_array, score_array)


def _require_finite(points: FloatArray, offsets: IntArray, scores: FloatArray) -> None:
    """Raise a ValueError that names the first element with a NaN or infinite value."""
    if np.isfinite(points).all() and np.isfinite(scores).all():
        return
    bad_points = np.flatnonzero(~np.isfinite(points).all(axis=1))
    bad_scores = np.flatnonzero(~np.isfinite(scores))
    if len(bad_points):
        index = int(np.searchsorted(offsets, bad_points[0], side="right")) - 1
        raise ValueError(f"element {index} has a point that is not finite.")
    raise ValueError(f"element {int(bad_scores[0])} has a score that is not finite.")


def empty_elements() -> MapElements:
    """Return a sample without elements."""
    return map_elements([], [])
