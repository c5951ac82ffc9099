"""Errors of Triton kernels against float64, and their times relative to plain torch.

Sizes come from the published configs. Each line is printed, and written to ``--out``, as soon as it
is measured. If a kernel fails, its line gives the reason, the other kernels are still measured, and
the command ends with exit code 1. The last line lists the correct kernels in the format of
``GSMAP_TRITON_KERNELS``. With ``--reduced`` sizes are small, so that Triton's interpreter can run
them on a CPU (``TRITON_INTERPRET=1``).
"""

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
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
    "error",  # `relative_error` of the values
    "gradients' errors",  # `relative_error` of the gradient of each floating-point input
    "plain forward (ms)",
    "forward (ms)",
    "plain backward (ms)",
    "backward (ms)",
)
# Largest `relative_error` of a correct kernel. Sums of float32 are accurate to 1e-6, and the
# gradient of a raster, which is a difference of large sums, to 1e-5.
LARGEST_ERROR = 1e-4
FEW = 8  # errors are measured with this number of instances, since float64 takes much memory


@dataclass(frozen=True)
class Case:
    """Kernel to measure at one size.

    Attributes:
        kernel: Name in ``TRITON_KERNELS``.
        size: Description of the size for the table.
        function: Function to measure. Its arguments are the name of the backend (``"triton"`` for
            the kernel, ``"reference"`` for plain torch) and the inputs.
        inputs: Input tensors. Gradients are computed for the floating-point ones.
        instances: Whether the first dimension of every input is the number of instances. If so,
            errors are measured with the first ``FEW`` instances.
        differentiable: Whether the function has gradients.
        largest_error: Largest `relative_error` of correct values and gradients.
    """

    kernel: str
    size: str
    function: Callable[..., Tensor]
    inputs: tuple[Tensor, ...]
    instances: bool = False
    differentiable: bool = True
    largest_error: float = LARGEST_ERROR

    def compute(self, backend: str, inputs: list[Tensor]) -> Tensor:
        """Call ``function`` with a backend and a list of inputs."""
        return self.function(backend, *inputs)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks kernels`` to a parser."""
    parser.add_argument("--device", default="cuda", help="cuda, or cpu in Triton's interpreter")
    parser.add_argument("--reduced", action="store_true", help="small sizes, one repeat")
    parser.add_argument(
        "--kernels", nargs="+", choices=sorted(backends.TRITON_KERNELS), help="measure only these"
    )
    parser.add_argument("--out", type=Path, help="append each line to this file, too")


def run(args: argparse.Namespace) -> None:
    """Measure, print and write every case.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        SystemExit: If a kernel fails or its errors are too large.
    """
    torch.set_num_threads(1)
    device = torch.device(args.device)
    device_name = torch.cuda.get_device_name() if device.type == "cuda" else "CPU, interpreted"

    def publish_line(line: str) -> None:
        print(line, flush=True)
        if args.out:
            with args.out.open("a") as file:
                file.write(line + "\n")

    publish_line(f"{device_name}, torch {torch.__version__}; medians of triton.testing.do_bench\n")
    publish_line("| " + " | ".join(COLUMNS) + " |")
    publish_line("| " + " | ".join(["---"] * len(COLUMNS)) + " |")
    verdicts: dict[str, bool] = {}
    for case in cases(args.reduced):
        if args.kernels and case.kernel not in args.kernels:
            continue
        try:
            cells, correct = measure_case(case, device, reduced=args.reduced)
        except Exception as error:  # the other kernels are still measured
            lines = str(error).strip().splitlines()
            reason = lines[-1] if lines else ""
            cells = [f"failed: {type(error).__name__}: {reason:.200}"]
            correct = False
        # A kernel is correct if all of its cases are.
        verdicts[case.kernel] = correct and verdicts.get(case.kernel, True)
        publish_line("| " + " | ".join([case.kernel, case.size, *cells]) + " |")
    correct_kernels = [name for name, correct in verdicts.items() if correct]
    wrong_kernels = sorted(verdicts.keys() - set(correct_kernels))
    # `SWITCH` is the environment variable that lists the Triton kernels to use.
    publish_line(f"\n{backends.SWITCH}={','.join(correct_kernels)} (correct on this device)")
    if wrong_kernels:
        raise SystemExit(f"error: wrong or failed: {', '.join(wrong_kernels)}.")


def measure_case(case: Case, device: torch.device, reduced: bool) -> tuple[list[str], bool]:
    """Measure the errors and times of a case.

    Args:
        case: The case.
        device: Device of the kernels.
        reduced: Whether to time a single call.

    Returns:
        Cells of the columns after ``kernel`` and ``size``, and whether the errors are small enough.
    """
    # `render_gaussians` has two Triton kernels. It uses the one "in warps" if this set contains it.
    backends.AUTO_KERNELS = {case.kernel}
    inputs = [x.to(device) for x in case.inputs]
    few = [x[:FEW] for x in inputs] if case.instances else inputs
    # The expected results are computed in float64.
    exact = [x.double() if x.is_floating_point() else x for x in few]
    actual = results(case, "triton", few)
    expected = results(case, "reference", exact)
    errors = [relative_error(a, b) for a, b in zip(actual, expected, strict=True)]
    del actual, expected, exact  # frees memory of the device before the timing
    plain_forward, plain_backward = time_case(case, "reference", inputs, reduced=reduced)
    forward, backward = time_case(case, "triton", inputs, reduced=reduced)
    value_error, *gradient_errors = errors
    cells = [
        f"{value_error:.1e}",
        " ".join(f"{error:.1e}" for error in gradient_errors),
        f"{plain_forward:.4f}",
        f"{forward:.4f}",
        f"{plain_backward:.4f}",
        f"{backward:.4f}",
    ]
    return cells, max(errors) <= case.largest_error


def time_case(case: Case, backend: str, inputs: list[Tensor], reduced: bool) -> tuple[float, float]:
    """Measure the median times of the forward and the backward pass of a case.

    Args:
        case: The case.
        backend: Backend of the function.
        inputs: Inputs of the function.
        reduced: Whether to time a single call.

    Returns:
        Times of the forward and the backward pass in milliseconds. The time of the backward pass is
        NaN if the case has no gradient.
    """
    device = inputs[0].device
    forward = median_ms(lambda: case.compute(backend, inputs), device, reduced=reduced)
    if not case.differentiable:
        return forward, math.nan
    leaves = differentiable_leaves(case, inputs)
    out = case.compute(backend, leaves)
    targets = [x for x in leaves if x.requires_grad]
    upstream = torch.ones_like(out)

    def backward() -> tuple[Tensor, ...]:
        return torch.autograd.grad(
            out, targets, grad_outputs=upstream, retain_graph=True, materialize_grads=True
        )

    return forward, median_ms(backward, device, reduced=reduced)


def differentiable_leaves(case: Case, inputs: list[Tensor]) -> list[Tensor]:
    """Detached inputs. If the case has gradients, the floating-point ones require a gradient."""
    leaves = []
    for value in inputs:
        requires_grad = case.differentiable and value.is_floating_point()
        leaves.append(value.detach().requires_grad_(requires_grad))
    return leaves


def results(case: Case, backend: str, inputs: list[Tensor]) -> list[Tensor]:
    """Compute the values of a case and the gradients of a weighted sum of them.

    Args:
        case: The case.
        backend: Backend of the function.
        inputs: Inputs of the function.

    Returns:
        Values and, if the case has gradients, the gradient of each floating-point input.
    """
    leaves = differentiable_leaves(case, inputs)
    out = case.compute(backend, leaves)
    if not case.differentiable:
        return [out]
    # Each value has another weight, so that errors at two values do not cancel in the gradients.
    weights = torch.linspace(-1, 1, out.numel(), device=out.device).view(out.shape).to(out)
    targets = [x for x in leaves if x.requires_grad]
    # With `materialize_grads`, an input that has no effect gets a gradient of zeros.
    gradients = torch.autograd.grad(out, targets, grad_outputs=weights, materialize_grads=True)
    return [out.detach(), *gradients]


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Norm of the difference over the norm of ``expected``; infinite if the ratio is not finite."""
    error = (actual.double() - expected).norm() / expected.norm().clamp(min=1e-30)
    return float(error) if bool(error.isfinite()) else math.inf


