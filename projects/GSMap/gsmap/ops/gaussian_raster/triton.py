# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
r"""Triton kernels: masks of 2D Gaussians, one program per tile of an instance.

The raster of an instance is cut into tiles of TILE x TILE pixels. A program keeps the pixels of one
tile in registers and loops over the P Gaussians of the instance. At more than sqrt(SQUARED_REACH)
standard deviations from the mean, the density of a Gaussian is below 1e-8 (``CUT`` in
``reference.py``). The bounding box of the Gaussian encloses the points that are nearer to the mean.
If the box misses the tile, a scalar branch skips the Gaussian. A NaN Gaussian is never skipped, so
the mask becomes NaN.

A pixel at the offset (dx, dy) from the mean has the coordinates u = (c dx + s dy) / sigma_u and
v = (c dy - s dx) / sigma_v along the axes of the Gaussian, with the cosine c and the sine s of its
rotation, and the density G = exp(-(u^2 + v^2) / 2). The mask is accumulated as R <- R + G (1 - R),
which is 1 - prod (1 - G) and exact for small G.

The backward pass computes the transmittance T = prod (1 - G) of the tile again and reads dL/dR
once. As dR/dG = T / (1 - G), it sums w u, w v, w u^2, w u v and w v^2 for each Gaussian that meets
the tile, with w = dL/dR * T * G / (1 - G). The five sums are called moments. Each program writes
its moments to separate entries of a buffer (N, tiles, P, 5). There are no atomics, so repeated runs
are bitwise equal. Torch adds the moments of all tiles and computes the gradients from them.

No launch waits for the device, nothing is autotuned, and TILE is the only size that is a
compile-time constant.

There are two pairs of kernels, whose results are equal up to rounding. The first pair is the
default. The second pair (``warp_...``) replaces it if the environment variable
``GSMAP_TRITON_KERNELS`` contains ``render_gaussians_in_warps``. There a program is one warp with a
smaller tile, and Gaussians that miss the tile are not visited: the boxes of 32 Gaussians are tested
at once, one per lane, and the loop runs over the set bits of the result. The term of u and v in x
is computed once per column, and the term in y once per row. Here u and v have the factor
sqrt(log2(e) / 2), so that a density is a single power of two. A sum within a warp needs no barrier.
"""

import math

import torch
import triton
import triton.language as tl

from gsmap.ops.gaussian_raster.reference import SQUARED_REACH

TILE = 32  # side of a tile of the first pair, in pixels
WARP_TILE = 16  # side of a tile of the second pair, in pixels
CHUNK = tl.constexpr(32)  # Gaussians whose boxes are tested at once: the bits of an integer
POWER = math.sqrt(math.log2(math.e) / 2)  # exp(-x^2 / 2) = 2^-(POWER x)^2
SIGMA = tl.constexpr(1 / POWER)  # brings sums of POWER u and POWER v back to units of sigma
WARP_OPTIONS = {"num_warps": 1, "enable_fp_fusion": True}
MAX_DENSITY = tl.constexpr(1 - 1e-6)  # keeps 1 - G, by which the backward pass divides, above 0


