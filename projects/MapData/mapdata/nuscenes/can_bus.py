"""Vehicle signals of the nuScenes CAN bus expansion in MapTR's layout (18 numbers)."""

import re
from pathlib import Path

import numpy as np

from gsmap.datasets.errors import explain_errors
from gsmap.structures.vehicle_signals import pose_signals
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json

_NUSCENES_SCENE = re.compile(r"scene-(\d{4})")
# Fields of a message: time in microseconds, acceleration, rotation rate and velocity.
_FIELDS = ("utime", "accel", "rotation_rate", "vel")
Messages = tuple[np.ndarray, np.ndarray]
"""Ascending times in microseconds (n,), and acceleration in m/s^2, rotation rate in rad/s and
velocity in m/s, three numbers each (n, 9)."""


def signals_at(timestamp_ns: int, global_from_ego: np.ndarray, messages: Messages) -> np.ndarray:
    """Compute the vehicle signals at a time from the pose and the latest message.

    Args:
        timestamp_ns: Time in nanoseconds.
        global_from_ego: Transform from the vehicle to the map in metres. (4, 4)
        messages: Messages of the scene (`read_messages`).

    Returns:
        Signals in the order of ``pose_signals``. If there is no message at or before the time,
        acceleration, rotation rate and velocity are 0. (18,)
    """
    signals = pose_signals(global_from_ego)
    times_us, measurements = messages
    # Signals 7 to 15 do not follow from the pose, and `pose_signals` leaves them zero.
    # Index of the latest message at or before the time; -1 if there is no such message.
    latest = int(np.searchsorted(times_us, timestamp_ns // 1000, side="right")) - 1
    if latest >= 0:
        signals[7:16] = measurements[latest]  # after the position (3) and the quaternion (4)
    return signals


def read_messages(dataroot: Path, scene: str) -> Messages:
    """Read the ``pose`` messages of a scene from the CAN bus expansion.

    Args:
        dataroot: Data root with the folder ``can_bus``.
        scene: Name of the scene.

    Returns:
        The messages by ascending time. Empty if the expansion has no file of the scene, and for the
        scenes that the nuScenes devkit rejects (161 to 176, 309 to 314).

    Raises:
        ValueError: If the file of the scene is damaged.
    """
    path = dataroot / f"can_bus/{scene}_pose.json"
    if not path.is_file() or _is_unreliable(scene, dataroot):
        return np.zeros(0, np.int64), np.zeros((0, 9))
    remedy = "unpack the CAN bus expansion again; a message has " + ", ".join(_FIELDS)
    with explain_errors(path, remedy=remedy):
        messages = read_json(path)
        times = []
        rows = []
        for message in messages:
            times.append(message["utime"])
            rows.append([*message["accel"], *message["rotation_rate"], *message["vel"]])
        times_us = np.array(times, dtype=np.int64)
        measurements = np.array(rows, dtype=np.float64).reshape(-1, 9)
        if not np.isfinite(measurements).all():
            raise InputError("a number is not finite")
    order = np.argsort(times_us, kind="stable")
    return times_us[order], measurements[order]


def _is_unreliable(scene: str, dataroot: Path) -> bool:
    """Whether a scene is a nuScenes scene whose signals the devkit rejects."""
    from nuscenes.can_bus.can_bus_api import NuScenesCanBus

    number = _NUSCENES_SCENE.fullmatch(scene)
    return number is not None and int(number[1]) in NuScenesCanBus(str(dataroot)).can_blacklist
