"""Parameter counts of a model by module."""

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class ParameterCount:
    """Elements of a module's parameters.

    Attributes:
        module: Name of the module; empty for the whole model.
        total: All elements.
        trainable: Elements that require a gradient: what papers count.
    """

    module: str
    total: int
    trainable: int


def count_parameters(model: nn.Module, depth: int = 2) -> list[ParameterCount]:
    """Count the parameters of a model and of its modules.

    Args:
        model: The model.
        depth: Levels of modules to list; 0 lists the whole model alone.

    Returns:
        The whole model first, then its modules in order, without those that hold no parameter.

    Raises:
        ValueError: If ``depth`` is negative.
    """
    if depth < 0:
        raise ValueError(f"depth must be >= 0, got {depth}.")
    counts = []
    for name, module in model.named_modules():
        if name and name.count(".") >= depth:
            continue
        sizes = [(p.numel(), p.requires_grad) for p in module.parameters()]
        total = sum(size for size, _ in sizes)
        if total:
            counts.append(ParameterCount(name, total, sum(size for size, grad in sizes if grad)))
    return counts
