"""Embeddings of points, and settings that a map model such as MGMap adds to all heads."""

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from gsmap.models.base.parts import PartConfig

# Function from the value of an added setting to the settings of `MapHead` that implement it.
HeadSetting = Callable[[Any], PartConfig]

_ADDED_SETTINGS: dict[str, HeadSetting] = {}  # by name; `head_setting` adds to it at imports


class PointTable(nn.Embedding):
    """Embeddings of the points of an instance, shared by all instances.

    Args:
        num_points: Points per instance P.
        embed_dims: Channels C of a query. An embedding has 2 C channels: C for the content of the
            query and C for its positional encoding.
    """

    def __init__(self, num_points: int, embed_dims: int) -> None:
        super().__init__(num_points, 2 * embed_dims)

    def forward(self, instances: Tensor) -> Tensor:
        """Add the embeddings of the points to embeddings of instances. (N, 2 C) -> (N, P, 2 C)"""
        return instances[:, None] + self.weight


def head_setting(name: str) -> Callable[[HeadSetting], HeadSetting]:
    """Decorator that adds a setting to `MapHead` and its subclasses.

    The decorated function returns the settings of `MapHead` for a value of the added setting.

    Args:
        name: Name of the setting.
    """

    def add(setting: HeadSetting) -> HeadSetting:
        _ADDED_SETTINGS[name] = setting
        return setting

    return add


def resolve_added_settings(values: PartConfig) -> PartConfig:
    """Convert added settings to the settings of `MapHead` that implement them.

    Args:
        values: Values of the settings added with `head_setting`, by name.

    Returns:
        Settings of `MapHead`, by name.

    Raises:
        TypeError: If a setting does not exist.
    """
    head_settings: PartConfig = {}
    for name, value in values.items():
        if name not in _ADDED_SETTINGS:
            # The text is Python's text for an unknown argument, because the settings are further
            # keyword arguments of `MapHead`.
            raise TypeError(f"MapHead.__init__() got an unexpected keyword argument '{name}'")
        setting = _ADDED_SETTINGS[name]
        head_settings.update(setting(value))
    return head_settings
