"""Generate the MiniCity data set."""

import argparse
from typing import Any

from gsmap.utils.errors import InputError
from minicity.config import PRESETS, VERSION, MiniCityConfig
from minicity.generate import generate


def image_size(text: str) -> tuple[int, int]:
    """Parse an image size such as ``800x450``.

    Args:
        text: Width and height in pixels, separated by ``x``.

    Returns:
        Width and height in pixels.

    Raises:
        argparse.ArgumentTypeError: If the text is no image size.
    """
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 800x450, got {text!r}")
    return int(width), int(height)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``python -m minicity generate`` to a parser."""
    parser.add_argument("--root", required=True, help="output folder, in nuScenes layout")
    parser.add_argument(
        "--preset",
        choices=sorted(PRESETS),
        help="data set of a published comparison; it sets all options below but --workers",
    )
    parser.add_argument("--scenes", type=int, help="number of scenes, a fifth for validation")
    parser.add_argument("--seed", type=int, help="seed of every random choice (default: 0)")
    parser.add_argument("--image-size", type=image_size, metavar="WxH", help="default: 800x450")
    parser.add_argument("--samples-per-scene", type=int, help="key frames per scene (default: 10)")
    parser.add_argument(
        "--sweeps-per-sample", type=int, help="LiDAR sweeps between key frames (default: 2)"
    )
    parser.add_argument("--val-scenes", type=int, help="validation scenes, instead of a fifth")
    parser.add_argument(
        "--passes", type=int, metavar="N", help="drive every scene N times (default: 1)"
    )
    parser.add_argument(
        "--repainted",
        type=float,
        metavar="SHARE",
        help="share of the streets that are repainted before the new passes (default: 0)",
    )
    parser.add_argument(
        "--new-passes",
        type=int,
        metavar="M",
        help="number of passes after the repainting, which validation uses (default: 1)",
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")


# All options that a preset sets: sizes, numbers, the seed and a share. They are fields of
# `MiniCityConfig`, except for ``image_size``, which sets the fields ``image_width`` and
# ``image_height``.
PRESET_OPTIONS = (
    "scenes",
    "seed",
    "image_size",
    "samples_per_scene",
    "sweeps_per_sample",
    "val_scenes",
    "passes",
    "repainted",
    "new_passes",
)


def chosen_config(arguments: argparse.Namespace) -> MiniCityConfig:
    """Make the configuration of the data set from the options of the command line.

    Args:
        arguments: Parsed options of ``add_arguments``.

    Returns:
        Configuration. Options that are not given have the defaults of `MiniCityConfig`.

    Raises:
        ValueError: If neither a preset nor ``--scenes`` is given, if a preset is given together
            with an option that it sets, or if a value is out of range.
    """
    values: dict[str, Any] = {}
    for name in PRESET_OPTIONS:
        value = getattr(arguments, name)
        if value is not None:  # the option was given
            values[name] = value
    if arguments.preset is not None:
        if values:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in values)
            raise InputError(f"--preset sets the size and the seed: leave out {options}.")
        return PRESETS[arguments.preset]
    if "scenes" not in values:
        raise InputError("give --scenes NUMBER, or --preset NAME for a published data set.")
    if "image_size" in values:
        width, height = values.pop("image_size")
        values["image_width"] = width
        values["image_height"] = height
    return MiniCityConfig(**values)


def run(arguments: argparse.Namespace) -> str:
    """Generate the data set that the command line describes.

    Args:
        arguments: Parsed options of ``add_arguments``, and the text of the command line as
            ``command``.

    Returns:
        Summary for the user: the folder and the command that generated it, or a note that the data
        set was complete already.

    Raises:
        ValueError: If the options contradict each other or are out of range (`chosen_config`), or
            if the data set cannot be generated.
    """
    config = chosen_config(arguments)
    is_new = generate(  # False if the folder already contains this data set
        root=arguments.root,
        scenes=config.scenes,
        seed=config.seed,
        image_size=(config.image_width, config.image_height),
        samples_per_scene=config.samples_per_scene,
        sweeps_per_sample=config.sweeps_per_sample,
        val_scenes=config.val_scenes,
        passes=config.passes,
        repainted=config.repainted,
        new_passes=config.new_passes,
        workers=arguments.workers,
    )
    if not is_new:
        return f"MiniCity at {arguments.root} is complete already (same arguments): skipped."
    command = arguments.command
    return f"MiniCity written to {arguments.root} (version {VERSION}); made by: {command}"
