"""File format of all kinds of map priors: a header, compressed tiles and an index.

The file begins with the magic number, the version and the length of the header, all little-endian.
The header is JSON in UTF-8. If the prior names the samples that it was made of, their number and
checksum are in the header, and their digests (`PriorSources`) follow. Then there are compressed
tiles (zlib), and the index with the column, row, offset, length and checksum (CRC-32) of each tile.
A footer of fixed size ends the file.

A rule is an object with the settings by which the states of the prior are updated. Files are
untrusted: header, index and tiles are checked before their content is used.
"""

import json
import mmap
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from gsmap.prior.element_rule import ELEMENT_RULES
from gsmap.prior.gaussian_rule import GAUSSIAN_RULES
from gsmap.prior.inputs import reserve_file
from gsmap.prior.rules import RULES, rule_from_settings, rule_settings
from gsmap.prior.settings import PriorSettings
from gsmap.prior.sources import DIGEST_BYTES, MOST_SOURCES, PriorSources
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write, fetch_advice

VERSION = 1
TileKey = tuple[int, int]
"""Column and row of a tile in the global frame."""
TileEntry = tuple[int, int, int]
"""Offset in the file and length, both in bytes, and checksum of a compressed tile."""
FARTHEST_TILE = 2**30
"""Largest column or row of a tile."""
RASTER_MAGIC = b"\x89GSPRIOR"
"""First bytes of a file of `MapPrior`."""
GAUSSIAN_MAGIC = b"\x89GSGAUSS"
"""First bytes of a file of `GaussianPrior`."""
ELEMENT_MAGIC = b"\x89GSELEMS"
"""First bytes of a file of `ElementPrior`."""
# Formats of `struct`: "<" is little-endian, "8s" 8 bytes, "I" and "Q" integers of 4 and 8 bytes.
_START = struct.Struct("<8sII")  # magic, version, length of the header in bytes
# Offset, number of rows and checksum of the index; checksum of the header; magic.
_FOOTER = struct.Struct("<QIII8s")
_INDEX = np.dtype(
    [("column", "<i4"), ("row", "<i4"), ("offset", "<u8"), ("length", "<u4"), ("crc", "<u4")]
)
_SOURCES = "sources"  # key in the header
_NO_SOURCES = {"count": 0, "checksum": 0}  # the checksum (CRC-32) of no bytes is 0
_LONGEST_HEADER = 1 << 18  # in bytes; 65 names of 200 letters have at most 12 bytes a letter


class _Kind(NamedTuple):
    """Kind of a prior in a file.

    Attributes:
        title: Name of the kind, for messages.
        writer: Name of the class that writes such files.
        rules: Classes of the rules of such a prior, by their names in files.
    """

    title: str
    writer: str
    rules: Mapping[str, type]


_KINDS = {
    RASTER_MAGIC: _Kind("map prior", "MapPrior", rules=RULES),
    GAUSSIAN_MAGIC: _Kind("Gaussian prior", "GaussianPrior", rules=GAUSSIAN_RULES),
    ELEMENT_MAGIC: _Kind("prior of elements", "ElementPrior", rules=ELEMENT_RULES),
}


class PriorHeader(NamedTuple):
    """Everything in a file but its tiles.

    Attributes:
        settings: Classes, place and cells of the prior.
        rule: Rule that computes the stored states.
        entries: Offset, length and checksum of each tile, by column and row.
        sources: Samples that the prior was made of; none if they are unknown.
    """

    settings: PriorSettings
    rule: Any
    entries: dict[TileKey, TileEntry]
    sources: PriorSources


def save_file(
    path: Path,
    settings: PriorSettings,
    rule: Any,
    tiles: Iterable[tuple[TileKey, bytes]],
    magic: bytes,
    sources: PriorSources,
) -> None:
    """Write a file, which replaces ``path`` when it is complete.

    Args:
        path: File to create or replace.
        settings: Classes, place and cells of the prior.
        rule: Rule that computes the stored states.
        tiles: Column and row, and compressed states, of each tile.
        magic: First bytes of the kind of file.
        sources: Samples that the prior was made of.

    Raises:
        ValueError: If another program has written the lock file.
        RuntimeError: If the file is reserved by another process.
    """
    owner = reserve_file(path)  # open lock file, which reserves `path` until it is closed
    try:
        with atomic_write(path, mode="wb") as file:
            write_tiles(file, settings, rule=rule, tiles=tiles, magic=magic, sources=sources)
    finally:
        owner.close()


