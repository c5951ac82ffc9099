"""Latency of one frame, from images in memory to map elements."""

import argparse
from functools import partial

import numpy as np
import torch

from benchmarks.measure import markdown_table, measure
from benchmarks.model import ring_of_cameras
from gsmap.apis.map_inferencer import MapInferencer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks live`` to a parser."""
    parser.add_argument("model", help="name of a trained model, or a config with random weights")
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        default=(225, 400),
        metavar=("H", "W"),
        help="height and width of each image in pixels",
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2, help="threads of torch on the CPU")
    parser.add_argument("--amp", action="store_true", help="mixed precision")
    parser.add_argument("--cuda-graphs", action="store_true", help="replay frames as CUDA graphs")
    parser.add_argument("--repeats", type=int, default=20, help="number of measured calls")


def run(args: argparse.Namespace) -> None:
    """Measure and print the shortest time of one frame.

    Two ways of predicting are compared. `MapInferencer.live` prepares the calibration once, before
    the measurement, and returns a function of the images alone. `MapInferencer.predict_images`
    takes the calibration as an argument and prepares it in each call.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    torch.set_num_threads(args.threads)
    # Without the option, the inferencer chooses. False would switch CUDA graphs off.
    cuda_graphs = True if args.cuda_graphs else None
    inferencer = MapInferencer(
        args.model, device=args.device, amp=args.amp, cuda_graphs=cuda_graphs
    )
    camera_names = inferencer.cfg.test_dataloader.dataset.cameras
    height, width = args.size
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, size=(height, width, 3), dtype=np.uint8)
    images = dict.fromkeys(camera_names, pixels)  # one image is enough to measure the time
    # The inferencer takes intrinsics and extrinsics apart, but `ring_of_cameras` returns their
    # product. `img_from_cam` equals the intrinsics in that function, so its inverse times the
    # product gives the extrinsics. "ref" is the frame of the map (x right, y forward, z up).
    img_from_cam = np.eye(4)
    img_from_cam[:2, :3] = [[width / 2, 0, width / 2], [0, width / 2, height / 2]]
    img_from_ref = ring_of_cameras(len(camera_names), height=height, width=width)  # (V, 4, 4)
    cam_from_ref = np.linalg.inv(img_from_cam) @ img_from_ref  # (V, 4, 4)
    intrinsics = dict.fromkeys(camera_names, img_from_cam[:3, :3])
    extrinsics = dict(zip(camera_names, cam_from_ref, strict=True))
    predict_live = inferencer.live(intrinsics, extrinsics)
    calls = {
        "live(images)": partial(predict_live, images),
        "predict_images(images, ...)": partial(
            inferencer.predict_images, images, intrinsics, extrinsics
        ),
    }
    rows = []
    for name, call in calls.items():
        cost = measure(call, torch.device(args.device), repeats=args.repeats)
        rows.append([name, f"{1000 * cost.cpu_s:.1f}", f"{1000 * cost.wall_s:.1f}"])
    title = (
        f"{args.model}, {len(camera_names)} images of {height} x {width}, {args.device}, "
        f"{args.threads} threads, torch {torch.__version__}"
    )
    table = markdown_table(["one frame", "processor, ms", "wall clock, ms"], rows)
    print(f"{title}\n\n{table}")
