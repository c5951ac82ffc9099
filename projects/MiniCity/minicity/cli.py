"""Generate the MiniCity data set."""

import argparse

from minicity.config import VERSION
from minicity.generate import generate


def image_size(text: str) -> tuple[int, int]:
    """Width and height from ``800x450``."""
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 800x450, got {text!r}")
    return int(width), int(height)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("--root", required=True, help="output folder, in nuScenes layout")
    parser.add_argument(
        "--scenes", type=int, required=True, help="total number of scenes, a fifth for validation"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of every random choice")
    parser.add_argument("--image-size", type=image_size, default=(800, 450), metavar="WxH")
    parser.add_argument("--samples-per-scene", type=int, default=10, help="key frames per scene")
    parser.add_argument(
        "--sweeps-per-sample", type=int, default=2, help="LiDAR sweeps between key frames"
    )
    parser.add_argument("--val-scenes", type=int, help="validation scenes, instead of a fifth")
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")


def run(arguments: argparse.Namespace) -> str:
    """Generate the data set and say where it lies, and by which ``command`` it was made."""
    made = generate(
        arguments.root,
        arguments.scenes,
        arguments.seed,
        arguments.image_size,
        arguments.samples_per_scene,
        arguments.sweeps_per_sample,
        arguments.val_scenes,
        arguments.workers,
    )
    if not made:
        return f"MiniCity at {arguments.root} is complete already (same arguments): skipped."
    made_by = arguments.command
    return f"MiniCity written to {arguments.root} (version {VERSION}); made by: {made_by}"
