"""PivotNet's targets: the pivots of every line, and its mask."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mmdet3d.registry import TRANSFORMS
from numpy.typing import NDArray

from gsmap.models.lines.front import front_size
from gsmap.models.lines.targets import FormatLineTargets, Points, directed
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


def significances(points: Points) -> NDArray[np.float64]:
    """Return the area with which each point is removed, infinite for the ends. (n, 2) -> (n,)

    Visvalingam and Whyatt: the point of the smallest triangle with its neighbours goes first. A
    point counts at least as much as those removed before it.
    """
    areas, left, next_up = np.full(len(points), np.inf), list(range(len(points))), 0
    areas[1:-1] = _triangles(points[:-2], points[1:-1], points[2:])
    while len(left) > 2:
        at = next_up or int(np.argmin(areas[left]))
        smallest = areas[left.pop(at)]
        next_up = 0
        for near in (at, at - 1):  # what was on its right and on its left
            if 0 < near < len(left) - 1:
                areas[left[near]] = _triangles(*points[left[near - 1 : near + 2]])
                if areas[left[near]] <= smallest:
                    areas[left[near]], next_up = smallest, near
    return areas


def _triangles(a: Points, b: Points, c: Points) -> NDArray[np.float64]:
    """Return the areas of triangles. 3 x (..., 2) -> (...)"""
    (ax, ay), (bx, by), (cx, cy) = a.T, b.T, c.T
    return np.abs(ax * (by - cy) + bx * (cy - ay) + cx * (ay - by)) / 2


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatPivotTargets(FormatLineTargets):
    """Add ``gt_instances_3d`` with the pivots of lines, from ``map_instances``.

    Args:
        num_points: Most pivots P of a line of each class, which a config has in the head's
            queries; the other settings, and what the targets are, are those of
            `FormatLineTargets`.
        min_area_m2: A point is a pivot if its triangle is at least as large.
        keep_end: Whether a line of too many pivots keeps the most significant ones; by default the
            first, as released, so that its end is lost.

    Raises:
        ValueError: If a class has less than two points, or ``edge_classes`` names one that is not.
    """

    num_points: Sequence[int] = (10, 2, 30)
    min_area_m2: float = 2.0
    keep_end: bool = False

    def __post_init__(self) -> None:
        if min(self.num_points, default=0) < 2:
            raise InputError(f"num_points must be >= 2 for each class, got {self.num_points}.")
        super().__post_init__()

    def by_class(self) -> tuple[str, Sequence[int]]:
        """Return the setting that has a number for each class: its name and the numbers."""
        return "num_points", self.num_points

    def most(self) -> int:
        """Return the largest number P of pivots of a line."""
        return max(self.num_points)

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Return the pivots of a line, [0, 1] from the front and the left. (m, 2)"""
        size_m, most = np.array(front_size(grid)) * self.pixel_m, self.num_points[label]
        line_m = directed(line * size_m, 1.0, self.sort_rings)
        areas = significances(line_m)
        chosen = np.flatnonzero(areas >= self.min_area_m2)
        if self.keep_end and len(chosen) > most:
            chosen = np.sort(np.argsort(-areas, kind="stable")[:most])
        return line_m[chosen[:most]] / size_m
