"""A vehicle's motion as 18 numbers in MapTR's layout (``can_bus``)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyquaternion import Quaternion

from gsmap.structures.calibration import NUM_CAN_BUS

Pose = tuple[float, NDArray[np.floating[Any]]]
"""A time in seconds, and the transform from the vehicle to the world then. (4, 4)"""
_GRAVITY = np.array([0.0, 0.0, 9.81])  # an accelerometer feels it


def pose_signals(global_from_ego: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the signals that a vehicle's pose tells, the others zero. (4, 4) -> (18,).

    Entries: position (3), orientation (w, x, y, z), acceleration (3), rotation rate (3), velocity
    (3), yaw in radians, yaw in degrees in [0, 360).
    """
    values = np.zeros(NUM_CAN_BUS)
    values[:3] = global_from_ego[:3, 3]
    values[3:7] = Quaternion(matrix=global_from_ego, atol=1e-6, rtol=1e-6).elements
    yaw_deg = np.degrees(np.arctan2(global_from_ego[1, 0], global_from_ego[0, 0])) % 360.0
    values[16:] = np.radians(yaw_deg), yaw_deg
    return values


def pose_only_signals(global_from_ego: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the signals that MapTR's code for Argoverse 2 makes of a pose. (4, 4) -> (18,).

    They are those of `pose_signals`, but with ones for acceleration, rotation rate and velocity,
    which are not known there.
    """
    values = pose_signals(global_from_ego)
    values[7:16] = 1.0
    return values


def motion_signals(
    now: Pose, before: Pose | None = None, after: Pose | None = None
) -> NDArray[np.float64]:
    """Return the signals that poses tell: `pose_signals`, and the rates by differences. (18,)

    Args:
        now: The pose at the time of the signals.
        before: An earlier pose of the drive, or None.
        after: A later one, or None.
    """
    (time, pose), (start, first), (end, last) = now, before or now, after or now
    values, to_ego = pose_signals(pose), pose[:3, :3].T
    acceleration = _GRAVITY
    if end > start:
        turn = Quaternion(matrix=first[:3, :3].T @ last[:3, :3], atol=1e-6, rtol=1e-6)
        values[10:13] = turn.axis * turn.radians / (end - start)
        values[13:16] = to_ego @ (last - first)[:3, 3] / (end - start)
    if end > time > start:
        speeds = (pose - first)[:3, 3] / (time - start), (last - pose)[:3, 3] / (end - time)
        acceleration = _GRAVITY + 2 * (speeds[1] - speeds[0]) / (end - start)
    values[7:10] = to_ego @ acceleration
    return values
