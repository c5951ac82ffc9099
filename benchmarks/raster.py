"""Time and memory of the rasterizers and their losses, compared with lower bounds of the time.

A lower bound is called a floor.
"""

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

SIZES = ((128, 64), (200, 100), (256, 128), (480, 240))  # height and width of rasters in pixels
SCALES_M = ((1.0, 0.4), (0.2, 0.2), (5.0, 5.0))  # standard deviations along both axes
POINTS = 20  # Gaussians per instance
TRAINING_SIZE = (200, 100)  # height and width in pixels
RATE_REPEATS = 20  # timed calls in the measurements of the floor
# Time and memory of the reference are linear in the number of instances. They are measured on as
# many instances as fill a tensor of this size, and scaled up. With smaller tensors, memory that
# malloc keeps after they are freed would blur the peak memory.
REFERENCE_BYTES = 36 * MIB
FLOOR_DENSITY = 1e-6  # a pixel with a smaller density of a Gaussian needs no exponential
Gaussians = tuple[Tensor, Tensor, Tensor]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks raster`` to a parser."""
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--instances", type=int, default=360, help="15 matched x batch 4 x 6 decoder layers"
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write the tables to this file, too")


def run(args: argparse.Namespace) -> None:
    """Measure, print and write the tables.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    clock = "wall clock" if args.device != "cpu" else "processor time, all threads together"
    setup = f"{args.device}, {args.threads} threads, torch {torch.__version__}; {clock}"
    parts = [
        f"Rendering {args.instances} x {POINTS} Gaussians, forward + backward ({setup}):\n",
        rendering_table(args),
        f"\nThe rest of the training path at {TRAINING_SIZE[0]} x {TRAINING_SIZE[1]} ({setup}):\n",
        training_table(args),
    ]
    publish("\n".join(parts), args.out)


def random_polylines(count: int, grid: BEVGrid) -> Tensor:
    """Winding lines about as long as map elements.

    Args:
        count: Number of lines.
        grid: Grid that most of the lines lie in.

    Returns:
        Vertices in metres. (count, 20, 2)
    """
    width_m, height_m = grid.extent_m
    # The lines run along y for 20 steps of 1.5 m on average, half the height of the map. With the
    # shift by 3/4 of the height, their middles are spread over the map.
    steps = torch.randn(count, POINTS, 2) * 0.3 + torch.tensor([0.2, 1.5])
    starts = torch.rand(count, 1, 2) * torch.tensor([width_m, height_m])
    return starts + steps.cumsum(1) - torch.tensor([width_m / 2, height_m * 0.75])


def gaussians_along(polylines: Tensor, scales_m: tuple[float, float]) -> Gaussians:
    """Place a Gaussian of fixed size and random direction on every vertex.

    Args:
        polylines: Vertices in metres. (N, P, 2)
        scales_m: Standard deviations in metres along the axes of each Gaussian.

    Returns:
        Means (N, P, 2) and scales (N, P, 2) in metres, and rotations in radians (N, P).
    """
    scales = torch.tensor(scales_m).expand_as(polylines).contiguous()
    return polylines, scales, torch.rand(polylines.shape[:-1]) * math.pi


def forward_backward(
    render: Callable[..., Tensor], inputs: tuple[Tensor, ...], upstream: Tensor
) -> Callable[[], object]:
    """Make a function that renders and computes the gradient of every input.

    Args:
        render: Differentiable function of the inputs.
        inputs: Inputs, moved to the device of ``upstream``. An input that is already there is
            changed: it requires a gradient afterwards.
        upstream: Gradient of the result, in the shape of the result.

    Returns:
        Function without arguments that returns the gradients.
    """
    leaves = [value.to(upstream.device).requires_grad_() for value in inputs]
    return lambda: torch.autograd.grad(render(*leaves), leaves, grad_outputs=upstream)


def ellipse_pixels(gaussians: Gaussians, grid: BEVGrid) -> int:
    """Count the pixels with a density of at least ``FLOOR_DENSITY``, over all Gaussians.

    Args:
        gaussians: Means (N, P, 2) and scales (N, P, 2) in metres, and rotations in radians (N, P).
        grid: The raster.

    Returns:
        Sum of the pixels of each Gaussian.
    """
    all_means, all_scales, all_rotations = gaussians
    total = 0
    for means, scales, rotations in zip(all_means, all_scales, all_rotations, strict=True):
        densities = gaussian_densities(means, scales, rotations, grid)
        total += int((densities >= FLOOR_DENSITY).sum())
    return total


