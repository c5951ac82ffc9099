"""Escaping of control characters in terminal output, which may come from untrusted files."""

import re
import sys
from collections.abc import Iterable
from typing import Any, TextIO

# Characters that may need an escape: all but ASCII text, newlines and tabs. Nearly all text has
# none, so `_escape` is rarely called.
_UNCOMMON = re.compile(r"[^\x20-\x7e\n\t]+")


def printable(text: str) -> str:
    r"""Escape the control characters of a text, as ``repr`` does.

    Control characters are ``ESC`` and the other codes below a space, the codes from 0x7f to 0x9f,
    marks that change the writing direction, and lone surrogates of undecodable bytes. All other
    characters that ``str.isprintable`` refuses, such as a no-break space, are escaped, too.
    Newlines and tabs are kept.
    """
    return _UNCOMMON.sub(repl=_escape, string=text)


def _escape(match: re.Match[str]) -> str:
    """Escape the characters of a match that are not printable."""
    escaped = []
    for character in match[0]:
        without_quotes = ascii(character)[1:-1]  # such as \x1b
        escaped.append(character if character.isprintable() else without_quotes)
    return "".join(escaped)


class PrintableStream:
    """Text stream that escapes control characters (`printable`) before it writes to another stream.

    All attributes that are not defined here come from the wrapped stream.

    Args:
        stream: Stream to wrap, such as ``sys.stdout``.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write a text, and return its length before escaping."""
        self.stream.write(printable(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several texts. The method of the wrapped stream would not escape them."""
        for line in lines:
            self.write(line)

    def __eq__(self, other: object) -> bool:
        """Whether both streams write to one stream; tqdm compares the streams of its bars."""
        other_stream = other.stream if isinstance(other, PrintableStream) else other
        return self.stream is other_stream

    def __hash__(self) -> int:
        return hash(self.stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def escape_output() -> None:
    """Escape control characters in ``sys.stdout`` and ``sys.stderr`` until the process ends."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, PrintableStream):
            setattr(sys, name, PrintableStream(stream))


def unescaped_stream(stream: TextIO) -> TextIO:
    """Return the stream that a `PrintableStream` wraps; another stream is returned as it is.

    A progress bar needs it, because it moves the cursor by control characters.
    """
    return stream.stream if isinstance(stream, PrintableStream) else stream
