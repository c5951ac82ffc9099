"""Speed and memory of loading, ground truth, pipelines and conversion, as in results/speed.md."""

import argparse
import json
import tempfile
from pathlib import Path

from benchmarks import data
from benchmarks.memory import measure_memory

# Each function from `loading` to `memory` belongs to one subcommand. It takes the parsed options of
# the subcommand and returns figures by name, which `run` prints.


def loading(args: argparse.Namespace) -> dict[str, float]:
    """Measure the loading of an annotation file, tiled (its samples repeated) to ``--samples``."""
    with tempfile.TemporaryDirectory() as folder:
        tiled = Path(folder, "tiled.arrow")
        data.tile_annotations(args.annotations, tiled, count=args.samples)
        return data.measure_loading(tiled)


def ground_truth(args: argparse.Namespace) -> dict[str, float]:
    """Measure two ways to compute the ground truth of a frame of nuScenes."""
    return data.measure_ground_truth(args.root, args.annotations)


def pipeline(args: argparse.Namespace) -> dict[str, float]:
    """Measure the training pipeline with two sources of ground truth."""
    # Imported here, since the other subcommands do not need these slow imports.
    from mmengine.config import Config
    from mmengine.registry import init_default_scope

    import gsmap.registered  # noqa: F401 - adds the classes that the config names to the registries

    init_default_scope("mmdet3d")  # type names of the config are looked up in mmdet3d's registries
    config = Config.fromfile(args.config).train_dataloader.dataset
    # `split=None` accepts an annotation file of any split.
    config.update(data_root=str(args.root), ann_file=str(args.annotations.resolve()), split=None)
    return data.measure_pipeline(config, args.root, count=args.samples)


def images(args: argparse.Namespace) -> dict[str, float]:
    """Measure the transforms of the images of a sample."""
    from benchmarks.images import measure_images

    return measure_images(args.folder, count=args.samples, workers=args.workers)


def argoverse2(args: argparse.Namespace) -> dict[str, float]:
    """Measure the computation of the ground truth of Argoverse 2."""
    from benchmarks.argoverse2 import measure_extraction

    return measure_extraction(args.root, split=args.split, stride=args.stride)


def memory(args: argparse.Namespace) -> dict[str, float]:
    """Measure the peak memory of the conversion of nuScenes."""
    return measure_memory(args.root, args.version, copies=tuple(args.copies))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of ``benchmarks data`` to a parser."""
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("loading", help="open and read a file of many samples")
    command.add_argument("annotations", type=Path)
    command.add_argument("--samples", type=int, default=28_130)  # nuScenes' training samples
    command.set_defaults(measure=loading)
    command = commands.add_parser(
        "ground-truth",
        help="ground truth of a frame, from a prepared map and from all records of the map",
    )
    command.add_argument("root", type=Path)
    command.add_argument("annotations", type=Path)
    command.set_defaults(measure=ground_truth)
    command = commands.add_parser(
        "pipeline",
        help="time per training sample, with ground truth from the file and computed for each",
    )
    command.add_argument("root", type=Path)
    command.add_argument("annotations", type=Path)
    command.add_argument("--config", default="configs/_base_/datasets/minicity.py")
    command.add_argument("--samples", type=int, default=20)
    command.set_defaults(measure=pipeline)
    command = commands.add_parser("images", help="time of the image transforms of a sample")
    command.add_argument(
        "folder", type=Path, help="folder of six JPEG files, such as a frame of nuScenes"
    )
    command.add_argument("--samples", type=int, default=10)
    command.add_argument(
        "--workers",
        type=int,
        nargs="*",
        default=[],
        help="also measure samples per second with each of these numbers of worker processes",
    )
    command.set_defaults(measure=images)
    command = commands.add_parser("av2", help="Argoverse 2 ground truth per frame")
    command.add_argument("root", type=Path)
    command.add_argument("--split", default="val")
    command.add_argument("--stride", type=int, default=10, help="every N-th pose")
    command.set_defaults(measure=argoverse2)
    command = commands.add_parser(
        "memory", help="peak memory of the conversion, extrapolated to nuScenes trainval"
    )
    command.add_argument("root", type=Path)
    command.add_argument("--version", default="v1.0-mini")
    command.add_argument(
        "--copies",
        type=int,
        nargs=2,
        default=(16, 48),
        help="how often ROOT is repeated in the small and in the large measurement",
    )
    command.set_defaults(measure=memory)


def run(args: argparse.Namespace) -> None:
    """Measure and print the figures as JSON.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    result = args.measure(args)
    rounded = {name: round(value, 4) for name, value in result.items()}
    print(json.dumps(rounded, indent=1))
