"""The Triton backend: torch operators around the kernels. Importable without Triton."""

import math

import torch
from torch import Tensor

from gsmap.ops.gaussian_raster.fused import Frame, fused_renderer
from gsmap.ops.gaussian_raster.reference import SQUARED_REACH


def _pack(means: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
    """Return mean, cos, sin, 1 / sigma and half the box of each Gaussian. (N, P, 8)"""
    reach = math.sqrt(SQUARED_REACH)
    cos, sin = torch.cos(rotations)[..., None], torch.sin(rotations)[..., None]
    u, v = scales[..., :1].square(), scales[..., 1:].square()
    half_x = reach * (cos.square() * u + sin.square() * v).sqrt()
    half_y = reach * (sin.square() * u + cos.square() * v).sqrt()
    return torch.cat([means, cos, sin, scales.reciprocal(), half_x, half_y], -1).contiguous()


def _forward(
    means: Tensor, scales: Tensor, rotations: Tensor, frame: Frame, height: int, width: int
) -> Tensor:
    """Render masks. (N, H, W)"""
    from gsmap.ops.gaussian_raster.triton_kernels import TILE, forward_kernel

    masks = means.new_empty(len(means), height, width)
    if not len(means):
        return masks
    tiles = math.ceil(height / TILE) * math.ceil(width / TILE)
    with torch.cuda.device_of(means):
        forward_kernel[tiles, len(means)](
            _pack(means, scales, rotations),
            masks,
            means.shape[1],
            *frame,
            height,
            width,
            TILE=TILE,
            num_warps=4,
        )
    return masks


def _backward(
    grads: Tensor, means: Tensor, scales: Tensor, rotations: Tensor, frame: Frame
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients in means, scales and rotations."""
    from gsmap.ops.gaussian_raster.triton_kernels import TILE, backward_kernel

    instances, count = rotations.shape
    if not rotations.numel():
        return torch.zeros_like(means), torch.zeros_like(scales), torch.zeros_like(rotations)
    height, width = grads.shape[1:]
    tiles = math.ceil(height / TILE) * math.ceil(width / TILE)
    moments = means.new_empty(instances, tiles, count, 5)
    gaussians = _pack(means, scales, rotations)
    with torch.cuda.device_of(means):
        backward_kernel[tiles, instances](
            gaussians,
            grads.contiguous(),
            moments,
            count,
            *frame,
            height,
            width,
            TILE=TILE,
            num_warps=4,
        )
    return _gradients(moments.sum(1), gaussians, scales)


def _gradients(moments: Tensor, gaussians: Tensor, scales: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Turn the moments of w (u, v, u^2, u v, v^2, in units of sigma) into gradients."""
    cos, sin, inv_u, inv_v = gaussians[..., 2:6].unbind(-1)
    m_u, m_v, m_uu, m_uv, m_vv = moments.unbind(-1)
    m_u, m_v = m_u * inv_u, m_v * inv_v
    grad_means = torch.stack([cos * m_u - sin * m_v, sin * m_u + cos * m_v], -1)
    grad_scales = torch.stack([m_uu * inv_u, m_vv * inv_v], -1)
    scale_u, scale_v = scales.unbind(-1)
    return grad_means, grad_scales, m_uv * (scale_u * inv_v - scale_v * inv_u)


render_gaussians_triton = fused_renderer("triton", _forward, _backward)