@triton.jit
def _tile_pixels(tile, x_min, y_min, step_x, step_y, height, width, TILE: tl.constexpr):
    """Pixel centres x (1, TILE) and y (TILE, 1) of a tile, flat indices, and whether they exist."""
    tiles_x = tl.cdiv(width, TILE)
    rows = (tile // tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    cols = (tile % tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    x = x_min + (cols.to(tl.float32) + 0.5) * step_x
    y = y_min + (rows.to(tl.float32) + 0.5) * step_y
    index = rows * width + cols
    valid = (rows < height) & (cols < width)
    return x, y, index, valid


@triton.jit
def _touches(gaussian, left, right, low, high):
    """Whether the bounding box of a Gaussian meets a tile; true for NaN.

    ``gaussian`` points to the 8 parameters of a Gaussian, in the order of `_prepare`.
    """
    mean_x = tl.load(gaussian)
    mean_y = tl.load(gaussian + 1)
    half_x = tl.load(gaussian + 6)
    half_y = tl.load(gaussian + 7)
    is_beside = (mean_x + half_x < left) | (mean_x - half_x > right)
    misses = is_beside | (mean_y + half_y < low) | (mean_y - half_y > high)
    total = mean_x + mean_y + half_x + half_y  # NaN, which differs from itself, if one of them is
    return (total != total) | (misses == 0)  # `misses == 0` is "does not miss"


@triton.jit
def _density(gaussian, x, y):
    """Density of a Gaussian at pixels, and their coordinates u, v in sigmas. (TILE, TILE)

    ``gaussian`` points to the 8 parameters of a Gaussian, in the order of `_prepare`.
    """
    dx = x - tl.load(gaussian)
    dy = y - tl.load(gaussian + 1)
    cos = tl.load(gaussian + 2)
    sin = tl.load(gaussian + 3)
    u = (cos * dx + sin * dy) * tl.load(gaussian + 4)
    v = (cos * dy - sin * dx) * tl.load(gaussian + 5)
    return tl.exp(-0.5 * (u * u + v * v)), u, v


@triton.jit
def forward_kernel(
    gaussians, masks, count, x_min, y_min, step_x, step_y, height, width, TILE: tl.constexpr
):
    """Render one tile of one instance.

    Args:
        gaussians: Gaussians as returned by `_prepare`, float32. (N, P, 8)
        masks: Output for the masks, float32. (N, H, W)
        count: Number P of Gaussians of an instance.
        x_min: Smallest x of the raster in metres.
        y_min: Smallest y of the raster in metres.
        step_x: Size of a pixel along x in metres.
        step_y: Size of a pixel along y in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)  # instance; offsets into the buffers may exceed 32 bits
    tile = tl.program_id(0)
    x, y, index, valid = _tile_pixels(
        tile, x_min, y_min, step_x=step_x, step_y=step_y, height=height, width=width, TILE=TILE
    )
    left = tl.min(x)
    right = tl.max(x)
    low = tl.min(y)
    high = tl.max(y)
    mask = tl.zeros((TILE, TILE), dtype=tl.float32)
    for p in range(count):
        gaussian = gaussians + (n * count + p) * 8  # 8 parameters per Gaussian
        if _touches(gaussian, left, right=right, low=low, high=high):
            density, _, _ = _density(gaussian, x, y=y)
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
    """Sum the moments of each Gaussian over one tile of its instance.

    Args:
        gaussians: Gaussians as returned by `_prepare`, float32. (N, P, 8)
        grads: Gradient of the masks, float32. (N, H, W)
        moments: Output for the moments in units of sigma, float32. (N, tiles, P, 5)
        count: Number P of Gaussians of an instance.
        x_min: Smallest x of the raster in metres.
        y_min: Smallest y of the raster in metres.
        step_x: Size of a pixel along x in metres.
        step_y: Size of a pixel along y in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)  # instance; offsets into the buffers may exceed 32 bits
    tile = tl.program_id(0)
    x, y, index, valid = _tile_pixels(
        tile, x_min, y_min, step_x=step_x, step_y=step_y, height=height, width=width, TILE=TILE
    )
    left = tl.min(x)
    right = tl.max(x)
    low = tl.min(y)
    high = tl.max(y)
    trans = tl.full((TILE, TILE), 1.0, dtype=tl.float32)  # transmittance T
    for p in range(count):
        gaussian = gaussians + (n * count + p) * 8  # 8 parameters per Gaussian
        if _touches(gaussian, left, right=right, low=low, high=high):
            density, _, _ = _density(gaussian, x, y=y)
            trans *= 1 - tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
    grad = tl.load(grads + n * height * width + index, mask=valid, other=0.0) * trans  # dL/dR T
    out = moments + (n * tl.num_programs(0) + tile) * count * 5
    for p in range(count):
        gaussian = gaussians + (n * count + p) * 8  # 8 parameters per Gaussian
        if _touches(gaussian, left, right=right, low=low, high=high):
            density, u, v = _density(gaussian, x, y=y)
            clamped = density > MAX_DENSITY  # constant there, so it has no gradient
            odds = density / tl.where(clamped, 1.0, 1 - density)
            weight = grad * tl.where(clamped, 0.0, odds)
            tl.store(out + p * 5, tl.sum(weight * u))
            tl.store(out + p * 5 + 1, tl.sum(weight * v))
            tl.store(out + p * 5 + 2, tl.sum(weight * u * u))
            tl.store(out + p * 5 + 3, tl.sum(weight * u * v))
            tl.store(out + p * 5 + 4, tl.sum(weight * v * v))
        else:  # the buffer is not initialised
            for i in range(5):
                tl.store(out + p * 5 + i, 0.0)


