"""Segmentation targets: masks of map elements in BEV and in the camera views."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from mmengine.logging import print_log
from torch.utils.data import get_worker_info

from gsmap.datasets.annotations.record import MapInstance
from gsmap.structures.elements import ground_truth_elements
from gsmap.structures.grid import padded_size
from gsmap.structures.polylines import resample
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

_NUM_PV_POINTS = 200  # resampled points of an element for its projection into the cameras
_EPSILON = 1e-7  # metres, added to depths before a division


def bev_cells(instance: MapInstance, results: dict[str, Any], size: tuple[int, int]) -> np.ndarray:
    """Compute the BEV cells of the vertices of an element, truncated to integers.

    Args:
        instance: Map element in metres in the annotation frame.
        results: Results of the pipeline, with ``x_range`` and ``y_range`` in metres.
        size: Rows and columns of the raster.

    Returns:
        Cells (column, row), int32. (n, 2)
    """
    ranges = np.array([results["x_range"], results["y_range"]])
    low, high = ranges.T
    num_rows, num_columns = size
    # Columns run along x and rows along y.
    cells_per_metre = np.array([num_columns, num_rows]) / (high - low)
    points = instance.points[:, :2].astype(np.float64)
    cells = (points - low) * cells_per_metre
    return cells.astype(np.int32)


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeBEVMask(BaseTransform):
    """Add ``gt_seg``, the BEV masks of the map elements, float32. (channels, H, W)

    Coordinates of vertices are truncated to integers, as in the public code of the methods.

    Args:
        size: Rows H and columns W over the range of the ground truth.
        thickness_px: Width of the lines in cells.
        num_classes: Number of channels, one for each class; None for one channel with all classes.

    Raises:
        ValueError: If a number is not positive.
    """

    size: tuple[int, int] = (200, 100)
    thickness_px: int = 3
    num_classes: int | None = None

    def __post_init__(self) -> None:
        check_positive(rows=self.size[0], columns=self.size[1])
        check_positive(thickness_px=self.thickness_px, num_classes=self.num_classes or 1)

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Draw the masks.

        Raises:
            ValueError: If the sample has no ground truth, or a label is not less than
                ``num_classes``.
        """
        masks = np.zeros((self.num_classes or 1, *self.size), dtype=np.uint8)
        # A list of `MapInstance`. Without ground truth, an error names this transform.
        for instance in ground_truth_elements(results, self):
            cells = bev_cells(instance, results, size=self.size)
            channel = channel_of(instance, self.num_classes)
            _draw_line(masks[channel], cells, thickness_px=self.thickness_px)
        results["gt_seg"] = torch.from_numpy(masks.astype(np.float32))
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeInstanceMasks(BaseTransform):
    """Add ``masks`` to ``gt_instances_3d``: a BEV mask of each element, bool. (K, H, W)

    Masks of elements of one class do not overlap: a common cell belongs to the later element. Cells
    near elements with a higher label are removed. Coordinates are truncated as in `MakeBEVMask`.

    Args:
        size: Rows H and columns W over the range of the ground truth.
        thickness_px: Width of the lines in cells.
        gap_px: Width in cells of a line along each element. Within this line, cells of elements
            with a lower label are removed.
        mirrored: Whether to flip the masks left to right, as in the public code of MGMap. Flipped
            masks do not fit the BEV features.

    Raises:
        ValueError: If a number is not positive.
    """

    size: tuple[int, int] = (200, 100)
    thickness_px: int = 3
    gap_px: int = 7
    mirrored: bool = True

    def __post_init__(self) -> None:
        check_positive(rows=self.size[0], columns=self.size[1])
        check_positive(thickness_px=self.thickness_px, gap_px=self.gap_px)

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Draw the masks.

        Raises:
            ValueError: If the sample has no ground truth, or the pipeline has no `FormatMapTargets`
                before this transform.
        """
        instances = ground_truth_elements(results, self)
        if "gt_instances_3d" not in results:
            raise InputError(
                f"sample {results['token']!r} has no targets yet: put MakeInstanceMasks behind "
                "FormatMapTargets in the pipeline."
            )
        masks = np.zeros((len(instances), *self.size), dtype=np.uint8)  # cv2 draws no booleans
        # Wider lines, in which cells of elements with a lower label are removed.
        gaps = np.zeros_like(masks)
        for index, instance in enumerate(instances):
            cells = bev_cells(instance, results, size=self.size)
            _draw_line(masks[index], cells, thickness_px=self.thickness_px)
            _draw_line(gaps[index], cells, thickness_px=self.gap_px)
        labels = np.array([instance.label for instance in instances])
        for index, label in enumerate(labels):
            # The masks of later elements are still complete here.
            later_masks = masks[index + 1 :]
            later_labels = labels[index + 1 :]
            later_of_class = later_masks[later_labels == label]
            gaps_of_higher_labels = gaps[labels > label]
            blocked = np.concatenate([later_of_class, gaps_of_higher_labels])
            masks[index] &= ~blocked.any(0)
        masks = masks[..., ::-1] if self.mirrored else masks
        results["gt_instances_3d"].masks = torch.from_numpy(masks.astype(bool))
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakePVMask(BaseTransform):
    """Add ``gt_pv_seg``, the masks of the elements in the camera views. (V, channels, h, w)

    The masks are float32 and have the resolution of the feature maps. The transform must follow all
    transforms that resize images.

    Args:
        stride: Image pixels per feature pixel.
        pad_size_divisor: Divisor of the image size after the padding before the backbone.
        ground_z_m: Height of the ground in the annotation frame in metres, used for elements
            without heights.
        thickness_px: Width of the lines in feature pixels.
        num_classes: Number of channels, one for each class; None for one channel with all classes.
        heights: Whether two-dimensional elements take their heights from the annotation file, as
            the published systems do for Argoverse 2. If the file has no heights, ``ground_z_m`` is
            used and a message is logged.

    Raises:
        ValueError: If a number is not positive.
    """

    stride: int = 32
    pad_size_divisor: int = 32
    ground_z_m: float = -1.6
    thickness_px: int = 1
    num_classes: int | None = None
    heights: bool = False

    def __post_init__(self) -> None:
        check_positive(stride=self.stride, pad_size_divisor=self.pad_size_divisor)
        check_positive(thickness_px=self.thickness_px, num_classes=self.num_classes or 1)

    def _homogeneous_points(self, points: np.ndarray) -> np.ndarray:
        """Resample a line to homogeneous points (x, y, z, 1) in metres. (n, 2 or 3) -> (200, 4)"""
        line = resample(points, _NUM_PV_POINTS)
        flat_heights = np.full((len(line), 1), self.ground_z_m)
        heights = line[:, 2:3] if line.shape[1] == 3 else flat_heights
        return np.concatenate([line[:, :2], heights, np.ones((len(line), 1))], axis=-1)

    def _elements(self, results: dict[str, Any]) -> Iterator[tuple[MapInstance, np.ndarray]]:
        """Yield each element with its points in metres, (n, 2) or (n, 3)."""
        elements = ground_truth_elements(results, self)
        # Heights in metres of the vertices of each element; None if the file has none.
        heights = results.get("map_heights") if self.heights else None
        lacks_heights = any(element.points.shape[1] == 2 for element in elements)
        if self.heights and heights is None and lacks_heights:
            _log_flat_ground(self.ground_z_m)
        for number, element in enumerate(elements):
            points = element.points
            if heights is not None:
                points = np.column_stack([points[:, :2], heights[number]])
            yield element, points

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Draw the masks.

        Raises:
            ValueError: If the sample has no ground truth, or a label is not less than
                ``num_classes``.
        """
        # Rows and columns of the images, rounded up to multiples of the divisor.
        height, width = padded_size(results["img_shape"], self.pad_size_divisor)
        # Projection of each view from the annotation frame (``lidar``) in metres to pixels. (4, 4)
        matrices = results["lidar2img"]
        num_channels = self.num_classes or 1
        rows = height // self.stride
        cols = width // self.stride
        masks = np.zeros((len(matrices), num_channels, rows, cols), dtype=np.uint8)
        lines = []  # channel and homogeneous points (200, 4) of each element
        for instance, points in self._elements(results):
            channel = channel_of(instance, self.num_classes)
            lines.append((channel, self._homogeneous_points(points)))
        feature_from_img = np.diag([1 / self.stride, 1 / self.stride, 1.0, 1.0])
        for view_masks, lidar2img in zip(masks, matrices, strict=True):
            feature_from_frame = feature_from_img @ lidar2img
            for channel, line in lines:
                projected = line @ feature_from_frame.T  # (200, 4)
                # `u` and `v` are feature pixels times depth. Points behind the camera are dropped.
                u, v, depth = projected[:, :3].T
                is_ahead = depth > 0
                pixels = np.stack([u[is_ahead], v[is_ahead]], axis=-1)
                pixels /= depth[is_ahead, None] + _EPSILON
                if len(pixels):
                    pixels = pixels.clip(-1e6, 1e6).astype(np.int32)  # within int32
                    _draw_line(view_masks[channel], pixels, thickness_px=self.thickness_px)
        results["gt_pv_seg"] = torch.from_numpy(masks.astype(np.float32))
        return results


