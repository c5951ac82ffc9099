# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: soft rasters and ground-truth masks, one program per tile of an element.

A warp keeps a tile of TILE x TILE pixels in registers and loops over the edges of the element. For
each pixel it computes the smallest squared distance, the index of the nearest edge, and whether the
number of edges to the right is odd. There is no tensor per edge.

The backward pass searches the nearest edges again. The set of edges that are nearest to a pixel of
the tile is an integer with one bit per edge, for 32 edges at a time. For each of these edges the
warp sums the gradient of both ends and writes it to its entries of a buffer (n, tiles, V, 4). There
are no atomics, so repeated runs are equal to the bit. Torch adds the sums of all tiles.
"""

import math

import torch
import triton
import triton.language as tl

from gsmap.ops.polyline_raster.reference import DISTANCE_EPS, LENGTH_EPS

TILE = 16
OPTIONS = {"num_warps": 1, "enable_fp_fusion": True}
CHUNK = tl.constexpr(32)  # number of edges at a time: the bits of an integer
EPS = tl.constexpr(LENGTH_EPS)  # added to squared lengths of edges, as in the reference
SHORTEST = tl.constexpr(1e-30)  # smallest squared length of an edge, which may be a point


@triton.jit
def _tile_pixels(height, width, TILE: tl.constexpr):
    """Columns (1, TILE), rows (TILE, 1), flat indices and validity of the pixels of a tile.

    The last two are (TILE, TILE). A pixel is valid if it lies in the raster.
    """
    tiles_x = tl.cdiv(width, TILE)
    rows = (tl.program_id(0) // tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    cols = (tl.program_id(0) % tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    index = rows * width + cols
    valid = (rows < height) & (cols < width)
    return cols.to(tl.float32), rows.to(tl.float32), index, valid


@triton.jit
def _ends(ring, edge, count):
    """Start (x, y) of an edge of a closed ring of ``count`` vertices, and the vector to its end."""
    following = tl.where(edge + 1 < count, edge + 1, 0)
    x = tl.load(ring + 2 * edge)
    y = tl.load(ring + 2 * edge + 1)
    edge_x = tl.load(ring + 2 * following) - x
    edge_y = tl.load(ring + 2 * following + 1) - y
    return x, y, edge_x, edge_y


@triton.jit
def _nearest_edges(ring, num_edges, count, x, y, eps, TILE: tl.constexpr):
    """Squared distance and index of the nearest edge of each pixel, inside flags, and a NaN term.

    The flags are True for pixels inside of the ring. The term is a scalar that is added to the
    mask: NaN if a vertex is not finite, otherwise zero.

    Args:
        ring: Pointer to the vertices (x, y). (count, 2)
        num_edges: Number of edges: ``count`` for a closed ring, one fewer for an open polyline.
        count: Number of vertices.
        x: x of the pixel centres, in the unit of the vertices. (1, TILE)
        y: y of the pixel centres. (TILE, 1)
        eps: Number that is added to the squared length of an edge.
        TILE: Side of a tile in pixels.
    """
    nearest = tl.full((TILE, TILE), float("inf"), dtype=tl.float32)
    edge_index = tl.full((TILE, TILE), 0, dtype=tl.int32)
    inside = tl.full((TILE, TILE), 0, dtype=tl.int32)
    poison = 0.0
    for edge in range(num_edges):
        x0, y0, edge_x, edge_y = _ends(ring, edge, count=count)
        # A number minus itself is NaN if it is infinite or NaN.
        poison += (edge_x - edge_x) + (edge_y - edge_y)
        length2 = tl.maximum(edge_x * edge_x + edge_y * edge_y + eps, SHORTEST)
        offset_x = x - x0
        offset_y = y - y0
        along = offset_x * (edge_x / length2) + offset_y * (edge_y / length2)
        along = tl.minimum(tl.maximum(along, 0.0), 1.0)
        dx = offset_x - along * edge_x
        dy = offset_y - along * edge_y
        squared = dx * dx + dy * dy
        closer = squared < nearest
        nearest = tl.where(closer, squared, nearest)
        edge_index = tl.where(closer, edge, edge_index)
        # The ray from the pixel towards larger x crosses the edge: it changes between outside and
        # inside (even-odd rule). Offsets are relative to the start of the edge.
        # Each comparison is whether an end of the edge lies above the pixel (larger y). Both ends
        # are loaded, so that two edges agree on the vertex between them.
        y1 = tl.load(ring + 2 * tl.where(edge + 1 < count, edge + 1, 0) + 1)
        straddles = (y < y0) != (y < y1)
        rise = tl.where(edge_y == 0, 1.0, edge_y)  # no division by 0
        inside ^= (straddles & (offset_x < edge_x * offset_y / rise)).to(tl.int32)
    return nearest, edge_index, inside != 0, poison


@triton.jit
def _distance(squared, min_distance, PLAIN: tl.constexpr):
    """Distance D with which a mask fades, from the squared distance of pixels to the nearest edge.

    If PLAIN, D is the root of the squared distance, and at least ``min_distance``. Otherwise D is
    the squared distance itself.
    """
    distance = squared
    if PLAIN:
        distance = tl.maximum(tl.sqrt(squared), min_distance)
    return distance


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
    min_distance,
    PLAIN: tl.constexpr,
    TILE: tl.constexpr,
):
    """Render one tile of one closed ring: exp(-D / s), or sigmoid(+-D / s) for a polygon.

    Args:
        rings: Vertices of closed rings in pixels, float32. (n, V, 2)
        polygons: Whether a ring is a polygon, uint8. (n,)
        masks: Output for the masks, float32. (n, H, W)
        count: Number V of vertices of a ring.
        height: Rows H of the raster.
        width: Columns W of the raster.
        line_softness: Softness s of lines, in the unit of D.
        polygon_softness: Softness s of polygons, in the unit of D.
        min_distance: Smallest distance of a pixel from an edge, in pixels.
        PLAIN: Whether D is the distance to the nearest edge instead of its square.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)
    x, y, index, valid = _tile_pixels(height, width, TILE=TILE)
    squared, _, inside, poison = _nearest_edges(
        rings + n * count * 2, count, count=count, x=x, y=y, eps=EPS, TILE=TILE
    )
    filled = tl.load(polygons + n) != 0
    softness = tl.where(filled, polygon_softness, line_softness)
    fade = tl.exp(-_distance(squared, min_distance, PLAIN=PLAIN) / softness)
    # sigmoid(D / s) = 1 / (1 + fade) inside, and sigmoid(-D / s) = fade / (1 + fade) outside.
    area = tl.where(inside, 1.0, fade) / (1 + fade)
    mask = tl.where(filled, area, fade) + poison
    tl.store(masks + n * height * width + index, mask, mask=valid)


