"""Progress display: a bar on a terminal, a line per minute in a file or a pipe."""

import sys
from typing import Any, TextIO

from tqdm import tqdm

from gsmap.utils.terminal import unescaped_stream

# Options of ``tqdm``: shortest and longest time between two updates, in seconds.
_EVERY_MINUTE = {"mininterval": 60.0, "maxinterval": 60.0}
# Formats of a line, whose fields ``tqdm`` fills in: title, count, total, unit and elapsed time.
_FORMAT = "{desc}{n_fmt} of {total_fmt} {unit}, {elapsed}"
_UNKNOWN_TOTAL = "{desc}{n_fmt} {unit}, {elapsed}"


class Progress(tqdm):
    """tqdm's progress bar on a terminal.

    In a file or a pipe, plain lines are written instead: one at the start, one per minute, and one
    at the end.

    Args:
        *args: Positional arguments of ``tqdm``.
        **kwargs: Keyword arguments of ``tqdm``.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if not sys.stderr.isatty():  # a file or a pipe
            title = f"{kwargs['desc']}: " if kwargs.get("desc") else ""
            kwargs |= _EVERY_MINUTE
            kwargs |= {"desc": title, "bar_format": _FORMAT, "file": _Lines(sys.stderr)}
        else:
            # A bar moves the cursor by control characters. They must not be escaped, as they are if
            # `terminal.escape_output` has replaced sys.stderr.
            kwargs.setdefault("file", unescaped_stream(sys.stderr))
        super().__init__(*args, **kwargs)

    @property
    def format_dict(self) -> dict[str, Any]:
        """Values that ``tqdm`` fills into the format of a line, and the format itself.

        The format of a line omits an unknown total.
        """
        values: dict[str, Any] = super().format_dict
        if values["bar_format"] == _FORMAT and values["total"] is None:
            values["bar_format"] = _UNKNOWN_TOTAL
        return values


class _Lines:
    """Stream that writes each update of a progress bar as a line.

    ``tqdm`` begins an update with a carriage return, to overwrite the previous one, and fills it up
    with spaces. Both are removed.

    Args:
        file: File or pipe to write to.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        if text.strip():
            self._file.write(f"{text.strip()}\n")

    def flush(self) -> None:
        self._file.flush()
