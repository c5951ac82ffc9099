# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
r"""Triton kernels: masks of 2D Gaussians, a tile of an instance per program.

The raster of an instance is cut into TILE x TILE pixels; a program keeps those of one tile in
registers and walks over the instance's P Gaussians. One whose box (outside of which it is below the
cut) misses the tile is skipped by a scalar branch; one that is NaN is never skipped and shows up in
the mask. In the Gaussian's own frame u = (c dx + s dy) / sigma_u, v = (c dy - s dx) / sigma_v, and
G = exp(-(u^2 + v^2) / 2); the mask gathers R <- R + G (1 - R), which is 1 - prod (1 - G) and exact
for small G.

The backward pass rebuilds the tile's transmittance T = prod (1 - G), reads dL/dR once, and takes
for each Gaussian that touches the tile the sums of w u, w v, w u^2, w u v and w v^2, with w =
dL/dR * T * G / (1 - G). They go to a buffer (N, tiles, P, 5) that no other program writes: no
atomics, so two runs give the same bits. torch adds up the tiles and turns them into gradients.

No launch waits for the device, nothing is autotuned, and no size is compiled in but TILE.

There are two pairs of kernels. In the later one (``_in_warps``) one warp has a smaller tile and
never visits what misses it: it tests the boxes of 32 Gaussians at once, a lane each, and walks the
bits of those that hit. Rows and columns share what they can of u and v, which have the factor
sqrt(log2(e) / 2), so that a density is one power of two. A warp adds up without a barrier.
"""

import math

import torch
import triton
import triton.language as tl

from gsmap.ops.gaussian_raster.reference import SQUARED_REACH

TILE = 32
WARP_TILE = 16
CHUNK = tl.constexpr(32)  # Gaussians whose boxes are tested at once: the bits of a number
POWER = math.sqrt(math.log2(math.e) / 2)  # exp(-x^2 / 2) = 2^-(POWER x)^2
SIGMA = tl.constexpr(1 / POWER)
WARP_OPTIONS = {"num_warps": 1, "enable_fp_fusion": True}
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
    misses = beside | (mean_y + half_y < low) | (mean_y - half_y > high)
    total = mean_x + mean_y + half_x + half_y
    return (total != total) | (misses == 0)


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


@triton.jit
def _find_hits(gaussians, first, count, left, right, low, high):
    """Return a number: bit i tells whether Gaussian first + i's box meets a tile, or is NaN."""
    lane = tl.arange(0, CHUNK)
    exists = first + lane < count
    box = gaussians + (first + lane) * 8
    mean_x, mean_y = tl.load(box, exists, 0.0), tl.load(box + 1, exists, 0.0)
    half_x, half_y = tl.load(box + 6, exists, 0.0), tl.load(box + 7, exists, 0.0)
    beside = (mean_x + half_x < left) | (mean_x - half_x > right)
    misses = beside | (mean_y + half_y < low) | (mean_y - half_y > high)
    total = mean_x + mean_y + half_x + half_y
    hits = exists & ((total != total) | (misses == 0))
    return tl.sum(tl.where(hits, 1 << lane, 0))


@triton.jit
def _lowest_bit(bits):
    """Return the number of the lowest set bit, which is the exponent of a power of two."""
    power = (bits & -bits).to(tl.uint32).to(tl.float32)
    return (power.to(tl.int32, bitcast=True) >> 23) - 127


@triton.jit
def _warp_density(gaussian, x, y):
    """Return a Gaussian's density at pixels, and these along its axes in sigmas times POWER."""
    dx, dy = x - tl.load(gaussian), y - tl.load(gaussian + 1)
    u = tl.load(gaussian + 2) * dx + tl.load(gaussian + 3) * dy
    v = tl.load(gaussian + 4) * dx + tl.load(gaussian + 5) * dy
    return tl.exp2(-(u * u + v * v)), u, v


@triton.jit
def warp_forward_kernel(
    gaussians, masks, count, x_min, y_min, step_x, step_y, height, width, TILE: tl.constexpr
):
    """Render one tile of one instance: gaussians (N, P, 8) to masks (N, H, W)."""
    n, tile = tl.program_id(1).to(tl.int64), tl.program_id(0)
    x, y, index, valid = _tile_pixels(tile, x_min, y_min, step_x, step_y, height, width, TILE)
    left, right, low, high = tl.min(x), tl.max(x), tl.min(y), tl.max(y)
    own = gaussians + n * count * 8
    mask = tl.zeros((TILE, TILE), tl.float32)
    for first in range(0, count, CHUNK):
        bits = _find_hits(own, first, count, left, right, low, high)
        while bits != 0:
            density, _, _ = _warp_density(own + (first + _lowest_bit(bits)) * 8, x, y)
            density = tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
            mask += density * (1 - mask)
            bits = bits & (bits - 1)
    tl.store(masks + n * height * width + index, mask, mask=valid)


