"""Reading of checkpoints, and loading of their weights. Every error message contains a remedy."""

import inspect
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
from mmdet3d.registry import DATASETS, MODELS
from mmengine.config import Config, ConfigDict
from mmengine.logging import print_log
from torch import Tensor, nn

from gsmap.checkpoints.building import building
from gsmap.checkpoints.convert import summarize_names
from gsmap.checkpoints.named_models import find_checkpoint, model_of_file
from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.checkpoints.settings import (
    IMAGE_SIZE,
    MODEL_SETTINGS,
    SIGNALS,
    TRAINING_SETTINGS,
    check_settings,
    differences,
    innermost_datasets,
    plain,
    scale_steps,
)
from gsmap.checkpoints.unwrapping import UnfitError, unwrap
from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_machine_error, user_message
from gsmap.utils.files import fetch_advice
from gsmap.utils.model_facts import calibration_of
from gsmap.utils.split_lists import SPLIT_LIST, checked_identity

# Classes of exception that torch.load raises for damaged files.
_DAMAGE = (
    RuntimeError, EOFError, LookupError, TypeError, AttributeError, AssertionError, ValueError,
    ArithmeticError, OSError, zipfile.BadZipFile,
)  # fmt: skip
# Beginnings of the names of overrides that set the scale of test images.
_SCALE_OPTIONS = ("image_scale", "test_dataloader.dataset.pipeline")
_WIDEST_PX = 100_000  # largest width or height of images that a file may contain
# End of messages about files and settings that are refused.
_REMEDY = "if you trust its origin, save its state_dict alone and give that file."


@dataclass(frozen=True)
class Checkpoint:
    """Contents of a checkpoint that loading and testing use.

    Attributes:
        state: Weights by state key.
        settings: Settings of the model during training, not checked; None if the file has none.
        image_size: Width and height of the training images after scaling, in pixels; None if
            unknown.
        can_bus: Whether the training samples had vehicle signals; False if unknown.
        without_signals: Whether the training samples had no vehicle signals; False if unknown.
        trained_on: Name of the training's data set, and identity of its list of scenes; each is
            empty if unknown.
        dataset_meta: Metadata of the training's data set, not checked.
        calibration: Result of `calibration_of`: the distribution of errors and the interval to
            which the sigmas of the Gaussians were fitted; empty if they were not fitted.
    """

    state: dict[str, Tensor]
    settings: Any
    image_size: tuple[int, int] | None
    can_bus: bool
    without_signals: bool = False
    trained_on: tuple[str, str] = ("", "")
    dataset_meta: Mapping[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)

    def list_of(self, dataset: object) -> str:
        """Identity of the training's list of scenes; empty if ``dataset`` is another data set."""
        training_dataset, identity = self.trained_on
        return identity if training_dataset == dataset else ""


@contextmanager
def refusing(path: object) -> Iterator[None]:
    """Context manager that adds the path, the reason and a remedy to errors of reading.

    Args:
        path: File or address of the checkpoint.

    Raises:
        ValueError: If the block raises an error that the contents of the file cause.
    """
    try:
        yield
    except UnfitError as error:  # its message follows the name of the file
        raise InputError(f"{path} {error}.") from error
    except pickle.UnpicklingError as error:
        reason = str(error).split(". ")[0]  # the first sentence of a long message of torch
        default = f"it is broken, or holds more than tensors and plain data ({reason}); {_REMEDY}"
        raise InputError(f"{path} was not loaded: {_remedy_for(path, default=default)}.") from error
    except _DAMAGE as error:
        # Full memory or a failing disk is not a fault of the file. However, if torch tried to
        # allocate more than the whole file, a size in the file is damaged.
        if is_machine_error(error) and not _exceeds_file_size(error, path=Path(str(path))):
            raise
        default = "fetch it again, or use the checkpoint of an earlier epoch"
        remedy = _remedy_for(path, default=default)
        raise InputError(
            f"{path} is not a whole checkpoint ({type(error).__name__}: {error}); {remedy}."
        ) from error


def _remedy_for(path: object, default: str) -> str:
    """Remedy for a file that cannot be read.

    Pointers of Git LFS and web pages are recognised by the first bytes of the file.

    Args:
        path: File or address of the checkpoint.
        default: Remedy for other files and for addresses.

    Returns:
        The remedy without a period at its end.
    """
    default = default.rstrip(".")
    file_path = Path(str(path))
    if not file_path.is_file():
        return default
    with file_path.open("rb") as file:
        # The caller appends the period of the sentence.
        return fetch_advice(file.read(100), default)


