"""Frames per second of whole models, batch 1."""

import argparse
from pathlib import Path

import torch

from benchmarks.measure import MIB, Cost, measure
from benchmarks.model import add_arguments, drive_on, measured_each, model_and_batch, report

__all__ = ["add_arguments", "run"]


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

    @torch.no_grad()
    def predict() -> None:
        drive_on(samples)
        with torch.autocast(args.device, enabled=args.fp16):
            model.predict(inputs, samples)

    return measure(predict, torch.device(args.device), args.repeats)
