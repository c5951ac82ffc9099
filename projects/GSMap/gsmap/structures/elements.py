"""Map of one sample, predicted or annotated: its polylines and rings in flat arrays."""

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
PerElement = Sequence[Any] | npt.NDArray[Any]  # one entry for each element: array or nested list


def ground_truth_elements(results: Mapping[str, Any], transform: object) -> Sequence[Any]:
    """Return the ground-truth elements of a sample in a pipeline: its list of `MapInstance`.

    Args:
        results: Dictionary of the sample that the transforms of the pipeline pass on.
        transform: Transform that needs the elements, named in the message.

    Raises:
        ValueError: If the sample has no ground truth.
    """
    elements: Sequence[Any] | None = results["map_instances"]
    if elements is None:
        raise InputError(
            f"sample {results['token']!r} has no ground truth: leave {type(transform).__name__} "
            "out of this pipeline."
        )
    return elements


FARTHEST_M = 1e8
"""Largest coordinate of a pose or a point in the global frame, in metres.

Grids whose eastings begin with the number of a zone, such as EPSG:4527, reach 6e7 m.
"""
MAX_LENGTH_M = 1e5
"""Largest distance in metres of a point of a map from the vehicle, and largest length of a line."""
MAX_TOTAL_LENGTH_M = 1e6
"""Largest length in metres of all lines of the map around a vehicle together."""


