"""Distances between lines and Bezier curves fitted to them.

The functions are kernels: numba compiles them, because `gsmap.structures.bezier` calls them very
often. Its search only asks whether a distance is below a limit, so they stop at a distance of
``enough``.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

import gsmap.utils.compilation  # noqa: F401 - logs a notice while kernels are compiled

Float = NDArray[np.float64]


@njit(cache=True)
def resample_line(points: Float, num_points: int) -> Float:
    """Resample a line to P >= 2 equidistant points, both ends included. (n, 2) -> (P, 2)"""
    along = np.zeros(len(points))  # distance of each vertex from the start along the line
    for i in range(1, len(points)):
        dx = points[i, 0] - points[i - 1, 0]
        dy = points[i, 1] - points[i - 1, 1]
        along[i] = along[i - 1] + math.sqrt(dx * dx + dy * dy)
    samples = np.empty((num_points, 2))
    i = 0  # index of the segment, which only increases with the distance
    for k in range(num_points):
        distance = along[-1] * k / (num_points - 1)
        while i < len(points) - 2 and along[i + 1] < distance:
            i += 1
        length = along[i + 1] - along[i]
        # Position in the segment, from 0 to 1. It may exceed 1 by rounding at the end of the line.
        share = min((distance - along[i]) / length, 1.0) if length > 0.0 else 1.0
        for axis in range(2):
            samples[k, axis] = points[i, axis] + share * (points[i + 1, axis] - points[i, axis])
    return samples


@njit(cache=True)
def largest_distance(points: Float, line: Float, enough: float) -> float:
    """Compute the largest distance of points from a line.

    Args:
        points: Points in metres. (n, 2)
        line: Vertices of the line in metres. (m, 2)
        enough: Distance in metres at which the search ends.

    Returns:
        Largest distance in metres. If it is at least ``enough``, any distance from ``enough`` to
        the largest one.
    """
    # Squared distances are compared, which saves a square root per segment.
    largest_squared = 0.0
    for p in range(len(points)):
        x = points[p, 0]
        y = points[p, 1]
        nearest_squared = np.inf
        for s in range(len(line) - 1):
            along_x = line[s + 1, 0] - line[s, 0]
            along_y = line[s + 1, 1] - line[s, 1]
            to_x = x - line[s, 0]
            to_y = y - line[s, 1]
            squared_length = along_x * along_x + along_y * along_y
            # Position of the nearest point of the segment, from 0 at its start to 1 at its end.
            share = 0.0
            if squared_length > 0.0:
                share = (to_x * along_x + to_y * along_y) / squared_length
            share = min(max(share, 0.0), 1.0)
            off_x = to_x - share * along_x
            off_y = to_y - share * along_y
            nearest_squared = min(nearest_squared, off_x * off_x + off_y * off_y)
        largest_squared = max(largest_squared, nearest_squared)
        if largest_squared >= enough * enough:
            break
    return math.sqrt(largest_squared)


@njit(cache=True)
def largest_deviation(line: Float, curve: Float, num_points: int, enough: float) -> float:
    """Compute the largest distance from a line to a curve, and from the curve to the line.

    Args:
        line: Vertices of the line in metres. (n, 2)
        curve: Points of the curve in metres. (m, 2)
        num_points: Number of equidistant points of the line that are measured in addition to its
            vertices.
        enough: Distance in metres at which the search ends.

    Returns:
        Larger of both distances in metres. If it is at least ``enough``, any distance from
        ``enough`` to the larger one.
    """
    largest = largest_distance(resample_line(line, num_points), curve, enough=enough)
    if largest < enough:
        largest = max(largest, largest_distance(line, curve, enough=enough))
    if largest < enough:
        largest = max(largest, largest_distance(curve, line, enough=enough))
    return largest


@njit(cache=True)
def deviation_of_fit(line: Float, inverse: Float, weights: Float, enough: float) -> float:
    """Fit one Bezier curve to a line and compute the largest distance between the two.

    The curve is fitted by least squares to points at equal distances. The first and last control
    points are then moved to the ends of the line.

    Args:
        line: Vertices of the line in metres. (n, 2)
        inverse: Pseudo-inverse of ``weights``: from points of the line to control points.
            (degree + 1, P)
        weights: Matrix from control points to points of the curve. (P, degree + 1)
        enough: Distance in metres at which the search ends.

    Returns:
        Largest distance in metres. If it is at least ``enough``, any distance from ``enough`` to
        the largest one.
    """
    controls = inverse @ resample_line(line, len(weights))
    controls[0] = line[0]
    controls[-1] = line[-1]
    curve = weights @ controls
    return largest_deviation(line, curve, num_points=len(weights), enough=enough)
