#!/usr/bin/env python
"""Draw training samples: augmented images with their ground truth.

Example: ``python tools/browse_dataset.py CONFIG --split train --num 20 --show-dir pictures``.
``--web dataset.html`` writes an interactive page with the original image files instead.
"""

import argparse
from pathlib import Path

from gsmap.engine.arguments import add_config_options
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.progress import Progress
from gsmap.visualization.figure import FORMATS, sample_name, save_figure
from gsmap.visualization.page.page import PageOptions, page_data, write_page


def parse_args() -> argparse.Namespace:
    parser = CommandParser(description=__doc__)
    parser.add_argument("config", help="config: its file or its name")
    parser.add_argument("--split", default="train", choices=["train", "val", "test"])
    parser.add_argument("--num", type=int, default=20, help="how many samples, evenly spread")
    parser.add_argument(
        "--show-dir", type=Path, default="work_dirs/browse", help="folder for pictures"
    )
    parser.add_argument("--format", default="jpg", choices=FORMATS)
    parser.add_argument("--order", action="store_true", help="mark start and direction of elements")
    parser.add_argument(
        "--original", action="store_true", help="draw the image files, not the inputs"
    )
    parser.add_argument(
        "--web", type=output_file, metavar="PAGE", help="write an HTML page instead"
    )
    add_config_options(parser)
    return parser.parse_args()


def main() -> str:
    args = parse_args()
    # Imported after the options are parsed, because these libraries are slow to import.
    from mmdet3d.registry import DATASETS

    from gsmap.apis.map_inferencer import spread_evenly
    from gsmap.checkpoints.building import building
    from gsmap.checkpoints.settings import dataset_of, single_dataset_of
    from gsmap.engine.launch import read_config
    from gsmap.visualization.map_visualizer import MapVisualizer, images_from_inputs

    cfg = read_config(args.config, args.cfg_options)
    settings = dataset_of(cfg, args.split)
    if args.web:
        settings = single_dataset_of(cfg, part=args.split, purpose="--web")
    with building(cfg):  # adds the name of the config and of its part to errors
        dataset = DATASETS.build(settings)
    if args.web:
        options = PageOptions(data_root=Path(dataset.data_root), max_frames=args.num)
        # The page has no results ({}), only ground truth and images. A summary is returned.
        return write_page(args.web, page_data(dataset.ann_file, {}, options))
    visualizer = MapVisualizer("browse", show_order=args.order)
    visualizer.dataset_meta = dataset.metainfo
    indices = spread_evenly(len(dataset), args.num)
    for index in Progress(indices, unit="pictures"):
        item = dataset[index]
        sample = item["data_samples"]
        # For None, `draw_sample` reads the original image files.
        images = None if args.original else images_from_inputs(item["inputs"]["img"])
        figure = visualizer.draw_sample(sample, images)
        save_figure(figure, args.show_dir / sample_name(sample.metainfo, f".{args.format}"))
    return f"{len(indices)} pictures: {args.show_dir}"


if __name__ == "__main__":
    run_command(main)
