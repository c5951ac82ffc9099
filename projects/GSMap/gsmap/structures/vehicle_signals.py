"""Vehicle signals: pose and motion of a vehicle as 18 numbers in MapTR's layout (``can_bus``)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyquaternion import Quaternion

from gsmap.structures.calibration import NUM_CAN_BUS

Pose = tuple[float, NDArray[np.floating[Any]]]
"""Time in seconds, and transform from the vehicle to the world at that time in metres (4, 4)."""
# Largest deviation of a rotation matrix from orthogonality. Poses of annotation files are checked
# with 1e-3 for each entry.
_ROTATION_TOLERANCE = 5e-3
# Upward acceleration in m/s^2 that an accelerometer measures at rest, in the world.
_GRAVITY = np.array([0.0, 0.0, 9.81])


def pose_signals(global_from_ego: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Compute the signals that follow from the pose of a vehicle; the others are zero.

    Args:
        global_from_ego: Transform from the vehicle to the world in metres. (4, 4)

    Returns:
        Position (3) in metres and orientation (w, x, y, z) in the world; acceleration (3) with
        gravity in m/s^2, rotation rate (3) in rad/s and velocity (3) in m/s, all in the frame of
        the vehicle; yaw in the world in radians, and in degrees in [0, 360). The acceleration, the
        rotation rate and the velocity are zero. (18,)
    """
    values = np.zeros(NUM_CAN_BUS)
    values[:3] = global_from_ego[:3, 3]
    values[3:7] = _rotation(global_from_ego[:3, :3]).elements
    yaw_deg = np.degrees(np.arctan2(global_from_ego[1, 0], global_from_ego[0, 0])) % 360.0
    values[16] = np.radians(yaw_deg)
    values[17] = yaw_deg
    return values


def _rotation(matrix: NDArray[np.floating[Any]]) -> Quaternion:
    """Rotation of a matrix (3, 3), which may be rounded."""
    return Quaternion(matrix=matrix, atol=_ROTATION_TOLERANCE, rtol=_ROTATION_TOLERANCE)


def pose_only_signals(global_from_ego: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Compute the signals of MapTR's code for Argoverse 2 from a pose.

    All entries of acceleration, rotation rate and velocity are 1, because Argoverse 2 has no
    measurements of them.

    Args:
        global_from_ego: Transform from the vehicle to the world in metres. (4, 4)

    Returns:
        Signals in the layout of `pose_signals`. (18,)
    """
    values = pose_signals(global_from_ego)
    values[7:16] = 1.0
    return values


def motion_signals(
    now: Pose, before: Pose | None = None, after: Pose | None = None
) -> NDArray[np.float64]:
    """Compute signals from poses: `pose_signals`, with the motion from differences of the poses.

    If neither an earlier nor a later pose is given, the rotation rate and the velocity are zero.
    Unless both are given, the acceleration is gravity alone.

    Args:
        now: Pose at the time of the signals.
        before: Earlier pose of the drive, or None.
        after: Later pose of the drive, or None.

    Returns:
        Signals in the layout of `pose_signals`. (18,)
    """
    time, pose = now
    # At the start and the end of a drive, the current pose replaces the missing one.
    start, first = before or now
    end, last = after or now
    values = pose_signals(pose)
    ego_from_global = pose[:3, :3].T  # rotation only, for vectors without a position
    acceleration = _GRAVITY
    if end > start:
        # Rotation of the vehicle from the start to the end, in its frame at the start.
        rotation = _rotation(first[:3, :3].T @ last[:3, :3])
        rotation_rate = rotation.axis * rotation.radians / (end - start)
        values[10:13] = rotation_rate
        velocity = ego_from_global @ (last - first)[:3, 3] / (end - start)
        values[13:16] = velocity
    if end > time > start:
        # Mean velocities of both intervals. The centres of the intervals are (end - start) / 2
        # apart. The acceleration is the difference of the velocities, divided by this time.
        velocity_before = (pose - first)[:3, 3] / (time - start)
        velocity_after = (last - pose)[:3, 3] / (end - time)
        acceleration = _GRAVITY + 2 * (velocity_after - velocity_before) / (end - start)
    values[7:10] = ego_from_global @ acceleration
    return values
