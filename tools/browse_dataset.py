#!/usr/bin/env python
"""Draw what a data set hands to training: images after augmentation, with their ground truth.

Example: ``python tools/browse_dataset.py CONFIG --split train --num 20 --show-dir pictures``.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from mmdet3d.registry import DATASETS
from mmengine.config import DictAction
from mmengine.registry import init_default_scope
from mmengine.utils import import_modules_from_strings, track_iter_progress

from gsmap.inference.map_inferencer import read_config
from gsmap.visualization.figure import save_figure
from gsmap.visualization.map_visualization_hook import picture_name
from gsmap.visualization.map_visualizer import MapVisualizer, images_from_inputs


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", help="config file")
    parser.add_argument("--split", default="train", choices=["train", "val", "test"])
    parser.add_argument("--num", type=int, default=20, help="how many samples, evenly spread")
    parser.add_argument("--show-dir", type=Path, default=Path("work_dirs/browse"))
    parser.add_argument("--format", default="jpg", choices=["png", "jpg", "webp", "pdf", "svg"])
    parser.add_argument(
        "--original", action="store_true", help="draw the image files, not the inputs"
    )
    parser.add_argument("--order", action="store_true", help="mark start and direction of elements")
    parser.add_argument(
        "--cfg-options",
        nargs="+",
        action=DictAction,
        metavar="KEY=VALUE",
        help="override settings of the config",
    )
    return parser.parse_args()


def run(args: argparse.Namespace) -> None:
    cfg = read_config(args.config, args.cfg_options)
    import_modules_from_strings(**cfg.get("custom_imports", {"imports": ["gsmap.registered"]}))
    init_default_scope(cfg.get("default_scope", "mmdet3d"))
    dataset = DATASETS.build(cfg[f"{args.split}_dataloader"].dataset)
    visualizer = MapVisualizer("browse", show_order=args.order)
    visualizer.dataset_meta = dataset.metainfo
    indices = np.unique(
        np.linspace(0, len(dataset) - 1, min(args.num, len(dataset))).round().astype(int)
    )
    for index in track_iter_progress(indices.tolist()):
        item = dataset[index]
        sample = item["data_samples"]
        images = None if args.original else images_from_inputs(item["inputs"]["img"])
        figure = visualizer.draw_sample(sample, images)
        save_figure(
            figure, args.show_dir / picture_name(sample.metainfo["token"], f".{args.format}")
        )
    print(f"\n{len(indices)} pictures: {args.show_dir}")


def main() -> None:
    try:
        run(parse_args())
    except (FileNotFoundError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
