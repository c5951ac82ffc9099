"""Marks of the layers of a model that have weights for each class."""

from typing import Any, NamedTuple


class ClassAxis(NamedTuple):
    """Axis of a layer's weight that has entries for each class, in the order of the classes.

    Attributes:
        dim: Number of the axis: 0 for outputs, where the bias has entries as well, 1 for inputs.
        first: Number of entries before the entries of the first class.
        size: Number of consecutive entries of a class.
    """

    dim: int = 0
    first: int = 0
    size: int = 1


def mark_classes(layer: Any, dim: int = 0, first: int = 0, size: int = 1) -> None:
    """Mark a layer as having entries for each class, with the attribute ``class_axis``.

    When training starts from a checkpoint with other classes, these entries are reordered by class
    (`gsmap.apis.rig_fit`). The entries of layers without a mark are loaded in their order.

    Args:
        layer: Layer with a weight and maybe a bias. It gets the attribute.
        dim: Axis of the weight: 0 for outputs, 1 for inputs.
        first: Number of entries before the entries of the first class.
        size: Number of consecutive entries of a class.
    """
    layer.class_axis = ClassAxis(dim=dim, first=first, size=size)
