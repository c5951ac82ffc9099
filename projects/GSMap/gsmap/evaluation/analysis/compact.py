"""Result files of few numbers: Bezier curves in place of points, within an error in metres."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsmap.evaluation.core.results_json import BEZIER, RESULTS_KEY, SampleFile, write_results
from gsmap.structures.bezier import (
    controls_between,
    curve_points,
    fit_joints,
    largest_deviation,
)
from gsmap.structures.elements import FloatArray
from gsmap.utils.errors import InputError

_DECIMALS = 3  # control points are written in whole millimetres
_ROUNDING_M = 0.001
_REPLACED = ("pts", "pts_num", "gaussian_scales", "gaussian_rotations")


class Compaction(NamedTuple):
    """Numbers of elements, of their vertices and control points, and the largest error."""

    elements: int
    vertices: int
    controls: int
    largest_m: float


def compact_results(
    results: Path, out: Path, degree: int = 3, max_error_m: float = 0.1
) -> Compaction:
    """Write a result file again with piecewise Bezier curves, which every reader here takes.

    Vectors keep their other entries, but for Gaussians, which belong to vertices. A vector of one
    point stays as it is.

    Args:
        results: The result file.
        out: The file to write.
        degree: Of the curves, 1 to 5.
        max_error_m: Largest distance of a curve from its line in the plane, in metres; more than
            the millimetre to which control points are rounded.

    Raises:
        FileNotFoundError: If the result file does not exist.
        ValueError: If it is malformed, or a setting is out of range.
    """
    if max_error_m <= _ROUNDING_M:
        raise InputError(f"the error must be more than {_ROUNDING_M} m, got {max_error_m}.")
    file, samples = SampleFile(results, RESULTS_KEY, ()), []
    total = Compaction(0, 0, 0, 0.0)
    for item, token, elements, _ in file.raw():
        vectors = []
        for vector, points in zip(item["vectors"], elements.polylines, strict=True):
            if len(points) > 1:
                joints = fit_joints(points, degree, max_error_m - _ROUNDING_M)
                controls = controls_between(points, joints, degree).round(_DECIMALS)
                vector = _with_curve(vector, controls, degree)
                total = _added(total, points, controls, _error(points, joints, controls, degree))
            vectors.append(vector)
        samples.append((token, vectors))
    write_results(out, samples, {**file.about, "bezier_max_error_m": max_error_m})
    return total


def _with_curve(vector: Mapping[str, Any], controls: FloatArray, degree: int) -> dict[str, Any]:
    """Return a vector with a curve in place of its points."""
    kept = {key: value for key, value in vector.items() if key not in _REPLACED}
    return {**kept, BEZIER: {"degree": degree, "pts": np.asarray(controls).tolist()}}


def _error(points: FloatArray, joints: list[int], controls: FloatArray, degree: int) -> float:
    """Return the largest distance of a curve's pieces from their parts of a line, in metres."""
    return max(
        largest_deviation(
            points[a : b + 1], curve_points(controls[i * degree : (i + 1) * degree + 1], degree)
        )
        for i, (a, b) in enumerate(pairwise(joints))
    )


def _added(total: Compaction, points: FloatArray, controls: FloatArray, error: float) -> Compaction:
    """Count an element."""
    largest = max(total.largest_m, error)
    return Compaction(
        total.elements + 1, total.vertices + len(points), total.controls + len(controls), largest
    )
