"""Number of parameters of a config's model, by module.

Papers count in three ways: all parameters, trainable parameters, or entries of the checkpoint.
"""

import argparse

from mmdet3d.registry import MODELS
from torch import nn

from gsmap.checkpoints.building import building
from gsmap.engine.launch import read_config
from gsmap.utils.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks parameters`` to a parser."""
    parser.add_argument("config", help="config file")
    parser.add_argument("--depth", type=int, default=2, help="levels of modules to list")


def run(args: argparse.Namespace) -> None:
    """Count and print the parameters of each module.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    cfg = read_config(args.config)  # also registers the classes that the config names
    with building(cfg):  # adds the names of the config and of its parts to errors
        counts = count_parameters(MODELS.build(cfg.model), args.depth)
    width = max(map(len, counts))
    print(f"{'module'.ljust(width)}  {'all':>12}  {'trainable':>12}  {'entries':>12}")
    for name, (parameters, trainable, entries) in counts.items():
        label = (name or "model").ljust(width)  # the name of the whole model is empty
        print(f"{label}  {parameters:>12,}  {trainable:>12,}  {entries:>12,}")
    print("all and trainable are parameters; entries are numbers in a checkpoint, with buffers")


def count_parameters(model: nn.Module, depth: int = 2) -> dict[str, tuple[int, int, int]]:
    """Count the parameters of a model (named "") and of its modules.

    Args:
        model: The model.
        depth: Levels of modules to list, >= 0; 0 lists only the whole model. Modules without
            parameters are left out.

    Returns:
        By module, the number of parameters, of trainable parameters, and of entries in a
        checkpoint. Entries include buffers, such as the statistics of batch norms. A parameter that
        has two names is one parameter, but its entries are counted twice.

    Raises:
        ValueError: If ``depth`` is negative.
    """
    if depth < 0:
        raise InputError(f"depth must be >= 0, got {depth}.")
    counts = {}
    for name, module in model.named_modules():
        level = name.count(".") + 1 if name else 0
        if level > depth:
            continue
        total = 0
        trainable = 0
        for parameter in module.parameters():
            total += parameter.numel()
            if parameter.requires_grad:
                trainable += parameter.numel()
        if total:
            entries = sum(value.numel() for value in module.state_dict().values())
            counts[name] = (total, trainable, entries)
    return counts
