"""Rasters of polylines and polygons: MapVR's soft ones, and the masks of ground truth."""

import torch
from torch import Tensor

from ..geometry.bev_grid import BEVGrid

LANE_GAP_PX = (
    0.01  # how far MapVR moves a line's way back, so that line and way back form a polygon
)
LENGTH_EPS = 1e-5  # added to an edge's squared length, as in MapVR: an edge may be a single point


def edge_distances(pixels: Tensor, starts: Tensor, ends: Tensor, eps: float = 0.0) -> Tensor:
    """Squared distance of every pixel to the nearest edge.

    Args:
        pixels: Sample positions. (H, W, 2)
        starts: First end of each edge, in the unit of ``pixels``. (K, E, 2)
        ends: Second end of each edge. (K, E, 2)
        eps: Added to an edge's squared length in the projection.

    Returns:
        Squared distances. (K, H, W)
    """
    nearest = pixels.new_full((len(starts), *pixels.shape[:2]), torch.inf)
    for start, end in zip(starts.unbind(1), ends.unbind(1), strict=True):
        start, edge = start[:, None, None], (end - start)[:, None, None]  # (K, 1, 1, 2)
        offsets = pixels - start  # (K, H, W, 2)
        length2 = (edge.square().sum(-1) + eps).clamp(min=torch.finfo(edge.dtype).tiny)
        along = ((offsets * edge).sum(-1) / length2).clamp(0, 1)
        nearest = torch.minimum(nearest, (offsets - along[..., None] * edge).square().sum(-1))
    return nearest


def inside_polygon(pixels: Tensor, vertices: Tensor) -> Tensor:
    """Tell which pixels lie inside each polygon by the even-odd rule.

    Args:
        pixels: Sample positions. (H, W, 2)
        vertices: Corners, implicitly closed. (K, V, 2)

    Returns:
        True inside. (K, H, W)
    """
    inside = torch.zeros(len(vertices), *pixels.shape[:2], dtype=torch.bool, device=vertices.device)
    x, y = pixels.unbind(-1)
    for start, end in zip(vertices.unbind(1), vertices.roll(-1, 1).unbind(1), strict=True):
        (x0, y0), (x1, y1) = start[:, None, None].unbind(-1), end[:, None, None].unbind(-1)
        straddles = (y0 > y) != (y1 > y)
        rise = torch.where(y1 == y0, torch.ones_like(y0), y1 - y0)
        inside ^= straddles & (x < (x1 - x0) * (y - y0) / rise + x0)
    return inside


def draw_polylines(
    polylines: Tensor,
    grid: BEVGrid,
    width_m: float = 0.6,
    filled: Tensor | None = None,
    antialias: bool = True,
) -> Tensor:
    """Draw the masks of ground-truth polylines, all at once and on their own device.

    Args:
        polylines: Vertices in metres, in the frame of ``grid``. (K, P, 2)
        grid: The raster.
        width_m: Width of a line in metres. The default is close to what AP_raster draws (5 pixels
            of 0.125 m).
        filled: Which polylines are filled as polygons (to their vertices, without the line's
            width); all are drawn as lines without it. (K,)
        antialias: Give a pixel the share that the shape covers of it, taken across the nearest
            edge; otherwise 1 if its centre is covered and 0 if not.

    Returns:
        Masks in [0, 1], without gradient, at least float32. (K, H, W)

    Raises:
        ValueError: If a shape is wrong or ``width_m`` is not positive.
    """
    if polylines.ndim != 3 or polylines.shape[-1] != 2 or polylines.shape[1] < 2:
        raise ValueError(
            f"polylines must have shape (K, P, 2) with P >= 2, got {tuple(polylines.shape)}."
        )
    if filled is not None and filled.shape != polylines.shape[:1]:
        raise ValueError(
            f"filled must have shape {(len(polylines),)}, one flag per polyline, "
            f"got {tuple(filled.shape)}."
        )
    if not width_m > 0:
        raise ValueError(f"width_m must be > 0, got {width_m}.")
    dtype = torch.promote_types(polylines.dtype, torch.float32)
    polylines = polylines.detach().to(dtype)
    with torch.autocast(polylines.device.type, enabled=False):
        pixels = grid.pixel_centres(polylines.device, dtype)
        distance_m = edge_distances(pixels, polylines[:, :-1], polylines[:, 1:]).sqrt()
        masks = _line_coverage(distance_m, width_m, grid, antialias)
        if filled is None:
            return masks
        closing = edge_distances(pixels, polylines[:, -1:], polylines[:, :1]).sqrt()
        distance_m = torch.minimum(distance_m, closing)
        inside = inside_polygon(pixels, polylines)
        areas = _area_coverage(distance_m, inside, grid, antialias)
        return torch.where(filled[:, None, None], areas, masks)


