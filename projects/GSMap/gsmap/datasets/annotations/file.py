"""Annotation files: one memory-mapped Arrow file per split, without pickle.

They are made once by a command and never cached silently; a reader refuses a file made for
something else.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa

from gsmap.datasets.annotations.record import (
    CLASSES,
    FORMAT_VERSION,
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
    validate_sample,
)
from gsmap.datasets.annotations.schema import FIELDS, META_KEY, Batch, row_of, schema_of
from gsmap.utils.files import atomic_write

__all__ = [
    "CLASSES",
    "FORMAT_VERSION",
    "AnnotationFile",
    "AnnotationMeta",
    "AnnotationWriter",
    "CameraRecord",
    "LidarRecord",
    "MapInstance",
    "MapSample",
    "SweepRecord",
    "write_annotations",
]

_ROWS_PER_BATCH = 256


class AnnotationWriter:
    """Write an annotation file that appears only when it is whole.

    A context manager: the file takes its name when the block ends well, and is removed when it ends
    with an exception.

    Args:
        path: File to write; parent folders are made.
        meta: What holds for the whole file.
    """

    def __init__(self, path: str | Path, meta: AnnotationMeta):
        self.path = Path(path)
        self.meta = meta
        self._schema = schema_of(meta)
        self._opened = ExitStack()
        self._rows: list[dict[str, Any]] = []
        self._tokens: set[str] = set()

    def __enter__(self) -> "AnnotationWriter":
        file = self._opened.enter_context(atomic_write(self.path, "wb"))
        self._writer = pa.ipc.new_file(file, self._schema)
        return self

    def __len__(self) -> int:
        return len(self._tokens)

    def write(self, sample: MapSample) -> None:
        """Append a sample.

        Args:
            sample: The sample.

        Raises:
            ValueError: If it is malformed (``validate_sample``) or its token was already written.
        """
        validate_sample(sample, self.meta)
        if sample.token in self._tokens:
            raise ValueError(f"sample {sample.token!r} was already written to {self.path}.")
        self._tokens.add(sample.token)
        self._rows.append(row_of(sample))
        if len(self._rows) == _ROWS_PER_BATCH:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            columns = [
                pa.array([row[name] for row in self._rows], kind) for name, kind in FIELDS.items()
            ]
            self._writer.write_batch(pa.record_batch(columns, schema=self._schema))
            self._rows.clear()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._opened:
            if value is not None:
                raise value
            self._flush()
            self._writer.close()


def write_annotations(path: str | Path, meta: AnnotationMeta, samples: Iterable[MapSample]) -> int:
    """Write an annotation file from samples.

    Args:
        path: File to write.
        meta: What holds for the whole file.
        samples: Samples with different tokens.

    Returns:
        How many were written.

    Raises:
        ValueError: If a sample is malformed; then no file is left behind.
    """
    with AnnotationWriter(path, meta) as writer:
        for sample in samples:
            writer.write(sample)
        return len(writer)


class AnnotationFile(Sequence[MapSample]):
    """Read a memory-mapped annotation file; opening does not depend on its size.

    Pickling hands on the path alone, so that each worker process maps the same pages.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: If it does not exist.
        ValueError: If it is not a whole annotation file of this format version.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._open()

    def _open(self) -> None:
        if not self.path.is_file():
            raise FileNotFoundError(
                f"no annotation file at {self.path}: make it with tools/create_data.py (see "
                "docs/data.md)."
            )
        try:
            self._reader = pa.ipc.open_file(pa.memory_map(str(self.path)))
        except (pa.ArrowInvalid, OSError) as error:
            raise ValueError(
                f"{self.path} is not a whole annotation file ({error}): delete it and run "
                "tools/create_data.py again."
            ) from error
        self.meta = self._read_meta()
        if self._reader.schema.names != list(FIELDS):
            raise ValueError(
                f"{self.path} has other columns than format version {FORMAT_VERSION}: {self.remedy}"
            )
        self._batches: dict[int, Batch] = {}
        sizes = [self._reader.get_batch(i).num_rows for i in range(self._reader.num_record_batches)]
        self._starts = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])

    def _read_meta(self) -> AnnotationMeta:
        stored = (self._reader.schema.metadata or {}).get(META_KEY)
        if stored is None:
            raise ValueError(
                f"{self.path} is an Arrow file, but not an annotation file: run "
                "tools/create_data.py."
            )
        values = json.loads(stored)
        if values.get("format_version") != FORMAT_VERSION:
            raise ValueError(
                f"{self.path} has format version {values.get('format_version')}, this program "
                f"reads {FORMAT_VERSION}: make it again with "
                f"`{values.get('command') or 'tools/create_data.py'}`."
            )
        return AnnotationMeta(**values)

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.path = state["path"]
        self._open()

    @property
    def remedy(self) -> str:
        """What to run to make the file again."""
        return f"make it again with `{self.meta.command or 'python tools/create_data.py --help'}`."

    def require(self, **expected: Any) -> None:
        """Refuse a file made for something else.

        Args:
            **expected: Names of ``AnnotationMeta`` with the values that they must have; None is not
                checked.

        Raises:
            ValueError: If a value differs; the message names it and says what to run.
        """
        for name, wanted in expected.items():
            found = getattr(self.meta, name)
            wanted = tuple(wanted) if isinstance(wanted, list) else wanted
            if wanted is not None and wanted != found:
                raise ValueError(
                    f"{self.path} was made with {name} {found}, the config asks for {wanted}: "
                    "change the config, or make the file for it. It was made with "
                    f"`{self.meta.command or 'an unknown command'}`; `python tools/create_data.py "
                    "--help` lists the options."
                )

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> MapSample:  # type: ignore[override]
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)} in {self.path}.")
        index %= len(self)
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        if number not in self._batches:
            self._batches[number] = Batch(self._reader.get_batch(number), self.meta.dim)
        return self._batches[number].sample(index - int(self._starts[number]))

    def __iter__(self) -> Iterator[MapSample]:
        return (self[i] for i in range(len(self)))

    def column(self, name: str) -> list[Any]:
        """Return one plain column of all samples.

        Args:
            name: ``token``, ``scene``, ``map_name`` or ``timestamp_ns``.
        """
        return [
            v
            for i in range(len(self._starts) - 1)
            for v in self._reader.get_batch(i).column(name).to_pylist()
        ]

    def instance_counts(self) -> np.ndarray:
        """Return each sample's number of map elements, -1 if not known. (samples,)."""
        counts = [np.empty(0, np.int64)]
        for i in range(len(self._starts) - 1):
            column = self._reader.get_batch(i).column("instances")
            known = column.is_valid().to_numpy(zero_copy_only=False)
            counts.append(np.where(known, np.diff(column.offsets.to_numpy()), -1))
        return np.concatenate(counts)