@triton.jit
def _find_hits(gaussians, first, count, left, right, low, high):
    """Integer whose bit i is set if the box of Gaussian ``first + i`` meets a tile, or is NaN.

    Bit 31 is the sign of the integer, which is therefore compared with 0 by ``!=``. ``gaussians``
    points to the first Gaussian of the instance.
    """
    lane = tl.arange(0, CHUNK)
    exists = first + lane < count
    box = gaussians + (first + lane) * 8
    mean_x = tl.load(box, mask=exists, other=0.0)
    mean_y = tl.load(box + 1, mask=exists, other=0.0)
    half_x = tl.load(box + 6, mask=exists, other=0.0)
    half_y = tl.load(box + 7, mask=exists, other=0.0)
    is_beside = (mean_x + half_x < left) | (mean_x - half_x > right)
    misses = is_beside | (mean_y + half_y < low) | (mean_y - half_y > high)
    total = mean_x + mean_y + half_x + half_y  # NaN if one of them is
    hits = exists & ((total != total) | (misses == 0))
    return tl.sum(tl.where(hits, 1 << lane, 0))


@triton.jit
def _lowest_bit(bits):
    """Index of the lowest set bit, read from the exponent of a float."""
    # The lowest bit alone, a power of two. It is unsigned, since bit 31 is not a sign here.
    power = (bits & -bits).to(tl.uint32).to(tl.float32)
    return (power.to(tl.int32, bitcast=True) >> 23) - 127  # 23 bits of mantissa, bias 127


@triton.jit
def _warp_density(gaussian, x, y):
    """Density of a Gaussian at pixels, and their coordinates u, v in sigmas times POWER.

    ``gaussian`` points to the 8 parameters of a Gaussian, in the order of `_warp_parameters`.
    """
    dx = x - tl.load(gaussian)
    dy = y - tl.load(gaussian + 1)
    u = tl.load(gaussian + 2) * dx + tl.load(gaussian + 3) * dy
    v = tl.load(gaussian + 4) * dx + tl.load(gaussian + 5) * dy
    return tl.exp2(-(u * u + v * v)), u, v


@triton.jit
def warp_forward_kernel(
    gaussians, masks, count, x_min, y_min, step_x, step_y, height, width, TILE: tl.constexpr
):
    """Render one tile of one instance.

    Args:
        gaussians: Gaussians as returned by `_warp_parameters`, float32. (N, P, 8)
        masks: Output for the masks, float32. (N, H, W)
        count: Number P of Gaussians of an instance.
        x_min: Smallest x of the raster in metres.
        y_min: Smallest y of the raster in metres.
        step_x: Size of a pixel along x in metres.
        step_y: Size of a pixel along y in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)  # instance; offsets into the buffers may exceed 32 bits
    tile = tl.program_id(0)
    x, y, index, valid = _tile_pixels(
        tile, x_min, y_min, step_x=step_x, step_y=step_y, height=height, width=width, TILE=TILE
    )
    left = tl.min(x)
    right = tl.max(x)
    low = tl.min(y)
    high = tl.max(y)
    instance = gaussians + n * count * 8
    mask = tl.zeros((TILE, TILE), dtype=tl.float32)
    for first in range(0, count, CHUNK):
        bits = _find_hits(instance, first, count=count, left=left, right=right, low=low, high=high)
        while bits != 0:
            p = first + _lowest_bit(bits)
            density, _, _ = _warp_density(instance + p * 8, x, y=y)
            density = tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
            mask += density * (1 - mask)
            bits = bits & (bits - 1)  # clears the lowest bit
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
    """Sum the moments of each Gaussian over one tile of its instance.

    Args:
        gaussians: Gaussians as returned by `_warp_parameters`, float32. (N, P, 8)
        grads: Gradient of the masks, float32. (N, H, W)
        moments: Output, filled with zeros, for the moments in units of sigma, float32.
            (N, tiles, P, 5)
        count: Number P of Gaussians of an instance.
        x_min: Smallest x of the raster in metres.
        y_min: Smallest y of the raster in metres.
        step_x: Size of a pixel along x in metres.
        step_y: Size of a pixel along y in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)  # instance; offsets into the buffers may exceed 32 bits
    tile = tl.program_id(0)
    x, y, index, valid = _tile_pixels(
        tile, x_min, y_min, step_x=step_x, step_y=step_y, height=height, width=width, TILE=TILE
    )
    left = tl.min(x)
    right = tl.max(x)
    low = tl.min(y)
    high = tl.max(y)
    instance = gaussians + n * count * 8
    trans = tl.full((TILE, TILE), 1.0, dtype=tl.float32)  # transmittance T
    for first in range(0, count, CHUNK):
        bits = _find_hits(instance, first, count=count, left=left, right=right, low=low, high=high)
        while bits != 0:
            p = first + _lowest_bit(bits)
            density, _, _ = _warp_density(instance + p * 8, x, y=y)
            trans *= 1 - tl.where(density > MAX_DENSITY, MAX_DENSITY, density)
            bits = bits & (bits - 1)  # clears the lowest bit
    grad = tl.load(grads + n * height * width + index, mask=valid, other=0.0) * trans  # dL/dR T
    for first in range(0, count, CHUNK):
        bits = _find_hits(instance, first, count=count, left=left, right=right, low=low, high=high)
        while bits != 0:
            p = first + _lowest_bit(bits)
            density, u, v = _warp_density(instance + p * 8, x, y=y)
            clamped = density > MAX_DENSITY  # constant there, so it has no gradient
            odds = density / tl.where(clamped, 1.0, 1 - density)
            weight = grad * tl.where(clamped, 0.0, odds)
            out = moments + ((n * tl.num_programs(0) + tile) * count + p) * 5
            tl.store(out, tl.sum(weight * u) * SIGMA)
            tl.store(out + 1, tl.sum(weight * v) * SIGMA)
            tl.store(out + 2, tl.sum(weight * u * u) * (SIGMA * SIGMA))
            tl.store(out + 3, tl.sum(weight * u * v) * (SIGMA * SIGMA))
            tl.store(out + 4, tl.sum(weight * v * v) * (SIGMA * SIGMA))
            bits = bits & (bits - 1)  # clears the lowest bit


