"""Generate the MiniCity data set."""

import argparse

from minicity.config import PRESETS, VERSION, MiniCityConfig
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
        "--preset",
        choices=sorted(PRESETS),
        help="data set of a published comparison, in place of the options of size and seed below",
    )
    parser.add_argument("--scenes", type=int, help="total number of scenes, a fifth for validation")
    parser.add_argument("--seed", type=int, help="seed of every random choice (default: 0)")
    parser.add_argument("--image-size", type=image_size, metavar="WxH", help="default: 800x450")
    parser.add_argument("--samples-per-scene", type=int, help="key frames per scene (default: 10)")
    parser.add_argument(
        "--sweeps-per-sample", type=int, help="LiDAR sweeps between key frames (default: 2)"
    )
    parser.add_argument("--val-scenes", type=int, help="validation scenes, instead of a fifth")
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")


SIZE_OPTIONS = (
    "scenes",
    "seed",
    "image_size",
    "samples_per_scene",
    "sweeps_per_sample",
    "val_scenes",
)


def chosen_config(arguments: argparse.Namespace) -> MiniCityConfig:
    """Data set of the command's arguments.

    Raises:
        ValueError: If neither a preset nor ``--scenes`` is given, if a preset is given together
            with an option of size, or if a value is out of range.
    """
    given = {
        name: getattr(arguments, name)
        for name in SIZE_OPTIONS
        if getattr(arguments, name) is not None
    }
    if arguments.preset is not None:
        if given:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise ValueError(f"--preset sets the size and the seed: leave out {options}.")
        return PRESETS[arguments.preset]
    if "scenes" not in given:
        raise ValueError("give --scenes NUMBER, or --preset NAME for a published data set.")
    if "image_size" in given:
        given["image_width"], given["image_height"] = given.pop("image_size")
    return MiniCityConfig(**given)


def run(arguments: argparse.Namespace) -> str:
    """Generate the data set and say where it lies, and by which ``command`` it was made."""
    config = chosen_config(arguments)
    made = generate(
        root=arguments.root,
        scenes=config.scenes,
        seed=config.seed,
        image_size=(config.image_width, config.image_height),
        samples_per_scene=config.samples_per_scene,
        sweeps_per_sample=config.sweeps_per_sample,
        val_scenes=config.val_scenes,
        workers=arguments.workers,
    )
    if not made:
        return f"MiniCity at {arguments.root} is complete already (same arguments): skipped."
    made_by = arguments.command
    return f"MiniCity written to {arguments.root} (version {VERSION}); made by: {made_by}"
