"""Vehicle signals of the nuScenes CAN bus expansion, in MapTR's layout of 18 numbers."""

from pathlib import Path

import numpy as np

from gsmap.datasets.errors import naming
from gsmap.structures.vehicle_signals import pose_signals

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

    There are none without the expansion, and for the scenes that the devkit itself refuses (161 to
    176, 309 to 314).

    Raises:
        ValueError: If the scene's file is damaged.
    """
    path, messages = dataroot / f"can_bus/{scene}_pose.json", []
    with naming(path, "unpack the CAN bus expansion again"):
        if path.is_file():
            from nuscenes.can_bus.can_bus_api import NuScenesCanBus

            api = NuScenesCanBus(dataroot=str(dataroot))
            if int(scene[-4:]) not in api.can_blacklist:  # scenes whose signals are unreliable
                messages = api.get_messages(scene, "pose", print_warnings=False)
        times_us = np.array([message["utime"] for message in messages], np.int64)
        rows = [[*m["accel"], *m["rotation_rate"], *m["vel"]] for m in messages]
        measured = np.array(rows, np.float64).reshape(-1, 9)
        if not np.isfinite(measured).all():
            raise ValueError("a number is not finite")
    return times_us, measured
