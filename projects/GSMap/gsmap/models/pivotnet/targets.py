"""PivotNet's targets: the pivots of every line, and its mask."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from mmengine.structures import InstanceData
from numpy.typing import NDArray

from gsmap.models.pivotnet.front import front_size
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed, sampled

Points = NDArray[np.float64]
Part = tuple[int, Points]  # its class, and a line in [0, 1] from the front and the left


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


def directed(line: Points, tolerance: float, sort_rings: bool = False) -> Points:
    """Let a line start at its rear end or, of ends at one height, at the one farther right.

    Args:
        line: Points (u, v) from the front and from the left, all in one unit. (n, 2)
        tolerance: Ends whose heights differ by at most that lie at one height.
        sort_rings: Whether a ring starts at its rearmost vertex and runs clockwise.

    Returns:
        The points in their order. (n, 2)
    """
    if sort_rings and is_closed(line):
        ring = np.roll(line[:-1], -int(line[:-1, 0].argmax()), 0)
        ring = np.concatenate([ring, ring[:1]])
        turns = ring[:-1, 1] * ring[1:, 0] - ring[1:, 1] * ring[:-1, 0]  # seen with u downwards
        return ring if turns.sum() > 0 else ring[::-1]
    (u0, v0), (u1, v1) = line[0], line[-1]
    starts_well = u0 > u1 if abs(u0 - u1) > tolerance else v0 >= v1
    return line if starts_well else line[::-1]


def drawn(lines: Iterable[Points], size: tuple[int, int], thickness_px: int) -> NDArray[np.bool_]:
    """Draw lines, [0, 1] from the front and the left, each on a raster of its own. (K, H, W)"""
    masks = []
    for line in lines:
        cells = (line * size)[:, ::-1].astype(np.int32)
        mask = cv2.polylines(np.zeros(size, np.uint8), [cells], False, (1,), thickness_px)
        masks.append(mask.astype(bool))
    return np.array(masks).reshape(-1, *size).astype(bool)


@dataclass(eq=False)
class FormatLineTargets(BaseTransform):
    """What PivotNet and BeMapNet make targets of: parts of lines, and their masks.

    Args:
        edge_classes: Class indices whose rings become their two longest edges.
        pixel_m: Side of a pixel of the masks in metres.
        thickness_px: Width of lines in them.
        step_m: Lines are sampled at this distance first.
        sort_rings: Whether rings start at their rearmost vertex and run clockwise; by default they
            stay as they are annotated.
    """

    edge_classes: Sequence[int] = (1,)
    pixel_m: float = 0.15
    thickness_px: int = 8
    step_m: float = 1.0
    sort_rings: bool = False

    def by_class(self) -> tuple[str, Sequence[int]]:
        """Return the setting with a number for each class, and its value."""
        raise NotImplementedError

    def __post_init__(self) -> None:
        name, numbers = self.by_class()
        if not set(self.edge_classes) <= set(range(len(numbers))):
            raise ValueError(
                f"edge_classes must be indices of the {len(numbers)} classes of {name}, got "
                f"{self.edge_classes}."
            )

    def annotated(self, results: dict[str, Any]) -> tuple[list[Part], BEVGrid]:
        """Return all parts of lines by class, and the masks' grid; ValueError without any truth."""
        if results["map_instances"] is None:
            name = type(self).__name__
            raise ValueError(
                f"sample {results['token']!r} has no ground truth: leave {name} out of this "
                "pipeline."
            )
        grid = BEVGrid(results["x_range"], results["y_range"]).rasterized(self.pixel_m)
        elements = sorted(results["map_instances"], key=lambda element: element.label)
        return [(own.label, line) for own in elements for line in self.lines(own, grid)], grid

    def instances(
        self, labels: Sequence[int], lines_m: Sequence[Points], masks: NDArray[np.bool_], most: int
    ) -> InstanceData:
        """Return targets: lines of at most ``most`` points in metres, the last one repeated."""
        points = [np.pad(line, ((0, most - len(line)), (0, 0)), "edge") for line in lines_m]
        return InstanceData(
            labels_3d=torch.tensor(labels, dtype=torch.int64),
            pts=torch.from_numpy(np.array(points, np.float32).reshape(-1, most, 2)),
            num_pts=torch.tensor([len(line) for line in lines_m], dtype=torch.int64),
            masks=torch.from_numpy(masks),
        )

    def lines(self, element: Any, grid: BEVGrid) -> list[Points]:
        """Return the parts of an element on the map, [0, 1] from the front and the left."""
        name, numbers = self.by_class()
        if not 0 <= element.label < len(numbers):
            raise ValueError(
                f"label {element.label} of an element, but {name} of {type(self).__name__} is "
                f"{numbers}: give one for each class."
            )
        box = shapely.box(grid.x_range[0], grid.y_range[0], grid.x_range[1], grid.y_range[1])
        whole = element.points[:, :2].astype(np.float64)
        lines, found = [whole], []
        if is_closed(whole) and element.label in self.edge_classes:
            longest = np.argsort(np.linalg.norm(np.diff(whole, axis=0), axis=1), kind="stable")[-2:]
            lines = [whole[i : i + 2] for i in longest]
        for line in lines:
            samples = sampled(line, self.step_m)
            if self.sort_rings and is_closed(line):
                samples = np.concatenate([samples, line[:1]])
            if len(samples) > 1:  # as released, a line that crosses itself becomes several
                parts = shapely.get_parts(shapely.LineString(samples).intersection(box))
                found += [shapely.get_coordinates(part) for part in parts]
        return [grid.front_from_metres(line) for line in found if len(line) > 1]

    def masks(
        self, parts: Sequence[Part], pivots: Iterable[Points], size: tuple[int, int]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Draw the lines of each class over each other; by their pivots if one is hidden.

        The masks, and which of them are drawn by pivots. (K, H, W), (K,)
        """
        labels = np.array([label for label, _ in parts], int)
        masks = drawn((line for _, line in parts), size, self.thickness_px)
        for i in range(len(masks)):
            masks[:i][labels[:i] == labels[i]] &= ~masks[i]
        hidden = np.isin(labels, labels[~masks.any((1, 2))])
        masks[hidden] = drawn(pivots, size, self.thickness_px)[hidden]
        return masks, hidden


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatPivotTargets(FormatLineTargets):
    """Add ``gt_instances_3d`` with the pivots of lines, from ``map_instances``.

    It has ``labels_3d`` (K,), ``pts`` (K, P, 2) in metres, the last pivot repeated, ``num_pts``
    (K,) and ``masks`` (K, H, W), with rows from the front and columns from the left.

    Args:
        num_points: Most pivots P of a line of each class, as in the head; the other settings are
            those of `FormatLineTargets`.
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
            raise ValueError(f"num_points must be >= 2 for each class, got {self.num_points}.")
        super().__post_init__()

    def by_class(self) -> tuple[str, Sequence[int]]:
        """Return the setting with a number for each class, and its value."""
        return "num_points", self.num_points

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets; ValueError without ground truth or for a class that has no number."""
        parts, grid = self.annotated(results)
        pivots = [self.pivots(line, label, grid) for label, line in parts]
        masks, _ = self.masks(parts, pivots, front_size(grid))
        labels, lines_m = [label for label, _ in parts], map(grid.metres_from_front, pivots)
        found = self.instances(labels, list(lines_m), masks, max(self.num_points))
        results["gt_instances_3d"] = found
        return results

    def pivots(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Return the pivots of a line, [0, 1] from the front and the left. (m, 2)"""
        size_m, most = np.array(front_size(grid)) * self.pixel_m, self.num_points[label]
        line_m = directed(line * size_m, 1.0, self.sort_rings)
        areas = significances(line_m)
        chosen = np.flatnonzero(areas >= self.min_area_m2)
        if self.keep_end and len(chosen) > most:
            chosen = np.sort(np.argsort(-areas, kind="stable")[:most])
        return line_m[chosen[:most]] / size_m
