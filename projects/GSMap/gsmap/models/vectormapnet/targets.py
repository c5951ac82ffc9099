"""VectorMapNet's targets: simplified lines as tokens, their boxes, and weights of the tokens."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from mmengine.structures import InstanceData
from numpy.typing import NDArray

from gsmap.models.vectormapnet.canvas import Canvas, tokens_of
from gsmap.structures.elements import annotated
from gsmap.structures.grid import BEVGrid, padded_size
from gsmap.structures.polylines import padded

Floats = NDArray[np.float64]


def grown_box(line: Floats, smallest: float) -> Floats:
    """Return a line's box (x0, y0, x1, y1), grown on all sides if one is short. (n, 2) -> (4,)

    Args:
        line: Vertices, [0, 1] over the canvas.
        smallest: Length of the shorter side at least.
    """
    missing = smallest - np.ptp(line, 0).min()
    shape = shapely.LineString(line)
    return np.array((shape.buffer(missing / 2, quad_segs=16) if missing > 0 else shape).bounds)


def even_weights(line: Floats) -> Floats:
    """Return equal weights of the coordinates and the stop, of sum 1. (n, 2) -> (2 n + 1,)"""
    number = 2 * len(line) + 1
    return np.full(number, 1 / number)


def edge_weights(line: Floats) -> Floats:
    """Return weights by the mean length of a point's edges, of sum 1, and of the stop.

    (n, 2) -> (2 n + 1,)
    """
    edges = np.linalg.norm(np.diff(line, axis=0), axis=1)
    means = (np.append(edges[:1], edges) + np.append(edges, edges[-1:])) / 2
    number = 2 * len(line)
    shares = means / max(means.sum(), np.finfo(float).eps) / 2
    return np.append(np.repeat(shares, 2), 1 / number)


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatPolylineTargets(BaseTransform):
    """Add VectorMapNet's targets to ``gt_instances_3d``, from ``map_instances``.

    They are ``keypoints`` (K, 4), corners of boxes in canvas pixels, ``keypoint_tokens`` (K, 4),
    ``tokens`` and ``token_weights`` (K, T), of shorter lines filled with 0. Behind
    `FormatMapTargets` its targets stay; alone it also adds ``labels_3d`` (K,), the simplified lines
    ``pts`` (K, P, 2) in metres, the last point repeated, and ``num_pts`` (K,).

    Args:
        pixel_m: As in `Canvas`, that of the head.
        margin_m: As in `Canvas`, that of the head.
        tolerance_m: How far a simplified line may be from the annotated one.
        smallest_box: Shorter side of a box at least, as a share of the canvas.
        border_px: Least distance of corners from the border of the canvas, in pixels.
        edge_classes: Class indices whose points weigh as long as their edges; others weigh alike.

    Raises:
        ValueError: If a setting is negative.
    """

    pixel_m: float = 0.3
    margin_m: float = 2.0
    tolerance_m: float = 0.2
    smallest_box: float = 0.02
    border_px: float = 0.1
    edge_classes: Sequence[int] = (2,)

    def __post_init__(self) -> None:
        if min(self.tolerance_m, self.smallest_box, self.border_px, *self.edge_classes, 0) < 0:
            raise ValueError(f"settings of FormatPolylineTargets must not be negative: {self}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets; ValueError if the sample has no ground truth."""
        elements = annotated(results, self)
        grid = BEVGrid(results["x_range"], results["y_range"])
        canvas = Canvas(grid, self.pixel_m, self.margin_m)
        low, high = np.transpose([grid.x_range, grid.y_range])
        lines_m = [self.simplified(e.points[:, :2]).clip(low, high) for e in elements]
        lines = [canvas.norm_from_metres(line) for line in lines_m]
        weights = [
            edge_weights(line) if element.label in self.edge_classes else even_weights(line)
            for element, line in zip(elements, lines, strict=True)
        ]
        boxes = np.array([grown_box(line, self.smallest_box) for line in lines]).reshape(-1, 2, 2)
        border = self.border_px / np.array(canvas.size)
        boxes = boxes.clip(border, 1 - border)
        instances = results.get("gt_instances_3d", InstanceData())
        if "pts" not in instances:
            instances.labels_3d = torch.tensor([e.label for e in elements], dtype=torch.int64)
            instances.pts = torch.from_numpy(padded(lines_m)).float()
            instances.num_pts = torch.tensor([len(line) for line in lines], dtype=torch.int64)
        instances.keypoints = torch.from_numpy((boxes * canvas.size).reshape(-1, 4)).float()
        instances.keypoint_tokens = torch.from_numpy(boxes * canvas.steps).long().flatten(1)
        tokens = [tokens_of(line, canvas.steps) for line in lines]
        instances.tokens = filled(tokens).long()
        instances.token_weights = filled(weights).float()
        instances.set_metainfo({"canvas": canvas.settings})
        results["gt_instances_3d"] = instances
        return results

    def simplified(self, points: NDArray[Any]) -> Floats:
        """Return a line without the vertices that it does not need. (n, 2)"""
        return shapely.get_coordinates(shapely.LineString(points).simplify(self.tolerance_m))


def filled(rows: Sequence[NDArray[Any]]) -> torch.Tensor:
    """Stack arrays (n,), the shorter ones filled with zeros. (K, longest)"""
    return torch.from_numpy(padded([row[:, None] for row in rows], mode="constant")[..., 0])


@TRANSFORMS.register_module()
@dataclass(eq=False)
class StretchToPadding(BaseTransform):
    """Scale projections as if images were stretched over their padding, as released.

    Args:
        pad_size_divisor: What the sizes of padded images are multiples of.
    """

    pad_size_divisor: int = 32

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Scale ``lidar2img``, and ``img_aug_matrix`` with it, which leads back to the file."""
        height, width = results["img_shape"]
        padded = padded_size((height, width), self.pad_size_divisor)
        stretch = np.diag([padded[1] / width, padded[0] / height, 1.0, 1.0])
        for key in results.keys() & {"lidar2img", "img_aug_matrix"}:
            results[key] = [stretch @ matrix for matrix in results[key]]
        return results
