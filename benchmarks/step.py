"""Time and memory of a whole training step, from pixels on the host to new weights."""

import argparse
from pathlib import Path

import torch
from mmengine.optim import build_optim_wrapper

from benchmarks import model as models
from benchmarks.measure import MIB, Cost, measure
from gsmap.engine.figures import keep_figures
from gsmap.engine.launch import read_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    models.add_arguments(parser)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument(
        "--rasters", nargs="+", default=["200x100"], metavar="HxW", help="of GSMap's loss"
    )


def run(args: argparse.Namespace) -> None:
    """Measure and print a step of every config and raster size."""
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
    """Measure a config's training step, with another raster size if one is given.

    The step is mmengine's, from pixels on the host to new weights, with the config's optimizer,
    clipping and figures.
    """
    model, inputs, samples = models.model_and_batch(path, args, args.batch, raster)
    model.train()
    wrapper = build_optim_wrapper(model, read_config(path, args.cfg_options).optim_wrapper)
    images = [(each * 50 + 120).clamp(0, 255).to("cpu", torch.uint8) for each in inputs["imgs"]]
    batch = [sample.cpu() for sample in samples]

    def step() -> None:
        models.drive_on(batch)
        data = {"inputs": {"img": list(images)}, "data_samples": [each.clone() for each in batch]}
        figures = model.train_step(data, wrapper)
        named = {f"train/{name}": value for name, value in figures.items()}
        keep_figures(wrapper.message_hub, named)

    return measure(step, torch.device(args.device), args.repeats)
