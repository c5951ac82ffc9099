"""The settings that a model was trained with, as they stand in its checkpoint."""

import json
import re
from collections.abc import Mapping
from typing import Any

from mmdet3d.registry import MODELS, TASK_UTILS
from mmengine.config import Config, ConfigDict

from gsmap.utils.errors import InputError

MODEL_SETTINGS = "model_settings"  # key of a checkpoint's meta: JSON, as a config's text is code
# settings of a training alone; those of its start may load files
STARTS = {
    "init_cfg", "pretrained", "equal_weights", "uniform_positions", "allow_untrained", "autocast",
    "compiled",
}  # fmt: skip
IMAGE_SIZE = "image_size"  # key of a checkpoint's meta: width and height that images are scaled to
SIGNALS = "can_bus"  # key of a checkpoint's meta: whether training samples had vehicle signals
# what a checkpoint names and later versions replace by a part with the same arguments
_RENAMED = {"Det3DDataPreprocessor": "MapDataPreprocessor"}
_KEY = re.compile(r"[a-zA-Z]\w*")
_TEXT = re.compile(r"[\w -]*")  # no name of a file, an address or a module, and no expression
_LARGEST = 1_000_000  # layers, channels, voxels
_DEEPEST = 20


def plain(settings: Any) -> Any:
    """Return settings as JSON knows them: tuples are lists, objects their text."""
    return json.loads(json.dumps(settings, default=str))


def differences(ours: Any, others: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Return both values of what differs, by dotted name; None is what is not there.

    Args:
        ours: Nested dictionaries, lists and plain values.
        others: What to compare them with.
        name: What the names begin with.
    """
    if isinstance(ours, list) and isinstance(others, list):
        return differences(dict(enumerate(ours)), dict(enumerate(others)), name)
    if not (isinstance(ours, Mapping) and isinstance(others, Mapping)):
        return {} if ours == others else {name: (ours, others)}
    found: dict[str, tuple[Any, Any]] = {}
    for key in dict.fromkeys([*ours, *others]):
        inner = f"{name}.{key}" if name else str(key)
        found |= differences(ours.get(key), others.get(key), inner)
    return found


def scale_steps(cfg: Config, *parts: str) -> list[ConfigDict]:
    """Return the steps that scale images in pipelines of a config: train's, val's, test's."""
    return [step for step in pipeline_steps(cfg, *parts) if step.get("type") == "ScaleImages"]


def pipeline_steps(cfg: Config, *parts: str) -> list[ConfigDict]:
    """Return all steps in pipelines of a config: train's, val's, test's."""
    loaders = [cfg.get(f"{part}_dataloader") or {} for part in parts]
    pipelines = [loader.get("dataset", {}).get("pipeline") or [] for loader in loaders]
    return [step for pipeline in pipelines for step in pipeline if isinstance(step, ConfigDict)]


def checked(settings: Any, config: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a checkpoint, without `STARTS`, if all they do is to set a model.

    mmengine imports the module of a type that is not registered, and some classes that others
    register run a text as code or read the file that it names. So a type must be registered, and be
    this project's, one of torch's layers or one of the config's. Other texts must be plain words or
    the config's.

    Args:
        settings: As the JSON in the checkpoint has them.
        config: The model's settings in the config, which are trusted, from `plain`.

    Raises:
        ValueError: If they hold anything else; the message names the setting.
    """
    if not isinstance(settings, dict):
        raise InputError(f"model must be a dictionary, got {settings!r:.60}")
    return _checked(settings, "model", _words(config))


def _checked(value: Any, name: str, known: set[str]) -> Any:
    """Return a setting if all in it is allowed; ``known`` are the config's keys and texts."""
    if name.count(".") > _DEEPEST:
        raise InputError(f"{name[:60]}... is nested too deep")
    if isinstance(value, list):
        return [_checked(inner, f"{name}.{i}", known) for i, inner in enumerate(value)]
    if isinstance(value, dict):
        for key in value:
            if not _KEY.fullmatch(key) and (key not in known or key.startswith("_")):
                raise InputError(f"{name} has the key {key!r:.60}, which is no name of a setting")
        pairs = ((key, inner) for key, inner in value.items() if key not in STARTS)
        return {key: _checked(inner, f"{name}.{key}", known) for key, inner in pairs}
    if name.endswith(".type"):
        if value not in known:
            value = _RENAMED.get(value, value)
        _check_type(value, name, known)
    elif isinstance(value, str) and not (_TEXT.fullmatch(value) or value in known):
        raise InputError(f"{name} is {value!r:.60}, no plain word and not the config's")
    elif isinstance(value, (int, float)) and not abs(value) <= _LARGEST:  # NaN neither
        raise InputError(f"{name} is {value!r:.60}, not within {_LARGEST}")
    return value


def _check_type(kind: Any, name: str, known: set[str]) -> None:
    """Refuse a type that is not to be built from a file."""
    made = _registered(kind) if isinstance(kind, str) else None
    own = str(getattr(made, "__module__", "")).startswith(("gsmap.", "torch.nn."))
    if made is None or not (own or kind in known):
        raise InputError(f"{name} is {kind!r:.60}, no part of this project and not of the config")


def _registered(kind: str) -> Any:
    """Return what the registries hold under a name, with a scope or without; import no other."""
    scope, _, bare = kind.rpartition(".")
    for registry in (MODELS, TASK_UTILS):
        for holder in (registry, registry.root, *registry.root.children.values()):
            reachable = scope == holder.scope if scope else holder in (registry, registry.root)
            if reachable:
                holder.import_from_location()  # the package's own modules
            if reachable and bare in holder.module_dict:
                return holder.module_dict[bare]
    return None


def _words(value: Any) -> set[str]:
    """Return the keys and texts in nested settings."""
    if isinstance(value, dict):
        return {*value, *_words(list(value.values()))}
    if isinstance(value, list):
        return set().union(*map(_words, value))
    return {value} if isinstance(value, str) else set()
