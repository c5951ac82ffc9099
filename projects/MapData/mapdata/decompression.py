"""Chunks and messages of bags unpacked within bounds, so that a small file cannot take all memory.

The libraries that read bags unpack whatever a file says. What they unpack with is replaced here by
functions that count.
"""

import bz2
import os
from collections.abc import Callable
from io import BytesIO
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra

FREE_BYTES = 1 << 26
TIMES = 100
_OF = {  # modules that unpack, by those that are asked for
    "rosbags.rosbag1": ("rosbags.rosbag1.reader",),
    "rosbags.rosbag2": ("rosbags.rosbag2.reader", "rosbags.rosbag2.storage_mcap"),
    "mcap.reader": ("mcap.stream_reader",),
    "mcap.stream_reader": ("mcap.stream_reader",),
}


class _Bag:
    """Bytes of the bag at hand."""

    packed: ClassVar[int] = 0
    unpacked: ClassVar[int] = 0


def begin_bag() -> None:
    """Count anew, for another bag."""
    _Bag.packed = _Bag.unpacked = 0


def import_bounded(name: str) -> ModuleType:
    """Import a module that reads bags, and let it unpack no more than their size allows.

    Args:
        name: Of the extra ``bags``; the message of the RuntimeError without it names the extra.
    """
    for part in _OF[name]:
        _bound(import_extra(part, "bags"))
    return import_extra(name, "bags")


def _bound(module: Any) -> None:
    """Replace what a module unpacks with, once."""
    if hasattr(module, "_is_bounded"):
        return
    module._is_bounded = True
    for table in ("decompressors", "DECOMPRESSORS"):
        known: dict[str, Any] = getattr(module, table, {})
        for kind in known.keys() & {"bz2", "zstd"}:
            known[kind] = _by_stream(bz2.open if kind == "bz2" else module.zstd.open)
        if "lz4" in known:
            known["lz4"] = _at_once(known["lz4"])
    if (zstd := getattr(module, "zstd", None)) is not None:
        module.zstd = SimpleNamespace(decompress=_by_stream(zstd.open), open=_bounded_file(zstd))
    if (zstandard := getattr(module, "zstandard", None)) is not None:
        module.zstandard = SimpleNamespace(decompress=_by_stream(zstandard.open))
    if (lz4 := getattr(module, "lz4", None)) is not None:
        module.lz4 = SimpleNamespace(decompress=_at_once(lz4.decompress))


def _room(packed: int) -> int:
    """Count packed bytes, and return how many more they may become."""
    _Bag.packed += packed
    return FREE_BYTES + TIMES * _Bag.packed - _Bag.unpacked


def _counted(content: bytes, room: int) -> bytes:
    """Count unpacked bytes.

    Raises:
        ValueError: If they are too many.
    """
    _Bag.unpacked += len(content)
    if len(content) > room:
        raise InputError(
            f"what is packed in it becomes more than {TIMES} times as large: if that is meant, "
            "unpack the bag first, such as by `mcap compress --compression none`"
        )
    return content


def _by_stream(opened: Callable[[BytesIO], Any]) -> Callable[..., bytes]:
    """Return a function that unpacks bytes through a file, no farther than the bound."""

    def unpack(data: bytes, *_: object) -> bytes:
        room = _room(len(data))
        with opened(BytesIO(data)) as file:
            return _counted(file.read(room + 1), room)

    return unpack


def _at_once(decompress: Callable[..., bytes]) -> Callable[..., bytes]:
    """Return a function that unpacks LZ4, which becomes at most 255 times as large."""

    def unpack(data: bytes, *others: object) -> bytes:
        room = _room(len(data))
        return _counted(decompress(data, *others), room)

    return unpack


def _bounded_file(zstd: Any) -> Callable[..., Any]:
    """Return a function that opens a packed file, whose parts are counted as they are read."""

    def opened(file: Any, mode: str) -> Any:
        _room(os.fstat(file.fileno()).st_size)
        unpacked = zstd.open(file, mode)
        read = unpacked.read
        unpacked.read = lambda size=-1: _counted(read(size), _room(0))
        return unpacked

    return opened
