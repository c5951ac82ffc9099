"""The folder of one Argoverse 2 log: poses, calibration, and when each sensor fired."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from av2.geometry.camera.pinhole_camera import PinholeCamera
from av2.geometry.geometry import quat_to_mat
from av2.utils.synchronization_database import SynchronizationDB
from pyarrow import feather

from gsmap.datasets.errors import naming
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import SUFFIX as PARTIAL
from gsmap.utils.inputs import heed_input

# The order of MapTR's family: camera embeddings of its checkpoints depend on it.
RING_CAMERAS = (
    "ring_front_center", "ring_front_right", "ring_front_left", "ring_rear_right", "ring_rear_left",
    "ring_side_right", "ring_side_left",
)  # fmt: skip
MAX_CAMERA_OFFSET_NS = int(SynchronizationDB.MAX_LIDAR_RING_CAM_TIMESTAMP_DIFF)  # 25 ms
MAX_LIDAR_OFFSET_NS = int(SynchronizationDB.MAX_LIDAR_ANYCAM_TIMESTAMP_DIFF)  # 51 ms

POSES = "city_SE3_egovehicle.feather"

# their maps or sensor data cannot be used
BROKEN_LOGS = (
    "01bb304d-7bd8-35f8-bbef-7086b688e35e", "453e5558-6363-38e3-bf9b-42b5ba0a6f1d",
)  # fmt: skip
# by Argoverse 2's own note
MAP_CHANGE_LOGS = (
    "75e8adad-50a6-3245-8726-5e612db3d165", "54bc6dbc-ebfb-3fba-b5b3-57f88b4b79ca",
    "af170aac-8465-3d7b-82c5-64147e94af7d", "6e106cf8-f6dd-38f6-89c8-9be7a71e7275",
)  # fmt: skip


def _read_feather(path: Path) -> Any:
    """Read a table; ``ArrowException`` if it is damaged, which might end the process later."""
    heed_input(path)
    table = feather.read_table(path, memory_map=False)
    table.validate(full=True)
    return table.to_pandas()


class Argoverse2Log:
    """One log's folder, named by its id, read on demand."""

    def __init__(self, log_dir: Path) -> None:
        self.log_dir, self.log_id = log_dir, log_dir.name

    @cached_property
    def poses(self) -> dict[int, np.ndarray]:
        """The vehicle's poses in the city by time, which ascends. each (4, 4)

        Raises:
            FileNotFoundError: If there is no table of them.
            ValueError: If it is damaged or a pose is not finite.
        """
        path = self.log_dir / POSES
        if not path.is_file():
            raise FileNotFoundError(f"no poses at {path}: download the log again.")
        with naming(path, "download the log again"):
            table = _read_feather(path)
            table = table.drop_duplicates("timestamp_ns").sort_values("timestamp_ns")
            quaternions = table[["qw", "qx", "qy", "qz"]].to_numpy(np.float64)
            translations = table[["tx_m", "ty_m", "tz_m"]].to_numpy(np.float64)
            good = np.abs(np.linalg.norm(quaternions, axis=1) - 1) < 1e-3
            good &= np.isfinite(translations).all(1)
            if not good.all() or len(table) == 0:
                raise InputError(f"it holds {int((~good).sum())} bad of {len(table)} poses")
            times = table["timestamp_ns"].to_numpy(np.int64).tolist()
        return dict(zip(times, map(rigid, quat_to_mat(quaternions), translations), strict=True))

    @cached_property
    def city(self) -> str:
        """Short name of the city, such as ``PIT``; empty if the map's file name does not tell."""
        names = [path.name for path in (self.log_dir / "map").glob("log_map_archive_*____*.json")]
        return names[0].split("____")[1].split("_")[0] if names else ""

    @cached_property
    def calibration(self) -> dict[str, PinholeCamera]:
        """The calibrated ring cameras by name; empty if the log has no calibration."""
        folder = self.log_dir / "calibration"
        paths = [folder / "intrinsics.feather", folder / "egovehicle_SE3_sensor.feather"]
        if not all(path.is_file() for path in paths):
            return {}
        with naming(folder, "download the log again"):
            intrinsics, _ = map(_read_feather, paths)
            names = [name for name in RING_CAMERAS if name in set(intrinsics["sensor_name"])]
            return {name: PinholeCamera.from_feather(self.log_dir, name) for name in names}

    @cached_property
    def lidar_timestamps_ns(self) -> np.ndarray:
        """Times of the LiDAR sweeps, ascending. (n,)"""
        return _timestamps(self.log_dir / "sensors/lidar", ".feather")

    @cached_property
    def image_timestamps_ns(self) -> dict[str, np.ndarray]:
        """Times of each ring camera's images, ascending. each (n,)"""
        folder = self.log_dir / "sensors/cameras"
        return {name: _timestamps(folder / name, ".jpg") for name in RING_CAMERAS}


