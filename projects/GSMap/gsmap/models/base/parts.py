"""Configs of the parts of a head, and checks of the built parts.

A part is an object that a head is composed of, such as its decoder, a loss or a matching cost.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

import torch
from mmdet3d.registry import MODELS
from mmengine.registry import Registry
from torch import Tensor, nn

from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError

PartConfig = dict[str, Any]  # type of the config of a part: its settings by name
WeightConfig = float | Sequence[float]  # type of a weight: one number, or one for each class
# Config without settings, the default of parameters of heads: the part is built with the defaults
# of its class. (None would switch the part off.) It is read-only, since all heads share it.
DEFAULTS: Mapping[str, Any] = MappingProxyType({})


class AuxHead(Protocol):
    """Auxiliary head, a module used in training only.

    Attributes:
        name: Name of its loss.
    """

    name: str

    def loss(self, bev_outputs: dict[str, Any], batch_data_samples: Sequence[Any]) -> Tensor:
        """Weighted loss of a batch.

        Args:
            bev_outputs: Outputs of the BEV encoder, by name.
            batch_data_samples: Samples of the batch, with their annotations.

        Returns:
            Scalar loss.
        """


def with_defaults(settings: Mapping[str, Any] | None, **defaults: Any) -> PartConfig:
    """Config of a part: the given settings, and default values of all other settings.

    Args:
        settings: Given settings. None means that no setting is given.
        defaults: Values of settings that are not given.
    """
    return {**defaults, **(settings or {})}


def build_part(settings: Mapping[str, Any] | None, **defaults: Any) -> Any:
    """Build a part of a model.

    Args:
        settings: Config of the part, or None.
        defaults: Values of settings that the config does not give, ``type`` included.

    Returns:
        Object of the class that the setting ``type`` names in the registry ``MODELS``.
    """
    return MODELS.build(with_defaults(settings, **defaults))


def class_of(part: Mapping[str, Any] | None, registry: Registry = MODELS) -> type | None:
    """Class that a config builds, or None if it has no type or a name that is not registered.

    Args:
        part: Config. Its ``type`` is a class, or the name of a class with or without the scope of
            its registry. None, for a part that another config has removed, has no class.
        registry: Registry in which names are looked up.
    """
    kind = part.get("type") if part else None
    return registry.get(kind) if isinstance(kind, str) else kind  # `get` returns None if unknown


def optional_part(
    kind: type, settings: Mapping[str, Any] | None, **defaults: Any
) -> list[PartConfig]:
    """List of one config, or the empty list if the part is switched off.

    Args:
        kind: Class of the part, unless the settings have a type.
        settings: Settings of the part. None switches it off.
        defaults: Values of settings that are not given.
    """
    if settings is None:
        return []
    return [{"type": kind, **defaults, **settings}]


def set_points_weight(
    parts: Sequence[PartConfig],
    kind: type,
    weight: WeightConfig | None,
    key: str,
    registry: Registry = MODELS,
) -> list[PartConfig]:
    """Copy configs of losses or costs, and replace the weight of the points loss or cost.

    Args:
        parts: Configs of losses or costs.
        kind: Class of the loss or cost of the points. Subclasses do not count.
        weight: New weight. None keeps the configs as they are.
        key: Name of the setting that is the weight, such as ``loss_weight``.
        registry: Registry of the classes of the configs.

    Returns:
        The configs in their order. The configs in ``parts`` are not changed.

    Raises:
        ValueError: If a weight is given and no config has the class.
    """
    if weight is None:
        return list(parts)
    weighted_parts = []
    has_points_part = False
    for part in parts:
        if class_of(part, registry) is kind:
            has_points_part = True
            part = {**part, key: weight}
        weighted_parts.append(part)
    if not has_points_part:
        raise InputError(
            f"points_weight is {weight}, but no config has the type {kind.__name__}: add one, or "
            "set points_weight=None."
        )
    return weighted_parts


def modules_by_name(modules: Sequence[Any]) -> nn.ModuleDict:
    """Dictionary of modules by their attribute ``name``.

    Raises:
        ValueError: If a module has no name, or two modules have an equal name.
    """
    for module in modules:
        if not hasattr(module, "name"):
            raise InputError(f"{type(module).__name__} needs a name: a class attribute `name`.")
    names = [module.name for module in modules]
    check_unique_names(names, kind="parts")
    return nn.ModuleDict(dict(zip(names, modules, strict=True)))


def check_unique_names(names: Sequence[str], kind: str) -> None:
    """Raise ValueError if a name occurs twice.

    Args:
        names: Names to check.
        kind: Plural noun for the error message, such as "losses".
    """
    for name in sorted(names):
        if names.count(name) > 1:
            raise InputError(f"two {kind} have one name, {name!r}; there are {list(names)}.")


def class_weights(weight: WeightConfig, labels: Tensor) -> Tensor:
    """Look up the weight of each element by its class.

    Args:
        weight: One weight, or a weight for each class.
        labels: Class indices. (M,)

    Returns:
        The weights in float32. (M,), or () for one weight
    """
    # A cached tensor on the device of the labels, without a wait for the GPU: (), or (classes,)
    weights = constant(labels, weight, torch.float32)
    return weights[labels] if weights.ndim else weights


def check_weight(part: Any, weight: WeightConfig, classes: Sequence[str]) -> None:
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
