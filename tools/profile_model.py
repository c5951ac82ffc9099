"""Time one forward pass of a config's model by part, each also as a ratio to the image backbone.

Random weights, random images, cameras in a ring; batch 1, float32. CPU seconds of all threads (on a
GPU: wall seconds), the fastest of all repeats, as other processes only slow a part down.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample

from benchmarks.model import ring_of_cameras
from gsmap.engine.launch import read_config


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("configs", nargs="+", help="config files; timed in turn, in one run")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 800), help="rows and columns")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    return parser.parse_args()


def sample(num_cams: int, height: int, width: int) -> Det3DDataSample:
    matrices = ring_of_cameras(num_cams, (height, width))
    eyes = np.stack([np.eye(4)] * num_cams)
    return Det3DDataSample(
        metainfo={
            "token": "random",
            "lidar2img": matrices,
            "cam2img": eyes,
            "lidar2cam": eyes,
            "img_aug_matrix": eyes,
            "lidar2ego": np.eye(4),
            "batch_input_shape": (height, width),
        }
    )


@torch.no_grad()
def profile(model: torch.nn.Module, args: argparse.Namespace) -> dict[str, float]:
    """Return the CPU (on a GPU: wall) seconds of every part, fastest of all repeats."""
    height, width = args.size
    num_cams = 6
    data_sample = sample(num_cams, height, width)
    images = torch.randn(num_cams, 3, height, width, device=args.device)
    images = images.contiguous(memory_format=torch.channels_last)[None]
    on_gpu = args.device != "cpu"
    clock = time.perf_counter if on_gpu else time.process_time
    times: dict[str, list[float]] = {}

    def timed(part: str, function: Callable, *inputs: object) -> object:
        start = clock()
        result = function(*inputs)
        if on_gpu:
            torch.cuda.synchronize()
        times.setdefault(part, []).append(clock() - start)
        return result

    for _ in range(args.repeats + 1):  # the first is a warm-up
        features = timed("image backbone", model.folded_backbone, model.img_backbone, images[0])
        features = timed("image neck", model.img_neck, features)
        features = [feature.unflatten(0, (1, -1)) for feature in features]
        bev = timed("BEV encoder", model.bev_encoder, features, [data_sample.metainfo])
        timed("map head", model.map_head.predict, bev, [data_sample])
    return {part: min(values[1:]) for part, values in times.items()}


def main() -> None:
    args = parse_args()
    torch.set_num_threads(args.threads)
    for config in args.configs:
        model = MODELS.build(read_config(config).model)
        parts = profile(model.to(args.device).eval(), args)
        backbone = parts["image backbone"]
        parts["total"] = sum(parts.values())
        print(f"{config}, {args.size[0]} x {args.size[1]}, {args.threads} threads")
        for part, seconds in parts.items():
            print(f"  {part:<22}{seconds:>8.3f} s {seconds / backbone:>7.3f} of the backbone")


if __name__ == "__main__":
    main()
