#!/usr/bin/env python
"""Draw what a data set hands to training: images after augmentation, with their ground truth.

Example: ``python tools/browse_dataset.py CONFIG --split train --num 20 --show-dir pictures``.
"""

import argparse

from mmdet3d.registry import DATASETS
from mmengine.utils import track_iter_progress

from gsmap.apis.map_inferencer import spread_evenly
from gsmap.engine.launch import add_config_options, read_config
from gsmap.utils.cli import CommandParser, run_command
from gsmap.visualization.map_visualizer import MapVisualizer, images_from_inputs
from gsmap.visualization.pictures import add_picture_arguments, save_picture


def parse_args() -> argparse.Namespace:
    parser = CommandParser(description=__doc__)
    parser.add_argument("config", help="config file")
    parser.add_argument("--split", default="train", choices=["train", "val", "test"])
    parser.add_argument("--num", type=int, default=20, help="how many samples, evenly spread")
    add_picture_arguments(parser, folder="work_dirs/browse", picture_format="jpg")
    parser.add_argument(
        "--original", action="store_true", help="draw the image files, not the inputs"
    )
    add_config_options(parser)
    return parser.parse_args()


def main() -> str:
    args = parse_args()
    cfg = read_config(args.config, args.cfg_options)
    dataset = DATASETS.build(cfg[f"{args.split}_dataloader"].dataset)
    visualizer = MapVisualizer("browse", show_order=args.order)
    visualizer.dataset_meta = dataset.metainfo
    indices = spread_evenly(len(dataset), args.num)
    for index in track_iter_progress(indices):
        item = dataset[index]
        sample = item["data_samples"]
        images = None if args.original else images_from_inputs(item["inputs"]["img"])
        figure = visualizer.draw_sample(sample, images)
        save_picture(figure, args.show_dir, sample.metainfo["token"], f".{args.format}")
    return f"\n{len(indices)} pictures: {args.show_dir}"


if __name__ == "__main__":
    run_command(main)
