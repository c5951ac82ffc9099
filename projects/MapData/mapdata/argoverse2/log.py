"""Folder of one Argoverse 2 log: poses, calibration and times of the sensors."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from av2.geometry.camera.pinhole_camera import PinholeCamera
from av2.geometry.geometry import quat_to_mat
from av2.utils.synchronization_database import SynchronizationDB

from gsmap.datasets.errors import explain_errors
from gsmap.structures.rigid import is_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import SUFFIX as PARTIAL_SUFFIX
from mapdata.arrow_tables import read_table

# Camera order of MapTR and its successors; the camera embeddings of checkpoints depend on it.
RING_CAMERAS = (
    "ring_front_center", "ring_front_right", "ring_front_left", "ring_rear_right", "ring_rear_left",
    "ring_side_right", "ring_side_left",
)  # fmt: skip
# Longest times by which a LiDAR sweep and an image may differ, by the official API. The first limit
# is for the image of a ring camera that belongs to a sweep. The second one is for the sweep that
# belongs to an image of any camera.
MAX_CAMERA_OFFSET_NS = int(SynchronizationDB.MAX_LIDAR_RING_CAM_TIMESTAMP_DIFF)  # 25 ms
MAX_LIDAR_OFFSET_NS = int(SynchronizationDB.MAX_LIDAR_ANYCAM_TIMESTAMP_DIFF)  # 51 ms

POSE_TABLE = "city_SE3_egovehicle.feather"  # file of each log with the poses of the vehicle
_SAME_PLACE_M = 0.1  # largest distance along an axis of two poses that count as one

# Logs with an unusable map or unusable sensor data.
BROKEN_LOGS = (
    "01bb304d-7bd8-35f8-bbef-7086b688e35e", "453e5558-6363-38e3-bf9b-42b5ba0a6f1d",
)  # fmt: skip
# Logs whose map was changed on purpose, as listed by Argoverse 2.
MAP_CHANGE_LOGS = (
    "75e8adad-50a6-3245-8726-5e612db3d165", "54bc6dbc-ebfb-3fba-b5b3-57f88b4b79ca",
    "af170aac-8465-3d7b-82c5-64147e94af7d", "6e106cf8-f6dd-38f6-89c8-9be7a71e7275",
)  # fmt: skip


def _read_feather(path: Path) -> Any:
    """Read and validate a table as a pandas data frame.

    Raises:
        ArrowException: If the table is damaged.
    """
    return read_table(path).to_pandas()


def _check_camera(camera: PinholeCamera) -> None:
    """Raise a ``ValueError`` for sizes, focal lengths or a pose that no camera can have."""
    lens = camera.intrinsics
    positive = (lens.fx_px, lens.fy_px, lens.width_px, lens.height_px)
    has_lens = np.isfinite(lens.K).all() and min(positive) > 0
    if not (has_lens and is_rigid(camera.ego_SE3_cam.transform_matrix)):
        raise InputError(f"the calibration of {camera.cam_name} has invalid values")


class Argoverse2Log:
    """Content of one log's folder. Attributes are read on first use and cached.

    Args:
        log_dir: Folder of the log, named by the id of the log.
    """

    def __init__(self, log_dir: Path) -> None:
        self.log_dir = log_dir
        self.log_id = log_dir.name

    @cached_property
    def poses(self) -> dict[int, np.ndarray]:
        """Transforms from the vehicle to the city; the keys are ascending times in ns. Each (4, 4).

        Raises:
            FileNotFoundError: If the pose table is missing.
            ValueError: If the table is damaged or empty, a translation is not finite, a quaternion
                does not have the length 1, or a time has several poses that differ by more than
                0.1 m.
        """
        path = self.log_dir / POSE_TABLE
        if not path.is_file():
            raise FileNotFoundError(f"no poses at {path}: download the log again.")
        # `explain_errors` adds the path and the advice to errors about the content of the file.
        with explain_errors(path, "download the log again"):
            table = _read_feather(path)
            places = table[["timestamp_ns", "tx_m", "ty_m", "tz_m"]].groupby("timestamp_ns")
            spread_m = (places.max() - places.min()).max(axis=1)
            if (spread_m > _SAME_PLACE_M).any():
                raise InputError(f"it has several poses for the time {spread_m.idxmax()} ns")
            # The first pose of each time is kept.
            table = table.drop_duplicates("timestamp_ns").sort_values("timestamp_ns")
            quaternions = table[["qw", "qx", "qy", "qz"]].to_numpy(np.float64)
            translations = table[["tx_m", "ty_m", "tz_m"]].to_numpy(np.float64)
            # The quaternion of a rotation has the length 1. The comparison is also False for NaN.
            is_valid = np.abs(np.linalg.norm(quaternions, axis=1) - 1) < 1e-3
            is_valid &= np.isfinite(translations).all(axis=1)
            num_invalid = int((~is_valid).sum())
            if num_invalid > 0 or len(table) == 0:
                raise InputError(f"{num_invalid} of its {len(table)} poses are not valid")
            times = table["timestamp_ns"].to_numpy(np.int64).tolist()
        rotations = quat_to_mat(quaternions)  # (n, 3, 3)
        poses = {}
        for time, rotation, translation in zip(times, rotations, translations, strict=True):
            poses[time] = rigid(rotation, translation)
        return poses

    @cached_property
    def city(self) -> str:
        """Short name of the city, such as ``PIT``; empty if no map file has a city in its name."""
        map_paths = (self.log_dir / "map").glob("log_map_archive_*____*.json")
        path = next(map_paths, None)  # a log has one map, so the first file suffices
        if path is None:
            return ""
        suffix = path.name.split("____")[1]  # such as "PIT_city_47117.json"
        return suffix.split("_")[0]

    @cached_property
    def calibration(self) -> dict[str, PinholeCamera]:
        """Calibrated ring cameras by name; empty if the log has no calibration.

        Raises:
            ValueError: If a calibration file is damaged, or its values are no camera.
        """
        folder = self.log_dir / "calibration"
        intrinsics_path = folder / "intrinsics.feather"
        extrinsics_path = folder / "egovehicle_SE3_sensor.feather"
        if not intrinsics_path.is_file() or not extrinsics_path.is_file():
            return {}
        cameras = {}
        with explain_errors(folder, "download the log again"):
            intrinsics = _read_feather(intrinsics_path)
            _read_feather(extrinsics_path)  # only to validate it: av2 reads it without validation
            calibrated_names = set(intrinsics["sensor_name"])
            for name in RING_CAMERAS:
                if name in calibrated_names:
                    cameras[name] = PinholeCamera.from_feather(self.log_dir, name)
                    _check_camera(cameras[name])
        return cameras

    @cached_property
    def lidar_timestamps_ns(self) -> np.ndarray:
        """Ascending times of the LiDAR sweeps in nanoseconds. (n,)"""
        return _timestamps(self.log_dir / "sensors/lidar", ".feather")

    @cached_property
    def image_timestamps_ns(self) -> dict[str, np.ndarray]:
        """Ascending times of the images in nanoseconds, by name of the ring camera. Each (n,)."""
        folder = self.log_dir / "sensors/cameras"
        return {name: _timestamps(folder / name, ".jpg") for name in RING_CAMERAS}


def closest_ns(timestamps_ns: np.ndarray, wanted_ns: int, tolerance_ns: int) -> int | None:
    """Find the time closest to a wanted time.

    Args:
        timestamps_ns: Ascending times in nanoseconds. (n,)
        wanted_ns: Wanted time in nanoseconds.
        tolerance_ns: Largest distance from the wanted time in nanoseconds.

    Returns:
        The closest time in nanoseconds; None if no time is within the tolerance.
    """
    if len(timestamps_ns) == 0:
        return None
    after = int(np.searchsorted(timestamps_ns, wanted_ns))  # first time at or after the wanted one
    neighbours = timestamps_ns[max(after - 1, 0) : after + 1]  # the times before and after
    index = np.abs(neighbours - wanted_ns).argmin()
    closest = int(neighbours[index])
    return closest if abs(closest - wanted_ns) <= tolerance_ns else None


def find_logs(root: Path, split: str, logs: Sequence[str] = ()) -> list[Path]:
    """Find the logs of a split.

    Args:
        root: Data root. The folder of the split is ``root/split`` or ``root/sensor/split``.
        split: ``train``, ``val`` or ``test``.
        logs: Ids, or first characters of ids, of the logs to take; an empty sequence takes all
            logs.

    Returns:
        Folders of the logs, sorted.

    Raises:
        FileNotFoundError: If the split is missing or has no log, or if no id begins with one of
            ``logs``.
    """
    folder = _split_folder(root, split)
    if folder is None:
        raise FileNotFoundError(
            f"no folder {root / split} (nor {root / 'sensor' / split}): --root must name the "
            "folder that holds train, val and test of the Argoverse 2 sensor data set "
            "(https://www.argoverse.org/av2.html#download-link)."
        )
    log_dirs = _logs_of_split(folder)
    if not log_dirs and not logs:
        raise FileNotFoundError(f"no Argoverse 2 log in {folder}.")
    return chosen_logs(log_dirs, logs, where=str(folder))


def chosen_logs(log_dirs: list[Path], logs: Sequence[str], where: str) -> list[Path]:
    """Select logs by their ids.

    Args:
        log_dirs: Folders of the logs.
        logs: Ids, or first characters of ids; an empty sequence takes all logs.
        where: Place of the logs, for messages.

    Returns:
        The selected folders in their order.

    Raises:
        FileNotFoundError: If no id begins with one of ``logs``.
    """
    for prefix in logs:
        if not any(path.name.startswith(prefix) for path in log_dirs):
            raise FileNotFoundError(f"no log in {where} begins with {prefix!r}.")
    if not logs:
        return log_dirs
    return [path for path in log_dirs if path.name.startswith(tuple(logs))]


def find_all_logs(root: Path) -> list[Path]:
    """Find the logs of all official splits below a data root.

    Returns:
        Folders of the logs, sorted within each split.

    Raises:
        FileNotFoundError: If there is no log.
        ValueError: If a log is in two splits.
    """
    log_dirs = []
    for split in ("train", "val", "test"):
        folder = _split_folder(root, split)
        if folder is not None:
            log_dirs += _logs_of_split(folder)
    if not log_dirs:
        raise FileNotFoundError(f"no Argoverse 2 log in the folders train, val and test of {root}.")
    folder_of_log: dict[str, Path] = {}
    for log_dir in log_dirs:
        other = folder_of_log.setdefault(log_dir.name, log_dir)
        if other != log_dir:
            raise InputError(f"{other} and {log_dir} are one log: remove one of the folders.")
    return log_dirs


def _split_folder(root: Path, split: str) -> Path | None:
    """Folder of an official split, in one of the two places where it may be; None if missing."""
    for folder in (root / split, root / "sensor" / split):
        if folder.is_dir():
            return folder
    return None


def _logs_of_split(folder: Path) -> list[Path]:
    """Sorted subfolders with a map or a pose table.

    Folders that a program of this project has not finished have the ending ``PARTIAL_SUFFIX``, and
    are left out.
    """
    log_dirs = set()
    for part in ("map", POSE_TABLE):
        for path in folder.glob(f"*/{part}"):
            if path.parent.suffix != PARTIAL_SUFFIX:
                log_dirs.add(path.parent)
    return sorted(log_dirs)


def logs_in(folder: Path) -> list[Path]:
    """Find the logs in a folder or at most three levels below it, as in ``sensor/val/LOG``.

    Returns:
        Sorted folders of the logs at the first level that has any; empty if there are no logs.
    """
    for depth in range(4):  # depth 0 is the folder itself
        pattern = "*/" * depth + POSE_TABLE
        pose_tables = sorted(folder.glob(pattern))
        if pose_tables:
            return [path.parent for path in pose_tables]
    return []


def _timestamps(folder: Path, suffix: str) -> np.ndarray:
    """Ascending times from the file names in a folder; empty if the folder is missing. (n,)"""
    if not folder.is_dir():
        return np.empty(0, dtype=np.int64)
    times = []
    for path in folder.iterdir():
        if path.suffix == suffix and path.stem.isdigit():
            times.append(int(path.stem))
    return np.array(sorted(times), dtype=np.int64)
