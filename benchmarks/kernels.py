"""Triton kernels beside the plain path: errors against float64, medians forward and backward.

Sizes are those of the published configs. A line is printed, and written to ``--out``, as soon as it
is measured; a kernel that fails is named in its line, and the command ends with 1. The last line
names the kernels that were right, as ``GSMAP_TRITON_KERNELS`` takes them. With ``--reduced`` sizes
are small, so that Triton's interpreter can run them on a CPU (``TRITON_INTERPRET=1``).
"""

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measure import measure
from benchmarks.raster import gaussians_along, random_polylines
from gsmap.ops import backends
from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.kernel_sampling import sample_kernels
from gsmap.ops.polyline_raster import draw_polylines, soft_rasters
from gsmap.ops.raster_loss import raster_loss
from gsmap.structures.grid import BEVGrid

COLUMNS = (
    "kernel",
    "size",
    "error",
    "gradients' errors",
    "plain forward (ms)",
    "forward (ms)",
    "plain backward (ms)",
    "backward (ms)",
)
# Relative errors in the norm: sums of float32 are right to 1e-6, and a raster's gradient, which is
# a difference of large sums, to 1e-5.
LARGEST_ERROR = 1e-4
FEW = 8  # instances whose errors are computed: plain torch in float64 takes much memory


@dataclass(frozen=True)
class Case:
    """A kernel at one size.

    Args:
        kernel: Its name in ``TRITON_KERNELS``.
        size: The size in words.
        function: Called with the backend and the inputs.
        inputs: Tensors; gradients are taken in those of floating point.
        instances: Whether the inputs' first dimension is that of instances.
        differentiable: Whether there is a gradient.
        largest_error: Relative error in the norm up to which values and gradients are right.
    """

    kernel: str
    size: str
    function: Callable[..., Tensor]
    inputs: tuple[Tensor, ...]
    instances: bool = False
    differentiable: bool = True
    largest_error: float = LARGEST_ERROR


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--device", default="cuda", help="cuda, or cpu in Triton's interpreter")
    parser.add_argument("--reduced", action="store_true", help="small sizes, one repeat")
    parser.add_argument(
        "--kernels", nargs="+", choices=sorted(backends.TRITON_KERNELS), help="these alone"
    )
    parser.add_argument("--out", type=Path, help="append each line to this file, too")


def run(args: argparse.Namespace) -> None:
    """Measure, print and write every case."""
    torch.set_num_threads(1)
    device = torch.device(args.device)
    name = torch.cuda.get_device_name() if device.type == "cuda" else "CPU, interpreted"

    def publish_line(line: str) -> None:
        print(line, flush=True)
        if args.out:
            with args.out.open("a") as file:
                file.write(line + "\n")

    publish_line(f"{name}, torch {torch.__version__}; medians of do_bench\n")
    publish_line("| " + " | ".join(COLUMNS) + " |")
    publish_line("| " + " | ".join("---" for _ in COLUMNS) + " |")
    right: dict[str, bool] = {}
    for case in cases(args.reduced):
        if args.kernels and case.kernel not in args.kernels:
            continue
        try:
            cells, good = measure_case(case, device, args.reduced)
        except Exception as error:  # the other kernels are measured all the same
            reason = str(error).strip().splitlines() or [""]
            cells, good = [f"failed: {type(error).__name__}: {reason[-1]:.200}"], False
        right[case.kernel] = right.get(case.kernel, True) and good
        publish_line("| " + " | ".join([case.kernel, case.size, *cells]) + " |")
    wrong = sorted(name for name, good in right.items() if not good)
    chosen = ",".join(name for name, good in right.items() if good)
    publish_line(f"\n{backends.SWITCH}={chosen} (right here)")
    if wrong:
        raise SystemExit(f"error: wrong or failed: {', '.join(wrong)}.")


