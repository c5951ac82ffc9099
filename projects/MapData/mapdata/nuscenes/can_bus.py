"""Vehicle signals of the nuScenes CAN bus expansion in MapTR's layout (18 numbers)."""

import re
from pathlib import Path

import numpy as np

from gsmap.datasets.errors import explain_errors
from gsmap.structures.vehicle_signals import pose_signals
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json

_NUSCENES_SCENE = re.compile(r"scene-(\d{4})")
# Log file of a nuScenes drive: vehicle, date, time and time zone, such as
# n015-2018-07-24-11-22-45+0800.
_NUSCENES_LOG = re.compile(r"n\d{3}-\d{4}(-\d{2}){5}[+-]\d{4}")
# Fields of a message: time in microseconds, acceleration, rotation rate and velocity.
_FIELDS = ("utime", "accel", "rotation_rate", "vel")
Messages = tuple[np.ndarray, np.ndarray]
"""Ascending times in microseconds (n,), and acceleration in m/s^2, rotation rate in rad/s and
velocity in m/s, three numbers each (n, 9)."""
NO_MESSAGES: Messages = (np.zeros(0, np.int64), np.zeros((0, 9)))


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
        The messages by ascending time. Empty if the expansion has no file of the scene.

    Raises:
        ValueError: If the file of the scene is damaged.
    """
    path = _messages_path(dataroot, scene)
    if not path.is_file():
        return NO_MESSAGES
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


def is_rejected(dataroot: Path, scene: str, logfile: object) -> bool:
    """Test whether a scene is a drive of nuScenes whose messages the nuScenes devkit rejects.

    Scenes of other data sets may have the names of these drives. They are told apart by the names
    of the log files.

    Args:
        dataroot: Data root with the folder ``can_bus``.
        scene: Name of the scene.
        logfile: Field ``logfile`` of the log of the scene; None if there is no such field.

    Returns:
        True if the messages are rejected; False also for a scene without a file of messages.
    """
    number = _NUSCENES_SCENE.fullmatch(scene)
    if number is None or not isinstance(logfile, str) or not _NUSCENES_LOG.fullmatch(logfile):
        return False
    if not _messages_path(dataroot, scene).is_file():
        return False
    from nuscenes.can_bus.can_bus_api import NuScenesCanBus

    return int(number[1]) in NuScenesCanBus(str(dataroot)).can_blacklist


def _messages_path(dataroot: Path, scene: str) -> Path:
    """File of the ``pose`` messages of a scene."""
    return dataroot / f"can_bus/{scene}_pose.json"
