"""PivotNet's targets: the pivots (vertices that determine the shape) and the mask of every line."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mmdet3d.registry import TRANSFORMS
from numpy.typing import NDArray

from gsmap.models.lines.front import front_size
from gsmap.models.lines.targets import FormatLineTargets, Points, orient_line
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


def significances(points: Points) -> NDArray[np.float64]:
    """Compute the significance of a line's points for simplification (Visvalingam and Whyatt).

    Each point but the ends forms a triangle with its two neighbours. The point with the smallest
    triangle is removed until only the ends remain. Its significance is the area of its triangle,
    but at least the significance of the points removed before it.

    Args:
        points: Vertices of the line. (n, 2)

    Returns:
        Areas, infinite for the ends. (n,)
    """
    areas = np.full(len(points), fill_value=np.inf)
    areas[1:-1] = _triangle_areas(points[:-2], points[1:-1], points[2:])
    remaining = list(range(len(points)))  # indices of the points that are not removed yet
    # Position of a neighbour of the removed point that is not more significant and is therefore
    # removed next. It is 0 if there is no such neighbour (0 is an end, which is never removed).
    next_position = 0
    while len(remaining) > 2:
        position = next_position or int(np.argmin(areas[remaining]))
        smallest = areas[remaining.pop(position)]
        next_position = 0
        # After the removal, the neighbours of the point are at `position` and `position - 1`.
        for neighbour in (position, position - 1):
            if not 0 < neighbour < len(remaining) - 1:
                continue
            before, point, after = remaining[neighbour - 1 : neighbour + 2]
            areas[point] = _triangle_areas(points[before], points[point], points[after])
            if areas[point] <= smallest:
                areas[point] = smallest
                next_position = neighbour
    return areas


def _triangle_areas(a: Points, b: Points, c: Points) -> NDArray[np.float64]:
    """Return the areas of triangles. Three (..., 2) -> (...)"""
    ax, ay = a.T
    bx, by = b.T
    cx, cy = c.T
    return np.abs(ax * (by - cy) + bx * (cy - ay) + cx * (ay - by)) / 2


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatPivotTargets(FormatLineTargets):
    """Add ``gt_instances_3d`` with the pivots of lines, selected from ``map_instances``.

    The fields of the targets and the other settings are described in `FormatLineTargets`.

    Args:
        num_points: Largest number of pivots of a line of each class, >= 2. Taken from the queries
            of the head if the pipeline does not set it.
        min_area_m2: Smallest significance of a pivot, in square metres.
        keep_end: Whether a line with too many pivots keeps the most significant ones. By default it
            keeps the first ones and loses its end, as in the released code.

    Raises:
        ValueError: If a class has fewer than two points, or if ``edge_classes`` has an unknown
            class.
    """

    num_points: Sequence[int] = (10, 2, 30)
    min_area_m2: float = 2.0
    keep_end: bool = False

    def __post_init__(self) -> None:
        if min(self.num_points, default=0) < 2:
            raise InputError(f"num_points must be >= 2 for each class, got {self.num_points}.")
        super().__post_init__()

    def class_setting(self) -> tuple[str, Sequence[int]]:
        """Return the name and the values of the setting with one number for each class."""
        return "num_points", self.num_points

    def max_points(self) -> int:
        """Return the largest number P of pivots of a line."""
        return max(self.num_points)

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Select the pivots of a line.

        Args:
            line: Points (from the front, from the left) in [0, 1]. (n, 2)
            label: Class index.
            grid: Raster of the masks.

        Returns:
            Pivots (from the front, from the left) in [0, 1]. (m, 2)
        """
        # Size of the map along the direction of travel and across it, from the number of pixels.
        size_m = np.array(front_size(grid)) * self.pixel_m
        max_pivots = self.num_points[label]
        # The line is directed from its rear end to its front end, or from right to left if its ends
        # are level. Ends are level if their distances from the front differ by up to 1 m.
        line_m = orient_line(line * size_m, tolerance=1.0, sort_rings=self.sort_rings)
        areas = significances(line_m)
        pivots = np.flatnonzero(areas >= self.min_area_m2)
        if self.keep_end and len(pivots) > max_pivots:
            most_significant = np.argsort(-areas, kind="stable")[:max_pivots]
            pivots = np.sort(most_significant)
        return line_m[pivots[:max_pivots]] / size_m
