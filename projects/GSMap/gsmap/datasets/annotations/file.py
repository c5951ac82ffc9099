"""Annotation files: one memory-mapped Arrow file per split, without pickle.

They are made once by a command and never cached silently; a reader refuses a file made for
something else, and one that is damaged.
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
from gsmap.utils.faults import is_of_the_machine
from gsmap.utils.files import atomic_write
from gsmap.utils.inputs import heed_input
from gsmap.utils.shards import WHOLE, Shard, ShardFile

SHARD_KIND = "annotations"
_ROWS_PER_BATCH = 256
_WORDS = ("dataset", "frame", "split", "command", "source_fingerprint")  # of the metadata


class AnnotationWriter:
    """Write an annotation file that appears only when it is whole.

    A context manager: the file takes its name when the block ends well, and is removed when it ends
    with an exception.

    Args:
        path: File to write; parent folders are made.
        meta: What holds for the whole file.
        shard: Part of the file to write; it gets a manifest.
        source: Digest of what the whole is made from, for the manifest; by default that of
            ``meta``.
    """

    def __init__(
        self, path: str | Path, meta: AnnotationMeta, shard: Shard = WHOLE, source: str = ""
    ):
        self.path = shard.path_of(Path(path))
        self.meta = meta
        self._seal = partial(
            shard.seal, Path(path), SHARD_KIND, source or meta.source_fingerprint, asdict(meta)
        )
        self._schema = schema_of(meta)
        self._opened = ExitStack()
        self._rows: list[dict[str, Any]] = []
        self._tokens: set[str] = set()
        self._finished = False

    def __enter__(self) -> "AnnotationWriter":
        self._file = self._opened.enter_context(atomic_write(self.path, "wb"))
        self._writer = pa.ipc.new_file(self._file, self._schema)
        return self

    def __len__(self) -> int:
        return len(self._tokens)

    def write(self, sample: MapSample) -> None:
        """Append a sample.

        Raises:
            ValueError: If a shape is wrong or its token was already written. A wrong value
                (``check_batch``) may be noticed some samples later, or when the file is finished.
        """
        if sample.token in self._tokens:
            raise InputError(f"sample {sample.token!r} was already written to {self.path}.")
        self._tokens.add(sample.token)
        self._rows.append(row_of(sample, self.meta))
        if len(self._rows) == _ROWS_PER_BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            batch = batch_of(self._rows, self._schema)
            check_batch(batch, self.meta)
            self._writer.write_batch(batch)
            self._rows.clear()

    def finish(self) -> None:
        """Write all that is left to the disk, under the provisional name.

        Several files appear together if each is finished before the first block ends.
        """
        if self._finished:
            return
        self._flush()
        self._file.flush()
        content = pa.memory_map(self._file.name).read_buffer()
        seal = {"rows": len(self), "bytes": content.size, "crc32": zlib.crc32(content)}
        self._writer.write_batch(
            batch_of([], self._schema), custom_metadata={SEAL_KEY: json.dumps(seal)}
        )
        self._writer.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._finished = True

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._opened:
            if error is not None:
                raise error
            self.finish()
        self._seal(len(self))


def write_annotations(
    path: str | Path,
    meta: AnnotationMeta,
    samples: Iterable[MapSample],
    shard: Shard = WHOLE,
    source: str = "",
) -> int:
    """Write an annotation file from samples, and return how many it has.

    Args:
        path: File to write; parent folders are made.
        meta: What holds for the whole file.
        samples: The samples, taken one by one.
        shard: Part of the file that the samples are; it gets a manifest.
        source: Digest of what the whole is made from; by default that of ``meta``.

    Raises:
        ValueError: If a sample is malformed; then no file is left behind.
    """
    with AnnotationWriter(path, meta, shard, source) as writer:
        for sample in samples:
            writer.write(sample)
        return len(writer)


def merge_annotations(path: Path, shards: Sequence[ShardFile]) -> int:
    """Write an annotation file from all its shards (``find_shards``), and count its samples.

    It is byte for byte as if it had been made at once.

    Raises:
        ValueError: If it has no sample, or one twice.
    """
    files = [AnnotationFile(shard.path) for shard in shards]
    if not any(map(len, files)):
        raise InputError(f"no shard of {path} has a sample: give the command other data.")
    return write_annotations(path, files[0].meta, chain.from_iterable(files))


def check_samples(samples: Sequence[MapSample], meta: AnnotationMeta) -> None:
    """Check samples that come from elsewhere as those of an annotation file are.

    Raises:
        ValueError: If a shape or value is wrong; the message names the sample.
    """
    batch = batch_of([row_of(sample, meta) for sample in samples], schema_of(meta))
    check_batch(batch, meta)


class AnnotationFile(Sequence[MapSample]):
    """Read a memory-mapped annotation file, which is checked from end to end when it is opened.

    Pickling hands on the path and the checksums of the batches, so that each worker process maps
    the same pages. There, and in all processes after anything has written to the file, a batch is
    compared with its checksum when it is next read.

    Raises:
        FileNotFoundError: If it does not exist.
        ValueError: If it is not a whole annotation file of this format version, its checksum does
            not fit, or a value is out of its domain (``check_batch``); when reading, if the file
            is not the one that was checked any more.
    """

    sealed: bool
    """Whether the file has a checksum; those of earlier versions have none."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._open()

    def _open(self, sums: list[tuple[int, int]] | None = None) -> None:
        """Map the file; check it unless its ``_sums`` are known from another process."""
        if not self.path.is_file():
            raise FileNotFoundError(
                f"no annotation file at {self.path}: make it with tools/create_data.py (see "
                "docs/data.md)."
            )
        try:
            heed_input(self.path)
            self._map = pa.memory_map(str(self.path))
            self._state = self._current_state()
            self._content = self._map.read_buffer()
            schema, self._batches, seal, ends = read_messages(self._content)
            self.meta = _meta_of(schema)
        except (pa.ArrowException, OSError, ValueError, TypeError) as error:
            if is_of_the_machine(error):
                raise
            raise InputError(
                f"{self.path} is not a whole annotation file ({error}): delete it and run "
                "tools/create_data.py again."
            ) from error
        self.sealed = seal is not None
        try:
            # Where each message ends, and the checksum of all bytes up to there.
            self._sums = sums or checksums(self._content, ends)
            self._intact = set() if sums else set(range(len(self._batches)))
            if sums is None:
                self._check(seal)
            elif [end for end, _ in sums] != ends:
                raise InputError("it was replaced after this run had opened it")
        except (pa.ArrowException, ValueError, TypeError, KeyError) as error:
            if is_of_the_machine(error):
                raise
            text = str(error).rstrip(".")
            raise InputError(
                f"{self.path} is damaged: {text}. Copy it again, or {self.remedy}"
            ) from error
        self._decoders = [decoder_of(b.to_struct_array(), self.meta.dim) for b in self._batches]
        self._starts = np.cumsum([0, *map(len, self._batches)])

    def _check(self, seal: bytes | None) -> None:
        """Raise an error unless a file's bytes, rows and values are those that were written."""
        if seal is not None:
            stated = json.loads(seal)
            found = dict(self._sums).get(stated["bytes"])
            if found != stated["crc32"] or sum(map(len, self._batches)) != stated["rows"]:
                raise InputError("its checksum does not fit its content")
        for batch in self._batches:
            batch.validate(full=True)
            check_batch(batch, self.meta)
        tokens = pa.chunked_array([batch.column("token") for batch in self._batches], pa.string())
        if pc.count_distinct(tokens).as_py() < len(tokens):
            raise InputError("two samples have one token")

    def _current_state(self) -> tuple[int, int, int]:
        """Return what differs after a write to the file: its size and time; and the process."""
        status = os.fstat(self._map.fileno())
        return status.st_size, status.st_mtime_ns, os.getpid()

    def _require_intact(self, number: int) -> None:
        """Raise an error unless a batch still is what was checked when the file was opened.

        A look at size and time goes first: memory beyond a file's end must not be touched.
        """
        state = self._current_state()
        if state != self._state:
            self._state, self._intact = state, set()
        if number in self._intact:
            return
        if state[0] == self._content.size:
            (start, before), (end, after) = self._sums[number + 1 : number + 3]
            if zlib.crc32(memoryview(self._content)[start:end], before) == after:
                self._intact.add(number)
                return
        raise InputError(
            f"{self.path} was changed while it was in use: end what writes there, {self.remedy} "
            "Then go on from the last checkpoint."
        )

    @property
    def batches(self) -> list[pa.RecordBatch]:
        """The samples as Arrow has them."""
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
        """What to run to make the file again."""
        return f"make it again with `{self.meta.command or 'python tools/create_data.py --help'}`."

    def require(self, **expected: Any) -> None:
        """Refuse a file whose ``AnnotationMeta`` has other values than expected; None is any.

        Raises:
            ValueError: If a value differs; the message names it and says what to run.
        """
        for name, wanted in expected.items():
            found = getattr(self.meta, name)
            wanted = tuple(wanted) if isinstance(wanted, list) else wanted
            if wanted is not None and wanted != found:
                raise InputError(
                    f"{self.path} was made with {name} {found}, the config asks for {wanted}: "
                    "change the config, or make the file for it. It was made with "
                    f"`{self.meta.command or 'an unknown command'}`; `python tools/create_data.py "
                    "--help` lists the options."
                )

    def require_rate(self, wanted_hz: float) -> None:
        """Refuse a file whose samples follow one another at another rate.

        Args:
            wanted_hz: Samples per second; the median of all drives may differ by a fifth.

        Raises:
            ValueError: If it differs by more; the message says what to run.
        """
        scenes = np.unique(np.array(self.column("scene"), dtype=str), return_inverse=True)[1]
        order = np.lexsort((self.seconds_into_scene, scenes))
        same, steps = (np.diff(np.asarray(v)[order]) for v in (scenes, self.seconds_into_scene))
        steps = steps[same == 0]
        if not len(steps) or 0.8 < (ratio := np.median(steps) * wanted_hz) < 1.25:
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
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        self._require_intact(number)
        return self._decoders[number](index - int(self._starts[number]))

    def column(self, name: str) -> list[Any]:
        """Return ``token``, ``scene``, ``map_name`` or ``timestamp_ns`` of all samples."""
        return [value for batch in self.batches for value in batch.column(name).to_pylist()]

    @cached_property
    def seconds_into_scene(self) -> list[float]:
        """Each sample's time since the first of its scene, in seconds."""
        scenes, times = self.column("scene"), self.column("timestamp_ns")
        start: dict[str, int] = {}
        for scene, time in zip(scenes, times, strict=True):
            start[scene] = min(time, start.get(scene, time))
        return [(t - start[scene]) / 1e9 for scene, t in zip(scenes, times, strict=True)]

    def instance_counts(self) -> np.ndarray:
        """Return each sample's number of map elements, -1 if not known. (samples,)."""
        counts = (pc.list_value_length(batch.column("instances")) for batch in self.batches)
        known = [count.fill_null(-1).to_numpy() for count in counts]
        return np.concatenate([np.empty(0, np.int64), *known])


def _meta_of(schema: pa.Schema) -> AnnotationMeta:
    """Read the metadata of a file, which tell whether it is an annotation file of this version."""
    values = json.loads((schema.metadata or {}).get(META_KEY, b"null"))
    if not isinstance(values, dict):
        raise InputError("it holds Arrow's data, but it is not an annotation file")
    found, command = values.get("format_version"), values.get("command")
    if found != FORMAT_VERSION or not schema.equals(pa.schema(FIELDS)):
        raise InputError(
            f"it has format version {found} or other columns than version {FORMAT_VERSION}, which "
            f"this program reads: make it again with `{command or 'tools/create_data.py'}`"
        )
    _require_plain(values)
    return AnnotationMeta(**values)


def _require_plain(values: dict[str, Any]) -> None:
    """Refuse words of a file's metadata that no terminal, picture or map could hold."""
    classes = values.get("classes")
    words = {name: values.get(name) for name in _WORDS}
    if isinstance(classes, list):
        words |= {f"class {number}": name for number, name in enumerate(classes)}
    for name, word in words.items():
        if word is not None and not (isinstance(word, str) and word.isprintable()):
            raise InputError(f"its {name} must be plain text, got {word!a:.80}")
