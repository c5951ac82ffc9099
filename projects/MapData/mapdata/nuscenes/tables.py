"""Reader of nuScenes tables, which makes samples from the records of cameras and LiDAR."""

import math
from collections import Counter
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
from gsmap.utils.words import format_count
from mapdata.nuscenes.can_bus import (
    NO_MESSAGES,
    Messages,
    is_rejected,
    read_messages,
    signals_at,
)

CAMERAS = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip
LIDAR = "LIDAR_TOP"
# Fields that are read from each table, with their kinds (`_has_kind`). The kind of a list of
# numbers is its length; the kind of any other field is its type.
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
# Fields that contain the token of a record of another table, with the name of the other table.
_LINKS = {
    "calibrated_sensor": {"sensor_token": "sensor"},
    "scene": {"log_token": "log", "first_sample_token": "sample"},
    "sample_data": {
        "sample_token": "sample", "ego_pose_token": "ego_pose",
        "calibrated_sensor_token": "calibrated_sensor",
    },
}  # fmt: skip


def _has_kind(value: Any, kind: type | int) -> bool:
    """Whether a value has the type of a field, or is a list of ``kind`` finite numbers.

    The kind ``list`` is a matrix of camera intrinsics (3, 3), or an empty list for other sensors.
    Types are compared exactly, because a bool is also an ``int`` in Python.
    An integer must fit into 64 bits after a conversion from microseconds to nanoseconds. Four
    numbers must be a unit quaternion.
    """
    if kind is list:
        if type(value) is not list:
            return False
        if not value:
            return True
        return len(value) == 3 and all(_has_kind(row, 3) for row in value)
    if kind is int:
        return type(value) is int and abs(value) <= 1 << 53
    if isinstance(kind, type):
        return type(value) is kind
    if type(value) is not list or len(value) != kind:
        return False
    for number in value:
        if type(number) not in (int, float) or not math.isfinite(number):
            return False
    return kind != 4 or abs(math.hypot(*value) - 1) < 1e-3


def pose_of(record: Mapping[str, Any], prefix: str = "") -> np.ndarray:
    """Build the transform of a record from its translation and rotation.

    Args:
        record: Record with ``translation`` in metres (3,) and ``rotation``, a quaternion
            (w, x, y, z) or, in info files, a matrix (3, 3).
        prefix: Prefix of the two names, such as ``lidar2ego_``.

    Returns:
        Transform in metres. (4, 4)

    Raises:
        ValueError: If the translation does not have three numbers.
    """
    rotation = np.asarray(record[f"{prefix}rotation"], np.float64)
    if rotation.shape != (3, 3):
        rotation = Quaternion(rotation).rotation_matrix
    translation = np.asarray(record[f"{prefix}translation"], np.float64)
    if translation.size != 3:
        raise InputError(f"{prefix}translation must be 3 numbers, got {translation.tolist()!r:.60}")
    return rigid(rotation, translation.reshape(3))


def _table_error(folder: Path, table: str, problem: str) -> ValueError:
    """Error for a damaged table; ``problem`` continues the name of its file."""
    return InputError(f"{folder}/{table}.json{problem}; download the tables again.")


def read_table(folder: Path, table: str) -> Iterator[dict[str, Any]]:
    """Yield the records of a table after a check of their fields.

    Args:
        folder: Folder of the tables.
        table: Name of the table, such as ``ego_pose``.

    Raises:
        FileNotFoundError: If the table is missing.
        ValueError: If the table is damaged. Records before the damage may be yielded first.
    """
    path = folder / f"{table}.json"
    if not path.is_file():
        raise FileNotFoundError(f"no table at {path}: download the tables again.")
    fields: dict[str, type | int] = {"token": str, **_FIELDS[table]}
    # The file is a list of records (key None), which is read without loading the whole file.
    for record, _ in items_of(path, None, "download it again"):
        # A record that is no object has no fields, so the first field is reported.
        values = record if isinstance(record, dict) else {}
        for name, kind in fields.items():
            value = values.get(name)
            if not _has_kind(value, kind):
                numbers = f"{kind} finite numbers"
                expected = f"a {kind.__name__}" if isinstance(kind, type) else numbers
                problem = (
                    f", record {values.get('token')!r}: {name} must be {expected}, got {value!r}"
                )
                raise _table_error(folder, table, problem=problem)
        yield record


