"""Embeddings of points, and settings that a method adds to every head."""

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from gsmap.models.base.parts import PARTS

HeadSetting = Callable[[Any], PARTS]  # from its value to settings of `MapHead`

_ADDED: dict[str, HeadSetting] = {}


class PointTable(nn.Embedding):
    """Embeddings of the points of an instance, one table for all instances.

    Args:
        num_points: Points per instance P.
        embed_dims: Channels C of a query; an embedding has twice as many.
    """

    def __init__(self, num_points: int, embed_dims: int) -> None:
        super().__init__(num_points, 2 * embed_dims)

    def forward(self, instances: Tensor) -> Tensor:
        """Return the embeddings of the points of instances. (N, 2 C) -> (N, P, 2 C)"""
        return instances[:, None] + self.weight


def head_setting(name: str) -> Callable[[HeadSetting], HeadSetting]:
    """Return a decorator that adds a setting to `MapHead` and the heads derived from it.

    Args:
        name: Name of the setting.
    """

    def add(setting: HeadSetting) -> HeadSetting:
        _ADDED[name] = setting
        return setting

    return add


def resolve_added_settings(given: PARTS) -> PARTS:
    """Return the settings of `MapHead` that added settings stand for.

    Args:
        given: Values of added settings, by name.

    Raises:
        TypeError: If there is no such setting.
    """
    found: PARTS = {}
    for name, value in given.items():
        if name not in _ADDED:
            raise TypeError(f"MapHead.__init__() got an unexpected keyword argument '{name}'")
        found.update(_ADDED[name](value))
    return found
