# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
r"""Triton kernels and their operators: masks of 2D Gaussians, a tile of an instance per program.

How the work is laid out
    The raster of an instance is cut into TILE x TILE pixels; a program owns one tile and keeps its
    pixels in registers (8 per thread with 32 x 32 pixels and 4 warps). It walks over the instance's
    P Gaussians. Each comes as eight numbers, made beforehand by a few torch operations on (N, P)
    values: mean, cos, sin, 1 / sigma along both axes, and half the size of the box outside which
    the Gaussian is below the cut. A Gaussian whose box misses the tile is skipped by a scalar
    branch, without touching a pixel. A NaN compares false, so it is never skipped and shows up in
    the mask as it does in the reference.

    In the Gaussian's own frame u = (c dx + s dy) / sigma_u, v = (c dy - s dx) / sigma_v, and
    G = exp(-(u^2 + v^2) / 2); the mask gathers R <- R + G (1 - R), which is 1 - prod (1 - G) and
    exact for small G. It is written once. Offsets from the mean are taken in metres, whose
    float32 spacing (2e-6 m at 30 m) is far below any useful sigma.

Backward
    Only (N, P) values are kept from the forward pass. A program rebuilds its tile's transmittance
    T = prod (1 - G) in registers, reads dL/dR once, and takes for each Gaussian that touches the
    tile the five sums of w, w = dL/dR * T * G / (1 - G): w u, w v, w u^2, w u v, w v^2. They go to
    a buffer (N, tiles, P, 5) that no other program writes: no atomics, so two runs give the same
    bits. torch adds up the tiles and turns the moments into gradients on (N, P) values.

The floor
    Memory: forward writes the masks once (N H W 4 bytes); backward reads dL/dR once. The moments'
    buffer is 20 P / TILE^2 bytes per 4 bytes of mask: a tenth of the masks at P = 20, TILE = 32.
    Arithmetic: one exponential forward and two backward per pixel of a tile that a Gaussian's box
    touches. At Setting T a Gaussian of 1.0 x 0.4 m touches about 4 of 28 tiles.

No launch waits for the device, nothing is autotuned, and no size is compiled in but TILE.
"""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsmap.ops.backends import register_gradient
from gsmap.ops.gaussian_raster.reference import SQUARED_REACH

TILE = 32
MAX_DENSITY = tl.constexpr(1 - 1e-6)


