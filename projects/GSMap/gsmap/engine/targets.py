"""Targets of a config: which transforms make them, and what these take from the head."""

import inspect
from collections.abc import Iterator
from itertools import chain
from typing import Any

from mmdet3d.registry import MODELS, TRANSFORMS
from mmengine.config import Config
from mmengine.registry import Registry

from gsmap.utils.errors import InputError
from gsmap.utils.targets import NeedsTargets


def share_settings(cfg: Config) -> None:
    """Give the transforms that make the targets of a config's head its settings, in place.

    A setting that follows from one of the head (`NeedsTargets.target_settings`) has its source
    there; a transform that names it keeps its value, which `check_targets` compares.

    Args:
        cfg: The config.
    """
    for head in _heads(cfg):
        wanted = _target_settings(head)
        sections = [value for key, value in cfg.items() if key != "model"]
        for step in _steps_of(sections, _needs(head.get("type")).transforms) if wanted else ():
            known = _defaults(class_of_type(step["type"], TRANSFORMS))
            step.update({k: v for k, v in wanted.items() if k in known and k not in step})


def _check_agreement(cfg: Config, steps: list[Any]) -> None:
    """Refuse a transform that names another value of a setting than the head makes it."""
    for head in _heads(cfg):
        wanted = _target_settings(head)
        for step in _steps_of(steps, _needs(head.get("type")).transforms):
            for name in wanted.keys() & step.keys():
                if _plain(step[name]) != _plain(wanted[name]):
                    raise InputError(
                        f"{cfg.filename}: {name} of {step['type']} is {step[name]}, but that of "
                        f"{head['type']} makes it {wanted[name]}: leave it out of the transform, "
                        "which takes it from the head."
                    )


def _target_settings(head: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of transforms that follow from those of a head's config."""
    kind = _needs(head.get("type"))
    try:
        return kind.target_settings({**_defaults(kind), **head})
    except (TypeError, ValueError):  # settings that the head refuses, in words, when it is built
        return {}


def _heads(cfg: Config) -> list[dict[str, Any]]:
    """Return the head of a config, and that of its first stage if it has two."""
    head = (cfg.get("model") or {}).get("map_head")
    if not isinstance(head, dict):
        return []
    return [head, head["detector"]] if isinstance(head.get("detector"), dict) else [head]


def _steps_of(settings: Any, names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield all steps of nested settings that are one of these transforms, or derive from one."""
    if isinstance(settings, list | tuple):
        for inner in settings:
            yield from _steps_of(inner, names)
    elif isinstance(settings, dict):
        kind = class_of_type(settings.get("type"), TRANSFORMS)
        if kind is not None and not {base.__name__ for base in kind.__mro__}.isdisjoint(names):
            yield settings
        for inner in settings.values():
            yield from _steps_of(inner, names)


def _defaults(kind: type | None) -> dict[str, Any]:
    """Return the settings of a class that have defaults, those of its bases included."""
    found: dict[str, Any] = {}
    makers = [vars(base).get("__init__") for base in reversed(kind.__mro__ if kind else ())]
    for maker in filter(None, makers):
        for name, parameter in inspect.signature(maker).parameters.items():
            if parameter.default is not parameter.empty:
                found[name] = parameter.default
    return found


def _plain(value: Any) -> Any:
    """Return a setting with lists in place of tuples."""
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def needed_targets(cfg: Config) -> dict[str, Any]:
    """Return which transforms make the targets of a config's head and of its parts.

    Returns:
        Names of transforms (``transforms`` of the classes), each with the type that needs it.
    """
    heads = _heads(cfg)
    lists = [own.get(name) for own in heads for name in ("losses", "aux_heads")]
    parts = chain(heads, *(part for part in lists if isinstance(part, list)))
    kinds = [part.get("type") for part in parts if isinstance(part, dict)]
    return {name: kind for kind in kinds for name in _needs(kind).transforms}


def _needs(kind: Any) -> type[NeedsTargets]:
    """Return the class of a part, for what it needs; a part of a stranger needs nothing."""
    found = class_of_type(kind)
    return found if found and issubclass(found, NeedsTargets) else NeedsTargets


def class_of_type(kind: Any, registry: Registry = MODELS) -> type | None:
    """Return the class of a type, itself or its name; None if it names none."""
    found = registry.get(kind) if isinstance(kind, str) else kind
    return found if isinstance(found, type) else None


def check_targets(cfg: Config) -> None:
    """Refuse a training pipeline without the transforms that `needed_targets` names."""
    dataset = (cfg.get("train_dataloader") or {}).get("dataset") or {}
    for steps in _pipelines(dataset):
        made = [class_of_type(kind, TRANSFORMS) for kind in _step_types(steps)]
        bases = {base.__name__ for kind in made for base in inspect.getmro(kind or object)}
        for name, kind in needed_targets(cfg).items():
            if name not in bases:
                raise InputError(
                    f"{cfg.filename}: {kind} needs the targets of {name}: add it to the pipeline "
                    "of train_dataloader.dataset."
                )
        _check_agreement(cfg, steps)


def _pipelines(dataset: dict[str, Any]) -> list[list[Any]]:
    """Return the steps of a data set, or of each one that it wraps; none without a data set."""
    own = list(dataset.get("pipeline") or ())
    wrapped = [dataset["dataset"]] if dataset.get("dataset") else dataset.get("datasets") or []
    if wrapped:
        return [[*steps, *own] for part in wrapped for steps in _pipelines(part)]
    return [own] if dataset else []


def _step_types(steps: Any) -> Iterator[Any]:
    """Yield the types of a pipeline's steps, and of those that they wrap."""
    for step in steps:
        if isinstance(step, dict):
            yield step.get("type")
            yield from _step_types(step.get("transforms") or ())
