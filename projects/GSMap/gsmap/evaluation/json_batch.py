"""Parse many samples of a JSON file at once, without a Python object per number.

Arrow's parser reads the common form; whatever it does not take goes to ``json``, whose errors name
the sample.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.json

from gsmap.structures.elements import MapElements

_VECTOR = {"pts": pa.list_(pa.list_(pa.float64())), "cls_name": pa.string()}


def _schema(scored: bool) -> pa.Schema:
    fields = {**_VECTOR, "confidence_level": pa.float64()} if scored else _VECTOR
    vectors = pa.list_(pa.struct(list(fields.items())))
    return pa.schema({"sample_token": pa.string(), "vectors": vectors})


def parse_batch(
    pieces: Sequence[bytes], tokens: Sequence[str], labels: dict[str, int], scored: bool
) -> list[tuple[MapElements, bool]] | None:
    """Parse the samples of a result or ground-truth file.

    Args:
        pieces: The text of each sample. (B,)
        tokens: Their expected tokens. (B,)
        labels: Label of each class name; other classes get -1.
        scored: Whether the vectors have a confidence.

    Returns:
        Elements of each sample and whether they had a z; None if the samples are not of the common
        form, or malformed.
    """
    text = b"\n".join(pieces)
    try:
        table = pyarrow.json.read_json(
            pa.BufferReader(text),
            pyarrow.json.ReadOptions(use_threads=False, block_size=len(text) + 1),
            pyarrow.json.ParseOptions(
                explicit_schema=_schema(scored),
                newlines_in_values=True,
                unexpected_field_behavior="ignore",
            ),
        )
    except pa.ArrowInvalid:
        return None
    if table.column("sample_token").to_pylist() != list(tokens):
        return None
    return _elements(table.column("vectors").combine_chunks(), labels, scored)


def _values(array: pa.Array, dtype: type[np.generic]) -> npt.NDArray[Any]:
    """View the numbers of an Arrow array; its own ``to_numpy`` would load pandas."""
    stored = array.buffers()[1]
    if stored is None or not len(array):
        return np.zeros(0, dtype)
    offset = array.offset * np.dtype(dtype).itemsize
    return np.frombuffer(stored, dtype, count=len(array), offset=offset)


def _elements(
    vectors: pa.ListArray, labels: dict[str, int], scored: bool
) -> list[tuple[MapElements, bool]] | None:
    """Cut the flat columns of the vectors into samples."""
    flat = vectors.values
    columns = [flat.field(name) for name in _VECTOR]
    points = columns[0].values
    if scored:
        columns.append(flat.field("confidence_level"))
    if any(column.null_count for column in (vectors, flat, points, points.values, *columns)):
        return None
    dims = np.diff(_values(points.offsets, np.int32))
    dim = int(dims[0]) if len(dims) else 2
    if dim not in (2, 3) or (dims != dim).any():
        return None
    xy = _values(points.values, np.float64).reshape(-1, dim)[:, :2]
    names = columns[1].to_pylist()
    label = np.array([labels.get(name, -1) for name in names], dtype=np.int64)
    score = _values(columns[2], np.float64) if scored else np.ones(len(label))
    if not (np.isfinite(xy).all() and np.isfinite(score).all()):
        return None
    xy = np.array(xy)  # contiguous, and writable: compiled code is then loaded for one type
    starts = _values(columns[0].offsets, np.int32).astype(np.int64)
    found = []
    bounds = _values(vectors.offsets, np.int32)
    for first, last in pairwise(bounds):
        begin = starts[first]
        elements = MapElements(
            xy[begin : starts[last]],
            starts[first : last + 1] - begin,
            label[first:last],
            score[first:last],
        )
        found.append((elements, dim == 3))
    return found
