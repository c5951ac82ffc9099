"""Parameters of a config's model by module; papers count all, the trainable, or all entries."""

import argparse

from mmdet3d.registry import MODELS
from torch import nn

from gsmap.checkpoints.building import building
from gsmap.engine.launch import read_config
from gsmap.utils.errors import InputError


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
    print(f"{'module'.ljust(width)}  {'all':>12}  {'trainable':>12}  {'entries':>12}")
    for name, numbers in counts.items():
        print("  ".join([(name or "model").ljust(width), *(f"{n:>12,}" for n in numbers)]))
    print("all and trainable: parameters; entries: numbers in a checkpoint, with buffers")


def count_parameters(model: nn.Module, depth: int = 2) -> dict[str, tuple[int, int, int]]:
    """Count the numbers of a model (named "") and of its modules.

    They are all parameters, the trainable ones, and the entries of a checkpoint: buffers such as
    the statistics of batch norms count, and what has two names counts twice. Modules are listed to
    ``depth`` levels; those that hold no parameter are left out.

    Raises:
        ValueError: If ``depth`` is negative.
    """
    if depth < 0:
        raise InputError(f"depth must be >= 0, got {depth}.")
    counts = {}
    for name, module in model.named_modules():
        if name and name.count(".") >= depth:
            continue
        sizes = [(p.numel(), p.requires_grad) for p in module.parameters()]
        if total := sum(size for size, _ in sizes):
            trainable = sum(size for size, grad in sizes if grad)
            counts[name] = total, trainable, sum(v.numel() for v in module.state_dict().values())
    return counts
