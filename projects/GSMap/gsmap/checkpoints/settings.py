"""Model settings of a training, as stored in its checkpoint."""

import json
import re
from collections.abc import Mapping
from typing import Any

from mmdet3d.registry import MODELS, TASK_UTILS
from mmengine.config import Config, ConfigDict

from gsmap.utils.errors import InputError

# Key in a checkpoint's meta. The value is JSON, and not the text of a config, because such a text
# is run as code.
MODEL_SETTINGS = "model_settings"
# Settings that only training uses, such as initial weights. `check_settings` removes them from the
# settings of a checkpoint, because some of them load files.
TRAINING_SETTINGS = {
    "init_cfg", "pretrained", "equal_weights", "uniform_positions", "allow_untrained", "autocast",
    "compiled",
}  # fmt: skip
IMAGE_SIZE = "image_size"  # key in a checkpoint's meta: width and height of the scaled images
SIGNALS = "can_bus"  # key in a checkpoint's meta: whether training samples had vehicle signals
# Types in old checkpoints, and the types that replace them with equal arguments.
_REPLACEMENTS = {"Det3DDataPreprocessor": "MapDataPreprocessor"}
_KEY = re.compile(r"[a-zA-Z]\w*")
_TEXT = re.compile(r"[\w -]*")  # excludes file names, addresses, modules and expressions
_LARGEST = 1_000_000  # largest number in a setting, such as a number of channels or voxels
_DEEPEST = 20  # largest depth of nested settings


def plain(settings: Any) -> Any:
    """Convert settings to JSON types: tuples to lists, other objects to strings."""
    return json.loads(json.dumps(settings, default=str))


