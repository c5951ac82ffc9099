"""Directions of lines, and distances from a line to the borders beside it."""

import numpy as np
import shapely

from gsmap.structures.elements import FloatArray

STEP_M = 2.0
"""Largest distance in metres between the points at which directions and distances are measured."""


def rotate_to_left(directions: FloatArray) -> FloatArray:
    """Rotate vectors to the left by a right angle. (..., 2)"""
    return np.stack([-directions[..., 1], directions[..., 0]], axis=-1)


def drop_repeats(line: FloatArray) -> FloatArray:
    """Drop vertices that equal their predecessor, since the line has no direction there. (n, 2)"""
    differs = (np.diff(line, axis=0) != 0).any(axis=1)
    return line[np.append(True, differs)]


def line_directions(line: FloatArray) -> FloatArray:
    """Unit direction of a line at each vertex. (n, 2)"""
    steps = np.diff(line, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    # A vertex has the mean direction of its two segments, and an end the direction of its segment.
    sums = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)


def resample(line: FloatArray) -> FloatArray:
    """Sample a line at equal steps of at most ``STEP_M``, with both ends. -> (n >= 2, 2)"""
    shape = shapely.LineString(line)
    count = max(int(np.ceil(shape.length / STEP_M)), 1) + 1
    distances = np.linspace(0.0, shape.length, count)
    return shapely.get_coordinates(shapely.line_interpolate_point(shape, distances))


def border_tree(borders: list[FloatArray]) -> shapely.STRtree:
    """Spatial index of the borders with two vertices or more."""
    return shapely.STRtree([shapely.LineString(border) for border in borders if len(border) > 1])


def border_distances(
    line: FloatArray, side: int, borders: shapely.STRtree, reach_m: float
) -> FloatArray:
    """Distance from each vertex of a line to the nearest border beside it.

    Args:
        line: Line in its direction, in metres. (n, 2)
        side: 1 for the left side, -1 for the right side.
        borders: Spatial index of dividers and boundaries, from `border_tree`.
        reach_m: Distance up to which borders are searched, at a right angle to the line.

    Returns:
        Distances in metres, infinite where there is no border. (n,)
    """
    # A ray starts at each vertex and goes across the line, to the given side.
    across = side * reach_m * rotate_to_left(line_directions(line))
    rays = shapely.linestrings(np.stack([line, line + across], axis=1))
    rows, border_indices = borders.query(rays, predicate="intersects")
    starts = shapely.points(line[rows])
    crossings = shapely.intersection(rays[rows], borders.geometries[border_indices])
    nearest_m = np.full(len(line), np.inf)
    # Rounding may lead to an empty crossing. Its distance is NaN, which `fmin` ignores.
    np.fmin.at(nearest_m, rows, shapely.distance(starts, crossings))
    return nearest_m
