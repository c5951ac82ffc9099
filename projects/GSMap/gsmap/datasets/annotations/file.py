"""Reader and writer of annotation files, memory-mapped Arrow files with the samples of a split.

A command creates the file once; there is no hidden cache. The reader raises an error if a file is
damaged or has unexpected metadata. Files contain no pickled objects.
"""

import json
import os
import zlib
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gsmap.datasets.annotations.checks import check_batch
from gsmap.datasets.annotations.messages import SEAL_KEY, checksums, read_messages
from gsmap.datasets.annotations.record import FORMAT_VERSION, AnnotationMeta, MapSample
from gsmap.datasets.annotations.schema import (
    FIELDS,
    META_KEY,
    batch_of,
    decoder_of,
    row_of,
    schema_of,
)
from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_machine_error
from gsmap.utils.files import atomic_write
from gsmap.utils.inputs import check_input
from gsmap.utils.shards import WHOLE, Shard, ShardFile

SHARD_KIND = "annotations"
_ROWS_PER_BATCH = 256
# Fields of the metadata whose values are texts.
_TEXTS = ("dataset", "frame", "split", "command", "source_fingerprint")


class AnnotationWriter:
    """Writer of an annotation file that appears only when it is complete.

    The writer is a context manager. The file gets its name at the end of the block, and is removed
    if the block raises an exception.

    Args:
        path: File to write; parent folders are created.
        meta: Metadata of the file.
        shard: Part of the file to write; by default the whole file. A part gets a manifest, a file
            by which the parts are merged.
        source: Digest of the source data of the whole file, for the manifest; by default
            ``source_fingerprint`` of ``meta``.
    """

    def __init__(
        self, path: str | Path, meta: AnnotationMeta, shard: Shard = WHOLE, source: str = ""
    ):
        self.path = shard.path_of(Path(path))
        # Refuses to replace another program's file that has the name of a shard.
        shard.require_own(Path(path), mark=META_KEY)
        self.meta = meta
        # Called once the file is complete. For the whole file it writes nothing.
        self._write_manifest = partial(
            shard.write_manifest,
            Path(path),
            kind=SHARD_KIND,
            source=source or meta.source_fingerprint,
            options=asdict(meta),
        )
        self._schema = schema_of(meta)
        self._resources = ExitStack()  # the open file, from `__enter__` to `__exit__`
        self._rows: list[dict[str, Any]] = []
        self._tokens: set[str] = set()
        self._finished = False

    def __enter__(self) -> "AnnotationWriter":
        self._file = self._resources.enter_context(atomic_write(self.path, mode="wb"))
        self._writer = pa.ipc.new_file(self._file, self._schema)
        return self

    def __len__(self) -> int:
        return len(self._tokens)

    def write(self, sample: MapSample) -> None:
        """Append a sample.

        Values are checked in batches (see ``check_batch``), so a wrong value may raise an error in
        the call for a later sample or in `finish`.

        Args:
            sample: Sample with a token that is not in the file.

        Raises:
            ValueError: If a shape or a value is wrong, or the file already has the token.
        """
        if sample.token in self._tokens:
            raise InputError(f"sample {sample.token!r} was already written to {self.path}.")
        self._tokens.add(sample.token)
        self._rows.append(row_of(sample, self.meta))  # also checks the shapes
        if len(self._rows) == _ROWS_PER_BATCH:
            self._flush()

    def _flush(self) -> None:
        """Check and write the rows in memory."""
        if self._rows:
            batch = batch_of(self._rows, self._schema)
            check_batch(batch, self.meta)
            self._writer.write_batch(batch)
            self._rows.clear()

    def finish(self) -> None:
        """Write all remaining samples and the seal to the disk, under the temporary name.

        The seal is the metadata of an empty last batch: the number of samples, and the size and
        the checksum of all bytes before this batch.

        To make several files appear together, finish all of them before any of their ``with``
        blocks ends.

        Raises:
            ValueError: If a value is wrong.
        """
        if self._finished:
            return
        self._flush()
        self._file.flush()
        content = pa.memory_map(self._file.name).read_buffer()
        seal = {"rows": len(self), "bytes": content.size, "crc32": zlib.crc32(content)}
        empty_batch = batch_of([], self._schema)
        self._writer.write_batch(empty_batch, custom_metadata={SEAL_KEY: json.dumps(seal)})
        self._writer.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._finished = True

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._resources:
            if error is not None:
                raise error  # leaving the resources with an error removes the temporary file
            self.finish()
        self._write_manifest(samples=len(self))


