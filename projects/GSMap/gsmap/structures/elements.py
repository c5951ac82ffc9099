"""The map of one sample, predicted or annotated: all its polylines and rings in flat arrays."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from gsmap.utils.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
PerElement = Sequence[Any] | npt.NDArray[Any]


def annotated(results: Mapping[str, Any], transform: object) -> Sequence[Any]:
    """Return the elements of a sample in a pipeline, ``map_instances``.

    ValueError if there is no ground truth, so that the transform should be left out.
    """
    elements: Sequence[Any] | None = results["map_instances"]
    if elements is None:
        raise InputError(
            f"sample {results['token']!r} has no ground truth: leave {type(transform).__name__} "
            "out of this pipeline."
        )
    return elements


FARTHEST_M = 1e5
"""How far from the vehicle a point of a map around it may lie, and how long a line may be."""
MOST_M = 1e6
"""How long all lines of a map around a vehicle may be together."""


@dataclass(frozen=True, eq=False)
class MapElements:
    """Polylines and rings of one sample, one after another in one array.

    ``from_polylines`` builds and checks them.

    Args:
        points: Vertices of all elements, (x, y) or (x, y, z) in metres in the frame of the
            annotations. (M, D)
        offsets: Element i owns the vertices ``offsets[i]:offsets[i + 1]``. (N + 1,)
        labels: Class index of each element. (N,)
        scores: Confidence of each element in [0, 1], or None for ground truth. (N,)
        scales: Standard deviations of each vertex's Gaussian in metres, if it has one. (M, 2)
        rotations: Angle of its first axis from +x in radians, anticlockwise. (M,)
    """

    points: FloatArray
    offsets: IntArray
    labels: IntArray
    scores: FloatArray | None = None
    scales: FloatArray | None = None
    rotations: FloatArray | None = None

    @classmethod
    def from_polylines(
        cls,
        polylines: PerElement = (),
        labels: npt.ArrayLike = (),
        scores: npt.ArrayLike | None = None,
        scales: PerElement | None = None,
        rotations: PerElement | None = None,
    ) -> "MapElements":
        """Build the elements of a sample from separate polylines.

        Args:
            polylines: Arrays or nested lists of vertices in metres; z is dropped unless all have
                it. N x (P, 2 or 3)
            labels: Class indices. (N,)
            scores: Confidences in [0, 1], or None for ground truth. (N,)
            scales: Standard deviations of the vertices' Gaussians in metres. N x (P, 2)
            rotations: Angles of their first axes from +x in radians. N x (P,)

        Raises:
            ValueError: If the lengths disagree, the points are not (x, y[, z]), a point is not
                finite, a score is outside [0, 1], or a Gaussian is none: a scale that is not
                positive, a value that is not finite.
        """
        labels = np.asarray(labels, np.int64).reshape(-1)
        scores = None if scores is None else np.asarray(scores, np.float64).reshape(-1)
        values = {"labels": labels, "scores": scores, "scales": scales, "rotations": rotations}
        for name, given in values.items():
            if given is not None and len(given) != len(polylines):
                raise InputError(
                    f"{name} must have one entry for each of the {len(polylines)} polylines, "
                    f"got {len(given)}."
                )
        try:
            points = _joined(polylines)
        except (TypeError, IndexError, ValueError) as error:
            raise InputError(f"polylines must be lists of (x, y) or (x, y, z): {error}") from error
        offsets = np.cumsum([0, *map(len, polylines)])
        _require(np.isfinite(points).all(axis=1), offsets, "point that is not finite")
        if scores is not None and not ((scores >= 0) & (scores <= 1)).all():  # NaN is not
            index = ((scores >= 0) & (scores <= 1)).argmin()
            raise InputError(f"element {index} has the score {scores[index]}, not in [0, 1].")
        scales = _per_vertex(scales, "scales", (len(points), 2))
        rotations = _per_vertex(rotations, "rotations", (len(points),))
        if scales is not None:
            positive = ((scales > 0) & np.isfinite(scales)).all(axis=1)
            _require(positive, offsets, "Gaussian whose scales are not positive numbers")
        if rotations is not None:
            _require(np.isfinite(rotations), offsets, "Gaussian whose rotation is not finite")
        return cls(points, offsets, labels, scores, scales, rotations)

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def num_points(self) -> IntArray:
        """Number of vertices of each element. (N,)"""
        return np.diff(self.offsets)

    @property
    def polylines(self) -> list[FloatArray]:
        """The vertices of each element, as views. N x (P, D)"""
        return [self.points[a:b] for a, b in pairwise(self.offsets.tolist())]

    @property
    def rows(self) -> Iterator[tuple[FloatArray, int, float]]:
        """Vertices (P, D), label and confidence of one element after another."""
        values = self.labels.tolist(), self.confidence.tolist()
        return zip(self.polylines, *values, strict=True)

    @property
    def confidence(self) -> FloatArray:
        """The scores; ones if there are none. (N,)"""
        return np.ones(len(self)) if self.scores is None else self.scores

    @property
    def has_gaussians(self) -> bool:
        """Whether every vertex carries a Gaussian."""
        return self.scales is not None and self.rotations is not None

    def with_coordinates(self, dim: int) -> "MapElements":
        """Return the elements with ``dim`` coordinates a vertex; ValueError if there are fewer."""
        found = self.points.shape[1]
        if found == dim:
            return self
        if found < dim and len(self.points):
            raise InputError(f"points must have {dim} coordinates, got {found}.")
        points = self.points[:, :dim] if len(self.points) else np.empty((0, dim))
        return replace(self, points=np.ascontiguousarray(points))

    def moved(self, transform: FloatArray) -> "MapElements":
        """Return the elements in another level frame: moved by position and yaw of a pose.

        Ground truth is cut out of maps in just this way, so that the two are inverse to each other;
        roll and pitch would move a point 30 m away by centimetres.

        Args:
            transform: From the frame of the elements to the other one, in metres. (4, 4)
        """
        cos, sin = transform[:2, 0] / np.hypot(*transform[:2, 0])
        turn = np.eye(self.points.shape[1])
        turn[:2, :2] = [[cos, -sin], [sin, cos]]
        points = self.points @ turn.T + transform[: len(turn), 3]
        turned = None if self.rotations is None else self.rotations + np.arctan2(sin, cos)
        return replace(self, points=points, rotations=turned)

    def select(self, index: IntArray | BoolArray) -> "MapElements":
        """Return some of the elements, by positions in their order (K,), or by a mask (N,)."""
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else np.asarray(index)
        counts = self.num_points[rows]
        offsets = np.append(0, np.cumsum(counts))
        take = np.repeat(self.offsets[rows] - offsets[:-1], counts) + np.arange(offsets[-1])
        scores, scales, rotations = (
            None if values is None else values[chosen]
            for values, chosen in ((self.scores, rows), (self.scales, take), (self.rotations, take))
        )
        return MapElements(self.points[take], offsets, self.labels[rows], scores, scales, rotations)


def _require(right: BoolArray, offsets: IntArray, fault: str) -> None:
    """Raise ValueError with the first element of which a vertex is not right. (M,), (N + 1,)"""
    if not right.all():
        index = np.searchsorted(offsets, right.argmin(), side="right") - 1
        raise InputError(f"element {index} has a {fault}.")


def _joined(polylines: PerElement) -> FloatArray:
    """Return the vertices of all polylines. (M, 2 or 3)"""
    filled = [p for p in polylines if len(p)]
    if not filled:
        return np.empty((0, 2))
    arrays = isinstance(filled[0], np.ndarray)
    rows = list(chain.from_iterable(filled)) if not arrays else []
    dims = {p.shape[1] for p in filled} if arrays else set(map(len, rows))
    if not dims <= {2, 3}:
        raise InputError(f"points have {sorted(dims)} coordinates")
    if arrays:
        return np.concatenate([p[:, : min(dims)] for p in filled], dtype=np.float64)
    return np.array(rows if len(dims) == 1 else [row[:2] for row in rows], dtype=np.float64)


def _per_vertex(values: Any, name: str, shape: tuple[int, ...]) -> FloatArray | None:
    """Join what each polyline's vertices carry, and check that every vertex has it."""
    if values is None:
        return None
    if not len(values):
        return np.empty(shape)
    joined = np.concatenate([np.asarray(v, dtype=np.float64) for v in values])
    if joined.shape != shape:
        raise InputError(f"{name} must hold {shape} values in all, got {joined.shape}.")
    return joined
