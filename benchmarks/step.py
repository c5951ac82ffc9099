"""Time and memory of a whole training step, from pixels on the host to new weights.

On a GPU, the time is the mean over several steps in a row. As in a training, the host then prepares
a step while the GPU computes the previous one.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from mmengine.optim import build_optim_wrapper

from benchmarks import model as models
from benchmarks.measure import MIB, Cost, measure
from gsmap.engine.figures import keep_figures
from gsmap.engine.optimizers import use_mixed_precision

# Steps per measured call on a GPU. The host waits for the GPU only after the last one.
STEPS_IN_A_ROW = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks step`` to a parser."""
    models.add_arguments(parser)
    parser.add_argument("--batch", type=int, default=1, help="number of samples of a step")
    parser.add_argument(
        "--rasters",
        nargs="+",
        default=["200x100"],
        metavar="HxW",
        help="sizes of the raster of GSMap's loss",
    )


def run(args: argparse.Namespace) -> None:
    """Measure and print the costs of a step for every config and raster size.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    tasks: list[tuple[str, argparse.Namespace, str]] = []  # arguments of `step_cost`
    for path in args.configs:
        is_gsmap = "GSMap" in models.config_of(path, args).model.map_head.type
        rasters = args.rasters if is_gsmap else [""]  # other heads have no such raster
        for raster in rasters:
            tasks.append((path, args, raster))
    # On a CPU, each task runs in a separate process, so that no model uses memory of another one.
    costs = [cost for _path, cost in models.measure_each(step_cost, tasks)]
    device = torch.device(args.device)
    # Ratios refer to the first config with its first raster.
    first_seconds = costs[0].time_s(device)
    first_peak = costs[0].peak_bytes
    rows = []
    for (path, _, raster), cost in zip(tasks, costs, strict=True):
        seconds = cost.time_s(device)
        row = [
            Path(path).stem,
            raster,
            f"{seconds:.3f}",
            f"{seconds / first_seconds:.3f}",
            f"{cost.peak_bytes / MIB:.0f}",
            f"{cost.peak_bytes / first_peak:.3f}",
        ]
        rows.append(row)
    header = ["model", "raster", "s a step", "ratio", "peak memory (MiB)", "ratio"]
    models.report(args, header, rows=rows)


def step_cost(path: str, args: argparse.Namespace, raster: str = "") -> Cost:
    """Measure the training step of a config; on a GPU, the mean of several steps in a row.

    The step is mmengine's, from pixels on the host to new weights, with the optimizer and gradient
    clipping of the config, and the collection of the losses and statistics for the log. With
    ``--fp16``, it is in mixed precision, as with ``tools/train.py --amp``.

    Args:
        path: Config file.
        args: Parsed options of ``add_arguments``.
        raster: Rows and columns of the raster of GSMap's loss, such as ``200x100``; empty for
            the size in the config.

    Returns:
        Time and memory of a step.
    """
    model, inputs, samples = models.model_and_batch(path, args, batch=args.batch, raster=raster)
    model.train()
    device = torch.device(args.device)
    settings = models.config_of(path, args).optim_wrapper
    if args.fp16:
        use_mixed_precision(settings, on_gpu=device.type != "cpu")
    wrapper = build_optim_wrapper(model, settings)
    # The data preprocessor of the model takes pixels on the host, so the inputs are converted back.
    images = []
    for normalized in inputs["imgs"]:  # images of one sample (V, 3, H, W)
        pixels = (normalized * 50 + 120).clamp(0, 255)  # undoes the normalization, approximately
        images.append(pixels.to("cpu", torch.uint8))
    batch = [sample.cpu() for sample in samples]

    def step() -> None:
        models.advance_samples(batch)  # a temporal model expects the next frame
        # Copies, because a training step may change its input.
        samples = [sample.clone() for sample in batch]
        data = {"inputs": {"img": list(images)}, "data_samples": samples}
        figures = model.train_step(data, wrapper)
        # As in a training, the losses and statistics are added to the histories for the log.
        prefixed = {}
        for name, value in figures.items():
            prefixed[f"train/{name}"] = value
        keep_figures(wrapper.message_hub, prefixed)

    if device.type == "cpu":
        return measure(step, device, repeats=args.repeats)

    def steps_in_a_row() -> None:
        for _ in range(STEPS_IN_A_ROW):
            step()

    # Only the times are divided: the steps run one after another, so the peak memory is of one.
    cost = measure(steps_in_a_row, device, repeats=args.repeats)
    return replace(cost, wall_s=cost.wall_s / STEPS_IN_A_ROW, cpu_s=cost.cpu_s / STEPS_IN_A_ROW)
