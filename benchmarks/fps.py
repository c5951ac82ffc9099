"""Frames per second of whole models, with batch size 1."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import model as models
from benchmarks.measure import MIB, Cost, measure
from benchmarks.model import advance_samples, measure_each, model_and_batch, report
from gsmap.apis.fast_frame import FastFrames, StaticFrame
from gsmap.structures.tensors import matrix_products


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks fps`` to a parser."""
    models.add_arguments(parser)
    parser.add_argument(
        "--cuda-graphs",
        action="store_true",
        help="on a GPU, record the launches of a frame once and replay them",
    )


def run(args: argparse.Namespace) -> None:
    """Measure and print the frames per second of every config.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    # Each tuple has the arguments of one call of `frame_cost`. On a CPU, each call runs in a
    # separate process.
    costs = measure_each(frame_cost, [(path, args, args.cuda_graphs) for path in args.configs])
    device = torch.device(args.device)
    _, first_cost = costs[0]
    # `time_s` is processor time on a CPU, which other processes do not disturb, and wall-clock time
    # on a GPU.
    first_seconds = first_cost.time_s(device)
    rows = []
    for path, cost in costs:
        seconds = cost.time_s(device)
        row = [
            Path(path).stem,
            f"{seconds:.3f}",
            f"{first_seconds / seconds:.3f}",  # ratio of frame rates, so the times are swapped
            f"{cost.wall_s:.3f}",
            f"{1 / cost.wall_s:.2f}",
            f"{cost.peak_bytes / MIB:.0f}",
        ]
        rows.append(row)
    header = ["model", "s a frame", "FPS, ratio to the first", "wall s", "FPS", "peak memory (MiB)"]
    report(args, header, rows=rows)


def frame_cost(path: str, args: argparse.Namespace, cuda_graphs: bool = False) -> Cost:
    """Measure the inference of a config's model, from images to decoded elements.

    The model has random weights, and its input is one sample of random images. A temporal model
    uses the features that it stored in the previous call.

    Args:
        path: Config file.
        args: Parsed options of ``benchmarks.model.add_arguments``.
        cuda_graphs: Whether a frame is recorded once as a CUDA graph and replayed, on a GPU.

    Returns:
        Time and memory of a frame.
    """
    model, inputs, samples = model_and_batch(path, args)
    model.eval()
    if cuda_graphs:
        return _replayed_frame_cost(model, inputs, samples=samples, args=args)
    # With --fp16 on a GPU, the weights of the backbone are converted to float16, and float32 matrix
    # products of the other layers use TF32. On a CPU, the whole model runs under autocast.
    has_half_weights = args.fp16 and args.device != "cpu"
    if has_half_weights:
        model.halve_backbone()

    @torch.no_grad()
    def predict() -> None:
        # Temporal models expect a later frame in each call: time and pose are advanced in place.
        advance_samples(samples)
        autocast = torch.autocast(args.device, enabled=args.fp16 and not has_half_weights)
        with autocast, matrix_products(in_tf32=has_half_weights):
            model.predict(inputs, samples)

    return measure(predict, torch.device(args.device), repeats=args.repeats)


def _replayed_frame_cost(
    model: Any, inputs: dict[str, Tensor], samples: list[Any], args: argparse.Namespace
) -> Cost:
    """Measure frames replayed as CUDA graphs, from pixels on the GPU to samples on the host.

    Samples are not advanced, because `StaticFrame` refuses temporal models.
    """
    if args.fp16:
        model.halve_backbone()
    device = torch.device(args.device)
    predict_batch = FastFrames(StaticFrame(model), device)
    # `StaticFrame` starts from pixel values. A typical standard deviation (50) and mean (120) turn
    # the normalised random images into such values.
    images = (inputs["imgs"][0] * 50 + 120).clamp(0, 255).to(torch.uint8)
    batch = {"inputs": {"img": [images]}, "data_samples": samples[:1]}
    return measure(partial(predict_batch, batch), device, repeats=args.repeats)
