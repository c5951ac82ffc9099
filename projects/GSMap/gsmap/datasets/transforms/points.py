"""LiDAR points: the annotation frame, and sparse depth maps for supervision."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.datasets.transforms import LoadPointsFromFile
from mmdet3d.registry import TRANSFORMS

from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.transforms.masks import padded_size


@TRANSFORMS.register_module()
class LoadLidarPoints(LoadPointsFromFile):
    """mmdet3d's ``LoadPointsFromFile``, naming sample and file when one is missing or cut short."""

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load ``results['lidar_points']``.

        Raises:
            BrokenSampleError: If the sample has no LiDAR, or its file is missing or truncated.
        """
        if "lidar_points" not in results:
            raise BrokenSampleError(f"sample {results['token']!r} has no LiDAR sweep.")
        path = Path(results["lidar_points"]["lidar_path"])
        if not path.is_file():
            raise BrokenSampleError(f"sample {results['token']!r}: no LiDAR file at {path}.")
        size = path.stat().st_size
        if size == 0 or size % (4 * self.load_dim):  # float32 values
            raise BrokenSampleError(
                f"sample {results['token']!r}: {path} has {size} bytes, not a multiple of "
                f"{self.load_dim} float32 values: copy it again, or correct load_dim."
            )
        return super().transform(results)


@TRANSFORMS.register_module()
class PointsToFrame(BaseTransform):
    """Move the points of a sensor that is not the annotation frame into it.

    Comes between ``LoadPointsFromFile`` and ``LoadPointsFromMultiSweeps`` (whose sweeps are moved
    already); on nuScenes it changes nothing.
    """

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Apply ``lidar2frame`` to ``points``."""
        matrix = results["lidar2frame"]
        if not np.array_equal(matrix, np.eye(4)):
            points = results["points"].tensor
            rotation = torch.as_tensor(matrix[:3, :3], dtype=points.dtype)
            shift = torch.as_tensor(matrix[:3, 3], dtype=points.dtype)
            points[:, :3] = points[:, :3] @ rotation.T + shift
        return results


@TRANSFORMS.register_module()
class MakeDepthMap(BaseTransform):
    """Add ``gt_depth``: the nearest return at each pixel in metres, 0 without one. (V, H, W)

    Comes after the points are loaded and the images have their final scale.

    Args:
        depth_range: Smallest and largest depth to keep, in metres.
        pad_size_divisor: To what the images are padded later.
    """

    def __init__(
        self, depth_range: tuple[float, float] = (1.0, 60.0), pad_size_divisor: int = 32
    ) -> None:
        self.depth_range = tuple(depth_range)
        self.pad_size_divisor = pad_size_divisor

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Project the points into each camera."""
        points = results["points"].tensor[:, :3].numpy().astype(np.float64)
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], -1)
        height, width = results["img_shape"]
        padded = padded_size((height, width), self.pad_size_divisor)
        depths = np.zeros((len(results["lidar2img"]), *padded), np.float32)
        for target, lidar2img in zip(depths, results["lidar2img"], strict=True):
            u, v, depth = (homogeneous @ lidar2img.T)[:, :3].T
            keep = (depth >= self.depth_range[0]) & (depth < self.depth_range[1])
            depth = depth[keep]
            col, row = np.round(u[keep] / depth), np.round(v[keep] / depth)
            inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
            far_first = np.argsort(-depth[inside], kind="stable")  # the nearest is written last
            rows, cols = row[inside][far_first].astype(int), col[inside][far_first].astype(int)
            target[rows, cols] = depth[inside][far_first]
        results["gt_depth"] = torch.from_numpy(depths)
        return results
