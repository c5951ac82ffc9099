"""Time and memory of the rasterizers and of what is built on them, beside their floors."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.measure import MIB, Cost, markdown_table, measure, publish
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.gaussian_raster.reference import gaussian_densities
from gsmap.ops.polyline_raster import draw_polylines, soft_rasters
from gsmap.ops.raster_loss import raster_loss
from gsmap.ops.soft_iou import pairwise_soft_iou
from gsmap.structures.grid import BEVGrid

SIZES = ((128, 64), (200, 100), (256, 128), (480, 240))
SCALES_M = ((1.0, 0.4), (0.2, 0.2), (5.0, 5.0))
POINTS = 20
TRAINING_SIZE = (200, 100)
RATE_REPEATS = 20
# The reference is measured on as many instances as fill a tensor of this size and scaled up: it is
# linear in them. Smaller tensors are kept by malloc when they are freed, and blur its peak memory.
REFERENCE_BYTES = 36 * MIB
FLOOR_DENSITY = 1e-6  # pixels where a Gaussian is below need no exponential
Gaussians = tuple[Tensor, Tensor, Tensor]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--instances", type=int, default=360, help="15 matched x batch 4 x 6 decoder layers"
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write the tables to this file, too")


def run(args: argparse.Namespace) -> None:
    """Measure, print and write the tables."""
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    clock = "wall clock" if args.device != "cpu" else "processor time, all threads together"
    where = f"{args.device}, {args.threads} threads, torch {torch.__version__}; {clock}"
    parts = [
        f"Rendering {args.instances} x {POINTS} Gaussians, forward + backward ({where}):\n",
        rendering_table(args),
        f"\nThe rest of the training path at {TRAINING_SIZE[0]} x {TRAINING_SIZE[1]} ({where}):\n",
        training_table(args),
    ]
    publish("\n".join(parts), args.out)


def random_polylines(count: int, grid: BEVGrid) -> Tensor:
    """Return winding lines about as long as map elements are, in metres. (count, 20, 2)"""
    steps = torch.randn(count, POINTS, 2) * 0.3 + torch.tensor([0.2, 1.5])
    starts = torch.rand(count, 1, 2) * torch.tensor(grid.extent_m)
    return starts + steps.cumsum(1) - torch.tensor([grid.extent_m[0] / 2, grid.extent_m[1] * 0.75])


def gaussians_along(polylines: Tensor, scales_m: tuple[float, float]) -> Gaussians:
    """Put a Gaussian of fixed size and random direction on every vertex."""
    scales = torch.tensor(scales_m).expand_as(polylines).contiguous()
    return polylines, scales, torch.rand(polylines.shape[:-1]) * math.pi


def forward_backward(
    render: Callable[..., Tensor], inputs: tuple[Tensor, ...], upstream: Tensor
) -> Callable[[], object]:
    """Return a call that renders and takes the gradient in every input."""
    leaves = [value.to(upstream.device).requires_grad_() for value in inputs]
    return lambda: torch.autograd.grad(render(*leaves), leaves, upstream)


def ellipse_pixels(gaussians: Gaussians, grid: BEVGrid) -> int:
    """Count the pixels, over all Gaussians, where one is at least ``FLOOR_DENSITY``."""
    total = 0
    for means, scales, rotations in zip(*gaussians, strict=True):
        densities = gaussian_densities(means, scales, rotations, grid)
        total += int((densities >= FLOOR_DENSITY).sum())
    return total


def byte_seconds(device: torch.device) -> float:
    """Measure the time to write a byte to new memory and to read it again."""
    size = 8 * MIB if device.type == "cpu" else 512 * MIB  # far beyond a GPU's cache
    write = measure(lambda: torch.empty(size, device=device).fill_(0.5), device, RATE_REPEATS)
    data = torch.ones(size, device=device)
    read = measure(lambda: data.sum(), device, RATE_REPEATS)
    return (write.time_s(device) + read.time_s(device)) / (4 * size)


def exponential_seconds(device: torch.device) -> float:
    """Measure the time of one of the CPU kernels' exponentials; a GPU's hide behind its memory."""
    if device.type != "cpu":
        return 0.0
    import numba

    from gsmap.ops._numba import FASTMATH
    from gsmap.ops.gaussian_raster.numba import exp2_float32

    @numba.njit(fastmath=FASTMATH)
    def fill_exponentials(values, repeats):  # type: ignore[no-untyped-def]
        out = np.empty_like(values)
        for _ in range(repeats):
            for k in range(len(values)):
                out[k] = exp2_float32(values[k])
        return out

    array = -torch.rand(1 << 12).numpy()
    cost = measure(lambda: fill_exponentials(array, 256), device, RATE_REPEATS)
    return cost.cpu_s / (256 * len(array))


def rendering_table(args: argparse.Namespace) -> str:
    """Measure the renderers at every size and scale."""
    device = torch.device(args.device)
    backend = "triton" if device.type == "cuda" else "cpu"
    per_byte_s, per_exponential_s = byte_seconds(device), exponential_seconds(device)
    rows = []
    for height, width in SIZES:
        grid = BEVGrid((-15, 15), (-30, 30), height, width)
        lines = random_polylines(args.instances, grid)
        upstream = torch.randn(args.instances, height, width, device=device)
        mapvr = measure_soft_lines(lines, grid, upstream, args.repeats)
        for scales_m in SCALES_M:
            gaussians = gaussians_along(lines, scales_m)
            count = min(args.instances, math.ceil(REFERENCE_BYTES / (4 * POINTS * height * width)))
            few = gaussians[0][:count], gaussians[1][:count], gaussians[2][:count]
            factor = args.instances / count
            reference = measure_renderer(few, grid, upstream, "reference", 2).scaled(factor)
            fused = measure_renderer(gaussians, grid, upstream, backend, args.repeats)
            pixels = ellipse_pixels(few, grid) * factor
            # nobody can beat: masks written and read once, two exponentials per pixel
            floor_s = 4 * upstream.numel() * per_byte_s + 2 * pixels * per_exponential_s
            name = f"{height} x {width}", " x ".join(f"{s:g}" for s in scales_m)
            rows.append([*name, *rendering_row(reference, fused, floor_s, mapvr, upstream)])
    rates = (
        f"Floor: {per_byte_s * 1e12:.0f} ps per byte of a mask, written and read once, and "
        f"{per_exponential_s * 1e12:.0f} ps per exponential, measured in this run.\n\n"
    )
    return rates + markdown_table(
        (
            "raster",
            "sigma (m)",
            "reference (ms)",
            f"{backend} (ms)",
            "times faster",
            f"{backend} wall clock (ms)",
            "floor (ms)",
            "measured / floor",
            "reference memory (MiB)",
            f"{backend} memory (MiB)",
            "share of reference",
            "in masks",
            "MapVR lines (ms)",
        ),
        rows,
    )


def measure_renderer(
    gaussians: Gaussians, grid: BEVGrid, upstream: Tensor, backend: str, repeats: int
) -> Cost:
    """Measure forward and backward of one backend."""
    call = forward_backward(
        lambda means, scales, rotations: render_gaussians(means, scales, rotations, grid, backend),
        gaussians,
        upstream[: len(gaussians[0])],
    )
    return measure(call, upstream.device, repeats)


def measure_soft_lines(lines: Tensor, grid: BEVGrid, upstream: Tensor, repeats: int) -> Cost:
    """Measure forward and backward of MapVR's soft lines."""
    vertices = grid.px_from_metres(lines)
    call = forward_backward(
        lambda leaf: soft_rasters(leaf, grid.height, grid.width), (vertices,), upstream
    )
    return measure(call, upstream.device, repeats)