@triton.jit
def _or(a, b):
    """Bitwise or, for a reduction."""
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
    min_distance,
    PLAIN: tl.constexpr,
    TILE: tl.constexpr,
):
    """Sum the gradients of the ends of edges over the pixels of one tile.

    Args:
        rings: Vertices of closed rings in pixels, float32. (n, V, 2)
        polygons: Whether a ring is a polygon, uint8. (n,)
        grads: Gradient of the masks, float32. (n, H, W)
        sums: Output, filled with zeros, for the gradient of the start (2) and the end (2) of each
            edge, float32. (n, tiles, V, 4)
        count: Number V of vertices of a ring.
        height: Rows H of the raster.
        width: Columns W of the raster.
        line_softness: Softness s of lines, in the unit of D.
        polygon_softness: Softness s of polygons, in the unit of D.
        min_distance: Smallest distance of a pixel from an edge, in pixels.
        PLAIN: Whether D is the distance to the nearest edge instead of its square.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)
    x, y, index, valid = _tile_pixels(height, width, TILE=TILE)
    ring = rings + n * count * 2
    squared, edge_index, inside, _ = _nearest_edges(
        ring, count, count=count, x=x, y=y, eps=EPS, TILE=TILE
    )
    filled = tl.load(polygons + n) != 0
    softness = tl.where(filled, polygon_softness, line_softness)
    distance = _distance(squared, min_distance, PLAIN=PLAIN)
    fade = tl.exp(-distance / softness)
    # Derivative of a polygon's sigmoid by D / s. A line's exp(-D / s) has the derivative -fade.
    area_slope = tl.where(inside, fade, -fade) / ((1 + fade) * (1 + fade))
    grad = tl.load(grads + n * height * width + index, mask=valid, other=0.0)
    weight = grad * tl.where(filled, area_slope, -fade) / softness  # gradient of D
    if PLAIN:  # gradient of the squared distance, whose root is D
        weight *= tl.where(distance > min_distance, 0.5 / distance, 0.0)
    # Entries of this tile in `sums`, 4 for each edge.
    out = sums + (n * tl.num_programs(0) + tl.program_id(0)) * count * 4
    for first in range(0, count, CHUNK):
        bit = edge_index - first  # position of the nearest edge of each pixel in this chunk
        in_chunk = (weight != 0) & (bit >= 0) & (bit < CHUNK)
        # One bit for the nearest edge of each pixel. The inner `where` keeps shifts in 0 to 31.
        pixel_bits = tl.where(in_chunk, 1 << tl.where(in_chunk, bit, 0), 0)
        row_bits = tl.reduce(pixel_bits, 1, combine_fn=_or)
        bits = tl.reduce(row_bits, 0, combine_fn=_or)
        while bits != 0:
            lowest = (bits & -bits).to(tl.uint32).to(tl.float32)  # a power of two
            # The exponent of a float32 follows 23 bits of mantissa and has the bias 127.
            edge = first + (lowest.to(tl.int32, bitcast=True) >> 23) - 127
            x0, y0, edge_x, edge_y = _ends(ring, edge, count=count)
            length2 = edge_x * edge_x + edge_y * edge_y + EPS
            offset_x = x - x0
            offset_y = y - y0
            along = offset_x * (edge_x / length2) + offset_y * (edge_y / length2)
            t = tl.minimum(tl.maximum(along, 0.0), 1.0)
            dx = offset_x - t * edge_x
            dy = offset_y - t * edge_y
            # The squared distance is S = d . d with d = o - t e: e is the edge, from its start to
            # its end, and o is the offset of the pixel from the start. Between the ends,
            # t = o . e / L with L = e . e + EPS. For EPS = 0, t would be the nearest point, and
            # dS/dt = -2 d . e would be 0. EPS and rounding change t a little, so that dS/dt counts:
            # slip = -(dS/dt) / L. With dt/de = (o - 2 t e) / L and dt/do = e / L, the derivatives
            # are dS/de = -2 t d - slip (o - 2 t e) and dS/do = 2 d - slip e.
            # As e = end - start and o = pixel - start, the gradient is dS/de for the end (`end_x`,
            # `end_y`), and -dS/do - dS/de for the start.
            between = (along >= 0) & (along <= 1)
            slip = tl.where(between, 2 * (dx * edge_x + dy * edge_y) / length2, 0.0)
            share = tl.where(edge_index == edge, weight, 0.0)  # only pixels nearest to this edge
            end_x = -2 * t * dx - slip * (offset_x - 2 * t * edge_x)
            end_y = -2 * t * dy - slip * (offset_y - 2 * t * edge_y)
            tl.store(out + edge * 4, tl.sum(share * (slip * edge_x - 2 * dx - end_x)))
            tl.store(out + edge * 4 + 1, tl.sum(share * (slip * edge_y - 2 * dy - end_y)))
            tl.store(out + edge * 4 + 2, tl.sum(share * end_x))
            tl.store(out + edge * 4 + 3, tl.sum(share * end_y))
            bits = bits & (bits - 1)  # clears the lowest bit


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
    """Draw one tile of one polyline or filled polygon.

    Args:
        polylines: Vertices in metres, float32. (K, P, 2)
        filled: Whether a polyline is filled as a polygon, uint8. (K,)
        masks: Output for the masks, float32. (K, H, W)
        count: Number P of vertices of a polyline.
        height: Rows H of the raster.
        width: Columns W of the raster.
        x_min: Smallest x of the raster in metres.
        y_min: Smallest y of the raster in metres.
        step_x: Size of a pixel along x in metres.
        step_y: Size of a pixel along y in metres.
        half_width: Half the width of a line in metres.
        pixel: Side in metres of a square with the area of a pixel.
        TILE: Side of a tile in pixels.
    """
    n = tl.program_id(1).to(tl.int64)
    cols, rows, index, valid = _tile_pixels(height, width, TILE=TILE)
    x = x_min + (cols + 0.5) * step_x
    y = y_min + (rows + 0.5) * step_y
    closed = (tl.load(filled + n) != 0).to(tl.int32)
    num_edges = count - 1 + closed  # a filled polygon has an edge from its last to its first vertex
    squared, _, inside, poison = _nearest_edges(
        polylines + n * count * 2, num_edges, count=count, x=x, y=y, eps=0.0, TILE=TILE
    )
    distance = tl.sqrt(squared)
    # Share of the pixel that a polygon covers. The nearest edge is taken as a line parallel to a
    # side of the pixel: half the pixel is covered if the edge goes through its centre, and more if
    # the centre is inside.
    area = tl.minimum(0.5 + tl.where(inside, distance, -distance) / pixel, 1.0)
    # Overlap of two intervals across the line, in pixels: the line, `half_width` to both sides of
    # `distance`, and the pixel, -0.5 to 0.5.
    high = tl.minimum((distance + half_width) / pixel, 0.5)
    low = tl.maximum((distance - half_width) / pixel, -0.5)
    line = high - low
    share = tl.maximum(tl.where(closed != 0, area, line), 0.0)
    tl.store(masks + n * height * width + index, share + poison, mask=valid)


def _num_tiles(height, width):
    """Number of tiles of a raster."""
    return math.ceil(height / TILE) * math.ceil(width / TILE)


def soft_rasters(rings, is_polygon, height, width, softness, plain):
    """Render closed rings softly, see `soft_rasters_reference`.

    Args:
        rings: Vertices of closed rings in pixels, float32. (n, V, 2)
        is_polygon: Whether a ring is a polygon, bool. (n,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        plain: Whether D is the distance to the nearest edge instead of its square.

    Returns:
        Masks in [0, 1], float32. (n, H, W)
    """
    masks = torch.empty(len(rings), height, width, dtype=torch.float32, device=rings.device)
    if not masks.numel():
        return masks
    line_softness, polygon_softness = softness
    with torch.cuda.device_of(rings):
        soft_forward_kernel[_num_tiles(height, width), len(rings)](
            rings.contiguous(),
            is_polygon.contiguous().view(torch.uint8),
            masks=masks,
            count=rings.shape[1],
            height=height,
            width=width,
            line_softness=line_softness,
            polygon_softness=polygon_softness,
            min_distance=DISTANCE_EPS,
            PLAIN=plain,
            TILE=TILE,
            **OPTIONS,
        )
    return masks


def soft_rasters_backward(grads, rings, is_polygon, height, width, softness, plain):
    """Compute the gradient of `soft_rasters`.

    Args:
        grads: Gradient of the masks, float32. (n, H, W)
        rings: Vertices of closed rings in pixels, float32. (n, V, 2)
        is_polygon: Whether a ring is a polygon, bool. (n,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        plain: Whether D is the distance to the nearest edge instead of its square.

    Returns:
        Tuple with one entry, the gradient of the rings, float32; NaN for a ring with a vertex that
        is not finite. (n, V, 2)
    """
    if not grads.numel():
        return (torch.zeros_like(rings, memory_format=torch.contiguous_format),)
    num_tiles = _num_tiles(height, width)
    rings = rings.contiguous()
    instances, count, _ = rings.shape
    sums = torch.zeros(instances, num_tiles, count, 4, dtype=torch.float32, device=rings.device)
    line_softness, polygon_softness = softness
    with torch.cuda.device_of(rings):
        soft_backward_kernel[num_tiles, instances](
            rings,
            is_polygon.contiguous().view(torch.uint8),
            grads=grads.contiguous(),
            sums=sums,
            count=count,
            height=height,
            width=width,
            line_softness=line_softness,
            polygon_softness=polygon_softness,
            min_distance=DISTANCE_EPS,
            PLAIN=plain,
            TILE=TILE,
            **OPTIONS,
        )
    starts, ends = sums.sum(1).split(2, -1)  # gradients of both ends of each edge. (n, V, 2) each
    poison = (rings - rings).sum((1, 2), keepdim=True)  # NaN if a vertex is not finite
    # Edge i goes from vertex i to vertex i + 1, whose index is 0 for the last edge.
    return (starts + ends.roll(1, 1) + poison,)


def draw_polylines(polylines, filled, height, width, frame, half_width, pixel):
    """Draw polylines and filled polygons, see `draw_reference`.

    Args:
        polylines: Vertices in metres, float32. (K, P, 2)
        filled: Whether a polyline is filled as a polygon, bool. (K,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        frame: Four numbers: smallest x and y of the raster, and the size of a pixel along x and y,
            in metres.
        half_width: Half the width of a line in metres.
        pixel: Side in metres of a square with the area of a pixel.

    Returns:
        Masks in [0, 1], float32. (K, H, W)
    """
    masks = torch.empty(len(polylines), height, width, dtype=torch.float32, device=polylines.device)
    if not masks.numel():
        return masks
    x_min, y_min, step_x, step_y = frame
    with torch.cuda.device_of(polylines):
        draw_kernel[_num_tiles(height, width), len(polylines)](
            polylines.contiguous(),
            filled.contiguous().view(torch.uint8),
            masks=masks,
            count=polylines.shape[1],
            height=height,
            width=width,
            x_min=x_min,
            y_min=y_min,
            step_x=step_x,
            step_y=step_y,
            half_width=half_width,
            pixel=pixel,
            TILE=TILE,
            **OPTIONS,
        )
    return masks