def _draw_line(mask: np.ndarray, cells: np.ndarray, thickness_px: int) -> None:
    """Draw an open line into a mask (H, W), through cells as (column, row). (n, 2)"""
    cv2.polylines(mask, [cells], isClosed=False, color=(1,), thickness=thickness_px)


def channel_of(instance: MapInstance, num_classes: int | None) -> int:
    """Return the channel of an element in the masks.

    Args:
        instance: Map element.
        num_classes: Number of channels; None for one channel with all classes.

    Raises:
        ValueError: If the label is negative or not less than ``num_classes``.
    """
    if num_classes is None:
        return 0
    if not 0 <= instance.label < num_classes:
        raise InputError(
            f"label {instance.label} of an element is not in [0, {num_classes}), the range for "
            f"num_classes={num_classes}."
        )
    return instance.label


@cache
def _log_flat_ground(ground_z_m: float) -> None:
    """Log once that masks of the camera views are drawn on flat ground for lack of heights."""
    # `cache` limits the message to one per process, and each worker of a data loader is a process.
    worker = get_worker_info()
    if worker is None or worker.id == 0:
        print_log(
            f"camera masks of elements lie on flat ground at z = {ground_z_m:g} m: the annotation "
            "file has no heights. Make it with `python tools/create_data.py av2 ... --dim 3` for "
            "masks as in the published systems, or set heights=False in MakePVMask.",
            logger="current",
        )
