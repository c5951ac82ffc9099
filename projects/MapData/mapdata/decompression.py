"""Bounded decompression of bags (recordings of ROS), so that a small file cannot fill the memory.

The libraries that read bags decompress without a limit. Their decompression functions are replaced
by functions that count bytes and raise an error beyond a limit.
"""

import bz2
import os
from collections.abc import Callable
from io import BytesIO
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra

# A bag of n compressed bytes may have at most FREE_BYTES + TIMES * n bytes after decompression.
FREE_BYTES = 1 << 26
TIMES = 100
# Modules whose decompression is replaced, by the name of the module that is imported. MCAP is a
# file format of ROS 2 and of other systems.
_DECOMPRESSING = {
    "rosbags.rosbag1": ("rosbags.rosbag1.reader",),
    "rosbags.rosbag2": ("rosbags.rosbag2.reader", "rosbags.rosbag2.storage_mcap"),
    "mcap.reader": ("mcap.stream_reader",),
    "mcap.stream_reader": ("mcap.stream_reader",),
}


class _Bag:
    """Number of compressed (packed) and decompressed (unpacked) bytes of the current bag.

    They are class attributes, because the libraries pass no bag to a decompression function. One
    bag is read at a time.
    """

    packed: ClassVar[int] = 0
    unpacked: ClassVar[int] = 0


def begin_bag() -> None:
    """Reset the number of bytes, for another bag."""
    _Bag.packed = 0
    _Bag.unpacked = 0


def import_bounded(name: str) -> ModuleType:
    """Import a module that reads bags, with bounded decompression.

    Args:
        name: Name of a module of the extra ``bags``, a key of ``_DECOMPRESSING``.

    Returns:
        The module.

    Raises:
        RuntimeError: If the module is not installed; the message names the extra.
    """
    for part in _DECOMPRESSING[name]:
        _bound(import_extra(part, extra="bags"))
    return import_extra(name, extra="bags")


def _bound(module: Any) -> None:
    """Replace the decompression functions of a module, once."""
    if hasattr(module, "_is_bounded"):
        return
    module._is_bounded = True
    # Tables of functions by compression: `decompressors` for ROS 1, `DECOMPRESSORS` for MCAP files
    # of ROS 2. Their replacements take the original `module.zstd`, which is replaced afterwards.
    for table_name in ("decompressors", "DECOMPRESSORS"):
        table: dict[str, Any] = getattr(module, table_name, {})
        if "bz2" in table:
            table["bz2"] = _bounded_stream(bz2.open)
        if "zstd" in table:
            table["zstd"] = _bounded_stream(module.zstd.open)
        if "lz4" in table:
            table["lz4"] = _bounded_lz4(table["lz4"])
    # Modules that the readers call directly. The replacements have only the functions for reading.
    zstd = getattr(module, "zstd", None)
    if zstd is not None:
        module.zstd = SimpleNamespace(
            decompress=_bounded_stream(zstd.open), open=_bounded_file(zstd)
        )
    zstandard = getattr(module, "zstandard", None)
    if zstandard is not None:
        module.zstandard = SimpleNamespace(decompress=_bounded_stream(zstandard.open))
    lz4 = getattr(module, "lz4", None)
    if lz4 is not None:
        module.lz4 = SimpleNamespace(decompress=_bounded_lz4(lz4.decompress))


def _remaining_bytes() -> int:
    """Number of bytes by which the decompressed size of the current bag may still grow."""
    return max(0, FREE_BYTES + TIMES * _Bag.packed - _Bag.unpacked)


def _count_unpacked(content: bytes, limit: int) -> bytes:
    """Count decompressed bytes, and return them.

    Args:
        content: The decompressed bytes.
        limit: `_remaining_bytes` before these bytes are counted.

    Raises:
        ValueError: If there are more than ``limit`` bytes.
    """
    _Bag.unpacked += len(content)
    if len(content) > limit:
        raise InputError(
            f"its content is more than {TIMES} times as large after decompression: if that is "
            "right, decompress the bag first, such as by `mcap compress --compression none`"
        )
    return content


def _bounded_stream(open_stream: Callable[[BytesIO], Any]) -> Callable[..., bytes]:
    """Function that decompresses bytes as a stream, at most up to the limit.

    Some libraries also pass the decompressed size. It is ignored: a file may contain any size.
    """

    def decompress(data: bytes, *_: object) -> bytes:
        _Bag.packed += len(data)
        limit = _remaining_bytes()
        with open_stream(BytesIO(data)) as file:
            # Reading one byte more than the limit shows whether the content exceeds it.
            return _count_unpacked(file.read(limit + 1), limit=limit)

    return decompress


def _bounded_lz4(unbounded: Callable[..., bytes]) -> Callable[..., bytes]:
    """Function that decompresses LZ4 at once and counts the bytes afterwards.

    LZ4 expands data by a factor of at most 255, so a single call cannot fill the memory.
    """

    def decompress(data: bytes, *options: object) -> bytes:
        _Bag.packed += len(data)
        limit = _remaining_bytes()
        return _count_unpacked(unbounded(data, *options), limit=limit)

    return decompress


def _bounded_file(zstd: Any) -> Callable[..., Any]:
    """Function that opens a compressed file, and counts the bytes of each read.

    The reader copies the file in blocks, so one read is too small to fill the memory.
    """

    def open_file(file: Any, mode: str) -> Any:
        _Bag.packed += os.fstat(file.fileno()).st_size
        unpacked = zstd.open(file, mode)
        read = unpacked.read
        unpacked.read = lambda size=-1: _count_unpacked(read(size), limit=_remaining_bytes())
        return unpacked

    return open_file
