"""The tables of nuScenes-format data, without what maps do not need."""

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from pyquaternion import Quaternion

from gsmap.converters.nuscenes.can_bus import CanBusReader
from gsmap.datasets.annotations.record import CameraRecord, LidarRecord, MapSample, SweepRecord
from gsmap.structures.rigid import invert_rigid

CAMERAS = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip
LIDAR = "LIDAR_TOP"
# what is read of each table: fields with their type, or how many numbers they hold
_POSE: dict[str, type | int] = {"translation": 3, "rotation": 4}
_FIELDS: dict[str, dict[str, type | int]] = {
    "sensor": {"channel": str, "modality": str},
    "calibrated_sensor": {"sensor_token": str, "camera_intrinsic": list, **_POSE},
    "ego_pose": _POSE,
    "log": {"location": str},
    "scene": {"name": str, "log_token": str, "first_sample_token": str, "nbr_samples": int},
    "sample": {"timestamp": int, "next": str},
    "sample_data": {
        "sample_token": str, "ego_pose_token": str, "calibrated_sensor_token": str,
        "timestamp": int, "filename": str, "is_key_frame": bool, "prev": str, "width": int,
        "height": int,
    },
}  # fmt: skip
_LINKS = {
    "calibrated_sensor": {"sensor_token": "sensor"},
    "scene": {"log_token": "log", "first_sample_token": "sample"},
    "sample_data": {
        "sample_token": "sample", "ego_pose_token": "ego_pose",
        "calibrated_sensor_token": "calibrated_sensor",
    },
}  # fmt: skip
_MARK = re.compile(r"\s*([\[\],]?)\s*")
_CHUNK_CHARACTERS = 1 << 20  # a record is shorter


def _refuse_constant(name: str) -> float:
    """Refuse NaN and infinity, which JSON does not have."""
    raise ValueError(f"{name} is no number")


def iterate_records(path: Path) -> Iterator[dict[str, Any]]:
    """Read the records of a table (a JSON list) one by one; it is never in memory as a whole.

    Raises:
        ValueError: If it is not one whole list of records, from the first sign to the last.
    """
    decode = json.JSONDecoder(parse_constant=_refuse_constant).raw_decode
    with path.open(encoding="utf-8") as file:
        text, position, expected = "", 0, "["
        try:
            while True:
                if len(text) - position < _CHUNK_CHARACTERS:
                    text, position = text[position:] + file.read(_CHUNK_CHARACTERS), 0
                mark = _MARK.match(text, position)
                sign, position = (mark[1], mark.end()) if mark else ("", position)
                if sign == "[" == expected and text[position : position + 1] == "]":
                    sign, expected, position = "]", ",", position + 1
                if sign == "]" and expected == ",":
                    break
                if sign != expected:
                    raise ValueError(f"{expected!r} is missing before {text[position:][:40]!r}")
                record, position = decode(text, position)
                expected = ","
                yield record
            if (text[position:] + file.read()).strip():
                raise ValueError("something follows the end of the list")
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"table {path} is damaged or incomplete ({error}): download it again."
            ) from error


def _check_record(record: Any, table: str, path: Path) -> None:
    """Raise a ``ValueError`` if a record lacks a field that is read, or it is of another type."""
    token = record.get("token") if isinstance(record, dict) else None
    fields: dict[str, type | int] = {"token": str, **_FIELDS.get(table, {})}
    for name, kind in fields.items():
        value = record.get(name) if isinstance(record, dict) else None
        good = _are_numbers(value, kind) if isinstance(kind, int) else type(value) is kind
        if kind is int:  # microseconds that nanoseconds of 64 bits hold
            good = isinstance(value, int) and good and abs(value) <= 1 << 53
        if name == "camera_intrinsic" and value:  # a matrix, or nothing for another sensor
            good = good and len(value) == 3 and all(_are_numbers(row, 3) for row in value)
        if not good:
            wanted = f"{kind} finite numbers" if isinstance(kind, int) else f"a {kind.__name__}"
            raise ValueError(
                f"{path}, record {token!r}: {name} must be {wanted}, got {value!r}; download it "
                "again."
            )


def _are_numbers(value: Any, count: int) -> bool:
    """Whether a value is a list of finite numbers; four are a quaternion, which has length 1."""
    if type(value) is not list or len(value) != count:
        return False
    if not all(type(v) in (int, float) and math.isfinite(v) for v in value):
        return False
    return count != 4 or abs(math.hypot(*value) - 1) < 1e-3


