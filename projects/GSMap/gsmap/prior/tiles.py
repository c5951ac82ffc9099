"""Tiles of a map prior: all of them in files, and the recently used ones in memory."""

import mmap
import os
import tempfile
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from gsmap.prior.file_format import TileEntry, TileKey, unpack_tile
from gsmap.utils.errors import WorkError

Tile = NDArray[np.uint8]
_LEVEL = 1  # compression level of zlib; higher levels save little on sparse rasters
# Each time this number of bytes has been read from a mapped file, its pages are released from
# memory. Otherwise a large file would fill the memory.
_MAPPED_BYTES = 32 << 20
# Old versions of tiles in the temporary file are removed once they take more bytes than this, and
# more bytes than the current tiles.
_WASTED_BYTES = 64 << 20


class TileStore:
    """Tiles by their column and row in the global frame (`TileKey`), with a memory limit.

    A tile is an array with the states of its cells. The rule of the prior defines the meaning of a
    state, one byte. When the limit is reached, the least recently used tile leaves memory. If it
    has changed since it was read, it is compressed and written to a temporary file. The store
    never writes to the file of the prior.

    Args:
        shape: Shape of a tile.
        memory_bytes: Largest size of the tiles in memory, at least one tile.
    """

    def __init__(self, shape: tuple[int, ...], memory_bytes: int) -> None:
        self.shape = shape
        self._tile_bytes = int(np.prod(shape))
        self._most_tiles = max(1, memory_bytes // self._tile_bytes)
        self._tiles: OrderedDict[TileKey, Tile] = OrderedDict()  # the least recently used one first
        self._changed: set[TileKey] = set()  # tiles in memory that differ from both files
        self._file_entries: dict[TileKey, TileEntry] = {}
        self._mapped: mmap.mmap | None = None
        self._path = Path()
        self._mapped_bytes = 0  # read from the file since its pages were last released
        self._spill = _SpillFile()

    def open(self, mapped: mmap.mmap, path: Path, entries: dict[TileKey, TileEntry]) -> None:
        """Read tiles from a file from now on.

        Tiles in memory are not read again. So the store must be empty, or the file must contain all
        of its tiles in their current state.

        Args:
            mapped: Content of the file. The store closes it in `close`, or in the next `open`.
            path: Name of the file, for messages.
            entries: Offset, length and checksum of each tile in the file.
        """
        if self._mapped is not None:
            self._mapped.close()
        self._mapped = mapped
        self._path = path
        self._file_entries = entries
        self._changed.clear()
        self._spill.clear()

    def keys(self) -> set[TileKey]:
        """Columns and rows of all tiles, in memory and in files."""
        return {*self._file_entries, *self._spill.entries, *self._tiles}

    @property
    def num_in_memory(self) -> int:
        """Number of tiles in memory."""
        return len(self._tiles)

    def get(self, key: TileKey) -> Tile | None:
        """Return a tile, or None if nothing was written to it.

        The caller must not keep the tile: if it leaves memory, it is read again as a new array, and
        later changes go to this array.

        Raises:
            ValueError: If the tile is damaged in its file.
            RuntimeError: If the temporary file is needed, but belongs to another process.
        """
        tile = self._tiles.get(key)
        if tile is None:
            tile = self._load(key)
            if tile is None:
                return None
            self._keep(key, tile)
        self._tiles.move_to_end(key)
        return tile

    def get_to_write(self, key: TileKey, empty: int) -> Tile:
        """Return a tile for the caller to change before the next call.

        A tile that does not exist yet is created, with ``empty`` everywhere.

        Raises:
            ValueError: If the tile is damaged in its file.
            RuntimeError: If the temporary file is needed, but belongs to another process.
        """
        tile = self.get(key)
        if tile is None:
            tile = np.full(self.shape, empty, dtype=np.uint8)
            self._keep(key, tile)
        self._changed.add(key)
        return tile

    def packed_tiles(self) -> Iterator[tuple[TileKey, bytes]]:
        """Iterate over all tiles, compressed, in the order of their columns, then rows.

        Tiles that are not in memory are not loaded into it.

        Raises:
            ValueError: If a tile is damaged in its file.
            RuntimeError: If a tile is in the temporary file of another process.
        """
        for key in sorted(self.keys()):
            yield key, self._packed(key)

    def close(self) -> None:
        """Release all tiles and the file."""
        self._tiles.clear()
        self._file_entries = {}
        self._changed.clear()
        self._spill.clear()
        if self._mapped is not None:
            self._mapped.close()
            self._mapped = None

    def _packed(self, key: TileKey) -> bytes:
        """Compressed states of a tile. A damaged tile of a file raises an error."""
        if key in self._changed:
            return zlib.compress(self._tiles[key].tobytes(), level=_LEVEL)
        content, crc = self._stored(key)
        # Only a check: it raises an error if the tile is damaged.
        unpack_tile(content, crc=crc, num_bytes=self._tile_bytes, path=self._path)
        return content

    def _stored(self, key: TileKey) -> tuple[bytes, int]:
        """Compressed states and checksum of a tile in the temporary file or the prior's file."""
        if key in self._spill.entries:  # newer than the tile in the prior's file
            return self._spill.read(key)
        assert self._mapped is not None
        offset, length, crc = self._file_entries[key]
        content = self._mapped[offset : offset + length]
        self._mapped_bytes += length
        # Some systems cannot release the pages of a mapped file.
        if self._mapped_bytes > _MAPPED_BYTES and hasattr(mmap, "MADV_DONTNEED"):
            self._mapped.madvise(mmap.MADV_DONTNEED)
            self._mapped_bytes = 0
        return content, crc

    def _load(self, key: TileKey) -> Tile | None:
        """Read a tile that is not in memory. None if no file has it."""
        if key not in self._spill.entries and key not in self._file_entries:
            return None
        content, crc = self._stored(key)
        states = unpack_tile(content, crc=crc, num_bytes=self._tile_bytes, path=self._path)
        # `states` is a bytearray, so the array can be written to.
        return np.frombuffer(states, dtype=np.uint8).reshape(self.shape)

    def _keep(self, key: TileKey, tile: Tile) -> None:
        """Add a tile to the tiles in memory. At the limit, the least recently used one leaves."""
        while len(self._tiles) >= self._most_tiles:
            oldest = next(iter(self._tiles))
            if oldest in self._changed:
                content = zlib.compress(self._tiles[oldest].tobytes(), level=_LEVEL)
                self._spill.write(oldest, content)
                self._changed.discard(oldest)
            del self._tiles[oldest]
        self._tiles[key] = tile


class _SpillFile:
    """Temporary file of compressed tiles. It has no name, so the system removes it when closed."""

    def __init__(self) -> None:
        self.entries: dict[TileKey, TileEntry] = {}
        self._file: IO[bytes] | None = None
        self._end = 0  # size of the file in bytes
        self._used_bytes = 0  # bytes of current tiles in the file, without replaced tiles
        self._process = os.getpid()

    def write(self, key: TileKey, content: bytes) -> None:
        """Write a tile, which replaces an earlier version of the tile.

        The earlier version stays in the file until `_compact` removes all replaced versions.
        """
        self._require_process()
        replaced_bytes = self._end - self._used_bytes
        if replaced_bytes > max(_WASTED_BYTES, self._used_bytes):
            self._compact()
        if key in self.entries:
            _, old_length, _ = self.entries[key]
            self._used_bytes -= old_length
        self._append(key, content)

    def read(self, key: TileKey) -> tuple[bytes, int]:
        """Return a compressed tile and its checksum."""
        self._require_process()
        offset, length, crc = self.entries[key]
        assert self._file is not None
        self._file.seek(offset)
        return self._file.read(length), crc

    def clear(self) -> None:
        """Remove all tiles."""
        if self._file is not None:
            self._file.close()
        self._file = None
        self.entries = {}
        self._end = 0
        self._used_bytes = 0

    def _require_process(self) -> None:
        """Raise an error in a forked process.

        A forked process shares the position in the file with the process that made the file, so a
        read in one process would move the position in both.
        """
        if self._process != os.getpid():
            raise WorkError(
                "a map prior with changes belongs to the process that made it: save it, and load "
                "the file in the other process."
            )

    def _append(self, key: TileKey, content: bytes) -> None:
        """Write a tile at the end of the file."""
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._file.seek(self._end)
        self._file.write(content)
        self.entries[key] = (self._end, len(content), zlib.crc32(content))
        self._end += len(content)
        self._used_bytes += len(content)

    def _compact(self) -> None:
        """Write the current tiles to a new temporary file."""
        old_file = self._file
        old_entries = self.entries
        assert old_file is not None
        self._file = None  # so that `clear` leaves the old file open
        self.clear()
        for key, (offset, length, _) in old_entries.items():
            old_file.seek(offset)
            self._append(key, old_file.read(length))
        old_file.close()
