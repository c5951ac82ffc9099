"""Weights from a checkpoint into a model, or an error that says what to do."""

import json
import pickle
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config, ConfigDict
from mmengine.logging import print_log
from torch import Tensor, nn

from gsmap.checkpoints.building import building
from gsmap.checkpoints.convert import listed
from gsmap.checkpoints.named_models import find_checkpoint, named_models
from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.checkpoints.settings import (
    IMAGE_SIZE,
    MODEL_SETTINGS,
    SIGNALS,
    STARTS,
    checked,
    differences,
    plain,
    scale_steps,
)
from gsmap.checkpoints.unwrapping import UnfitError, Unwrapped, unwrap
from gsmap.utils.faults import in_words, is_of_the_machine
from gsmap.utils.files import fetch_advice
from gsmap.utils.model_facts import calibration_of
from gsmap.utils.split_lists import SPLIT_LIST, checked_identity

# what torch's reader raises on bytes that make no sense
_DAMAGE = (
    RuntimeError, EOFError, LookupError, TypeError, AttributeError, AssertionError, ValueError,
    ArithmeticError, OSError, zipfile.BadZipFile,
)  # fmt: skip
_SCALED = ("image_scale", "test_dataloader.dataset.pipeline")  # overrides of the images' scale
_WIDEST_PX = 100_000
_REMEDY = "if you trust its origin, save its state_dict alone and give that file."


@dataclass(frozen=True)
class Checkpoint:
    """Contents of a checkpoint.

    Attributes:
        state: Its weights.
        settings: The model's settings in training, not checked yet; None if they are not there.
        image_size: Width and height that images were scaled to in training, or None.
        can_bus: Whether the training samples had vehicle signals, as far as it says.
        trained_on: The training's data set and its list of scenes, empty where it does not say.
        dataset_meta: What it says of the training's data set, not checked.
        calibration: Law and interval that its sigmas were fitted by; empty if they were not.
    """

    state: dict[str, Tensor]
    settings: Any
    image_size: tuple[int, int] | None
    can_bus: bool
    trained_on: tuple[str, str] = ("", "")
    dataset_meta: Mapping[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)

    def list_of(self, dataset: object) -> str:
        """Return the list of scenes it was trained on; nothing if that is of another data set."""
        own, identity = self.trained_on
        return identity if own == dataset else ""


@contextmanager
def refusing(path: object) -> Iterator[None]:
    """Say in a line which checkpoint cannot be read, and why."""
    try:
        yield
    except UnfitError as error:
        raise ValueError(f"{path} {error}.") from error
    except pickle.UnpicklingError as error:
        reason = str(error).split(". ")[0]
        otherwise = f"it is broken, or holds more than tensors and plain data ({reason}); {_REMEDY}"
        raise ValueError(f"{path} was not loaded: {_advice(path, otherwise)}.") from error
    except _DAMAGE as error:
        if is_of_the_machine(error) and not _asks_for_more(error, Path(str(path))):
            raise
        advice = _advice(path, "fetch it again, or use an earlier epoch's")
        raise ValueError(
            f"{path} is not a whole checkpoint ({type(error).__name__}: {error}); {advice}."
        ) from error


def _advice(path: object, otherwise: str) -> str:
    """Advice for a file that cannot be read, by its first bytes."""
    file = Path(str(path))
    if not file.is_file():
        return otherwise
    with file.open("rb") as opened:
        return fetch_advice(opened.read(100), otherwise.rstrip("."))


def _asks_for_more(error: BaseException, path: Path) -> bool:
    """Whether more memory was asked for than a file has bytes, whatever tensors it tells of."""
    asked = re.search(r"allocate (\d+) bytes", str(error))
    return asked is not None and path.is_file() and int(asked[1]) > path.stat().st_size


