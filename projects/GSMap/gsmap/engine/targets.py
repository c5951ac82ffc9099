"""Transforms of the training pipeline that compute targets, and the settings they share with heads.

A step is an entry of a pipeline in a config: a dictionary with the ``type`` of a transform and its
settings. Heads, losses and auxiliary heads name the transforms that they need (`NeedsTargets`).
"""

import inspect
from collections.abc import Iterator
from functools import cache
from typing import Any

from mmdet3d.registry import MODELS, TRANSFORMS
from mmengine.config import Config
from mmengine.registry import Registry

from gsmap.checkpoints.settings import wrapped_datasets
from gsmap.utils.errors import InputError
from gsmap.utils.targets import NeedsTargets


def share_settings(cfg: Config) -> None:
    """Copy settings of the head to the transforms that compute its targets, in place.

    `NeedsTargets.target_settings` returns the settings to copy. The axis ``forward`` of the model's
    grid is copied, too. A value that the config gives to a transform explicitly is kept;
    `check_targets` compares it with the head.

    Args:
        cfg: Config to change.
    """
    # Steps are searched everywhere outside of the model, because configs nest pipelines in loaders,
    # data set wrappers and variables.
    sections = [value for key, value in cfg.items() if key != "model"]
    for head in _heads(cfg):
        head_settings = _target_settings(cfg, head=head)
        if not head_settings:
            continue
        transform_names = _class_with_targets(head.get("type")).transforms
        for step in _find_steps(sections, names=transform_names):
            transform = class_of_type(step["type"], registry=TRANSFORMS)
            optional_names = _defaults(transform).keys()
            for name, value in head_settings.items():
                if name in optional_names and name not in step:
                    step[name] = value


def _check_agreement(cfg: Config, steps: list[Any]) -> None:
    """Raise ValueError if a setting of a transform contradicts the settings of the head."""
    for head in _heads(cfg):
        head_settings = _target_settings(cfg, head=head)
        transform_names = _class_with_targets(head.get("type")).transforms
        for step in _find_steps(steps, names=transform_names):
            for name in head_settings.keys() & step.keys():
                if _tuples_to_lists(step[name]) != _tuples_to_lists(head_settings[name]):
                    raise InputError(
                        f"{cfg.filename}: {name} of {step['type']} is {step[name]}, but the "
                        f"settings of {head['type']} require {head_settings[name]}: leave it out "
                        "of the transform, which takes it from the head."
                    )


