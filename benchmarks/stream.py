"""Size of the state that a temporal model keeps for each stream of frames, part by part."""

import argparse

from mmdet3d.registry import MODELS

from gsmap.apis.export import ExportedDetector
from gsmap.checkpoints.building import building
from gsmap.engine.arguments import parse_options
from gsmap.engine.launch import read_config
from gsmap.utils.errors import InputError

_IMAGE_SIZE = (64, 96)  # rows and columns; small, because the state does not depend on them


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks stream`` to a parser."""
    parser.add_argument("config", help="config file of a model with memory and cameras")
    parser.add_argument("--cfg-options", nargs="+", default=[], metavar="K=V", help="overrides")


def run(args: argparse.Namespace) -> None:
    """Measure and print the size of each part of the state.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    sizes = state_bytes(args.config, args.cfg_options)
    sizes["state"] = sum(sizes.values())
    for name, size in sizes.items():
        print(f"{name.ljust(12)}  {size / 1e6:8.3f} MB")


def state_bytes(config: str, options: list[str]) -> dict[str, int]:
    """Size of each part of a stream's state.

    A stream is a sequence of frames of one drive. Its state, the memory of the model, is all
    tensors that the model computes in a frame and reads in the next one. Each tensor is a part.

    Args:
        config: Config file.
        options: Overrides of the config, each ``KEY=VALUE``.

    Returns:
        Bytes by name of the part.

    Raises:
        ValueError: If the model has no memory.
    """
    cfg_options = parse_options(options) if options else None
    cfg = read_config(config, cfg_options)
    if cfg.model.get("img_backbone"):
        cfg.model.img_backbone.init_cfg = None  # loads no pretrained weights
    with building(cfg):  # adds the name of the config to errors
        model = MODELS.build(cfg.model).eval()
    if model.temporal is None:
        raise InputError(f"{config} has no memory: give --cfg-options model.temporal=...")
    exported = ExportedDetector(model)
    num_cams = len(cfg.test_dataloader.dataset.cameras)
    # This call runs the model on a frame. It sets `exported.memory`, the names of the parts, so it
    # must come first. The parts are the last tensors of the inputs, in the order of their names.
    inputs = exported.example_inputs(num_cams, _IMAGE_SIZE)
    state = inputs[len(inputs) - len(exported.memory) :]
    sizes = {}
    for name, value in zip(exported.memory, state, strict=True):
        sizes[name] = value.numel() * value.element_size()
    return sizes
