# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: soft rasters and ground-truth masks, a tile of an element per program.

One warp keeps a tile of TILE x TILE pixels in registers and walks over the element's edges: the
smallest squared distance, the edge it belongs to, and how many edges lie to the right of a pixel.
No tensor per edge exists.

The backward pass finds the nearest edges again. Those that own a pixel of the tile are the set bits
of a number, 32 edges at a time; for each the warp adds up the gradient in its two ends, and writes
it to a buffer (n, tiles, V, 4) that no other program writes: no atomics, so two runs give the same
bits. torch adds up the tiles.
"""

import math

import torch
import triton
import triton.language as tl

from gsmap.ops.polyline_raster.reference import DISTANCE_EPS, LENGTH_EPS

TILE = 16
OPTIONS = {"num_warps": 1, "enable_fp_fusion": True}
CHUNK = tl.constexpr(32)  # edges at a time: the bits of a number
EPS = tl.constexpr(LENGTH_EPS)
SHORTEST = tl.constexpr(1e-30)  # squared length of an edge, which may be a single point


@triton.jit
def _tile_pixels(height, width, TILE: tl.constexpr):
    """Return a tile's columns (1, TILE) and rows (TILE, 1), flat indices and validity."""
    tiles_x = tl.cdiv(width, TILE)
    rows = (tl.program_id(0) // tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    cols = (tl.program_id(0) % tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    valid = (rows < height) & (cols < width)
    return cols.to(tl.float32), rows.to(tl.float32), rows * width + cols, valid


@triton.jit
def _ends(ring, edge, count):
    """Return the first end of an edge of a closed ring, and the way to the second."""
    following = tl.where(edge + 1 < count, edge + 1, 0)
    x, y = tl.load(ring + 2 * edge), tl.load(ring + 2 * edge + 1)
    return x, y, tl.load(ring + 2 * following) - x, tl.load(ring + 2 * following + 1) - y


@triton.jit
def _survey(ring, edges, count, x, y, eps, TILE: tl.constexpr):
    """Return squared distances to the nearest edges, these, the inside, and 0, or NaN if one is."""
    nearest = tl.full((TILE, TILE), float("inf"), tl.float32)
    owner = tl.full((TILE, TILE), 0, tl.int32)
    inside = tl.full((TILE, TILE), 0, tl.int32)
    poison = 0.0
    for edge in range(edges):
        x0, y0, edge_x, edge_y = _ends(ring, edge, count)
        poison += (edge_x - edge_x) + (edge_y - edge_y)
        length2 = tl.maximum(edge_x * edge_x + edge_y * edge_y + eps, SHORTEST)
        offset_x, offset_y = x - x0, y - y0
        along = offset_x * (edge_x / length2) + offset_y * (edge_y / length2)
        along = tl.minimum(tl.maximum(along, 0.0), 1.0)
        dx, dy = offset_x - along * edge_x, offset_y - along * edge_y
        squared = dx * dx + dy * dy
        closer = squared < nearest
        nearest = tl.where(closer, squared, nearest)
        owner = tl.where(closer, edge, owner)
        straddles = (offset_y < 0) != (offset_y < edge_y)
        rise = tl.where(edge_y == 0, 1.0, edge_y)
        inside ^= (straddles & (offset_x < edge_x * offset_y / rise)).to(tl.int32)
    return nearest, owner, inside != 0, poison


@triton.jit
def _distance(squared, nearest, PLAIN: tl.constexpr):
    """Return D: a squared distance as it is, or the distance, which is at least ``nearest``."""
    if PLAIN:
        squared = tl.maximum(tl.sqrt(squared), nearest)
    return squared


@triton.jit
def soft_forward_kernel(
    rings,
    polygons,
    masks,
    count,
    height,
    width,
    line_softness,
    polygon_softness,
    nearest,
    PLAIN: tl.constexpr,
    TILE: tl.constexpr,
):
    """Render one tile of one closed ring: rings (n, V, 2) to masks (n, H, W)."""
    n = tl.program_id(1).to(tl.int64)
    x, y, index, valid = _tile_pixels(height, width, TILE)
    squared, _, inside, poison = _survey(rings + n * count * 2, count, count, x, y, EPS, TILE)
    filled = tl.load(polygons + n) != 0
    softness = tl.where(filled, polygon_softness, line_softness)
    fade = tl.exp(-_distance(squared, nearest, PLAIN) / softness)
    area = tl.where(inside, 1.0, fade) / (1 + fade)
    tl.store(masks + n * height * width + index, tl.where(filled, area, fade) + poison, valid)


@triton.jit
def _or(a, b):
    return a | b


@triton.jit
def soft_backward_kernel(
    rings,
    polygons,
    grads,
    sums,
    count,
    height,
    width,
    line_softness,
    polygon_softness,
    nearest,
    PLAIN: tl.constexpr,
    TILE: tl.constexpr,
):
    """Sum one tile's gradient in the ends of the edges it owns: to sums (n, tiles, V, 4), zeros."""
    n = tl.program_id(1).to(tl.int64)
    x, y, index, valid = _tile_pixels(height, width, TILE)
    ring = rings + n * count * 2
    squared, owner, inside, _ = _survey(ring, count, count, x, y, EPS, TILE)
    filled = tl.load(polygons + n) != 0
    softness = tl.where(filled, polygon_softness, line_softness)
    distance = _distance(squared, nearest, PLAIN)
    fade = tl.exp(-distance / softness)
    area = tl.where(inside, fade, -fade) / ((1 + fade) * (1 + fade))
    grad = tl.load(grads + n * height * width + index, valid, 0.0)
    weight = grad * tl.where(filled, area, -fade) / softness  # gradient in D
    if PLAIN:
        weight *= tl.where(distance > nearest, 0.5 / distance, 0.0)  # in the squared distance
    out = sums + (n * tl.num_programs(0) + tl.program_id(0)) * count * 4
    for first in range(0, count, CHUNK):
        bit = owner - first
        owned = (weight != 0) & (bit >= 0) & (bit < CHUNK)
        bits = tl.where(owned, 1 << tl.where(owned, bit, 0), 0)
        left = tl.reduce(tl.reduce(bits, 1, _or), 0, _or)
        while left != 0:
            lowest = (left & -left).to(tl.uint32).to(tl.float32)  # a power of two
            edge = first + (lowest.to(tl.int32, bitcast=True) >> 23) - 127
            x0, y0, edge_x, edge_y = _ends(ring, edge, count)
            length2 = edge_x * edge_x + edge_y * edge_y + EPS
            offset_x, offset_y = x - x0, y - y0
            along = offset_x * (edge_x / length2) + offset_y * (edge_y / length2)
            t = tl.minimum(tl.maximum(along, 0.0), 1.0)
            dx, dy = offset_x - t * edge_x, offset_y - t * edge_y
            # Between the ends t has a gradient of its own: EPS, and rounding, move it off the
            # nearest point. As computed, and not by EPS alone, it undoes what rounding does.
            between = (along >= 0) & (along <= 1)
            slip = tl.where(between, 2 * (dx * edge_x + dy * edge_y) / length2, 0.0)
            own = tl.where(owner == edge, weight, 0.0)
            end_x = -2 * t * dx - slip * (offset_x - 2 * t * edge_x)
            end_y = -2 * t * dy - slip * (offset_y - 2 * t * edge_y)
            tl.store(out + edge * 4, tl.sum(own * (slip * edge_x - 2 * dx - end_x)))
            tl.store(out + edge * 4 + 1, tl.sum(own * (slip * edge_y - 2 * dy - end_y)))
            tl.store(out + edge * 4 + 2, tl.sum(own * end_x))
            tl.store(out + edge * 4 + 3, tl.sum(own * end_y))
            left = left & (left - 1)


@triton.jit
def draw_kernel(
    polylines,
    filled,
    masks,
    count,
    height,
    width,
    x_min,
    y_min,
    step_x,
    step_y,
    half_width,
    pixel,
    TILE: tl.constexpr,
):
    """Draw one tile of one polyline or filled polygon: (K, P, 2) to masks (K, H, W)."""
    n = tl.program_id(1).to(tl.int64)
    cols, rows, index, valid = _tile_pixels(height, width, TILE)
    x, y = x_min + (cols + 0.5) * step_x, y_min + (rows + 0.5) * step_y
    closed = (tl.load(filled + n) != 0).to(tl.int32)
    squared, _, inside, poison = _survey(
        polylines + n * count * 2, count - 1 + closed, count, x, y, 0.0, TILE
    )
    distance = tl.sqrt(squared)
    area = tl.minimum(0.5 + tl.where(inside, distance, -distance) / pixel, 1.0)
    near = tl.minimum((distance + half_width) / pixel, 0.5)
    line = near - tl.maximum((distance - half_width) / pixel, -0.5)
    share = tl.maximum(tl.where(closed != 0, area, line), 0.0)
    tl.store(masks + n * height * width + index, share + poison, valid)


def _tiles(height, width):
    """Return the number of tiles of a raster."""
    return math.ceil(height / TILE) * math.ceil(width / TILE)


def _flags(flags):
    """Return bools as the kernels read them."""
    return flags.contiguous().view(torch.uint8)


def soft_rasters(rings, is_polygon, height, width, softness, plain):
    """Render closed float32 rings softly; see ``soft_rasters_reference``. (n, H, W)"""
    masks = torch.empty(len(rings), height, width, dtype=torch.float32, device=rings.device)
    if masks.numel():
        tensors = rings.contiguous(), _flags(is_polygon), masks
        numbers = rings.shape[1], height, width, *softness, DISTANCE_EPS
        with torch.cuda.device_of(rings):
            launch = soft_forward_kernel[_tiles(height, width), len(rings)]
            launch(*tensors, *numbers, PLAIN=plain, TILE=TILE, **OPTIONS)
    return masks


def soft_rasters_backward(grads, rings, is_polygon, height, width, softness, plain):
    """Return the gradient in the rings; not a number for a ring with such a vertex. (n, V, 2)"""
    if not grads.numel():
        return (torch.zeros_like(rings, memory_format=torch.contiguous_format),)
    tiles, rings = _tiles(height, width), rings.contiguous()
    shape = len(rings), tiles, rings.shape[1], 4
    sums = torch.zeros(shape, dtype=torch.float32, device=rings.device)
    tensors = rings, _flags(is_polygon), grads.contiguous(), sums
    numbers = rings.shape[1], height, width, *softness, DISTANCE_EPS
    with torch.cuda.device_of(rings):
        launch = soft_backward_kernel[tiles, len(rings)]
        launch(*tensors, *numbers, PLAIN=plain, TILE=TILE, **OPTIONS)
    starts, ends = sums.sum(1).split(2, -1)
    poison = (rings - rings).sum((1, 2), keepdim=True)
    return (starts + ends.roll(1, 1) + poison,)


def draw_polylines(polylines, filled, height, width, frame, half_width, pixel):
    """Draw float32 polylines; see ``draw_reference``. (K, H, W)"""
    masks = torch.empty(len(polylines), height, width, dtype=torch.float32, device=polylines.device)
    if masks.numel():
        tensors = polylines.contiguous(), _flags(filled), masks
        numbers = polylines.shape[1], height, width, *frame, half_width, pixel
        with torch.cuda.device_of(polylines):
            launch = draw_kernel[_tiles(height, width), len(polylines)]
            launch(*tensors, *numbers, TILE=TILE, **OPTIONS)
    return masks
