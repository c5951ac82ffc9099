"""Wraps a pair of fused kernels into torch operators with a gradient."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid

Frame = tuple[float, float, float, float]  # smallest x and y, pixel size along x and y, in metres
Forward = Callable[[Tensor, Tensor, Tensor, Frame, int, int], Tensor]
Backward = Callable[[Tensor, Tensor, Tensor, Tensor, Frame], tuple[Tensor, Tensor, Tensor]]
Renderer = Callable[[Tensor, Tensor, Tensor, BEVGrid], Tensor]


def fused_renderer(name: str, forward: Forward, backward: Backward) -> Renderer:
    """Register ``gsmap::render_gaussians_<name>`` and return a function that calls it.

    As registered operators the kernels work under torch.compile, autocast, DistributedDataParallel
    and gradient checkpointing. Only the Gaussians' parameters are kept for the backward pass, so
    it can also run a second time (``retain_graph``).

    Args:
        name: Suffix of the operators' names.
        forward: ``(means, scales, rotations, frame, height, width) -> masks``, in float32.
        backward: ``(grads, means, scales, rotations, frame) -> gradients`` in the three inputs.

    Returns:
        A renderer of float32 tensors. (..., P, 2), (..., P, 2), (..., P) -> (..., H, W)
    """

    @torch.library.custom_op(f"gsmap::render_gaussians_{name}", mutates_args=())
    def render(
        means: Tensor,
        scales: Tensor,
        rotations: Tensor,
        x_min: float,
        y_min: float,
        step_x: float,
        step_y: float,
        height: int,
        width: int,
    ) -> Tensor:
        frame = (x_min, y_min, step_x, step_y)
        return forward(means, scales, rotations, frame, height, width)

    @torch.library.custom_op(f"gsmap::render_gaussians_{name}_backward", mutates_args=())
    def render_backward(
        grads: Tensor,
        means: Tensor,
        scales: Tensor,
        rotations: Tensor,
        x_min: float,
        y_min: float,
        step_x: float,
        step_y: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        return backward(grads, means, scales, rotations, (x_min, y_min, step_x, step_y))

    @render.register_fake
    def _(means, scales, rotations, x_min, y_min, step_x, step_y, height, width):  # type: ignore[no-untyped-def]
        return means.new_empty(means.shape[0], height, width)

    @render_backward.register_fake
    def _(grads, means, scales, rotations, x_min, y_min, step_x, step_y):  # type: ignore[no-untyped-def]
        return (
            torch.empty_like(means, memory_format=torch.contiguous_format),
            torch.empty_like(scales, memory_format=torch.contiguous_format),
            torch.empty_like(rotations, memory_format=torch.contiguous_format),
        )

    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:3])
        ctx.frame = inputs[3:7]

    def differentiate(ctx: Any, grads: Tensor) -> tuple[Any, ...]:
        return *render_backward(grads, *ctx.saved_tensors, *ctx.frame), *(None,) * 6

    render.register_autograd(differentiate, setup_context=setup_context)

    def renderer(means: Tensor, scales: Tensor, rotations: Tensor, grid: BEVGrid) -> Tensor:
        batch, count = means.shape[:-2], means.shape[-2]
        instances = math.prod(batch)
        masks = render(
            means.reshape(instances, count, 2),
            scales.reshape(instances, count, 2),
            rotations.reshape(instances, count),
            grid.x_range[0],
            grid.y_range[0],
            *grid.pixel_size_m,
            grid.height,
            grid.width,
        )
        return masks.reshape(*batch, grid.height, grid.width)

    return renderer
