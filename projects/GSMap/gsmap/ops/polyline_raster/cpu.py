"""Torch operators around the numba kernels of polylines."""

import math
from typing import Any

import torch
from torch import Tensor

from gsmap.ops._numba import run_in_threads
from gsmap.ops.polyline_raster.reference import DISTANCE_EPS, LENGTH_EPS

Pair = tuple[float, float]
Frame = tuple[float, float, float, float]

REACH = -math.log(1e-8)  # in units of softness: beyond it masks are 0 or 1
INTEGER_FRAME = (-0.5, -0.5, 1.0, 1.0)  # MapVR samples pixel (row, col) at (col, row)


def _settings(
    line_softness: float, polygon_softness: float, plain: bool
) -> tuple[Frame, Pair, float, Pair, float]:
    """Return the kernels' frame, reach, eps, softness and smallest distance."""
    lines, polygons = REACH * line_softness, REACH * polygon_softness
    reach = (lines, polygons) if plain else (math.sqrt(lines), math.sqrt(polygons))
    softness = (line_softness, polygon_softness)
    return INTEGER_FRAME, reach, LENGTH_EPS, softness, DISTANCE_EPS if plain else 0.0


@torch.library.custom_op("gsmap::soft_rasters", mutates_args=(), device_types="cpu")
def soft_rasters_cpu(
    rings: Tensor,
    is_polygon: Tensor,
    height: int,
    width: int,
    line_softness: float,
    polygon_softness: float,
    plain: bool,
) -> Tensor:
    """Render closed float32 rings softly; see ``soft_rasters_reference``. (n, H, W)"""
    from gsmap.ops.polyline_raster.cpu_kernels import soft_forward

    masks = torch.empty(len(rings), height, width, dtype=torch.float32)
    settings = _settings(line_softness, polygon_softness, plain)
    arguments = (
        rings.contiguous().numpy(),
        is_polygon.contiguous().numpy(),
        *settings,
        masks.numpy(),
    )
    run_in_threads(
        lambda first, last: soft_forward(*arguments, first, last),
        len(rings),
        height * width,
    )
    return masks


@torch.library.custom_op("gsmap::soft_rasters_backward", mutates_args=(), device_types="cpu")
def _soft_rasters_backward(
    grads: Tensor,
    rings: Tensor,
    is_polygon: Tensor,
    line_softness: float,
    polygon_softness: float,
    plain: bool,
) -> Tensor:
    """Return the gradient in the rings. (n, V, 2)"""
    from gsmap.ops.polyline_raster.cpu_kernels import soft_backward

    gradients = torch.empty(rings.shape, dtype=torch.float64)
    settings = _settings(line_softness, polygon_softness, plain)
    arrays = grads.contiguous().numpy(), gradients.numpy()
    arguments = (rings.contiguous().numpy(), is_polygon.contiguous().numpy(), *settings, *arrays)
    run_in_threads(
        lambda first, last: soft_backward(*arguments, first, last),
        len(rings),
        math.prod(grads.shape[1:]),
    )
    return gradients.float()


@soft_rasters_cpu.register_fake
def _(  # type: ignore[no-untyped-def]
    rings, is_polygon, height, width, line_softness, polygon_softness, plain
):
    return rings.new_empty(rings.shape[0], height, width)


@_soft_rasters_backward.register_fake
def _(grads, rings, is_polygon, line_softness, polygon_softness, plain):  # type: ignore[no-untyped-def]
    return rings.new_empty(rings.shape)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:2])
    ctx.settings = inputs[4:]


def _differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
    gradient = _soft_rasters_backward(grads, *ctx.saved_tensors, *ctx.settings)
    return gradient, None, None, None, None, None, None


soft_rasters_cpu.register_autograd(_differentiate, setup_context=_setup_context)


@torch.library.custom_op("gsmap::draw_polylines", mutates_args=(), device_types="cpu")
def draw_cpu(
    polylines: Tensor,
    filled: Tensor,
    x_min: float,
    y_min: float,
    step_x: float,
    step_y: float,
    height: int,
    width: int,
    half_width: float,
    pixel: float,
    antialias: bool,
) -> Tensor:
    """Draw float32 polylines; see ``draw_reference``. (K, H, W)"""
    from gsmap.ops.polyline_raster.cpu_kernels import draw

    masks = torch.empty(len(polylines), height, width, dtype=torch.float32)
    arrays = polylines.contiguous().numpy(), filled.contiguous().numpy()
    settings = (x_min, y_min, step_x, step_y), half_width, pixel, antialias, masks.numpy()
    run_in_threads(
        lambda first, last: draw(*arrays, *settings, first, last),
        len(polylines),
        height * width,
    )
    return masks


@draw_cpu.register_fake
def _(  # type: ignore[no-untyped-def]
    polylines, filled, x_min, y_min, step_x, step_y, height, width, half_width, pixel, antialias
):
    return polylines.new_empty(polylines.shape[0], height, width)
