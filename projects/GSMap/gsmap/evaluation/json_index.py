"""Find the samples of a large JSON file without parsing it, so that they are parsed one by one.

A file of 6,000 samples takes half a gigabyte as Python objects; read through this index it takes a
few megabytes, and several processes share the parsing.
"""

import json
import mmap
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from gsmap.structures.elements import IntArray

_FIRST = re.compile(rb'\{\s*"sample_token"\s*:')
_NEXT = re.compile(rb'\}\s*,\s*(\{)\s*"sample_token"\s*:')
_TOKEN = re.compile(rb'"sample_token"\s*:\s*("(?:[^"\\]|\\.)*")')
_QUOTE, _BACKSLASH = ord('"'), ord("\\")
_PLAIN, _STRING, _OBJECT, _LIST, _END, _BETWEEN = range(6)  # what a byte begins
_KIND = np.zeros(256, dtype=np.uint8)
_KIND[[ord(c) for c in '"{[]}: \n\r\t']] = [
    *(_STRING, _OBJECT, _LIST, _END, _END),
    *(_BETWEEN,) * 5,
]


@njit(cache=True)
def _string_end(data: npt.NDArray[np.uint8], start: int) -> int:
    """Return the position of the quote that closes the string which opens at ``start``."""
    position, size = start + 1, len(data)
    while position < size and data[position] != _QUOTE:
        position += 2 if data[position] == _BACKSLASH else 1
    return position


@njit(cache=True)
def _item_spans(data: npt.NDArray[np.uint8], key: npt.NDArray[np.uint8]) -> IntArray:
    """Find the objects of the list that stands under a key of the outermost object.

    Args:
        data: The file.
        key: The key with its quotes.

    Returns:
        First byte and one past the last byte of each object; a row (-1, -1) if the key or its list
        is missing or does not end. (N, 2)
    """
    spans = np.empty((1024, 2), dtype=np.int64)
    count, depth, position, size = 0, 0, 0, len(data)
    matched = inside = ended = False  # the key was just read; its list is open; it was closed
    while position < size and not ended:
        kind = _KIND[data[position]]
        if kind == _PLAIN:
            matched = False
        elif kind == _STRING:
            string = data[position : _string_end(data, position) + 1]
            position += len(string) - 1
            matched = depth == 1 and len(string) == len(key) and bool((string == key).all())
        elif kind == _END:
            depth -= 1
            if inside and depth == 2:
                spans[count, 1] = position + 1
                count += 1
            ended = inside and depth == 1
        elif kind != _BETWEEN:
            inside = inside or (matched and depth == 1 and kind == _LIST)
            matched = False
            if inside and depth == 2:
                if count == len(spans):
                    spans = np.concatenate((spans, np.empty_like(spans)))
                spans[count, 0] = position
            depth += 1
        position += 1
    return spans[:count] if ended else np.full((1, 2), -1, dtype=np.int64)


def _quick_spans(data: mmap.mmap, key: str) -> IntArray | None:
    """Find the objects of a list by the key ``sample_token`` that each begins with.

    Ten times as fast as ``_item_spans``. In a string this key would have its quotes escaped, so
    that every find is the start of an object; that the objects are whole, and items of the list
    rather than parts of an item, shows when each of them is parsed.

    Args:
        data: The file.
        key: ``results`` or ``GTs``.

    Returns:
        As ``_item_spans``; None if the file is not laid out so. (N, 2)
    """
    first = _FIRST.search(data)
    if first is None:
        return None
    bounds = [(found.start() + 1, found.start(1)) for found in _NEXT.finditer(data, first.end())]
    starts = [first.start(), *(start for _, start in bounds)]
    try:
        head = json.loads(data[: starts[0]] + b"]}")  # ends in the empty list of the key, or fails
        rest = data[starts[-1] :].decode()
        end = json.JSONDecoder().raw_decode(rest)[1]
    except ValueError:
        return None
    if list(head.items())[-1:] != [(key, [])] or not rest[end:].lstrip().startswith("]"):
        return None
    stops = [*(stop for stop, _ in bounds), starts[-1] + len(rest[:end].encode())]
    return np.array([starts, stops], dtype=np.int64).T


class JsonSamples:
    """The samples of a result or ground-truth file, read on demand.

    Pickling hands on the path and the index, so that each worker process maps the same pages.

    Args:
        path: The file.
        key: ``results`` or ``GTs``.
        exact: Follow the file byte by byte. Otherwise samples are cut before each object that
            begins with ``sample_token``, if the file is laid out so: several times as fast, and
            right if every sample is parsed without an error afterwards.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If it has no list under the key, a sample has no token, or a token occurs twice.
    """

    def __init__(self, path: str | Path, key: str, exact: bool = True):
        self.path, self.key = Path(path), key
        self._open()
        spans = None if exact else _quick_spans(self._data, key)
        if spans is None:
            name = np.frombuffer(f'"{key}"'.encode(), dtype=np.uint8)
            spans = _item_spans(np.frombuffer(self._data, dtype=np.uint8), name)
        self._spans = spans
        if len(self._spans) and self._spans[0, 0] < 0:
            raise ValueError(
                f"{self.path} holds no complete list under {key!r}: expected "
                f'{{"{key}": [{{"sample_token": ..., "vectors": [...]}}, ...]}}.'
            )
        self.tokens = [self._token(start, stop) for start, stop in self._spans.tolist()]
        if len(set(self.tokens)) != len(self.tokens):
            twice = next(t for i, t in enumerate(self.tokens) if t in self.tokens[:i])
            raise ValueError(f"{self.path} holds sample {twice!r} more than once.")

    def _open(self) -> None:
        if not self.path.is_file():
            raise FileNotFoundError(f"no file at {self.path}.")
        if not self.path.stat().st_size:
            raise ValueError(f"{self.path} is empty.")
        with self.path.open("rb") as file:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "_data"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open()

    def __len__(self) -> int:
        return len(self.tokens)

    def _token(self, start: int, stop: int) -> str:
        found = _TOKEN.search(self._data, start, stop)
        if found is None:
            raise ValueError(f"{self.path}: a sample at byte {start} has no sample_token.")
        return str(json.loads(found.group(1)))

    def piece(self, index: int) -> bytes:
        """Return the text of one sample.

        Args:
            index: Position in ``tokens``.
        """
        start, stop = self._spans[index]
        return self._data[start:stop]

    def vectors(self, index: int) -> list[dict[str, Any]]:
        """Parse the vectors of one sample.

        Args:
            index: Position in ``tokens``.

        Raises:
            ValueError: If the sample is not valid JSON, or not of the expected form.
        """
        try:
            sample = json.loads(self.piece(index))
            vectors = sample["vectors"]
        except (json.JSONDecodeError, KeyError) as error:
            raise ValueError(f"{self.path}, sample {self.tokens[index]!r}: {error!r}.") from error
        if sample.get("sample_token") != self.tokens[index] or not isinstance(vectors, list):
            raise ValueError(
                f"{self.path}, sample {self.tokens[index]!r}: expected an object with sample_token "
                "and a list of vectors."
            )
        return vectors
