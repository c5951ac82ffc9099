"""Plain torch rasters of polylines and polygons: the definition of right, in any float type."""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

BLOCK_VALUES = 1 << 22  # how many distances are held at a time
GPU_BLOCK_VALUES = 1 << 25  # fewer would cost more launches than arithmetic
DISTANCE_EPS = 1e-6  # pixels that are nearer to an edge count as this near
LENGTH_EPS = 1e-5  # added to an edge's squared length, as in MapVR: an edge may be a single point


def _edge_distances(pixels: Tensor, starts: Tensor, ends: Tensor, eps: float = 0.0) -> Tensor:
    """Return squared distances to the nearest edge. (H, W, 2), 2 x (K, E, 2) -> (K, H, W)

    It is found without gradient, a block of edges at a time, so that memory does not grow with E;
    distances are differentiable in its ends. ``eps`` is added to an edge's squared length.
    """
    shape = (len(starts), *pixels.shape[:2])
    with torch.no_grad():
        nearest = pixels.new_full(shape, torch.inf)
        owner = torch.zeros(shape, dtype=torch.long, device=pixels.device)
        for first, start, end in _edge_blocks(shape, starts, ends):
            squared, index = _segment_distance(pixels, start, end, eps).min(1)
            closer = squared < nearest
            nearest = torch.where(closer, squared, nearest)
            owner = torch.where(closer, index + first, owner)
        owner = owner.flatten(1)[..., None].expand(-1, -1, 2)  # (K, HW, 2)
    start, end = (e.gather(1, owner).reshape(*shape, 2) for e in (starts, ends))
    return _segment_distance(pixels, start, end, eps)


def _edge_blocks(
    shape: tuple[int, ...], starts: Tensor, ends: Tensor
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Cut edges (K, E, 2) into blocks (K, b, 1, 1, 2), each with its first edge's index."""
    values = BLOCK_VALUES if starts.device.type == "cpu" else GPU_BLOCK_VALUES
    size = max(1, values // max(1, math.prod(shape)))
    for i in range(0, starts.shape[1], size):
        yield i, starts[:, i : i + size, None, None], ends[:, i : i + size, None, None]


def _segment_distance(pixels: Tensor, start: Tensor, end: Tensor, eps: float) -> Tensor:
    """Squared distance of points to segments. (..., 2) each -> (...)"""
    edge, offsets = end - start, pixels - start
    length2 = (edge.square().sum(-1) + eps).clamp(min=1e-38)
    along = ((offsets * edge).sum(-1) / length2).clamp(0, 1)
    return (offsets - along[..., None] * edge).square().sum(-1)


def _inside_polygon(pixels: Tensor, vertices: Tensor) -> Tensor:
    """Tell which pixels lie inside by the even-odd rule. (H, W, 2), (K, V, 2) -> (K, H, W)"""
    shape = (len(vertices), *pixels.shape[:2])
    crossings = torch.zeros(shape, dtype=torch.long, device=vertices.device)
    x, y = pixels.unbind(-1)
    for _, start, end in _edge_blocks(shape, vertices, vertices.roll(-1, 1)):
        (x0, y0), (x1, y1) = start.unbind(-1), end.unbind(-1)
        straddles = (y0 > y) != (y1 > y)
        rise = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)
        crossings += (straddles & (x < (x1 - x0) * (y - y0) / rise + x0)).sum(1)
    return crossings % 2 == 1


def soft_rasters_reference(
    rings: Tensor,
    is_polygon: Tensor,
    height: int,
    width: int,
    softness: Sequence[float],
    plain: bool = False,
) -> Tensor:
    r"""Render closed rings: :math:`\exp(-D / s)`, or :math:`\sigma(\pm D / s)` for polygons.

    Args:
        rings: Vertices in pixels; pixels are at integer positions. (n, V, 2)
        is_polygon: Whether a ring is an area. (n,)
        height: Rows H of the raster.
        width: Columns W of the raster.
        softness: s of lines and of polygons. (2,)
        plain: Whether D is the distance to the nearest edge, and not its square.

    Returns:
        Values in [0, 1]. (n, H, W)
    """
    x = torch.arange(width, device=rings.device, dtype=rings.dtype)
    y = torch.arange(height, device=rings.device, dtype=rings.dtype)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    distances = _edge_distances(pixels, rings, rings.roll(-1, 1), LENGTH_EPS)
    if plain:  # no gradient at an edge, where the distance has a kink
        distances = distances.clamp(min=DISTANCE_EPS**2).sqrt()
    signed = torch.where(_inside_polygon(pixels, rings.detach()), distances, -distances)
    lines, polygons = torch.exp(-distances / softness[0]), torch.sigmoid(signed / softness[1])
    return torch.where(is_polygon[:, None, None], polygons, lines)


def draw_reference(
    polylines: Tensor, filled: Tensor, pixels: Tensor, half_width: float, pixel: float
) -> Tensor:
    """Draw polylines and filled polygons, all in one unit of length. (K, H, W)

    Args:
        polylines: Vertices. (K, P, 2)
        filled: Whether a polyline is an area. (K,)
        pixels: Centres of the pixels. (H, W, 2)
        half_width: Half the width of a line.
        pixel: Side of the square that is as large as a pixel.
    """
    to_line = _edge_distances(pixels, polylines[:, :-1], polylines[:, 1:]).sqrt()
    to_closing = _edge_distances(pixels, polylines[:, -1:], polylines[:, :1]).sqrt()
    inside = _inside_polygon(pixels, polylines)
    near, far = (to_line + half_width) / pixel, (to_line - half_width) / pixel
    lines = (near.clamp(max=0.5) - far.clamp(min=-0.5)).clamp(min=0)
    to_edge = torch.minimum(to_line, to_closing) / pixel
    areas = (0.5 + torch.where(inside, to_edge, -to_edge)).clamp(0, 1)
    return torch.where(filled[:, None, None], areas, lines)