def median_ms(function: Callable[[], object], device: torch.device, reduced: bool) -> float:
    """Measure the median time of a call.

    Args:
        function: Function without arguments.
        device: Device of the work.
        reduced: Whether to time a single call.

    Returns:
        Median time in milliseconds. On the CPU, or if ``reduced``, the time of a single call after
        warm-up calls.
    """
    if device.type == "cuda" and not reduced:
        from triton.testing import do_bench

        return float(do_bench(function, return_mode="median"))
    # `measure` returns the shortest time of the repeats, here of one call.
    return measure(function, device, repeats=1).wall_s * 1e3


def cases(reduced: bool) -> Iterator[Case]:
    """Make the cases one after another, small ones if ``reduced``."""
    torch.manual_seed(0)
    yield from sampling_cases(reduced)
    yield from kernel_sampling_cases(reduced)
    yield from raster_cases(reduced)


def sampling_cases(reduced: bool) -> Iterator[Case]:
    """Deformable sampling as in decoders, and as in BEV self-attention."""
    height, width = (20, 10) if reduced else (200, 100)
    # Columns: description, number of queries at full size, batch size.
    sizes = [("1,000 queries", 1000, 1), ("4 x 1,000 queries", 1000, 4)]
    if not reduced:
        sizes.append(("20,000 queries", 20000, 1))
    for size, full_queries, batch in sizes:
        queries = full_queries // 1000 if reduced else full_queries
        # The kernel also reads bfloat16 values, whose rounding error is at most 2^-8, about 0.004.
        for dtype, largest_error in ((torch.float32, LARGEST_ERROR), (torch.bfloat16, 5e-3)):

            def sample(
                backend: str,
                value: Tensor,
                locations: Tensor,
                weights: Tensor,
                dtype: torch.dtype = dtype,  # the default keeps the value of this iteration
            ) -> Tensor:
                if backend == "triton":
                    value = value.to(dtype)
                return deformable_sample(
                    value, (height, width), locations, weights, backend=backend
                )

            # Values that ``dtype`` represents exactly: all backends compute with equal inputs.
            # There are 8 heads of 32 channels, and each query samples 4 locations per head.
            value = torch.randn(batch, height * width, 8, 32).to(dtype).float()
            locations = random_locations((batch, queries, 8, 4), (height, width))
            weights = torch.rand(batch, queries, 8, 4)
            yield Case(
                kernel="deformable_sample",
                size=f"{size}, {dtype}".replace("torch.", ""),
                function=sample,
                inputs=(value, locations, weights),
                largest_error=largest_error,
            )


