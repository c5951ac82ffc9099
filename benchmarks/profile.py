"""Time of one forward pass of a config's model by part, each also as a ratio to the image backbone.

Random weights, random images, cameras in a ring; batch 1, float32. CPU seconds of all threads (on a
GPU: wall seconds), the fastest of all repeats, as other processes only slow a part down.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.model import add_model_arguments, build, image_shape, random_batch


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand ``profile``."""
    parser = subparsers.add_parser("profile", help=__doc__.splitlines()[0], description=__doc__)
    add_model_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Time the parts of every config's model and print them."""
    for config in args.configs:
        shape = image_shape(config, args)
        parts = profile(build(config, args).eval(), shape, args)
        backbone = parts["image backbone"]
        parts["total"] = sum(parts.values())
        print(f"{config}, {shape[0]} cameras of {shape[1]} x {shape[2]}, {args.threads} threads")
        for part, seconds in parts.items():
            print(f"  {part:<22}{seconds:>8.3f} s {seconds / backbone:>7.3f} of the backbone")


@torch.no_grad()
def profile(model: Any, shape: tuple[int, int, int], args: argparse.Namespace) -> dict[str, float]:
    """Return the CPU (on a GPU: wall) seconds of every part, fastest of all repeats."""
    inputs, samples = random_batch(model, 1, shape, args.device)
    samples[0].set_metainfo({"batch_input_shape": shape[1:]})
    images = inputs["imgs"][0].contiguous(memory_format=torch.channels_last)
    on_gpu = args.device != "cpu"
    clock = time.perf_counter if on_gpu else time.process_time
    times: dict[str, list[float]] = {}

    def timed(part: str, function: Callable[..., Any], *inputs: Any) -> Any:
        start = clock()
        result = function(*inputs)
        if on_gpu:
            torch.cuda.synchronize()
        times.setdefault(part, []).append(clock() - start)
        return result

    for _ in range(args.repeats + 1):  # the first is a warm-up
        with torch.autocast(args.device, torch.float16, enabled=args.fp16):
            features = timed("image backbone", model.folded_backbone, model.img_backbone, images)
            features = timed("image neck", model.img_neck, features)
            features = [feature.unflatten(0, (1, -1)) for feature in features]
            bev = timed("BEV encoder", model.bev_encoder, features, [samples[0].metainfo])
            timed("map head", model.map_head.predict, bev, samples)
    return {part: min(values[1:]) for part, values in times.items()}