def _num_tiles(height, width, tile):
    """Number of tiles of a raster."""
    return math.ceil(height / tile) * math.ceil(width / tile)


def _prepare(gaussians):
    """Compute the parameters that the kernels read. (N, P, 5) -> (N, P, 8)

    They are mean x and y (0, 1), cosine and sine of the rotation (2, 3), 1 / sigma along u and v
    (4, 5), and half the width and half the height of the bounding box (6, 7).
    """
    means, scales, rotations = gaussians.split((2, 2, 1), -1)
    reach = math.sqrt(SQUARED_REACH)
    cos = rotations.cos()
    sin = rotations.sin()
    variance_u, variance_v = scales.square().split(1, -1)
    half_x = reach * (cos.square() * variance_u + sin.square() * variance_v).sqrt()
    half_y = reach * (sin.square() * variance_u + cos.square() * variance_v).sqrt()
    return torch.cat([means, cos, sin, scales.reciprocal(), half_x, half_y], dim=-1)


def render_gaussians(gaussians, frame, height, width):
    """Render Gaussians to masks.

    Args:
        gaussians: Mean x, y, scales u, v and rotation, float32. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.

    Returns:
        Masks, float32. (N, H, W)
    """
    instances, count, _ = gaussians.shape
    masks = gaussians.new_empty(instances, height, width)
    if not instances:
        return masks
    x_min, y_min, step_x, step_y = frame
    with torch.cuda.device_of(gaussians):  # Triton launches on the current device
        forward_kernel[_num_tiles(height, width, tile=TILE), instances](
            _prepare(gaussians),
            masks,
            count=count,
            x_min=x_min,
            y_min=y_min,
            step_x=step_x,
            step_y=step_y,
            height=height,
            width=width,
            TILE=TILE,
            num_warps=4,
        )
    return masks


def render_gaussians_backward(grads, gaussians, frame, height, width):
    """Compute the gradient of `render_gaussians`.

    Args:
        grads: Gradient of the masks, float32. (N, H, W)
        gaussians: Mean x, y, scales u, v and rotation, float32. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.

    Returns:
        Tuple with one entry, the gradient of the Gaussians, float32. (N, P, 5)
    """
    instances, count, _ = gaussians.shape
    if not gaussians.numel():
        return (torch.zeros_like(gaussians),)
    num_tiles = _num_tiles(height, width, tile=TILE)
    moments = gaussians.new_empty(instances, num_tiles, count, 5)
    prepared = _prepare(gaussians)
    x_min, y_min, step_x, step_y = frame
    with torch.cuda.device_of(gaussians):  # Triton launches on the current device
        backward_kernel[num_tiles, instances](
            prepared,
            grads.contiguous(),
            moments=moments,
            count=count,
            x_min=x_min,
            y_min=y_min,
            step_x=step_x,
            step_y=step_y,
            height=height,
            width=width,
            TILE=TILE,
            num_warps=4,
        )
    return (_gradients(moments, gaussians, prepared=prepared),)


