"""Decoding of MessagePack, the format in which py123d stores metadata and map features."""

import math
from typing import Any

import numpy as np
import pyarrow as pa

from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra

_ARRAY = b"__ndarray__"  # key that marks a dictionary as an array; py123d writes keys as bytes
_DTYPES = ("<f4", "<f8")  # float32 and float64 in little-endian order


def unpack(content: bytes) -> Any:
    """Decode MessagePack, with arrays as py123d encodes them. No code of the content is run.

    Raises:
        ValueError: If the content is damaged, or an array is not float32 or float64.
    """
    msgpack = import_extra("msgpack", "py123d")
    # The hook is called for each dictionary, the inner ones first.
    return msgpack.unpackb(content, object_hook=_array_of)


def _array_of(item: dict[Any, Any]) -> Any:
    """Decode an array; other dictionaries are returned as they are."""
    if _ARRAY not in item:
        return item
    dtype = item[b"dtype"]
    shape = item[b"shape"]
    if dtype not in _DTYPES:
        raise InputError(f"an array must have the type {' or '.join(_DTYPES)}, got {dtype!r:.60}")
    values = np.frombuffer(item[b"data"], dtype=dtype)
    if math.prod(shape) != len(values):
        raise InputError(f"an array of {len(values)} values cannot have the shape {shape!r:.60}")
    return values.reshape(shape)


def metadata_of(table: pa.Table) -> dict[str, Any]:
    """Decode the metadata of a table.

    Raises:
        ValueError: If the table has no metadata of py123d.
    """
    # Arrow's metadata is None if it is empty. Its keys and values are bytes.
    content = (table.schema.metadata or {}).get(b"metadata")
    metadata = None if content is None else unpack(content)
    if not isinstance(metadata, dict):
        raise InputError("it has no metadata of py123d")
    return metadata