def write_annotations(
    path: str | Path,
    meta: AnnotationMeta,
    samples: Iterable[MapSample],
    shard: Shard = WHOLE,
    source: str = "",
) -> int:
    """Write an annotation file.

    Args:
        path: File to write; parent folders are created.
        meta: Metadata of the file.
        samples: Samples, which are read one by one.
        shard: Part of the file with these samples, which gets a manifest; by default the whole
            file.
        source: Digest of the source data of the whole file, for the manifest; by default
            ``source_fingerprint`` of ``meta``.

    Returns:
        Number of samples.

    Raises:
        ValueError: If a sample is malformed. In this case, no file is written.
    """
    with AnnotationWriter(path, meta, shard=shard, source=source) as writer:
        for sample in samples:
            writer.write(sample)
        return len(writer)


def merge_annotations(path: Path, shards: Sequence[ShardFile]) -> int:
    """Write an annotation file from the samples of all shards.

    The file is equal, byte for byte, to a file that was written without shards.

    Args:
        path: File to write; parent folders are created.
        shards: All shards in order, from ``find_shards``.

    Returns:
        Number of samples.

    Raises:
        ValueError: If there is no sample, or if two samples have the same token.
    """
    files = [AnnotationFile(shard.path) for shard in shards]
    if not any(map(len, files)):
        raise InputError(f"no shard of {path} has a sample: give the command other data.")
    samples = chain.from_iterable(files)
    return write_annotations(path, meta=files[0].meta, samples=samples)


def check_samples(samples: Sequence[MapSample], meta: AnnotationMeta) -> None:
    """Check samples of any origin with the rules for annotation files.

    Args:
        samples: Samples.
        meta: Metadata with the annotation frame and the classes of the samples.

    Raises:
        ValueError: If a shape or a value is wrong. The message names the sample.
    """
    rows = [row_of(sample, meta) for sample in samples]
    batch = batch_of(rows, schema_of(meta))
    check_batch(batch, meta)