def _exceeds_file_size(error: BaseException, path: Path) -> bool:
    """Whether a failed allocation was larger than a file, because a size in the file is damaged."""
    allocation = re.search(r"allocate (\d+) bytes", str(error))
    if allocation is None or not path.is_file():
        return False
    return int(allocation[1]) > path.stat().st_size


def load_tensors(path: str | Path, map_location: Any = "cpu") -> Any:
    """Load a file of ``torch.save`` without running code from it.

    For a damaged file, `torch.load` raises other exceptions (`_DAMAGE`), which `refusing` converts.

    Args:
        path: The file.
        map_location: Device of the tensors, as ``torch.load`` takes it.

    Returns:
        Tensors and plain data.

    Raises:
        ValueError: If the file is an archive with compressed or overlapping parts. Such a small
            file can fill the memory, and torch never writes one. The message lacks the path, which
            `refusing` adds.
        UnpicklingError: If it contains objects other than tensors and plain data.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            total = 0
            for part in archive.infolist():
                if part.compress_type != zipfile.ZIP_STORED:
                    name = f"{part.filename!r:.60}"
                    raise InputError(f"{name} in it is compressed, which torch never does")
                total += part.file_size
            if total > Path(path).stat().st_size:
                raise InputError(f"its parts overlap: they have {total} bytes in all")
    return torch.load(path, map_location=map_location, weights_only=True)


def read_checked(path: str | Path) -> Checkpoint:
    """Read a checkpoint without running code from it, and check its weights.

    Args:
        path: File of a training, bare state dict, or name of a model.

    Returns:
        Weights and metadata. Values that are described as not checked may be anything in the file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, has no weights, or has weights that are not finite.
    """
    path = find_checkpoint(path)
    with refusing(path):
        # The message hub in mmengine's checkpoints refers to these classes and functions.
        with torch.serialization.safe_globals(mmengine_globals()):
            content = load_tensors(path)
        unwrapped = unwrap(content)  # the state dict, without wrappers around it and in its keys
        if unwrapped.left_out:
            _log_left_out(path, left_out=tuple(unwrapped.left_out.items()))
        # `holder` is the dictionary around the state dict. mmengine stores ``meta`` beside it.
        meta = (unwrapped.holder or {}).get("meta") or {}
        if not isinstance(meta, Mapping):
            # `refusing` converts this error to ValueError.
            raise TypeError(f"meta must be a dictionary, got {meta!r:.60}")
        settings = json.loads(meta[MODEL_SETTINGS]) if MODEL_SETTINGS in meta else None
        # The registry has the image size and the signals of its models, which older files lack. The
        # file has precedence.
        facts = {**_facts_of_named_model(path), **meta}
        dataset_meta = meta.get("dataset_meta")
        if not isinstance(dataset_meta, Mapping):
            dataset_meta = {}
        dataset = str(dataset_meta.get("dataset", ""))
        scene_list = checked_identity(dataset_meta.get(SPLIT_LIST))
        checkpoint = Checkpoint(
            state=unwrapped.state,
            settings=settings,
            image_size=_check_image_size(facts.get(IMAGE_SIZE)),
            can_bus=facts.get(SIGNALS) is True,
            without_signals=meta.get(SIGNALS) is False,
            trained_on=(dataset, scene_list),
            dataset_meta=dataset_meta,
            calibration=calibration_of(meta),
        )
        broken = [key for key, value in unwrapped.state.items() if not value.isfinite().all()]
    if broken:
        raise InputError(
            f"{path} holds NaN or infinite weights ({summarize_names(broken)}): the training that "
            "wrote it had failed; use the checkpoint of an earlier epoch."
        )
    return checkpoint


def _facts_of_named_model(path: Path) -> dict[str, Any]:
    """Return the fields of a file's entry in `named_models`; empty without an entry."""
    model = model_of_file(path)
    return {} if model is None else vars(model)


