"""Segmentation targets: map elements drawn in BEV and in each camera's feature map."""

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

_PV_SAMPLES = 200
_MIN_DEPTH = 1e-7


def cells_of(instance: MapInstance, results: dict[str, Any], size: tuple[int, int]) -> np.ndarray:
    """Return an element's cells (column, row) on a raster of rows and columns. (n, 2)"""
    low, high = np.array([results["x_range"], results["y_range"]]).T
    scale = np.array(size[::-1]) / (high - low)
    return ((instance.points[:, :2].astype(np.float64) - low) * scale).astype(np.int32)


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeBEVMask(BaseTransform):
    """Add ``gt_seg``: elements drawn in one channel, or in that of their class. (channels, H, W)

    Pixel coordinates are truncated to integers, as released.

    Args:
        size: Rows H and columns W over the ground truth's range.
        thickness_px: Width of the lines.
        num_classes: Number of channels; None draws all elements in one.

    Raises:
        ValueError: If a number is not positive.
    """

    size: tuple[int, int] = (200, 100)
    thickness_px: int = 3
    num_classes: int | None = None

    def __post_init__(self) -> None:
        numbers = {"thickness_px": self.thickness_px, "num_classes": self.num_classes or 1}
        check_positive(rows=self.size[0], columns=self.size[1], **numbers)

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Draw the mask; ValueError if the sample has no ground truth."""
        masks = np.zeros((self.num_classes or 1, *self.size), np.uint8)
        for instance in ground_truth_elements(results, self):
            pixels = cells_of(instance, results, self.size)
            channel = channel_of(instance, self.num_classes)
            cv2.polylines(masks[channel], [pixels], False, (1,), self.thickness_px)
        results["gt_seg"] = torch.from_numpy(masks.astype(np.float32))
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeInstanceMasks(BaseTransform):
    """Add ``masks`` (K, H, W) to ``gt_instances_3d``: each element's own cells in BEV.

    Of elements of one class the later one has the cells of both; near an element of a later class
    all give way. Cells are truncated as in `MakeBEVMask`.

    Args:
        size: Rows H and columns W over the ground truth's range.
        thickness_px: Width of the lines.
        gap_px: Width around elements of later classes.
        mirrored: Mirror the masks left to right, as released; they then fit no BEV features.

    Raises:
        ValueError: If a number is not positive.
    """

    size: tuple[int, int] = (200, 100)
    thickness_px: int = 3
    gap_px: int = 7
    mirrored: bool = True

    def __post_init__(self) -> None:
        widths = {"thickness_px": self.thickness_px, "gap_px": self.gap_px}
        check_positive(rows=self.size[0], columns=self.size[1], **widths)

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Draw the masks; ValueError if the sample has no ground truth, or no targets yet."""
        instances = ground_truth_elements(results, self)
        if "gt_instances_3d" not in results:
            raise InputError(
                f"sample {results['token']!r} has no targets yet: put MakeInstanceMasks behind "
                "FormatMapTargets in the pipeline."
            )
        masks, gaps = np.zeros((2, len(instances), *self.size), np.uint8)
        for number, instance in enumerate(instances):
            cells = cells_of(instance, results, self.size)
            cv2.polylines(masks[number], [cells], False, (1,), self.thickness_px)
            cv2.polylines(gaps[number], [cells], False, (1,), self.gap_px)
        labels = np.array([instance.label for instance in instances])
        for number, label in enumerate(labels):
            later = masks[number + 1 :][labels[number + 1 :] == label]
            masks[number] &= ~np.concatenate([later, gaps[labels > label]]).any(0)
        masks = masks[..., ::-1] if self.mirrored else masks
        results["gt_instances_3d"].masks = torch.from_numpy(masks.astype(bool))
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakePVMask(BaseTransform):
    """Add ``gt_pv_seg``: elements projected into each camera's feature map. (V, channels, h, w)

    Comes after the images have their final scale. Two-dimensional elements lie at one height, or
    at the heights that their file has.

    Args:
        stride: Image pixels per feature pixel.
        pad_size_divisor: To what the images are padded later.
        ground_z_m: Height of the ground in the annotation frame, in metres.
        thickness_px: Width of the lines in feature pixels.
        num_classes: Number of channels; None draws all elements in one.
        heights: Whether two-dimensional elements of a file with heights lie at these, as published
            for Argoverse 2. A file without heights is said once.

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

    def _points(self, points: np.ndarray) -> np.ndarray:
        """Return an element as homogeneous points along it. (200, 4)."""
        line = resample(points, _PV_SAMPLES)
        height = line[:, 2:3] if line.shape[1] == 3 else np.full((len(line), 1), self.ground_z_m)
        return np.concatenate([line[:, :2], height, np.ones((len(line), 1))], -1)

    def _elements(self, results: dict[str, Any]) -> Iterator[tuple[MapInstance, np.ndarray]]:
        """Yield each element with the points that are drawn, (n, 2) or (n, 3)."""
        elements = ground_truth_elements(results, self)
        heights = results.get("map_heights") if self.heights else None
        if self.heights and heights is None and any(e.points.shape[1] == 2 for e in elements):
            _say_flat(self.ground_z_m)
        for number, element in enumerate(elements):
            points = element.points
            if heights is not None:
                points = np.column_stack([points[:, :2], heights[number]])
            yield element, points

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Draw the masks; ValueError if the sample has no ground truth."""
        height, width = padded_size(results["img_shape"], self.pad_size_divisor)
        size = height // self.stride, width // self.stride
        views = results["lidar2img"]
        masks = np.zeros((len(views), self.num_classes or 1, *size), np.uint8)
        lines = [
            (channel_of(instance, self.num_classes), self._points(points))
            for instance, points in self._elements(results)
        ]
        shrink = np.diag([1 / self.stride, 1 / self.stride, 1.0, 1.0])
        for view, lidar2img in zip(masks, views, strict=True):
            for channel, line in lines:
                u, v, depth = (line @ (shrink @ lidar2img).T)[:, :3].T
                front = depth > 0
                pixels = np.stack([u[front], v[front]], -1) / (depth[front, None] + _MIN_DEPTH)
                if len(pixels):
                    clipped = pixels.clip(-1e6, 1e6).astype(np.int32)
                    cv2.polylines(view[channel], [clipped], False, (1,), self.thickness_px)
        results["gt_pv_seg"] = torch.from_numpy(masks.astype(np.float32))
        return results


def channel_of(instance: MapInstance, num_classes: int | None) -> int:
    """Return the channel that an element is drawn in; ValueError if that is beyond the classes."""
    if num_classes is None:
        return 0
    if not 0 <= instance.label < num_classes:
        raise InputError(f"label {instance.label} of an element, but num_classes={num_classes}.")
    return instance.label


@cache
def _say_flat(ground_z_m: float) -> None:
    """Say once that masks of the cameras lie on flat ground, though heights are asked for."""
    worker = get_worker_info()
    if worker is None or worker.id == 0:
        print_log(
            f"camera masks of elements lie on flat ground at z = {ground_z_m:g} m: the annotation "
            "file has no heights. Make it with `python tools/create_data.py av2 ... --dim 3` for "
            "those of the published systems, or set heights=False in MakePVMask.",
            "current",
        )