@dataclass(frozen=True, eq=False)
class MapElements:
    """Polylines and rings of one sample, concatenated in one array.

    ``from_polylines`` creates and checks them.

    Args:
        points: Vertices of all elements, (x, y) or (x, y, z) in metres in the frame of the
            annotations. (M, D)
        offsets: Element i has the vertices ``offsets[i]:offsets[i + 1]``. (N + 1,)
        labels: Class index of each element. (N,)
        scores: Confidence of each element in [0, 1], or None for ground truth. (N,)
        scales: Standard deviations of the Gaussian of each vertex in metres, or None. (M, 2)
        rotations: Angle of the first axis of the Gaussian of each vertex from +x in radians,
            anticlockwise, or None. (M,)
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
        """Create the elements of a sample from separate polylines.

        Args:
            polylines: Arrays or nested lists of vertices in metres; z is dropped unless all
                vertices have it. N x (P, 2 or 3)
            labels: Class indices. (N,)
            scores: Confidences in [0, 1], or None for ground truth. (N,)
            scales: Standard deviations of the Gaussians of the vertices in metres, or None.
                N x (P, 2)
            rotations: Angles of the first axes of the Gaussians from +x in radians, or None.
                N x (P,)

        Returns:
            Elements.

        Raises:
            ValueError: If the lengths disagree, a label is no whole number, a point is not (x, y)
                or (x, y, z), a point is not finite, a score is outside [0, 1], a scale is not
                positive and finite, or a rotation is not finite.
        """
        labels = _whole_labels(labels)
        scores = None if scores is None else np.asarray(scores, np.float64).reshape(-1)
        values = {"labels": labels, "scores": scores, "scales": scales, "rotations": rotations}
        for name, given in values.items():
            if given is not None and len(given) != len(polylines):
                raise InputError(
                    f"{name} must have one entry for each of the {len(polylines)} polylines, "
                    f"got {len(given)}."
                )
        try:
            points = _concatenate(polylines)
        except (TypeError, IndexError, ValueError) as error:
            raise InputError(f"polylines must be lists of (x, y) or (x, y, z): {error}") from error
        offsets = np.cumsum([0, *map(len, polylines)])
        is_finite = np.isfinite(points).all(axis=1)
        _require(is_finite, offsets, fault="point that is not finite")
        if scores is not None:
            in_range = (scores >= 0) & (scores <= 1)  # False for NaN
            if not in_range.all():
                index = in_range.argmin()  # index of the first False
                raise InputError(f"element {index} has the score {scores[index]}, not in [0, 1].")
        scales = _per_vertex(scales, "scales", shape=(len(points), 2))
        rotations = _per_vertex(rotations, "rotations", shape=(len(points),))
        if scales is not None:
            positive = ((scales > 0) & np.isfinite(scales)).all(axis=1)
            _require(positive, offsets, fault="Gaussian whose scales are not positive numbers")
        if rotations is not None:
            is_finite = np.isfinite(rotations)
            _require(is_finite, offsets, fault="Gaussian whose rotation is not finite")
        return cls(points, offsets, labels, scores=scores, scales=scales, rotations=rotations)

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def num_points(self) -> IntArray:
        """Number of vertices of each element. (N,)"""
        return np.diff(self.offsets)

    @property
    def polylines(self) -> list[FloatArray]:
        """Vertices of each element, as views of ``points``. N x (P, D)"""
        return [self.points[a:b] for a, b in pairwise(self.offsets.tolist())]

    @property
    def rows(self) -> Iterator[tuple[FloatArray, int, float]]:
        """Vertices (P, D), label and confidence of each element."""
        labels = self.labels.tolist()
        confidences = self.confidence.tolist()
        return zip(self.polylines, labels, confidences, strict=True)

    @property
    def confidence(self) -> FloatArray:
        """Scores, or ones if there are no scores. (N,)"""
        return np.ones(len(self)) if self.scores is None else self.scores

    @property
    def has_gaussians(self) -> bool:
        """Whether each vertex has a Gaussian."""
        return self.scales is not None and self.rotations is not None

    def with_coordinates(self, dim: int) -> "MapElements":
        """Keep only the first coordinates of the vertices.

        Args:
            dim: Number of coordinates to keep.

        Returns:
            Elements with ``dim`` coordinates per vertex.

        Raises:
            ValueError: If there are vertices and they have fewer coordinates.
        """
        num_coordinates = self.points.shape[1]
        if num_coordinates == dim:
            return self
        if num_coordinates < dim and len(self.points):
            raise InputError(f"points must have {dim} coordinates, got {num_coordinates}.")
        points = self.points[:, :dim] if len(self.points) else np.empty((0, dim))
        return replace(self, points=np.ascontiguousarray(points))

    def to_frame(self, transform: FloatArray) -> "MapElements":
        """Transform the elements to another frame, by the position and yaw of a pose.

        Roll and pitch are ignored: at 30 m from the origin, they change x and y by centimetres.
        Ground truth is also cut out of a map by position and yaw, so transforming it back to the
        frame of the map by this method restores the coordinates of the map.

        Args:
            transform: Transform from the frame of the elements to the other one, in metres. (4, 4)

        Returns:
            Elements in the other frame.
        """
        axis_x, axis_y = transform[:2, 0]  # the x axis of the elements' frame in the other frame
        # Roll and pitch shorten the axis in the plane. Its direction there is the yaw.
        cos, sin = transform[:2, 0] / np.hypot(axis_x, axis_y)
        rotation = np.eye(self.points.shape[1])  # (D, D); z, if present, is only translated
        rotation[:2, :2] = [[cos, -sin], [sin, cos]]
        translation = transform[: len(rotation), 3]  # (D,)
        points = self.points @ rotation.T + translation
        rotations = self.rotations
        if rotations is not None:
            rotations = rotations + np.arctan2(sin, cos)
        return replace(self, points=points, rotations=rotations)

    def select(self, index: IntArray | BoolArray) -> "MapElements":
        """Select elements.

        Args:
            index: Indices (K,) or a mask (N,) of the elements.

        Returns:
            Selected elements.
        """
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else np.asarray(index)
        counts = self.num_points[rows]  # number of vertices of each selected element
        offsets = np.append(0, np.cumsum(counts))
        # Each selected element starts at one of ``offsets`` in the result, and at one of
        # ``self.offsets`` here. The difference, added to the index of a vertex in the result, gives
        # its index in ``self.points``.
        shifts = np.repeat(self.offsets[rows] - offsets[:-1], counts)
        vertices = shifts + np.arange(offsets[-1])  # indices of the selected vertices
        return MapElements(
            points=self.points[vertices],
            offsets=offsets,
            labels=self.labels[rows],
            scores=None if self.scores is None else self.scores[rows],
            scales=None if self.scales is None else self.scales[vertices],
            rotations=None if self.rotations is None else self.rotations[vertices],
        )


def _whole_labels(labels: npt.ArrayLike) -> IntArray:
    """Convert labels to integers, and refuse values that an integer would change. (N,)"""
    values = np.asarray(labels).reshape(-1)
    if values.dtype.kind == "O":  # such as a column of a table
        values = np.array(values.tolist())
    if not len(values):
        return np.empty(0, dtype=np.int64)
    # The kinds are truth values, signed and unsigned integers, and floating-point numbers.
    if values.dtype.kind not in "biuf":
        raise InputError(f"labels must be class indices, got {values[0]!r:.80}.")
    if values.dtype.kind == "f":
        is_whole = np.isfinite(values) & (values == np.round(values))
        if not is_whole.all():
            index = is_whole.argmin()  # index of the first False
            raise InputError(
                f"element {index} has the label {values[index]:g}, but labels must be class "
                "indices, such as 0 or 1: are labels and scores exchanged?"
            )
    return values.astype(np.int64)


def _require(valid: BoolArray, offsets: IntArray, fault: str) -> None:
    """Raise ValueError naming the first element with an invalid vertex.

    Args:
        valid: Whether each vertex is valid. (M,)
        offsets: Index of the first vertex of each element, then M. (N + 1,)
        fault: Description of an invalid vertex. It ends the message "element i has a ...".
    """
    if not valid.all():
        first_invalid = valid.argmin()  # index of the first False
        index = np.searchsorted(offsets, first_invalid, side="right") - 1
        raise InputError(f"element {index} has a {fault}.")


def _concatenate(polylines: PerElement) -> FloatArray:
    """Concatenate the vertices of all polylines. N x (P, 2 or 3) -> (M, 2 or 3)

    The result has two coordinates if any vertex has two. The first polyline that is not empty
    decides whether all of them are treated as arrays or as nested lists.
    """
    nonempty = [polyline for polyline in polylines if len(polyline)]
    if not nonempty:
        return np.empty((0, 2))
    are_arrays = isinstance(nonempty[0], np.ndarray)
    # `dims` contains each number of coordinates per vertex that occurs.
    if are_arrays:
        dims = {polyline.shape[1] for polyline in nonempty}
    else:
        dims = set(map(len, chain.from_iterable(nonempty)))
    if not dims <= {2, 3}:
        raise InputError(f"points have {sorted(dims)} coordinates")
    if are_arrays:
        dim = min(dims)
        return np.concatenate([polyline[:, :dim] for polyline in nonempty], dtype=np.float64)
    rows = list(chain.from_iterable(nonempty))
    if len(dims) > 1:
        rows = [row[:2] for row in rows]
    return np.array(rows, dtype=np.float64)


def _per_vertex(values: Any, name: str, shape: tuple[int, ...]) -> FloatArray | None:
    """Concatenate the values of the vertices of all polylines, and check the resulting shape."""
    if values is None:
        return None
    if not len(values):  # no elements: `np.concatenate` needs at least one array
        return np.empty(shape)
    joined = np.concatenate([np.asarray(v, dtype=np.float64) for v in values])
    if joined.shape != shape:
        raise InputError(f"{name} must hold {shape} values in all, got {joined.shape}.")
    return joined
