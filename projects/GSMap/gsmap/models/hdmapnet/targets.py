"""HDMapNet's targets: which element each pixel belongs to, and its two directions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from numpy.typing import NDArray

from gsmap.models.hdmapnet.layout import ahead_size, pixels_from_metres
from gsmap.structures.elements import annotated
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import parts_inside, sampled
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

Pixels = NDArray[np.int32]


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeLineMaps(BaseTransform):
    """Add ``gt_lines`` and ``gt_directions``: elements drawn as lines, from ``map_instances``.

    ``gt_lines`` (classes, H, W) has the number of a line, from 1 on over all classes, and 0 for
    none; ``gt_directions`` (2, H, W) its direction 1 to K, forward and backward. Rows lie from the
    right to the left, columns from the rear to the front.

    Args:
        num_classes: Number of classes.
        pixel_m: Side of a pixel in metres; a config has it in the head.
        thickness_px: Width of the lines.
        gap_px: Width around lines of later classes in which earlier ones are erased.
        step_m: Lines are sampled at this distance first.
        num_directions: Directions K, likewise.
        forward: Axis of the direction of travel, by default the longer side, as in `BEVGrid`.

    Raises:
        ValueError: If a setting is not positive.
    """

    num_classes: int = 3
    pixel_m: float = 0.15
    thickness_px: int = 5
    gap_px: int = 9
    step_m: float = 1.0
    num_directions: int = 36
    forward: str | None = None

    def __post_init__(self) -> None:
        check_positive(num_classes=self.num_classes, pixel_m=self.pixel_m, step_m=self.step_m)
        check_positive(thickness_px=self.thickness_px, gap_px=self.gap_px)
        if self.num_directions < 1 or 360 % self.num_directions:
            raise InputError(f"num_directions must divide 360, got {self.num_directions}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets; ValueError without ground truth or for an unknown class."""
        elements = annotated(results, self)
        grid = BEVGrid(results["x_range"], results["y_range"], forward=self.forward)
        grid = grid.rasterized(self.pixel_m)
        numbers, directions = self.drawn(elements, grid)
        results["gt_lines"] = torch.from_numpy(numbers)
        results["gt_directions"] = torch.from_numpy(directions)
        return results

    def drawn(self, instances: Any, grid: BEVGrid) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
        """Draw lines class by class; they give way to lines of later classes beside them.

        -> (classes, H, W), (2, H, W)
        """
        size = ahead_size(grid)
        numbers = np.zeros((self.num_classes, *size), np.int16)
        ways = np.zeros((2, self.num_classes, *size), np.int16)
        for number, (label, line) in enumerate(self.lines(instances, grid), 1):
            cv2.polylines(numbers[label], [line], False, (number,), self.thickness_px)
            for way, points in zip(ways[:, label], (line, line[::-1]), strict=True):
                self.draw_directions(way, points)
            gap = cv2.polylines(np.zeros(size, np.uint8), [line], False, (1,), self.gap_px) > 0
            numbers[:label, gap] = 0
            ways[:, :label, gap] = 0
        return numbers, ways.max(1)

    def draw_directions(self, way: NDArray[np.int16], points: Pixels) -> None:
        """Draw the direction of each step of a line, later ones over earlier ones."""
        for (x0, y0), (x1, y1) in zip(points[:-1].tolist(), points[1:].tolist(), strict=True):
            angle = np.degrees(np.arctan2(y1 - y0, x1 - x0)) % 360
            direction = int(angle / (360 / self.num_directions) + 0.5) % self.num_directions + 1
            cv2.line(way, (x0, y0), (x1, y1), (direction,), self.thickness_px)

    def lines(self, instances: Any, grid: BEVGrid) -> Iterator[tuple[int, Pixels]]:
        """Yield class and pixels (column, row) of each part of an element on the map, by class."""
        for element in sorted(instances, key=lambda element: element.label):
            if not 0 <= element.label < self.num_classes:
                raise InputError(
                    f"label {element.label} of an element, but num_classes={self.num_classes} in "
                    "MakeLineMaps."
                )
            # as released without its end, and so nothing of a line below one step
            points = sampled(element.points[:, :2].astype(np.float64), self.step_m)
            for part in parts_inside(points, grid.x_range, grid.y_range):
                yield element.label, pixels_from_metres(part, grid).astype(np.int32)
