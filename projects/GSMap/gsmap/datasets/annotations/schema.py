"""The columns of an annotation file, and rows to and from them."""

import json
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


def _flat(matrix: np.ndarray) -> np.ndarray:
    return np.asarray(matrix, np.float64).reshape(-1)


def row_of(sample: MapSample) -> dict[str, Any]:
    """Return a sample as the nested values of one Arrow row, by column."""
    lidar = None
    if sample.lidar is not None:
        sweeps = [
            {
                "path": s.path,
                "timestamp_ns": int(s.timestamp_ns),
                "frame_from_lidar": _flat(s.frame_from_lidar),
            }
            for s in sample.lidar.sweeps
        ]
        lidar = {
            "path": sample.lidar.path,
            "frame_from_lidar": _flat(sample.lidar.frame_from_lidar),
            "sweeps": sweeps,
        }
    cameras = [
        {
            "name": camera.name,
            "path": camera.path,
            "width": int(camera.width),
            "height": int(camera.height),
            "intrinsics": _flat(camera.intrinsics),
            "cam_from_frame": _flat(camera.cam_from_frame),
        }
        for camera in sample.cameras
    ]
    instances = None
    if sample.instances is not None:
        instances = [
            {"label": int(i.label), "points": np.asarray(i.points, np.float32).reshape(-1)}
            for i in sample.instances
        ]
    return {
        "token": sample.token,
        "scene": sample.scene,
        "map_name": sample.map_name,
        "timestamp_ns": int(sample.timestamp_ns),
        "global_from_frame": _flat(sample.global_from_frame),
        "ego_from_frame": _flat(sample.ego_from_frame),
        "cameras": cameras,
        "lidar": lidar,
        "can_bus": None if sample.can_bus is None else _flat(sample.can_bus),
        "instances": instances,
    }


def schema_of(meta: AnnotationMeta) -> pa.Schema:
    """Return the file's schema with its metadata."""
    return pa.schema(FIELDS, metadata={META_KEY: json.dumps(asdict(meta)).encode()})


def _matrices(array: pa.FixedSizeListArray, *shape: int) -> np.ndarray:
    """Return a fixed-size list column as a view; null rows hold any number. (rows, *shape)."""
    values = array.values
    stored = values.buffers()[1]
    if stored is None:
        return np.empty((0, *shape))
    view = np.frombuffer(stored, np.float64, count=len(values), offset=8 * values.offset)
    return view.reshape(-1, *shape)


class Batch:
    """Numpy views on one record batch, from which rows are decoded.

    Args:
        batch: The record batch.
        dim: Coordinates per point.
    """

    def __init__(self, batch: pa.RecordBatch, dim: int):
        column = {name: batch.column(name) for name in FIELDS}
        self.dim = dim
        self.column = column
        self.global_from_frame = _matrices(column["global_from_frame"], 4, 4)
        self.ego_from_frame = _matrices(column["ego_from_frame"], 4, 4)
        self.can_bus = _matrices(column["can_bus"], CAN_BUS_SIZE)
        self.camera_offsets = column["cameras"].offsets.to_numpy()
        cameras = column["cameras"].values
        self.camera = {name: cameras.field(name) for name in ("name", "path", "width", "height")}
        self.intrinsics = _matrices(cameras.field("intrinsics"), 3, 3)
        self.cam_from_frame = _matrices(cameras.field("cam_from_frame"), 4, 4)
        self.lidar_path = column["lidar"].field("path")
        self.frame_from_lidar = _matrices(column["lidar"].field("frame_from_lidar"), 4, 4)
        self.sweep_offsets = column["lidar"].field("sweeps").offsets.to_numpy()
        self.sweep = column["lidar"].field("sweeps").values
        self.sweep_from = _matrices(self.sweep.field("frame_from_lidar"), 4, 4)
        self.instance_offsets = column["instances"].offsets.to_numpy()
        instances = column["instances"].values
        self.labels = instances.field("label").to_numpy()
        self.point_offsets = instances.field("points").offsets.to_numpy()
        self.points = instances.field("points").values.to_numpy()

    def _cameras(self, row: int) -> list[CameraRecord]:
        return [
            CameraRecord(
                **{name: values[i].as_py() for name, values in self.camera.items()},
                intrinsics=self.intrinsics[i].copy(),
                cam_from_frame=self.cam_from_frame[i].copy(),
            )
            for i in range(self.camera_offsets[row], self.camera_offsets[row + 1])
        ]

    def _lidar(self, row: int) -> LidarRecord | None:
        if not self.column["lidar"][row].is_valid:
            return None
        sweeps = [
            SweepRecord(
                self.sweep.field("path")[i].as_py(),
                self.sweep.field("timestamp_ns")[i].as_py(),
                self.sweep_from[i].copy(),
            )
            for i in range(self.sweep_offsets[row], self.sweep_offsets[row + 1])
        ]
        return LidarRecord(self.lidar_path[row].as_py(), self.frame_from_lidar[row].copy(), sweeps)

    def _instances(self, row: int) -> list[MapInstance] | None:
        if not self.column["instances"][row].is_valid:
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
            ego_from_frame=self.ego_from_frame[row].copy(),
            lidar=self._lidar(row),
            can_bus=self.can_bus[row].copy() if self.column["can_bus"][row].is_valid else None,
            instances=self._instances(row),
        )
