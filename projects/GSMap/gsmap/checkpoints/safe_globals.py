"""What a checkpoint of mmengine may hold beside tensors and plain data."""

import codecs
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
from mmengine.logging.history_buffer import HistoryBuffer
from numpy.core import multiarray


def mmengine_globals() -> list[Any]:
    """Return what ``torch.load(weights_only=True)`` needs to read mmengine's checkpoints.

    A checkpoint to resume from holds the message hub: ``HistoryBuffer`` objects around arrays,
    numbers, and references to the class's own statistics (``getattr(HistoryBuffer, "mean")``).
    Naming just these keeps torch's protection on for everything else.

    Returns:
        The list for ``torch.serialization.safe_globals`` or ``add_safe_globals``.
    """
    kinds = (np.float32, np.float64, np.int64, np.int32, np.uint8, np.bool_)
    dtypes = [type(np.dtype(kind)) for kind in kinds]
    rebuild = [multiarray._reconstruct, multiarray.scalar]  # type: ignore[attr-defined]
    types = [HistoryBuffer, np.ndarray, np.dtype, codecs.encode]
    return [*types, *rebuild, *dtypes, (_history_statistic, "builtins.getattr")]


def _history_statistic(owner: type, name: str) -> Callable[..., float]:
    """Stand in for ``getattr`` while unpickling: a statistic of ``HistoryBuffer`` and no more."""
    if owner is not HistoryBuffer or name not in {"min", "max", "current", "mean"}:
        raise pickle.UnpicklingError(f"A checkpoint must not look up {name!r} of {owner!r}.")
    return getattr(HistoryBuffer, name)
