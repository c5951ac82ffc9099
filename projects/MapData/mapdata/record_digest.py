"""Digest of plain records, by which shards of different records are told apart."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

_Known = dict[int, tuple[Any, bytes]]  # a value and its digest, by the id of the value


def digest_of_records(records: Iterable[Any]) -> str:
    """Return a digest of all values of records.

    Equal values have equal digests in every process, whether they are one object or copies.

    Args:
        records: Records as `mapdata.custom.from_records` takes them, correct or not. The elements
            of a map (``global_instances``) that several records share are read once.

    Returns:
        SHA-256 as hexadecimal digits.
    """
    sha256 = hashlib.sha256()
    known: _Known = {}
    for record in records:
        if not isinstance(record, Mapping):
            sha256.update(_digest(record))
            continue
        for key in sorted(record, key=str):
            value = record[key]
            sha256.update(_digest(str(key)))
            is_map = key == "global_instances" and isinstance(value, list | tuple)
            sha256.update(_digest_of_map(value, known) if is_map else _digest(value))
    return sha256.hexdigest()


def _digest_of_map(elements: Sequence[Any], known: _Known) -> bytes:
    """Digest of the elements of a map, or of one that was read before."""
    if id(elements) not in known:
        sha256 = hashlib.sha256()
        for element in elements:
            if id(element) not in known:
                known[id(element)] = (element, _digest(element))
            sha256.update(known[id(element)][1])
        # The value is kept, too, so that no later one gets its id.
        known[id(elements)] = (elements, sha256.digest())
    return known[id(elements)][1]


def _digest(value: Any) -> bytes:
    """Digest of a value: a number, a text, an array, or a mapping or sequence of values."""
    sha256 = hashlib.sha256()
    if isinstance(value, Mapping):
        sha256.update(b"mapping")
        for key in sorted(value, key=str):
            sha256.update(_digest(str(key)))
            sha256.update(_digest(value[key]))
    elif value is None or isinstance(value, str | bytes | Path):
        sha256.update(repr(value).encode())
    else:
        array = _numbers_of(value)
        if array is not None:
            sha256.update(f"{array.dtype.str} {array.shape}".encode())
            sha256.update(array.tobytes())
        elif isinstance(value, list | tuple):
            sha256.update(b"sequence")
            for item in value:
                sha256.update(_digest(item))
        else:  # not a value of a record: an error follows when the record is read
            sha256.update(type(value).__name__.encode())
    return sha256.digest()


def _numbers_of(value: Any) -> np.ndarray | None:
    """Array of a number, or of a nested sequence of numbers; None for other values."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):  # such as a nested sequence without a shape
        return None
    return array if array.dtype.kind in "biuf" else None
