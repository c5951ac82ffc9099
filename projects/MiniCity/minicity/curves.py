"""Plane curves that roads are made of."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def arc_lengths(points: Array) -> Array:
    """Distance along a polyline at each of its points, in metres. (n, 2) -> (n,)"""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def resample(points: Array, spacing_m: float) -> Array:
    """Equally spaced points along a polyline, about ``spacing_m`` apart. (n, 2) -> (m, 2)"""
    lengths = arc_lengths(points)
    count = max(2, round(lengths[-1] / spacing_m) + 1)
    return interpolate(points, lengths, np.linspace(0.0, lengths[-1], count))


def interpolate(values: Array, lengths: Array, at: Array) -> Array:
    """Interpolate between rows of values. (k, D)

    Args:
        values: A row at each arc length. (n, D)
        lengths: Ascending arc lengths. (n,)
        at: Arc lengths of the result. (k,)
    """
    left = np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, len(lengths) - 2)
    span = np.maximum(lengths[left + 1] - lengths[left], 1e-12)
    share = np.clip((at - lengths[left]) / span, 0.0, 1.0)[:, None]
    return values[left] + share * (values[left + 1] - values[left])


def subline(points: Array, start_m: float, end_m: float) -> Array:
    """Return the part of a polyline between two arc lengths. (m, 2)

    Args:
        points: The polyline, in metres. (n, 2)
        start_m: Arc length of the first point.
        end_m: Arc length of the last point.
    """
    lengths = arc_lengths(points)
    inner = lengths[(lengths > start_m + 1e-6) & (lengths < end_m - 1e-6)]
    return interpolate(points, lengths, np.concatenate([[start_m], inner, [end_m]]))


def tangents(points: Array) -> Array:
    """Unit direction of travel at each point of a polyline. (n, 2) -> (n, 2)"""
    steps = np.gradient(points, axis=0)
    return steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9)


def left_normals(points: Array) -> Array:
    """Unit vectors to the left of travel at each point of a polyline. (n, 2) -> (n, 2)"""
    direction = tangents(points)
    return np.stack([-direction[:, 1], direction[:, 0]], axis=1)


def offset(points: Array, distance_m: float) -> Array:
    """A polyline moved to its left by ``distance_m``. (n, 2) -> (n, 2)"""
    return points + distance_m * left_normals(points)


def hermite(
    start: Array, start_dir: Array, end: Array, end_dir: Array, count: int, pull: float = 1.0
) -> Array:
    """A cubic curve with given ends and end directions.

    Args:
        start: First point. (2,)
        start_dir: Unit direction of travel at the start. (2,)
        end: Last point. (2,)
        end_dir: Unit direction of travel at the end. (2,)
        count: Number of points.
        pull: Length of the end tangents relative to the distance between the ends.

    Returns:
        The curve. (count, 2)
    """
    t = np.linspace(0.0, 1.0, count)[:, None]
    reach = pull * float(np.linalg.norm(end - start))
    return (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * reach * start_dir
        + (-2 * t**3 + 3 * t**2) * end
        + (t**3 - t**2) * reach * end_dir
    )


def strip(points: Array, half_width_m: float) -> Array:
    """The outline of a band around a polyline. (n, 2) -> (2n, 2)"""
    normals = left_normals(points)
    return np.concatenate(
        [points + half_width_m * normals, (points - half_width_m * normals)[::-1]]
    )


def rectangle(center: Array, yaw_rad: float, length_m: float, width_m: float) -> Array:
    """Return the corners of a rectangle, anticlockwise. (4, 2)

    Args:
        center: Its middle (x, y) in metres. (2,)
        yaw_rad: Direction of its length, anticlockwise from +x.
        length_m: Extent along that direction.
        width_m: Extent across it.
    """
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    corners = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length_m, width_m]
    return corners @ np.array([[c, s], [-s, c]]) + center


def unit(yaw_rad: float) -> Array:
    """The unit vector at an angle from +x. (2,)"""
    return np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
