"""Globals that checkpoints of mmengine may refer to, besides tensors and plain data."""

import pickle
from collections.abc import Callable
from typing import Any

from mmengine.logging.history_buffer import HistoryBuffer

from gsmap.utils.numpy_pickle import CHECKED


def mmengine_globals() -> list[Any]:
    """Globals that ``torch.load(weights_only=True)`` needs for mmengine's checkpoints.

    A checkpoint for resuming contains mmengine's message hub: ``HistoryBuffer`` objects with
    arrays, numbers, and references to statistics of the class
    (``getattr(HistoryBuffer, "mean")``). Torch refuses all other globals. Arrays are rebuilt by
    functions that check their arguments, because numpy's functions give a file access to memory.

    Returns:
        Classes, and pairs of a function and the global name that it replaces.
    """
    array_functions = [(function, name) for name, function in CHECKED.items()]
    return [HistoryBuffer, *array_functions, (_history_statistic, "builtins.getattr")]


def _history_statistic(owner: type, name: str) -> Callable[..., float]:
    """Replacement for ``getattr`` in unpickling, restricted to statistics of ``HistoryBuffer``."""
    if owner is not HistoryBuffer or name not in {"min", "max", "current", "mean"}:
        raise pickle.UnpicklingError(f"A checkpoint must not look up {name!r} of {owner!r}.")
    return getattr(HistoryBuffer, name)
