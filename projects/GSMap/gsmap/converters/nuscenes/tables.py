"""The tables of nuScenes-format data, opened with the devkit without what maps do not need."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.geometry_utils import transform_matrix
from pyquaternion import Quaternion

from gsmap.datasets.annotations.record import CameraRecord, LidarRecord, MapSample, SweepRecord
from gsmap.structures.rigid import invert_rigid

CAMERAS = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip
LIDAR = "LIDAR_TOP"
_UNUSED = {"sample_annotation", "instance", "image_annotations"}
_SAMPLE_DATA_FIELDS = (
    "token", "sample_token", "ego_pose_token", "calibrated_sensor_token", "timestamp", "filename",
    "is_key_frame", "prev", "next", "width", "height",
)  # fmt: skip
_SEPARATOR = re.compile(r"[\s,\[\]]*")
_CHUNK_CHARACTERS = 1 << 20


def iterate_records(path: Path) -> Iterator[dict[str, Any]]:
    """Read the records of a table (a JSON list) one by one; it is never in memory as a whole.

    Raises:
        ValueError: If the file ends inside a record.
    """
    decode = json.JSONDecoder().raw_decode
    with path.open(encoding="utf-8") as file:
        text, position = "", 0
        while chunk := file.read(_CHUNK_CHARACTERS):
            text, position = text[position:] + chunk, 0
            while True:
                separator = _SEPARATOR.match(text, position)
                position = separator.end() if separator else position
                try:
                    record, position = decode(text, position)
                except json.JSONDecodeError:
                    break  # the record goes on in the next chunk
                yield record
        if _SEPARATOR.fullmatch(text, position) is None:
            raise ValueError(f"table {path} is damaged or incomplete: download it again.")


class NuScenesTables(NuScenes):
    """The devkit's tables with key frames of cameras and LiDAR, and LiDAR sweeps if asked for.

    The annotation tables and every other sensor's records are left out while reading: of trainval's
    2.6 million ``sample_data`` records a tenth remains (a fifth with sweeps), and with them their
    poses.

    Args:
        version: Version folder, such as ``v1.0-trainval``.
        dataroot: Data root.
        with_sweeps: Whether to keep LiDAR sweeps between key frames.
    """

    def __init__(self, version: str, dataroot: Path, with_sweeps: bool) -> None:
        self._with_sweeps = with_sweeps
        self._kept_data: list[dict[str, Any]] = []
        super().__init__(version, str(dataroot), verbose=False)

    def __load_table__(self, table_name: str) -> list[dict[str, Any]]:
        path = Path(self.table_root, f"{table_name}.json")
        if table_name in _UNUSED:
            return []
        if table_name == "ego_pose":  # asked for before sample_data, which says what is needed
            self._kept_data = self._wanted_sample_data()
            wanted = {record["ego_pose_token"] for record in self._kept_data}
            return [pose for pose in iterate_records(path) if pose["token"] in wanted]
        if table_name == "sample_data":
            return self._kept_data
        return list(iterate_records(path))

    def _wanted_sample_data(self) -> list[dict[str, Any]]:
        channels = {sensor["token"]: sensor["channel"] for sensor in self.sensor}
        channel_of = {c["token"]: channels[c["sensor_token"]] for c in self.calibrated_sensor}
        kept = []
        for record in iterate_records(Path(self.table_root, "sample_data.json")):
            channel = channel_of[record["calibrated_sensor_token"]]
            is_sweep = channel == LIDAR and self._with_sweeps
            if is_sweep or (record["is_key_frame"] and (channel == LIDAR or channel in CAMERAS)):
                kept.append({name: record.get(name) for name in _SAMPLE_DATA_FIELDS})
        return kept

    def samples_of(self, scene: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield a scene's samples in order of time."""
        token = scene["first_sample_token"]
        while token:
            sample = self.get("sample", token)
            yield sample
            token = sample["next"]

    def location_of(self, scene: dict[str, Any]) -> str:
        """Return the name of the map that a scene was driven on."""
        return self.get("log", scene["log_token"])["location"]


def _pose(record: dict[str, Any]) -> np.ndarray:
    """Return the transform of an ``ego_pose`` or ``calibrated_sensor`` record. (4, 4)."""
    return transform_matrix(record["translation"], Quaternion(record["rotation"]))


class SampleReader:
    """Turn rows of the tables into samples, without ground truth.

    Args:
        tables: The opened tables.
        max_sweeps: How many earlier LiDAR sweeps a sample lists at most.
    """

    def __init__(self, tables: NuScenesTables, max_sweeps: int) -> None:
        self._tables = tables
        self._max_sweeps = max_sweeps

    def _global_from(self, data: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return global-from-sensor and ego-from-sensor of a sensor record. each (4, 4)."""
        sensor = _pose(self._tables.get("calibrated_sensor", data["calibrated_sensor_token"]))
        return _pose(self._tables.get("ego_pose", data["ego_pose_token"])) @ sensor, sensor

    def read(self, sample: dict[str, Any], scene: dict[str, Any]) -> MapSample:
        """Read a sample in the LIDAR_TOP frame, without instances and cameras that have no record.

        Raises:
            ValueError: If it has no LIDAR_TOP key frame, so that its frame is unknown.
        """
        if LIDAR not in sample["data"]:
            raise ValueError(f"no {LIDAR} key frame")
        lidar = self._tables.get("sample_data", sample["data"][LIDAR])
        global_from_frame, ego_from_frame = self._global_from(lidar)
        if not np.isfinite(global_from_frame).all():
            raise ValueError(f"pose of {LIDAR} is not finite")
        return MapSample(
            token=sample["token"],
            scene=scene["name"],
            map_name=self._tables.location_of(scene),
            timestamp_ns=int(sample["timestamp"]) * 1000,
            cameras=self._cameras(sample, global_from_frame),
            global_from_frame=global_from_frame,
            lidar=LidarRecord(lidar["filename"], np.eye(4), self._sweeps(lidar, global_from_frame)),
            ego_from_frame=ego_from_frame,
        )

    def _cameras(self, sample: dict[str, Any], global_from_frame: np.ndarray) -> list[CameraRecord]:
        cameras = []
        for name in CAMERAS:
            if name not in sample["data"]:
                continue
            data = self._tables.get("sample_data", sample["data"][name])
            calibration = self._tables.get("calibrated_sensor", data["calibrated_sensor_token"])
            global_from_cam, _ = self._global_from(data)
            size = int(data["width"] or 0), int(data["height"] or 0)
            intrinsics = np.array(calibration["camera_intrinsic"], np.float64)
            cam_from_frame = invert_rigid(global_from_cam) @ global_from_frame
            cameras.append(CameraRecord(name, data["filename"], *size, intrinsics, cam_from_frame))
        return cameras

    def _sweeps(self, lidar: dict[str, Any], global_from_frame: np.ndarray) -> list[SweepRecord]:
        frame_from_global = invert_rigid(global_from_frame)
        sweeps: list[SweepRecord] = []
        token = lidar["prev"]
        while token and len(sweeps) < self._max_sweeps:
            data = self._tables.get("sample_data", token)
            frame_from_sweep = frame_from_global @ self._global_from(data)[0]
            timestamp_ns = int(data["timestamp"]) * 1000
            sweeps.append(SweepRecord(data["filename"], timestamp_ns, frame_from_sweep))
            token = data["prev"]
        return sweeps