def _pixel_m(grid: BEVGrid) -> float:
    """Side of the square that is as large as a pixel, in metres."""
    dx, dy = grid.pixel_size_m
    return (dx * dy) ** 0.5


def _line_coverage(distance_m: Tensor, width_m: float, grid: BEVGrid, antialias: bool) -> Tensor:
    """Share of a pixel that a line of a width covers at a distance from its centre."""
    if not antialias:
        return (distance_m <= width_m / 2).to(distance_m.dtype)
    distance, half = distance_m / _pixel_m(grid), width_m / 2 / _pixel_m(grid)
    return ((distance + half).clamp(max=0.5) - (distance - half).clamp(min=-0.5)).clamp(min=0)


def _area_coverage(distance_m: Tensor, inside: Tensor, grid: BEVGrid, antialias: bool) -> Tensor:
    """Share of a pixel that a polygon covers at a distance of its edge from the pixel's centre."""
    if not antialias:
        return inside.to(distance_m.dtype)
    distance = distance_m / _pixel_m(grid)
    return (0.5 + torch.where(inside, distance, -distance)).clamp(0, 1)


def _integer_pixels(height: int, width: int, like: Tensor) -> Tensor:
    """Positions (column, row) at which MapVR samples: no half-pixel offset. (H, W, 2)"""
    x = torch.arange(width, device=like.device, dtype=like.dtype)
    y = torch.arange(height, device=like.device, dtype=like.dtype)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def soft_line_rasters(vertices: Tensor, height: int, width: int, softness: float = 2.0) -> Tensor:
    r"""Render polylines softly: :math:`\exp(-d^2 / \tau)` (MapVR Eq. 2).

    Differs from MapVR Eq. (2): d is squared, as in MapVR's released rasterizer. The line is
    rendered as the thin closed polygon of itself and its way back.

    Args:
        vertices: In pixels (x = column, y = row); pixel (row, col) is sampled at (col, row).
            (..., V, 2)
        height: Rows H.
        width: Columns W.
        softness: :math:`\tau` in square pixels.

    Returns:
        Masks in [0, 1], differentiable in ``vertices``. (..., H, W)

    Raises:
        ValueError: If the shape is wrong or ``softness`` is not positive.
    """
    _check_vertices(vertices, softness)
    ring = torch.cat([vertices, vertices.flip(-2) + LANE_GAP_PX], -2)
    return torch.exp(-_ring_distances(ring, height, width) / softness)


def soft_polygon_rasters(
    vertices: Tensor, height: int, width: int, softness: float = 4.0
) -> Tensor:
    r"""Render filled polygons softly: :math:`\sigma(\pm d^2 / \tau)`, + inside (MapVR Eq. 3).

    Differs from MapVR Eq. (3): d is squared, as in MapVR's released rasterizer.

    Args:
        vertices: Corners in pixels, implicitly closed; sampled as in
            :func:`soft_line_rasters`. (..., V, 2)
        height: Rows H.
        width: Columns W.
        softness: :math:`\tau` in square pixels.

    Returns:
        Masks in [0, 1], differentiable in ``vertices``. (..., H, W)

    Raises:
        ValueError: If the shape is wrong or ``softness`` is not positive.
    """
    _check_vertices(vertices, softness)
    distances = _ring_distances(vertices, height, width)
    flat = vertices.detach().to(distances.dtype).reshape(-1, *vertices.shape[-2:])
    inside = inside_polygon(_integer_pixels(height, width, distances), flat)
    signed = torch.where(inside.reshape(distances.shape), distances, -distances)
    return torch.sigmoid(signed / softness)


def _ring_distances(ring: Tensor, height: int, width: int) -> Tensor:
    """Squared pixel distances to the closed ring's nearest edge. (..., V, 2) -> (..., H, W)"""
    with torch.autocast(ring.device.type, enabled=False):
        dtype = torch.promote_types(ring.dtype, torch.float32)
        flat = ring.to(dtype).reshape(-1, *ring.shape[-2:])
        pixels = _integer_pixels(height, width, flat)
        distances = edge_distances(pixels, flat, flat.roll(-1, 1), LENGTH_EPS)
        return distances.reshape(*ring.shape[:-2], height, width)


def _check_vertices(vertices: Tensor, softness: float) -> None:
    """Raise for a wrong shape or softness."""
    if vertices.ndim < 2 or vertices.shape[-1] != 2 or not vertices.shape[-2]:
        raise ValueError(
            f"vertices must have shape (..., V, 2) with V >= 1, got {tuple(vertices.shape)}."
        )
    if not softness > 0:
        raise ValueError(f"softness must be > 0, got {softness}.")
