"""Loading, ground truth, pipeline: what results/speed.md states."""

import argparse
import json
import tempfile
from pathlib import Path

from benchmarks import data as benchmarks
from benchmarks.memory import measure_memory


def loading(args: argparse.Namespace) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        tiled = Path(folder, "tiled.arrow")
        benchmarks.tile_annotations(args.annotations, tiled, args.samples)
        return benchmarks.measure_loading(tiled)


def ground_truth(args: argparse.Namespace) -> dict[str, float]:
    return benchmarks.measure_ground_truth(args.root, args.annotations)


def pipeline(args: argparse.Namespace) -> dict[str, float]:
    from mmengine.config import Config
    from mmengine.registry import init_default_scope

    import gsmap.registered  # noqa: F401

    init_default_scope("mmdet3d")
    config = Config.fromfile(args.config).train_dataloader.dataset
    config.update(data_root=str(args.root), ann_file=str(args.annotations.resolve()), split=None)
    return benchmarks.measure_pipeline(config, args.root, args.samples)


def images(args: argparse.Namespace) -> dict[str, float]:
    from benchmarks.images import measure_images

    return measure_images(args.folder, args.samples, args.workers)


def argoverse2(args: argparse.Namespace) -> dict[str, float]:
    from benchmarks.argoverse2 import measure_extraction

    return measure_extraction(args.root, args.split, args.stride)


def memory(args: argparse.Namespace) -> dict[str, float]:
    return measure_memory(args.root, args.version, tuple(args.copies))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("loading", help="open and read a file of many samples")
    command.add_argument("annotations", type=Path)
    command.add_argument("--samples", type=int, default=28_130)
    command.set_defaults(measure=loading)
    command = commands.add_parser("ground-truth", help="per frame, prepared and per item")
    command.add_argument("root", type=Path)
    command.add_argument("annotations", type=Path)
    command.set_defaults(measure=ground_truth)
    command = commands.add_parser("pipeline", help="training samples, from the file and per item")
    command.add_argument("root", type=Path)
    command.add_argument("annotations", type=Path)
    command.add_argument("--config", default="configs/_base_/datasets/minicity.py")
    command.add_argument("--samples", type=int, default=20)
    command.set_defaults(measure=pipeline)
    command = commands.add_parser("images", help="image steps of a sample, and samples a second")
    command.add_argument("folder", type=Path, help="six JPEG files, such as a frame of nuScenes")
    command.add_argument("--samples", type=int, default=10)
    command.add_argument("--workers", type=int, nargs="*", default=[], help="numbers of processes")
    command.set_defaults(measure=images)
    command = commands.add_parser("av2", help="Argoverse 2 ground truth per frame")
    command.add_argument("root", type=Path)
    command.add_argument("--split", default="val")
    command.add_argument("--stride", type=int, default=10, help="every N-th pose")
    command.set_defaults(measure=argoverse2)
    command = commands.add_parser("memory", help="peak of the conversion, extrapolated")
    command.add_argument("root", type=Path)
    command.add_argument("--version", default="v1.0-mini")
    command.add_argument("--copies", type=int, nargs=2, default=(16, 48))
    command.set_defaults(measure=memory)


def run(args: argparse.Namespace) -> None:
    """Measure and print the figures as JSON."""
    result = args.measure(args)
    print(json.dumps({name: round(value, 4) for name, value in result.items()}, indent=1))
