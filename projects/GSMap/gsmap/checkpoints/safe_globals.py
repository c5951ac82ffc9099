"""What a checkpoint of mmengine may hold beside tensors and plain data."""

import pickle
from collections.abc import Callable
from typing import Any

from mmengine.logging.history_buffer import HistoryBuffer

from gsmap.utils.numpy_pickle import CHECKED


def mmengine_globals() -> list[Any]:
    """Return what ``torch.load(weights_only=True)`` needs to read mmengine's checkpoints.

    A checkpoint to resume from holds the message hub: ``HistoryBuffer`` objects around arrays,
    numbers, and references to the class's own statistics (``getattr(HistoryBuffer, "mean")``).
    Naming just these keeps torch's protection on for everything else. numpy's values are rebuilt by
    checked functions, as numpy's own give a file memory access.
    """
    checked = [(function, name) for name, function in CHECKED.items()]
    return [HistoryBuffer, *checked, (_history_statistic, "builtins.getattr")]


def _history_statistic(owner: type, name: str) -> Callable[..., float]:
    """Stand in for ``getattr`` while unpickling: a statistic of ``HistoryBuffer`` and no more."""
    if owner is not HistoryBuffer or name not in {"min", "max", "current", "mean"}:
        raise pickle.UnpicklingError(f"A checkpoint must not look up {name!r} of {owner!r}.")
    return getattr(HistoryBuffer, name)
