"""Loading of LiDAR points, transformation to the annotation frame, and depth maps as targets."""

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
from gsmap.utils.faults import is_machine_error
from gsmap.utils.inputs import check_input

# Columns of Argoverse 2. The first five have the meaning of the five values of a point in files of
# nuScenes.
FEATHER_COLUMNS = ("x", "y", "z", "intensity", "laser_number", "offset_ns")
# Largest difference from the identity of a transform without effect, such as one that was rounded.
# It moves a point at a distance of 100 m by a millimetre.
_FRAME_TOLERANCE = 1e-5


def read_points(path: str, load_dim: int) -> np.ndarray:
    """Read and check a LiDAR sweep of nuScenes (float32 values) or Argoverse 2 (``.feather``).

    Args:
        path: Point file.
        load_dim: Values per point. For a ``.feather`` file, the number of columns to read, in the
            order of ``FEATHER_COLUMNS``.

    Returns:
        Points, float32. The values of a point are x, y, z in metres in the frame of the file,
        intensity from 0 to 255 and number of the laser. A ``.feather`` file also has the time since
        the start of the sweep in nanoseconds. (n, load_dim)

    Raises:
        BrokenSampleError: If the file is missing or truncated, or has other content.
        ValueError: If ``load_dim`` is more than the number of columns of a ``.feather`` file.
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
        points = np.fromfile(file, dtype=np.float32).reshape(-1, load_dim)
    if not np.isfinite(points).all():
        raise BrokenSampleError(f"{path} holds NaN or infinity: copy it again.")
    return points


def _read_feather(path: str, load_dim: int) -> np.ndarray:
    """Read a LiDAR sweep of Argoverse 2. (n, load_dim)"""
    if load_dim > len(FEATHER_COLUMNS):
        raise InputError(
            f"load_dim must be at most {len(FEATHER_COLUMNS)} for {path}, got {load_dim}."
        )
    names = FEATHER_COLUMNS[:load_dim]
    try:
        # Files that Python opens are checked automatically, but Arrow opens this file itself. The
        # check refuses pipes and outputs of the command.
        check_input(path)
        table = feather.read_table(path, columns=list(names), memory_map=False)
        table.validate(full=True)  # otherwise a damaged table could crash the process
        columns = [table[name].to_numpy().astype(np.float32) for name in names]
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        if is_machine_error(error):  # such as a lack of memory: the file may be in order
            raise
        raise BrokenSampleError(
            f"{path} is not a whole LiDAR sweep ({error}): download it again."
        ) from error
    if not table.num_rows:
        raise BrokenSampleError(f"{path} holds no point: download it again.")
    return np.stack(columns, axis=-1)


def _name_sample_in_errors(
    transform: Callable[[dict[str, Any]], dict[str, Any]], results: dict[str, Any]
) -> dict[str, Any]:
    """Apply a transform to a sample, and add the sample's token to an error about a broken file."""
    try:
        return transform(results)
    except BrokenSampleError as error:
        raise BrokenSampleError(f"sample {results['token']!r}: {error}") from error


def check_points_in_frame(results: dict[str, Any], step: str) -> None:
    """Raise a ``ValueError`` if the points are not in the annotation frame yet.

    Args:
        results: Results of the earlier transforms.
        step: Name of the transform that needs the points in the annotation frame, for the message.
    """
    remaining = results.get("lidar2frame")
    if remaining is None or np.allclose(remaining, np.eye(4), rtol=0, atol=_FRAME_TOLERANCE):
        return
    raise InputError(
        f"sample {results['token']!r}: {step} needs points in the annotation frame, and they are "
        "in another frame, that of the LiDAR: add dict(type='PointsToFrame') to the pipeline, "
        "directly after LoadLidarPoints."
    )