def _gradients(moments, gaussians, prepared):
    """Compute the gradient of Gaussians (N, P, 5) from moments (N, tiles, P, 5).

    The moments m_u, m_v, m_uu, m_uv and m_vv are sums over pixels whose coordinates u and v are
    divided by sigma_u and sigma_v. With sigma as s, the gradients are

        dL/dsigma = (m_uu / s_u, m_vv / s_v),  dL/dmu = R(theta) (m_u / s_u, m_v / s_v),
        dL/dtheta = m_uv (s_u / s_v - s_v / s_u).

    The equations in the docstring of ``numba.py`` are equal to these, with u and v in metres.
    """
    cos, sin, inv_u, inv_v = prepared[..., 2:6].unbind(-1)
    scale_u, scale_v = gaussians[..., 2:4].unbind(-1)
    m_u, m_v, m_uu, m_uv, m_vv = moments.sum(1).unbind(-1)
    grad_u = m_u * inv_u  # gradient of the mean along the axes of the Gaussian
    grad_v = m_v * inv_v
    grad_x = cos * grad_u - sin * grad_v
    grad_y = sin * grad_u + cos * grad_v
    grad_scale_u = m_uu * inv_u
    grad_scale_v = m_vv * inv_v
    grad_rotation = m_uv * (scale_u * inv_v - scale_v * inv_u)
    return torch.stack([grad_x, grad_y, grad_scale_u, grad_scale_v, grad_rotation], dim=-1)


def _warp_parameters(prepared):
    """Compute the parameters that the kernels in warps read. (N, P, 8) -> (N, P, 8)

    They are mean x and y (0, 1), the unit vector (x, y) along u times POWER / sigma_u (2, 3), the
    unit vector along v times POWER / sigma_v (4, 5), and half the width and height of the bounding
    box (6, 7).
    """
    means, cos, sin, inverse, box = prepared.split((2, 1, 1, 2, 2), -1)
    inv_u, inv_v = (POWER * inverse).split(1, -1)
    return torch.cat([means, cos * inv_u, sin * inv_u, -sin * inv_v, cos * inv_v, box], dim=-1)


def render_gaussians_in_warps(gaussians, frame, height, width):
    """Render Gaussians to masks, one warp per tile.

    Args:
        gaussians: Mean x, y, scales u, v and rotation, float32. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.

    Returns:
        Masks, float32. (N, H, W)
    """
    instances, count, _ = gaussians.shape
    masks = gaussians.new_empty(instances, height, width)
    if not instances:
        return masks
    x_min, y_min, step_x, step_y = frame
    with torch.cuda.device_of(gaussians):  # Triton launches on the current device
        warp_forward_kernel[_num_tiles(height, width, tile=WARP_TILE), instances](
            _warp_parameters(_prepare(gaussians)),
            masks,
            count=count,
            x_min=x_min,
            y_min=y_min,
            step_x=step_x,
            step_y=step_y,
            height=height,
            width=width,
            TILE=WARP_TILE,
            **WARP_OPTIONS,
        )
    return masks


def render_gaussians_in_warps_backward(grads, gaussians, frame, height, width):
    """Compute the gradient of `render_gaussians_in_warps`.

    Args:
        grads: Gradient of the masks, float32. (N, H, W)
        gaussians: Mean x, y, scales u, v and rotation, float32. (N, P, 5)
        frame: Smallest x and y of the raster, and the size of a pixel along x and y, in metres.
        height: Rows H of the raster.
        width: Columns W of the raster.

    Returns:
        Tuple with one entry, the gradient of the Gaussians, float32. (N, P, 5)
    """
    instances, count, _ = gaussians.shape
    if not gaussians.numel():
        return (torch.zeros_like(gaussians),)
    num_tiles = _num_tiles(height, width, tile=WARP_TILE)
    # Zeros, because the kernel writes nothing for Gaussians that miss a tile.
    moments = gaussians.new_zeros(instances, num_tiles, count, 5)
    prepared = _prepare(gaussians)
    x_min, y_min, step_x, step_y = frame
    with torch.cuda.device_of(gaussians):  # Triton launches on the current device
        warp_backward_kernel[num_tiles, instances](
            _warp_parameters(prepared),
            grads.contiguous(),
            moments=moments,
            count=count,
            x_min=x_min,
            y_min=y_min,
            step_x=step_x,
            step_y=step_y,
            height=height,
            width=width,
            TILE=WARP_TILE,
            **WARP_OPTIONS,
        )
    return (_gradients(moments, gaussians, prepared=prepared),)