@triton.jit
def _tile_pixels(tile, x_min, y_min, step_x, step_y, height, width, TILE: tl.constexpr):
    """Return a tile's pixel centres (1, TILE) and (TILE, 1), flat indices and validity."""
    tiles_x = tl.cdiv(width, TILE)
    rows = (tile // tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    cols = (tile % tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    x = x_min + (cols.to(tl.float32) + 0.5) * step_x
    y = y_min + (rows.to(tl.float32) + 0.5) * step_y
    return x, y, rows * width + cols, (rows < height) & (cols < width)


@triton.jit
def _touches(gaussian, left, right, low, high):
    """Tell whether a Gaussian's box meets a tile; true for NaN."""
    mean_x, mean_y = tl.load(gaussian), tl.load(gaussian + 1)
    half_x, half_y = tl.load(gaussian + 6), tl.load(gaussian + 7)
    beside = (mean_x + half_x < left) | (mean_x - half_x > right)
    return not (beside | (mean_y + half_y < low) | (mean_y - half_y > high))


@triton.jit
def _density(gaussian, x, y):
    """Return a Gaussian's density at pixels, and these in sigmas along its axes. (TILE, TILE)"""
    dx, dy = x - tl.load(gaussian), y - tl.load(gaussian + 1)
    cos, sin = tl.load(gaussian + 2), tl.load(gaussian + 3)
    u = (cos * dx + sin * dy) * tl.load(gaussian + 4)
    v = (cos * dy - sin * dx) * tl.load(gaussian + 5)
    return tl.exp(-0.5 * (u * u + v * v)), u, v


@triton.jit
def forward_kernel(
    gaussians, masks, count, x_min, y_min, step_x, step_y, height, width, TILE: tl.constexpr
):
    """Render one tile of one instance: gaussians (N, P, 8) to masks (N, H, W)."""
    n, tile = tl.program_id(1).to(tl.int64), tl.program_id(0)
    x, y, index, valid = _tile_pixels(tile, x_min, y_min, step_x, step_y, height, width, TILE)
    left, right, low, high = tl.min(x), tl.max(x), tl.min(y), tl.max(y)
    mask = tl.zeros((TILE, TILE), tl.float32)
    for p in range(count):
        gaussian = gaussians + (n * count + p) * 8
        if _touches(gaussian, left, right, low, high):
            density, _, _ = _density(gaussian, x, y)
            density = tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
            mask += density * (1 - mask)
    tl.store(masks + n * height * width + index, mask, mask=valid)


@triton.jit
def backward_kernel(
    gaussians,
    grads,
    moments,
    count,
    x_min,
    y_min,
    step_x,
    step_y,
    height,
    width,
    TILE: tl.constexpr,
):
    """Sum one tile's share of every Gaussian's moments: to moments (N, tiles, P, 5)."""
    n, tile = tl.program_id(1).to(tl.int64), tl.program_id(0)
    x, y, index, valid = _tile_pixels(tile, x_min, y_min, step_x, step_y, height, width, TILE)
    left, right, low, high = tl.min(x), tl.max(x), tl.min(y), tl.max(y)
    trans = tl.full((TILE, TILE), 1.0, tl.float32)
    for p in range(count):
        gaussian = gaussians + (n * count + p) * 8
        if _touches(gaussian, left, right, low, high):
            density, _, _ = _density(gaussian, x, y)
            trans *= 1 - tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
    grad = tl.load(grads + n * height * width + index, mask=valid, other=0.0) * trans
    out = moments + (n * tl.num_programs(0) + tile) * count * 5
    for p in range(count):
        gaussian = gaussians + (n * count + p) * 8
        if _touches(gaussian, left, right, low, high):
            density, u, v = _density(gaussian, x, y)
            clamped = density > MAX_DENSITY  # has no gradient
            weight = grad * tl.where(clamped, 0.0, density / tl.where(clamped, 1.0, 1 - density))
            tl.store(out + p * 5, tl.sum(weight * u))
            tl.store(out + p * 5 + 1, tl.sum(weight * v))
            tl.store(out + p * 5 + 2, tl.sum(weight * u * u))
            tl.store(out + p * 5 + 3, tl.sum(weight * u * v))
            tl.store(out + p * 5 + 4, tl.sum(weight * v * v))
        else:
            for i in range(5):
                tl.store(out + p * 5 + i, 0.0)


def _pack(means: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
    """Return mean, cos, sin, 1 / sigma and half the box of each Gaussian. (N, P, 8)"""
    reach = math.sqrt(SQUARED_REACH)
    cos, sin = torch.cos(rotations)[..., None], torch.sin(rotations)[..., None]
    u, v = scales[..., :1].square(), scales[..., 1:].square()
    half_x = reach * (cos.square() * u + sin.square() * v).sqrt()
    half_y = reach * (sin.square() * u + cos.square() * v).sqrt()
    return torch.cat([means, cos, sin, scales.reciprocal(), half_x, half_y], -1).contiguous()


@torch.library.custom_op("gsmap::render_gaussians_triton", mutates_args=())
def render(
    means: Tensor, scales: Tensor, rotations: Tensor, frame: list[float], height: int, width: int
) -> Tensor:
    """Render float32 Gaussians; ``frame``: smallest x and y, pixel size along both. (N, H, W)"""
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


@torch.library.custom_op("gsmap::render_gaussians_triton_backward", mutates_args=())
def _backward(
    grads: Tensor,
    means: Tensor,
    scales: Tensor,
    rotations: Tensor,
    frame: list[float],
    height: int,
    width: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients in means, scales and rotations."""
    instances, count = rotations.shape
    if not rotations.numel():
        return torch.zeros_like(means), torch.zeros_like(scales), torch.zeros_like(rotations)
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


@render.register_fake
def _(means, scales, rotations, frame, height, width):
    return means.new_empty(means.shape[0], height, width)


register_gradient(render, _backward, tensors=3, differentiable=3)
