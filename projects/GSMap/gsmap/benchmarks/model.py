"""Whole models on random inputs: frames per second, and the cost of a training step."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData

from .measure import MIB, markdown_table, measure


def run_fps(args: argparse.Namespace) -> None:
    """Measure and print the frames per second of every config."""
    rows = []
    for path in args.configs:
        model, size = build(path, args), tuple(args.size)
        model.eval()
        inputs, samples = random_batch(model, 1, size, args.device)
        predict = partial(predict_once, model, inputs, samples, args)
        cost = measure(predict, torch.device(args.device), args.repeats)
        rows.append((Path(path).stem, cost.time_s(torch.device(args.device)), cost.peak_bytes))
    first = rows[0][1]
    report(
        args,
        ["model", "s a frame", "FPS", "FPS, ratio to the first", "peak memory (MiB)"],
        [
            [name, f"{s:.3f}", f"{1 / s:.2f}", f"{first / s:.3f}", f"{peak / MIB:.0f}"]
            for name, s, peak in rows
        ],
    )


def run_step(args: argparse.Namespace) -> None:
    """Measure and print forward, losses and backward of every config and raster size."""
    rows = []
    for path in args.configs:
        sizes = args.rasters if "GSMap" in Config.fromfile(path).model.map_head.type else [""]
        for raster in sizes:
            model = build(path, args, raster)
            model.train()
            inputs, samples = random_batch(model, args.batch, tuple(args.size), args.device)
            step = training_step(model, inputs, samples, args)
            cost = measure(step, torch.device(args.device), args.repeats)
            seconds = cost.time_s(torch.device(args.device))
            rows.append((Path(path).stem, raster, seconds, cost.peak_bytes))
    _, _, first_s, first_peak = rows[0]
    report(
        args,
        ["model", "raster", "s a step", "ratio", "peak memory (MiB)", "ratio"],
        [
            [
                *(name, raster, f"{s:.3f}", f"{s / first_s:.3f}"),
                *(f"{peak / MIB:.0f}", f"{peak / first_peak:.3f}"),
            ]
            for name, raster, s, peak in rows
        ],
    )


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
    init_default_scope("mmdet3d")
    cfg = Config.fromfile(path)
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
    print(  # noqa: T201 (the command's result)
        f"{args.size[0]} x {args.size[1]}, six cameras, {kind}, {args.device}, {args.threads} "
        f"threads, torch {torch.__version__}; {clock}\n\n{markdown_table(header, rows)}"
    )
