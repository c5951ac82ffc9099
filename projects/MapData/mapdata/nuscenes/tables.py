"""The tables of nuScenes-format data, without what maps do not need, and the samples in them."""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from pyquaternion import Quaternion

from gsmap.datasets.annotations.record import CameraRecord, LidarRecord, MapSample, SweepRecord
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import is_hidden
from gsmap.utils.json_items import items_of
from gsmap.utils.words import counted
from mapdata.nuscenes.can_bus import read_messages, signals_at

CAMERAS = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip
LIDAR = "LIDAR_TOP"
# what is read of each table: fields with their type, or how many numbers they hold
_POSE: dict[str, type | int] = {"translation": 3, "rotation": 4}
_FIELDS: dict[str, dict[str, type | int]] = {
    "sensor": {"channel": str},
    "calibrated_sensor": {"sensor_token": str, "camera_intrinsic": list, **_POSE},
    "ego_pose": _POSE,
    "log": {"location": str},
    "sample": {"timestamp": int, "next": str},
    "scene": {"name": str, "log_token": str, "first_sample_token": str, "nbr_samples": int},
    "sample_data": {
        "sample_token": str, "ego_pose_token": str, "calibrated_sensor_token": str,
        "timestamp": int, "filename": str, "is_key_frame": bool, "prev": str, "width": int,
        "height": int,
    },
    "sample_annotation": {"sample_token": str, "size": 3, **_POSE},
}  # fmt: skip
_LINKS = {
    "calibrated_sensor": {"sensor_token": "sensor"},
    "scene": {"log_token": "log", "first_sample_token": "sample"},
    "sample_data": {
        "sample_token": "sample", "ego_pose_token": "ego_pose",
        "calibrated_sensor_token": "calibrated_sensor",
    },
}  # fmt: skip


def _is_right(value: Any, kind: type | int) -> bool:
    """Whether a value is of a type, or a list of so many finite numbers."""
    if kind is list:  # a matrix of intrinsics, or nothing for another sensor
        return type(value) is list and (
            not value or (len(value) == 3 and all(_is_right(row, 3) for row in value))
        )
    if kind is int:  # microseconds that nanoseconds of 64 bits hold
        return type(value) is int and abs(value) <= 1 << 53
    if isinstance(kind, type):
        return type(value) is kind
    if type(value) is not list or len(value) != kind:
        return False
    if not all(type(v) in (int, float) and math.isfinite(v) for v in value):
        return False
    return kind != 4 or abs(math.hypot(*value) - 1) < 1e-3  # a quaternion


def pose_of(record: Mapping[str, Any], prefix: str = "") -> np.ndarray:
    """Return the transform of a record's ``translation`` and ``rotation``. (4, 4).

    The rotation is a quaternion (w, x, y, z), or in info files a matrix.
    """
    turned = np.asarray(record[f"{prefix}rotation"], np.float64)
    rotation = turned if turned.shape == (3, 3) else Quaternion(turned).rotation_matrix
    shift = np.asarray(record[f"{prefix}translation"], np.float64)
    if shift.size != 3:
        raise InputError(f"{prefix}translation must be 3 numbers, got {shift.tolist()!r:.60}")
    return rigid(rotation, shift.reshape(3))


def _damaged(folder: Path, table: str, wrong: str) -> ValueError:
    return InputError(f"{folder}/{table}.json{wrong}; download the tables again.")


def read_table(folder: Path, table: str) -> Iterator[dict[str, Any]]:
    """Yield a table's records, what is read of each checked.

    Args:
        folder: Folder of the tables.
        table: Its name, one of those with fields that maps need.

    Raises:
        FileNotFoundError: If it is missing.
        ValueError: If it is damaged; maybe only after some records.
    """
    path = folder / f"{table}.json"
    if not path.is_file():
        raise FileNotFoundError(f"no table at {path}: download the tables again.")
    fields: dict[str, type | int] = {"token": str, **_FIELDS[table]}
    for record, _ in items_of(path, None, "download it again"):
        values = record if isinstance(record, dict) else {}
        for name, kind in fields.items():
            if not _is_right(value := values.get(name), kind):
                numbers = f"{kind} finite numbers"
                wanted = f"a {kind.__name__}" if isinstance(kind, type) else numbers
                wrong = f", record {values.get('token')!r}: {name} must be {wanted}"
                raise _damaged(folder, table, f"{wrong}, got {value!r}")
        yield record