def random_locations(shape: tuple[int, ...], size: tuple[int, int]) -> Tensor:
    """Random locations on a map, none where the gradient of bilinear sampling jumps.

    The gradient jumps at the lines through the centres of pixels. These lines divide the map into
    squares with a pixel centre at each corner. Along each axis, square i, with i >= -1, reaches
    from the centre of pixel i to the centre of pixel i + 1. Each location is inside of a square.

    Args:
        shape: Shape of the locations.
        size: Rows and columns of the map.

    Returns:
        Locations (x, y) relative to the size of the map: [0, 1] on the map; some locations are up
        to half a pixel outside. (*shape, 2)
    """
    rows, columns = size
    column = torch.randint(-1, columns, shape)
    row = torch.randint(-1, rows, shape)
    within = 0.02 + 0.96 * torch.rand((*shape, 2))  # position inside the square, off its edges
    squares = torch.stack([column, row], dim=-1)
    # The centre of pixel i, where square i starts, is at i + 0.5.
    return (squares + within + 0.5) / torch.tensor([columns, rows])


def kernel_sampling_cases(reduced: bool) -> Iterator[Case]:
    """Sampling of kernels of pixels around image positions, as in the encoders of MapTR and MapQR.

    A kernel of pixels is the set of pixels around one position. MapTR (GKT) rounds the positions to
    pixels, MapQR interpolates between pixels.
    """
    shape = (15, 25)  # rows and columns of the image features
    rows, columns = (6, 4) if reduced else (200, 100)  # of the BEV features
    y, x = torch.meshgrid(
        torch.linspace(-30, 30, rows), torch.linspace(-15, 15, columns), indexing="ij"
    )
    camera_turns = torch.arange(6) / 6  # directions of six cameras, as parts of a full turn
    turns = torch.atan2(y, x).flatten()[None] / (2 * math.pi) - camera_turns[:, None]
    # Distance of each BEV cell from the middle of each image, in image widths of 70 degrees. (V, Q)
    # Subtracting the rounded number of turns gives the shorter way around, in [-0.5, 0.5] turns.
    from_middle = (turns - turns.round()) * 360 / 70
    visible = from_middle.abs() < 0.5
    depth = (x.square() + y.square()).sqrt().flatten().clamp(min=1.0)
    # Columns: description, whether positions are interpolated, heads, sampled pixels per position.
    for size, bilinear, heads, samples in (("MapTR", False, 4, 15), ("MapQR", True, 8, 8)):

        def sample(
            backend: str,
            value: Tensor,
            uv: Tensor,
            weights: Tensor,
            visible: Tensor,
            offsets: Tensor,
            bilinear: bool = bilinear,  # the default keeps the value of this iteration
        ) -> Tensor:
            return sample_kernels(
                value, shape, uv, visible, weights, offsets, bilinear=bilinear, backend=backend
            )

        # Image positions of a point at several heights above each BEV cell, one for each head.
        v = 0.5 + torch.linspace(-2, 2, heads) / depth[:, None]  # (Q, heads)
        u = (from_middle + 0.5)[..., None].expand(-1, -1, heads)
        uv = torch.stack([u, v.clamp(0.01, 0.99).expand_as(u)], dim=-1)
        if not bilinear:
            # Without `bilinear`, positions are rounded to pixels, and float32 and float64 must give
            # equal ones. Values with the 11 bits of float16 have exact products with the size of
            # the map in both.
            uv = uv.half().float()
        index = torch.arange(samples)
        offsets = torch.stack([index // 3 - 2, index % 3 - 1], dim=-1)  # rows of three pixels
        value = torch.randn(1, 6, shape[0] * shape[1], heads, 256 // heads)
        weights = torch.rand(1, rows * columns, heads, samples)
        yield Case(
            kernel="sample_kernels",
            size=size,
            function=sample,
            inputs=(value, uv[None], weights, visible[None], offsets),
        )


def raster_cases(reduced: bool) -> Iterator[Case]:
    """Rasters of the elements of all six decoder layers, with 15 or 60 elements per layer."""
    height, width = (21, 33) if reduced else (200, 100)
    grid = BEVGrid((-15.0, 15.0), (-30.0, 30.0), height=height, width=width)

    def render(backend: str, means: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
        return render_gaussians(means, scales, rotations, grid=grid, backend=backend)

    def draw_soft(backend: str, vertices: Tensor, distance: str) -> Tensor:
        return soft_rasters(
            vertices, height=grid.height, width=grid.width, distance=distance, backend=backend
        )

    def draw(backend: str, lines: Tensor) -> Tensor:
        return draw_polylines(lines, grid, backend=backend)

    def loss(backend: str, preds: Tensor, targets: Tensor) -> Tensor:
        # Targets have no gradient, as in training. `results` requests one and gets zeros.
        return raster_loss(preds, targets.detach(), backend=backend)

    counts = (2,) if reduced else (6 * 15, 6 * 60)
    for count in counts:
        lines = random_polylines(count, grid)
        # A Gaussian of 1.0 m x 0.4 m in a random direction at each vertex of the lines.
        means, scales, rotations = gaussians_along(lines, (1.0, 0.4))
        for kernel in ("render_gaussians", "render_gaussians_in_warps"):
            yield Case(
                kernel=kernel,
                size=f"{count} instances",
                function=render,
                inputs=(means, scales, rotations),
                instances=True,
            )
        vertices = grid.px_from_metres(lines)
        for distance in ("squared", "plain"):
            yield Case(
                kernel="soft_rasters",
                size=f"{count} lines, {distance} distance",
                function=partial(draw_soft, distance=distance),
                inputs=(vertices,),
                instances=True,
            )
        yield Case(
            kernel="draw_polylines",
            size=f"{count} lines",
            function=draw,
            inputs=(lines,),
            instances=True,
            differentiable=False,
        )
        targets = draw_polylines(random_polylines(count, grid), grid)
        preds = render_gaussians(means, scales, rotations, grid=grid)
        yield Case(
            kernel="raster_loss",
            size=f"{count} instances",
            function=loss,
            inputs=(preds, targets),
            instances=True,
        )
