"""How a head's parts are named and put together, and what it refuses when it is built."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

import torch
from mmdet3d.registry import MODELS
from mmengine.registry import Registry
from torch import Tensor, nn

from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError

PARTS = dict[str, Any]
WEIGHT = float | Sequence[float]  # one for all classes, or one for each
DEFAULTS: Mapping[str, Any] = MappingProxyType({})  # settings of a part: all as its class has them


class AuxHead(Protocol):
    """A head that only helps training: a module with the name of its loss."""

    name: str

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Sequence[Any]) -> Tensor:
        """Return the weighted loss on the encoder's outputs."""


def class_of(part: Mapping[str, Any], registry: Registry = MODELS) -> type | None:
    """Return the class of a part's config, whose type is a class or its name, scope or not.

    None if it names none; the registry says so when the part is built.
    """
    kind = part.get("type")
    return registry.get(kind) if isinstance(kind, str) else kind


def optional_part(kind: type, settings: Mapping[str, Any] | None, **defaults: Any) -> list[PARTS]:
    """Return the config of a part that a method brings, or nothing if it is switched off (None)."""
    return [] if settings is None else [{"type": kind, **defaults, **settings}]


def set_points_weight(
    parts: Sequence[PARTS], kind: type, weight: WEIGHT | None, key: str, registry: Registry = MODELS
) -> list[PARTS]:
    """Return configs of losses or costs, with another weight in that of the points.

    Args:
        parts: Configs of losses or costs.
        kind: The class of that of the points.
        weight: Its weight; None leaves all as they are.
        key: The setting that is the weight.
        registry: Where names of classes are looked up.

    Raises:
        ValueError: If a weight is given and there is no such part.
    """
    if weight is None:
        return list(parts)
    found = [class_of(part, registry) is kind for part in parts]
    if not any(found):
        raise InputError(
            f"points_weight is {weight}, and there is no {kind.__name__}: add one, or set "
            "points_weight=None."
        )
    return [{**part, key: weight} if own else part for part, own in zip(parts, found, strict=True)]


def modules_by_name(modules: Sequence[Any]) -> nn.ModuleDict:
    """Return modules by their ``name``; ValueError if two have the same."""
    check_unique_names([module.name for module in modules], "parts")
    return nn.ModuleDict({module.name: module for module in modules})


def check_unique_names(names: Sequence[str], what: str) -> None:
    """Raise ValueError if two have one name."""
    twins = sorted({name for name in names if names.count(name) > 1})
    if twins:
        raise InputError(f"two {what} have one name, {twins[0]!r}; there are {list(names)}.")


def class_weights(weight: WEIGHT, labels: Tensor) -> Tensor:
    """Return each element's weight, by its class. (M,) int64 -> (M,) float32 or ()"""
    weights = constant(labels, weight, torch.float32)
    return weights[labels] if weights.ndim else weights


def check_weight(part: Any, weight: WEIGHT, classes: Sequence[str]) -> None:
    """Raise ValueError if a part has weights, but not one for each class.

    Args:
        part: The loss or cost, for the message.
        weight: Its weight, or one for each class.
        classes: Names of the classes.
    """
    if isinstance(weight, Sequence) and len(weight) != len(classes):
        raise InputError(
            f"{type(part).__name__} has the weights {list(weight)}: give one, or one for each of "
            f"{list(classes)}."
        )


def check_classes(name: str, indices: Sequence[int], classes: Sequence[str]) -> None:
    """Raise ValueError if a setting names a class that does not exist.

    Args:
        name: Name of the setting, for the message.
        indices: Class indices that it has.
        classes: Names of the classes.
    """
    if any(not 0 <= index < len(classes) for index in indices):
        raise InputError(f"{name} must be indices of {list(classes)}, got {tuple(indices)}.")