def measure_case(case: Case, device: torch.device, reduced: bool) -> tuple[list[str], bool]:
    """Return a case's cells of the table, and whether its errors are small."""
    backends.AUTO_KERNELS = {case.kernel}  # of two pairs of kernels, this one's
    inputs = [x.to(device) for x in case.inputs]
    few = [x[:FEW] for x in inputs] if case.instances else inputs
    exact = [x.double() if x.is_floating_point() else x for x in few]
    found, right = results(case, "triton", few), results(case, "reference", exact)
    errors = [relative_error(a, b) for a, b in zip(found, right, strict=True)]
    del found, right, exact
    times = [time_case(case, name, inputs, reduced) for name in ("reference", "triton")]
    cells = [f"{errors[0]:.1e}", " ".join(f"{error:.1e}" for error in errors[1:])]
    cells += [f"{time_ms:.4f}" for step in zip(*times, strict=True) for time_ms in step]
    return cells, max(errors) <= case.largest_error


def time_case(case: Case, backend: str, inputs: list[Tensor], reduced: bool) -> tuple[float, float]:
    """Return the median times of forward and backward in ms; not a number without a gradient."""
    device = inputs[0].device
    forward = median_ms(lambda: case.function(backend, *inputs), device, reduced)
    if not case.differentiable:
        return forward, math.nan
    leaves = differentiable_leaves(case, inputs)
    out = case.function(backend, *leaves)
    wanted, upstream = [x for x in leaves if x.requires_grad], torch.ones_like(out)

    def backward() -> tuple[Tensor, ...]:
        return torch.autograd.grad(out, wanted, upstream, retain_graph=True, materialize_grads=True)

    return forward, median_ms(backward, device, reduced)


def differentiable_leaves(case: Case, inputs: list[Tensor]) -> list[Tensor]:
    """Return inputs of which those of floating point want a gradient."""
    wants = case.differentiable
    return [x.detach().requires_grad_(wants and x.is_floating_point()) for x in inputs]


def results(case: Case, backend: str, inputs: list[Tensor]) -> list[Tensor]:
    """Return the values and the gradients of a weighted sum of them."""
    leaves = differentiable_leaves(case, inputs)
    out = case.function(backend, *leaves)
    if not case.differentiable:
        return [out]
    weights = torch.linspace(-1, 1, out.numel(), device=out.device).view(out.shape).to(out)
    wanted = [x for x in leaves if x.requires_grad]
    return [out.detach(), *torch.autograd.grad(out, wanted, weights, materialize_grads=True)]


def relative_error(found: Tensor, right: Tensor) -> float:
    """Return the norm of the difference over that of what is right; infinite if not a number."""
    error = (found.double() - right).norm() / right.norm().clamp(min=1e-30)
    return float(error) if bool(error.isfinite()) else math.inf


def median_ms(function: Callable[[], object], device: torch.device, reduced: bool) -> float:
    """Return the median time of a call."""
    if device.type == "cuda":
        from triton.testing import do_bench

        if not reduced:
            return float(do_bench(function, return_mode="median"))
    return measure(function, device, 1).wall_s * 1e3


def cases(reduced: bool) -> Iterator[Case]:
    """Make the cases, one after the other."""
    torch.manual_seed(0)
    yield from sampling_cases(reduced)
    yield from kernel_sampling_cases(reduced)
    yield from raster_cases(reduced)


def sampling_cases(reduced: bool) -> Iterator[Case]:
    """Deformable sampling as in decoders, and as in BEV self-attention."""
    height, width = (20, 10) if reduced else (200, 100)
    sizes = [("1,000 queries", 1000, 1), ("4 x 1,000 queries", 1000, 4)]
    sizes += [] if reduced else [("20,000 queries", 20000, 1)]
    for size, queries, batch in sizes:
        queries = queries // 1000 if reduced else queries
        for dtype, largest_error in ((torch.float32, LARGEST_ERROR), (torch.bfloat16, 5e-3)):
            value = torch.randn(batch, height * width, 8, 32).to(dtype).float()
            yield Case(
                "deformable_sample",
                f"{size}, {dtype}".replace("torch.", ""),
                lambda backend, value, places, weights, dtype=dtype: deformable_sample(
                    value.to(dtype) if backend == "triton" else value,
                    (height, width),
                    places,
                    weights,
                    backend,
                ),
                (
                    value,
                    places_within_cells((batch, queries, 8, 4), (height, width)),
                    torch.rand(batch, queries, 8, 4),
                ),
                largest_error=largest_error,
            )


