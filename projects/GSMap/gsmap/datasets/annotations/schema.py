"""The columns of an annotation file, and samples to and from its rows.

The columns bear the names of the records' fields, so one walk along the types does either way.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa

from gsmap.datasets.annotations.record import (
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
)
from gsmap.structures.calibration import NUM_CAN_BUS
from gsmap.utils.errors import InputError

META_KEY = b"gsmap"
_POSE, _INTRINSICS = pa.list_(pa.float64(), 16), pa.list_(pa.float64(), 9)
_SHAPES = {
    "intrinsics": (3, 3),
    "can_bus": (NUM_CAN_BUS,),
    **dict.fromkeys(
        ("global_from_frame", "ego_from_frame", "cam_from_frame", "frame_from_lidar"), (4, 4)
    ),
}
_INTEGERS = {"timestamp_ns", "width", "height", "label"}
_CAMERA = pa.struct(
    {
        "name": pa.string(),
        "path": pa.string(),
        "width": pa.int32(),
        "height": pa.int32(),
        "intrinsics": _INTRINSICS,
        "cam_from_frame": _POSE,
    }
)
_SWEEP = pa.struct({"path": pa.string(), "timestamp_ns": pa.int64(), "frame_from_lidar": _POSE})
_LIDAR = pa.struct({"path": pa.string(), "frame_from_lidar": _POSE, "sweeps": pa.list_(_SWEEP)})
_INSTANCE = pa.struct({"label": pa.int32(), "points": pa.list_(pa.float32())})
FIELDS = {
    "token": pa.string(),
    "scene": pa.string(),
    "map_name": pa.string(),
    "timestamp_ns": pa.int64(),
    "global_from_frame": _POSE,
    "ego_from_frame": _POSE,
    "cameras": pa.list_(_CAMERA),
    "lidar": _LIDAR,
    "can_bus": pa.list_(pa.float64(), NUM_CAN_BUS),
    "instances": pa.list_(_INSTANCE),
}
_SAMPLE = pa.struct(FIELDS)
_RECORDS: dict[pa.DataType, Any] = {
    _CAMERA: CameraRecord,
    _SWEEP: SweepRecord,
    _LIDAR: LidarRecord,
    _INSTANCE: MapInstance,
    _SAMPLE: MapSample,
}


def schema_of(meta: AnnotationMeta) -> pa.Schema:
    """Return the file's schema with its metadata."""
    values = asdict(meta)
    if meta.ground_z_m is None:  # as in files that earlier versions read
        del values["ground_z_m"]
    return pa.schema(FIELDS, metadata={META_KEY: json.dumps(values).encode()})


def row_of(record: Any, meta: AnnotationMeta, where: str = "") -> dict[str, Any]:
    """Return a sample, or a record in it, as the nested values of an Arrow row.

    Args:
        record: The sample or record.
        meta: What holds for the whole file.
        where: What the message of an error begins with.

    Raises:
        ValueError: If a matrix or an element has another shape, or holds no numbers.
    """
    where += f"sample {record.token!r}: " if isinstance(record, MapSample) else ""
    where += f"{record.name}: " if isinstance(record, CameraRecord) else ""
    row = {}
    for name, value in vars(record).items():
        if value is None and name == "ego_from_frame" and meta.frame == "ego":
            value = np.eye(4)  # the frame is the vehicle
        if name in _SHAPES or name == "points":
            value = None if value is None else _flat(value, name, meta.dim, where)
        elif isinstance(value, (list, tuple)):
            value = [row_of(item, meta, where) for item in value]
        elif isinstance(value, LidarRecord):
            value = row_of(value, meta, where)
        row[name] = int(value) if name in _INTEGERS else value
    return row


def _flat(value: Any, name: str, dim: int, where: str) -> np.ndarray:
    """Return a matrix, or the points of an element, in one dimension."""
    array = np.asarray(value)
    shape = _SHAPES.get(name, (max(array.size // dim, 2), dim))
    if array.shape != shape or array.dtype.kind not in "iuf":
        wanted = f"of shape {shape}" if name in _SHAPES else f"(n >= 2, {dim})"
        raise InputError(
            f"{where}{name} must be numbers {wanted}, got {array.dtype} {array.shape}."
        )
    return array.astype(np.float64 if name in _SHAPES else np.float32).reshape(-1)


def batch_of(rows: Sequence[dict[str, Any]], schema: pa.Schema) -> pa.RecordBatch:
    """Return rows as one record batch.

    Raises:
        ValueError: If a value has another type than its column.
    """
    try:
        columns = [pa.array([row[name] for row in rows], kind) for name, kind in FIELDS.items()]
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
        tokens = [row["token"] for row in rows]
        raise InputError(f"one of the samples {tokens[0]!r} to {tokens[-1]!r}: {error}.") from error
    return pa.record_batch(columns, schema=schema)


def matrices_of(array: pa.FixedSizeListArray, *shape: int) -> np.ndarray:
    """Return a column of matrices, NaN where there is none. (rows, *shape)."""
    return array.values.to_numpy(zero_copy_only=False).reshape(-1, *shape)


def decoder_of(array: pa.Array, dim: int, name: str = "") -> Callable[[int], Any]:
    """Return a function that makes the record of a row from a valid array.

    Args:
        array: Structures, or the values of one field of them.
        dim: Coordinates per point, 2 or 3.
        name: The field that the array holds; by default the whole record.
    """
    decode = _decoder_of(array, dim, name)
    if not array.null_count:
        return decode
    known = array.is_valid().to_numpy(zero_copy_only=False)
    return lambda i: decode(i) if known[i] else None


def _decoder_of(array: pa.Array, dim: int, name: str) -> Callable[[int], Any]:
    """Return what decodes an item that is there."""
    if pa.types.is_struct(array.type):
        record = _RECORDS[array.type]
        parts = {p.name: decoder_of(array.field(p.name), dim, p.name) for p in array.type}
        return lambda i: record(**{name: part(i) for name, part in parts.items()})
    if name in _SHAPES:
        matrices = matrices_of(array, *_SHAPES[name])
        return lambda i: matrices[i].copy()
    if name == "points":
        ends, points = array.offsets.to_numpy() // dim, array.values.to_numpy().reshape(-1, dim)
        return lambda i: points[ends[i] : ends[i + 1]].copy()
    if pa.types.is_list(array.type):
        ends, item = array.offsets.to_numpy(), decoder_of(array.values, dim)
        return lambda i: [item(j) for j in range(ends[i], ends[i + 1])]
    return lambda i: array[i].as_py()
