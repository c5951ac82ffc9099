"""Checks and conversions of the arguments of map priors: poses, rasters and files."""

from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsmap.structures.elements import FARTHEST_M
from gsmap.structures.rigid import is_rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import lock_file

Pose = Tensor | NDArray[np.floating[Any]]
Raster = Tensor | NDArray[Any]


class PlanarPose(NamedTuple):
    """Position and yaw of a frame in the global frame, in the plane.

    Attributes:
        cos: Cosine of the yaw.
        sin: Sine of the yaw.
        x_m: x of the position in metres.
        y_m: y of the position in metres.
    """

    cos: float
    sin: float
    x_m: float
    y_m: float

    def to_global(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points from the frame to the global frame, in metres. (n, 2) -> (n, 2)"""
        rotation = np.array([[self.cos, -self.sin], [self.sin, self.cos]])
        return points @ rotation.T + np.array([self.x_m, self.y_m])

    def to_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points from the global frame to the frame, in metres. (n, 2) -> (n, 2)"""
        rotation = np.array([[self.cos, -self.sin], [self.sin, self.cos]])
        return (points - np.array([self.x_m, self.y_m])) @ rotation


def planar_pose(pose: Pose) -> PlanarPose:
    """Check a pose, and return its position and yaw. Height, roll and pitch are left out.

    Args:
        pose: Transform from a frame to the global frame, in metres. (4, 4)

    Raises:
        ValueError: If the pose is not rigid, its x or y is beyond ``FARTHEST_M``, or it has no yaw
            because the x axis of the frame is vertical.
    """
    transform = to_numpy(pose).astype(np.float64, copy=False)
    if transform.shape != (4, 4) or not is_rigid(transform):
        raise InputError("pose must be a rigid transform of shape (4, 4).")
    largest_coordinate_m = np.abs(transform[:2, 3]).max()
    if largest_coordinate_m > FARTHEST_M:
        raise InputError(
            f"pose is {largest_coordinate_m:.3g} m from the origin; at most "
            f"{FARTHEST_M:g} m are possible."
        )
    axis = transform[:2, 0]  # x axis of the frame, projected to the plane
    length = float(np.hypot(axis[0], axis[1]))
    if length < 1e-6:
        raise InputError("pose has no yaw: its x axis is vertical.")
    cos, sin = axis / length
    x_m, y_m = transform[:2, 3]
    return PlanarPose(float(cos), float(sin), x_m=float(x_m), y_m=float(y_m))


def to_numpy(values: Raster) -> NDArray[Any]:
    """Convert a tensor on any device, or an array, to an array."""
    if isinstance(values, Tensor):
        detached = values.detach()
        if detached.dtype == torch.bfloat16:  # numpy has no such type
            detached = detached.float()
        return detached.cpu().numpy()
    return np.asarray(values)


def reserve_file(path: Path) -> IO[str]:
    """Reserve a file for a writer, by a lock file beside it. Missing folders are created.

    Args:
        path: File to reserve. It need not exist.

    Returns:
        The open lock file. The reservation ends when the caller closes it.

    Raises:
        ValueError: If another program has written the lock file.
        RuntimeError: If the file is reserved already, by another process or in this one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock_path = path.with_name(f".{path.name}.lock")
    return lock_file(lock_path, subject=path, advice="wait for its end, or write another file")