def places_within_cells(shape: tuple[int, ...], size: tuple[int, int]) -> Tensor:
    """Random places over a map, none on the border between cells, where the gradient jumps.

    Args:
        shape: Shape of the places.
        size: Rows and columns of the map.

    Returns:
        The places (x, y), some half a cell outside of [0, 1]. (*shape, 2)
    """
    cells = [torch.randint(-1, side, shape) for side in reversed(size)]
    within = 0.02 + 0.96 * torch.rand(*shape, 2)
    return (torch.stack(cells, -1) + within + 0.5) / torch.tensor(size).flip(0)


def kernel_sampling_cases(reduced: bool) -> Iterator[Case]:
    """GKT as in MapTR's encoder, and with points between pixels as in MapQR's."""
    shape = (15, 25)
    rows, cols = (6, 4) if reduced else (200, 100)
    y, x = torch.meshgrid(
        torch.linspace(-30, 30, rows), torch.linspace(-15, 15, cols), indexing="ij"
    )
    turns = torch.arange(6) / 6  # six cameras around, each of 70 degrees
    angle = torch.atan2(y, x).flatten()[None] / (2 * math.pi) - turns[:, None]
    angle = (angle - angle.round()) * 360 / 70  # (V, Q), in [-0.5, 0.5] where seen
    seen = angle.abs() < 0.5
    depth = (x.square() + y.square()).sqrt().flatten().clamp(min=1.0)
    for size, bilinear, heads, samples in (("MapTR", False, 4, 15), ("MapQR", True, 8, 8)):
        lift = 0.5 + torch.linspace(-2, 2, heads) / depth[:, None]  # (Q, heads)
        u = (angle + 0.5)[..., None].expand(-1, -1, heads)
        uv = torch.stack([u, lift.clamp(0.01, 0.99).expand_as(u)], -1)
        offsets = torch.stack([torch.arange(samples) // 3 - 2, torch.arange(samples) % 3 - 1], -1)
        yield Case(
            "sample_kernels",
            size,
            lambda backend, value, uv, weights, seen, offsets, bilinear=bilinear: sample_kernels(
                value, shape, uv, seen, weights, offsets, bilinear, backend
            ),
            (
                torch.randn(1, 6, shape[0] * shape[1], heads, 256 // heads),
                uv[None] if bilinear else uv[None].half().float(),  # roundings of float64 are equal
                torch.rand(1, rows * cols, heads, samples),
                seen[None],
                offsets,
            ),
        )


def raster_cases(reduced: bool) -> Iterator[Case]:
    """Rasters of 15 and of 60 elements in six layers."""
    grid = BEVGrid((-15.0, 15.0), (-30.0, 30.0), *((21, 33) if reduced else (200, 100)))
    for count in (2,) if reduced else (90, 360):
        lines = random_polylines(count, grid)
        gaussians = gaussians_along(lines, (1.0, 0.4))
        for kernel in ("render_gaussians", "render_gaussians_in_warps"):
            yield Case(
                kernel,
                f"{count} instances",
                lambda backend, means, scales, rotations: render_gaussians(
                    means, scales, rotations, grid, backend
                ),
                gaussians,
                instances=True,
            )
        vertices = grid.px_from_metres(lines)
        for distance in ("squared", "plain"):
            yield Case(
                "soft_rasters",
                f"{count} lines, {distance} distance",
                lambda backend, vertices, distance=distance: soft_rasters(
                    vertices, grid.height, grid.width, distance=distance, backend=backend
                ),
                (vertices,),
                instances=True,
            )
        yield Case(
            "draw_polylines",
            f"{count} lines",
            lambda backend, lines: draw_polylines(lines, grid, backend=backend),
            (lines,),
            instances=True,
            differentiable=False,
        )
        targets = draw_polylines(random_polylines(count, grid), grid)
        yield Case(
            "raster_loss",
            f"{count} instances",
            lambda backend, preds, targets: raster_loss(preds, targets.detach(), backend=backend),
            (render_gaussians(*gaussians, grid), targets),
            instances=True,
        )
