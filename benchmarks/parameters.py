"""Parameters of a config's model by module; papers count the trainable ones."""

import argparse
from dataclasses import dataclass

from mmdet3d.registry import MODELS
from torch import nn

from gsmap.engine.launch import read_config


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand ``parameters``."""
    parser = subparsers.add_parser("parameters", help=__doc__)
    parser.add_argument("config", help="config file")
    parser.add_argument("--depth", type=int, default=2, help="levels of modules to list")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Count and print."""
    counts = count_parameters(MODELS.build(read_config(args.config).model), args.depth)
    width = max(len(count.module) for count in counts)
    print(f"{'module'.ljust(width)}  {'all':>12}  {'trainable':>12}")
    for count in counts:
        name = count.module or "model"
        print(f"{name.ljust(width)}  {count.total:>12,}  {count.trainable:>12,}")


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
