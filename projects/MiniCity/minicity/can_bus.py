"""A drive's motion as messages of the nuScenes CAN bus expansion."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minicity.curves import Array

RATE_HZ = 50
STEP_S = 0.02
GRAVITY = 9.81


def pose_messages(
    world_from_ego: Callable[[float], Array], start_us: int, duration_s: float
) -> list[dict[str, Any]]:
    """``pose`` messages of a drive, from a tenth of a second before it to its end.

    Args:
        world_from_ego: Pose of the car at a time in seconds. () -> (4, 4)
        start_us: Timestamp of time 0, microseconds.
        duration_s: Length of the drive.

    Returns:
        Messages with position and orientation in the world, and velocity, acceleration (gravity
        included) and rotation rate in the car's frame, by central differences.
    """
    times = np.arange(-0.1, duration_s + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    before, now, after = (
        np.array([world_from_ego(float(t + shift)) for t in times])
        for shift in (-STEP_S, 0.0, STEP_S)
    )
    to_car = np.swapaxes(now[:, :3, :3], 1, 2)
    velocity = (after[:, :3, 3] - before[:, :3, 3]) / (2 * STEP_S)
    bend = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / STEP_S**2
    turn = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    orientation = Rotation.from_matrix(now[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    fields = {
        "pos": now[:, :3, 3],
        "orientation": orientation,
        "vel": np.einsum("nij,nj->ni", to_car, velocity),
        "accel": np.einsum("nij,nj->ni", to_car, bend + np.array([0.0, 0.0, GRAVITY])),
        "rotation_rate": turn.as_rotvec() / (2 * STEP_S),
    }
    return [
        {
            "utime": start_us + round(float(time) * 1e6),
            **{name: np.round(values[i], 6).tolist() for name, values in fields.items()},
        }
        for i, time in enumerate(times)
    ]