@TRANSFORMS.register_module()
class LoadLidarPoints(LoadPointsFromFile):
    """``LoadPointsFromFile`` of mmdet3d with checks and support for files of Argoverse 2.

    The base class calls ``_load_points``, which returns the values of all points in one row, and
    stores the points as ``results["points"]``.
    """

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Load the point file of ``results['lidar_points']``.

        Raises:
            BrokenSampleError: If the sample has no LiDAR sweep, or the file is missing or damaged.
        """
        if "lidar_points" not in results:
            raise BrokenSampleError(
                f"sample {results['token']!r} has no LiDAR sweep: make the annotation file from "
                "data with LiDAR, or take a config without it."
            )
        return _name_sample_in_errors(super().transform, results)

    def _load_points(self, pts_filename: str) -> np.ndarray:
        return read_points(pts_filename, self.load_dim).reshape(-1)


@TRANSFORMS.register_module()
class LoadLidarSweeps(LoadPointsFromMultiSweeps):
    """``LoadPointsFromMultiSweeps`` of mmdet3d with checks and support for files of Argoverse 2.

    The base class appends the points of earlier sweeps to ``results["points"]``. It replaces the
    fifth value of each point by the age of the sweep in seconds, which is 0 for the current sweep.
    """

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Add the points of ``results['lidar_sweeps']``.

        Raises:
            BrokenSampleError: If a file is missing or damaged.
            ValueError: If ``results['points']`` are not in the annotation frame (`PointsToFrame`).
        """
        check_points_in_frame(results, "LoadLidarSweeps")
        return _name_sample_in_errors(super().transform, results)

    def _load_points(self, pts_filename: str) -> np.ndarray:
        if not Path(pts_filename).is_file():
            raise BrokenSampleError(
                f"no earlier LiDAR sweep at {pts_filename}: download the sweeps, or make the "
                "annotation file again with --max-sweeps 0."
            )
        return read_points(pts_filename, self.load_dim).reshape(-1)


@TRANSFORMS.register_module()
class PointsToFrame(BaseTransform):
    """Transform points from the frame of the LiDAR to the annotation frame.

    The transform must come after ``LoadLidarPoints`` and before ``LoadLidarSweeps``. The latter
    transforms the points of earlier sweeps to the annotation frame itself before it adds them.

    Transforms that need points in the annotation frame refuse them unless ``lidar2frame`` is the
    identity. This transform sets it to the identity, and a transform that replaces it must do so.
    """

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Apply ``lidar2frame``, the transform (4, 4) to the annotation frame, to ``points``."""
        matrix = results["lidar2frame"]
        if not np.array_equal(matrix, np.eye(4)):
            points = results["points"].clone()
            frame_from_lidar = torch.as_tensor(matrix, dtype=points.tensor.dtype)
            rotation = frame_from_lidar[:3, :3]
            shift = frame_from_lidar[:3, 3]
            points.tensor[:, :3] = points.tensor[:, :3] @ rotation.T + shift
            results["points"] = points
            results["lidar2frame"] = np.eye(4)
        return results


@TRANSFORMS.register_module()
@dataclass(eq=False)
class MakeDepthMap(BaseTransform):
    """Add ``gt_depth``, the depth in metres of the nearest LiDAR point at each pixel. (V, H, W)

    Pixels without a point are 0. The transform must follow all transforms that load points or
    resize images, since it projects the points by ``lidar2img``, the projection matrix of each
    view of the resized images.

    Args:
        depth_range: Smallest depth, included, and largest depth, excluded, in metres.
        pad_size_divisor: The model pads images at the bottom and right until their height and width
            are multiples of this number. H and W are the padded sizes.
    """

    depth_range: tuple[float, float] = (1.0, 60.0)
    pad_size_divisor: int = 32

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Project the points into each camera view.

        Raises:
            ValueError: If the points are not in the annotation frame (`PointsToFrame`).
        """
        check_points_in_frame(results, "MakeDepthMap")
        points = results["points"].tensor[:, :3].numpy().astype(np.float64)
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=-1)
        height, width = padded_size(results["img_shape"], self.pad_size_divisor)
        min_depth, max_depth = self.depth_range
        depths = np.zeros((len(results["lidar2img"]), height, width), dtype=np.float32)
        for view, lidar2img in enumerate(results["lidar2img"]):
            projected = homogeneous @ lidar2img.T  # (u * depth, v * depth, depth, 1). (n, 4)
            u_times_depth, v_times_depth, depth = projected[:, :3].T
            in_range = (depth >= min_depth) & (depth < max_depth)
            depth = depth[in_range]
            col = np.round(u_times_depth[in_range] / depth)
            row = np.round(v_times_depth[in_range] / depth)
            # Size of the view without padding. Points beside it are not in the picture.
            num_rows, num_cols = results["raw_shapes"][view]
            is_inside = (col >= 0) & (col < num_cols) & (row >= 0) & (row < num_rows)
            depth = depth[is_inside]
            col = col[is_inside].astype(int)
            row = row[is_inside].astype(int)
            # If several points fall into one pixel, the nearest one is written last and remains.
            far_first = np.argsort(-depth, kind="stable")
            depths[view, row[far_first], col[far_first]] = depth[far_first]
        results["gt_depth"] = torch.from_numpy(depths)
        return results
