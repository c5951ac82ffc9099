"""Configs of the parts of a head, and checks of the built parts."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

import torch
from mmdet3d.registry import MODELS
from mmengine.registry import Registry
from torch import Tensor, nn

from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError

PARTS = dict[str, Any]  # config of a part
WEIGHT = float | Sequence[float]  # one weight, or a weight for each class
DEFAULTS: Mapping[str, Any] = MappingProxyType({})  # all settings as in the class of the part


class AuxHead(Protocol):
    """Auxiliary head, a module used in training only.

    Attributes:
        name: Name of its loss.
    """

    name: str

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Sequence[Any]) -> Tensor:
        """Weighted loss of the outputs of the BEV encoder. ()"""


def with_defaults(settings: Mapping[str, Any] | None, **defaults: Any) -> PARTS:
    """Config of a part, in which defaults complete the given settings.

    Args:
        settings: Given settings, or None.
        defaults: Values of settings that are not given.
    """
    return {**defaults, **(settings or {})}


def build_part(settings: Mapping[str, Any] | None, **defaults: Any) -> Any:
    """Build a part of a model.

    Args:
        settings: Config of the part, or None.
        defaults: Values of settings that the config does not give, ``type`` included.
    """
    return MODELS.build(with_defaults(settings, **defaults))


def class_of(part: Mapping[str, Any], registry: Registry = MODELS) -> type | None:
    """Class of a config, or None if the config has no type or the registry does not know it.

    Args:
        part: Config, whose type is a class or the name of one, with or without a scope.
        registry: Registry of the names.
    """
    kind = part.get("type")
    return registry.get(kind) if isinstance(kind, str) else kind


def optional_part(kind: type, settings: Mapping[str, Any] | None, **defaults: Any) -> list[PARTS]:
    """List of one config, or the empty list if the part is switched off.

    Args:
        kind: Class of the part, unless the settings have a type.
        settings: Settings of the part. None switches it off.
        defaults: Values of settings that are not given.
    """
    if settings is None:
        return []
    return [with_defaults(settings, **{"type": kind, **defaults})]


def set_points_weight(
    parts: Sequence[PARTS], kind: type, weight: WEIGHT | None, key: str, registry: Registry = MODELS
) -> list[PARTS]:
    """Copy configs of losses or costs, with another weight of the points.

    Args:
        parts: Configs of losses or costs.
        kind: Class of the loss or cost of the points.
        weight: Weight of the points. None keeps the configs as they are.
        key: Name of the setting of the weight.
        registry: Registry of the classes.

    Raises:
        ValueError: If a weight is given and no config has the class.
    """
    if weight is None:
        return list(parts)
    weighted_parts = []
    has_points = False
    for part in parts:
        if class_of(part, registry) is kind:
            has_points = True
            part = {**part, key: weight}
        weighted_parts.append(part)
    if not has_points:
        raise InputError(
            f"points_weight is {weight}, and there is no {kind.__name__}: add one, or set "
            "points_weight=None."
        )
    return weighted_parts


def modules_by_name(modules: Sequence[Any]) -> nn.ModuleDict:
    """Dictionary of modules by their attribute ``name``.

    Raises:
        ValueError: If two modules have one name.
    """
    names = [module.name for module in modules]
    check_unique_names(names, kind="parts")
    return nn.ModuleDict(dict(zip(names, modules, strict=True)))


def check_unique_names(names: Sequence[str], kind: str) -> None:
    """Raise ValueError if a name occurs twice.

    Args:
        names: Names.
        kind: Plural noun for the named things, for the message.
    """
    for name in sorted(names):
        if names.count(name) > 1:
            raise InputError(f"two {kind} have one name, {name!r}; there are {list(names)}.")


def class_weights(weight: WEIGHT, labels: Tensor) -> Tensor:
    """Weight of each element, by its class.

    Args:
        weight: One weight, or a weight for each class.
        labels: Class indices. (M,)

    Returns:
        The weights in float32. (M,), or () for one weight
    """
    weights = constant(labels, weight, torch.float32)
    return weights[labels] if weights.ndim else weights


def check_weight(part: Any, weight: WEIGHT, classes: Sequence[str]) -> None:
    """Raise ValueError if the number of weights is not the number of classes.

    Args:
        part: Loss or cost, for the message.
        weight: One weight, which is always valid, or a weight for each class.
        classes: Names of the classes.
    """
    if isinstance(weight, Sequence) and len(weight) != len(classes):
        raise InputError(
            f"{type(part).__name__} has the weights {list(weight)}: give one, or one for each of "
            f"{list(classes)}."
        )


def check_classes(name: str, indices: Sequence[int], classes: Sequence[str]) -> None:
    """Raise ValueError if a class index is out of range.

    Args:
        name: Name of the setting, for the message.
        indices: Class indices.
        classes: Names of the classes.
    """
    for index in indices:
        if not 0 <= index < len(classes):
            raise InputError(f"{name} must be indices of {list(classes)}, got {tuple(indices)}.")
