"""Classes and functions that checkpoints of mmengine may refer to when they are unpickled."""

import pickle
from collections.abc import Callable
from typing import Any

from mmengine.logging.history_buffer import HistoryBuffer

from gsmap.utils.numpy_pickle import CHECKED


def mmengine_globals() -> list[Any]:
    """List the globals that ``torch.load(weights_only=True)`` needs for mmengine's checkpoints.

    A global is a class or function that a pickle file refers to by name; torch refuses globals that
    are not listed. A checkpoint for resuming contains mmengine's message hub. The hub consists of
    numbers and of ``HistoryBuffer`` objects, which contain arrays and references to methods of the
    class (``getattr(HistoryBuffer, "mean")``). Arrays are rebuilt by functions that check their
    arguments, because a malicious file could access memory through numpy's functions.

    Returns:
        Classes, and pairs of a function and the global name that it replaces. This is the form that
        ``torch.serialization.safe_globals`` takes.
    """
    # `CHECKED` has the checked functions by the names of numpy's functions that they replace.
    array_functions = [(function, name) for name, function in CHECKED.items()]
    return [HistoryBuffer, *array_functions, (_history_statistic, "builtins.getattr")]


def _history_statistic(owner: type, name: str) -> Callable[..., float]:
    """Replacement for ``getattr`` in unpickling; allows only statistics of ``HistoryBuffer``."""
    if owner is not HistoryBuffer or name not in {"min", "max", "current", "mean"}:
        raise pickle.UnpicklingError(f"A checkpoint must not look up {name!r} of {owner!r}.")
    return getattr(HistoryBuffer, name)
