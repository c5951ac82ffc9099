"""The items of a long list in a JSON file, one after another."""

import json
import re
from codecs import BOM_UTF8, getincrementaldecoder
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from gsmap.utils.errors import InputError
from gsmap.utils.files import fetch_advice

Place = tuple[int, int]
"""Where an item begins, and its length, in bytes."""
_BLOCK = 1 << 20
_SHOWN = 5  # names in a message
_KINDS = {"{": "an object", "[": "a list", '"': "a text"}
_SPACE = re.compile(r"[ \t\n\r]*")
_DECODER = json.JSONDecoder()


def items_of(
    path: Path, key: str | None, advice: str, beside: dict[str, Any] | None = None
) -> Iterator[tuple[Any, Place]]:
    """Yield value and place of each item of a list.

    What is in memory does not grow with the list.

    Args:
        path: The file.
        key: Of the file's object, where the list is; None: the file is the list.
        advice: What to do if it is not, for the message.
        beside: Gets the values of the object that have the names in it, as they are found.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If it is no JSON, or has no list there; maybe only after some items.
    """
    with path.open("rb") as file:
        under = "" if key is None else f" under {key!r}"
        try:
            yield from _Text(file).items(key, beside or {})
        except _FormError as error:
            raise InputError(f"{path} holds {error} and no list{under}: {advice}.") from error
        except (ValueError, RecursionError) as error:
            file.seek(0)
            advice = fetch_advice(file.read(100), advice)
            raise InputError(
                f"{path} is empty or holds no complete list{under} ({error!r:.80}): {advice}."
            ) from error


class _FormError(ValueError):
    """There is JSON, but another value where the list should be."""


class _Text:
    """A part of a file's text, from which JSON is taken value by value."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._decode = file, getincrementaldecoder("utf-8")().decode
        self._text = ""
        self._at = 0  # where the next value begins, in the text
        self._byte = len(BOM_UTF8) if file.read(len(BOM_UTF8)) == BOM_UTF8 else 0  # in the file
        file.seek(self._byte)

    def items(self, key: str | None, beside: dict[str, Any]) -> Iterator[tuple[Any, Place]]:
        """Yield the items of the list under a key, and note the values of names in ``beside``."""
        found, names = False, []
        self._require("[" if key is None else "{", "")
        for _ in () if key is None else self._parts("{", "}"):
            if self._sign() != '"':
                raise self._error("no name")
            name, _ = self._value()
            self._take(":")
            if name != key:
                names.append(f"{name:.30}")
                value, _ = self._value()
                if name in beside:
                    beside[name] = value
                continue
            if found:
                raise self._error(f"a second {key!r}")
            self._require("[", f" under {key!r}")
            found = True
            yield from (self._value() for _ in self._parts("[", "]"))
        if key is None:
            yield from (self._value() for _ in self._parts("[", "]"))
        elif not found:
            raise _FormError(f"an object with {names[:_SHOWN] or 'nothing'}")
        if self._sign():
            raise self._error("more text")

    def _require(self, opening: str, where: str) -> None:
        """Refuse another value than the one that begins so; what is no value is left."""
        sign = self._sign()
        if sign != opening and sign in _KINDS:
            raise _FormError(_KINDS[sign] + where)

    def _parts(self, opening: str, closing: str) -> Iterator[None]:
        """Stop before each part of an object or a list, for that to be taken."""
        self._take(opening)
        more = self._sign() != closing
        while more:
            yield
            more = self._sign() == ","
            if more:
                self._take(",")
        self._take(closing)

    def _value(self) -> tuple[Any, Place]:
        """Take a value, and return it with its place."""
        self._sign()
        while True:
            try:
                value, end = _DECODER.raw_decode(self._text, self._at)
            except json.JSONDecodeError as error:
                if not self._read():
                    raise self._error(error.msg) from error
                continue
            if end < len(self._text) or not self._read():  # a number may go on
                start = self._byte
                self._move(end)
                return value, (start, self._byte - start)

    def _sign(self) -> str:
        """Skip white space and return the character that follows, nothing at the end."""
        while True:
            self._move(_SPACE.match(self._text, self._at).end())  # type: ignore[union-attr]
            if self._at < len(self._text):
                return self._text[self._at]
            if not self._read():
                return ""

    def _take(self, sign: str) -> None:
        """Take a character that must follow."""
        if self._sign() != sign:
            raise self._error(f"no {sign!r}")
        self._move(self._at + 1)

    def _move(self, end: int) -> None:
        """Go on to a place in the text."""
        self._byte += len(self._text[self._at : end].encode())
        self._at = end

    def _read(self) -> bool:
        """Read on, as much again as is left and at least a block; return whether there was any."""
        block = self._file.read(max(_BLOCK, len(self._text) - self._at))
        self._text = self._text[self._at :] + self._decode(block, not block)
        self._at = 0
        return bool(block)

    def _error(self, what: str) -> ValueError:
        return InputError(f"{what} at byte {self._byte}")
