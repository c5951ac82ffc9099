"""Predictions on their way to a result file: what a killed run goes on from."""

import json
from pathlib import Path
from typing import Any

from gsmap.evaluation.results_json import write_results
from gsmap.utils.files import lock

_SUFFIX = ".unfinished"


class ResultLog:
    """A file ``OUT.unfinished`` with one line a frame, which becomes ``OUT`` when all are there.

    A context manager. It takes up what another run with the same settings has left.

    Args:
        out: The result file.
        settings: What decides the predictions, as plain values.

    Raises:
        RuntimeError: If another process is at work on the same result file.

    Attributes:
        done: Tokens of the frames that need no more work.
        broken: Reason of each broken frame, by token.
    """

    def __init__(self, out: Path, settings: dict[str, Any]) -> None:
        self.out = out
        self.path = out.with_name(out.name + _SUFFIX)
        self._head = json.dumps(settings, sort_keys=True) + "\n"
        self.done: set[str] = set()
        self.broken: dict[str, str] = {}

    def __enter__(self) -> "ResultLog":
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("a", encoding="utf-8")
        held = f"another process writes {self.path}: wait for its end, or give another --out."
        lock(self._file, held)
        content = self.path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]  # a kill may cut the last line
        if not whole.startswith(self._head.encode()):
            whole = self._head.encode()
        for line in whole.decode().splitlines()[1:]:
            self._note(json.loads(line))
        self.path.write_bytes(whole)
        return self

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def _note(self, line: dict[str, Any]) -> None:
        self.done.add(line["sample_token"])
        if "broken" in line:
            self.broken[line["sample_token"]] = line["broken"]

    def _append(self, line: dict[str, Any]) -> None:
        self._note(line)
        self._file.write(json.dumps(line, separators=(",", ":")) + "\n")
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
