"""Effect of the raster loss on Gaussians that lie off their line, for each reduction of the loss.

A reduction is the way in which the loss is averaged over the pixels of an element.
"""

import argparse
import math
from pathlib import Path

import torch
from shapely.geometry import Polygon
from torch import Tensor

from benchmarks.measure import markdown_table, publish
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.ops.raster_loss import raster_loss
from gsmap.structures.grid import BEVGrid

# Raster of the gradients and of the fit. `missed_line_table` replaces only its size in pixels.
GRID = BEVGrid(x_range=(-15, 15), y_range=(-30, 30), height=128, width=64)
POINTS = 20  # number of Gaussians per element
BANDS_M = (0.75, 4.0)  # widths of the band that a line covers in its ground-truth mask
ERRORS_M = (0.1, 0.5, 1.0, 2.0, 3.0)  # standard deviations of the centres' errors
SCALES_M = (0.15, 0.25, 0.5, 1.0, 1.5)  # standard deviations of the Gaussians
LENGTHS_M = (4.0, 10.0, 60.0)  # lengths of missed lines
RASTER_SIZES = ((128, 64), (200, 100), (256, 128))  # rows and columns of the raster
# Arguments ``normalize`` and ``foreground_weight`` of `raster_loss`, by the name in the tables.
# "both" divides the sum over the pixels by the area of both masks, "foreground" by the area of the
# ground truth, and "pixels" by the area of the raster. The second value weights foreground pixels.
REDUCTIONS = {
    "both": ("both", 1.0),
    "foreground, weight 5": ("foreground", 5.0),
    "pixels": ("pixels", 1.0),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks masks`` to a parser."""
    parser.add_argument("--seeds", type=int, default=64, help="random errors that are averaged")
    parser.add_argument("--out", type=Path, help="write the tables to this file, too")


def run(args: argparse.Namespace) -> None:
    """Measure, print and write the tables.

    Args:
        args: Parsed options of ``add_arguments``.
    """
    sections = [
        "-dL / d log sigma in thousandths, along / across the line: the loss enlarges Gaussians if "
        "it is positive, and shrinks them if it is negative. "
        f"A line of 60 m, {POINTS} round Gaussians, raster {GRID.height} x {GRID.width}, "
        f"mean over {args.seeds} seeds. Rows: error of the centres, columns: sigma.\n"
    ]
    for reduction in REDUCTIONS:
        for band_m in BANDS_M:
            sections.append(f"{reduction}, band of {band_m:g} m:\n")
            sections.append(gradient_table(reduction, band_m, seeds=args.seeds))
    sections.append("Loss of a miss, by the length of the element:\n")
    sections.append(missed_line_table())
    sections.append(
        "Gaussians are fitted to the mask of a crossing of 10 x 4 m. IoU of the polygon through "
        "their centres with the crossing, for two kinds of mask:\n"
    )
    outline_iou = fit_crossing(filled=False)
    filled_iou = fit_crossing(filled=True)
    sections.append(f"outline {outline_iou:.2f}, filled {filled_iou:.2f}\n")
    publish("\n".join(sections), args.out)  # prints, and writes to `out` if it is given


def straight_line(length_m: float) -> Tensor:
    """Line along y through the centre of the raster, in metres. (POINTS, 2)"""
    y = torch.linspace(-length_m / 2, length_m / 2, POINTS)
    return torch.stack([torch.zeros(POINTS), y], dim=-1)


def scale_gradients(
    reduction: str, band_m: float, error_m: float, scale_m: float, seeds: int = 64
) -> tuple[float, float]:
    """Measure the gradient of the loss with respect to the scales of round Gaussians.

    The Gaussians lie along a line of 60 m.

    Args:
        reduction: Key of ``REDUCTIONS``.
        band_m: Width of the ground-truth mask in metres.
        error_m: Standard deviation of the centres' error along x and y, in metres.
        scale_m: Standard deviation of the Gaussians in metres.
        seeds: Number of random draws of the errors of all centres.

    Returns:
        -dL / d log sigma along and across the line, summed over the Gaussians and averaged over the
        draws.
    """
    line = straight_line(60.0)
    errors = torch.randn(seeds, POINTS, 2, generator=torch.Generator().manual_seed(0))
    scales = torch.full((seeds, POINTS, 2), scale_m, requires_grad=True)
    rotations = torch.full((seeds, POINTS), math.pi / 2)  # first axis along the line, which is y
    preds = render_gaussians(line + error_m * errors, scales, rotations=rotations, grid=GRID)
    targets = draw_polylines(line[None], GRID, band_m).expand_as(preds)  # one mask for all draws
    normalize, weight = REDUCTIONS[reduction]
    loss = raster_loss(preds, targets, foreground_weight=weight, normalize=normalize).sum()
    (gradient,) = torch.autograd.grad(loss, scales)
    # dL / d log sigma = sigma * dL / d sigma.
    along, across = (-scale_m * gradient.sum((0, 1)) / seeds).tolist()
    return along, across


def gradient_table(reduction: str, band_m: float, seeds: int) -> str:
    """Table of the gradients of one reduction and band, for every error and scale.

    Args:
        reduction: Key of ``REDUCTIONS``.
        band_m: Width of the ground-truth mask in metres.
        seeds: Number of random draws of the errors of all centres.

    Returns:
        Markdown table.
    """
    header = ["error"]
    header += [f"{scale_m:g} m" for scale_m in SCALES_M]
    rows = []
    for error_m in ERRORS_M:
        row = [f"{error_m:g} m"]
        for scale_m in SCALES_M:
            along, across = scale_gradients(
                reduction, band_m, error_m=error_m, scale_m=scale_m, seeds=seeds
            )
            row.append(f"{1e3 * along:+.2f} / {1e3 * across:+.2f}")
        rows.append(row)
    return markdown_table(header, rows)


def missed_line_loss(
    reduction: str, band_m: float, length_m: float, size: tuple[int, int]
) -> float:
    """Loss of an empty prediction for a line.

    Args:
        reduction: Key of ``REDUCTIONS``.
        band_m: Width of the ground-truth mask in metres.
        length_m: Length of the line in metres.
        size: Rows and columns of the raster.

    Returns:
        The loss.
    """
    height, width = size
    target = draw_polylines(straight_line(length_m)[None], GRID.with_size(height, width), band_m)
    normalize, weight = REDUCTIONS[reduction]
    empty = torch.zeros_like(target)
    return raster_loss(empty, target, foreground_weight=weight, normalize=normalize).item()


def missed_line_table() -> str:
    """Table of the loss of a missed line at every reduction, band, raster size and length."""
    header = ["reduction", "band", "raster"]
    header += [f"{length_m:g} m" for length_m in LENGTHS_M]
    rows = []
    for reduction in REDUCTIONS:
        for band_m in BANDS_M:
            for height, width in RASTER_SIZES:
                row = [reduction, f"{band_m:g} m", f"{height} x {width}"]
                for length_m in LENGTHS_M:
                    loss = missed_line_loss(
                        reduction, band_m, length_m=length_m, size=(height, width)
                    )
                    row.append(f"{loss:.3f}")
                rows.append(row)
    return markdown_table(header, rows)


def fit_crossing(filled: bool, iterations: int = 800) -> float:
    """Fit Gaussians to the mask of a crossing by the default loss.

    The centres of the Gaussians start on the outline of the crossing.

    Args:
        filled: Whether the mask is the filled crossing. Otherwise, it is a band along the outline.
        iterations: Number of steps of Adam.

    Returns:
        IoU of the crossing with the polygon of the fitted centres.
    """
    crossing = torch.tensor([[-5.0, -2.0], [5.0, -2.0], [5.0, 2.0], [-5.0, 2.0], [-5.0, -2.0]])
    mask = draw_polylines(crossing[None], GRID, BANDS_M[0], torch.tensor([filled]))
    outline = Polygon(crossing.numpy())
    steps = torch.linspace(0, outline.length, POINTS)
    starts = [outline.exterior.interpolate(step).coords[0] for step in steps.tolist()]
    centres = torch.tensor(starts).requires_grad_()
    log_scales = torch.full((POINTS, 2), math.log(0.6)).requires_grad_()
    rotations = torch.zeros(POINTS).requires_grad_()
    optimizer = torch.optim.Adam([centres, log_scales, rotations], lr=0.02)
    smallest_m = max(GRID.pixel_size_m) / 2  # smaller Gaussians would fall between pixels
    for _ in range(iterations):
        scales = log_scales.exp().clamp(min=smallest_m)
        rendered = render_gaussians(
            centres[None], scales[None], rotations=rotations[None], grid=GRID
        )
        optimizer.zero_grad()
        raster_loss(rendered, mask).sum().backward()
        optimizer.step()
    # A buffer of 0 repairs a polygon whose outline crosses itself.
    polygon = Polygon(centres.detach().numpy()).buffer(0)
    return polygon.intersection(outline).area / polygon.union(outline).area
