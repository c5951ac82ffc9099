"""Time to trace lines in the maps that a trained `HDMapNetHead` predicts.

It is measured twice: at the size of the predicted maps, and at the size of the maps in the paper.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from benchmarks.measure import markdown_table
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.utils.errors import InputError

FULL_SIZE = (200, 400)  # rows and columns of nuScenes' maps in the paper


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks vectorize`` to a parser."""
    parser.add_argument("config", help="config of a model with an HDMapNetHead")
    parser.add_argument("checkpoint")
    parser.add_argument("truth", type=Path, help="annotation file; its images are used")
    parser.add_argument(
        "--data-root", help="folder of the images; default: the folder of the annotation file"
    )
    parser.add_argument("--samples", type=int, default=100)


def run(args: argparse.Namespace) -> None:
    """Measure and print the processor time in which the lines of a frame are traced.

    The first frame is left out, because numba compiles the functions for tracing during it.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        ValueError: If there is no frame after the first one.
    """
    torch.set_num_threads(1)
    inferencer = MapInferencer(args.config, args.checkpoint, device="cpu")
    dataset = inferencer.dataset(args.truth, args.data_root)
    head = inferencer.model.map_head
    vectorize_maps = head.lines  # method that traces the lines of the maps of one sample
    settings = head.vectorizing  # settings that this method reads
    # The defaults of the other settings are the published values, which hold for FULL_SIZE.
    published_settings = type(settings)(degrees=settings.degrees)
    settings_by_size = {head.map_size: settings, FULL_SIZE: published_settings}
    times_ms: dict[tuple[int, ...], list[float]] = {size: [] for size in settings_by_size}

    def time_lines(maps: Any) -> object:
        """Trace the lines of maps (`LineMaps`) in every size, and record the times.

        The lines of the last size are returned, because the head expects a result. Nothing uses it.
        """
        for size, size_settings in settings_by_size.items():
            head.vectorizing = size_settings
            resized_values = [resize_map(values, size) for values in maps]
            resized_maps = type(maps)._make(resized_values)  # `LineMaps` is a NamedTuple
            start = time.process_time()
            lines = vectorize_maps(resized_maps)
            elapsed_s = time.process_time() - start
            times_ms[size].append(1000 * elapsed_s)
        return lines

    head.lines = time_lines  # replaces the method, which `vectorize_maps` still refers to
    rows_to_predict = range(min(args.samples + 1, len(dataset)))  # one more, for the first frame
    if len(rows_to_predict) < 2:
        raise InputError(
            f"{len(dataset)} samples of {args.truth} and --samples {args.samples} leave no frame "
            "after the first one: give two samples or more, and --samples of at least 1."
        )
    for _ in inferencer.predict(dataset, rows_to_predict):
        pass  # each prediction calls `time_lines`
    table = []
    for (height, width), frame_times in times_ms.items():
        times = frame_times[1:]  # without the first frame
        row = [
            f"{height} x {width}",
            len(times),
            f"{np.median(times):.0f}",
            f"{np.quantile(times, 0.9):.0f}",
            f"{max(times):.0f}",
        ]
        table.append(row)
    header = ["maps", "frames", "median, ms", "90 %, ms", "longest, ms"]
    print(f"{args.config}, one thread\n\n{markdown_table(header, table)}")


def resize_map(values: Tensor, size: tuple[int, ...]) -> Tensor:
    """Resize a map bilinearly to ``size`` (rows, columns). (C, H, W) -> (C, *size)"""
    return interpolate(values[None], size, mode="bilinear", align_corners=False)[0]
