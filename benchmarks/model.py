"""Whole models on random inputs: what the commands that measure them share."""

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData

from benchmarks.measure import Cost, markdown_table
from gsmap.engine.launch import read_config


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """Add which models to measure, and how."""
    parser.add_argument("configs", nargs="+", help="ratios are to the first of them")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 800), metavar=("H", "W"))
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--fp16", action="store_true", help="mixed precision")


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


def build(path: str, args: argparse.Namespace, raster: str = "") -> Any:
    """Build a config's model with random weights, with another raster size if one is given."""
    torch.set_num_threads(args.threads)
    cfg = read_config(path)
    if raster:
        rows, columns = (int(side) for side in raster.split("x"))
        (x0, x1), (y0, y1) = cfg.model.grid.x_range, cfg.model.grid.y_range
        cfg.model.map_head.masks = {"pixel_m": ((x1 - x0) / columns, (y1 - y0) / rows)}
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
        labels = torch.randint(len(model.map_head.classes), (elements,), generator=generator)
        sample = Det3DDataSample(metainfo=metainfo)
        sample.gt_instances_3d = InstanceData(
            labels_3d=labels,
            pts=pts,
            pts_shifts=torch.stack([pts, pts.flip(1)], 1),
            polylines=pts,
        ).to(device)
        add_auxiliary_targets(sample, model, size, generator)
        samples.append(sample.to(device))
    return {"imgs": images}, samples


def add_auxiliary_targets(
    sample: Det3DDataSample, model: Any, size: tuple[int, int], generator: torch.Generator
) -> None:
    """Add what auxiliary heads train on: masks of every class and depth, at random."""
    classes, stride = len(model.map_head.classes), 32
    cells = model.bev_encoder.grid
    features = size[0] // stride, size[1] // stride
    sample.gt_seg = torch.rand(classes, cells.height, cells.width, generator=generator).round()
    sample.gt_pv_seg = torch.rand(6, classes, *features, generator=generator).round()
    sample.gt_depth = 1 + 33 * torch.rand(6, *size, generator=generator)


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
