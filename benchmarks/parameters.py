"""Parameters of a config's model by module; papers count the trainable ones."""

import argparse

from mmdet3d.registry import MODELS
from torch import nn

from gsmap.checkpoints.building import building
from gsmap.engine.launch import read_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("config", help="config file")
    parser.add_argument("--depth", type=int, default=2, help="levels of modules to list")


def run(args: argparse.Namespace) -> None:
    """Count and print."""
    cfg = read_config(args.config)
    with building(cfg):
        counts = count_parameters(MODELS.build(cfg.model), args.depth)
    width = max(map(len, counts))
    print(f"{'module'.ljust(width)}  {'all':>12}  {'trainable':>12}")
    for name, (total, trainable) in counts.items():
        print(f"{(name or 'model').ljust(width)}  {total:>12,}  {trainable:>12,}")


def count_parameters(model: nn.Module, depth: int = 2) -> dict[str, tuple[int, int]]:
    """Count the parameters of a model (named "") and of its modules, all and trainable ones.

    Modules are listed to ``depth`` levels; those that hold no parameter are left out.

    Raises:
        ValueError: If ``depth`` is negative.
    """
    if depth < 0:
        raise ValueError(f"depth must be >= 0, got {depth}.")
    counts = {}
    for name, module in model.named_modules():
        if name and name.count(".") >= depth:
            continue
        sizes = [(p.numel(), p.requires_grad) for p in module.parameters()]
        total = sum(size for size, _ in sizes)
        if total:
            counts[name] = total, sum(size for size, grad in sizes if grad)
    return counts
