#!/usr/bin/env python
"""Run a trained model on samples without ground truth, and draw what it finds.

Example: ``python tools/infer.py gsmap_r18_minicity --sample FOLDER --out map.json --show-dir
pictures``, or ``CONFIG CHECKPOINT`` in place of the name. ``--sample`` takes an annotation file
(.arrow), an info file of mmdet3d (.pkl), or a folder with one.
"""

import argparse
from pathlib import Path

from gsmap.apis.map_inferencer import MapInferencer, select_samples
from gsmap.engine.launch import add_config_options
from gsmap.engine.named_models import checkpoint_for
from gsmap.evaluation.results_json import SHARD_KIND as RESULTS
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.shards import add_shard_option, digest
from gsmap.visualization.figure import FORMATS, picture_name, save_figure


def parse_args() -> argparse.Namespace:
    parser = CommandParser(description=__doc__)
    parser.add_argument("config", help="config file of the model, or the name of one that ships")
    parser.add_argument("checkpoint", nargs="?", help="its checkpoint; not needed with a name")
    parser.add_argument(
        "--sample", type=Path, required=True, help="annotation file, info file or folder"
    )
    parser.add_argument(
        "--allow-missing-cameras", action="store_true", help="leave absent cameras blank"
    )
    parser.add_argument("--token", nargs="+", help="tokens of the samples to run; all by default")
    parser.add_argument("--max-samples", type=int, help="run this many samples, evenly spread")
    parser.add_argument("--out", type=output_file, help="JSON file for the predictions")
    parser.add_argument("--show-dir", type=Path, help="folder for pictures")
    parser.add_argument("--format", default="png", choices=FORMATS)
    parser.add_argument("--order", action="store_true", help="mark start and direction of elements")
    parser.add_argument("--score-thr", type=float, help="smallest drawn score")
    parser.add_argument(
        "--ground-z", type=float, help="height of a level ground in the frame, in metres"
    )
    parser.add_argument("--width", type=int, help="width of the pictures in pixels")
    parser.add_argument("--lidar", action="store_true", help="draw the LiDAR sweep faintly")
    parser.add_argument("--device", help="cpu, cuda, cuda:1, ...; a GPU by default if there is one")
    add_config_options(parser)
    add_shard_option(parser)
    return parser.parse_args()


def main() -> None:
    args = parse_args()
    if not args.out and not args.show_dir:
        raise ValueError("Nothing to do: give --out FILE, --show-dir FOLDER, or both.")
    if args.width is not None and args.width < 1:
        raise ValueError(f"--width must be >= 1 pixel, got {args.width}.")
    checkpoint = checkpoint_for(args.config, args.checkpoint)
    inferencer = MapInferencer(args.config, checkpoint, args.device, args.cfg_options)
    visualizer = inferencer.visualizer
    visualizer.show_order = args.order
    visualizer.ground_z_m = args.ground_z if args.ground_z is not None else visualizer.ground_z_m
    visualizer.width_px = args.width or visualizer.width_px
    dataset = inferencer.dataset(args.sample, args.data_root, args.allow_missing_cameras)
    chosen = select_samples(dataset.annotations.column("token"), args.token, args.max_samples)
    chosen = args.shard.part(chosen)
    found = inferencer.predict(dataset, chosen, allow_missing_cameras=args.allow_missing_cameras)
    samples = []
    for index, sample in zip(chosen, found, strict=True):
        samples.append(sample)
        if args.show_dir:
            points = inferencer.lidar_points(dataset, index) if args.lidar else None
            figure = inferencer.draw(sample, score_thr=args.score_thr, points=points)
            name = picture_name(sample.metainfo["token"], f".{args.format}")
            path = save_figure(figure, args.show_dir / name)
            print(f"[{len(samples)}/{len(chosen)}] {path}")
    if args.out:
        out = args.shard.path_of(args.out)
        inferencer.write(out, samples)
        settings = {"model": args.config, "checkpoint": digest(checkpoint)}
        for name in ("cfg_options", "token", "max_samples", "allow_missing_cameras"):
            settings[name] = str(getattr(args, name))
        source = digest(dataset.annotations.path)
        args.shard.seal(args.out, RESULTS, source, settings, len(samples))
        print(f"predictions of {len(samples)} samples: {out}")


if __name__ == "__main__":
    run_command(main)
