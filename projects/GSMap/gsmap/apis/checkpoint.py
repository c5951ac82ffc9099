"""Weights from a checkpoint into a model, or an error that says what to do."""

import pickle
import zipfile
from pathlib import Path

from torch import Tensor, nn

from gsmap.checkpoints.convert import read_state
from gsmap.engine.named_models import find_checkpoint

_SHOWN = 5


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Read the weights of a checkpoint without running code from it.

    Args:
        path: File that training wrote, a bare state dict, or the name of a model.

    Returns:
        The state dict.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or holds no weights.
    """
    path = find_checkpoint(path)
    try:
        return read_state(path)
    except pickle.UnpicklingError as error:
        reason = str(error).split(". ")[0]
        raise ValueError(
            f"{path} was not loaded: it is broken, or holds more than tensors and plain data "
            f"({reason}). If you trust its origin, save its state_dict alone and give that file."
        ) from error
    except (RuntimeError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} is not a whole checkpoint ({type(error).__name__}: {error}); "
            "fetch it again, or use an earlier epoch's."
        ) from error


def load_weights(model: nn.Module, path: str | Path) -> None:
    """Load a checkpoint into a model; every weight must be there and fit.

    Args:
        model: The model; its weights are replaced.
        path: The checkpoint, or the name of a model.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read or belongs to another architecture; the message lists the
            first keys that disagree.
    """
    state = read_weights(path)
    try:
        result = model.load_state_dict(state, strict=False)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path} does not belong to this config: {error}") from error
    counters = [key for key in result.missing_keys if key.endswith("num_batches_tracked")]
    missing = [key for key in result.missing_keys if key not in counters]
    if missing or result.unexpected_keys:
        raise ValueError(
            f"{path} does not belong to this config: it lacks {_listed(missing)} and has "
            f"{_listed(result.unexpected_keys)} too many. Give the config that it was trained with "
            "(a copy lies beside it in the work folder)."
        )


def _listed(keys: list[str]) -> str:
    """Name the first keys and count the rest."""
    if not keys:
        return "nothing"
    rest = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    return ", ".join(keys[:_SHOWN]) + rest
