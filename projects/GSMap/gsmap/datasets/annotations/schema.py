"""The columns of an annotation file, and rows to and from them."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa

from gsmap.datasets.annotations.record import (
    CAN_BUS_SIZE,
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
)

META_KEY = b"gsmap"


def _matrix(size: int) -> pa.DataType:
    return pa.list_(pa.float64(), size)


_CAMERA = pa.struct(
    {
        "name": pa.string(),
        "path": pa.string(),
        "width": pa.int32(),
        "height": pa.int32(),
        "intrinsics": _matrix(9),
        "cam_from_frame": _matrix(16),
    }
)
_SWEEP = pa.struct(
    {"path": pa.string(), "timestamp_ns": pa.int64(), "frame_from_lidar": _matrix(16)}
)
_INSTANCE = pa.struct({"label": pa.int32(), "points": pa.list_(pa.float32())})
FIELDS = {
    "token": pa.string(),
    "scene": pa.string(),
    "map_name": pa.string(),
    "timestamp_ns": pa.int64(),
    "global_from_frame": _matrix(16),
    "ego_from_frame": _matrix(16),
    "cameras": pa.list_(_CAMERA),
    "lidar": pa.struct(
        {"path": pa.string(), "frame_from_lidar": _matrix(16), "sweeps": pa.list_(_SWEEP)}
    ),
    "can_bus": _matrix(CAN_BUS_SIZE),
    "instances": pa.list_(_INSTANCE),
}


def _flat(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return numbers of a given shape in one dimension."""
    array = np.asarray(values)
    if array.shape != shape or array.dtype.kind not in "iuf":
        raise ValueError(
            f"{what} must be numbers of shape {shape}, got {array.dtype} {array.shape}."
        )
    return array.astype(np.float64).reshape(-1)


def _points(values: Any, dim: int, what: str) -> np.ndarray:
    """Return the points of an element in one dimension."""
    array = np.asarray(values)
    if array.ndim != 2 or len(array) < 2 or array.shape[1] != dim or array.dtype.kind not in "iuf":
        raise ValueError(
            f"{what} must be numbers (n >= 2, {dim}), got {array.dtype} {array.shape}."
        )
    return array.astype(np.float32).reshape(-1)


def _sensors(sample: MapSample, where: str) -> dict[str, Any]:
    """Return the columns of cameras and LiDAR."""
    cameras = [
        {
            "name": camera.name,
            "path": camera.path,
            "width": int(camera.width),
            "height": int(camera.height),
            "intrinsics": _flat(camera.intrinsics, (3, 3), f"{where}{camera.name}: intrinsics"),
            "cam_from_frame": _flat(
                camera.cam_from_frame, (4, 4), f"{where}{camera.name}: cam_from_frame"
            ),
        }
        for camera in sample.cameras
    ]
    if sample.lidar is None:
        return {"cameras": cameras, "lidar": None}
    what = f"{where}frame_from_lidar"
    sweeps = [
        {
            "path": sweep.path,
            "timestamp_ns": int(sweep.timestamp_ns),
            "frame_from_lidar": _flat(sweep.frame_from_lidar, (4, 4), what),
        }
        for sweep in sample.lidar.sweeps
    ]
    frame_from_lidar = _flat(sample.lidar.frame_from_lidar, (4, 4), what)
    lidar = {"path": sample.lidar.path, "frame_from_lidar": frame_from_lidar, "sweeps": sweeps}
    return {"cameras": cameras, "lidar": lidar}


def row_of(sample: MapSample, meta: AnnotationMeta) -> dict[str, Any]:
    """Return a sample as the nested values of one Arrow row, by column.

    Args:
        sample: The sample.
        meta: Metadata of the file: its frame, and coordinates per point.

    Raises:
        ValueError: If a matrix or an element has another shape, or holds no numbers.
    """
    where = f"sample {sample.token!r}: "
    instances = None
    if sample.instances is not None:
        instances = [
            {"label": int(item.label), "points": _points(item.points, meta.dim, f"{where}points")}
            for item in sample.instances
        ]
    can_bus, mounting = sample.can_bus, sample.ego_from_frame
    if mounting is None and meta.frame == "ego":
        mounting = np.eye(4)  # the frame is the vehicle
    if mounting is not None:
        mounting = _flat(mounting, (4, 4), f"{where}ego_from_frame")
    return {
        "token": sample.token,
        "scene": sample.scene,
        "map_name": sample.map_name,
        "timestamp_ns": int(sample.timestamp_ns),
        "global_from_frame": _flat(sample.global_from_frame, (4, 4), f"{where}global_from_frame"),
        "ego_from_frame": mounting,
        **_sensors(sample, where),
        "can_bus": None if can_bus is None else _flat(can_bus, (CAN_BUS_SIZE,), f"{where}can_bus"),
        "instances": instances,
    }


def batch_of(rows: Sequence[dict[str, Any]], schema: pa.Schema) -> pa.RecordBatch:
    """Return rows as one record batch.

    Raises:
        ValueError: If a value has another type than its column.
    """
    try:
        columns = [pa.array([row[name] for row in rows], kind) for name, kind in FIELDS.items()]
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
        tokens = [row["token"] for row in rows]
        raise ValueError(f"one of the samples {tokens[0]!r} to {tokens[-1]!r}: {error}.") from error
    return pa.record_batch(columns, schema=schema)


def schema_of(meta: AnnotationMeta) -> pa.Schema:
    """Return the file's schema with its metadata."""
    return pa.schema(FIELDS, metadata={META_KEY: json.dumps(asdict(meta)).encode()})