def _target_settings(cfg: Config, head: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of transforms that follow from the grid and a head of a config.

    Returns:
        Settings by name, with ``forward`` if the grid of the model names this axis.
    """
    grid = cfg.model.get("grid")
    forward = grid.get("forward") if isinstance(grid, dict) else None
    grid_settings = {} if forward is None else {"forward": forward}
    # Typed as Any, because the cached function `_defaults` needs a hashable argument, and mypy does
    # not accept the class of a protocol as hashable.
    head_class: Any = _class_with_targets(head.get("type"))
    try:
        head_settings = head_class.target_settings({**_defaults(head_class), **head})
    except (TypeError, ValueError):  # invalid settings, which the head reports when it is built
        head_settings = {}
    return {**grid_settings, **head_settings}


def _heads(cfg: Config) -> list[dict[str, Any]]:
    """Return the head of a config, followed by the first-stage head of a two-stage model.

    A two-stage head contains its first-stage head as the setting ``detector``.
    """
    head = (cfg.get("model") or {}).get("map_head")
    if not isinstance(head, dict):
        return []
    if isinstance(head.get("detector"), dict):
        return [head, head["detector"]]
    return [head]


def _find_steps(settings: Any, names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield the transforms in nested settings whose class or base class has one of the names."""
    if isinstance(settings, list | tuple):
        for item in settings:
            yield from _find_steps(item, names=names)
    elif isinstance(settings, dict):
        transform = class_of_type(settings.get("type"), registry=TRANSFORMS)
        if transform is not None and not _class_names(transform).isdisjoint(names):
            yield settings
        for value in settings.values():
            yield from _find_steps(value, names=names)


def _class_names(cls: type) -> set[str]:
    """Return the names of a class and of all its base classes."""
    return {base.__name__ for base in cls.__mro__}


@cache
def _defaults(cls: type | None) -> dict[str, Any]:
    """Return the default values of a class's constructor arguments, including its base classes.

    The result is shared by all calls and must not be changed.
    """
    defaults: dict[str, Any] = {}
    if cls is None:
        return defaults
    for base in reversed(cls.__mro__):  # base classes first, so that subclasses override them
        constructor = vars(base).get("__init__")
        if constructor is None:
            continue
        for name, parameter in inspect.signature(constructor).parameters.items():
            if parameter.default is not parameter.empty:
                defaults[name] = parameter.default
    return defaults


def _tuples_to_lists(value: Any) -> Any:
    """Convert tuples in a nested setting to lists, so that both compare as equal."""
    if isinstance(value, list | tuple):
        return [_tuples_to_lists(item) for item in value]
    return value


def needed_targets(cfg: Config) -> dict[str, Any]:
    """Return the transforms that compute the targets of a config's head and its parts.

    Returns:
        For each transform, by its name, the type of the head, loss or auxiliary head that needs it.
        If several need the transform, the last of them is named.
    """
    heads = _heads(cfg)
    parts: list[Any] = list(heads)
    for head in heads:
        for name in ("losses", "aux_heads"):
            if isinstance(head.get(name), list):
                parts.extend(head[name])
    targets = {}
    for part in parts:
        if isinstance(part, dict):
            part_type = part.get("type")
            for transform in _class_with_targets(part_type).transforms:
                targets[transform] = part_type
    return targets


def _class_with_targets(kind: Any) -> type[NeedsTargets]:
    """Return the class of a part if it inherits from `NeedsTargets`, otherwise `NeedsTargets`.

    The base class `NeedsTargets` itself has no transforms and no target settings.
    """
    part_class = class_of_type(kind)
    if part_class is not None and issubclass(part_class, NeedsTargets):
        return part_class
    return NeedsTargets


def class_of_type(kind: Any, registry: Registry = MODELS) -> type | None:
    """Return the class of the ``type`` in a config, or None if there is no such class.

    Args:
        kind: Value of ``type``: a class, or the name of a class.
        registry: Registry in which names are looked up.
    """
    cls = registry.get(kind) if isinstance(kind, str) else kind
    return cls if isinstance(cls, type) else None


def check_targets(cfg: Config) -> None:
    """Check that the training pipeline of each data set has the transforms of `needed_targets`.

    Raises:
        ValueError: If a transform is missing, or a setting of a transform contradicts the head.
    """
    dataset = (cfg.get("train_dataloader") or {}).get("dataset") or {}
    for steps in _pipelines(dataset):
        transform_names: set[str] = set()
        for kind in _step_types(steps):
            transform = class_of_type(kind, registry=TRANSFORMS)
            if transform is not None:
                transform_names |= _class_names(transform)
        for name, kind in needed_targets(cfg).items():
            if name not in transform_names:
                raise InputError(
                    f"{cfg.filename}: {kind} needs the targets of {name}: add it to the pipeline "
                    "of train_dataloader.dataset."
                )
        _check_agreement(cfg, steps=steps)


def _pipelines(dataset: dict[str, Any]) -> list[list[Any]]:
    """Return the pipeline of each data set in a config, followed by the steps of its wrappers.

    A wrapper is a data set around another one (``dataset``) or around several (``datasets``).
    Without a data set, the result is empty.
    """
    steps = list(dataset.get("pipeline") or ())
    inner_datasets = wrapped_datasets(dataset)
    if not inner_datasets:
        return [steps] if dataset else []
    pipelines = []
    for inner_dataset in inner_datasets:
        for inner_steps in _pipelines(inner_dataset):
            pipelines.append([*inner_steps, *steps])
    return pipelines


def _step_types(steps: Any) -> Iterator[Any]:
    """Yield the types of all steps of a pipeline, including steps inside of other steps."""
    for step in steps:
        if isinstance(step, dict):
            yield step.get("type")
            yield from _step_types(step.get("transforms") or ())