def _check_image_size(size: Any) -> tuple[int, int] | None:
    """Check the image size that a file contains: width and height in pixels; None if it has none.

    Raises:
        TypeError: If it is neither None nor a width and a height.
    """
    if size is None:
        return None
    if len(size) != 2 or not all(isinstance(n, int) and 0 < n <= _WIDEST_PX for n in size):
        raise TypeError(f"{IMAGE_SIZE} must be width and height, got {size!r:.60}")
    return tuple(size)


@cache
def _log_left_out(path: Path, left_out: tuple[tuple[str, int], ...]) -> None:
    """Log the unused contents of a checkpoint once: the cache skips equal calls.

    Args:
        path: File of the checkpoint.
        left_out: Pairs of a kind of entries and its number, in a tuple that can be a cache key.
    """
    text = ", ".join(f"{count} {kind}" for kind, count in left_out)
    print_log(f"{path}: {text} left out")


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Read the state dict of a checkpoint.

    Args:
        path: File of a training, bare state dict, or name of a model.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, has no weights, or has weights that are not finite.
    """
    return read_checked(path).state


def adopt_settings(
    cfg: Config,
    path: str | Path,
    cfg_options: dict | None,
    checkpoint: Checkpoint | None = None,
) -> list[str]:
    """Set the model settings of a config to the settings with which a checkpoint was trained.

    Settings that only training uses (`TRAINING_SETTINGS`) and ``temporal.elements`` keep the values
    of the config. Test images are scaled to the size of the training images unless ``cfg_options``
    set the scale. If the training samples had vehicle signals, the signals of test samples without
    them are computed from poses; if they had none, the signals of all test samples are zero.
    Loading a checkpoint that lacks weights of the resulting model raises an error, unless the
    config sets ``model.allow_untrained``.

    Args:
        cfg: The config; its ``model`` and ``test_dataloader`` are changed.
        path: The checkpoint, as `read_checked` takes it.
        cfg_options: Overrides of the user by dotted name, which take precedence.
        checkpoint: Contents of the checkpoint; by default they are read from ``path``.

    Returns:
        A line of text for each setting of the config that is changed, and for each override that
        differs from the checkpoint.

    Raises:
        FileNotFoundError: As in `read_checked`, if the checkpoint is read here.
        ValueError: If the settings do not describe a model, or are not allowed (`check_settings`);
            also as in `read_checked`, if the checkpoint is read here.
    """
    if checkpoint is None:
        checkpoint = read_checked(path)
    settings = checkpoint.settings
    overrides = cfg_options or {}
    _adopt_test_data(cfg, checkpoint=checkpoint, overrides=overrides)
    config = plain(cfg.model.to_dict())  # in JSON types, as the settings of a checkpoint are
    # The settings of the checkpoint replace ``cfg.model`` below. The value of ``allow_untrained``
    # is kept, because only the config may allow missing weights.
    allow_untrained = cfg.model.setdefault("allow_untrained", False)
    if settings is None or not differences(settings, others=config):
        return []
    model_overrides: dict[str, Any] = {}
    for name, value in overrides.items():
        if name.startswith("model.") and not _is_training_setting(name):
            model_overrides[name] = value
    trained, model = _build_settings(
        path=path, settings=settings, config=config, overrides=model_overrides
    )
    result = plain(model.to_dict())
    lines: list[str] = []
    # `differences` returns both values of each setting that differs, by its dotted name.
    for name, (used, configured) in differences(result, others=config, name="model").items():
        if not _is_training_setting(name):
            lines.append(f"{name}: {used}, as {path} was trained; the config has {configured}")
    for name, (used, in_training) in differences(result, others=trained, name="model").items():
        lines.append(f"{name}: {used}, as asked for; {path} was trained with {in_training}")
    if lines:
        cfg.model = model
        cfg.model.allow_untrained = allow_untrained
    return lines


def _adopt_test_data(cfg: Config, checkpoint: Checkpoint, overrides: dict[str, Any]) -> None:
    """Set the image scale and the signals of the test data to the values of the training.

    A scale that the user sets is kept, and so are settings of signals in the config. A data set
    class of a user may lack these settings.

    Args:
        cfg: The config; its ``test_dataloader`` is changed.
        checkpoint: Contents of the checkpoint.
        overrides: Overrides of the user by dotted name.
    """
    scale_is_set = any(name.startswith(_SCALE_OPTIONS) for name in overrides)
    if checkpoint.image_size and not scale_is_set:
        for step in scale_steps(cfg, "test"):
            step.trained_size = checkpoint.image_size
    for dataset in innermost_datasets(cfg.test_dataloader.dataset):
        if checkpoint.can_bus and _accepts(dataset, "signals_from_poses"):
            dataset.setdefault("signals_from_poses", True)
        asks_for_signals = dataset.get("signals_from_poses") or dataset.get("pose_only_signals")
        is_unset = checkpoint.without_signals and not asks_for_signals
        if is_unset and _accepts(dataset, "zero_signals"):
            dataset.setdefault("zero_signals", True)


def _accepts(dataset: dict[str, Any], name: str) -> bool:
    """Whether the class of a data set in a config has an argument of this name."""
    kind = dataset.get("type")
    dataset_class = DATASETS.get(kind) if isinstance(kind, str) else kind
    if dataset_class is None:
        return False  # an error follows when it is built
    parameters = inspect.signature(dataset_class).parameters
    takes_any = any(value.kind is value.VAR_KEYWORD for value in parameters.values())
    return name in parameters or takes_any


def _is_training_setting(name: str) -> bool:
    """Whether a dotted name belongs to a setting that only training uses."""
    return not TRAINING_SETTINGS.isdisjoint(name.split("."))


def _build_settings(
    path: str | Path, settings: Any, config: dict[str, Any], overrides: dict[str, Any]
) -> tuple[dict[str, Any], ConfigDict]:
    """Check the settings of a checkpoint, and that a model can be built with the overrides.

    Args:
        path: File of the checkpoint.
        settings: Settings in the checkpoint.
        config: Settings of the model in the config.
        overrides: Overrides of the user by dotted name.

    Returns:
        The settings without the overrides, and the settings with the overrides; both without
        settings that only training uses.

    Raises:
        ValueError: If the settings are not allowed, or no model can be built.
    """
    try:
        settings = check_settings(settings, config=config)  # also removes `TRAINING_SETTINGS`
        settings = _with_elements_of(settings, config=config)
        cfg = Config({"model": settings})
        cfg.merge_from_dict(overrides)
        with building(cfg):
            MODELS.build(cfg.model)  # only a test; the caller builds the model again
    except Exception as error:  # unchecked settings can raise any class of exception
        reason = (user_message(error) or f"{type(error).__name__}: {error}").rstrip(".")
        raise InputError(
            f"{path} was not loaded, because its model settings are refused: {reason}. Give the "
            f"config that it was trained with, or, {_REMEDY}"
        ) from error
    return settings, cfg.model


def _with_elements_of(settings: dict[str, Any], config: dict[str, Any]) -> dict[str, Any]:
    """Replace ``temporal.elements`` in the settings of a checkpoint by the value in the config.

    This setting describes the memory of map elements, which has no weights.

    Args:
        settings: Settings of the model in a checkpoint.
        config: Settings of the model in the config.
    """
    elements = (config.get("temporal") or {}).get("elements")
    temporal = settings.get("temporal") or {}
    if not isinstance(temporal, dict) or temporal.get("elements") == elements:
        return settings
    temporal = dict(temporal)
    temporal.pop("elements", None)
    if elements is not None:
        temporal["elements"] = elements
    # Without any setting left, the model has no temporal part.
    return {**settings, "temporal": temporal or None}


def load_weights(model: nn.Module, path: str | Path, checkpoint: Checkpoint | None = None) -> None:
    """Load a checkpoint into a model. Every weight must be present and have the right shape.

    Args:
        model: Model that receives the weights.
        path: File of the checkpoint, or name of a model.
        checkpoint: Contents of the checkpoint; by default they are read from ``path``.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read or belongs to another architecture; the message contains
            the first keys that differ.
    """
    if checkpoint is None:
        checkpoint = read_checked(path)
    try:
        result = model.load_state_dict(checkpoint.state, strict=False)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{path} does not belong to this config: {error}") from error
    missing: list[str] = []
    for key in result.missing_keys:
        # Counters of normalisation layers, which old checkpoints lack and prediction does not use.
        if not key.endswith("num_batches_tracked"):
            missing.append(key)
    if missing or result.unexpected_keys:
        raise InputError(
            f"{path} does not belong to this config: it lacks {summarize_names(missing)} and has "
            f"{summarize_names(result.unexpected_keys)} too many. Give the config that it was "
            "trained with (a copy lies beside it in the work folder)."
        )
