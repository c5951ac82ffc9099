"""Incremental reading of a long list in a JSON file, item by item.

The file is read in blocks. Only the text that is not consumed yet and one item are in memory.
"""

import json
import re
from codecs import BOM_UTF8, getincrementaldecoder
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import IO, Any

from gsmap.utils.errors import InputError
from gsmap.utils.files import fetch_advice

Place = tuple[int, int]
"""Offset and length of an item in its file, in bytes, by which it can be read again."""
_BLOCK = 1 << 20  # bytes
_LISTED_NAMES = 5  # largest number of names in a message
# Kind of a value, by its first character, for messages.
_KINDS = {"{": "an object", "[": "a list", '"': "a text"}
_SPACE = re.compile(r"[ \t\n\r]*")
_DECODER = json.JSONDecoder()


def items_of(
    path: Path, key: str | None, advice: str, other_entries: dict[str, Any] | None = None
) -> Generator[tuple[Any, Place], None, None]:
    """Yield the value and the place of each item of a list; the memory does not grow with the list.

    Args:
        path: JSON file.
        key: Key of the list in the file's object; None if the file itself is a list.
        advice: Remedy for a file without the list, for the message.
        other_entries: Dictionary whose keys name further entries of the object; their values are
            filled in as the file is read, and are complete after the last item. Ignored if the
            file itself is a list.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not valid JSON or lacks the list. As items are yielded before the
            rest of the file is read, the error may come after some items.
    """
    with path.open("rb") as file:
        under = "" if key is None else f" under {key!r}"
        try:
            yield from _Parser(file).items(key=key, other_entries=other_entries or {})
        except _FormError as error:
            raise InputError(f"{path} holds {error} and no list{under}: {advice}.") from error
        except (ValueError, RecursionError) as error:  # RecursionError: nested too deeply
            # The first bytes show whether a pointer of Git LFS or a web page is in place of the
            # JSON file, for which the advice differs.
            file.seek(0)
            advice = fetch_advice(start=file.read(100), otherwise=advice)
            raise InputError(
                f"{path} is empty or holds no complete list{under} ({error!r:.80}): {advice}."
            ) from error


class _FormError(ValueError):
    """Valid JSON with another value in place of the list."""


class _Parser:
    """Incremental JSON parser that reads a file in blocks and consumes value by value.

    The text in memory is a part of the file. The position moves through the text, and the offset
    moves through the file in step with it.

    Args:
        file: JSON file, opened in binary mode.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        # An incremental decoder, since a block may end within a character.
        self._decode = getincrementaldecoder("utf-8")().decode
        self._text = ""
        self._position = 0  # start of the next value in the text, in characters
        self._offset = 0  # start of the next value in the file, in bytes
        # A byte order mark at the start of the file is skipped.
        if file.read(len(BOM_UTF8)) == BOM_UTF8:
            self._offset = len(BOM_UTF8)
        file.seek(self._offset)

    def items(self, key: str | None, other_entries: dict[str, Any]) -> Iterator[tuple[Any, Place]]:
        """Yield the items of the list under a key, and fill in the values of ``other_entries``."""
        if key is None:
            self._require(opening="[", where="")
            yield from self._list_items()
        else:
            self._require(opening="{", where="")
            yield from self._items_under(key=key, other_entries=other_entries)
        if self._next_character():  # the file must end after the list or object
            raise self._error("more text")

    def _items_under(self, key: str, other_entries: dict[str, Any]) -> Iterator[tuple[Any, Place]]:
        """Yield the items of the list under a key of an object."""
        has_list = False  # whether the key has been found
        names = []  # other keys, for the message; each is cut to 30 characters
        for _ in self._members(opening="{", closing="}"):
            if self._next_character() != '"':
                raise self._error("no name")
            name, _ = self._read_value()
            self._consume(":")
            if name != key:
                names.append(f"{name:.30}")
                value, _ = self._read_value()
                if name in other_entries:
                    other_entries[name] = value
                continue
            if has_list:
                raise self._error(f"a second {key!r}")
            self._require(opening="[", where=f" under {key!r}")
            has_list = True
            yield from self._list_items()
        if not has_list:
            raise _FormError(f"an object with {names[:_LISTED_NAMES] or 'nothing'}")

    def _list_items(self) -> Iterator[tuple[Any, Place]]:
        """Consume a list, and yield the value and the place of each item."""
        for _ in self._members(opening="[", closing="]"):
            yield self._read_value()

    def _require(self, opening: str, where: str) -> None:
        """Require that the next value begins with a character.

        The character is not consumed. An object, a list or a text in its place raises an error that
        names the kind of the value. Other values raise an error later, when the caller consumes
        ``opening``.

        Args:
            opening: Required character, ``[`` or ``{``.
            where: Place of the value, with which the message ends.
        """
        character = self._next_character()
        if character != opening and character in _KINDS:
            raise _FormError(_KINDS[character] + where)

    def _members(self, opening: str, closing: str) -> Iterator[None]:
        """Consume the brackets and commas of an object or a list.

        At each yield, the caller consumes one member: an item, or a key with its value.
        """
        self._consume(opening)
        has_more = self._next_character() != closing
        while has_more:
            yield
            has_more = self._next_character() == ","
            if has_more:
                self._consume(",")
        self._consume(closing)

    def _read_value(self) -> tuple[Any, Place]:
        """Consume a value, and return it with its place."""
        self._next_character()  # skips white space before the value
        while True:
            try:
                value, end = _DECODER.raw_decode(self._text, idx=self._position)
            except json.JSONDecodeError as error:
                # The value may be cut at the end of the text. Parse it again with one more block.
                if not self._read_block():
                    raise self._error(error.msg) from error
                continue
            # A number at the end of the text may continue in the next block. If there is one, the
            # value is parsed again.
            if end < len(self._text) or not self._read_block():
                start = self._offset
                self._advance(end)
                return value, (start, self._offset - start)

    def _next_character(self) -> str:
        """Skip white space, and return the next character; empty at the end of the file."""
        while True:
            space = _SPACE.match(self._text, pos=self._position)
            self._advance(space.end())  # type: ignore[union-attr]
            if self._position < len(self._text):
                return self._text[self._position]
            if not self._read_block():
                return ""

    def _consume(self, character: str) -> None:
        """Consume a character, which must come next."""
        if self._next_character() != character:
            raise self._error(f"no {character!r}")
        self._advance(self._position + 1)

    def _advance(self, end: int) -> None:
        """Move to a position in the text, and move the offset by the bytes between."""
        self._offset += len(self._text[self._position : end].encode())
        self._position = end

    def _read_block(self) -> bool:
        """Append a block of the file to the unread text; False at the end of the file.

        The block is at least as long as the unread text. So a value of many blocks is parsed again
        only a few times, and the total time is linear in its length. Consumed text is dropped.
        """
        unread = self._text[self._position :]
        block = self._file.read(max(_BLOCK, len(unread)))
        self._text = unread + self._decode(block, final=not block)
        self._position = 0
        return bool(block)

    def _error(self, fault: str) -> ValueError:
        """Error about the next value, with its offset in the file."""
        return InputError(f"{fault} at byte {self._offset}")