@triton.jit
def warp_backward_kernel(
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
    """Sum one tile's share of the moments of what hits it: to moments (N, tiles, P, 5), zeros."""
    n, tile = tl.program_id(1).to(tl.int64), tl.program_id(0)
    x, y, index, valid = _tile_pixels(tile, x_min, y_min, step_x, step_y, height, width, TILE)
    left, right, low, high = tl.min(x), tl.max(x), tl.min(y), tl.max(y)
    own = gaussians + n * count * 8
    trans = tl.full((TILE, TILE), 1.0, tl.float32)
    for first in range(0, count, CHUNK):
        bits = _find_hits(own, first, count, left, right, low, high)
        while bits != 0:
            density, _, _ = _warp_density(own + (first + _lowest_bit(bits)) * 8, x, y)
            trans *= 1 - tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
            bits = bits & (bits - 1)
    grad = tl.load(grads + n * height * width + index, mask=valid, other=0.0) * trans
    for first in range(0, count, CHUNK):
        bits = _find_hits(own, first, count, left, right, low, high)
        while bits != 0:
            p = first + _lowest_bit(bits)
            density, u, v = _warp_density(own + p * 8, x, y)
            clamped = density > MAX_DENSITY  # has no gradient
            weight = grad * tl.where(clamped, 0.0, density / tl.where(clamped, 1.0, 1 - density))
            out = moments + ((n * tl.num_programs(0) + tile) * count + p) * 5
            tl.store(out, tl.sum(weight * u) * SIGMA)
            tl.store(out + 1, tl.sum(weight * v) * SIGMA)
            tl.store(out + 2, tl.sum(weight * u * u) * (SIGMA * SIGMA))
            tl.store(out + 3, tl.sum(weight * u * v) * (SIGMA * SIGMA))
            tl.store(out + 4, tl.sum(weight * v * v) * (SIGMA * SIGMA))
            bits = bits & (bits - 1)


def _tiles(height, width, tile=TILE):
    """Return the number of tiles of a raster."""
    return math.ceil(height / tile) * math.ceil(width / tile)


def _prepare(gaussians):
    """Return mean, cos, sin, 1 / sigma and half the box of each Gaussian. (N, P, 5) -> (N, P, 8)"""
    means, scales, rotations = gaussians.split((2, 2, 1), -1)
    reach, cos, sin = math.sqrt(SQUARED_REACH), rotations.cos(), rotations.sin()
    u, v = scales.square().split(1, -1)
    half_x = reach * (cos.square() * u + sin.square() * v).sqrt()
    half_y = reach * (sin.square() * u + cos.square() * v).sqrt()
    return torch.cat([means, cos, sin, scales.reciprocal(), half_x, half_y], -1)


def render_gaussians(gaussians, frame, height, width):
    """Render float32 Gaussians: mean x, y, scale u, v, rotation. (N, P, 5) -> (N, H, W)

    ``frame`` is the smallest x and y and the pixel's size along both.
    """
    masks = gaussians.new_empty(len(gaussians), height, width)
    if len(gaussians):
        with torch.cuda.device_of(gaussians):
            launch = forward_kernel[_tiles(height, width), len(gaussians)]
            arguments = _prepare(gaussians), masks, gaussians.shape[1], *frame, height, width
            launch(*arguments, TILE=TILE, num_warps=4)
    return masks


def render_gaussians_backward(grads, gaussians, frame, height, width):
    """Return the gradient in the Gaussians. (N, P, 5)"""
    instances, count, _ = gaussians.shape
    if not gaussians.numel():
        return (torch.zeros_like(gaussians),)
    tiles = _tiles(height, width)
    moments = gaussians.new_empty(instances, tiles, count, 5)
    prepared = _prepare(gaussians)
    arguments = prepared, grads.contiguous(), moments, count, *frame, height, width
    with torch.cuda.device_of(gaussians):
        backward_kernel[tiles, instances](*arguments, TILE=TILE, num_warps=4)
    return (_combine(moments, gaussians, prepared),)


def _combine(moments, gaussians, prepared):
    """Turn moments in units of sigma (N, tiles, P, 5) into the gradient in the Gaussians."""
    cos, sin, inv_u, inv_v = prepared[..., 2:6].unbind(-1)
    scale_u, scale_v = gaussians[..., 2:4].unbind(-1)
    m_u, m_v, m_uu, m_uv, m_vv = moments.sum(1).unbind(-1)  # in units of sigma
    m_u, m_v = m_u * inv_u, m_v * inv_v
    turn = m_uv * (scale_u * inv_v - scale_v * inv_u)
    shift = cos * m_u - sin * m_v, sin * m_u + cos * m_v
    return torch.stack([*shift, m_uu * inv_u, m_vv * inv_v, turn], -1)


def _warp_parameters(prepared):
    """Return mean, the axes u and v over sigma times POWER, half the box. (N, P, 8), both"""
    means, cos, sin, inverse, box = prepared.split((2, 1, 1, 2, 2), -1)
    inv_u, inv_v = (POWER * inverse).split(1, -1)
    return torch.cat([means, cos * inv_u, sin * inv_u, -sin * inv_v, cos * inv_v, box], -1)


def render_gaussians_in_warps(gaussians, frame, height, width):
    """Do what `render_gaussians` does, a warp a tile."""
    masks = gaussians.new_empty(len(gaussians), height, width)
    if len(gaussians):
        with torch.cuda.device_of(gaussians):
            launch = warp_forward_kernel[_tiles(height, width, WARP_TILE), len(gaussians)]
            parameters = _warp_parameters(_prepare(gaussians))
            arguments = parameters, masks, gaussians.shape[1], *frame, height, width
            launch(*arguments, TILE=WARP_TILE, **WARP_OPTIONS)
    return masks


def render_gaussians_in_warps_backward(grads, gaussians, frame, height, width):
    """Do what `render_gaussians_backward` does, a warp a tile."""
    instances, count, _ = gaussians.shape
    if not gaussians.numel():
        return (torch.zeros_like(gaussians),)
    tiles = _tiles(height, width, WARP_TILE)
    moments = gaussians.new_zeros(instances, tiles, count, 5)
    prepared = _prepare(gaussians)
    parameters = _warp_parameters(prepared)
    arguments = parameters, grads.contiguous(), moments, count, *frame, height, width
    with torch.cuda.device_of(gaussians):
        warp_backward_kernel[tiles, instances](*arguments, TILE=WARP_TILE, **WARP_OPTIONS)
    return (_combine(moments, gaussians, prepared),)
