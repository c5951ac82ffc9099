"""Whole models on random inputs: what the commands that measure them share."""

import argparse
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS, TRANSFORMS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import DictAction
from mmengine.structures import InstanceData

from benchmarks.measure import Cost, in_own_process, markdown_table
from gsmap.checkpoints.building import building
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.masks import MakePVMask
from gsmap.engine.launch import read_config
from gsmap.engine.targets import needed_targets
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError

# transforms of images, cameras and LiDAR, whose targets `add_auxiliary_targets` makes
AT_RANDOM = {"MakeBEVMask", "MakePVMask", "MakeDepthMap"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add which models to measure, and how."""
    parser.add_argument("configs", nargs="+", help="configs; ratios refer to the first")
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        metavar=("H", "W"),
        help="image size (default: that of the config)",
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--fp16", action="store_true", help="mixed precision")
    parser.add_argument(
        "--cfg-options",
        nargs="+",
        action=DictAction,
        metavar="KEY=VALUE",
        help="overrides of all configs, such as switches for a GPU",
    )


def measured_each(
    task: Callable[..., Cost], arguments: Sequence[tuple[Any, ...]]
) -> list[tuple[str, Cost]]:
    """Call ``task`` on every tuple of arguments, on a CPU each in a process of its own, in turn.

    There, what an earlier model leaves behind in the allocator would count as memory of the next
    one; a GPU's memory is counted by torch.

    Returns:
        The first argument of every call, and its result.
    """
    on_cpu = all(args.device == "cpu" for _, args, *_ in arguments)
    call = partial(in_own_process, task) if on_cpu else task
    return [(each[0], call(*each)) for each in arguments]


def build(path: str, args: argparse.Namespace, raster: str = "") -> Any:
    """Build a config's model with random weights, with another raster size if one is given."""
    torch.set_num_threads(args.threads)
    cfg = read_config(path, getattr(args, "cfg_options", None))
    if raster:
        rows, columns = (int(side) for side in raster.split("x"))
        (x0, x1), (y0, y1) = cfg.model.grid.x_range, cfg.model.grid.y_range
        cfg.model.map_head.masks = {"pixel_m": ((x1 - x0) / columns, (y1 - y0) / rows)}
    if cfg.model.get("img_backbone"):
        cfg.model.img_backbone.init_cfg = None
    torch.manual_seed(0)
    with building(cfg):
        return MODELS.build(cfg.model).to(args.device)


def image_shape(path: str, args: argparse.Namespace) -> tuple[int, int, int]:
    """Return how many cameras, rows and columns a config's network sees, padding included.

    Raises:
        ValueError: If the config does not say how large its image files are.
    """
    cfg = read_config(path)
    dataset = cfg.test_dataloader.dataset
    if args.size:
        return len(dataset.cameras), *args.size
    if "_file_size" not in cfg:
        raise InputError(f"{path} says nothing of _file_size (width, height): give --size H W.")
    step: dict = next((step for step in dataset.pipeline if step.type == "ScaleImages"), {})
    if step.get("size"):
        return len(dataset.cameras), step["size"][1], step["size"][0]
    scale = step.get("scale", 1.0)
    unit = cfg.model.data_preprocessor.get("pad_size_divisor", 1)
    width, height = (math.ceil(int(side * scale + 1e-6) / unit) * unit for side in cfg._file_size)
    return len(dataset.cameras), height, width


def mask_stride(path: str) -> int:
    """Return how many pixels of an image a cell of a config's camera masks covers."""
    pipeline = read_config(path).train_dataloader.dataset.pipeline
    default = MakePVMask.stride
    given = (step.get("stride", default) for step in pipeline if step.type == "MakePVMask")
    return next(given, default)


def model_and_batch(
    path: str, args: argparse.Namespace, batch: int = 1, raster: str = "", num_elements: int = 15
) -> tuple[Any, dict[str, torch.Tensor], list[Det3DDataSample]]:
    """Build a config's model as ``build`` does, and random inputs for it.

    They are normalised images of cameras in a ring, and straight elements as ground truth, each
    sample of a scene of its own (`drive_on`).
    """
    model, shape, stride = build(path, args, raster), image_shape(path, args), mask_stride(path)
    generator = torch.Generator().manual_seed(0)
    cameras, *size = shape
    images = torch.randn(batch, cameras, 3, *size, generator=generator).to(args.device)
    eyes = np.stack([np.eye(4)] * cameras)
    metainfo: dict[str, Any] = {"token": "random", "lidar2img": ring_of_cameras(*shape)}
    metainfo |= {"cam2img": eyes, "lidar2cam": eyes, "img_aug_matrix": eyes, "lidar2ego": np.eye(4)}
    metainfo |= {"timestamp_ns": 0, "lidar2global": np.eye(4)}
    grid = model.map_head.grid
    samples = []
    for number in range(batch):
        ends = grid.metres_from_norm(torch.rand(num_elements, 2, 2, generator=generator))
        steps = torch.linspace(0, 1, getattr(model.map_head, "num_points", 2))[:, None]
        pts = ends[:, :1] * (1 - steps) + ends[:, 1:] * steps  # (K, P, 2)
        labels = torch.randint(len(model.map_head.classes), (num_elements,), generator=generator)
        sample = Det3DDataSample(metainfo={**metainfo, "scene": f"scene {number}"})
        sample.gt_instances_3d = InstanceData(
            labels_3d=labels,
            pts=pts,
            pts_shifts=torch.stack([pts, pts.flip(1)], 1),
            polylines=pts,
        ).to(args.device)
        add_auxiliary_targets(sample, model, shape, stride, generator)
        add_own_targets(sample, path, grid)
        samples.append(sample.to(args.device))
    return model, {"imgs": images}, samples


def drive_on(samples: Sequence[Det3DDataSample]) -> None:
    """Take samples half a second and 4 m further, so that a model with memory has one of them."""
    for sample in samples:
        moved = sample.lidar2global @ rigid(np.eye(3), [0.0, 4.0, 0.0])
        later = {"timestamp_ns": sample.timestamp_ns + 500_000_000, "lidar2global": moved}
        sample.set_metainfo(later)


def add_own_targets(sample: Det3DDataSample, path: str, grid: BEVGrid) -> None:
    """Let the transforms that a config's head and losses need make targets of the elements."""
    cfg = read_config(path)
    needed = needed_targets(cfg).keys() - AT_RANDOM
    instances = sample.gt_instances_3d
    results = {
        "token": sample.token,
        "x_range": grid.x_range,
        "y_range": grid.y_range,
        "gt_instances_3d": instances,
        "map_instances": [
            MapInstance(label, points.numpy())
            for label, points in zip(
                instances.labels_3d.tolist(), instances.polylines.cpu(), strict=True
            )
        ],
    }
    for step in cfg.train_dataloader.dataset.pipeline:
        if step.type in needed:
            results = TRANSFORMS.build(step).transform(results)
    for name in results:
        if name.startswith("gt_"):
            setattr(sample, name, results[name])


def add_auxiliary_targets(
    sample: Det3DDataSample,
    model: Any,
    shape: tuple[int, int, int],
    stride: int,
    generator: torch.Generator,
) -> None:
    """Add what auxiliary heads train on: masks of every class and depth, at random."""
    classes = len(model.map_head.classes)
    cells = model.bev_encoder.grid
    views, *size = shape
    features = size[0] // stride, size[1] // stride
    sample.gt_seg = torch.rand(classes, cells.height, cells.width, generator=generator).round()
    sample.gt_pv_seg = torch.rand(views, classes, *features, generator=generator).round()
    sample.gt_depth = 1 + 33 * torch.rand(views, *size, generator=generator)


def ring_of_cameras(num_cams: int, height: int, width: int) -> np.ndarray:
    """Return projections of level cameras, outward at equal angles, 90 degrees wide. (V, 4, 4)"""
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
    shapes = dict.fromkeys(image_shape(path, args) for path in args.configs)
    sizes = " and ".join(f"{cameras} cameras of {h} x {w}" for cameras, h, w in shapes)
    print(
        f"{sizes}, {kind}, {args.device}, {args.threads} threads, torch {torch.__version__}; "
        f"{clock}\n\n{markdown_table(header, rows)}"
    )
