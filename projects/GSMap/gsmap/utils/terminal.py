"""Text on its way to a terminal, which must not act on what files bring."""

import re
import sys
from collections.abc import Iterable
from typing import Any, TextIO

_DOUBTFUL = re.compile(r"[^\x20-\x7e\n\t]+")  # nearly all text has none


def printable(text: str) -> str:
    r"""Return a text whose control characters are written out, as ``repr`` writes them.

    These are all that a terminal may act on, or hide: ``ESC`` and the other codes below a space,
    those from 0x7f to 0x9f, the marks that turn the direction of writing, and halves of a character
    that could not be decoded. Ends of lines and tabulators stay.
    """
    return _DOUBTFUL.sub(_written_out, text)


def _written_out(found: re.Match[str]) -> str:
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in found[0])


class PrintableStream:
    """A stream of text that passes on what is `printable`; in all else it is the other one.

    Args:
        stream: The other one, such as ``sys.stdout``.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write a text, and return its length."""
        self.stream.write(printable(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def __eq__(self, other: object) -> bool:
        """Whether both write to one place; tqdm asks, to keep texts apart from its bars."""
        return self.stream is (other.stream if isinstance(other, PrintableStream) else other)

    def __hash__(self) -> int:
        return hash(self.stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def print_safely() -> None:
    """Let ``sys.stdout`` and ``sys.stderr`` pass on printable text only, to the process's end."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, PrintableStream):
            setattr(sys, name, PrintableStream(stream))


def own_stream(stream: TextIO) -> TextIO:
    """Return what lies below a `PrintableStream`, for a bar that moves the terminal's cursor."""
    return stream.stream if isinstance(stream, PrintableStream) else stream
