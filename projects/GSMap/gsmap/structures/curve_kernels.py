"""Compiled distances of lines and their curves; ``bezier`` is their only user."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled

Float = NDArray[np.float64]


@njit(cache=True)
def resampled(points: Float, num_points: int) -> Float:
    """Return points of a line at equal lengths, both ends included. (n, 2) -> (P, 2)"""
    along = np.zeros(len(points))
    for i in range(1, len(points)):
        dx, dy = points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1]
        along[i] = along[i - 1] + math.sqrt(dx * dx + dy * dy)
    found, i = np.empty((num_points, 2)), 0
    for k in range(num_points):
        at = along[-1] * k / (num_points - 1)
        while i < len(points) - 2 and along[i + 1] < at:
            i += 1
        length = along[i + 1] - along[i]
        share = min((at - along[i]) / length, 1.0) if length > 0.0 else 1.0
        for axis in range(2):
            found[k, axis] = points[i, axis] + share * (points[i + 1, axis] - points[i, axis])
    return found


@njit(cache=True)
def largest_distance(points: Float, line: Float, enough: float) -> float:
    """Return the largest distance of points from a line, in metres.

    Args:
        points: The points. (n, 2)
        line: Vertices of the line. (m, 2)
        enough: A distance of so much ends the search.
    """
    largest = 0.0
    for p in range(len(points)):
        x, y = points[p, 0], points[p, 1]
        nearest = np.inf
        for s in range(len(line) - 1):
            along_x, along_y = line[s + 1, 0] - line[s, 0], line[s + 1, 1] - line[s, 1]
            to_x, to_y = x - line[s, 0], y - line[s, 1]
            length = along_x * along_x + along_y * along_y
            share = (to_x * along_x + to_y * along_y) / length if length > 0.0 else 0.0
            share = min(max(share, 0.0), 1.0)
            to_x, to_y = to_x - share * along_x, to_y - share * along_y
            nearest = min(nearest, to_x * to_x + to_y * to_y)
        largest = max(largest, nearest)
        if largest >= enough * enough:
            break
    return math.sqrt(largest)


@njit(cache=True)
def largest_deviation(line: Float, curve: Float, num_points: int, enough: float) -> float:
    """Return the largest distance of a line and a curve, in metres.

    Args:
        line: Vertices of the line. (n, 2)
        curve: Points of the curve. (m, 2)
        num_points: Points of the line at equal lengths that count beside its vertices.
        enough: A distance of so much ends the search.
    """
    largest = largest_distance(resampled(line, num_points), curve, enough)
    if largest < enough:
        largest = max(largest, largest_distance(line, curve, enough))
    if largest < enough:
        largest = max(largest, largest_distance(curve, line, enough))
    return largest


@njit(cache=True)
def deviation_of_fit(line: Float, inverse: Float, weights: Float, enough: float) -> float:
    """Return the largest distance of a line and of the piece that is fitted to it, in metres.

    Args:
        line: Vertices of the line. (n, 2)
        inverse: What makes control points of points at equal lengths. (degree + 1, P)
        weights: What makes points of the curve of control points. (P, degree + 1)
        enough: A distance of so much ends the search.
    """
    controls = inverse @ resampled(line, len(weights))
    controls[0], controls[-1] = line[0], line[-1]
    return largest_deviation(line, weights @ controls, len(weights), enough)
