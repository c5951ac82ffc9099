"""Time of vectorising a frame's maps: of a trained HDMapNet as they are, and at the full size."""

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

FULL_SIZE = (200, 400)  # of nuScenes in the paper


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("config", help="of a model whose head is HDMapNetHead")
    parser.add_argument("checkpoint")
    parser.add_argument("truth", type=Path, help="annotation file, of which the images are taken")
    parser.add_argument("--data-root", help="folder of the images; that of the file by default")
    parser.add_argument("--samples", type=int, default=100)


def run(args: argparse.Namespace) -> None:
    """Print the processor time of a frame, after a first one that compiles."""
    torch.set_num_threads(1)
    inferencer = MapInferencer(args.config, args.checkpoint, "cpu")
    dataset = inferencer.dataset(args.truth, args.data_root)
    head, lines = inferencer.model.map_head, inferencer.model.map_head.lines
    own = head.vectorizing
    settings = {head.map_size: own, FULL_SIZE: type(own)(degrees=own.degrees)}  # as published
    spent: dict[tuple[int, ...], list[float]] = {size: [] for size in settings}

    def timed(maps: Any) -> object:
        for size, setting in settings.items():
            head.vectorizing = setting
            resized = maps._make(enlarged(values, size) for values in maps)
            start = time.process_time()
            found = lines(resized)
            spent[size].append(1000 * (time.process_time() - start))
        return found

    head.lines = timed
    for _ in inferencer.predict(dataset, range(min(args.samples + 1, len(dataset)))):
        pass
    rows = []
    for (height, width), ms in spent.items():
        figures = (np.median(ms[1:]), np.quantile(ms[1:], 0.9), max(ms[1:]))
        cells = (f"{figure:.0f}" for figure in figures)
        rows.append([f"{height} x {width}", len(ms) - 1, *cells])
    header = ["maps", "frames", "median, ms", "90 %, ms", "longest, ms"]
    print(f"{args.config}, one thread\n\n{markdown_table(header, rows)}")


def enlarged(values: Tensor, size: tuple[int, ...]) -> Tensor:
    """Return a map in another size. (C, H, W) -> (C, *size)"""
    return interpolate(values[None], size, mode="bilinear", align_corners=False)[0]
