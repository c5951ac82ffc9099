"""Geometry of polylines in the plane.

The arc length of a point is its distance from the start, measured along the polyline.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def arc_lengths(points: Array) -> Array:
    """Arc length of each point of a polyline, in metres. (n, 2) -> (n,)"""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: Array, spacing_m: float) -> Array:
    """Resample a polyline at equal distances.

    Args:
        points: Vertices in metres. (n, 2)
        spacing_m: Approximate distance between two points of the result, in metres.

    Returns:
        At least two points, the ends of the polyline included. (m, 2)
    """
    lengths = arc_lengths(points)
    count = max(2, round(lengths[-1] / spacing_m) + 1)
    return interpolate(points, lengths, at=np.linspace(0.0, lengths[-1], num=count))


def interpolate(values: Array, lengths: Array, at: Array) -> Array:
    """Interpolate linearly between rows of values.

    Args:
        values: One row per arc length. (n, D)
        lengths: Ascending arc lengths of the rows, in metres. (n >= 2,)
        at: Arc lengths of the result in metres, clipped to the range of ``lengths``. (k,)

    Returns:
        Interpolated rows. (k, D)
    """
    # `at` lies between the rows `left` and `left + 1`.
    left = np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, len(lengths) - 2)
    # Repeated vertices have a span of 0. The small value avoids a division by 0.
    span = np.maximum(lengths[left + 1] - lengths[left], 1e-12)
    share = np.clip((at - lengths[left]) / span, 0.0, 1.0)[:, None]
    return values[left] + share * (values[left + 1] - values[left])


def subline(points: Array, start_m: float, end_m: float) -> Array:
    """Part of a polyline between two arc lengths.

    Args:
        points: Vertices in metres. (n, 2)
        start_m: Arc length of the first point of the result, in metres.
        end_m: Arc length of the last point of the result, in metres.

    Returns:
        Vertices of the part. (m, 2)
    """
    lengths = arc_lengths(points)
    # Vertices strictly between the ends; a vertex at an end would be repeated.
    inner = lengths[(lengths > start_m + 1e-6) & (lengths < end_m - 1e-6)]
    return interpolate(points, lengths, at=np.concatenate([[start_m], inner, [end_m]]))


def tangents(points: Array) -> Array:
    """Unit direction of travel at each point of a polyline. (n, 2) -> (n, 2)"""
    # Half of the step from the previous to the next point; at an end, the step to its neighbour.
    steps = np.gradient(points, axis=0)
    return steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9)


def left_normals(points: Array) -> Array:
    """Unit normal to the left of travel at each point of a polyline. (n, 2) -> (n, 2)"""
    direction = tangents(points)
    return np.stack([-direction[:, 1], direction[:, 0]], axis=1)


def offset(points: Array, distance_m: float) -> Array:
    """Shift a polyline to its left by a distance in metres; < 0 to its right. (n, 2) -> (n, 2)"""
    return points + distance_m * left_normals(points)


def hermite(
    start: Array, start_dir: Array, end: Array, end_dir: Array, count: int, pull: float = 1.0
) -> Array:
    """Cubic Hermite curve between two points with given end directions.

    Args:
        start: First point in metres. (2,)
        start_dir: Unit direction of travel at the start. (2,)
        end: Last point in metres. (2,)
        end_dir: Unit direction of travel at the end. (2,)
        count: Number of points, >= 2.
        pull: Length of the end tangents relative to the distance between the ends. With longer
            tangents, the curve keeps the end directions for a longer way.

    Returns:
        Points at equal steps of the curve's parameter. (count, 2)
    """
    t = np.linspace(0.0, 1.0, num=count)[:, None]  # parameter of the curve
    reach = pull * float(np.linalg.norm(end - start))
    # The polynomials weigh the start, the tangent at the start, the end and the tangent at the end.
    return (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * reach * start_dir
        + (-2 * t**3 + 3 * t**2) * end
        + (t**3 - t**2) * reach * end_dir
    )


def strip(points: Array, half_width_m: float) -> Array:
    """Outline of a band around a polyline.

    Args:
        points: Centre line in metres. (n, 2)
        half_width_m: Distance of the outline from the centre line, in metres.

    Returns:
        The left side in the direction of travel, then the right side against it. (2n, 2)
    """
    shift = half_width_m * left_normals(points)
    left_side = points + shift
    right_side = points - shift
    return np.concatenate([left_side, right_side[::-1]])


def rectangle(center: Array, yaw_rad: float, length_m: float, width_m: float) -> Array:
    """Corners of a rectangle, anticlockwise.

    Args:
        center: Centre (x, y) in metres. (2,)
        yaw_rad: Direction of the length in radians, anticlockwise from +x.
        length_m: Extent along that direction, in metres.
        width_m: Extent across that direction, in metres.

    Returns:
        Front left, back left, back right and front right corner, in metres. (4, 2)
    """
    c = np.cos(yaw_rad)
    s = np.sin(yaw_rad)
    # Corners before the rotation. (4, 2)
    corners = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length_m, width_m]
    # Points are rows here, so the matrix is the transpose of a rotation by the yaw.
    return corners @ np.array([[c, s], [-s, c]]) + center


def unit(yaw_rad: float) -> Array:
    """Unit vector at an angle in radians, anticlockwise from +x. (2,)"""
    return np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
