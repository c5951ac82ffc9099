"""Frames per second of whole models, batch 1."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import model as models
from benchmarks.measure import MIB, Cost, measure
from benchmarks.model import drive_on, measured_each, model_and_batch, report
from gsmap.apis.fast_frame import FastFrames, StaticFrame, matrix_products


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    models.add_arguments(parser)
    parser.add_argument(
        "--cuda-graphs",
        action="store_true",
        help="on a GPU: frames that are recorded once and replayed, pixels to samples on the host",
    )


def run(args: argparse.Namespace) -> None:
    """Measure and print the frames per second of every config."""
    costs = measured_each(frame_cost, [(path, args) for path in args.configs])
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
    """Measure a config's way from images to decoded elements, with memory if it has any."""
    model, inputs, samples = model_and_batch(path, args)
    model.eval()
    if args.cuda_graphs:
        return _captured_cost(model, inputs, samples, args)
    halved = args.fp16 and args.device != "cpu"
    if halved:
        model.halve_backbone()

    @torch.no_grad()
    def predict() -> None:
        drive_on(samples)
        autocast = torch.autocast(args.device, enabled=args.fp16 and not halved)
        with autocast, matrix_products(halved):
            model.predict(inputs, samples)

    return measure(predict, torch.device(args.device), args.repeats)


def _captured_cost(
    model: Any, inputs: dict[str, Tensor], samples: list[Any], args: argparse.Namespace
) -> Cost:
    """Measure frames that are replayed, from pixels on the GPU to samples on the host."""
    if args.fp16:
        model.halve_backbone()
    frames = FastFrames(StaticFrame(model), torch.device(args.device))
    images = (inputs["imgs"][0] * 50 + 120).clamp(0, 255).to(torch.uint8)
    batch = {"inputs": {"img": [images]}, "data_samples": samples[:1]}
    return measure(partial(frames, batch), torch.device(args.device), args.repeats)
