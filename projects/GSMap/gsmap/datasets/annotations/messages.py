"""The messages of an Arrow file, one after another, and the checksums up to each.

An Arrow file is a stream of messages between "ARROW1" and a footer that says where each begins. The
last message of an annotation file is its seal.
"""

import zlib
from collections.abc import Sequence
from itertools import pairwise

import pyarrow as pa

from gsmap.utils.errors import InputError

_START, _END = b"ARROW1\0\0", b"ARROW1"
# The seal has no rows; its metadata hold the checksum of all bytes before it.
SEAL_KEY = b"gsmap_seal"


def read_messages(
    content: pa.Buffer,
) -> tuple[pa.Schema, list[pa.RecordBatch], bytes | None, list[int]]:
    """Read a file's messages in their order: schema, batches, and the seal if there is one.

    Last come the ends of nothing, the schema and each batch, in bytes.
    """
    size = content.size
    if size < len(_START) + 10 or content[: len(_START)].to_pybytes() != _START:
        raise InputError("it does not begin as an Arrow file")
    source = pa.BufferReader(content)
    source.seek(len(_START))
    reader = pa.ipc.open_stream(source)
    ends, found = [0, source.tell()], []
    for message in reader.iter_batches_with_custom_metadata():
        ends.append(source.tell())
        found.append(message)
    tail = content[source.tell() :].to_pybytes()
    if tail[-6:] != _END or int.from_bytes(tail[-10:-6], "little") != len(tail) - 10:
        raise InputError("it ends too early")
    seal = (found[-1].custom_metadata or {}).get(SEAL_KEY) if found else None
    batches = [batch for batch, _ in (found if seal is None else found[:-1])]
    if not all(map(len, batches)):
        raise InputError("it has an empty part")  # as a seal with a damaged name would be
    return reader.schema, batches, seal, ends[: len(batches) + 2]


def checksums(content: pa.Buffer, ends: Sequence[int]) -> list[tuple[int, int]]:
    """Return the places and the checksums of all bytes before each."""
    view, sums = memoryview(content), [(0, 0)]
    for start, end in pairwise(ends):
        sums.append((end, zlib.crc32(view[start:end], sums[-1][1])))
    return sums
