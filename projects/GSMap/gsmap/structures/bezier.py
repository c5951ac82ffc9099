"""Piecewise Bezier curves: lines as few control points (BeMapNet, Qiao et al., CVPR 2023).

A curve of k pieces of degree d has ``k * d + 1`` control points: joint, inner points, joint, ...
"""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from math import comb

import numpy as np
from numpy.typing import NDArray

from gsmap.structures.polylines import Points, resample
from gsmap.utils.errors import InputError

MAX_DEGREE = 5
SAMPLES = 100  # points of a piece that a fit looks at, both ends included
_WORK = 2000  # points that the search for joints may look at, for each vertex of a line

Float = NDArray[np.float64]
Deviation = Callable[[Float, Float], float]


@cache
def bernstein(degree: int, num_points: int = SAMPLES) -> Float:
    """Return what each control point of a piece weighs at equal steps of its parameter.

    Args:
        degree: Of the piece, 1 to ``MAX_DEGREE``.
        num_points: Steps from 0 to 1, both included.

    Returns:
        Weights, whose rows sum to 1. (num_points, degree + 1)

    Raises:
        ValueError: If the degree is another.
    """
    if not 1 <= degree <= MAX_DEGREE:
        raise InputError(f"the degree of a Bezier curve must be 1 to {MAX_DEGREE}, got {degree}.")
    t, k = np.linspace(0, 1, num_points)[:, None], np.arange(degree + 1)
    numbers: Float = np.array([comb(degree, each) for each in k.tolist()], np.float64)
    return numbers * t**k * (1 - t) ** (degree - k)


def curve_points(controls: Points, degree: int, num_points: int = SAMPLES) -> Float:
    """Return points of a piecewise curve.

    Args:
        controls: Control points in metres. (k * degree + 1, D)
        degree: Of each piece.
        num_points: Points of a piece, both ends included.

    Returns:
        Points in metres; joints occur once. (k * (num_points - 1) + 1, D)

    Raises:
        ValueError: If the control points are not those of one piece or more.
    """
    controls = np.asarray(controls, dtype=np.float64)
    weights = bernstein(degree, num_points)
    if controls.ndim != 2 or len(controls) < degree + 1 or (len(controls) - 1) % degree:
        raise InputError(
            f"pieces of degree {degree} have {degree} control points each and one at the end, got "
            f"points of shape {controls.shape}."
        )
    pieces = [weights @ controls[a : a + degree + 1] for a in range(0, len(controls) - 1, degree)]
    return np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])


@cache
def _inverse(degree: int) -> Float:
    """Return what makes control points of a piece's points, by least squares. (degree + 1, 100)"""
    return np.linalg.pinv(bernstein(degree))


def fit_piece(points: Points, degree: int) -> Float:
    """Fit one piece to a line: least squares at equal lengths, then the line's own ends.

    Args:
        points: Vertices in metres. (n >= 2, D)
        degree: Of the piece.

    Returns:
        Control points in metres. (degree + 1, D)
    """
    controls = _inverse(degree) @ resample(points, SAMPLES)
    controls[[0, -1]] = points[[0, -1]]
    return controls


def mean_deviation(line: Float, curve: Float, ignored_m: float = 0.05) -> float:
    """Return how far a curve is from a line in the mean, in metres: BeMapNet's measure.

    Args:
        line: Vertices of the line, in metres; 100 equidistant points of it count. (n, D)
        curve: Points of the curve. (m, D)
        ignored_m: Distances up to this count as 0.
    """
    from scipy.spatial import distance  # reading a result file needs neither scipy nor shapely

    between = distance.cdist(resample(line, SAMPLES), curve)
    nearest = between.min(0), between.min(1)
    return float(np.mean([np.where(near <= ignored_m, 0, near).mean() for near in nearest]))


def largest_deviation(line: Float, curve: Float) -> float:
    """Return the largest distance of a line (n, D) and a curve (m, D), in metres (Hausdorff).

    Both directions count, in the plane: the given points of the curve, the vertices of the line,
    and 100 equidistant points of it.
    """
    from gsmap.structures.curve_kernels import largest_deviation as compiled  # reading needs none

    return compiled(_in_plane(line), _in_plane(curve), SAMPLES, np.inf)


