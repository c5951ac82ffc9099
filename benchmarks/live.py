"""Latency of one frame: images in memory in, map elements out."""

import argparse
from functools import partial

import numpy as np
import torch

from benchmarks.measure import markdown_table, measure
from benchmarks.model import ring_of_cameras
from gsmap.apis.map_inferencer import MapInferencer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add which model to measure, and how."""
    parser.add_argument("model", help="name of a trained model, or a config with random weights")
    parser.add_argument("--size", type=int, nargs=2, default=(225, 400), metavar=("H", "W"))
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--amp", action="store_true", help="mixed precision")
    parser.add_argument("--cuda-graphs", action="store_true", help="frames that are replayed")
    parser.add_argument("--repeats", type=int, default=20)


def run(args: argparse.Namespace) -> None:
    """Measure and print the shortest time of a frame, of a rig that is known and of a new one."""
    torch.set_num_threads(args.threads)
    graphs = args.cuda_graphs or None
    inferencer = MapInferencer(args.model, device=args.device, amp=args.amp, cuda_graphs=graphs)
    names = inferencer.cfg.test_dataloader.dataset.cameras
    pixels = np.random.default_rng(0).integers(0, 256, (*args.size, 3), np.uint8)
    images = dict.fromkeys(names, pixels)
    height, width = args.size
    projection = np.eye(4)  # that of `ring_of_cameras`
    projection[:2, :3] = [[width / 2, 0, width / 2], [0, width / 2, height / 2]]
    cam_from_frame = np.linalg.inv(projection) @ ring_of_cameras(len(names), *args.size)
    rig = dict.fromkeys(names, projection[:3, :3]), dict(zip(names, cam_from_frame, strict=True))
    ways = {
        "live(images)": partial(inferencer.live(*rig), images),
        "predict_images(images, ...)": partial(inferencer.predict_images, images, *rig),
    }
    rows = []
    for name, way in ways.items():
        cost = measure(way, torch.device(args.device), args.repeats)
        rows.append([name, f"{1000 * cost.cpu_s:.1f}", f"{1000 * cost.wall_s:.1f}"])
    print(
        f"{args.model}, {len(names)} images of {height} x {width}, {args.device}, {args.threads} "
        f"threads, torch {torch.__version__}\n\n"
        f"{markdown_table(['one frame', 'processor, ms', 'wall clock, ms'], rows)}"
    )
