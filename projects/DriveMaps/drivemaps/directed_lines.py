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
    return line[np.append(True, differs)]  # the first vertex has no predecessor and is kept


def line_directions(line: FloatArray) -> FloatArray:
    """Unit direction at each vertex of a line without repeated vertices (`drop_repeats`). (n, 2)"""
    steps = np.diff(line, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    # A vertex has the mean direction of its two segments, and an end the direction of its segment.
    sums = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    # Where a line turns back, the sum is 0. The bound avoids a division by 0 there.
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)


def resample(line: FloatArray) -> FloatArray:
    """Sample a line at equal steps of at most ``STEP_M``, with both ends. -> (n >= 2, 2)"""
    line_string = shapely.LineString(line)
    num_steps = max(int(np.ceil(line_string.length / STEP_M)), 1)
    distances = np.linspace(0.0, line_string.length, num_steps + 1)  # from the start of the line
    return shapely.get_coordinates(shapely.line_interpolate_point(line_string, distances))


def border_tree(borders: list[FloatArray]) -> shapely.STRtree:
    """Spatial index of borders in metres; borders with fewer than two vertices are left out."""
    return shapely.STRtree([shapely.LineString(border) for border in borders if len(border) > 1])


def border_distances(
    line: FloatArray, side: int, borders: shapely.STRtree, reach_m: float
) -> FloatArray:
    """Distance from each vertex of a line to the nearest border beside it.

    Args:
        line: Vertices in the order of the line's direction, in metres, without repeated vertices.
            (n, 2)
        side: 1 for the left side, -1 for the right side.
        borders: Spatial index of dividers and boundaries, from `border_tree`.
        reach_m: Distance in metres up to which borders are searched, at a right angle to the line.

    Returns:
        Distances in metres, infinite where no border is within reach. (n,)
    """
    # A ray starts at each vertex and goes across the line, to the given side.
    across = side * reach_m * rotate_to_left(line_directions(line))
    rays = shapely.linestrings(np.stack([line, line + across], axis=1))
    # Pairs of a ray and a border that it crosses. A ray may be in several pairs.
    rows, border_indices = borders.query(rays, predicate="intersects")
    starts = shapely.points(line[rows])
    crossings = shapely.intersection(rays[rows], borders.geometries[border_indices])
    nearest_m = np.full(len(line), np.inf)
    # `fmin.at` takes the least distance of all pairs of a ray. Rounding may lead to an empty
    # crossing. Its distance is NaN, which `fmin` ignores.
    np.fmin.at(nearest_m, rows, shapely.distance(starts, crossings))
    return nearest_m