def closest_ns(timestamps_ns: np.ndarray, wanted_ns: int, tolerance_ns: int) -> int | None:
    """Return the time that is closest to a wanted one.

    Args:
        timestamps_ns: Ascending times in nanoseconds. (n,)
        wanted_ns: The wanted time in nanoseconds.
        tolerance_ns: Largest distance in nanoseconds; beyond it the result is None.
    """
    if len(timestamps_ns) == 0:
        return None
    after = int(np.searchsorted(timestamps_ns, wanted_ns))
    candidates = timestamps_ns[max(after - 1, 0) : after + 1]
    best = int(candidates[np.abs(candidates - wanted_ns).argmin()])
    return best if abs(best - wanted_ns) <= tolerance_ns else None


def find_logs(root: Path, split: str, logs: Sequence[str] = ()) -> list[Path]:
    """Return the folders of a split's logs, sorted.

    Args:
        root: Data root. The split is a folder in it or in its folder ``sensor``.
        split: ``train``, ``val`` or ``test``.
        logs: First characters of the ids of the logs to take; empty takes all.

    Raises:
        FileNotFoundError: If there is no such split, or no log that begins as asked.
    """
    folder = _split_folder(root, split)
    if folder is None:
        raise FileNotFoundError(
            f"no folder {root / split} (nor {root / 'sensor' / split}): --root must name the "
            "folder that holds train, val and test of the Argoverse 2 sensor data set "
            "(https://www.argoverse.org/av2.html#download-link)."
        )
    found = _logs_of(folder)
    for prefix in logs:
        if not any(path.name.startswith(prefix) for path in found):
            raise FileNotFoundError(f"no log in {folder} begins with {prefix!r}.")
    if not found:
        raise FileNotFoundError(f"no Argoverse 2 log in {folder}.")
    return [path for path in found if not logs or path.name.startswith(tuple(logs))]


def find_all_logs(root: Path) -> list[Path]:
    """Return the logs of all official splits that are there; FileNotFoundError without any."""
    folders = [_split_folder(root, split) for split in ("train", "val", "test")]
    found = [log for folder in folders if folder is not None for log in _logs_of(folder)]
    if not found:
        raise FileNotFoundError(f"no Argoverse 2 log in the folders train, val and test of {root}.")
    return found


def _split_folder(root: Path, split: str) -> Path | None:
    """Return the folder of an official split, None without."""
    return next((f for f in (root / split, root / "sensor" / split) if f.is_dir()), None)


def _logs_of(folder: Path) -> list[Path]:
    """Return the logs in a folder, sorted."""
    holding = {path.parent for part in ("map", POSES) for path in folder.glob(f"*/{part}")}
    return sorted(path for path in holding if path.suffix != PARTIAL)


def logs_in(folder: Path) -> list[Path]:
    """Return the logs at or up to three folders below a folder (``sensor/val/LOG``)."""
    found = (sorted(folder.glob("*/" * depth + POSES)) for depth in range(4))
    return [path.parent for path in next(filter(None, found), [])]


def _timestamps(folder: Path, suffix: str) -> np.ndarray:
    """Return the times in the names of a folder's files, ascending; none if there is no folder."""
    if not folder.is_dir():
        return np.empty(0, dtype=np.int64)
    stems = (path.stem for path in folder.iterdir() if path.suffix == suffix)
    return np.array(sorted(int(stem) for stem in stems if stem.isdigit()), dtype=np.int64)