class NuScenesTables:
    """The tables with the key frames of cameras and LiDAR, and LiDAR sweeps if asked for.

    Annotation tables and every other sensor's records are left out while reading: of trainval's 2.6
    million ``sample_data`` records a tenth remains (a fifth with sweeps), and with them their
    poses. Each sample's ``data`` holds the tokens of its key frames by channel.

    Args:
        version: Version folder, such as ``v1.0-trainval``.
        dataroot: Data root.
        with_sweeps: Whether to keep LiDAR sweeps between key frames.

    Raises:
        FileNotFoundError: If a table is missing.
        ValueError: If a table is damaged or a record points to one that there is not.
    """

    def __init__(self, version: str, dataroot: Path, with_sweeps: bool) -> None:
        self._folder = dataroot / version
        self._records: dict[str, dict[str, dict[str, Any]]] = {}
        for table in ("sensor", "calibrated_sensor", "log", "scene", "sample"):
            self._keep(table, self._read(table))
        self._check_links("calibrated_sensor", "scene")
        self._keep("sample_data", self._wanted_sample_data(with_sweeps))
        wanted = {record["ego_pose_token"] for record in self._records["sample_data"].values()}
        self._keep("ego_pose", (r for r in self._read("ego_pose") if r["token"] in wanted))
        self._check_links("sample_data")
        for sample in self._records["sample"].values():
            sample["data"] = {}
        for token, record in self._records["sample_data"].items():
            if record["is_key_frame"]:
                channel = self._channel_of(record)
                self._records["sample"][record["sample_token"]]["data"][channel] = token
        self.scene = list(self._records["scene"].values())

    def get(self, table: str, token: str) -> dict[str, Any]:
        """Return a record."""
        return self._records[table][token]

    def _keep(self, table: str, records: Iterable[dict[str, Any]]) -> None:
        """Keep a table's records by token."""
        kept = self._records[table] = {}
        for record in records:
            if kept.setdefault(record["token"], record) is not record:
                raise ValueError(
                    f"{self._folder}/{table}.json has record {record['token']!r} twice; download "
                    "the tables again."
                )

    def _read(self, table: str) -> Iterator[dict[str, Any]]:
        """Yield a table's records, checked."""
        path = self._folder / f"{table}.json"
        if not path.is_file():
            raise FileNotFoundError(f"no table at {path}: download the tables again.")
        for record in iterate_records(path):
            _check_record(record, table, path)
            yield record

    def _channel_of(self, record: dict[str, Any]) -> str:
        """Return the sensor channel of a ``sample_data`` record."""
        sensor = self._records["calibrated_sensor"][record["calibrated_sensor_token"]]
        return self._records["sensor"][sensor["sensor_token"]]["channel"]

    def _wanted_sample_data(self, with_sweeps: bool) -> Iterator[dict[str, Any]]:
        for record in self._read("sample_data"):
            self._check_link("sample_data", record, "calibrated_sensor_token")
            channel = self._channel_of(record)
            is_sweep = channel == LIDAR and with_sweeps
            if is_sweep or (record["is_key_frame"] and channel in (LIDAR, *CAMERAS)):
                yield {name: record[name] for name in ("token", *_FIELDS["sample_data"])}

    def _check_links(self, *tables: str) -> None:
        """Check that every link of tables leads somewhere."""
        for table in tables:
            for record in self._records[table].values():
                for name in _LINKS[table]:
                    self._check_link(table, record, name)

    def _check_link(self, table: str, record: dict[str, Any], name: str) -> None:
        if record[name] not in self._records[_LINKS[table][name]]:
            raise ValueError(
                f"{self._folder}/{table}.json, record {record['token']!r}: {name} "
                f"{record[name]!r} leads nowhere; download the tables again."
            )

    def chain(
        self, table: str, token: str, step: str, first: dict[str, Any]
    ) -> Iterator[dict[str, Any]]:
        """Yield records that lead from one to the next.

        Args:
            table: Their table.
            token: The first one's token; an empty one ends the chain.
            step: The field that leads on.
            first: The record that leads to the first one.

        Raises:
            ValueError: If a link leads nowhere or back.
        """
        known, seen, record = self._records[table], set(), first
        while token:
            if token not in known:
                raise ValueError(
                    f"{self._folder}/{table}.json has no record {token!r}, to which "
                    f"{record['token']!r} leads; download the tables again."
                )
            if token in seen:
                raise ValueError(
                    f"{self._folder}/{table}.json, record {record['token']!r}: {step} leads "
                    f"back to {token!r}; download the tables again."
                )
            seen.add(token)
            record = known[token]
            yield record
            token = record[step]

    def samples_of(self, scene: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield a scene's samples in order of time."""
        return self.chain("sample", scene["first_sample_token"], "next", scene)

    def location_of(self, scene: dict[str, Any]) -> str:
        """Return the name of the map that a scene was driven on."""
        return self.get("log", scene["log_token"])["location"]


def pose_of(record: Mapping[str, Any], prefix: str = "") -> np.ndarray:
    """Return the transform of a record's ``translation`` and ``rotation``. (4, 4).

    The rotation is a quaternion (w, x, y, z), or in info files a matrix.
    """
    pose = np.eye(4)
    turned = np.asarray(record[f"{prefix}rotation"], np.float64)
    pose[:3, :3] = turned if turned.shape == (3, 3) else Quaternion(turned).rotation_matrix
    pose[:3, 3] = np.asarray(record[f"{prefix}translation"], np.float64).reshape(3)
    return pose


class SampleReader:
    """Turn rows of the tables into samples, without ground truth.

    Args:
        tables: The opened tables.
        max_sweeps: How many earlier LiDAR sweeps a sample lists at most.
        can_bus: The vehicle's signals; None leaves them unknown.
    """

    def __init__(
        self, tables: NuScenesTables, max_sweeps: int, can_bus: CanBusReader | None = None
    ) -> None:
        self._tables, self._max_sweeps, self._can_bus = tables, max_sweeps, can_bus

    def _global_from(self, data: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return global-from-sensor and ego-from-sensor of a sensor record. each (4, 4)."""
        sensor = pose_of(self._tables.get("calibrated_sensor", data["calibrated_sensor_token"]))
        return pose_of(self._tables.get("ego_pose", data["ego_pose_token"])) @ sensor, sensor

    def read(self, sample: dict[str, Any], scene: dict[str, Any]) -> MapSample:
        """Read a sample in the frame of its LiDAR, without instances and absent cameras."""
        lidar = self._tables.get("sample_data", sample["data"][LIDAR])
        global_from_frame, ego_from_frame = self._global_from(lidar)
        signals = None
        if self._can_bus is not None:
            pose = global_from_frame @ invert_rigid(ego_from_frame)
            signals = self._can_bus.signals(scene["name"], sample["timestamp"] * 1000, pose)
        return MapSample(
            token=sample["token"],
            scene=scene["name"],
            map_name=self._tables.location_of(scene),
            timestamp_ns=sample["timestamp"] * 1000,
            cameras=self._cameras(sample, global_from_frame),
            global_from_frame=global_from_frame,
            lidar=LidarRecord(lidar["filename"], np.eye(4), self._sweeps(lidar, global_from_frame)),
            ego_from_frame=ego_from_frame,
            can_bus=signals,
        )

    def _cameras(self, sample: dict[str, Any], global_from_frame: np.ndarray) -> list[CameraRecord]:
        cameras = []
        for name in CAMERAS:
            if name not in sample["data"]:
                continue
            data = self._tables.get("sample_data", sample["data"][name])
            calibration = self._tables.get("calibrated_sensor", data["calibrated_sensor_token"])
            global_from_cam, _ = self._global_from(data)
            size = data["width"], data["height"]
            cam_from_frame = invert_rigid(global_from_cam) @ global_from_frame
            intrinsics = np.array(calibration["camera_intrinsic"])
            cameras.append(CameraRecord(name, data["filename"], *size, intrinsics, cam_from_frame))
        return cameras

    def _sweeps(self, lidar: dict[str, Any], global_from_frame: np.ndarray) -> list[SweepRecord]:
        frame_from_global = invert_rigid(global_from_frame)
        if not self._max_sweeps:
            return []
        earlier = self._tables.chain("sample_data", lidar["prev"], "prev", lidar)
        return [
            SweepRecord(
                data["filename"],
                data["timestamp"] * 1000,
                frame_from_global @ self._global_from(data)[0],
            )
            for data in islice(earlier, self._max_sweeps)
        ]
