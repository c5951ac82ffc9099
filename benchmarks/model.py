"""Whole models and random inputs for the commands that measure them."""

import argparse
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS, TRANSFORMS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.structures import InstanceData

from benchmarks.measure import Cost, in_own_process, markdown_table
from gsmap.checkpoints.building import building
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.masks import MakePVMask
from gsmap.engine.arguments import OverrideAction
from gsmap.engine.launch import read_config
from gsmap.engine.targets import needed_targets
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError

# Transforms whose targets are replaced by random ones (`add_auxiliary_targets`). Camera masks and
# depth would need camera or LiDAR data, which random samples lack.
RANDOM_TARGETS = {"MakeBEVMask", "MakePVMask", "MakeDepthMap"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the models to measure and the options of their measurement to a parser."""
    parser.add_argument("configs", nargs="+", help="configs; ratios refer to the first")
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        metavar=("H", "W"),
        help="image size (default: the size in the config)",
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--fp16", action="store_true", help="mixed precision")
    parser.add_argument(
        "--cfg-options",
        nargs="+",
        action=OverrideAction,
        metavar="KEY=VALUE",
        help="overrides of all configs, such as switches for a GPU",
    )


def measure_each(
    task: Callable[..., Cost], arguments: Sequence[tuple[Any, ...]]
) -> list[tuple[str, Cost]]:
    """Call a task with each tuple of arguments, one after another.

    On a CPU each call runs in a separate process, because memory that an earlier model leaves in
    the allocator would count as memory of the next model. On a GPU the calls run in this process,
    because torch counts only the memory of tensors that are in use.

    Args:
        task: Function that can be pickled.
        arguments: Arguments of each call: the config file, the parsed options, and further ones.

    Returns:
        Config file and cost of every call.
    """
    on_cpu = all(args.device == "cpu" for _, args, *_ in arguments)
    call = partial(in_own_process, task) if on_cpu else task
    costs = []
    for call_arguments in arguments:
        config_file = call_arguments[0]
        costs.append((config_file, call(*call_arguments)))
    return costs


def config_of(path: str, args: argparse.Namespace) -> Config:
    """Read a config with the overrides of ``--cfg-options``."""
    return read_config(path, getattr(args, "cfg_options", None))


def build(path: str, args: argparse.Namespace, raster: str = "") -> Any:
    """Build a config's model with random weights.

    Args:
        path: Config file.
        args: Parsed options of ``add_arguments``.
        raster: Rows and columns of the raster of the head's masks, such as ``200x100``; empty for
            the size in the config.

    Returns:
        The model on the device of the options.
    """
    torch.set_num_threads(args.threads)
    cfg = config_of(path, args)
    if raster:
        rows, columns = map(int, raster.split("x"))
        x_min, x_max = cfg.model.grid.x_range
        y_min, y_max = cfg.model.grid.y_range
        pixel_m = ((x_max - x_min) / columns, (y_max - y_min) / rows)
        cfg.model.map_head.masks = {"pixel_m": pixel_m}
    if cfg.model.get("img_backbone"):
        cfg.model.img_backbone.init_cfg = None  # no pretrained weights, which may be downloads
    torch.manual_seed(0)
    with building(cfg):  # adds the names of the config and of its parts to errors
        return MODELS.build(cfg.model).to(args.device)


def image_shape(path: str, args: argparse.Namespace) -> tuple[int, int, int]:
    """Number and size of the images that a config's network takes.

    A size in the options or in the config's ``ScaleImages`` is returned as it is. Otherwise, the
    size of the image files (``_file_size``) is scaled and padded as in the config.

    Args:
        path: Config file.
        args: Parsed options of ``add_arguments``.

    Returns:
        Number of cameras, image rows and columns.

    Raises:
        ValueError: If the options have no ``size``, and the config does not state the size of its
            image files.
    """
    cfg = config_of(path, args)
    dataset = cfg.test_dataloader.dataset
    cameras = len(dataset.cameras)
    if args.size:
        height, width = args.size
        return cameras, height, width
    if "_file_size" not in cfg:
        raise InputError(f"{path} does not set _file_size (width, height): give --size H W.")
    scaling: dict = {}
    for step in dataset.pipeline:
        if step.type == "ScaleImages":
            scaling = step
            break
    if scaling.get("size"):
        width, height = scaling["size"]  # a config has the width first
        return cameras, height, width
    scale = scaling.get("scale", 1.0)
    divisor = cfg.model.data_preprocessor.get("pad_size_divisor", 1)
    sides = []
    for side in cfg._file_size:
        scaled = int(side * scale + 1e-6)  # a product just below a whole number is rounded up
        sides.append(math.ceil(scaled / divisor) * divisor)
    width, height = sides
    return cameras, height, width


def mask_stride(cfg: Config) -> int:
    """Edge of a cell of a config's camera masks in image pixels; a default without such masks."""
    for step in cfg.train_dataloader.dataset.pipeline:
        if step.type == "MakePVMask":
            return step.get("stride", MakePVMask.stride)
    return MakePVMask.stride


def model_and_batch(
    path: str, args: argparse.Namespace, batch: int = 1, raster: str = "", num_elements: int = 15
) -> tuple[Any, dict[str, torch.Tensor], list[Det3DDataSample]]:
    """Build a config's model and random inputs for it.

    The inputs are normalised images of cameras in a ring, and straight elements as ground truth.
    Each sample belongs to another scene, so temporal models treat the samples as separate streams.

    Args:
        path: Config file.
        args: Parsed options of ``add_arguments``.
        batch: Number of samples, >= 1.
        raster: Rows and columns of the raster of the head's masks, such as ``200x100``; empty for
            the size in the config.
        num_elements: Number of elements in each sample's ground truth.

    Returns:
        The model; the inputs, with images ``imgs`` (B, V, 3, H, W); and the samples, with elements
        and all targets that the training of the model needs.
    """
    model = build(path, args, raster=raster)
    shape = image_shape(path, args)
    cfg = config_of(path, args)
    stride = mask_stride(cfg)
    generator = torch.Generator().manual_seed(0)
    cameras, height, width = shape
    images = torch.randn(batch, cameras, 3, height, width, generator=generator).to(args.device)
    # Encoders project with `lidar2img`. The other matrices are only inputs of the depth network of
    # camera-aware encoders.
    identities = np.stack([np.eye(4)] * cameras)
    metainfo: dict[str, Any] = {
        "token": "random",
        "lidar2img": ring_of_cameras(cameras, height, width=width),
        "cam2img": identities,
        "lidar2cam": identities,
        "img_aug_matrix": identities,
        "lidar2ego": np.eye(4),
        "timestamp_ns": 0,
        "lidar2global": np.eye(4),
    }
    grid = model.map_head.grid
    # Heads without a fixed number of points get the two ends of each straight element.
    num_points = getattr(model.map_head, "num_points", 2)
    num_classes = len(model.map_head.classes)
    steps = torch.linspace(0, 1, num_points)[:, None]
    samples = []
    for number in range(batch):
        ends = grid.metres_from_norm(torch.rand(num_elements, 2, 2, generator=generator))
        pts = ends[:, :1] * (1 - steps) + ends[:, 1:] * steps  # (K, P, 2)
        labels = torch.randint(num_classes, (num_elements,), generator=generator)
        sample = Det3DDataSample(metainfo={**metainfo, "scene": f"scene {number}"})
        instances = InstanceData(
            labels_3d=labels,
            pts=pts,
            pts_shifts=torch.stack([pts, pts.flip(1)], dim=1),  # both directions: (K, 2, P, 2)
            polylines=pts,  # elements before resampling
        )
        sample.gt_instances_3d = instances.to(args.device)
        add_auxiliary_targets(sample, model, shape=shape, stride=stride, generator=generator)
        add_config_targets(sample, cfg, grid=grid)
        samples.append(sample.to(args.device))
    return model, {"imgs": images}, samples


def advance_samples(samples: Sequence[Det3DDataSample]) -> None:
    """Advance samples by half a second and 4 m, in place; temporal models expect the next frame."""
    step = rigid(np.eye(3), [0.0, 4.0, 0.0])  # forward in the sensor frame, hence on the right
    for sample in samples:
        sample.set_metainfo(
            {
                "timestamp_ns": sample.timestamp_ns + 500_000_000,
                "lidar2global": sample.lidar2global @ step,
            }
        )


def add_config_targets(sample: Det3DDataSample, cfg: Config, grid: BEVGrid) -> None:
    """Add the targets that a config's head and losses need, made from the sample's elements.

    Args:
        sample: Sample with elements as ground truth; changed in place.
        cfg: Config.
        grid: Grid of the head.
    """
    transforms = needed_targets(cfg).keys() - RANDOM_TARGETS  # names of transforms
    instances = sample.gt_instances_3d
    labels = instances.labels_3d.tolist()
    polylines = instances.polylines.cpu().numpy()
    # Fields that the transforms read, as in the results of the pipeline.
    results = {
        "token": sample.token,
        "x_range": grid.x_range,
        "y_range": grid.y_range,
        "gt_instances_3d": instances,
        "map_instances": list(map(MapInstance, labels, polylines)),
    }
    for step in cfg.train_dataloader.dataset.pipeline:
        if step.type in transforms:
            results = TRANSFORMS.build(step).transform(results)
    for name, value in results.items():
        if name.startswith("gt_"):  # the targets, and the elements themselves
            setattr(sample, name, value)


def add_auxiliary_targets(
    sample: Det3DDataSample,
    model: Any,
    shape: tuple[int, int, int],
    stride: int,
    generator: torch.Generator,
) -> None:
    """Add random targets of auxiliary heads to a sample, in place.

    The targets are BEV masks ``gt_seg`` (classes, H, W), camera masks ``gt_pv_seg``
    (V, classes, h, w), and depths ``gt_depth`` in metres (V, rows, columns).

    Args:
        sample: Sample to which the targets are added.
        model: Model with the auxiliary heads.
        shape: Number of cameras, image rows and columns.
        stride: Edge of a cell of the camera masks in image pixels.
        generator: Source of the values.
    """
    classes = len(model.map_head.classes)
    cells = model.bev_encoder.grid
    views, height, width = shape
    rows = height // stride
    columns = width // stride
    sample.gt_seg = torch.rand(classes, cells.height, cells.width, generator=generator).round()
    sample.gt_pv_seg = torch.rand(views, classes, rows, columns, generator=generator).round()
    # Depths from 1 to 34 m, in the range of the depth bins of the shipped configs.
    sample.gt_depth = 1 + 33 * torch.rand(views, height, width, generator=generator)


def ring_of_cameras(num_cams: int, height: int, width: int) -> np.ndarray:
    """Projections of level cameras that face outward at equal angles, 90 degrees wide.

    Args:
        num_cams: Number of cameras V.
        height: Image height in pixels.
        width: Image width in pixels.

    Returns:
        Transforms from the sensor frame (x right, y forward, z up) to pixels. (V, 4, 4)
    """
    # A focal length of half the width gives a field of view of 90 degrees.
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = [[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]]
    matrices = []
    for angle in np.arange(num_cams) * (2 * np.pi / num_cams):
        # Rows: the camera's axes right, down and forward in the frame (x right, y forward, z up).
        camera = np.eye(4)
        camera[0, :2] = [np.cos(angle), np.sin(angle)]
        camera[1, :3] = [0, 0, -1]
        camera[2, :3] = [-np.sin(angle), np.cos(angle), 0]
        matrices.append(intrinsics @ camera)
    return np.stack(matrices)


def report(args: argparse.Namespace, header: list[str], rows: list[list[str]]) -> None:
    """Print a table below the conditions of the measurement.

    Args:
        args: Parsed options of ``add_arguments``.
        header: Names of the columns.
        rows: Cells of each row.
    """
    clock = "wall clock" if args.device != "cpu" else "processor time of all threads"
    conditions = ["float32"]
    if args.fp16:
        conditions = ["bfloat16" if args.device == "cpu" else "float16"]
    conditions += [f"{key}={value}" for key, value in (args.cfg_options or {}).items()]
    sizes: list[str] = []
    for path in args.configs:
        cameras, height, width = image_shape(path, args)
        size = f"{cameras} cameras of {height} x {width}"
        if size not in sizes:
            sizes.append(size)
    print(
        f"{' and '.join(sizes)}, {', '.join(conditions)}, {args.device}, {args.threads} threads, "
        f"torch {torch.__version__}; {clock}\n\n{markdown_table(header, rows)}"
    )
