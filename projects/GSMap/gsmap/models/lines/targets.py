"""Targets of line heads: lines cut at the border of the map, their key points and their masks.

Points (u, v) are relative positions in the map. u is 0 at its front edge and 1 at its rear edge.
v is 0 at its left edge and 1 at its right edge.
"""

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
Part = tuple[int, Points]  # class index and points (u, v) of a line that is cut at the border


def orient_line(line: Points, tolerance: float, sort_rings: bool = False) -> Points:
    """Order the points of a line from its rear end to its front end.

    If the ends are level, the line starts at the right end.

    Args:
        line: Points (u, v) from the front and from the left. (n, 2)
        tolerance: Largest difference in u at which the ends count as level, in the unit of the
            points.
        sort_rings: Whether rings start at their rearmost vertex and run clockwise.

    Returns:
        The ordered points. (n, 2)
    """
    if sort_rings and is_closed(line):
        rearmost = int(line[:-1, 0].argmax())  # u increases to the rear
        ring = np.roll(line[:-1], -rearmost, axis=0)
        ring = np.concatenate([ring, ring[:1]])
        u = ring[:, 0]
        v = ring[:, 1]  # increases to the right
        # The shoelace formula gives twice the area, > 0 if a ring is anticlockwise. Here x = v and
        # y = -u. The minus sign is left out, so the result is > 0 if the ring is clockwise.
        doubled_areas = v[:-1] * u[1:] - v[1:] * u[:-1]
        is_clockwise = doubled_areas.sum() > 0
        return ring if is_clockwise else ring[::-1]
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
        # (u, v) times (H, W) gives (row, column), and OpenCV expects (column, row).
        cells = (line * size)[:, ::-1].astype(np.int32)
        canvas = np.zeros(size, dtype=np.uint8)  # OpenCV does not draw on boolean arrays
        mask = cv2.polylines(canvas, [cells], isClosed=False, color=(1,), thickness=thickness_px)
        masks.append(mask.astype(bool))
    rows, columns = size
    # Without lines, NumPy makes a float array (0,), which becomes (0, H, W) and boolean.
    return np.array(masks).reshape(-1, rows, columns).astype(bool)


