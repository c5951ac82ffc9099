"""Compaction of result files: Bezier curves that approximate the points of the elements."""

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
_ROUNDING_M = 0.001  # bound on the displacement of a curve by this rounding
_POINT_KEYS = ("pts", "pts_num", "gaussian_scales", "gaussian_rotations")  # replaced by a curve


class Compaction(NamedTuple):
    """Numbers of points of a result file before and after its compaction.

    Args:
        elements: Number of elements replaced by curves.
        vertices: Number of vertices of these elements.
        controls: Number of control points of the curves.
        largest_m: Largest distance of a curve from its line, in metres.
    """

    elements: int
    vertices: int
    controls: int
    largest_m: float


def compact_results(
    results: Path, out: Path, degree: int = 3, max_error_m: float = 0.1
) -> Compaction:
    """Write a result file with piecewise Bezier curves, which all readers of GSMap accept.

    A vector is the JSON object of one element, whose points are the vertices of a line. A curve
    replaces the points and their Gaussians; other entries of the vector are kept. A vector with
    fewer than two points is not changed.

    Args:
        results: Path of the result file.
        out: Path of the file to write.
        degree: Degree of the curves, in [1, 5].
        max_error_m: Largest distance of a curve from its line in the plane, in metres. It must be
            more than 0.001, because control points are rounded to millimetres.

    Returns:
        Numbers of points before and after, and the largest error.

    Raises:
        FileNotFoundError: If the result file does not exist.
        ValueError: If the file is malformed, or a setting is out of range.
    """
    if max_error_m <= _ROUNDING_M:
        raise InputError(f"the error must be more than {_ROUNDING_M} m, got {max_error_m}.")
    file = SampleFile(results, key=RESULTS_KEY, classes=())  # labels are not needed
    samples = []
    num_elements = 0
    num_vertices = 0
    num_controls = 0
    largest_m = 0.0
    # `item` is the JSON object of a sample, and `elements` are its vectors in their order.
    for item, token, elements, _ in file.raw():
        vectors = []
        for vector, points in zip(item["vectors"], elements.polylines, strict=True):
            if len(points) < 2:
                vectors.append(vector)
                continue
            # Indices of the vertices at which pieces of the curve begin and end. The error that
            # rounding adds below is subtracted from the limit.
            joints = fit_joints(points, degree, max_error_m - _ROUNDING_M)
            controls = controls_between(points, joints, degree).round(_DECIMALS)
            vectors.append(_replace_points(vector, controls=controls, degree=degree))
            error_m = _largest_error(points, joints=joints, controls=controls, degree=degree)
            num_elements += 1
            num_vertices += len(points)
            num_controls += len(controls)
            largest_m = max(largest_m, error_m)
        samples.append((token, vectors))
    # `about`, the metadata of the file, is set only after the last sample was read.
    meta = {**file.about, "bezier_max_error_m": max_error_m}
    write_results(out, samples=samples, meta=meta)
    return Compaction(
        elements=num_elements, vertices=num_vertices, controls=num_controls, largest_m=largest_m
    )


def _replace_points(vector: Mapping[str, Any], controls: FloatArray, degree: int) -> dict[str, Any]:
    """Replace the points of a vector by a curve."""
    entries = {key: value for key, value in vector.items() if key not in _POINT_KEYS}
    entries[BEZIER] = {"degree": degree, "pts": np.asarray(controls).tolist()}
    return entries


def _largest_error(
    points: FloatArray, joints: list[int], controls: FloatArray, degree: int
) -> float:
    """Compute the largest distance, in metres, of a piecewise curve from its line.

    Each piece is compared with the part of the line that it approximates.

    Args:
        points: Vertices of the line in metres. (n, D)
        joints: Indices of the vertices at which pieces begin and end.
        controls: Control points of all pieces. Consecutive pieces share one point. (m, D)
        degree: Degree of the curve.
    """
    errors_m = []
    for piece, (start, end) in enumerate(pairwise(joints)):
        first_control = piece * degree
        piece_controls = controls[first_control : first_control + degree + 1]
        curve = curve_points(piece_controls, degree=degree)
        errors_m.append(largest_deviation(points[start : end + 1], curve))
    return max(errors_m)