def byte_seconds(device: torch.device) -> float:
    """Measure the seconds to write a byte to new memory and to read it again."""
    # Number of float32 values, four bytes each.
    size = 8 * MIB if device.type == "cpu" else 512 * MIB  # far beyond a GPU's cache
    data = torch.ones(size, device=device)

    def write() -> Tensor:
        return torch.empty(size, device=device).fill_(0.5)

    write_s = measure(write, device, repeats=RATE_REPEATS).time_s(device)
    read_s = measure(data.sum, device, repeats=RATE_REPEATS).time_s(device)
    return (write_s + read_s) / (4 * size)


def exponential_seconds(device: torch.device) -> float:
    """Measure the seconds that the CPU kernels take for one exponential.

    The result is 0 on a GPU, whose kernels are limited by its memory.
    """
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

    # Exponents of densities are negative. The 4096 values stay in the cache during the 256 rounds.
    array = -torch.rand(1 << 12).numpy()
    cost = measure(lambda: fill_exponentials(array, 256), device, repeats=RATE_REPEATS)
    return cost.cpu_s / (256 * len(array))


def rendering_table(args: argparse.Namespace) -> str:
    """Measure the renderers at every size and scale.

    Args:
        args: Parsed options of ``add_arguments``.

    Returns:
        The rates from which the floors are computed, then the Markdown table.
    """
    device = torch.device(args.device)
    backend = "triton" if device.type == "cuda" else "cpu"
    per_byte_s = byte_seconds(device)
    per_exponential_s = exponential_seconds(device)
    rows = []
    for height, width in SIZES:
        grid = BEVGrid((-15, 15), (-30, 30), height=height, width=width)
        lines = random_polylines(args.instances, grid)
        upstream = torch.randn(args.instances, height, width, device=device)
        soft_lines = measure_soft_lines(lines, grid, upstream=upstream, repeats=args.repeats)
        # Number of instances of the reference, and factor by which its cost is scaled up.
        count = min(args.instances, math.ceil(REFERENCE_BYTES / (4 * POINTS * height * width)))
        factor = args.instances / count
        for scales_m in SCALES_M:
            gaussians = gaussians_along(lines, scales_m)
            means, scales, rotations = gaussians
            reference_gaussians = (means[:count], scales[:count], rotations[:count])
            reference = measure_renderer(
                reference_gaussians, grid, upstream=upstream, backend="reference", repeats=2
            )
            fused = measure_renderer(
                gaussians, grid, upstream=upstream, backend=backend, repeats=args.repeats
            )
            pixels = ellipse_pixels(reference_gaussians, grid) * factor
            # Any renderer writes the masks once and reads their gradients once. It computes two
            # exponentials per pixel, one in the forward and one in the backward pass. A value of a
            # mask has 4 bytes, and `per_byte_s` includes writing and reading.
            floor_s = 4 * upstream.numel() * per_byte_s + 2 * pixels * per_exponential_s
            cells = rendering_cells(
                reference=reference.scale(factor),
                fused=fused,
                floor_s=floor_s,
                soft_lines=soft_lines,
                upstream=upstream,
            )
            rows.append([f"{height} x {width}", f"{scales_m[0]:g} x {scales_m[1]:g}", *cells])
    rates = (
        f"Floor: {per_byte_s * 1e12:.0f} ps per byte of a mask, written and read once, and "
        f"{per_exponential_s * 1e12:.0f} ps per exponential, measured in this run.\n\n"
    )
    header = (
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
        "soft lines (ms)",
    )
    return rates + markdown_table(header, rows)