@dataclass(eq=False)
class FormatLineTargets(BaseTransform):
    """Transform that makes the targets of a `LineHead`: key points and a mask of each line.

    A subclass defines the key points by `class_setting`, `max_points` and `points`. The transform
    sets ``gt_instances_3d`` with the fields

    - ``labels_3d``: Class indices. (K,)
    - ``pts``: Key points in metres, padded with the last one. (K, P, 2)
    - ``num_pts``: Number of key points. (K,)
    - ``masks``: Masks with rows from the front and columns from the left. (K, H, W)
    - ``redrawn``: True if the mask was drawn from the key points. This is done for all lines of a
      class if one of them is completely covered by others of the class. (K,)

    Args:
        edge_classes: Indices of classes whose rings are replaced by their two longest edges.
        pixel_m: Side of a pixel of the masks in metres. Configs set ``mask_pixel_m`` of the head,
            and the head's `target_settings` set it here.
        thickness_px: Width of the lines in the masks in pixels.
        step_m: Distance in metres between the samples of a line, from which its key points are
            computed.
        sort_rings: Whether rings start at their rearmost vertex and run clockwise. Otherwise they
            keep the annotated order.
        forward: Axis of the direction of travel, by default the longer side, as in `BEVGrid`.
            Configs set ``model.grid.forward``, which is copied to this setting.

    Raises:
        ValueError: If a size is not positive, or ``edge_classes`` has an unknown class.
    """

    edge_classes: Sequence[int] = (1,)
    pixel_m: float = 0.15
    thickness_px: int = 8
    step_m: float = 1.0
    sort_rings: bool = False
    forward: str | None = None

    def __post_init__(self) -> None:
        check_positive(pixel_m=self.pixel_m, thickness_px=self.thickness_px, step_m=self.step_m)
        name, numbers = self.class_setting()
        num_classes = len(numbers)
        if any(index not in range(num_classes) for index in self.edge_classes):
            raise InputError(
                f"edge_classes must be indices of the {num_classes} classes of {name}, got "
                f"{self.edge_classes}."
            )

    def class_setting(self) -> tuple[str, Sequence[int]]:
        """Name and value of a setting with a number for each class, such as a number of points."""
        raise NotImplementedError

    def max_points(self) -> int:
        """Largest number P of key points of a line."""
        raise NotImplementedError

    def points(self, line: Points, label: int, grid: BEVGrid) -> Points:
        """Compute the key points of a line.

        Args:
            line: Points (u, v) in [0, 1] from the front and the left. (n, 2)
            label: Index of the class.
            grid: Raster of the masks.

        Returns:
            Key points in [0, 1]. (m, 2)
        """
        raise NotImplementedError

    def polyline(self, points: Points, label: int) -> Points:
        """Compute the polyline through the key points of a line.

        Args:
            points: Key points in [0, 1]. (m, 2)
            label: Index of the class.

        Returns:
            Points of the polyline in [0, 1]. (n, 2)
        """
        return points

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets to a sample.

        Raises:
            ValueError: If there is no ground truth, or `class_setting` has no value for a class.
        """
        parts, grid = self.collect_parts(results)
        labels = []
        counts = []
        points_m = []
        polylines = []
        for label, line in parts:
            key_points = self.points(line, label, grid)
            labels.append(label)
            counts.append(len(key_points))
            points_m.append(grid.metres_from_front(key_points))
            polylines.append(self.polyline(key_points, label))
        # `front_size` returns the pixels along the direction of travel and across it.
        masks, redrawn = self.masks(parts, polylines=polylines, size=front_size(grid))
        results["gt_instances_3d"] = InstanceData(
            labels_3d=torch.tensor(labels, dtype=torch.int64),
            # `pad_lines` repeats the last point of each line up to the number of points.
            pts=torch.from_numpy(pad_lines(points_m, self.max_points())).float(),
            num_pts=torch.tensor(counts, dtype=torch.int64),
            masks=torch.from_numpy(masks),
            redrawn=torch.from_numpy(redrawn),
        )
        return results

    def collect_parts(self, results: dict[str, Any]) -> tuple[list[Part], BEVGrid]:
        """Collect the parts of the annotated lines, ordered by class, and the raster of the masks.

        Args:
            results: Sample with ``x_range``, ``y_range`` and the ground truth.

        Returns:
            Class and points (u, v) of each part, and the raster.

        Raises:
            ValueError: If there is no ground truth, or `class_setting` has no value for a class.
        """
        # The transform is only passed to be named in the error of a sample without ground truth.
        elements = sorted(ground_truth_elements(results, self), key=lambda element: element.label)
        area = BEVGrid(results["x_range"], results["y_range"], forward=self.forward)
        grid = area.rasterized(self.pixel_m)
        parts = []
        for element in elements:
            for line in self.lines(element, grid):
                parts.append((element.label, line))
        return parts, grid

    def lines(self, element: Any, grid: BEVGrid) -> list[Points]:
        """Cut an element into its parts within the map.

        Args:
            element: Map element, with ``label`` and ``points`` in metres (n, 2 or 3).
            grid: Raster of the masks.

        Returns:
            Points (u, v) in [0, 1] from the front and the left. (m, 2) each

        Raises:
            ValueError: If `class_setting` has no value for the class of the element.
        """
        name, numbers = self.class_setting()
        if not 0 <= element.label < len(numbers):
            raise InputError(
                f"label {element.label} of an element, but {name} of "
                f"{type(self).__name__} is {numbers}: give one for each class."
            )
        points_m = element.points[:, :2].astype(np.float64)
        lines = [points_m]
        if is_closed(points_m) and element.label in self.edge_classes:
            # The two longest edges replace the ring.
            lengths_m = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
            longest_edges = np.argsort(lengths_m, kind="stable")[-2:]
            lines = [points_m[start : start + 2] for start in longest_edges]
        parts = []
        for line in lines:
            # The samples begin at the first vertex and do not include the last one.
            samples = points_at_steps(line, self.step_m)
            if self.sort_rings and is_closed(line):  # append the first point to close the ring
                samples = np.concatenate([samples, line[:1]])
            # A line that leaves the map and returns has several parts.
            for part_m in parts_inside(samples, x_range=grid.x_range, y_range=grid.y_range):
                parts.append(grid.front_from_metres(part_m))
        return parts

    def masks(
        self, parts: Sequence[Part], polylines: Iterable[Points], size: tuple[int, int]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Draw the masks. Within a class, later lines cover earlier ones.

        If a line is covered completely, all lines of its class are drawn from their key points.

        Args:
            parts: Class and points of each line.
            polylines: Polyline (u, v) through the key points of each line.
            size: Rows H and columns W of the masks.

        Returns:
            Masks (K, H, W), and True for the masks that were drawn from key points (K,).
        """
        part_labels = []
        lines = []
        for label, line in parts:
            part_labels.append(label)
            lines.append(line)
        labels = np.array(part_labels, dtype=int)
        masks = draw_lines(lines, size, thickness_px=self.thickness_px)
        for index, mask in enumerate(masks):
            earlier_masks = masks[:index]  # a view: the masks are changed in place
            has_equal_class = labels[:index] == labels[index]
            earlier_masks[has_equal_class] &= ~mask
        is_empty = ~masks.any(axis=(1, 2))
        redrawn = np.isin(labels, labels[is_empty])
        polyline_masks = draw_lines(polylines, size, thickness_px=self.thickness_px)
        masks[redrawn] = polyline_masks[redrawn]
        return masks, redrawn