def _in_plane(points: Float) -> Float:
    """Return x and y of points, as the kernels take them. (n, D) -> (n, 2)"""
    return np.ascontiguousarray(points[:, :2], np.float64)


def _fits(degree: int, max_error_m: float, deviation: Deviation) -> Callable[[Float], bool]:
    """Return a test of whether one piece is near enough to a part of a line (n, D)."""

    def fits(part: Float) -> bool:
        return deviation(part, curve_points(fit_piece(part, degree), degree)) < max_error_m

    def fits_compiled(part: Float) -> bool:
        apart_m = deviation_of_fit(_in_plane(part), inverse, weights, max_error_m)
        return bool(apart_m < max_error_m)

    if deviation is not largest_deviation:
        return fits
    from gsmap.structures.curve_kernels import deviation_of_fit

    inverse = _inverse(degree)
    weights = bernstein(degree)
    return fits_compiled


def fit_joints(
    points: Points,
    degree: int = 3,
    max_error_m: float = 0.1,
    deviation: Deviation = largest_deviation,
) -> list[int]:
    """Return the vertices of a line at which the pieces of its curve meet, both ends included.

    Each piece reaches as far as the error allows. Lines for which that search takes too long, such
    as long ones that turn at each vertex, are searched on by twice the reach as long as that fits.

    Args:
        points: Vertices in metres. (n >= 2, D)
        degree: Of the pieces, 1 to ``MAX_DEGREE``.
        max_error_m: A piece is accepted below this deviation, in metres.
        deviation: Takes the vertices of a part of the line (n, D) and points of its curve (m, D).

    Raises:
        ValueError: If the line has fewer than two points, or a setting is out of range.
    """
    points = np.asarray(points, dtype=np.float64)
    if max_error_m <= 0:
        raise InputError(f"max_error_m must be more than 0, got {max_error_m}.")
    if len(points) < 2:
        raise InputError(f"a line has two points or more, got {len(points)}.")
    fits = _fits(degree, max_error_m, deviation)
    last, work = len(points) - 1, _WORK * len(points)
    joints = [0]
    while joints[-1] < last:
        start, end = joints[-1], last
        while end > start + 1 and work > 0:
            work -= end - start + SAMPLES
            if fits(points[start : end + 1]):
                break
            end -= 1
        if work <= 0:
            end, farther = start + 1, min(start + 2, last)
            while end < farther and fits(points[start : farther + 1]):
                end = farther
                farther = min(2 * farther - start, last)
        joints.append(end)
    return joints


def controls_between(points: Points, joints: Sequence[int], degree: int) -> Float:
    """Return the control points of pieces that meet at some vertices of a line.

    Args:
        points: Vertices in metres. (n >= 2, D)
        joints: Numbers of the vertices, rising, with both ends. (k + 1,)
        degree: Of the pieces.

    Returns:
        Control points in metres. (k * degree + 1, D)
    """
    points = np.asarray(points, dtype=np.float64)
    pieces = [fit_piece(points[a : b + 1], degree)[1:] for a, b in pairwise(joints)]
    return np.concatenate([points[:1], *pieces])


def fit_pieces(
    points: Points,
    degree: int = 3,
    max_error_m: float = 0.1,
    deviation: Deviation = largest_deviation,
) -> Float:
    """Fit a line with few pieces: each reaches as far as the error allows.

    Joints are vertices of the line (`fit_joints`). A piece between neighbouring vertices is exact,
    so that there is always a fit. BeMapNet's own fits are those with ``deviation=mean_deviation``.

    Args:
        points: Vertices in metres. (n >= 2, D)
        degree: Of the pieces, 1 to ``MAX_DEGREE``.
        max_error_m: A piece is accepted below this deviation, in metres.
        deviation: Takes the vertices of a part of the line (n, D) and points of its curve (m, D).

    Returns:
        Control points in metres. (k * degree + 1, D)

    Raises:
        ValueError: If the line has fewer than two points, or a setting is out of range.
    """
    return controls_between(points, fit_joints(points, degree, max_error_m, deviation), degree)
