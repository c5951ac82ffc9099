"""HDMapNet's targets: the number of the line at each pixel, and its two directions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from numpy.typing import NDArray

from gsmap.models.hdmapnet.layout import forward_size, pixels_from_metres
from gsmap.structures.elements import ground_truth_elements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import parts_inside, points_at_steps
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

Pixels = NDArray[np.int32]


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeLineMaps(BaseTransform):
    """Add rasters of the elements, ``gt_lines`` and ``gt_directions``, from ``map_instances``.

    ``gt_lines`` (classes, H, W) contains the number of the line at each pixel, or 0 without a line.
    The lines of a sample are numbered from 1 across all classes. ``gt_directions`` (2, H, W)
    contains the forward and the backward direction of the line, from 1 to K, or 0 without a line.
    The first row is at the right of the vehicle, and the first column at the rear. A line is a
    part of an element inside the map. An element may have several parts.

    Args:
        num_classes: Number of classes.
        pixel_m: Side of a pixel in metres. Configs set ``pixel_m`` of the head, and the head's
            `target_settings` copy it to this transform.
        thickness_px: Width of the lines, in pixels.
        gap_px: Width around a line in which lines of earlier classes are erased, in pixels.
        step_m: Distance at which lines are sampled before they are drawn, in metres.
        num_directions: Number K of directions, a divisor of 360. It is copied like ``pixel_m``.
        forward: Axis of the direction of travel, by default the longer side, as in `BEVGrid`.

    Raises:
        ValueError: If a setting is not positive, or if ``num_directions`` does not divide 360.
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
        """Add the targets to a sample.

        Raises:
            ValueError: If the sample has no ground truth, or an element of an unknown class.
        """
        # ``map_instances`` of the sample; `self` names this transform in an error.
        elements = ground_truth_elements(results, self)
        grid = BEVGrid(results["x_range"], results["y_range"], forward=self.forward)
        numbers, directions = self.draw(elements, grid.rasterized(self.pixel_m))
        results["gt_lines"] = torch.from_numpy(numbers)
        results["gt_directions"] = torch.from_numpy(directions)
        return results

    def draw(self, instances: Any, grid: BEVGrid) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
        """Draw the elements class by class, and erase earlier classes around each line.

        Args:
            instances: Elements with ``label`` and ``points``.
            grid: Raster of the pixels.

        Returns:
            Line numbers (classes, H, W) and directions (2, H, W): forward, then backward. The
            direction of travel is along the columns.
        """
        size = forward_size(grid)
        numbers = np.zeros((self.num_classes, *size), dtype=np.int16)
        directions = np.zeros((2, self.num_classes, *size), dtype=np.int16)
        for number, (label, line) in enumerate(self.lines(instances, grid), start=1):
            cv2.polylines(
                numbers[label],
                pts=[line],
                isClosed=False,
                color=(number,),
                thickness=self.thickness_px,
            )
            # Forward direction, then backward direction.
            self.draw_directions(directions[0, label], line)
            self.draw_directions(directions[1, label], line[::-1])
            gap = np.zeros(size, dtype=np.uint8)
            cv2.polylines(gap, pts=[line], isClosed=False, color=(1,), thickness=self.gap_px)
            numbers[:label, gap > 0] = 0
            directions[:, :label, gap > 0] = 0
        # With gap_px >= thickness_px, erasing has left at most one class at each pixel.
        return numbers, directions.max(axis=1)

    def draw_directions(self, raster: NDArray[np.int16], points: Pixels) -> None:
        """Draw the direction of each segment of a line, later segments over earlier ones.

        Args:
            raster: Raster to draw on. (H, W)
            points: Vertices (column, row) of the line. (n, 2)
        """
        for start, end in zip(points[:-1].tolist(), points[1:].tolist(), strict=True):
            # Counted from the direction of increasing columns towards increasing rows.
            angle = np.degrees(np.arctan2(end[1] - start[1], end[0] - start[0])) % 360
            step = int(angle / (360 / self.num_directions) + 0.5)  # rounded
            direction = step % self.num_directions + 1  # 1 to K, as 0 means no line
            cv2.line(raster, start, end, color=(direction,), thickness=self.thickness_px)

    def lines(self, instances: Any, grid: BEVGrid) -> Iterator[tuple[int, Pixels]]:
        """Yield the class and the pixels of each part of an element on the map, sorted by class.

        Args:
            instances: Elements with ``label`` and ``points``.
            grid: Raster of the pixels.

        Yields:
            Class index and vertices (column, row) of a part. (n, 2)

        Raises:
            ValueError: If an element has an unknown class.
        """
        for element in sorted(instances, key=lambda element: element.label):
            if not 0 <= element.label < self.num_classes:
                raise InputError(
                    f"label {element.label} of an element, but num_classes={self.num_classes} in "
                    "MakeLineMaps."
                )
            # As in the released code, the samples do not include the last point of a line, so a
            # line that is shorter than one step is dropped.
            points = points_at_steps(element.points[:, :2].astype(np.float64), self.step_m)
            for part in parts_inside(points, grid.x_range, y_range=grid.y_range):
                yield element.label, pixels_from_metres(part, grid).astype(np.int32)
