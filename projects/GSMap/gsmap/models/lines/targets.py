"""Base class of the targets of line heads: parts of lines, their key points and their masks."""

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
from gsmap.structures.elements import ground_truth_elements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed, pad_lines, parts_inside, points_at_steps
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

Points = NDArray[np.float64]
Part = tuple[int, Points]  # class index, and a line (u, v) in [0, 1] from the front and the left


def direct_line(line: Points, tolerance: float, sort_rings: bool = False) -> Points:
    """Order a line from its rear end to its front end.

    If both ends are level, the line starts at the right one.

    Args:
        line: Points (u, v) from the front and from the left. (n, 2)
        tolerance: Largest difference in u of two level ends, in the unit of the points.
        sort_rings: Let rings start at their rearmost vertex and run clockwise.

    Returns:
        The ordered points. (n, 2)
    """
    if sort_rings and is_closed(line):
        ring = np.roll(line[:-1], -int(line[:-1, 0].argmax()), 0)
        ring = np.concatenate([ring, ring[:1]])
        areas = ring[:-1, 1] * ring[1:, 0] - ring[1:, 1] * ring[:-1, 0]  # with u downwards
        return ring if areas.sum() > 0 else ring[::-1]
    u_first, v_first = line[0]
    u_last, v_last = line[-1]
    is_level = abs(u_first - u_last) <= tolerance
    is_ordered = v_first >= v_last if is_level else u_first > u_last
    return line if is_ordered else line[::-1]


def draw_lines(
    lines: Iterable[Points], size: tuple[int, int], thickness_px: int
) -> NDArray[np.bool_]:
    """Draw each line on a raster.

    Args:
        lines: Points (u, v) in [0, 1] from the front and the left. (n, 2) each
        size: Rows H and columns W of the rasters.
        thickness_px: Width of the lines in pixels.

    Returns:
        A mask per line. (K, H, W)
    """
    masks = []
    for line in lines:
        cells = (line * size)[:, ::-1].astype(np.int32)
        mask = cv2.polylines(np.zeros(size, np.uint8), [cells], False, (1,), thickness_px)
        masks.append(mask.astype(bool))
    return np.array(masks).reshape(-1, *size).astype(bool)


@dataclass(eq=False)
class FormatLineTargets(BaseTransform):
    """Transform that computes the targets of a `LineHead`: key points of each line, and its mask.

    It sets ``gt_instances_3d`` with ``labels_3d`` (K,); ``pts`` (K, P, 2) in metres, where the last
    point is repeated; their number ``num_pts`` (K,); ``masks`` (K, H, W), with rows from the front
    and columns from the left; and ``redrawn`` (K,): whether the mask was drawn from the key points,
    because other lines of the class cover a line completely.

    Args:
        edge_classes: Indices of classes whose rings are replaced by their two longest edges.
        pixel_m: Side of a pixel of the masks in metres; a config sets it in the head.
        thickness_px: Width of the lines in the masks in pixels.
        step_m: Distance of the samples of a line, from which its key points are computed.
        sort_rings: Let rings start at their rearmost vertex and run clockwise. Otherwise they keep
            the annotated order.

    Raises:
        ValueError: If a size is not positive, or ``edge_classes`` has an unknown class.
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
        """Name and value of the setting with a number for each class."""
        raise NotImplementedError

    def most(self) -> int:
        """Largest number P of key points of a line."""
        raise NotImplementedError

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Key points of a line.

        Args:
            line: Points (u, v) in [0, 1] from the front and the left. (n, 2)
            label: Index of the class.
            grid: Raster of the masks.

        Returns:
            Key points in [0, 1]. (m, 2)
        """
        raise NotImplementedError

    def way(self, points: Points, label: int) -> Points:
        """Polyline through the key points of a line, in [0, 1]."""
        return points

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets to a sample.

        Raises:
            ValueError: If there is no ground truth, or the setting of `by_class` lacks a class.
        """
        parts, grid = self.collect_parts(results)
        labels = []
        points = []
        points_m = []
        ways = []
        for label, line in parts:
            key_points = self.points(line, label, grid)
            labels.append(label)
            points.append(key_points)
            points_m.append(grid.metres_from_front(key_points))
            ways.append(self.way(key_points, label))
        masks, redrawn = self.masks(parts, pivots=ways, size=front_size(grid))
        results["gt_instances_3d"] = InstanceData(
            labels_3d=torch.tensor(labels, dtype=torch.int64),
            pts=torch.from_numpy(pad_lines(points_m, self.most())).float(),
            num_pts=torch.tensor([len(key_points) for key_points in points], dtype=torch.int64),
            masks=torch.from_numpy(masks),
            redrawn=torch.from_numpy(redrawn),
        )
        return results

    def collect_parts(self, results: dict[str, Any]) -> tuple[list[Part], BEVGrid]:
        """Parts of the annotated lines, ordered by class, and the raster of the masks.

        Raises:
            ValueError: If there is no ground truth.
        """
        elements = sorted(ground_truth_elements(results, self), key=lambda element: element.label)
        grid = BEVGrid(results["x_range"], results["y_range"]).rasterized(self.pixel_m)
        parts = []
        for element in elements:
            for line in self.lines(element, grid):
                parts.append((element.label, line))
        return parts, grid

    def lines(self, element: Any, grid: BEVGrid) -> list[Points]:
        """Parts of an element within the map, in [0, 1] from the front and the left.

        Raises:
            ValueError: If the setting of `by_class` lacks the class of the element.
        """
        name, numbers = self.by_class()
        if not 0 <= element.label < len(numbers):
            raise InputError(
                f"label {element.label} of an element, but {name} of "
                f"{type(self).__name__} is {numbers}: give one for each class."
            )
        whole = element.points[:, :2].astype(np.float64)
        lines = [whole]
        if is_closed(whole) and element.label in self.edge_classes:
            longest = np.argsort(np.linalg.norm(np.diff(whole, axis=0), axis=1), kind="stable")[-2:]
            lines = [whole[i : i + 2] for i in longest]
        parts = []
        for line in lines:
            samples = points_at_steps(line, self.step_m)
            if self.sort_rings and is_closed(line):
                samples = np.concatenate([samples, line[:1]])
            parts += parts_inside(samples, grid.x_range, grid.y_range)
        return [grid.front_from_metres(part) for part in parts]

    def masks(
        self, parts: Sequence[Part], pivots: Iterable[Points], size: tuple[int, int]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Draw the masks; within a class, later lines cover earlier ones.

        If a line is covered completely, all lines of its class are drawn from their key points.

        Args:
            parts: Class and points of each line.
            pivots: Polylines through the key points of each line.
            size: Rows H and columns W of the masks.

        Returns:
            Masks (K, H, W), and whether a mask was drawn from key points (K,).
        """
        labels = np.array([label for label, _ in parts], int)
        lines = [line for _, line in parts]
        masks = draw_lines(lines, size, self.thickness_px)
        for index, mask in enumerate(masks):
            earlier_of_class = labels[:index] == labels[index]
            masks[:index][earlier_of_class] &= ~mask
        hidden = np.isin(labels, labels[~masks.any((1, 2))])
        masks[hidden] = draw_lines(pivots, size, self.thickness_px)[hidden]
        return masks, hidden