class NuScenesTables:
    """The tables with the key frames of cameras and LiDAR, and LiDAR sweeps if asked for.

    Annotation tables and every other sensor's records are left out while reading: of trainval's 2.6
    million ``sample_data`` records a tenth remains (a fifth with sweeps), and with them their
    poses. Each sample's ``data`` holds the records of its key frames by channel.

    Raises:
        FileNotFoundError: If a table is missing.
        ValueError: If a table is damaged or a record points to one that there is not.
    """

    def __init__(self, version: str, dataroot: Path, max_sweeps: int, frame: str = "lidar") -> None:
        self.frame = frame
        self._folder, self._max_sweeps = dataroot / version, max_sweeps
        self._messages = lru_cache(maxsize=1)(partial(read_messages, dataroot))
        self._records: dict[str, dict[str, dict[str, Any]]] = {}
        for table in ("sensor", "calibrated_sensor", "log", "sample", "scene"):
            self._keep(table, read_table(self._folder, table))
        self.cameras, self.lidar = self._sensors()
        data = list(self._wanted_sample_data())
        wanted = {record["ego_pose_token"] for record in data}
        self._keep(
            "ego_pose", (r for r in read_table(self._folder, "ego_pose") if r["token"] in wanted)
        )
        self._keep("sample_data", data)
        for sample in self._records["sample"].values():
            sample["data"] = {}
        for record in data:
            if record["is_key_frame"]:
                keys = self._records["sample"][record["sample_token"]]["data"]
                keys[self._channel_of(record)] = record
        self.scene = list(self._records["scene"].values())

    def _keep(self, table: str, records: Iterable[dict[str, Any]]) -> None:
        """Keep a table's records by token; those that they link to are there already."""
        kept = self._records[table] = {}
        for record in records:
            for link in _LINKS.get(table, ()):
                self._check_link(table, record, link)
            if kept.setdefault(record["token"], record) is not record:
                raise _damaged(self._folder, table, f" has record {record['token']!r} twice")

    def _check_link(self, table: str, record: dict[str, Any], name: str) -> None:
        if record[name] not in self._records[_LINKS[table][name]]:
            wrong = f", record {record['token']!r}: {name} {record[name]!r} leads nowhere"
            raise _damaged(self._folder, table, wrong)

    def _channel_of(self, record: dict[str, Any]) -> str:
        """Return the sensor channel of a ``sample_data`` record."""
        sensor = self._records["calibrated_sensor"][record["calibrated_sensor_token"]]
        return self._records["sensor"][sensor["sensor_token"]]["channel"]

    def _sensors(self) -> tuple[tuple[str, ...], str]:
        """Return the channels of the cameras, nuScenes' first, and that of the LiDAR.

        Raises:
            ValueError: If the LiDAR is not LIDAR_TOP and its frame is asked for, or not the one.
        """
        channels = {sensor["channel"] for sensor in self._records["sensor"].values()}
        seeing = {
            self._records["sensor"][sensor["sensor_token"]]["channel"]
            for sensor in self._records["calibrated_sensor"].values()
            if sensor["camera_intrinsic"]
        }
        cameras = (*(c for c in CAMERAS if c in seeing), *sorted(seeing - set(CAMERAS)))
        lidars = sorted(channel for channel in channels if "LIDAR" in channel.upper())
        if LIDAR in channels:
            return cameras, LIDAR
        if len(lidars) == 1 and self.frame == "ego":
            return cameras, lidars[0]
        raise InputError(
            f"{self._folder} has no {LIDAR}, whose axes are those of the frame `lidar`; its "
            f"channels are {sorted(channels)!r:.300}. Name the LiDAR so if its axes are (x right, "
            "y ahead); else convert with --frame ego, which takes one LiDAR of any name."
        )

    def _wanted_sample_data(self) -> Iterator[dict[str, Any]]:
        wanted = {self.lidar, *self.cameras}
        for record in read_table(self._folder, "sample_data"):
            self._check_link("sample_data", record, "calibrated_sensor_token")
            channel = self._channel_of(record)
            is_sweep = channel == self.lidar and self._max_sweeps > 0
            if is_sweep or (record["is_key_frame"] and channel in wanted):
                yield {name: record[name] for name in ("token", *_FIELDS["sample_data"])}

    def chain(
        self, table: str, token: str, step: str, first: dict[str, Any]
    ) -> Iterator[dict[str, Any]]:
        """Yield a table's records from ``token`` on, to which ``first`` leads; ``step`` leads on.

        Raises:
            ValueError: If a link leads nowhere or back; an empty one ends the chain.
        """
        known, seen, record = self._records[table], set(), first
        while token:
            if token not in known:
                origin = record["token"]
                raise _damaged(
                    self._folder, table, f" has no record {token!r}, to which {origin!r} leads"
                )
            if token in seen:
                wrong = f", record {record['token']!r}: {step} leads back to {token!r}"
                raise _damaged(self._folder, table, wrong)
            seen.add(token)
            record = known[token]
            yield record
            token = record[step]

    def samples_of(self, scene: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield a scene's samples in order of time."""
        return self.chain("sample", scene["first_sample_token"], "next", scene)

    def location_of(self, scene: dict[str, Any]) -> str:
        """Return the name of the map that a scene was driven on."""
        return self._records["log"][scene["log_token"]]["location"]

    def _global_from(self, data: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        """Return global-from-sensor (4, 4) and the calibration of a sensor record."""
        calibration = self._records["calibrated_sensor"][data["calibrated_sensor_token"]]
        global_from_ego = pose_of(self._records["ego_pose"][data["ego_pose_token"]])
        return global_from_ego @ pose_of(calibration), calibration

    def read(self, sample: dict[str, Any], scene: dict[str, Any]) -> MapSample:
        """Return a sample in the annotation frame, without instances and absent cameras."""
        lidar = sample["data"][self.lidar]
        global_from_lidar, calibration = self._global_from(lidar)
        ego_from_lidar, timestamp_ns = pose_of(calibration), sample["timestamp"] * 1000
        global_from_ego = global_from_lidar @ invert_rigid(ego_from_lidar)
        global_from_frame, ego_from_frame, frame_from_lidar = (
            (global_from_lidar, ego_from_lidar, np.eye(4))
            if self.frame == "lidar"
            else (global_from_ego, np.eye(4), ego_from_lidar)
        )
        sweeps = self._sweeps(lidar, global_from_frame)
        names = [name for name in self.cameras if name in sample["data"]]
        return MapSample(
            token=sample["token"],
            scene=scene["name"],
            map_name=self.location_of(scene),
            timestamp_ns=timestamp_ns,
            cameras=[self._camera(n, sample["data"][n], global_from_frame) for n in names],
            global_from_frame=global_from_frame,
            lidar=LidarRecord(lidar["filename"], frame_from_lidar, sweeps),
            ego_from_frame=ego_from_frame,
            can_bus=signals_at(timestamp_ns, global_from_ego, self._messages(scene["name"])),
        )

    def _camera(
        self, name: str, data: dict[str, Any], global_from_frame: np.ndarray
    ) -> CameraRecord:
        global_from_cam, calibration = self._global_from(data)
        return CameraRecord(
            name,
            data["filename"],
            data["width"],
            data["height"],
            np.array(calibration["camera_intrinsic"]),
            invert_rigid(global_from_cam) @ global_from_frame,
        )

    def _sweeps(self, lidar: dict[str, Any], global_from_frame: np.ndarray) -> list[SweepRecord]:
        frame_from_global = invert_rigid(global_from_frame)
        earlier = self.chain("sample_data", lidar["prev"], "prev", lidar)
        return [
            SweepRecord(
                data["filename"],
                data["timestamp"] * 1000,
                frame_from_global @ self._global_from(data)[0],
            )
            for data in islice(earlier, self._max_sweeps)
        ]


def versions_in(root: Path) -> list[str]:
    """Return the version folders of a nuScenes-format root; none if it is no such root."""
    folders = (path.parent for path in root.glob("*/scene.json"))
    return sorted(folder.name for folder in folders if not is_hidden(folder))


def read_nuscenes(
    root: Path, version: str | None = None
) -> tuple[list[MapSample], tuple[str, ...]]:
    """Read all samples that have a LIDAR_TOP key frame, whose frame they are in.

    Args:
        root: Data root.
        version: Version folder, such as ``v1.0-mini``; the only one by default.

    Returns:
        The samples, and how many are left out.

    Raises:
        ValueError: If there is no such version or several, no sample, or a table is damaged.
    """
    found = versions_in(root)
    if version is None and len(found) > 1:
        raise InputError(f"{root} holds several versions, {found}: name one with --version.")
    if version is not None and version not in found:
        raise InputError(f"{root} holds no version {version!r}, but {found}.")
    tables = NuScenesTables(version or found[0], root, max_sweeps=10)
    pairs = [(record, scene) for scene in tables.scene for record in tables.samples_of(scene)]
    used = [(record, scene) for record, scene in pairs if tables.lidar in record["data"]]
    note = f"{len(used)} of {counted(len(pairs), 'sample')} used: the others have no key frame of "
    if not used:
        raise InputError(f"{root}: {note}{tables.lidar}; download the tables again.")
    samples = [tables.read(record, scene) for record, scene in used]
    return samples, (note + tables.lidar,) if len(used) < len(pairs) else ()
