"""The CPU backend: torch operators around the numba kernels."""

import torch
from torch import Tensor

from gsmap.ops._numba import run_in_threads
from gsmap.ops.gaussian_raster.fused import Frame, fused_renderer


def _pack(means: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
    """Put an instance's parameters together in float64. (N, P, 5)"""
    return torch.cat([means, scales, rotations[..., None]], -1).double().contiguous()


def _forward(
    means: Tensor, scales: Tensor, rotations: Tensor, frame: Frame, height: int, width: int
) -> Tensor:
    """Render masks. (N, H, W)"""
    from gsmap.ops.gaussian_raster.cpu_kernels import render_forward

    gaussians = _pack(means, scales, rotations).numpy()
    masks = torch.empty(len(means), height, width, dtype=torch.float32)
    array = masks.numpy()
    run_in_threads(
        lambda first, last: render_forward(gaussians, frame, array, first, last),
        len(means),
        height * width,
    )
    return masks


def _backward(
    grads: Tensor, means: Tensor, scales: Tensor, rotations: Tensor, frame: Frame
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients in means, scales and rotations."""
    from gsmap.ops.gaussian_raster.cpu_kernels import render_backward

    packed = _pack(means, scales, rotations)
    gaussians, array = packed.numpy(), grads.contiguous().numpy()
    out = torch.empty_like(packed)
    gradients = out.numpy()
    run_in_threads(
        lambda first, last: render_backward(gaussians, frame, array, gradients, first, last),
        len(means),
        grads[0].numel() if len(grads) else 0,
    )
    out = out.float()
    return out[..., :2].clone(), out[..., 2:4].clone(), out[..., 4].clone()


render_gaussians_cpu = fused_renderer("cpu", _forward, _backward)