def differences(ours: Any, others: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Compare nested settings.

    Args:
        ours: Nested dictionaries, lists and plain values.
        others: Settings to compare with.
        name: Prefix of the names.

    Returns:
        Both values of each setting that differs, by dotted name; None for an absent value.
    """
    if isinstance(ours, list) and isinstance(others, list):
        return differences(dict(enumerate(ours)), others=dict(enumerate(others)), name=name)
    if not (isinstance(ours, Mapping) and isinstance(others, Mapping)):
        return {} if ours == others else {name: (ours, others)}
    unequal: dict[str, tuple[Any, Any]] = {}
    for key in dict.fromkeys([*ours, *others]):  # each key once, in a fixed order
        inner_name = f"{name}.{key}" if name else str(key)
        unequal |= differences(ours.get(key), others=others.get(key), name=inner_name)
    return unequal


def scale_steps(cfg: Config, *parts: str) -> list[ConfigDict]:
    """Steps that scale images in pipelines of a config.

    Args:
        cfg: The config.
        parts: Splits of the pipelines, ``"train"``, ``"val"`` or ``"test"``.
    """
    return [step for step in pipeline_steps(cfg, *parts) if step.get("type") == "ScaleImages"]


def pipeline_steps(cfg: Config, *parts: str) -> list[ConfigDict]:
    """All steps in pipelines of a config.

    Args:
        cfg: The config.
        parts: Splits of the pipelines, ``"train"``, ``"val"`` or ``"test"``.
    """
    steps: list[ConfigDict] = []
    for part in parts:
        loader = cfg.get(f"{part}_dataloader") or {}
        for dataset in nested_datasets(loader.get("dataset") or {}):
            for step in dataset.get("pipeline") or []:
                # mmengine also allows functions, which have no settings.
                if isinstance(step, ConfigDict):
                    steps.append(step)
    return steps


def wrapped_datasets(dataset: Mapping[str, Any]) -> list[Any]:
    """Configs of the data sets directly inside of a wrapper such as ``ConcatDataset``.

    Args:
        dataset: Config of a data set. The result is empty if it is no wrapper.
    """
    if dataset.get("dataset") is not None:
        return [dataset["dataset"]]
    return list(dataset.get("datasets") or [])


def nested_datasets(dataset: Any) -> list[Any]:
    """Config of a data set, followed by the configs of all data sets inside of it."""
    nested = [dataset]
    for inner_dataset in wrapped_datasets(dataset):
        nested += nested_datasets(inner_dataset)
    return nested


def innermost_datasets(dataset: Any) -> list[Any]:
    """Configs of the data sets inside of all wrappers, or the config itself without a wrapper."""
    return [inner for inner in nested_datasets(dataset) if not wrapped_datasets(inner)]


def dataset_of(cfg: Config, part: str) -> ConfigDict:
    """Config of the data set of a split.

    Args:
        cfg: The config.
        part: Split, ``"train"``, ``"val"`` or ``"test"``.

    Raises:
        ValueError: If the config has no data for this split.
    """
    dataset = (cfg.get(f"{part}_dataloader") or {}).get("dataset")
    if not dataset:
        name = cfg.filename or "the config"
        raise InputError(f"{name} has no {part}_dataloader.dataset, which is needed here.")
    return dataset


def single_dataset_of(cfg: Config, part: str, purpose: str) -> ConfigDict:
    """Config of the data set of a split, which must be no wrapper of other data sets.

    Args:
        cfg: The config.
        part: Split, ``"train"``, ``"val"`` or ``"test"``.
        purpose: Option or command that needs a single data set, for the error.

    Raises:
        ValueError: If the config has no data for this split, or the data set is a wrapper.
    """
    dataset = dataset_of(cfg, part)
    if wrapped_datasets(dataset):
        raise InputError(
            f"{purpose}: {part}_dataloader.dataset of {cfg.filename or 'the config'} is a "
            f"{dataset.type} of other data sets: name one of these instead."
        )
    return dataset


def check_settings(settings: Any, config: dict[str, Any]) -> dict[str, Any]:
    """Check the settings of a checkpoint, which must do no more than configure a model.

    mmengine imports the module of a type that is not registered. Some registered classes of other
    packages run a string as code, or read the file that it names. Therefore a type must be
    registered, and must be a class of this project, a layer of torch or a type of the config. Other
    strings must be plain words or strings of the config.

    Args:
        settings: Settings from the JSON in the checkpoint.
        config: Settings of the model in the config, converted by `plain`. They are trusted.

    Returns:
        The settings without `TRAINING_SETTINGS`.

    Raises:
        ValueError: If a key or a value is not allowed; the message contains its dotted name.
    """
    if not isinstance(settings, dict):
        raise InputError(f"model must be a dictionary, got {settings!r:.60}")
    return _check_value(settings, name="model", known=_strings(config))


def _check_value(value: Any, name: str, known: set[str]) -> Any:
    """Check a setting and all nested ones.

    Args:
        value: Value of the setting.
        name: Dotted name of the setting.
        known: Keys and strings of the config, which are allowed.

    Returns:
        The value without `TRAINING_SETTINGS`, and with current types in place of old ones.
    """
    if name.count(".") > _DEEPEST:
        raise InputError(f"{name[:60]}... is nested too deep")
    if isinstance(value, list):
        items: list[Any] = []
        for index, item in enumerate(value):
            items.append(_check_value(item, name=f"{name}.{index}", known=known))
        return items
    if isinstance(value, dict):
        return _check_mapping(value, name=name, known=known)
    if name.endswith(".type"):
        return _check_type(value, name=name, known=known)
    if isinstance(value, str):
        is_plain_word = _TEXT.fullmatch(value) is not None
        if not is_plain_word and value not in known:
            raise InputError(
                f"{name} is {value!r:.60}, which is neither a plain word nor in the config"
            )
    if isinstance(value, (int, float)) and not abs(value) <= _LARGEST:  # refuses NaN as well
        raise InputError(f"{name} is {value!r:.60}, not within {_LARGEST}")
    return value


def _check_mapping(settings: dict[str, Any], name: str, known: set[str]) -> dict[str, Any]:
    """Check the keys and the values of a dictionary; arguments as for `_check_value`."""
    for key in settings:
        is_setting_name = _KEY.fullmatch(key) is not None
        # mmengine's `_scope_` and similar keys are never allowed.
        is_config_key = key in known and not key.startswith("_")
        if not (is_setting_name or is_config_key):
            raise InputError(f"{name} has the key {key!r:.60}, which is no name of a setting")
    result: dict[str, Any] = {}
    for key, value in settings.items():
        if key not in TRAINING_SETTINGS:
            result[key] = _check_value(value, name=f"{name}.{key}", known=known)
    return result


def _check_type(kind: Any, name: str, known: set[str]) -> Any:
    """Check that a type may be built, and return its current name.

    Args:
        kind: Name of the type.
        name: Dotted name of the setting.
        known: Keys and strings of the config, which are allowed.

    Raises:
        ValueError: If the type is not registered or not trusted.
    """
    if kind not in known:  # a type of the config is a current one
        kind = _REPLACEMENTS.get(kind, kind)
    registered_class = _find_registered(kind) if isinstance(kind, str) else None
    module = str(getattr(registered_class, "__module__", ""))
    is_trusted = module.startswith(("gsmap.", "torch.nn.")) or kind in known
    if registered_class is None or not is_trusted:
        raise InputError(
            f"{name} is {kind!r:.60}, which is neither a class of this project or of torch.nn nor "
            "in the config"
        )
    return kind


def _find_registered(kind: str) -> Any:
    """Find a class in the registries by name; None if it is absent.

    A name with a scope, such as ``mmdet`` in ``mmdet.DETRHead``, is looked up in the registries of
    this scope. A name without a scope is looked up in the registries of mmdet3d and in their roots,
    which are the registries of mmengine. Only modules of the packages of these registries are
    imported.
    """
    scope, _, bare_name = kind.rpartition(".")
    for registry in (MODELS, TASK_UTILS):
        holders = [registry, registry.root]  # registries that may hold the class
        if scope:
            holders += registry.root.children.values()
            holders = [holder for holder in holders if holder.scope == scope]
        for holder in holders:
            holder.import_from_location()  # imports the modules of the holder's package
            if bare_name in holder.module_dict:
                return holder.module_dict[bare_name]
    return None


def _strings(value: Any) -> set[str]:
    """All keys and strings in nested settings."""
    if isinstance(value, str):
        return {value}
    strings: set[str] = set()
    if isinstance(value, dict):
        strings.update(value)
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            strings |= _strings(item)
    return strings
