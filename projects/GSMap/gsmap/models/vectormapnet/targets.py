"""VectorMapNet's targets: simplified lines as tokens, their boxes and token weights."""

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

from gsmap.models.vectormapnet.canvas import Canvas, tokenize_points
from gsmap.structures.elements import ground_truth_elements
from gsmap.structures.grid import BEVGrid, padded_size
from gsmap.structures.polylines import pad_lines
from gsmap.utils.errors import InputError

Floats = NDArray[np.float64]


def bounding_box(line: Floats, smallest: float) -> Floats:
    """Compute the bounding box of a line, enlarged on all sides if its shorter side is too small.

    Args:
        line: Vertices in [0, 1] over the canvas, the raster of the tokens. (n, 2)
        smallest: Smallest length of the shorter side, in [0, 1].

    Returns:
        Corners x0, y0, x1, y1. (4,)
    """
    shape = shapely.LineString(line)
    missing_side = smallest - np.ptp(line, axis=0).min()
    if missing_side > 0:
        shape = shape.buffer(missing_side / 2, quad_segs=16)
    return np.array(shape.bounds)


def even_weights(line: Floats) -> Floats:
    """Return equal token weights of sum 1 for the coordinates and the stop token of a line.

    (n, 2) -> (2 n + 1,)
    """
    number = 2 * len(line) + 1
    return np.full(number, 1 / number)


def edge_weights(line: Floats) -> Floats:
    """Compute token weights of the points of a line in proportion to the length of their edges.

    The weight of a point is proportional to the mean length of its two edges, with half for x and
    half for y. The weights of the coordinates sum to 1; the stop token has the weight 1 / (2 n).

    (n, 2) -> (2 n + 1,)
    """
    edges = np.linalg.norm(np.diff(line, axis=0), axis=1)
    # The first and the last point have one edge, which counts twice.
    edge_before = np.append(edges[:1], edges)
    edge_after = np.append(edges, edges[-1:])
    means = (edge_before + edge_after) / 2
    shares = means / max(means.sum(), np.finfo(float).eps)  # of each point
    coordinate_weights = np.repeat(shares / 2, 2)  # half for x, half for y
    return np.append(coordinate_weights, 1 / (2 * len(line)))


@TRANSFORMS.register_module()
@dataclass(eq=False)
class FormatPolylineTargets(BaseTransform):
    """Add VectorMapNet's targets to ``gt_instances_3d``, computed from ``map_instances``.

    The targets are ``keypoints`` (K, 4), box corners in pixels of the canvas; ``keypoint_tokens``
    (K, 4), the numbers of the pixels of these corners; and ``tokens`` and ``token_weights`` (K, T),
    filled with 0 for shorter lines. Targets of a preceding `FormatMapTargets` are not changed.
    Without it, the transform also adds ``labels_3d`` (K,), the simplified lines ``pts`` (K, P, 2)
    in metres, filled with the last point, and ``num_pts`` (K,).

    Args:
        pixel_m: Side of a pixel in metres, as in the `Canvas` of the head.
        margin_m: Margin in metres, as in the `Canvas` of the head.
        tolerance_m: Largest distance of a simplified line from the annotated one, in metres.
        smallest_box: Smallest length of the shorter side of a box, as a share of the canvas.
        border_px: Smallest distance of box corners from the border of the canvas, in pixels.
        edge_classes: Class indices whose tokens are weighted by edge length. Other classes have
            even weights.

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
        if min(self.tolerance_m, self.smallest_box, self.border_px, *self.edge_classes) < 0:
            raise InputError(f"settings of FormatPolylineTargets must not be negative: {self}.")

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the targets to a sample.

        Raises:
            ValueError: If the sample has no ground truth.
        """
        elements = ground_truth_elements(results, self)
        grid = BEVGrid(results["x_range"], results["y_range"])
        canvas = Canvas(grid, self.pixel_m, margin_m=self.margin_m)
        low, high = np.transpose([grid.x_range, grid.y_range])  # (x, y) each
        labels = []
        counts = []
        lines_m = []
        boxes = []
        tokens = []
        weights = []
        for element in elements:
            line_m = self.simplify(element.points[:, :2]).clip(low, high)
            line = canvas.norm_from_metres(line_m)
            weigh = edge_weights if element.label in self.edge_classes else even_weights
            labels.append(element.label)
            counts.append(len(line))
            lines_m.append(line_m)
            boxes.append(bounding_box(line, self.smallest_box))
            tokens.append(tokenize_points(line, canvas.steps))
            weights.append(weigh(line))
        # `canvas.size` is the number of pixels along x and y. `canvas.steps` is one less, so
        # that the coordinate 1 belongs to the last pixel.
        border = self.border_px / np.array(canvas.size)
        corners = np.array(boxes).reshape(-1, 2, 2).clip(border, 1 - border)
        instances = results.get("gt_instances_3d", InstanceData())
        if "pts" not in instances:  # there is no preceding `FormatMapTargets`
            instances.labels_3d = torch.tensor(labels, dtype=torch.int64)
            instances.pts = torch.from_numpy(pad_lines(lines_m)).float()
            instances.num_pts = torch.tensor(counts, dtype=torch.int64)
        instances.keypoints = torch.from_numpy((corners * canvas.size).reshape(-1, 4)).float()
        # Here a token is a pixel number from 0. In `tokens` it is this number plus 1, because there
        # 0 is the stop token. The four tokens of a box need no stop token.
        instances.keypoint_tokens = torch.from_numpy(corners * canvas.steps).long().flatten(1)
        instances.tokens = stack_rows(tokens).long()
        instances.token_weights = stack_rows(weights).float()
        # The detector of the head compares these settings with the settings of its canvas.
        instances.set_metainfo({"canvas": canvas.settings})
        results["gt_instances_3d"] = instances
        return results

    def simplify(self, points: NDArray[Any]) -> Floats:
        """Simplify a line within the tolerance (Douglas and Peucker). (n, 2) -> (m, 2)"""
        return shapely.get_coordinates(shapely.LineString(points).simplify(self.tolerance_m))


def stack_rows(rows: Sequence[NDArray[Any]]) -> torch.Tensor:
    """Stack arrays of different lengths, filled with zeros. (n,) each -> (K, longest n)"""
    columns = [row[:, None] for row in rows]
    return torch.from_numpy(pad_lines(columns, mode="constant")[..., 0])


@TRANSFORMS.register_module()
@dataclass(eq=False)
class StretchToPadding(BaseTransform):
    """Scale projections as if images were stretched over their padding, as in the released code.

    Args:
        pad_size_divisor: Divisor of the height and width of padded images.
    """

    pad_size_divisor: int = 32

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Scale ``lidar2img`` and ``img_aug_matrix``, if the sample has them.

        With both scaled, the mapping from the LiDAR to the image file does not change.
        """
        height, width = results["img_shape"]
        padded_height, padded_width = padded_size((height, width), self.pad_size_divisor)
        stretch = np.diag([padded_width / width, padded_height / height, 1.0, 1.0])
        # Both have one matrix for each camera.
        for key in results.keys() & {"lidar2img", "img_aug_matrix"}:
            results[key] = [stretch @ matrix for matrix in results[key]]
        return results