def _matrices(array: pa.FixedSizeListArray, *shape: int) -> np.ndarray:
    """Return a fixed-size list column as a view; null rows hold any number. (rows, *shape)."""
    values = array.values
    if values.null_count:
        known = values.is_valid().to_numpy(zero_copy_only=False).reshape(len(array), -1)
        _require_known(bool(known[_valid(array)].all()), "a matrix")
    stored = values.buffers()[1]
    if stored is None or not len(values):
        return np.empty((0, *shape))
    return np.frombuffer(stored, np.float64, count=len(values)).reshape(-1, *shape)


def _valid(array: pa.Array) -> np.ndarray:
    """Say which rows hold something. (rows,) bool."""
    return array.is_valid().to_numpy(zero_copy_only=False)


def _require_known(known: bool, what: str) -> None:
    """Raise a ``ValueError`` if something is missing that every sample has."""
    if not known:
        raise ValueError(f"{what} is missing in a sample.")


class Batch:
    """Numpy views on one valid record batch, from which rows of ``dim`` coordinates are decoded.

    Raises:
        ValueError: If something is missing that every sample has.
    """

    def __init__(self, batch: pa.RecordBatch, dim: int):
        column = {name: batch.column(name) for name in FIELDS}
        cameras, lidar, instances = (column[name] for name in ("cameras", "lidar", "instances"))
        self.dim = dim
        self.column = column
        self.has_lidar, self.has_can_bus = _valid(lidar), _valid(column["can_bus"])
        self.has_instances = _valid(instances)
        self.has_mounting = _valid(column["ego_from_frame"])
        self.global_from_frame = _matrices(column["global_from_frame"], 4, 4)
        self.ego_from_frame = _matrices(column["ego_from_frame"], 4, 4)
        self.can_bus = _matrices(column["can_bus"], CAN_BUS_SIZE)
        self.camera_offsets = cameras.offsets.to_numpy()
        self.camera = {field.name: cameras.values.field(field.name) for field in _CAMERA}
        self.intrinsics = _matrices(self.camera["intrinsics"], 3, 3)
        self.cam_from_frame = _matrices(self.camera["cam_from_frame"], 4, 4)
        self.lidar_path = lidar.field("path")
        self.frame_from_lidar = _matrices(lidar.field("frame_from_lidar"), 4, 4)
        self.sweep_offsets = lidar.field("sweeps").offsets.to_numpy()
        self.sweep = {
            field.name: lidar.field("sweeps").values.field(field.name) for field in _SWEEP
        }
        self.sweep_from = _matrices(self.sweep["frame_from_lidar"], 4, 4)
        self._require_whole()
        self.instance_offsets = instances.offsets.to_numpy()
        self.labels = instances.values.field("label").to_numpy()
        self.point_offsets = instances.values.field("points").offsets.to_numpy()
        self.points = instances.values.field("points").values.to_numpy()

    def _require_whole(self) -> None:
        """Raise a ``ValueError`` where there is nothing, unless that has a meaning."""
        lists = {name: self.column[name] for name in ("cameras", "instances")}
        parts = {f"{name}.item": array.values for name, array in lists.items()}
        parts |= {f"camera {name}": array for name, array in self.camera.items()}
        parts |= {f"sweep {name}": array for name, array in self.sweep.items()}
        elements = self.column["instances"].values
        parts |= {"label": elements.field("label"), "points": elements.field("points")}
        parts["coordinate"] = parts["points"].values
        parts["sweep"] = self.column["lidar"].field("sweeps").values
        optional = ("lidar", "can_bus", "instances", "ego_from_frame")
        parts |= {name: array for name, array in self.column.items() if name not in optional}
        for what, array in parts.items():
            _require_known(not array.null_count, what)
        for name in ("path", "frame_from_lidar", "sweeps"):
            known = _valid(self.column["lidar"].field(name))[self.has_lidar]
            _require_known(bool(known.all()), f"lidar {name}")

    def __len__(self) -> int:
        return len(self.column["token"])

    def _cameras(self, row: int) -> list[CameraRecord]:
        return [
            CameraRecord(
                **{
                    name: self.camera[name][i].as_py()
                    for name in ("name", "path", "width", "height")
                },
                intrinsics=self.intrinsics[i].copy(),
                cam_from_frame=self.cam_from_frame[i].copy(),
            )
            for i in range(self.camera_offsets[row], self.camera_offsets[row + 1])
        ]

    def _lidar(self, row: int) -> LidarRecord | None:
        if not self.has_lidar[row]:
            return None
        sweeps = [
            SweepRecord(
                self.sweep["path"][i].as_py(),
                self.sweep["timestamp_ns"][i].as_py(),
                self.sweep_from[i].copy(),
            )
            for i in range(self.sweep_offsets[row], self.sweep_offsets[row + 1])
        ]
        return LidarRecord(self.lidar_path[row].as_py(), self.frame_from_lidar[row].copy(), sweeps)

    def _instances(self, row: int) -> list[MapInstance] | None:
        if not self.has_instances[row]:
            return None
        start, stop = self.instance_offsets[row], self.instance_offsets[row + 1]
        ends = self.point_offsets[start : stop + 1]
        return [
            MapInstance(int(label), self.points[a:b].reshape(-1, self.dim).copy())
            for label, a, b in zip(self.labels[start:stop], ends[:-1], ends[1:], strict=True)
        ]

    def sample(self, row: int) -> MapSample:
        """Decode one row."""
        scalars = {
            name: self.column[name][row].as_py()
            for name in ("token", "scene", "map_name", "timestamp_ns")
        }
        return MapSample(
            **scalars,
            cameras=self._cameras(row),
            global_from_frame=self.global_from_frame[row].copy(),
            ego_from_frame=self.ego_from_frame[row].copy() if self.has_mounting[row] else None,
            lidar=self._lidar(row),
            can_bus=self.can_bus[row].copy() if self.has_can_bus[row] else None,
            instances=self._instances(row),
        )
