"""Rasters of polylines and polygons in plain torch, in any floating-point type."""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

BLOCK_VALUES = 1 << 22  # number of distances of pixels from edges in memory at a time
GPU_BLOCK_VALUES = 1 << 25  # on a GPU; with fewer, launches take longer than the arithmetic
DISTANCE_EPS = 1e-6  # smallest distance of a pixel from an edge, in pixels
# Added to the squared length of an edge, which may be a point, as in Zhang et al.'s released code.
LENGTH_EPS = 1e-5


def _edge_distances(pixels: Tensor, starts: Tensor, ends: Tensor, eps: float = 0.0) -> Tensor:
    """Squared distances to the nearest edge. (H, W, 2), (K, E, 2), (K, E, 2) -> (K, H, W)

    The search for the nearest edge has no gradient and takes a block of edges at a time, so memory
    does not grow with E. The distance to the edge found is then computed again, and is
    differentiable in the ends of this edge. ``eps`` is added to the squared length of an edge.
    """
    shape = (len(starts), *pixels.shape[:2])
    with torch.no_grad():
        nearest = pixels.new_full(shape, torch.inf)
        edge_index = torch.zeros(shape, dtype=torch.long, device=pixels.device)
        for first, start, end in _edge_blocks(shape, starts, ends=ends):
            squared, index = _segment_distance(pixels, start, end=end, eps=eps).min(1)
            closer = squared < nearest
            nearest = torch.where(closer, squared, nearest)
            edge_index = torch.where(closer, index + first, edge_index)
        point_index = edge_index.flatten(1)[..., None].expand(-1, -1, 2)  # (K, HW, 2)
    start = starts.gather(1, point_index).reshape((*shape, 2))
    end = ends.gather(1, point_index).reshape((*shape, 2))
    return _segment_distance(pixels, start, end=end, eps=eps)


def _edge_blocks(
    shape: tuple[int, ...], starts: Tensor, ends: Tensor
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Cut edges (K, E, 2) into blocks (K, b, 1, 1, 2), each with the index of its first edge."""
    values = BLOCK_VALUES if starts.device.type == "cpu" else GPU_BLOCK_VALUES
    size = max(1, values // max(1, math.prod(shape)))
    for first in range(0, starts.shape[1], size):
        block = slice(first, first + size)
        yield first, starts[:, block, None, None], ends[:, block, None, None]


def _segment_distance(pixels: Tensor, start: Tensor, end: Tensor, eps: float) -> Tensor:
    """Squared distances of points from segments. (..., 2) each -> (...)"""
    edge = end - start
    offsets = pixels - start
    # The clamp avoids a division by 0 for a segment that is a point. 1e-38 is about the smallest
    # normal number of float32.
    length2 = (edge.square().sum(-1) + eps).clamp(min=1e-38)
    along = ((offsets * edge).sum(-1) / length2).clamp(0, 1)
    return (offsets - along[..., None] * edge).square().sum(-1)


def _inside_polygon(pixels: Tensor, vertices: Tensor) -> Tensor:
    """Mask of the pixels inside of polygons. (H, W, 2), (K, V, 2) -> (K, H, W)"""
    shape = (len(vertices), *pixels.shape[:2])
    crossings = torch.zeros(shape, dtype=torch.long, device=vertices.device)
    x, y = pixels.unbind(-1)
    # Even-odd rule: count the edges that the ray from a pixel towards larger x crosses. A pixel is
    # inside if their number is odd.
    for _, start, end in _edge_blocks(shape, vertices, ends=vertices.roll(-1, 1)):
        x0, y0 = start.unbind(-1)
        x1, y1 = end.unbind(-1)
        straddles = (y0 > y) != (y1 > y)  # one end is above the row of the pixel, the other is not
        rise = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)  # no division by 0
        crossing_x = (x1 - x0) * (y - y0) / rise + x0
        crossings += (straddles & (x < crossing_x)).sum(1)
    return crossings % 2 == 1


def soft_rasters_reference(
    rings: Tensor,
    is_polygon: Tensor,
    height: int,
    width: int,
    softness: Sequence[float],
    plain: bool = False,
) -> Tensor:
    r"""Render closed rings: lines as :math:`\exp(-D / s)`, polygons as :math:`\sigma(\pm D / s)`.

    D is the squared distance of a pixel to the nearest edge, and s is the softness. The sign is +
    inside of the polygon. Both kinds of rings have an edge from the last vertex to the first.

    Args:
        rings: Vertices in pixels; pixel (row, col) is sampled at (col, row). (n, V, 2)
        is_polygon: Whether a ring is a polygon, bool. (n,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        softness: Softness s of lines and of polygons, in the unit of D. (2,)
        plain: Whether D is the distance itself instead of its square.

    Returns:
        Values in [0, 1]. (n, H, W)
    """
    x = torch.arange(width, device=rings.device, dtype=rings.dtype)
    y = torch.arange(height, device=rings.device, dtype=rings.dtype)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    distances = _edge_distances(pixels, rings, ends=rings.roll(-1, 1), eps=LENGTH_EPS)
    if plain:  # the clamp has no gradient on an edge, where the distance has a kink
        distances = distances.clamp(min=DISTANCE_EPS**2).sqrt()
    # Inside or outside has no gradient, so it is computed from detached vertices.
    signed = torch.where(_inside_polygon(pixels, rings.detach()), distances, -distances)
    lines = torch.exp(-distances / softness[0])
    polygons = torch.sigmoid(signed / softness[1])
    return torch.where(is_polygon[:, None, None], polygons, lines)


def draw_reference(
    polylines: Tensor, filled: Tensor, pixels: Tensor, half_width: float, pixel: float
) -> Tensor:
    """Draw polylines and filled polygons.

    Args:
        polylines: Vertices in metres. (K, P, 2)
        filled: Whether a polyline is filled as a polygon, bool. (K,)
        pixels: Centres of the pixels in metres. (H, W, 2)
        half_width: Half the width of a line in metres.
        pixel: Side in metres of a square with the area of a pixel.

    Returns:
        Masks in [0, 1]. (K, H, W)
    """
    # The edge from the last to the first vertex is drawn for polygons only.
    to_line = _edge_distances(pixels, polylines[:, :-1], ends=polylines[:, 1:]).sqrt()
    to_closing = _edge_distances(pixels, polylines[:, -1:], ends=polylines[:, :1]).sqrt()
    inside = _inside_polygon(pixels, polylines)
    # Overlap of two intervals across the line, in pixels: the line, `half_width` to both sides of
    # `to_line`, and the pixel, -0.5 to 0.5.
    high = (to_line + half_width) / pixel
    low = (to_line - half_width) / pixel
    lines = (high.clamp(max=0.5) - low.clamp(min=-0.5)).clamp(min=0)
    # The edge of a polygon cuts the pixel at the signed distance from its centre.
    to_edge = torch.minimum(to_line, to_closing) / pixel
    areas = (0.5 + torch.where(inside, to_edge, -to_edge)).clamp(0, 1)
    return torch.where(filled[:, None, None], areas, lines)