class AnnotationFile(Sequence[MapSample]):
    """Sequence of the samples in a memory-mapped annotation file.

    The whole file is checked when it is opened. A pickled instance contains only the path and the
    checksums of the batches. Each worker process maps the file, and the processes share its pages
    in memory. In an unpickled instance, and after a change of the file, each batch is compared with
    its checksum before it is read.

    Args:
        path: Annotation file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not a complete annotation file of this format version, the
            checksum is wrong, or a value is out of its domain (see ``check_batch``). Also when a
            sample is read, if the file has changed since it was opened.
    """

    sealed: bool
    """Whether the file has a checksum, unlike files of earlier versions."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._open()

    def _open(self, sums: list[tuple[int, int]] | None = None) -> None:
        """Map and read the file, and check it.

        ``sums`` are the checksums of the process that pickled this instance. If they are given,
        each batch is compared with its checksum when it is read. If not, the whole file is checked
        now.
        """
        if not self.path.is_file():
            raise FileNotFoundError(
                f"no annotation file at {self.path}: make it with tools/create_data.py (see "
                "docs/data.md)."
            )
        try:
            check_input(self.path)  # refuses pipes and outputs of the command
            self._map = pa.memory_map(str(self.path))
            self._state = self._current_state()
            self._content = self._map.read_buffer()
            schema, self._batches, seal, ends = read_messages(self._content)
            self.meta = _meta_of(schema)
        except (pa.ArrowException, OSError, ValueError, TypeError) as error:
            # A TypeError is raised for metadata with fields that `AnnotationMeta` does not have.
            if is_machine_error(error):
                raise
            raise InputError(
                f"{self.path} is not a whole annotation file ({error}): delete it and run "
                "tools/create_data.py again."
            ) from error
        self.sealed = seal is not None
        try:
            # End of each message in bytes, and checksum of all bytes before it.
            self._sums = sums or checksums(self._content, ends)
            # Indices of the batches that have been checked since the last change of the file.
            self._intact_batches = set() if sums else set(range(len(self._batches)))
            if sums is None:
                self._check_content(seal)
            elif [end for end, _ in sums] != ends:
                raise InputError("it was replaced after this run had opened it")
        except (pa.ArrowException, ValueError, TypeError, KeyError) as error:
            # A TypeError or KeyError is raised for a seal that is not an object with all entries.
            if is_machine_error(error):
                raise
            reason = str(error).rstrip(".")
            raise InputError(
                f"{self.path} is damaged: {reason}. Copy it again, or {self.remedy}"
            ) from error
        self._decoders = []
        for batch in self._batches:
            self._decoders.append(decoder_of(batch.to_struct_array(), dim=self.meta.dim))
        # Index of the first sample of each batch; the last entry is the number of all samples.
        self._starts = np.cumsum([0, *map(len, self._batches)])

    def _check_content(self, seal: bytes | None) -> None:
        """Raise an error if the file does not match the seal, or a value is wrong."""
        if seal is not None:
            expected = json.loads(seal)  # entries rows, bytes and crc32, from `AnnotationWriter`
            checksum_up_to = dict(self._sums)
            checksum = checksum_up_to.get(expected["bytes"])
            num_rows = sum(map(len, self._batches))
            if checksum != expected["crc32"] or num_rows != expected["rows"]:
                raise InputError("its checksum does not fit its content")
        for batch in self._batches:
            batch.validate(full=True)
            check_batch(batch, self.meta)
        columns = [batch.column("token") for batch in self._batches]
        tokens = pa.chunked_array(columns, type=pa.string())
        if pc.count_distinct(tokens).as_py() < len(tokens):
            raise InputError("two samples have one token")

    def _current_state(self) -> tuple[int, int, int]:
        """Return size and time of the file, and the process id.

        Size and time of modification change when the file is written. In a forked process, the
        process id differs, so this process compares each batch with its checksum again.
        """
        status = os.fstat(self._map.fileno())
        return status.st_size, status.st_mtime_ns, os.getpid()

    def _require_intact(self, number: int) -> None:
        """Raise an error if the batch with this index has changed since the file was opened.

        The size of the file is compared first: reading mapped memory beyond the end of a file ends
        the process.
        """
        state = self._current_state()
        if state != self._state:
            self._state = state
            self._intact_batches = set()
        if number in self._intact_batches:
            return
        size = state[0]
        if size == self._content.size:
            # Entry 0 of the checksums is the start of the file, and entry 1 the end of the schema,
            # where the first batch starts.
            start, previous_checksum = self._sums[number + 1]
            end, checksum = self._sums[number + 2]
            content = memoryview(self._content)[start:end]
            if zlib.crc32(content, previous_checksum) == checksum:
                self._intact_batches.add(number)
                return
        raise InputError(
            f"{self.path} was changed while it was in use: stop the program that writes to it, and "
            f"{self.remedy} Then go on from the last checkpoint."
        )

    @property
    def batches(self) -> list[pa.RecordBatch]:
        """Samples as Arrow record batches, which are compared with their checksums if necessary."""
        for number in range(len(self._batches)):
            self._require_intact(number)
        return self._batches

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "sums": self._sums}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path = state["path"]
        self._open(state["sums"])

    @property
    def remedy(self) -> str:
        """Advice with the command that creates the file."""
        return f"make it again with `{self.meta.command or 'python tools/create_data.py --help'}`."

    def require(self, **expected: Any) -> None:
        """Check the metadata of the file.

        Args:
            expected: Expected values of fields of ``AnnotationMeta``; None for any value.

        Raises:
            ValueError: If a value differs. The message names the field and the remedy.
        """
        for name, wanted in expected.items():
            value = getattr(self.meta, name)
            if isinstance(wanted, list):  # the metadata have tuples in place of a config's lists
                wanted = tuple(wanted)
            if wanted is not None and wanted != value:
                raise InputError(
                    f"{self.path} was made with {name} {value}, the config asks for {wanted}: "
                    "change the config, or make the file for it. It was made with "
                    f"`{self.meta.command or 'an unknown command'}`; `python tools/create_data.py "
                    "--help` lists the options."
                )

    def require_rate(self, wanted_hz: float) -> None:
        """Check the number of samples per second of a drive.

        Args:
            wanted_hz: Expected samples per second. The median over all drives may differ by a
                factor of 0.8 to 1.25.

        Raises:
            ValueError: If the rate differs by more. The message names the remedy.
        """
        names = np.array(self.column("scene"), dtype=str)
        _, scenes = np.unique(names, return_inverse=True)
        seconds = np.asarray(self.seconds_into_scene)
        order = np.lexsort((seconds, scenes))  # by the last key, the scene, and then by time
        is_within_scene = np.diff(scenes[order]) == 0
        steps = np.diff(seconds[order])[is_within_scene]  # between successive samples of a scene
        if not len(steps):  # no scene has two samples
            return
        ratio = np.median(steps) * wanted_hz  # wanted rate divided by the rate of the file
        if 0.8 < ratio < 1.25:
            return
        raise InputError(
            f"{self.path} has {wanted_hz / ratio:.3g} samples per second of a drive, the config "
            f"asks for {wanted_hz:g}: make it again with `--rate {wanted_hz:g}hz`, or set "
            "train_dataloader.dataset.rate_hz=None if epochs may have another length. It was made "
            f"with `{self.meta.command or 'an unknown command'}`."
        )

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> MapSample:  # type: ignore[override]
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)} in {self.path}.")
        index %= len(self)
        # The batch of a sample is the last one that does not start after it.
        batch_index = int(np.searchsorted(self._starts, index, side="right")) - 1
        self._require_intact(batch_index)
        decode = self._decoders[batch_index]
        return decode(index - int(self._starts[batch_index]))

    def column(self, name: str) -> list[Any]:
        """Return ``token``, ``scene``, ``map_name`` or ``timestamp_ns`` of all samples."""
        values = []
        for batch in self.batches:
            values += batch.column(name).to_pylist()
        return values

    @cached_property
    def seconds_into_scene(self) -> list[float]:
        """Time of each sample since the first sample of the scene, in seconds."""
        scenes = self.column("scene")
        times_ns = self.column("timestamp_ns")
        starts_ns: dict[str, int] = {}
        for scene, time_ns in zip(scenes, times_ns, strict=True):
            starts_ns[scene] = min(time_ns, starts_ns.get(scene, time_ns))
        seconds = []
        for scene, time_ns in zip(scenes, times_ns, strict=True):
            seconds.append((time_ns - starts_ns[scene]) / 1e9)
        return seconds

    @cached_property
    def _time_order(self) -> tuple[np.ndarray, np.ndarray]:
        """Scene of each row as a number, and the rows in the order of their scenes and times."""
        numbers: dict[str, int] = {}
        scenes = np.array([numbers.setdefault(s, len(numbers)) for s in self.column("scene")])
        return scenes, np.lexsort((self.column("timestamp_ns"), scenes))

    @cached_property
    def _time_places(self) -> np.ndarray:
        """Place of each row in the order of scenes and times."""
        _, order = self._time_order
        return np.argsort(order)

    def neighbours_in_scene(self, row: int) -> list[int]:
        """Return the rows of the samples before and after a sample of the same scene.

        The first and the last sample of a scene have one neighbour, a single sample has none.
        """
        scenes, order = self._time_order
        place = int(self._time_places[row])
        rows = []
        for other_place in (place - 1, place + 1):
            if 0 <= other_place < len(order) and scenes[order[other_place]] == scenes[row]:
                rows.append(int(order[other_place]))
        return rows

    def has_signals(self) -> bool:
        """Test whether any sample has vehicle signals (``can_bus``)."""
        return any(batch.column("can_bus").null_count < len(batch) for batch in self.batches)

    def instance_counts(self) -> np.ndarray:
        """Return the number of map elements of each sample, -1 without ground truth. (samples,)"""
        counts = [np.empty(0, dtype=np.int64)]  # the result for a file without batches
        for batch in self.batches:
            lengths = pc.list_value_length(batch.column("instances"))
            counts.append(lengths.fill_null(-1).to_numpy())
        return np.concatenate(counts)


def _meta_of(schema: pa.Schema) -> AnnotationMeta:
    """Read and check the metadata and the format version of a file."""
    metadata = schema.metadata or {}
    values = json.loads(metadata.get(META_KEY, b"null"))
    if not isinstance(values, dict):
        raise InputError("it holds Arrow's data, but it is not an annotation file")
    version = values.get("format_version")
    # `equals` compares the names and types of the columns, but not the metadata.
    if version != FORMAT_VERSION or not schema.equals(pa.schema(FIELDS)):
        command = values.get("command") or "tools/create_data.py"
        raise InputError(
            f"it has format version {version} or other columns than version {FORMAT_VERSION}, "
            f"which this program reads: make it again with `{command}`"
        )
    _require_printable(values)
    return AnnotationMeta(**values)


def _require_printable(values: dict[str, Any]) -> None:
    """Raise an error for texts in the metadata that are not printable, as messages contain them."""
    texts = {name: values.get(name) for name in _TEXTS}
    classes = values.get("classes")
    if isinstance(classes, list):
        for number, name in enumerate(classes):
            texts[f"class {number}"] = name
    for name, text in texts.items():
        if text is not None and not (isinstance(text, str) and text.isprintable()):
            raise InputError(f"its {name} must be plain text, got {text!a:.80}")
