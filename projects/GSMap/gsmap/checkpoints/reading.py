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
from gsmap.utils.errors import InputError
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
    """Contents of a checkpoint that loading and testing use.

    Attributes:
        state: Weights, by state key.
        settings: Settings of the model in training, not checked yet; None if it has none.
        image_size: Width and height in pixels that images were scaled to in training, or None.
        can_bus: Whether the training samples had vehicle signals; False if that is not recorded.
        trained_on: Data set of the training and identity of its list of scenes, empty if unknown.
        dataset_meta: Metadata of the training's data set, not checked.
        calibration: Law and interval that the sigmas were fitted by; empty if they were not.
    """

    state: dict[str, Tensor]
    settings: Any
    image_size: tuple[int, int] | None
    can_bus: bool
    trained_on: tuple[str, str] = ("", "")
    dataset_meta: Mapping[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)

    def list_of(self, dataset: object) -> str:
        """Return the identity of the training's list of scenes; empty for another data set."""
        own, identity = self.trained_on
        return identity if own == dataset else ""


@contextmanager
def refusing(path: object) -> Iterator[None]:
    """Turn errors of reading a checkpoint into one line with its path, the reason and a remedy.

    Args:
        path: File or address of the checkpoint.

    Raises:
        ValueError: If the block raises an error that the contents of the file cause.
    """
    try:
        yield
    except UnfitError as error:
        raise InputError(f"{path} {error}.") from error
    except pickle.UnpicklingError as error:
        reason = str(error).split(". ")[0]
        otherwise = f"it is broken, or holds more than tensors and plain data ({reason}); {_REMEDY}"
        raise InputError(f"{path} was not loaded: {_advice(path, otherwise)}.") from error
    except _DAMAGE as error:
        if is_of_the_machine(error) and not _asks_for_more(error, Path(str(path))):
            raise
        advice = _advice(path, "fetch it again, or use an earlier epoch's")
        raise InputError(
            f"{path} is not a whole checkpoint ({type(error).__name__}: {error}); {advice}."
        ) from error


def _advice(path: object, otherwise: str) -> str:
    """Return a remedy for a file that cannot be read, by its first bytes."""
    file = Path(str(path))
    if not file.is_file():
        return otherwise
    with file.open("rb") as opened:
        return fetch_advice(opened.read(100), otherwise.rstrip("."))


def _asks_for_more(error: BaseException, path: Path) -> bool:
    """Whether more memory was asked for than a file has bytes, so that its sizes are wrong."""
    asked = re.search(r"allocate (\d+) bytes", str(error))
    return asked is not None and path.is_file() and int(asked[1]) > path.stat().st_size


