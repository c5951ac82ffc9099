"""Frames per second of whole models, batch 1."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import torch
from mmdet3d.structures import Det3DDataSample

from benchmarks.measure import MIB, Cost, measure
from benchmarks.model import (
    add_model_arguments,
    build,
    image_shape,
    in_fresh_processes,
    random_batch,
    report,
)


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand ``fps``."""
    parser = subparsers.add_parser("fps", help=__doc__)
    add_model_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Measure and print the frames per second of every config."""
    costs = in_fresh_processes(frame_cost, [(path, args) for path in args.configs])
    device = torch.device(args.device)
    first = costs[0][1].time_s(device)
    report(
        args,
        ["model", "s a frame", "FPS, ratio to the first", "wall s", "FPS", "peak memory (MiB)"],
        [
            [
                *(Path(path).stem, f"{cost.time_s(device):.3f}"),
                f"{first / cost.time_s(device):.3f}",
                *(f"{cost.wall_s:.3f}", f"{1 / cost.wall_s:.2f}"),
                f"{cost.peak_bytes / MIB:.0f}",
            ]
            for path, cost in costs
        ],
    )


def frame_cost(path: str, args: argparse.Namespace) -> Cost:
    """Measure a config's way from images to decoded elements."""
    model = build(path, args)
    model.eval()
    inputs, samples = random_batch(model, 1, image_shape(path, args), args.device)
    predict = partial(predict_once, model, inputs, samples, args)
    return measure(predict, torch.device(args.device), args.repeats)


@torch.no_grad()
def predict_once(
    model: Any,
    inputs: dict[str, torch.Tensor],
    samples: list[Det3DDataSample],
    args: argparse.Namespace,
) -> None:
    """Run a model from images to decoded elements."""
    with torch.autocast(args.device, torch.float16, enabled=args.fp16):
        model.predict(inputs, samples)
