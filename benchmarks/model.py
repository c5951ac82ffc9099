"""Whole models on random inputs: frames per second, and the cost of a training step."""

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData

from benchmarks.measure import MIB, Cost, markdown_table, measure
from gsmap.engine.launch import read_config


def run_fps(args: argparse.Namespace) -> None:
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


def run_step(args: argparse.Namespace) -> None:
    """Measure and print forward, losses and backward of every config and raster size."""
    tasks = []
    for path in args.configs:
        sizes = args.rasters if "GSMap" in read_config(path).model.map_head.type else [""]
        tasks += [(path, args, raster) for raster in sizes]
    costs = [cost for _, cost in in_fresh_processes(step_cost, tasks)]
    seconds = [cost.time_s(torch.device(args.device)) for cost in costs]
    peaks = [cost.peak_bytes for cost in costs]
    report(
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


def in_fresh_processes(
    task: Callable[..., Cost], arguments: Sequence[tuple[Any, ...]]
) -> list[tuple[str, Cost]]:
    """Call ``task`` on every tuple of arguments, each in a process of its own, one at a time.

    What an earlier model leaves behind in the allocator would count as memory of the next one.

    Returns:
        The first argument of every call, and its result.
    """
    context = multiprocessing.get_context("spawn")
    results = []
    for each in arguments:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            results.append((each[0], pool.submit(task, *each).result()))
    return results


def frame_cost(path: str, args: argparse.Namespace) -> Cost:
    """Measure a config's way from images to decoded elements."""
    model = build(path, args)
    model.eval()
    inputs, samples = random_batch(model, 1, tuple(args.size), args.device)
    predict = partial(predict_once, model, inputs, samples, args)
    return measure(predict, torch.device(args.device), args.repeats)


def step_cost(path: str, args: argparse.Namespace, raster: str = "") -> Cost:
    """Measure a config's training step, with another raster size if one is given."""
    model = build(path, args, raster)
    model.train()
    inputs, samples = random_batch(model, args.batch, tuple(args.size), args.device)
    step = training_step(model, inputs, samples, args)
    return measure(step, torch.device(args.device), args.repeats)


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


def training_step(
    model: Any,
    inputs: dict[str, torch.Tensor],
    samples: list[Det3DDataSample],
    args: argparse.Namespace,
) -> Callable[[], None]:
    """Return a function that runs forward, losses and backward once."""

    def step() -> None:
        model.zero_grad(set_to_none=True)
        with torch.autocast(args.device, torch.float16, enabled=args.fp16):
            losses = model.loss(inputs, samples)
        sum(losses.values()).backward()

    return step


def build(path: str, args: argparse.Namespace, raster: str = "") -> Any:
    """Build a config's model with random weights, with another raster size if one is given."""
    torch.set_num_threads(args.threads)
    cfg = read_config(path)
    if raster:
        cfg.model.map_head.raster_size = tuple(int(side) for side in raster.split("x"))
    if cfg.model.get("img_backbone"):
        cfg.model.img_backbone.init_cfg = None
    torch.manual_seed(0)
    return MODELS.build(cfg.model).to(args.device)


def random_batch(
    model: Any, batch: int, size: tuple[int, int], device: str, elements: int = 15
) -> tuple[dict[str, torch.Tensor], list[Det3DDataSample]]:
    """Make normalised images of six cameras in a ring, and straight elements as ground truth."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(batch, 6, 3, *size, generator=generator).to(device)
    eyes = np.stack([np.eye(4)] * 6)
    metainfo = {"token": "random", "lidar2img": ring_of_cameras(6, size), "cam2img": eyes}
    metainfo |= {"lidar2cam": eyes, "img_aug_matrix": eyes, "lidar2ego": np.eye(4)}
    grid = model.map_head.grid
    samples = []
    for _ in range(batch):
        ends = grid.metres_from_norm(torch.rand(elements, 2, 2, generator=generator))
        steps = torch.linspace(0, 1, model.map_head.num_points)[:, None]
        pts = ends[:, :1] * (1 - steps) + ends[:, 1:] * steps  # (K, P, 2)
        labels = torch.randint(model.map_head.num_classes, (elements,), generator=generator)
        sample = Det3DDataSample(metainfo=metainfo)
        sample.gt_instances_3d = InstanceData(
            labels_3d=labels, pts=pts, pts_shifts=torch.stack([pts, pts.flip(1)], 1)
        ).to(device)
        samples.append(sample)
    return {"imgs": images}, samples


def ring_of_cameras(num_cams: int, size: tuple[int, int]) -> np.ndarray:
    """Return projections of level cameras, outward at equal angles, 90 degrees wide. (V, 4, 4)"""
    height, width = size
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = [[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]]
    matrices = []
    for angle in np.arange(num_cams) * (2 * np.pi / num_cams):
        camera = np.eye(4)  # camera x right, y down, z forward; frame x right, y forward, z up
        camera[0, :2] = np.cos(angle), np.sin(angle)
        camera[1, :3] = 0, 0, -1
        camera[2, :3] = -np.sin(angle), np.cos(angle), 0
        matrices.append(intrinsics @ camera)
    return np.stack(matrices)


def report(args: argparse.Namespace, header: list[str], rows: list[list[str]]) -> None:
    """Print the table and say how it was measured."""
    clock = "wall clock" if args.device != "cpu" else "processor time of all threads"
    kind = "fp16 autocast" if args.fp16 else "float32"
    print(
        f"{args.size[0]} x {args.size[1]}, six cameras, {kind}, {args.device}, {args.threads} "
        f"threads, torch {torch.__version__}; {clock}\n\n{markdown_table(header, rows)}"
    )