def read_file(
    path: Path, settings: PriorSettings | None, magic: bytes
) -> tuple[bytes, PriorHeader]:
    """Read an untrusted file, and check everything but its tiles.

    Args:
        path: The file.
        settings: Settings that the file must have; None to accept any.
        magic: First bytes of the kind of file.

    Returns:
        Content of the file, and everything in it but the tiles.

    Raises:
        ValueError: If the file is no valid prior of this kind, or has other settings.
    """
    content = path.read_bytes()
    if not content:
        raise InputError(f"{path} is empty: copy or build it again.")
    header = read_header(content, path, magic=magic)
    if settings is not None:
        settings.require_equal(header.settings, str(path))
    return content, header


def write_tiles(
    file: IO[bytes],
    settings: PriorSettings,
    rule: Any,
    tiles: Iterable[tuple[TileKey, bytes]],
    magic: bytes = RASTER_MAGIC,
    sources: PriorSources | None = None,
) -> None:
    """Write the content of a file.

    Args:
        file: Empty file.
        settings: Classes, place and cells of the prior.
        rule: Rule that computes the stored states.
        tiles: Column and row, and compressed states, of each tile.
        magic: First bytes of the kind of file.
        sources: Samples that the prior was made of; None if they are unknown.

    Raises:
        ValueError: If a column or row is too large for the index.
    """
    rule_entry = rule_settings(rule, _KINDS[magic].rules)  # name and numbers of the rule
    values = asdict(settings) | {"rule": rule_entry}
    digests = b"" if sources is None else sources.to_bytes()
    if digests:
        num_sources = len(digests) // DIGEST_BYTES
        values[_SOURCES] = {"count": num_sources, "checksum": zlib.crc32(digests)}
    header = json.dumps(values).encode()
    file.write(_START.pack(magic, VERSION, len(header)))
    file.write(header)
    file.write(digests)
    offset = _START.size + len(header) + len(digests)
    rows = []
    for (column, row), content in tiles:
        if max(abs(column), abs(row)) > FARTHEST_TILE:
            raise InputError(f"tiles of {settings.tile_m:g} m are too small for this map.")
        file.write(content)
        rows.append((column, row, offset, len(content), zlib.crc32(content)))
        offset += len(content)
    index = np.array(rows, dtype=_INDEX).tobytes()
    file.write(index)
    file.write(_FOOTER.pack(offset, len(rows), zlib.crc32(index), zlib.crc32(header), magic))


def read_header(content: mmap.mmap | bytes, path: Path, magic: bytes = RASTER_MAGIC) -> PriorHeader:
    """Read and check everything but the tiles of an untrusted file.

    Args:
        content: Content of the file.
        path: Name of the file, for messages.
        magic: First bytes of the kind of file.

    Raises:
        ValueError: If the file is no valid prior.
    """
    kind = _KINDS[magic]
    size = len(content)
    # 200 bytes are enough for `fetch_advice`. It recognises a Git LFS pointer or a web page that
    # was stored in place of the file.
    start = bytes(content[: max(_START.size, 200)])
    if not start.startswith(magic):
        advice = fetch_advice(start, otherwise=f"give a file that {kind.writer}.save has written")
        raise InputError(f"{path} is no {kind.title}: {advice}.")
    if size < _START.size + _FOOTER.size:
        raise _cut(path)
    _, version, length = _START.unpack_from(start)
    if version != VERSION:
        raise InputError(
            f"{path} has version {version} of map priors, and version {VERSION} is read: build "
            "the prior with this version of the program."
        )
    footer = _FOOTER.unpack_from(content, size - _FOOTER.size)
    offset, count, index_crc, header_crc, last_bytes = footer
    index_size = count * _INDEX.itemsize
    # The index lies directly before the footer.
    if last_bytes != magic or offset + index_size + _FOOTER.size != size:
        raise _cut(path)
    header_end = _START.size + length
    if length > _LONGEST_HEADER or header_end > offset:
        raise InputError(f"{path} is damaged: its header has {length} bytes; build it again.")
    header = bytes(content[_START.size : header_end])
    index = bytes(content[offset : offset + index_size])
    if zlib.crc32(header) != header_crc or zlib.crc32(index) != index_crc:
        raise InputError(f"{path} is damaged: a checksum is wrong; copy or build it again.")
    settings, rule, sources_entry = _parse_header(header, path=path, rules=kind.rules)
    count = sources_entry["count"]
    tiles_start = header_end + count * DIGEST_BYTES
    digests = bytes(content[header_end : min(tiles_start, offset)])
    if tiles_start > offset or zlib.crc32(digests) != sources_entry["checksum"]:
        raise InputError(f"{path} is damaged: a checksum is wrong; copy or build it again.")
    entries = _parse_index(index, path=path, start=tiles_start, end=offset)
    return PriorHeader(settings, rule, entries=entries, sources=PriorSources(digests))


