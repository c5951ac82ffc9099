"""Speed of generating MiniCity, in images per second of processor time on one core.

The time includes towns, textures of the ground, images of six cameras with their JPEG files, LiDAR
sweeps, boxes and records. Processor time hardly depends on other work of the machine.
"""

import argparse
import tempfile
import time
from pathlib import Path

import cv2

from minicity.cli import image_size
from minicity.generate import generate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks minicity`` to a parser."""
    # `image_size` parses a text such as 800x450 to width and height.
    parser.add_argument("--image-size", type=image_size, default=[(800, 450)], nargs="+")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)


def run(arguments: argparse.Namespace) -> None:
    """Generate a data set of each image size, and print the time per image.

    Args:
        arguments: Parsed options of ``add_arguments``.
    """
    cv2.setNumThreads(1)  # by default OpenCV uses all cores
    for width, height in arguments.image_size:
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            generate(
                root=Path(folder) / "root",
                scenes=arguments.scenes,
                seed=arguments.seed,
                image_size=(width, height),
                workers=0,  # in this process, whose processor time is measured
            )
            seconds = time.process_time() - start
        images = 6 * 10 * arguments.scenes  # six cameras; `generate` makes ten samples per scene
        print(
            f"{width}x{height}: {images / seconds:.1f} images/s of one core "
            f"({1000 * seconds / images:.1f} ms an image, {images} images)"
        )
