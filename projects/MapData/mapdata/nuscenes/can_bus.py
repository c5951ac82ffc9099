"""Vehicle signals of the nuScenes CAN bus expansion, in MapTR's layout of 18 numbers."""

import re
from pathlib import Path

import numpy as np

from gsmap.datasets.errors import naming
from gsmap.structures.vehicle_signals import pose_signals
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json

_NUSCENES_SCENE = re.compile(r"scene-(\d{4})")
_FIELDS = ("utime", "accel", "rotation_rate", "vel")
Messages = tuple[np.ndarray, np.ndarray]
"""Their times in microseconds (n,), and accelerations, rotation rates and velocities (n, 9)."""


def signals_at(timestamp_ns: int, global_from_ego: np.ndarray, messages: Messages) -> np.ndarray:
    """Return the signals of the vehicle at a time, as ``pose_signals`` orders them. (18,)

    Args:
        timestamp_ns: The time in nanoseconds.
        global_from_ego: Pose of the vehicle at that time. (4, 4)
        messages: Times of the CAN bus in microseconds and what was measured; the latest counts.
    """
    values = pose_signals(global_from_ego)
    times_us, measured = messages
    latest = int(np.searchsorted(times_us, timestamp_ns // 1000, side="right")) - 1
    if latest >= 0:
        values[7:16] = measured[latest]
    return values


def read_messages(dataroot: Path, scene: str) -> Messages:
    """Read the ``pose`` messages of a scene from the folder ``can_bus`` of a data root.

    There are none without the expansion, and for nuScenes' scenes that its devkit refuses (161 to
    176, 309 to 314). Scenes may have any name.

    Raises:
        ValueError: If the scene's file is damaged.
    """
    path = dataroot / f"can_bus/{scene}_pose.json"
    if not path.is_file() or _is_unreliable(scene, dataroot):
        return np.zeros(0, np.int64), np.zeros((0, 9))
    with naming(path, "unpack the CAN bus expansion again; a message has " + ", ".join(_FIELDS)):
        messages = read_json(path)
        times_us = np.array([message["utime"] for message in messages], np.int64)
        rows = [[*m["accel"], *m["rotation_rate"], *m["vel"]] for m in messages]
        measured = np.array(rows, np.float64).reshape(-1, 9)
        if not np.isfinite(measured).all():
            raise InputError("a number is not finite")
    order = np.argsort(times_us, kind="stable")
    return times_us[order], measured[order]


def _is_unreliable(scene: str, dataroot: Path) -> bool:
    """Whether the devkit refuses the signals of a scene, which is then one of nuScenes by name."""
    from nuscenes.can_bus.can_bus_api import NuScenesCanBus

    number = _NUSCENES_SCENE.fullmatch(scene)
    return number is not None and int(number[1]) in NuScenesCanBus(str(dataroot)).can_blacklist
