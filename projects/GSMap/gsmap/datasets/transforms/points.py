"""LiDAR points: sweep files, the annotation frame, and sparse depth maps for supervision."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.datasets.transforms import LoadPointsFromFile, LoadPointsFromMultiSweeps
from mmdet3d.registry import TRANSFORMS
from pyarrow import feather

from gsmap.datasets.errors import BrokenSampleError
from gsmap.structures.grid import padded_size
from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_of_the_machine
from gsmap.utils.inputs import heed_input

# Argoverse 2's columns in the order of their use; the first five mean what nuScenes' values mean.
FEATHER_COLUMNS = ("x", "y", "z", "intensity", "laser_number", "offset_ns")


def read_points(path: str, load_dim: int) -> np.ndarray:
    """Read a LiDAR sweep of nuScenes (float32 values) or Argoverse 2 (``.feather``).

    Args:
        path: The file.
        load_dim: Values per point; of a ``.feather`` file the first of ``FEATHER_COLUMNS``.

    Returns:
        Points: x, y, z in metres in the frame of the file, intensity from 0 to 255, number of the
        laser, and of a ``.feather`` file the time since the sweep's in nanoseconds. (n, load_dim)

    Raises:
        BrokenSampleError: If the file is missing, cut short or holds something else.
        ValueError: If a ``.feather`` file cannot have so many values.
    """
    file = Path(path)
    if not file.is_file():
        raise BrokenSampleError(
            f"no LiDAR file at {path}: correct data_root, download it, or take a config without "
            "LiDAR."
        )
    size = file.stat().st_size
    if file.suffix == ".feather":
        points = _read_feather(path, load_dim)
    elif size == 0 or size % (4 * load_dim):  # float32 values
        raise BrokenSampleError(
            f"{file} has {size} bytes, not a multiple of {load_dim} float32 values: copy it again, "
            "or correct load_dim."
        )
    else:
        points = np.fromfile(file, np.float32).reshape(-1, load_dim)
    if not np.isfinite(points).all():
        raise BrokenSampleError(f"{path} holds NaN or infinity: copy it again.")
    return points


def _read_feather(path: str, load_dim: int) -> np.ndarray:
    """Read a sweep of Argoverse 2. (n, load_dim)."""
    if load_dim > len(FEATHER_COLUMNS):
        raise InputError(
            f"load_dim must be at most {len(FEATHER_COLUMNS)} for {path}, got {load_dim}."
        )
    names = FEATHER_COLUMNS[:load_dim]
    try:
        heed_input(path)
        table = feather.read_table(path, columns=list(names), memory_map=False)
        table.validate(full=True)
        columns = [table[name].to_numpy().astype(np.float32) for name in names]
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        if is_of_the_machine(error):
            raise
        raise BrokenSampleError(
            f"{path} is not a whole LiDAR sweep ({error}): download it again."
        ) from error
    if not table.num_rows:
        raise BrokenSampleError(f"{path} holds no point: download it again.")
    return np.stack(columns, -1)


def _naming_sample(
    transform: Callable[[dict[str, Any]], dict[str, Any]], results: dict[str, Any]
) -> dict[str, Any]:
    """Apply a transform; what it says of a broken file is preceded by the sample's token."""
    try:
        return transform(results)
    except BrokenSampleError as error:
        raise BrokenSampleError(f"sample {results['token']!r}: {error}") from error


@TRANSFORMS.register_module()
class LoadLidarPoints(LoadPointsFromFile):
    """mmdet3d's ``LoadPointsFromFile``, with checks and for Argoverse 2's files too."""

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load ``results['lidar_points']``; BrokenSampleError if that is missing or damaged."""
        if "lidar_points" not in results:
            raise BrokenSampleError(
                f"sample {results['token']!r} has no LiDAR sweep: make the annotation file from "
                "data with LiDAR, or take a config without it."
            )
        return _naming_sample(super().transform, results)

    def _load_points(self, pts_filename: str) -> np.ndarray:
        return read_points(pts_filename, self.load_dim).reshape(-1)


@TRANSFORMS.register_module()
class LoadLidarSweeps(LoadPointsFromMultiSweeps):
    """mmdet3d's ``LoadPointsFromMultiSweeps``, with checks and for Argoverse 2's files too.

    The fifth value of each point becomes the sweep's age in seconds.
    """

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add ``results['lidar_sweeps']``; BrokenSampleError if one is missing or damaged."""
        return _naming_sample(super().transform, results)

    def _load_points(self, pts_filename: str) -> np.ndarray:
        if not Path(pts_filename).is_file():
            raise BrokenSampleError(
                f"no earlier LiDAR sweep at {pts_filename}: download the sweeps, or make the "
                "annotation file again with --max-sweeps 0."
            )
        return read_points(pts_filename, self.load_dim).reshape(-1)


@TRANSFORMS.register_module()
class PointsToFrame(BaseTransform):
    """Move the points of a sensor that is not the annotation frame into it.

    Comes between ``LoadLidarPoints`` and ``LoadLidarSweeps`` (whose sweeps are moved already).
    """

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Apply ``lidar2frame`` to ``points``."""
        matrix = results["lidar2frame"]
        if not np.array_equal(matrix, np.eye(4)):
            points = results["points"].tensor
            moved = torch.as_tensor(matrix, dtype=points.dtype)
            points[:, :3] = points[:, :3] @ moved[:3, :3].T + moved[:3, 3]
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeDepthMap(BaseTransform):
    """Add ``gt_depth``: the nearest return at each pixel in metres, 0 without one. (V, H, W)

    Comes after the points are loaded and the images have their final scale.

    Args:
        depth_range: Smallest and largest depth to keep, in metres.
        pad_size_divisor: To what the images are padded later.
    """

    depth_range: tuple[float, float] = (1.0, 60.0)
    pad_size_divisor: int = 32

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Project the points into each camera."""
        points = results["points"].tensor[:, :3].numpy().astype(np.float64)
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], -1)
        padded = padded_size(results["img_shape"], self.pad_size_divisor)
        depths = np.zeros((len(results["lidar2img"]), *padded), np.float32)
        for view, (target, lidar2img) in enumerate(zip(depths, results["lidar2img"], strict=True)):
            u, v, depth = (homogeneous @ lidar2img.T)[:, :3].T
            keep = (depth >= self.depth_range[0]) & (depth < self.depth_range[1])
            depth = depth[keep]
            col, row = np.round(u[keep] / depth), np.round(v[keep] / depth)
            scale = results["img_aug_matrix"][view]
            rows, cols = np.round(results["raw_shapes"][view] * scale[[1, 0], [1, 0]])
            inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)  # not in the padding
            far_first = np.argsort(-depth[inside], kind="stable")  # the nearest is written last
            pixels = row[inside][far_first].astype(int), col[inside][far_first].astype(int)
            target[pixels] = depth[inside][far_first]
        results["gt_depth"] = torch.from_numpy(depths)
        return results