def rendering_row(
    reference: Cost, fused: Cost, floor_s: float, mapvr: Cost, upstream: Tensor
) -> list[str]:
    """Format one line of the table."""
    device = upstream.device
    reference_s, fused_s = reference.time_s(device), fused.time_s(device)
    return [
        f"{reference_s * 1e3:.0f}",
        f"{fused_s * 1e3:.1f}",
        f"{reference_s / fused_s:.0f}",
        f"{fused.wall_s * 1e3:.1f}",
        f"{floor_s * 1e3:.1f}",
        f"{fused_s / floor_s:.1f}",
        f"{reference.peak_bytes / MIB:.0f}",
        f"{fused.peak_bytes / MIB:.0f}",
        f"{fused.peak_bytes / reference.peak_bytes:.4f}",
        f"{fused.peak_bytes / (4 * upstream.numel()):.2f}",
        f"{mapvr.time_s(device) * 1e3:.1f}",
    ]


def training_table(args: argparse.Namespace) -> str:
    """Measure what a training step does beside rendering, fused and as the reference."""
    device = torch.device(args.device)
    grid = BEVGrid((-15, 15), (-30, 30), *TRAINING_SIZE)
    matched = args.instances // 4
    lines = random_polylines(matched, grid).to(device)
    targets = draw_polylines(lines, grid)
    near = gaussians_along(random_polylines(matched, grid), (1.0, 0.4))
    means, scales, rotations = (value.to(device) for value in near)
    preds = render_gaussians(means, scales, rotations, grid)
    upstream = torch.ones(matched, device=device)

    def loss(backend: str) -> Callable[[], object]:
        return forward_backward(
            lambda masks: raster_loss(masks, targets, backend=backend), (preds.clone(),), upstream
        )

    few = min(15, matched)
    works: dict[str, Callable[[str], Callable[[], object]]] = {
        f"draw {matched} ground truths": lambda backend: (
            lambda: draw_polylines(lines, grid, backend=backend)
        ),
        f"raster loss of {matched} instances, forward + backward": loss,
        f"soft IoU, 50 predictions x {few} ground truths": lambda backend: (
            lambda: pairwise_soft_iou(preds[:50], targets[:few], backend=backend)
        ),
    }
    rows = []
    for name, make in works.items():
        reference = measure(make("reference"), device, 2)
        auto = measure(make("auto"), device, args.repeats)
        times = reference.time_s(device), auto.time_s(device)
        peaks = f"{reference.peak_bytes / MIB:.0f}", f"{auto.peak_bytes / MIB:.0f}"
        milliseconds = f"{times[0] * 1e3:.0f}", f"{times[1] * 1e3:.1f}"
        rows.append([name, *milliseconds, f"{times[0] / times[1]:.0f}", *peaks])
    return markdown_table(
        (
            "work",
            "reference (ms)",
            "auto (ms)",
            "times faster",
            "reference memory (MiB)",
            "auto memory (MiB)",
        ),
        rows,
    )