class NuScenesTables:
    """Tables of one version: key frames of cameras and LiDAR and, on request, LiDAR sweeps.

    Annotation tables and the records of other sensors are not kept. This leaves a tenth of the 2.6
    million ``sample_data`` records of ``v1.0-trainval`` (a fifth with sweeps), and the poses that
    they refer to. The field ``data`` of a sample contains the records of its key frames by channel.

    Args:
        version: Name of the folder of the tables, such as ``v1.0-trainval``.
        dataroot: Data root.
        max_sweeps: Largest number of earlier LiDAR sweeps per sample; 0 keeps key frames only.
        frame: Annotation frame, ``lidar`` or ``ego``.

    Attributes:
        cameras: Channels of the cameras, the six of nuScenes first.
        folder: Folder of the tables.
        lidar: Channel of the LiDAR.
        scene: Records of all scenes.

    Raises:
        FileNotFoundError: If a table is missing.
        ValueError: If a table is damaged, or a record refers to a missing record.
    """

    def __init__(self, version: str, dataroot: Path, max_sweeps: int, frame: str = "lidar") -> None:
        self.frame = frame
        self.folder = dataroot / version
        self._dataroot = dataroot
        self._max_sweeps = max_sweeps
        # Messages of the CAN bus by scene; only the latest scene is kept.
        self._messages = lru_cache(maxsize=1)(partial(read_messages, dataroot))
        # Records of each table by token. A table is stored after the tables that it refers to.
        self._records: dict[str, dict[str, dict[str, Any]]] = {}
        for table in ("sensor", "calibrated_sensor", "log", "sample", "scene"):
            self._store(table, read_table(self.folder, table))
        self.cameras, self.lidar = self._sensor_channels()
        # A list, because the records are also needed to select poses and to fill `data`.
        sample_data = list(self._read_sample_data())
        pose_tokens = {record["ego_pose_token"] for record in sample_data}
        poses = read_table(self.folder, "ego_pose")
        self._store("ego_pose", (pose for pose in poses if pose["token"] in pose_tokens))
        self._store("sample_data", sample_data)
        # Number of samples by token of the scene.
        self._num_samples: Counter[str] = Counter()
        for sample in self._records["sample"].values():
            sample["data"] = {}
            # Tables that other programs write may lack the token. Their scenes have 0 samples here,
            # and `samples_of` cannot check them.
            self._num_samples[sample.get("scene_token", "")] += 1
        for record in sample_data:
            if record["is_key_frame"]:
                sample = self._records["sample"][record["sample_token"]]
                channel = self._channel_of(record)
                if channel in sample["data"]:
                    problem = f" has two key frames of {channel} for sample {sample['token']!r}"
                    raise _table_error(self.folder, "sample_data", problem=problem)
                sample["data"][channel] = record
        self.scene = list(self._records["scene"].values())

    def _store(self, table: str, records: Iterable[dict[str, Any]]) -> None:
        """Store the records of a table by token. Tables that they refer to must be stored first."""
        records_by_token: dict[str, dict[str, Any]] = {}
        self._records[table] = records_by_token
        for record in records:
            token = record["token"]
            for link in _LINKS.get(table, ()):
                self._check_link(table, record, name=link)
            if token in records_by_token:
                raise _table_error(self.folder, table, problem=f" has record {token!r} twice")
            records_by_token[token] = record

    def _check_link(self, table: str, record: dict[str, Any], name: str) -> None:
        """Raise a ``ValueError`` if the field ``name`` of a record refers to a missing record."""
        if record[name] not in self._records[_LINKS[table][name]]:
            problem = f", record {record['token']!r}: {name} {record[name]!r} leads nowhere"
            raise _table_error(self.folder, table, problem=problem)

    def _channel_of(self, record: dict[str, Any]) -> str:
        """Channel of the sensor of a ``sample_data`` record."""
        calibration = self._records["calibrated_sensor"][record["calibrated_sensor_token"]]
        return self._records["sensor"][calibration["sensor_token"]]["channel"]

    def _sensor_channels(self) -> tuple[tuple[str, ...], str]:
        """Find the channels of the cameras and the LiDAR.

        The LiDAR is LIDAR_TOP. With the frame ``ego``, it may have another name if it is the only
        LiDAR.

        Returns:
            Channels of the cameras, the six of nuScenes first, and the channel of the LiDAR.

        Raises:
            ValueError: If there is no such LiDAR.
        """
        sensors = self._records["sensor"]
        camera_channels = set()
        for calibration in self._records["calibrated_sensor"].values():
            if calibration["camera_intrinsic"]:
                sensor = sensors[calibration["sensor_token"]]
                camera_channels.add(sensor["channel"])
        nuscenes_cameras = [name for name in CAMERAS if name in camera_channels]
        other_cameras = sorted(camera_channels - set(CAMERAS))
        cameras = (*nuscenes_cameras, *other_cameras)
        channels = {sensor["channel"] for sensor in sensors.values()}
        lidars = sorted(channel for channel in channels if "LIDAR" in channel.upper())
        if LIDAR in channels:
            return cameras, LIDAR
        if len(lidars) == 1 and self.frame == "ego":
            return cameras, lidars[0]
        raise InputError(
            f"{self.folder} has no {LIDAR}, which defines the frame `lidar`, but the channels "
            f"{sorted(channels)!r:.300}. Name the LiDAR {LIDAR} if its axes are (x right, y "
            "ahead); else convert with --frame ego, which takes one LiDAR of any name."
        )

    def _read_sample_data(self) -> Iterator[dict[str, Any]]:
        """Yield the key frames of cameras and LiDAR and, on request, LiDAR sweeps.

        Records are reduced to the fields that `read_table` checks.
        """
        key_frame_channels = {self.lidar, *self.cameras}
        names = ("token", *_FIELDS["sample_data"])
        for record in read_table(self.folder, "sample_data"):
            # `_store` checks all links later, but the channel is needed first.
            self._check_link("sample_data", record, name="calibrated_sensor_token")
            channel = self._channel_of(record)
            # Sweeps include the key frames of the LiDAR.
            is_sweep = channel == self.lidar and self._max_sweeps > 0
            is_key_frame = record["is_key_frame"] and channel in key_frame_channels
            if is_sweep or is_key_frame:
                yield {name: record[name] for name in names}

    def chain(
        self, table: str, token: str, step: str, origin: dict[str, Any]
    ) -> Iterator[dict[str, Any]]:
        """Yield the records of a linked list.

        Args:
            table: Name of the table.
            token: Token of the first record; empty for an empty list.
            step: Field with the token of the following record, ``next`` or ``prev``; an empty
                token ends the list.
            origin: Record with a link to the first record, for messages.

        Raises:
            ValueError: If a record is missing, or the links form a circle.
        """
        records = self._records[table]
        visited_tokens = set()
        record = origin
        while token:
            if token not in records:
                problem = f" has no record {token!r}, to which {record['token']!r} leads"
                raise _table_error(self.folder, table, problem=problem)
            if token in visited_tokens:
                problem = f", record {record['token']!r}: {step} leads back to {token!r}"
                raise _table_error(self.folder, table, problem=problem)
            visited_tokens.add(token)
            record = records[token]
            yield record
            token = record[step]

    def samples_of(self, scene: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield the sample records of a scene in order of time.

        Raises:
            ValueError: If a link is broken, or the links lead to another scene or do not lead to
                all samples of the scene.
        """
        number = 0
        for sample in self.chain("sample", scene["first_sample_token"], step="next", origin=scene):
            if sample.get("scene_token", scene["token"]) != scene["token"]:
                problem = (
                    f", record {scene['token']!r}: links lead to sample {sample['token']!r} of "
                    "another scene"
                )
                raise _table_error(self.folder, "scene", problem=problem)
            number += 1
            yield sample
        expected = self._num_samples[scene["token"]] or number
        if number != expected:
            problem = (
                f", record {scene['token']!r}: links lead to {number} of its "
                f"{format_count(expected, 'sample')}"
            )
            raise _table_error(self.folder, "scene", problem=problem)

    def location_of(self, scene: dict[str, Any]) -> str:
        """Name of the map of a scene. The poses of the scene are in the frame of this map."""
        return self._records["log"][scene["log_token"]]["location"]

    def expansion_of(self, scene: dict[str, Any]) -> str:
        """Name of the map file of a scene.

        It is the location, unless the log has another name in the field ``map_expansion``: an
        earlier state of the map in the frame of the location.

        Raises:
            ValueError: If the name is no text.
        """
        log = self._records["log"][scene["log_token"]]
        name = log.get("map_expansion", log["location"])
        if not isinstance(name, str):
            problem = f", record {log['token']!r}: map_expansion must be a str, got {name!r:.60}"
            raise _table_error(self.folder, "log", problem=problem)
        return name

    def has_rejected_signals(self, scene: dict[str, Any]) -> bool:
        """Test whether the nuScenes devkit rejects the CAN bus messages of a scene.

        Acceleration, rotation rate and velocity of its samples are 0.
        """
        logfile = self._records["log"][scene["log_token"]].get("logfile")
        return is_rejected(self._dataroot, scene["name"], logfile=logfile)

    def _scene_messages(self, scene: dict[str, Any]) -> Messages:
        """CAN bus messages of a scene; none if the nuScenes devkit rejects them."""
        if self.has_rejected_signals(scene):
            return NO_MESSAGES
        return self._messages(scene["name"])

    def _global_from_sensor(self, data: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        """Transform from the sensor of a record to the map (4, 4), and the calibration record."""
        calibration = self._records["calibrated_sensor"][data["calibrated_sensor_token"]]
        global_from_ego = pose_of(self._records["ego_pose"][data["ego_pose_token"]])
        return global_from_ego @ pose_of(calibration), calibration

    def read(self, sample: dict[str, Any], scene: dict[str, Any]) -> MapSample:
        """Make a sample in the annotation frame, without ground truth.

        Args:
            sample: Sample record with a key frame of the LiDAR. Cameras may be absent.
            scene: Record of its scene.
        """
        lidar = sample["data"][self.lidar]
        global_from_lidar, calibration = self._global_from_sensor(lidar)
        ego_from_lidar = pose_of(calibration)
        global_from_ego = global_from_lidar @ invert_rigid(ego_from_lidar)
        if self.frame == "lidar":
            global_from_frame = global_from_lidar
            ego_from_frame = ego_from_lidar
            frame_from_lidar = np.eye(4)
        else:
            global_from_frame = global_from_ego
            ego_from_frame = np.eye(4)
            frame_from_lidar = ego_from_lidar
        sweeps = self._sweeps(lidar, global_from_frame)
        cameras = []
        for name in self.cameras:
            if name in sample["data"]:
                camera = self._camera(name, sample["data"][name], global_from_frame)
                cameras.append(camera)
        timestamp_ns = sample["timestamp"] * 1000
        messages = self._scene_messages(scene)
        return MapSample(
            token=sample["token"],
            scene=scene["name"],
            map_name=self.location_of(scene),
            timestamp_ns=timestamp_ns,
            cameras=cameras,
            global_from_frame=global_from_frame,
            lidar=LidarRecord(lidar["filename"], frame_from_lidar, sweeps=sweeps),
            ego_from_frame=ego_from_frame,
            can_bus=signals_at(timestamp_ns, global_from_ego, messages=messages),
        )

    def _camera(
        self, name: str, data: dict[str, Any], global_from_frame: np.ndarray
    ) -> CameraRecord:
        """Make the camera of a ``sample_data`` record.

        The vehicle moves between the times of LiDAR and camera, so the transform goes through the
        global frame.
        """
        global_from_cam, calibration = self._global_from_sensor(data)
        return CameraRecord(
            name=name,
            path=data["filename"],
            width=data["width"],
            height=data["height"],
            intrinsics=np.array(calibration["camera_intrinsic"]),
            cam_from_frame=invert_rigid(global_from_cam) @ global_from_frame,
        )

    def _sweeps(self, lidar: dict[str, Any], global_from_frame: np.ndarray) -> list[SweepRecord]:
        """Make the sweeps before a key frame of the LiDAR, the latest first."""
        frame_from_global = invert_rigid(global_from_frame)
        earlier = self.chain("sample_data", lidar["prev"], step="prev", origin=lidar)
        sweeps = []
        for data in islice(earlier, self._max_sweeps):
            global_from_lidar, _ = self._global_from_sensor(data)
            sweep = SweepRecord(
                path=data["filename"],
                timestamp_ns=data["timestamp"] * 1000,
                frame_from_lidar=frame_from_global @ global_from_lidar,
            )
            sweeps.append(sweep)
        return sweeps


def check_scene_names(scenes: Iterable[tuple[dict[str, Any], NuScenesTables]]) -> None:
    """Raise a ``ValueError`` if two scenes have one name, since they would become one drive.

    Args:
        scenes: Records of the scenes, each with the tables of its version.
    """
    first_with_name: dict[str, tuple[str, Path]] = {}  # token and folder of the first scene
    for scene, tables in scenes:
        name = scene["name"]
        token, folder = first_with_name.setdefault(name, (scene["token"], tables.folder))
        if token != scene["token"]:
            remedy = "rename one of them in scene.json, its file in can_bus and its split list"
            if folder != tables.folder:
                remedy += ", or convert each version with a --dataset of its own"
            raise InputError(
                f"two scenes have the name {name!r}: {token!r} in {folder / 'scene.json'} and "
                f"{scene['token']!r} in {tables.folder / 'scene.json'}; {remedy}."
            )


def versions_in(root: Path) -> list[str]:
    """Sorted names of the version folders in a data root; empty without nuScenes tables."""
    names = []
    for path in root.glob("*/scene.json"):
        if not is_hidden(path.parent):
            names.append(path.parent.name)
    return sorted(names)


def read_nuscenes(
    root: Path, version: str | None = None
) -> tuple[list[MapSample], tuple[str, ...]]:
    """Read all samples with a LIDAR_TOP key frame, in the frame of this LiDAR.

    Args:
        root: Data root with at least one version folder (`versions_in`).
        version: Version folder, such as ``v1.0-mini``; may be omitted if there is only one.

    Returns:
        The samples, and a note with the number of samples without a key frame, if there are any.

    Raises:
        ValueError: If the version is missing or ambiguous, there is no sample, two scenes have one
            name, or a table is damaged.
    """
    versions = versions_in(root)
    if version is None and len(versions) > 1:
        raise InputError(f"{root} holds several versions, {versions}: name one with --version.")
    if version is not None and version not in versions:
        raise InputError(f"{root} holds no version {version!r}, but {versions}.")
    tables = NuScenesTables(version or versions[0], root, max_sweeps=10)
    check_scene_names((scene, tables) for scene in tables.scene)
    samples = []
    total = 0
    for scene in tables.scene:
        for record in tables.samples_of(scene):
            total += 1
            if tables.lidar in record["data"]:  # the key frames of the sample, by channel
                samples.append(tables.read(record, scene))
    note = (
        f"{len(samples)} of {format_count(total, 'sample')} used: the others have no key frame of "
        f"{tables.lidar}"
    )
    if not samples:
        raise InputError(f"{root}: {note}; download the tables again.")
    notes = (note,) if len(samples) < total else ()
    return samples, notes
