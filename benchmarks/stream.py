"""What a model with memory keeps of each stream: its parts and their sizes."""

import argparse

from mmdet3d.registry import MODELS

from gsmap.apis.export import ExportedDetector
from gsmap.checkpoints.building import building
from gsmap.engine.arguments import parse_options
from gsmap.engine.launch import read_config
from gsmap.utils.errors import InputError

_IMAGES = (64, 96)  # rows and columns: the state does not depend on them


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("config", help="config file of a model with memory and cameras")
    parser.add_argument("--cfg-options", nargs="+", default=[], metavar="K=V", help="overrides")


def run(args: argparse.Namespace) -> None:
    """Measure and print."""
    sizes = state_bytes(args.config, args.cfg_options)
    for name, size in {**sizes, "state": sum(sizes.values())}.items():
        print(f"{name.ljust(12)}  {size / 1e6:8.3f} MB")


def state_bytes(config: str, options: list[str]) -> dict[str, int]:
    """Return how many bytes each part of a stream's state has, by name.

    Raises:
        ValueError: If the model has no memory.
    """
    cfg = read_config(config, parse_options(options) if options else None)
    if cfg.model.get("img_backbone"):
        cfg.model.img_backbone.init_cfg = None
    with building(cfg):
        model = MODELS.build(cfg.model).eval()
    if model.temporal is None:
        raise InputError(f"{config} has no memory: give --cfg-options model.temporal=...")
    exported = ExportedDetector(model)
    inputs = exported.example_inputs(len(cfg.test_dataloader.dataset.cameras), _IMAGES)
    kept = inputs[len(inputs) - len(exported.memory) :]
    sizes = (value.numel() * value.element_size() for value in kept)
    return dict(zip(exported.memory, sizes, strict=True))
