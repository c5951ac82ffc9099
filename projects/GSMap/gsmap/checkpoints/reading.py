"""Weights from a checkpoint into a model, or an error that says what to do."""

import json
import pickle
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config, ConfigDict
from torch import Tensor, nn

from gsmap.checkpoints.convert import listed
from gsmap.checkpoints.named_models import find_checkpoint
from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.checkpoints.settings import MODEL_SETTINGS, STARTS, checked, differences, plain
from gsmap.utils.faults import in_words

# what torch's reader raises on bytes that make no sense
_DAMAGE = (
    RuntimeError, EOFError, LookupError, TypeError, AttributeError, AssertionError, ValueError,
    ArithmeticError, OSError, zipfile.BadZipFile,
)  # fmt: skip
_REMEDY = "if you trust its origin, save its state_dict alone and give that file."


@contextmanager
def refusing(path: object) -> Iterator[None]:
    """Say in a line which checkpoint cannot be read, and why."""
    try:
        yield
    except pickle.UnpicklingError as error:
        reason = str(error).split(". ")[0]
        raise ValueError(
            f"{path} was not loaded: it is broken, or holds more than tensors and plain data "
            f"({reason}); {_REMEDY}"
        ) from error
    except _DAMAGE as error:
        raise ValueError(
            f"{path} is not a whole checkpoint ({type(error).__name__}: {error}); "
            "fetch it again, or use an earlier epoch's."
        ) from error


def read_checked(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any] | None]:
    """Read a checkpoint without running code from it, and check its weights.

    Args:
        path: File that training wrote, a bare state dict, or the name of a model.

    Returns:
        The state dict, and the model's settings in training where the checkpoint has them.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, holds no weights, or weights that are not finite.
    """
    path = find_checkpoint(path)
    with refusing(path):
        with torch.serialization.safe_globals(mmengine_globals()):
            checkpoint: Any = torch.load(path, map_location="cpu", weights_only=True)
        state = checkpoint.get("state_dict", checkpoint) if isinstance(checkpoint, Mapping) else {}
        meta = (checkpoint.get("meta") if state is not checkpoint else None) or {}
        if not isinstance(meta, Mapping):
            raise TypeError(f"meta must be a dictionary, got {meta!r:.60}")
        settings = json.loads(meta[MODEL_SETTINGS]) if MODEL_SETTINGS in meta else None
        if not isinstance(state, Mapping) or not all(map(_is_weight, state, state.values())):
            state = {}
        broken = [key for key, value in state.items() if not bool(value.isfinite().all())]
    if not state:
        raise ValueError(f"{path} holds no state dict of tensors: give a training checkpoint.")
    if broken:
        raise ValueError(
            f"{path} holds NaN or infinite weights ({listed(broken)}): the training that wrote it "
            "had failed; use an earlier epoch's."
        )
    return {key.removeprefix("module."): value for key, value in state.items()}, settings


def _is_weight(key: Any, value: Any) -> bool:
    """Whether an entry of a state dict is a weight: a plain tensor under a name."""
    plain_tensor = isinstance(value, Tensor) and value.layout is torch.strided
    return isinstance(key, str) and plain_tensor and not (value.is_quantized or value.is_meta)


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Return the state dict of a checkpoint; arguments and errors as in `read_checked`."""
    return read_checked(path)[0]


def adopt_settings(cfg: Config, path: str | Path, cfg_options: dict | None) -> list[str]:
    """Give a config the model settings that a checkpoint was trained with, and say which changed.

    How training started (`STARTS`) is left out.

    Args:
        cfg: The config; its ``model`` changes.
        path: The checkpoint, checked as in `read_checked`.
        cfg_options: Overrides that were given by hand, by dotted name; they stay.

    Returns:
        A line for each setting that the config had otherwise, and for each that is kept against the
        checkpoint.

    Raises:
        ValueError: If the settings are no model's, or ask for more than a model (`checked`).
    """
    settings = read_checked(path)[1]
    config = plain(cfg.model.to_dict())
    if settings is None or not differences(settings, config):
        return []
    options = {
        name: value
        for name, value in (cfg_options or {}).items()
        if name.startswith("model.") and not _is_start(name)
    }
    own, model = _model_of(path, settings, config, options)
    used = plain(model.to_dict())
    lines = [
        f"{name}: {theirs}, as {path} was trained; the config has {mine}"
        for name, (theirs, mine) in differences(used, config, "model").items()
        if not _is_start(name)
    ]
    lines += [
        f"{name}: {given}, as asked for; {path} was trained with {theirs}"
        for name, (given, theirs) in differences(used, own, "model").items()
    ]
    if lines:
        cfg.model = model
    return lines


def _is_start(name: str) -> bool:
    """Whether a dotted name is one of a setting of how training starts."""
    return not STARTS.isdisjoint(name.split("."))


def _model_of(
    path: str | Path, settings: Any, config: dict[str, Any], options: dict[str, Any]
) -> tuple[dict[str, Any], ConfigDict]:
    """Return a checkpoint's settings, checked, and with overrides; a model can be built of both."""
    try:
        settings = checked(settings, config)
        own = Config({"model": settings})
        own.merge_from_dict(options)
        MODELS.build(own.model)
    except Exception as error:  # a stranger's settings may end in whatever they like
        reason = (in_words(error) or f"{type(error).__name__}: {error}").rstrip(".")
        raise ValueError(
            f"{path} was not loaded: of the settings in it, {reason}. Give the config that it was "
            f"trained with, or, {_REMEDY}"
        ) from error
    return settings, own.model


def load_weights(model: nn.Module, path: str | Path) -> None:
    """Load a checkpoint, or a model's by its name; every weight must be there and fit.

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
    missing = [key for key in result.missing_keys if not key.endswith("num_batches_tracked")]
    if missing or result.unexpected_keys:
        raise ValueError(
            f"{path} does not belong to this config: it lacks {listed(missing)} and has "
            f"{listed(result.unexpected_keys)} too many. Give the config that it was trained with "
            "(a copy lies beside it in the work folder)."
        )
