"""Messages of an Arrow file and their checksums.

An Arrow file is a stream of messages between the bytes "ARROW1" and a footer with the positions of
the messages. The first message is the schema. Each further message is a batch, a part of the rows
of the table. The last message of a complete annotation file is the seal: a batch without rows that
has a checksum of the file in its metadata.
"""

import zlib
from collections.abc import Sequence
from itertools import pairwise

import pyarrow as pa

from gsmap.utils.errors import InputError

_START = b"ARROW1\0\0"  # two zeros pad the name to 8 bytes
_END = b"ARROW1"
_SIZE_BYTES = 4  # size of the footer as an integer, between the footer and ``_END``
_TAIL_BYTES = _SIZE_BYTES + len(_END)
SEAL_KEY = b"gsmap_seal"
"""Key of the seal in the metadata of a message.

The seal is JSON with the number of rows of the file, and the size in bytes and the checksum of the
part of the file before the seal.
"""


def read_messages(
    content: pa.Buffer,
) -> tuple[pa.Schema, list[pa.RecordBatch], bytes | None, list[int]]:
    """Read the messages of an Arrow file.

    Args:
        content: Content of the file.

    Returns:
        Four values: the schema, the batches without the seal, the seal (JSON, see ``SEAL_KEY``) or
        None for a file without one, and positions in bytes in ascending order. The positions are
        0, the end of the schema and the end of each batch.

    Raises:
        ValueError: If the content does not begin or end like an Arrow file, or has a batch without
            rows that is not a seal. The caller adds the name of the file to the error.
    """
    size = content.size
    if size < len(_START) + _TAIL_BYTES or content[: len(_START)].to_pybytes() != _START:
        raise InputError("it does not begin as an Arrow file")
    source = pa.BufferReader(content)
    source.seek(len(_START))
    reader = pa.ipc.open_stream(source)
    ends = [0, source.tell()]
    batches = []
    seal = None
    for message in reader.iter_batches_with_custom_metadata():
        ends.append(source.tell())
        batches.append(message.batch)
        # Each message replaces the value, so a seal only counts in the last message.
        seal = (message.custom_metadata or {}).get(SEAL_KEY)
    # The bytes behind the messages: the footer, its size, and ``_END``.
    ending = content[source.tell() :].to_pybytes()
    size_field = ending[-_TAIL_BYTES : -len(_END)]
    footer_size = int.from_bytes(size_field, byteorder="little")
    if not ending.endswith(_END) or footer_size != len(ending) - _TAIL_BYTES:
        raise InputError("it ends too early")
    if seal is not None:  # the last message is the seal, which has no rows
        batches.pop()
        ends.pop()
    if any(len(batch) == 0 for batch in batches):
        # For example, a seal whose key is damaged is not recognised as one.
        raise InputError("it has an empty part")
    return reader.schema, batches, seal, ends


def checksums(content: pa.Buffer, ends: Sequence[int]) -> list[tuple[int, int]]:
    """Compute the checksum of all bytes before each position.

    With these checksums, another process can check each batch when it reads the batch.

    Args:
        content: Content of the file.
        ends: Positions of `read_messages`, in bytes in ascending order; the first is 0.

    Returns:
        Each position, with the CRC-32 of all bytes before it.
    """
    view = memoryview(content)
    checksum = 0
    sums = [(0, checksum)]
    for start, end in pairwise(ends):
        checksum = zlib.crc32(view[start:end], checksum)  # continues the previous checksum
        sums.append((end, checksum))
    return sums
