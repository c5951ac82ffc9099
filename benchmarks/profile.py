"""Time of one forward pass of a config's model by part, also as a ratio to the image backbone.

Weights and images are random, and the cameras form a ring. The batch has one sample in float32.
With the option ``--fp16``, the model runs under autocast. The time is the processor time of all
threads or, on a GPU, the wall-clock time. It is the shortest of all repeats, because other
processes can only slow a part down.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.model import add_arguments, model_and_batch

__all__ = ["add_arguments", "run"]


def run(args: argparse.Namespace) -> None:
    """Measure and print the time of every part of every config's model.

    Args:
        args: Parsed options of ``add_arguments``, among them ``configs``, a list of config files.
    """
    for config in args.configs:
        seconds_by_part, (cameras, height, width) = profile(config, args)
        backbone_seconds = seconds_by_part["image backbone"]
        seconds_by_part["total"] = sum(seconds_by_part.values())
        print(f"{config}, {cameras} cameras of {height} x {width}, {args.threads} threads")
        for part, seconds in seconds_by_part.items():
            ratio = seconds / backbone_seconds
            print(f"  {part:<22}{seconds:>8.3f} s {ratio:>7.3f} of the backbone")


@torch.no_grad()
def profile(path: str, args: argparse.Namespace) -> tuple[dict[str, float], tuple[int, int, int]]:
    """Measure the parts of a config's model.

    Args:
        path: Config file.
        args: Parsed options of ``add_arguments``.

    Returns:
        Shortest time in seconds of every part: ``image backbone``, ``image neck`` (if the model has
        one), ``BEV encoder`` and ``map head``; and the number of cameras, image rows and columns.
    """
    # The inputs have the images ``imgs`` (1, V, 3, H, W), and the sample has the calibration.
    model, inputs, samples = model_and_batch(path, args)
    model.eval()
    cameras, _, height, width = inputs["imgs"][0].shape
    # The BEV encoder reads the size of the padded images from the metainfo.
    samples[0].set_metainfo({"batch_input_shape": (height, width)})
    # The V images of the only sample (V, 3, H, W), in the memory format that the model uses.
    images = inputs["imgs"][0].contiguous(memory_format=torch.channels_last)
    on_gpu = args.device != "cpu"
    clock = time.perf_counter if on_gpu else time.process_time
    times: dict[str, list[float]] = {}  # seconds of each repeat, by part

    def time_part(part: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function, note its time, and return its result."""
        start = clock()
        result = function(*arguments)
        if on_gpu:  # the GPU may still work when the function returns
            torch.cuda.synchronize()
        times.setdefault(part, []).append(clock() - start)
        return result

    for _ in range(args.repeats + 1):
        with torch.autocast(args.device, enabled=args.fp16):
            # `folded_backbone` runs a copy of the backbone whose batch norms are folded into its
            # convolutions, as in prediction.
            feats = time_part("image backbone", model.folded_backbone, model.img_backbone, images)
            if model.img_neck is not None:
                feats = time_part("image neck", model.img_neck, feats)
            # The BEV encoder needs the batch dimension: (1, V, C, h, w) for each feature level.
            feats = [level.unflatten(0, (1, -1)) for level in feats]
            bev = time_part("BEV encoder", model.bev_encoder, feats, [samples[0].metainfo])
            time_part("map head", model.map_head.predict, bev, samples)
    # The first repeat is a warm-up, which does not count.
    shortest = {part: min(seconds[1:]) for part, seconds in times.items()}
    return shortest, (cameras, height, width)