def measure_renderer(
    gaussians: Gaussians, grid: BEVGrid, upstream: Tensor, backend: str, repeats: int
) -> Cost:
    """Measure forward and backward of one backend.

    Args:
        gaussians: Means (N, P, 2) and scales (N, P, 2) in metres, and rotations in radians (N, P).
        grid: The raster.
        upstream: Gradients of at least N masks. (>= N, H, W)
        backend: Backend of ``render_gaussians``.
        repeats: Number of timed calls.

    Returns:
        Time and memory of a call.
    """

    def render(means: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
        return render_gaussians(means, scales, rotations, grid=grid, backend=backend)

    count = len(gaussians[0])
    call = forward_backward(render, gaussians, upstream=upstream[:count])
    return measure(call, upstream.device, repeats=repeats)


def measure_soft_lines(lines: Tensor, grid: BEVGrid, upstream: Tensor, repeats: int) -> Cost:
    """Measure forward and backward of soft lines.

    Args:
        lines: Vertices in metres. (N, P, 2)
        grid: The raster.
        upstream: Gradients of the masks. (N, H, W)
        repeats: Number of timed calls.

    Returns:
        Time and memory of a call.
    """

    def render(vertices: Tensor) -> Tensor:
        return soft_rasters(vertices, height=grid.height, width=grid.width)

    call = forward_backward(render, (grid.px_from_metres(lines),), upstream=upstream)
    return measure(call, upstream.device, repeats=repeats)


def rendering_cells(
    reference: Cost, fused: Cost, floor_s: float, soft_lines: Cost, upstream: Tensor
) -> list[str]:
    """Format the measurements of one row of the table.

    Args:
        reference: Cost of the reference.
        fused: Cost of the fused kernels.
        floor_s: Lower bound of the time in seconds.
        soft_lines: Cost of soft lines.
        upstream: Gradients of the masks. (N, H, W)

    Returns:
        Cells after size and scale.
    """
    device = upstream.device
    reference_s = reference.time_s(device)
    fused_s = fused.time_s(device)
    return [
        f"{reference_s * 1e3:.0f}",
        f"{fused_s * 1e3:.1f}",
        f"{reference_s / fused_s:.0f}",
        f"{fused.wall_s * 1e3:.1f}",
        f"{floor_s * 1e3:.1f}",
        f"{fused_s / floor_s:.1f}",
        f"{reference.peak_bytes / MIB:.0f}",
        f"{fused.peak_bytes / MIB:.0f}",
        f"{fused.peak_bytes / reference.peak_bytes:.4f}",  # memory as a share of the reference's
        f"{fused.peak_bytes / (4 * upstream.numel()):.2f}",  # memory in sizes of all masks
        f"{soft_lines.time_s(device) * 1e3:.1f}",
    ]


def training_table(args: argparse.Namespace) -> str:
    """Measure the other work of a training step, by the reference and by the fused kernels.

    Args:
        args: Parsed options of ``add_arguments``.

    Returns:
        Markdown table.
    """
    device = torch.device(args.device)
    height, width = TRAINING_SIZE
    grid = BEVGrid((-15, 15), (-30, 30), height=height, width=width)
    # Matched instances of one of the 4 samples of the batch, in all decoder layers.
    num_matched = args.instances // 4
    num_truths = min(15, num_matched)
    lines = random_polylines(num_matched, grid).to(device)
    targets = draw_polylines(lines, grid)
    means, scales, rotations = gaussians_along(random_polylines(num_matched, grid), (1.0, 0.4))
    preds = render_gaussians(
        means.to(device), scales.to(device), rotations=rotations.to(device), grid=grid
    )
    upstream = torch.ones(num_matched, device=device)

    def make_drawing(backend: str) -> Callable[[], object]:
        return lambda: draw_polylines(lines, grid, backend=backend)

    def make_loss(backend: str) -> Callable[[], object]:
        def loss(masks: Tensor) -> Tensor:
            return raster_loss(masks, targets, backend=backend)

        # A copy, since `forward_backward` makes its inputs require a gradient.
        return forward_backward(loss, (preds.clone(),), upstream=upstream)

    def make_iou(backend: str) -> Callable[[], object]:
        return lambda: pairwise_soft_iou(preds[:50], targets[:num_truths], backend=backend)

    works = {
        f"draw {num_matched} ground truths": make_drawing,
        f"raster loss of {num_matched} instances, forward + backward": make_loss,
        f"soft IoU, 50 predictions x {num_truths} ground truths": make_iou,
    }
    # ``auto`` selects the fused kernels of the device.
    rows = []
    for name, make_work in works.items():
        reference = measure(make_work("reference"), device, repeats=2)
        auto = measure(make_work("auto"), device, repeats=args.repeats)
        reference_s = reference.time_s(device)
        auto_s = auto.time_s(device)
        row = [
            name,
            f"{reference_s * 1e3:.0f}",
            f"{auto_s * 1e3:.1f}",
            f"{reference_s / auto_s:.0f}",
            f"{reference.peak_bytes / MIB:.0f}",
            f"{auto.peak_bytes / MIB:.0f}",
        ]
        rows.append(row)
    header = (
        "work",
        "reference (ms)",
        "auto (ms)",
        "times faster",
        "reference memory (MiB)",
        "auto memory (MiB)",
    )
    return markdown_table(header, rows)
