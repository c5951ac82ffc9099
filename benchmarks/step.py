"""Time and memory of a training step: forward, losses and backward."""

import argparse
from pathlib import Path

import torch

from benchmarks import model as models
from benchmarks.measure import MIB, Cost, measure
from gsmap.engine.launch import read_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    models.add_arguments(parser)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument(
        "--rasters", nargs="+", default=["200x100"], metavar="HxW", help="of GSMap's loss"
    )


def run(args: argparse.Namespace) -> None:
    """Measure and print forward, losses and backward of every config and raster size."""
    tasks = []
    for path in args.configs:
        sizes = args.rasters if "GSMap" in read_config(path).model.map_head.type else [""]
        tasks += [(path, args, raster) for raster in sizes]
    costs = [cost for _, cost in models.measured_each(step_cost, tasks)]
    seconds = [cost.time_s(torch.device(args.device)) for cost in costs]
    peaks = [cost.peak_bytes for cost in costs]
    models.report(
        args,
        ["model", "raster", "s a step", "ratio", "peak memory (MiB)", "ratio"],
        [
            [
                *(Path(path).stem, raster, f"{s:.3f}", f"{s / seconds[0]:.3f}"),
                *(f"{peak / MIB:.0f}", f"{peak / peaks[0]:.3f}"),
            ]
            for (path, _, raster), s, peak in zip(tasks, seconds, peaks, strict=True)
        ],
    )


def step_cost(path: str, args: argparse.Namespace, raster: str = "") -> Cost:
    """Measure a config's training step, with another raster size if one is given."""
    model, inputs, samples = models.model_and_batch(path, args, args.batch, raster)
    model.train()

    def step() -> None:
        models.drive_on(samples)
        model.zero_grad(set_to_none=True)
        with torch.autocast(args.device, enabled=args.fp16):
            losses = model.loss(inputs, samples)
        sum(losses.values()).backward()

    return measure(step, torch.device(args.device), args.repeats)
