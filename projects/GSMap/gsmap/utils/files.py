"""Files that are whole or absent, whatever stops their writer."""

import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

SUFFIX = ".partial"
_END = f".{platform.node()}{SUFFIX}"  # another machine's writers on a shared disk cannot be judged


@contextmanager
def atomic_write(path: str | Path, mode: Literal["w", "wb"] = "w") -> Iterator[IO[Any]]:
    """Open a file that takes its name only when the block ends well.

    Until then it is ``PATH.<pid>.<host>.partial``, which any exception removes. One that a killed
    writer left behind goes when the same machine writes the same file again. A reader sees the old
    file or the new one.

    Args:
        path: File to write; parent folders are made.
        mode: ``w`` for text in UTF-8, ``wb`` for bytes.

    Yields:
        The open file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(path)
    try:
        with partial.open(mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in one step, in UTF-8."""
    with atomic_write(path) as file:
        file.write(text)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file in one step."""
    with atomic_write(path, "wb") as file:
        file.write(content)


def partial_path(path: Path) -> Path:
    """Return where a file or folder is made before it takes its name, free of what is stale.

    What killed writers of the same file or folder left behind on this machine is removed.
    """
    start = f"{path.name}."
    # without /proc there is no way to tell whether a writer lives
    for name in os.listdir(path.parent) if Path("/proc/self").exists() else ():
        pid = name[len(start) : -len(_END)]
        if name == f"{start}{pid}{_END}" and pid.isdigit() and not Path("/proc", pid).exists():
            stale = path.parent / name
            shutil.rmtree(stale) if stale.is_dir() else stale.unlink(missing_ok=True)
    return path.with_name(f"{start}{os.getpid()}{_END}")
