"""Motion of a drive as messages of the nuScenes CAN bus expansion."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minicity.curves import Array

RATE_HZ = 50  # messages per second
STEP_S = 0.02  # finite differences use the poses this many seconds before and after a message
GRAVITY = 9.81  # m / s^2


def pose_messages(
    world_from_ego: Callable[[float], Array], start_us: int, duration_s: float
) -> list[dict[str, Any]]:
    """Create the ``pose`` messages of a drive, from 0.1 seconds before its start to its end.

    Args:
        world_from_ego: Function from a time in seconds to the pose of the car, in metres. (4, 4)
        start_us: Timestamp of time 0, in microseconds.
        duration_s: Duration of the drive in seconds.

    Returns:
        Messages with the timestamp ``utime`` in microseconds, position in metres and orientation
        (w, x, y, z) in the world. Velocity in m / s, acceleration in m / s^2 (gravity included) and
        rotation rate in rad / s are in the car's frame, by central differences.
    """
    # `arange` excludes its limit, which therefore lies half a period after the end of the drive.
    times = np.arange(-0.1, duration_s + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    before = np.array([world_from_ego(float(t - STEP_S)) for t in times])
    now = np.array([world_from_ego(float(t)) for t in times])
    after = np.array([world_from_ego(float(t + STEP_S)) for t in times])
    car_from_world = np.swapaxes(now[:, :3, :3], 1, 2)  # the inverse of a rotation: its transpose
    velocity = (after[:, :3, 3] - before[:, :3, 3]) / (2 * STEP_S)
    second_derivative = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / STEP_S**2
    # An accelerometer at rest measures the acceleration of gravity, upwards: along z of the world.
    acceleration = second_derivative + np.array([0.0, 0.0, GRAVITY])
    # Rotation of the car from before to after, in the car's frame: inverse(before) @ after.
    rotation = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    quaternions = Rotation.from_matrix(now[:, :3, :3]).as_quat()  # x, y, z, w
    fields = {
        "pos": now[:, :3, 3],
        "orientation": quaternions[:, [3, 0, 1, 2]],  # w, x, y, z
        "vel": np.einsum("nij,nj->ni", car_from_world, velocity),
        "accel": np.einsum("nij,nj->ni", car_from_world, acceleration),
        "rotation_rate": rotation.as_rotvec() / (2 * STEP_S),
    }
    messages = []
    for i, time_s in enumerate(times):
        message: dict[str, Any] = {"utime": start_us + round(float(time_s) * 1e6)}
        for name, values in fields.items():
            message[name] = np.round(values[i], 6).tolist()
        messages.append(message)
    return messages
