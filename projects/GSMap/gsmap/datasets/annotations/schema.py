"""Columns of an annotation file, and conversion of samples to and from rows.

Each column has the name of a field of `MapSample`. Nested records are nested columns, and both
conversions follow these nested types. A *record* is here a dataclass: a sample, or one of its
cameras, LiDAR scans, sweeps and map elements.
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

META_KEY = b"gsmap"  # key of the metadata, as JSON, in the schema of the file
_POSE = pa.list_(pa.float64(), 16)  # a (4, 4) matrix, row by row
_INTRINSICS = pa.list_(pa.float64(), 9)
# Shapes of the fields that are stored as flat lists of fixed length.
_SHAPES = {
    "intrinsics": (3, 3),
    "can_bus": (NUM_CAN_BUS,),
    "global_from_frame": (4, 4),
    "ego_from_frame": (4, 4),
    "cam_from_frame": (4, 4),
    "frame_from_lidar": (4, 4),
}
_INTEGERS = {"timestamp_ns", "width", "height", "label"}  # fields that are converted to int
_TEXTS = {"token", "scene", "map_name", "name", "path"}
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
# Class of the records that each nested type stores.
_RECORDS: dict[pa.DataType, Any] = {
    _CAMERA: CameraRecord,
    _SWEEP: SweepRecord,
    _LIDAR: LidarRecord,
    _INSTANCE: MapInstance,
    _SAMPLE: MapSample,
}


def schema_of(meta: AnnotationMeta) -> pa.Schema:
    """Return the schema of a file with its metadata."""
    values = asdict(meta)
    if meta.ground_z_m is None:  # left out, so that earlier versions, without it, read the file
        del values["ground_z_m"]
    return pa.schema(FIELDS, metadata={META_KEY: json.dumps(values).encode()})


def row_of(record: Any, meta: AnnotationMeta, where: str = "") -> dict[str, Any]:
    """Convert a sample, or a record in it, to the nested values of a row.

    Args:
        record: Sample or record.
        meta: Metadata of the file: annotation frame, and number of coordinates of a point.
        where: Beginning of error messages.

    Returns:
        Values by the name of the column. Matrices and points are flat arrays.

    Raises:
        ValueError: If a matrix or the points of an element have a wrong shape or are not numeric,
            if a name, token or path is no text, or if a label, a time or a size of an image is no
            whole number.
    """
    if isinstance(record, MapSample):
        where += f"sample {record.token!r}: "
    if isinstance(record, CameraRecord):
        where += f"{record.name}: "
    row = {}
    for name, value in vars(record).items():
        if value is None and name == "ego_from_frame" and meta.frame == "ego":
            value = np.eye(4)  # the annotation frame is the frame of the vehicle
        if name in _SHAPES or name == "points":
            if value is not None:
                value = _flatten(value, name=name, dim=meta.dim, where=where)
        elif isinstance(value, (list, tuple)):
            value = [row_of(item, meta, where=where) for item in value]
        elif isinstance(value, LidarRecord):
            value = row_of(value, meta, where=where)
        else:
            value = _checked_scalar(value, name=name, where=where)
        row[name] = value
    return row


def _checked_scalar(value: Any, name: str, where: str) -> Any:
    """Convert a whole number to an integer, and require texts where the file has texts."""
    if name in _INTEGERS:
        return whole_number(value, name=f"{where}{name}")
    if name in _TEXTS and not isinstance(value, str | bytes | None):
        raise InputError(f"{where}{name} must be text, got {value!r:.80}.")
    return value


def whole_number(value: Any, name: str) -> int:
    """Convert a number, such as 3.0, to an integer.

    Raises:
        ValueError: If the number is not whole; ``name`` begins the message.
    """
    if isinstance(value, (float, np.floating)) and not float(value).is_integer():
        raise InputError(f"{name} must be a whole number, got {value!r:.80}.")
    return int(value)


def _flatten(value: Any, name: str, dim: int, where: str) -> np.ndarray:
    """Check a matrix, or the points of an element, and convert it to one dimension."""
    array = np.asarray(value)
    if name in _SHAPES:
        shape = _SHAPES[name]
        wanted = f"of shape {shape}"
    else:
        num_points = array.size // dim
        shape = (max(num_points, 2), dim)  # an array of fewer than two points has another shape
        wanted = f"(n >= 2, {dim})"
    # The kinds are signed and unsigned integers, and floating-point numbers.
    if array.shape != shape or array.dtype.kind not in "iuf":
        raise InputError(
            f"{where}{name} must be numbers {wanted}, got {array.dtype} {array.shape}."
        )
    dtype = np.float64 if name in _SHAPES else np.float32
    return array.astype(dtype).reshape(-1)


def batch_of(rows: Sequence[dict[str, Any]], schema: pa.Schema) -> pa.RecordBatch:
    """Convert rows to a record batch.

    Args:
        rows: Rows from `row_of`.
        schema: Schema of the file.

    Raises:
        ValueError: If a value does not have the type of the column.
    """
    columns = []
    try:
        for name, column_type in FIELDS.items():
            values = [row[name] for row in rows]
            columns.append(pa.array(values, type=column_type))
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
        tokens = [row["token"] for row in rows]
        raise InputError(f"one of the samples {tokens[0]!r} to {tokens[-1]!r}: {error}.") from error
    return pa.record_batch(columns, schema=schema)


def matrices_of(array: pa.FixedSizeListArray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the matrices of a column, NaN in rows without a matrix. (rows, *shape)

    Args:
        array: Column with the entries of matrices.
        shape: Shape of a matrix.
    """
    return array.values.to_numpy(zero_copy_only=False).reshape((-1, *shape))


def decoder_of(array: pa.Array, dim: int, name: str = "") -> Callable[[int], Any]:
    """Return a function that creates the record, or the value, of a row.

    All columns are prepared here once, so that reading a row is fast.

    Args:
        array: Records, or the values of a field of records. The file must have been checked.
        dim: Coordinates per point, 2 or 3.
        name: Name of the field; empty for whole records.

    Returns:
        Function of the number of the row. It returns None for a missing value.
    """
    decode = _decoder_of_valid(array, dim=dim, name=name)
    if not array.null_count:
        return decode
    is_valid = array.is_valid().to_numpy(zero_copy_only=False)
    return lambda i: decode(i) if is_valid[i] else None


def _decoder_of_valid(array: pa.Array, dim: int, name: str) -> Callable[[int], Any]:
    """Return a function that creates the record, or the value, of a row that is not missing."""
    if pa.types.is_struct(array.type):
        record_class = _RECORDS[array.type]
        decoders = {}
        for field in array.type:
            decoders[field.name] = decoder_of(array.field(field.name), dim=dim, name=field.name)
        return lambda i: record_class(**{key: decode(i) for key, decode in decoders.items()})
    # Matrices and points are copied: the arrays may be read-only views of the mapped file.
    if name in _SHAPES:
        matrices = matrices_of(array, _SHAPES[name])
        return lambda i: matrices[i].copy()
    if name == "points":
        starts = array.offsets.to_numpy() // dim  # offsets count coordinates, starts count points
        points = array.values.to_numpy().reshape(-1, dim)
        return lambda i: points[starts[i] : starts[i + 1]].copy()
    if pa.types.is_list(array.type):  # a list of records, such as the cameras
        starts = array.offsets.to_numpy()
        decode_item = decoder_of(array.values, dim=dim)
        return lambda i: [decode_item(j) for j in range(starts[i], starts[i + 1])]
    return lambda i: array[i].as_py()