def _cut(path: Path) -> InputError:
    """Error about a file that is too short."""
    return InputError(f"{path} is cut off: its end is missing; copy or build it again.")


def _parse_header(
    header: bytes, path: Path, rules: Mapping[str, type]
) -> tuple[PriorSettings, Any, dict[str, int]]:
    """Parse and check a header.

    Args:
        header: JSON text.
        path: Name of the file, for messages.
        rules: Classes of the possible rules, by their names.

    Returns:
        Settings and rule of the prior, and number and checksum of its sources.

    Raises:
        ValueError: If the header is malformed.
    """
    fields = ["cell_m", "classes", "place", "rule", "tile_m"]  # sorted
    try:
        values: Any = json.loads(header)
        # Priors of earlier versions, and priors of unknown samples, have no sources.
        sources: Any = _NO_SOURCES
        if isinstance(values, dict):
            sources = values.pop(_SOURCES, _NO_SOURCES)
        if not isinstance(values, dict) or sorted(values) != fields:
            raise InputError(f"the header must have the fields {fields}.")
        if not isinstance(values["classes"], list):
            raise InputError("classes must be a list.")
        _require_sources(sources)
        rule = rule_from_settings(values.pop("rule"), rules)
        return PriorSettings(**values), rule, sources
    # A TypeError is raised for a list instead of a name, a RecursionError for deeply nested JSON.
    # An `InputError` is a ValueError, so the two above get the path of the file here, too.
    except (ValueError, TypeError, RecursionError) as error:
        text = str(error).rstrip(".")
        raise InputError(f"{path} is damaged: {text}; build it again.") from error


def _require_sources(entry: Any) -> None:
    """Raise ValueError if the entry of the sources in a header is malformed."""
    is_valid = isinstance(entry, dict) and entry.keys() == _NO_SOURCES.keys()
    # True and False are integers in Python.
    if not is_valid or any(type(number) is not int for number in entry.values()):
        raise InputError(f"{_SOURCES} must have a count and a checksum.")
    if not 0 <= entry["count"] <= MOST_SOURCES:
        raise InputError(f"the count of {_SOURCES} must be in [0, {MOST_SOURCES}].")


def _parse_index(index: bytes, path: Path, start: int, end: int) -> dict[TileKey, TileEntry]:
    """Parse and check the index of a file, whose tiles are in the bytes ``start`` to ``end``."""
    rows = np.frombuffer(index, dtype=_INDEX)
    offsets = rows["offset"]
    # Bytes between the start of a tile and the index. Offsets are unsigned integers, so without the
    # minimum the difference would wrap around to a huge number for an offset beyond the end.
    longest = end - np.minimum(offsets, end)
    is_valid = (offsets >= start) & (offsets <= end) & (rows["length"] <= longest)
    tile_columns = np.abs(rows["column"].astype(np.int64))
    tile_rows = np.abs(rows["row"].astype(np.int64))
    is_valid &= (tile_columns <= FARTHEST_TILE) & (tile_rows <= FARTHEST_TILE)
    # Tiles that share bytes would let a small file become a large map.
    by_offset = rows[np.argsort(offsets, kind="stable")]
    tile_ends = by_offset["offset"].astype(np.int64) + by_offset["length"]
    do_overlap = (tile_ends[:-1] > by_offset["offset"][1:].astype(np.int64)).any()
    entries = {}
    for column, row, offset, length, crc in rows.tolist():
        entries[column, row] = (offset, length, crc)
    # There are fewer entries than rows if a tile occurs twice.
    if not is_valid.all() or do_overlap or len(entries) != len(rows):
        raise InputError(
            f"{path} is damaged: its index names tiles outside of the file or twice; build it "
            "again."
        )
    return entries


def unpack_tile(content: bytes, crc: int, num_bytes: int, path: Path | str) -> bytearray:
    """Decompress a tile, in bounded memory.

    Args:
        content: Compressed tile.
        crc: Expected checksum of ``content``.
        num_bytes: Expected size of the decompressed states in bytes.
        path: Name of the file, for messages.

    Returns:
        States of the tile. They can be changed in place, unlike bytes.

    Raises:
        ValueError: If the tile is damaged.
    """
    unpacker = zlib.decompressobj()
    try:
        # One more byte than expected is enough to detect a tile that is too large.
        states = unpacker.decompress(content, num_bytes + 1)
    except zlib.error:
        states = b""  # with a wrong length, or an unfinished stream, so the check below fails
    if zlib.crc32(content) != crc or len(states) != num_bytes or not unpacker.eof:
        raise InputError(f"{path} is damaged: a tile cannot be read; copy or build it again.")
    return bytearray(states)
