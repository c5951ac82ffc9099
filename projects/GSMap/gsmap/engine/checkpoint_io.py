"""Checkpoints that run no code when read, and are whole or absent when written."""

import codecs
import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from mmengine.fileio import LocalBackend, register_backend
from mmengine.logging.history_buffer import HistoryBuffer
from numpy.core import multiarray


def allow_mmengine_checkpoints() -> None:
    """Let ``torch.load(weights_only=True)`` read what mmengine keeps beside the weights.

    A checkpoint to resume from holds the message hub: ``HistoryBuffer`` objects around arrays,
    numbers, and references to the class's own statistics (``getattr(HistoryBuffer, "mean")``).
    Naming just these keeps torch's protection on for everything else.
    """
    kinds = (np.float32, np.float64, np.int64, np.int32, np.uint8, np.bool_)
    dtypes = [type(np.dtype(kind)) for kind in kinds]
    rebuild = [multiarray._reconstruct, multiarray.scalar]  # type: ignore[attr-defined]
    types = [HistoryBuffer, np.ndarray, np.dtype, codecs.encode]
    statistics = (_history_statistic, "builtins.getattr")
    torch.serialization.add_safe_globals([*types, *rebuild, *dtypes, statistics])


def _history_statistic(owner: type, name: str) -> Callable[..., float]:
    """Stand in for ``getattr`` while unpickling: a statistic of ``HistoryBuffer`` and nothing else.

    Raises:
        pickle.UnpicklingError: If anything else is asked for.
    """
    if owner is not HistoryBuffer or name not in {"min", "max", "current", "mean"}:
        raise pickle.UnpicklingError(f"A checkpoint must not look up {name!r} of {owner!r}.")
    return getattr(HistoryBuffer, name)


class AtomicLocalBackend(LocalBackend):
    """mmengine's local files, each written beside its place and then moved there in one step.

    A run that is killed while it saves leaves the previous checkpoint as it was, so ``--resume``
    always finds a whole one.
    """

    def put(self, obj: bytes, filepath: str | Path) -> None:
        """Write ``obj`` to ``filepath``; a reader sees the old file or the whole new one."""
        path = Path(filepath)
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(obj)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o666 & ~_umask())
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    def put_text(self, obj: str, filepath: str | Path, encoding: str = "utf-8") -> None:
        """Write text to ``filepath`` in one step."""
        self.put(obj.encode(encoding), filepath)


def _umask() -> int:
    """Return the process's umask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


allow_mmengine_checkpoints()
register_backend("local", AtomicLocalBackend, force=True, prefixes="")
