"""What targets of lines share: parts of lines, the points that make each, and its mask."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmengine.structures import InstanceData
from numpy.typing import NDArray

from gsmap.models.lines.front import front_size
from gsmap.structures.elements import annotated
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed, padded, parts_inside, sampled
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

Points = NDArray[np.float64]
Part = tuple[int, Points]  # its class, and a line in [0, 1] from the front and the left


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
    """What PivotNet and BeMapNet make targets of: the few points that make a line, and its mask.

    ``gt_instances_3d`` has ``labels_3d`` (K,), ``pts`` (K, P, 2) in metres, the last point
    repeated, ``num_pts`` (K,), ``masks`` (K, H, W), with rows from the front and columns from the
    left, and ``redrawn`` (K,): whether a mask was drawn by these points, because lines hide one of
    that class.

    Args:
        edge_classes: Class indices whose rings become their two longest edges.
        pixel_m: Side of a pixel of the masks in metres; a config has it in the head.
        thickness_px: Width of lines in them.
        step_m: Lines are sampled at this distance first.
        sort_rings: Whether rings start at their rearmost vertex and run clockwise; by default they
            stay as they are annotated.

    Raises:
        ValueError: If a size is not positive, or ``edge_classes`` names a class that is not.
    """

    edge_classes: Sequence[int] = (1,)
    pixel_m: float = 0.15
    thickness_px: int = 8
    step_m: float = 1.0
    sort_rings: bool = False

    def __post_init__(self) -> None:
        check_positive(pixel_m=self.pixel_m, thickness_px=self.thickness_px, step_m=self.step_m)
        name, numbers = self.by_class()
        if not set(self.edge_classes) <= set(range(len(numbers))):
            raise InputError(
                f"edge_classes must be indices of the {len(numbers)} classes of {name}, got "
                f"{self.edge_classes}."
            )

    def by_class(self) -> tuple[str, Sequence[int]]:
        """Return the setting that has a number for each class: its name and the numbers."""
        raise NotImplementedError

    def most(self) -> int:
        """Return the largest number P of points of a line."""
        raise NotImplementedError

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Return the points that make a line, [0, 1] from the front and the left. (m, 2)"""
        raise NotImplementedError

    def way(self, points: Points, label: int) -> Points:
        """Return the way that points make."""
        return points

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets; ValueError without ground truth or for a class that has no number."""
        parts, grid = self.annotated(results)
        labels = [label for label, _ in parts]
        points = [self.points(line, label, grid) for label, line in parts]
        masks, redrawn = self.masks(parts, map(self.way, points, labels), front_size(grid))
        points_m = [grid.metres_from_front(own) for own in points]
        results["gt_instances_3d"] = InstanceData(
            labels_3d=torch.tensor(labels, dtype=torch.int64),
            pts=torch.from_numpy(padded(points_m, self.most())).float(),
            num_pts=torch.tensor([len(own) for own in points], dtype=torch.int64),
            masks=torch.from_numpy(masks),
            redrawn=torch.from_numpy(redrawn),
        )
        return results

    def annotated(self, results: dict[str, Any]) -> tuple[list[Part], BEVGrid]:
        """Return all parts of lines by class, and the masks' grid; ValueError without any truth."""
        elements = sorted(annotated(results, self), key=lambda element: element.label)
        grid = BEVGrid(results["x_range"], results["y_range"]).rasterized(self.pixel_m)
        return [(own.label, line) for own in elements for line in self.lines(own, grid)], grid

    def lines(self, element: Any, grid: BEVGrid) -> list[Points]:
        """Return the parts of an element on the map, [0, 1] from the front and the left."""
        name, numbers = self.by_class()
        if not 0 <= element.label < len(numbers):
            raise InputError(
                f"label {element.label} of an element, but {name} of "
                f"{type(self).__name__} is {numbers}: give one for each class."
            )
        whole = element.points[:, :2].astype(np.float64)
        lines, found = [whole], []
        if is_closed(whole) and element.label in self.edge_classes:
            longest = np.argsort(np.linalg.norm(np.diff(whole, axis=0), axis=1), kind="stable")[-2:]
            lines = [whole[i : i + 2] for i in longest]
        for line in lines:
            samples = sampled(line, self.step_m)
            if self.sort_rings and is_closed(line):
                samples = np.concatenate([samples, line[:1]])
            found += parts_inside(samples, grid.x_range, grid.y_range)
        return [grid.front_from_metres(line) for line in found]

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