def load_tensors(path: str | Path, map_location: Any = "cpu") -> Any:
    """Load a file of ``torch.save`` without running code from it.

    Args:
        path: The file.
        map_location: Device of the tensors, as ``torch.load`` takes it.

    Returns:
        Its contents: tensors and plain data.

    Raises:
        ValueError: If it is an archive with compressed parts, or with parts that overlap: their
            sizes in memory have no bound, and torch writes none.
        UnpicklingError: If it holds more than tensors and plain data.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for part in archive.infolist():
                if part.compress_type != zipfile.ZIP_STORED:
                    name = f"{part.filename!r:.60}"
                    raise InputError(f"{name} in it is packed, as torch packs nothing")
            total = sum(part.file_size for part in archive.infolist())
            if total > Path(path).stat().st_size:
                raise InputError(f"its parts overlap: they have {total} bytes in all")
    return torch.load(path, map_location=map_location, weights_only=True)


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
        with torch.serialization.safe_globals(mmengine_globals()):
            content = load_tensors(path)
        unwrapped = _unwrapped(path, content)
        meta = (unwrapped.holder or {}).get("meta") or {}
        if not isinstance(meta, Mapping):
            raise TypeError(f"meta must be a dictionary, got {meta!r:.60}")
        settings = json.loads(meta[MODEL_SETTINGS]) if MODEL_SETTINGS in meta else None
        facts = {**_facts_of_named(path), **meta}
        dataset_meta = meta.get("dataset_meta")
        if not isinstance(dataset_meta, Mapping):
            dataset_meta = {}
        scenes = checked_identity(dataset_meta.get(SPLIT_LIST))
        checkpoint = Checkpoint(
            state=unwrapped.state,
            settings=settings,
            image_size=_checked_size(facts.get(IMAGE_SIZE)),
            can_bus=facts.get(SIGNALS) is True,
            trained_on=(str(dataset_meta.get("dataset", "")), scenes),
            dataset_meta=dataset_meta,
            calibration=calibration_of(meta),
        )
        broken = [key for key, value in unwrapped.state.items() if not value.isfinite().all()]
    if broken:
        raise InputError(
            f"{path} holds NaN or infinite weights ({listed(broken)}): the training that wrote it "
            "had failed; use an earlier epoch's."
        )
    return checkpoint


def _facts_of_named(path: Path) -> dict[str, Any]:
    """Return the facts about a model that ships, by its file; none of another file."""
    for model in named_models().values():
        if model.file == path:
            return vars(model)
    return {}


def _checked_size(size: Any) -> tuple[int, int] | None:
    """Return an image size that a file brings; TypeError if it is none."""
    if size is None:
        return None
    if len(size) != 2 or not all(isinstance(n, int) and 0 < n <= _WIDEST_PX for n in size):
        raise TypeError(f"{IMAGE_SIZE} must be width and height, got {size!r:.60}")
    return tuple(size)


def _unwrapped(path: Path, content: Any) -> Unwrapped:
    """Return the weights of a checkpoint, and log once which other contents are left out."""
    unwrapped = unwrap(content)
    if unwrapped.left_out:
        _say_left_out(path, tuple(unwrapped.left_out.items()))
    return unwrapped


@cache
def _say_left_out(path: Path, left_out: tuple[tuple[str, int], ...]) -> None:
    """Log the contents of a checkpoint that are not used, once."""
    text = ", ".join(f"{count} {what}" for what, count in left_out)
    print_log(f"{path}: {text} left out")


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Return the state dict of a checkpoint; arguments and errors as in `read_checked`."""
    return read_checked(path).state


def adopt_settings(
    cfg: Config, path: str | Path, cfg_options: dict | None, read: Checkpoint | None = None
) -> list[str]:
    """Give a config the model settings that a checkpoint was trained with, and list the changes.

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
    given = cfg_options or {}
    if checkpoint.image_size and not any(name.startswith(_SCALED) for name in given):
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
        for name, value in given.items()
        if name.startswith("model.") and not _is_start(name)
    }
    own, model = _model_of(path, settings, config=config, options=options)
    used = plain(model.to_dict())
    lines = [
        f"{name}: {theirs}, as {path} was trained; the config has {mine}"
        for name, (theirs, mine) in differences(used, config, "model").items()
        if not _is_start(name)
    ]
    for name, (asked, theirs) in differences(used, own, "model").items():
        lines.append(f"{name}: {asked}, as asked for; {path} was trained with {theirs}")
    if lines:
        cfg.model = model
        cfg.model.allow_untrained = allowed
    return lines


def _is_start(name: str) -> bool:
    """Whether a dotted name is that of a setting of the start of training."""
    return not STARTS.isdisjoint(name.split("."))


def _model_of(
    path: str | Path, settings: Any, config: dict[str, Any], options: dict[str, Any]
) -> tuple[dict[str, Any], ConfigDict]:
    """Return a checkpoint's settings, checked, and these with overrides; a model builds of both."""
    try:
        settings = _with_elements_of(checked(settings, config), config)
        own = Config({"model": settings})
        own.merge_from_dict(options)
        with building(own):
            MODELS.build(own.model)
    except Exception as error:  # a stranger's settings may end in whatever they like
        reason = (in_words(error) or f"{type(error).__name__}: {error}").rstrip(".")
        raise InputError(
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
    kept = dict(temporal)
    kept.pop("elements", None)
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
        raise InputError(f"{path} does not belong to this config: {error}") from error
    missing = [key for key in result.missing_keys if not key.endswith("num_batches_tracked")]
    if missing or result.unexpected_keys:
        raise InputError(
            f"{path} does not belong to this config: it lacks {listed(missing)} and has "
            f"{listed(result.unexpected_keys)} too many. Give the config that it was trained with "
            "(a copy lies beside it in the work folder)."
        )
