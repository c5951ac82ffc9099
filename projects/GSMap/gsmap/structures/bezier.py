"""Piecewise Bezier curves, which describe lines by few control points (Qiao et al., CVPR 2023).

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
# A fit compares a line with a piece at this number of points of each. Both ends are included.
SAMPLES = 100
# Limit of the work of a search for joints, as a number of points per vertex of the line. The work
# of one fit is the number of vertices and points that it compares.
_WORK = 2000

Float = NDArray[np.float64]
# Function from the vertices of a line and the points of a curve to their deviation in metres.
Deviation = Callable[[Float, Float], float]


@cache
def bernstein(degree: int, num_points: int = SAMPLES) -> Float:
    """Compute the weights of the control points of a piece at equal steps of its parameter.

    Args:
        degree: Degree of the piece, 1 to ``MAX_DEGREE``.
        num_points: Number of values of the parameter from 0 to 1, both included.

    Returns:
        Weights, whose rows sum to 1. The array is cached, so it must not be changed.
        (num_points, degree + 1)

    Raises:
        ValueError: If the degree is out of range.
    """
    if not 1 <= degree <= MAX_DEGREE:
        raise InputError(f"the degree of a Bezier curve must be 1 to {MAX_DEGREE}, got {degree}.")
    t = np.linspace(0, 1, num_points)[:, None]
    k = np.arange(degree + 1)
    binomials: Float = np.array([comb(degree, each) for each in k.tolist()], np.float64)
    return binomials * t**k * (1 - t) ** (degree - k)


def curve_points(controls: Points, degree: int, num_points: int = SAMPLES) -> Float:
    """Compute points of a piecewise curve.

    Args:
        controls: Control points in metres. (k * degree + 1, D)
        degree: Degree of each piece, 1 to ``MAX_DEGREE``.
        num_points: Number of points of a piece, both ends included.

    Returns:
        Points in metres; joints occur once. (k * (num_points - 1) + 1, D)

    Raises:
        ValueError: If the degree is out of range, or the number of control points does not fit
            k >= 1 pieces.
    """
    controls = np.asarray(controls, dtype=np.float64)
    weights = bernstein(degree, num_points)
    if controls.ndim != 2 or len(controls) < degree + 1 or (len(controls) - 1) % degree:
        raise InputError(
            f"pieces of degree {degree} have {degree} control points each and one at the end, got "
            f"points of shape {controls.shape}."
        )
    pieces = []
    for start in range(0, len(controls) - 1, degree):
        piece = weights @ controls[start : start + degree + 1]
        # A later piece begins at the end of the previous one, so its first point is left out.
        pieces.append(piece if start == 0 else piece[1:])
    return np.concatenate(pieces)


@cache
def _inverse(degree: int) -> Float:
    """Matrix that computes a piece's control points from its points by least squares.

    (degree + 1, SAMPLES)
    """
    return np.linalg.pinv(bernstein(degree))


def fit_piece(points: Points, degree: int) -> Float:
    """Fit one piece to a line by least squares at points of equal arc distance.

    The ends of the piece are then moved to the ends of the line.

    Args:
        points: Vertices in metres. (n >= 2, D)
        degree: Degree of the piece, 1 to ``MAX_DEGREE``.

    Returns:
        Control points in metres. (degree + 1, D)

    Raises:
        ValueError: If the degree is out of range.
    """
    controls = _inverse(degree) @ resample(points, SAMPLES)
    controls[0] = points[0]
    controls[-1] = points[-1]
    return controls


def mean_deviation(line: Float, curve: Float, ignored_m: float = 0.05) -> float:
    """Compute the mean distance of a line and a curve, as in the public code of BeMapNet.

    Args:
        line: Vertices of the line in metres, which is resampled to 100 points. (n, D)
        curve: Points of the curve in metres. (m, D)
        ignored_m: Largest distance in metres that counts as 0.

    Returns:
        Average of the mean distance from the line to the curve and the mean distance from the curve
        to the line, in metres.
    """
    from scipy.spatial import distance  # imported here: result files are read without scipy

    between = distance.cdist(resample(line, SAMPLES), curve)  # (100, m)
    from_curve = between.min(0)  # from each point of the curve to the line
    from_line = between.min(1)  # from each point of the line to the curve
    mean_from_curve = np.where(from_curve <= ignored_m, 0, from_curve).mean()
    mean_from_line = np.where(from_line <= ignored_m, 0, from_line).mean()
    return float(np.mean([mean_from_curve, mean_from_line]))


def largest_deviation(line: Float, curve: Float) -> float:
    """Compute the largest distance of a line and a curve in the plane (Hausdorff distance).

    It is the largest of two sets of distances: from the points of the curve to the line, and from
    the vertices and 100 equidistant points of the line to the curve.

    Args:
        line: Vertices of the line in metres. (n, D)
        curve: Points of the curve in metres. (m, D)

    Returns:
        Largest distance in metres.
    """
    # Imported here: result files are read without numba.
    from gsmap.structures.curve_kernels import largest_deviation as compiled

    # The search ends early at a distance of ``enough``. With infinity, it never ends early.
    return compiled(_in_plane(line), _in_plane(curve), num_points=SAMPLES, enough=np.inf)


def _in_plane(points: Float) -> Float:
    """Return x and y of points as a contiguous array. (n, D) -> (n, 2)"""
    return np.ascontiguousarray(points[:, :2], np.float64)


def _fit_test(degree: int, max_error_m: float, deviation: Deviation) -> Callable[[Float], bool]:
    """Create the function that tests whether one piece fits a part of a line (n, D)."""

    def fits(part: Float) -> bool:
        curve = curve_points(fit_piece(part, degree), degree)
        return deviation(part, curve) < max_error_m

    # Only for the default deviation, there is a compiled function, which is much faster.
    if deviation is not largest_deviation:
        return fits
    from gsmap.structures.curve_kernels import deviation_of_fit

    inverse = _inverse(degree)
    weights = bernstein(degree)

    def fits_compiled(part: Float) -> bool:
        # The computation ends early when the error reaches ``enough``: the piece does not fit then.
        error_m = deviation_of_fit(_in_plane(part), inverse, weights=weights, enough=max_error_m)
        return bool(error_m < max_error_m)

    return fits_compiled


def fit_joints(
    points: Points,
    degree: int = 3,
    max_error_m: float = 0.1,
    deviation: Deviation = largest_deviation,
) -> list[int]:
    """Find the vertices of a line at which the pieces of its curve meet.

    Each piece is as long as the error allows: its end is searched from the end of the line
    backwards. Since this takes very long for long lines that turn at each vertex, the work of the
    search is limited. After the limit is reached, each piece starts with one edge of the line, and
    its length is doubled as long as the piece fits.

    Args:
        points: Vertices in metres. (n >= 2, D)
        degree: Degree of the pieces, 1 to ``MAX_DEGREE``.
        max_error_m: Deviation in metres below which a piece is accepted, > 0.
        deviation: Function from the vertices of a part of the line (n, D) and the points of its
            curve (m, D) to the deviation in metres.

    Returns:
        Indices of the vertices in rising order, both ends included.

    Raises:
        ValueError: If the line has fewer than two points, or a setting is out of range.
    """
    points = np.asarray(points, dtype=np.float64)
    if max_error_m <= 0:
        raise InputError(f"max_error_m must be more than 0, got {max_error_m}.")
    if len(points) < 2:
        raise InputError(f"a line has two points or more, got {len(points)}.")
    fits = _fit_test(degree, max_error_m, deviation=deviation)
    last = len(points) - 1
    work = _WORK * len(points)
    joints = [0]
    while joints[-1] < last:
        start = joints[-1]
        end = last  # the longest piece is tried first
        while end > start + 1 and work > 0:
            work -= end - start + SAMPLES  # vertices of the part, and points of the piece
            if fits(points[start : end + 1]):
                break
            end -= 1
        # The limit is reached, so the length is doubled instead. This replaces the end above, even
        # if the very last fit of the search was good.
        if work <= 0:
            end = start + 1  # a piece between neighbouring vertices is exact
            farther = min(start + 2, last)
            while end < farther and fits(points[start : farther + 1]):
                end = farther
                farther = min(2 * farther - start, last)
        joints.append(end)
    return joints


def controls_between(points: Points, joints: Sequence[int], degree: int) -> Float:
    """Fit pieces that meet at given vertices of a line.

    Args:
        points: Vertices in metres. (n >= 2, D)
        joints: Indices of the vertices in rising order, both ends included. (k + 1,)
        degree: Degree of the pieces, 1 to ``MAX_DEGREE``.

    Returns:
        Control points in metres. (k * degree + 1, D)
    """
    points = np.asarray(points, dtype=np.float64)
    controls = [points[:1]]
    for start, end in pairwise(joints):
        piece = fit_piece(points[start : end + 1], degree)
        controls.append(piece[1:])  # the first control point is the end of the previous piece
    return np.concatenate(controls)


def fit_pieces(
    points: Points,
    degree: int = 3,
    max_error_m: float = 0.1,
    deviation: Deviation = largest_deviation,
) -> Float:
    """Fit a line with few pieces, each as long as the error allows.

    Pieces meet at vertices of the line, which `fit_joints` selects. A piece between neighbouring
    vertices is exact, so there is always a fit. The public code of BeMapNet uses
    ``deviation=mean_deviation``.

    Args:
        points: Vertices in metres. (n >= 2, D)
        degree: Degree of the pieces, 1 to ``MAX_DEGREE``.
        max_error_m: Deviation in metres below which a piece is accepted, > 0.
        deviation: Function from the vertices of a part of the line (n, D) and the points of its
            curve (m, D) to the deviation in metres.

    Returns:
        Control points in metres. (k * degree + 1, D)

    Raises:
        ValueError: If the line has fewer than two points, or a setting is out of range.
    """
    joints = fit_joints(points, degree, max_error_m=max_error_m, deviation=deviation)
    return controls_between(points, joints, degree=degree)
