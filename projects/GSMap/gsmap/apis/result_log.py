"""Predictions on their way to a result file: what a killed run goes on from."""

import io
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsmap.evaluation.core.results_json import THREE_D, read_vectors, write_results
from gsmap.utils.errors import InputError
from gsmap.utils.files import lock, naming_file, open_to_append

_SUFFIX = ".unfinished"


class ResultLog:
    """A file ``OUT.unfinished`` with one line a frame, which becomes ``OUT`` when all are there.

    A context manager. It takes up what another run with the same settings has left.

    Args:
        out: The result file.
        settings: What decides the predictions, as plain values.
        tokens: The frames of the run; by default any may be in the file.
        classes: Classes of the model; by default any may be in the file.

    Raises:
        RuntimeError: If another process is at work on the same result file.
        ValueError: If ``OUT.unfinished`` is no such file, is damaged, or has other frames; it stays
            as it is.

    Attributes:
        done: Tokens of the frames that need no more work.
        broken: Reason of each broken frame, by token.
        dropped: Number of frames of a run with other settings, which are not used.
    """

    def __init__(
        self,
        out: Path,
        settings: dict[str, Any],
        tokens: Iterable[str] | None = None,
        classes: Sequence[str] | None = None,
    ) -> None:
        self.out = out
        self.dropped = 0
        self._tokens = None if tokens is None else frozenset(tokens)
        self._classes = classes
        self.path = out.with_name(out.name + _SUFFIX)
        self._head = json.dumps(settings, sort_keys=True) + "\n"
        self.done: set[str] = set()
        self.broken: dict[str, str] = {}

    def __enter__(self) -> "ResultLog":
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self._file = io.BufferedRandom(open_to_append(self.path))
        try:
            held = f"another process writes {self.path}: wait for its end, or give another --out."
            lock(self._file, held)
            self._take_up()
        except BaseException:
            self._file.close()
            raise
        return self

    def _take_up(self) -> None:
        """Note the frames that are there, and cut off what cannot be used."""
        self._file.seek(0)
        head, end = self._file.readline(), 0
        same = head == self._head.encode()
        if head.endswith(b"\n"):
            self._require(isinstance(_value(head), dict), 1)
            end = self._file.tell()
        else:  # a kill cut the first line, if it is one of this file's
            self._require(not head or head.startswith(b"{"), 1)
        for number, line in enumerate(self._file if end else (), 2):
            if not line.endswith(b"\n"):
                break  # a kill cut the last line
            frame = _value(line)
            self._require(self._is_frame(frame, same), number)
            self._note(frame)
            end += len(line)
        if not same:
            self.dropped = len(self.done)
            self.done.clear()
            self.broken.clear()
            end = 0
        with naming_file(self.path):
            self._file.truncate(end)
            if not end:
                self._file.write(self._head.encode())
            self._file.flush()

    def _is_frame(self, frame: Any, same: bool) -> bool:
        """Whether a line is a frame's, of this run if it is of the same settings, and no second."""
        if not isinstance(frame, dict) or not isinstance(frame.get("sample_token"), str):
            return False
        token, vectors = frame["sample_token"], frame.get("vectors", [])
        known = not same or self._tokens is None or token in self._tokens
        reason_fits = isinstance(frame.get("broken", ""), str)
        first = known and token not in self.done
        return first and reason_fits and self._are_elements(vectors, same)

    def _are_elements(self, vectors: Any, same: bool) -> bool:
        """Whether the elements of a frame can be read, and are of classes of the run."""
        if not isinstance(vectors, list):
            return False
        classes = self._classes if same else None
        others = Counter[str]()
        try:
            read_vectors(vectors, classes or (), others, gaussians=True)
        except (ValueError, KeyError, TypeError, OverflowError):
            return False
        return classes is None or not others.keys() - {THREE_D}

    def _require(self, good: bool, number: int) -> None:
        if not good:
            raise InputError(
                f"{self.path}, line {number}, is no frame of this run: the file is damaged, or "
                "another program's. Take it away to begin again, or give another --out."
            )

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def _note(self, line: dict[str, Any]) -> None:
        self.done.add(line["sample_token"])
        if "broken" in line:
            self.broken[line["sample_token"]] = line["broken"]

    def _append(self, line: dict[str, Any]) -> None:
        self._note(line)
        with naming_file(self.path):
            self._file.write(json.dumps(line, separators=(",", ":")).encode() + b"\n")
            self._file.flush()

    def add(self, token: str, vectors: list[dict[str, Any]]) -> None:
        """Keep a frame's predictions."""
        self._append({"sample_token": token, "vectors": vectors})

    def add_broken(self, token: str, reason: str) -> None:
        """Keep that a frame is broken."""
        self._append({"sample_token": token, "broken": reason})

    def finish(self, meta: dict[str, Any]) -> int:
        """Write the result file, in the order of tokens, remove this one, and count the frames.

        ``meta`` is what to say about the file.
        """
        places: list[tuple[str, int]] = []
        with self.path.open("rb") as file:
            file.readline()
            position = file.tell()
            for line in file:
                token = json.loads(line)["sample_token"]
                if token not in self.broken:
                    places.append((token, position))
                position += len(line)

            def vectors(position: int) -> list[dict[str, Any]]:
                file.seek(position)
                return json.loads(file.readline())["vectors"]

            write_results(self.out, ((t, vectors(at)) for t, at in sorted(places)), meta)
        self.path.unlink()
        return len(places)


def _value(line: bytes) -> Any:
    """Return the value of a line of JSON, None if it is none."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