def require_unpacked(path: Path) -> None:
    """Refuse an archive with packed parts, which torch does not write: their sizes have no bound.

    Raises:
        ValueError: If there is one.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            packed = [part for part in archive.infolist() if part.compress_type]
        if packed:
            raise ValueError(f"{packed[0].filename!r:.60} in it is packed, as torch packs nothing")


def read_checked(path: str | Path) -> Checkpoint:
    """Read a checkpoint without running code from it, and check its weights.

    Args:
        path: File that training wrote, a bare state dict, or the name of a model.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, holds no weights, or weights that are not finite.
    """
    path = find_checkpoint(path)
    with refusing(path):
        require_unpacked(path)
        with torch.serialization.safe_globals(mmengine_globals()):
            checkpoint: Any = torch.load(path, map_location="cpu", weights_only=True)
        unwrapped = _unwrapped(path, checkpoint)
        meta = (unwrapped.holder or {}).get("meta") or {}
        if not isinstance(meta, Mapping):
            raise TypeError(f"meta must be a dictionary, got {meta!r:.60}")
        settings = json.loads(meta[MODEL_SETTINGS]) if MODEL_SETTINGS in meta else None
        named = next((vars(m) for m in named_models().values() if m.file == path), {})
        size = _checked_size({**named, **meta}.get(IMAGE_SIZE))
        signals = {**named, **meta}.get(SIGNALS) is True
        said = meta.get("dataset_meta")
        said = said if isinstance(said, Mapping) else {}
        trained_on = str(said.get("dataset", "")), checked_identity(said.get(SPLIT_LIST))
        calibration = calibration_of(meta)
        state = unwrapped.state
        broken = [key for key, value in state.items() if not bool(value.isfinite().all())]
    if broken:
        raise ValueError(
            f"{path} holds NaN or infinite weights ({listed(broken)}): the training that wrote it "
            "had failed; use an earlier epoch's."
        )
    return Checkpoint(state, settings, size, signals, trained_on, said, calibration)


def _checked_size(size: Any) -> tuple[int, int] | None:
    """Return an image size that a file brings; TypeError if it is none."""
    if size is None:
        return None
    if len(size) != 2 or not all(isinstance(n, int) and 0 < n <= _WIDEST_PX for n in size):
        raise TypeError(f"{IMAGE_SIZE} must be width and height, got {size!r:.60}")
    return tuple(size)


def _unwrapped(path: Path, content: Any) -> Unwrapped:
    """Weights of a checkpoint; entries that are not used are named once."""
    unwrapped = unwrap(content)
    if unwrapped.left_out:
        _say_left_out(path, tuple(unwrapped.left_out.items()))
    return unwrapped


@cache
def _say_left_out(path: Path, left_out: tuple[tuple[str, int], ...]) -> None:
    """Name the entries of a checkpoint that are not used, once."""
    text = ", ".join(f"{count} {what}" for what, count in left_out)
    print_log(f"{path}: {text} left out")


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Return the state dict of a checkpoint; arguments and errors as in `read_checked`."""
    return read_checked(path).state


def adopt_settings(
    cfg: Config, path: str | Path, cfg_options: dict | None, read: Checkpoint | None = None
) -> list[str]:
    """Adopt the model settings of a checkpoint's training in a config, and list the changes.

    Test images are scaled to the size that it was trained at, unless ``cfg_options`` set the scale.
    If it was trained with vehicle signals, those of samples without are computed from their poses.
    How training started (`STARTS`) is left out, and ``temporal.elements`` stays the config's. Parts
    that were never trained are refused when the weights are loaded, unless the config sets
    ``model.allow_untrained``.

    Args:
        cfg: The config; its ``model`` and ``test_dataloader`` change.
        path: The checkpoint, checked as in `read_checked`.
        cfg_options: Overrides that were given by hand, by dotted name; they stay.
        read: The checkpoint, if it is read already.

    Returns:
        A line for each setting that the config had otherwise, and for each that is kept against the
        checkpoint.

    Raises:
        ValueError: If the settings are no model's, or ask for more than a model (`checked`).
    """
    checkpoint = read or read_checked(path)
    settings = checkpoint.settings
    if checkpoint.image_size and not any(n.startswith(_SCALED) for n in cfg_options or {}):
        for step in scale_steps(cfg, "test"):
            step.trained_size = checkpoint.image_size
    if checkpoint.can_bus:
        cfg.test_dataloader.dataset.setdefault("signals_from_poses", True)
    config = plain(cfg.model.to_dict())
    allowed = cfg.model.setdefault("allow_untrained", False)
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
        cfg.model.allow_untrained = allowed
    return lines


def _is_start(name: str) -> bool:
    """Whether a dotted name is one of a setting of how training starts."""
    return not STARTS.isdisjoint(name.split("."))


def _model_of(
    path: str | Path, settings: Any, config: dict[str, Any], options: dict[str, Any]
) -> tuple[dict[str, Any], ConfigDict]:
    """Return a checkpoint's settings, checked, and with overrides; a model can be built of both."""
    try:
        settings = _with_elements_of(checked(settings, config), config)
        own = Config({"model": settings})
        own.merge_from_dict(options)
        with building(own):
            MODELS.build(own.model)
    except Exception as error:  # a stranger's settings may end in whatever they like
        reason = (in_words(error) or f"{type(error).__name__}: {error}").rstrip(".")
        raise ValueError(
            f"{path} was not loaded: of the settings in it, {reason}. Give the config that it was "
            f"trained with, or, {_REMEDY}"
        ) from error
    return settings, own.model


def _with_elements_of(settings: dict[str, Any], config: dict[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's settings with the config's memory of elements, which is not trained."""
    elements = (config.get("temporal") or {}).get("elements")
    temporal = settings.get("temporal") or {}
    if not isinstance(temporal, dict) or temporal.get("elements") == elements:
        return settings
    kept = {name: value for name, value in temporal.items() if name != "elements"}
    if elements is not None:
        kept["elements"] = elements
    return {**settings, "temporal": kept or None}


def load_weights(model: nn.Module, path: str | Path, read: Checkpoint | None = None) -> None:
    """Load a checkpoint, or a model's by its name; every weight must be there and fit.

    Args:
        model: Gets the weights.
        path: The checkpoint.
        read: The same, if it is read already.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read or belongs to another architecture; the message lists the
            first keys that disagree.
    """
    state = (read or read_checked(path)).state
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
