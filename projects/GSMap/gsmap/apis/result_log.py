"""Log of predictions, from which an interrupted run continues."""

import io
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gsmap.evaluation.core.results_json import THREE_D, read_vectors, write_results
from gsmap.utils.errors import InputError
from gsmap.utils.files import add_path_to_errors, lock, open_to_append

_SUFFIX = ".unfinished"


class ResultLog:
    """File ``OUT.unfinished`` with one line per frame, which becomes ``OUT`` when it is complete.

    The log is a context manager. It reuses the frames of an interrupted run with equal settings.
    A frame that could not be predicted has no line, so a later run tries it again.

    Args:
        out: The result file.
        settings: Settings that determine the predictions, as plain values.
        tokens: Tokens of the frames of the run. If None, the file may have frames of any token.
        classes: Classes of the model. If None, the file may have elements of any class.

    Raises:
        RuntimeError: If another process writes the result file.
        ValueError: If ``OUT.unfinished`` has another format, is damaged, or has frames that do not
            belong to the run. The file is not changed in this case.

    Attributes:
        done: Tokens of the finished frames.
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
        self._head = json.dumps(settings, sort_keys=True) + "\n"  # first line of the log
        self.done: set[str] = set()

    def __enter__(self) -> "ResultLog":
        self.out.parent.mkdir(parents=True, exist_ok=True)
        # `open_to_append` returns an unbuffered file. The buffer makes reading of lines fast.
        self._file = io.BufferedRandom(open_to_append(self.path))
        try:
            # The file stays locked until it is closed.
            lock(
                self._file,
                f"another process writes {self.path}: wait for its end, or give another --out.",
            )
            self._resume()
        except BaseException:
            self._file.close()
            raise
        return self

    def _resume(self) -> None:
        """Read the finished frames of the file, and remove other content from the file.

        The first line of the file has the settings of a run, and every other line has a frame. If
        the settings differ from the settings of this run, all frames are removed. They are checked
        first, so that no file of another program is emptied. Otherwise only an incomplete last line
        is removed, which a killed run may leave.
        """
        self._file.seek(0)
        head = self._file.readline()
        end = 0  # end of the valid part, in bytes
        same_settings = head == self._head.encode()
        if head.endswith(b"\n"):
            self._require(isinstance(_parse_line(head), dict), line_number=1)
            end = self._file.tell()
        else:  # incomplete settings, or a file of another program
            self._require(not head or head.startswith(b"{"), line_number=1)
        frame_lines: Iterable[bytes] = self._file if end else ()
        for line_number, line in enumerate(frame_lines, start=2):
            if not line.endswith(b"\n"):
                break
            frame = _parse_line(line)
            is_valid = self._is_frame(frame, same_settings=same_settings)
            self._require(is_valid, line_number=line_number)
            if "broken" not in frame:  # a line of an earlier version for a frame to try again
                self.done.add(frame["sample_token"])
            end += len(line)
        if not same_settings:
            self.dropped = len(self.done)
            self.done.clear()
            end = 0
        with add_path_to_errors(self.path):
            self._file.truncate(end)
            if not end:
                self._file.write(self._head.encode())
            self._file.flush()

    def _is_frame(self, frame: Any, same_settings: bool) -> bool:
        """Whether the value of a line is a frame of the run that no earlier line has.

        Args:
            frame: Value of the line.
            same_settings: Whether the file and the run have equal settings; if not, frames of any
                run are valid.
        """
        if not isinstance(frame, dict) or not isinstance(frame.get("sample_token"), str):
            return False
        token = frame["sample_token"]
        if token in self.done:
            return False
        if same_settings and self._tokens is not None and token not in self._tokens:
            return False
        if "broken" in frame:
            return isinstance(frame["broken"], str)
        return self._are_elements(frame.get("vectors"), same_settings=same_settings)

    def _are_elements(self, vectors: Any, same_settings: bool) -> bool:
        """Whether the elements of a frame are valid and belong to classes of the run.

        Args:
            vectors: Elements of the frame.
            same_settings: As for `_is_frame`.
        """
        if not isinstance(vectors, list):
            return False
        classes = self._classes if same_settings else None
        unknown = Counter[str]()  # number of elements of each class that is not in `classes`
        try:
            # The elements are only checked, so the result is not used.
            read_vectors(vectors, classes or (), unknown, gaussians=True)
        except (ValueError, KeyError, TypeError, OverflowError):
            return False
        unknown.pop(THREE_D, None)  # this key counts samples with heights, which are valid
        return classes is None or not unknown

    def _require(self, is_valid: bool, line_number: int) -> None:
        """Raise an error about a line that is not valid."""
        if not is_valid:
            raise InputError(
                f"{self.path}, line {line_number}, is no frame of this run: the file is damaged or "
                "was written by another program. Remove it to begin again, or give another --out."
            )

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def add(self, token: str, vectors: list[dict[str, Any]]) -> None:
        """Add the predictions of a frame.

        Args:
            token: Token of the frame.
            vectors: Elements in the format of the results JSON.
        """
        frame = {"sample_token": token, "vectors": vectors}
        self.done.add(token)
        with add_path_to_errors(self.path):
            self._file.write(json.dumps(frame, separators=(",", ":")).encode() + b"\n")
            self._file.flush()

    def finish(self, meta: dict[str, Any]) -> int:
        """Write the result file in the order of tokens, and remove the unfinished one.

        Args:
            meta: Metadata of the result file, in types of JSON.

        Returns:
            Number of frames in the result file.
        """
        positions: list[tuple[str, int]] = []  # token and start of its line, in bytes
        with self.path.open("rb") as file:
            file.readline()  # the settings
            position = file.tell()
            for line in file:
                frame = json.loads(line)
                if "broken" not in frame:
                    positions.append((frame["sample_token"], position))
                position += len(line)
            positions.sort()

            # The frames are read one at a time, because all of them may not fit in memory.
            def samples() -> Iterator[tuple[str, list[dict[str, Any]]]]:
                for token, position in positions:
                    file.seek(position)
                    yield token, json.loads(file.readline())["vectors"]

            write_results(self.out, samples(), meta=meta)
        self.path.unlink()
        return len(positions)


def _parse_line(line: bytes) -> Any:
    """Parse a line of JSON; None if it is not valid."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
