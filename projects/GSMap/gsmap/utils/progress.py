"""Progress of long work: a bar on a terminal, a line now and then in a file or a pipe."""

import sys
from typing import Any, TextIO

from tqdm import tqdm

from gsmap.utils.terminal import own_stream

_PLAIN = {"mininterval": 60.0, "maxinterval": 60.0}
_FORMAT = "{desc}{n_fmt} of {total_fmt} {unit}, {elapsed}"
_UNKNOWN_TOTAL = "{desc}{n_fmt} {unit}, {elapsed}"


class Progress(tqdm):
    """tqdm's bar; where nobody watches, a plain line each minute, at the start and at the end."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if not sys.stderr.isatty():
            title = f"{kwargs['desc']}: " if kwargs.get("desc") else ""
            kwargs |= {**_PLAIN, "desc": title, "bar_format": _FORMAT, "file": _Lines(sys.stderr)}
        else:
            kwargs.setdefault("file", own_stream(sys.stderr))  # it moves the cursor
        super().__init__(*args, **kwargs)

    @property
    def format_dict(self) -> dict[str, Any]:
        """What a line is made of; one whose total is not known yet does not ask for it."""
        values: dict[str, Any] = super().format_dict
        if values["bar_format"] == _FORMAT and values["total"] is None:
            values["bar_format"] = _UNKNOWN_TOTAL
        return values


class _Lines:
    """Turns what overwrites itself on a terminal into lines."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        if text.strip():
            self._file.write(f"{text.strip()}\n")

    def flush(self) -> None:
        self._file.flush()
