"""Rasters of polylines and polygons: soft rasters, and masks of ground truth.

Soft rasters follow Zhang et al., arXiv 2306.10502.
"""

import torch
from torch import Tensor

from gsmap.ops.backends import choose_backend, fused_operator
from gsmap.ops.polyline_raster.reference import draw_reference, soft_rasters_reference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32
from gsmap.utils.errors import InputError

# A line is rendered as a thin closed polygon that runs along the line and back. The way back is
# shifted by this distance along x and along y, as in the code of Zhang et al.
LANE_GAP_PX = 0.01
DISTANCES = ("squared", "plain")
# Each operator calls the fused kernel of a backend, "cpu" or "triton". The second text has the
# arguments as a torch schema. The lambda functions return the shape of the masks.
_draw = fused_operator(
    "polyline_raster.draw_polylines",
    "Tensor polylines, Tensor filled, int height, int width, float[] frame, float half_width, "
    "float pixel",
    lambda polylines, filled, height, width, *_: (len(polylines), height, width),
)
_soft_rasters = fused_operator(
    "polyline_raster.soft_rasters",
    "Tensor rings, Tensor is_polygon, int height, int width, float[] softness, bool plain",
    lambda rings, is_polygon, height, width, *_: (len(rings), height, width),
    differentiable=1,  # the first tensor, `rings`, has gradients
)


def draw_polylines(
    polylines: Tensor,
    grid: BEVGrid,
    width_m: float = 0.6,
    filled: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Draw masks of ground-truth polylines, without gradient.

    The value of a pixel is the share of its area that the shape covers, estimated from the distance
    to the nearest edge.

    Args:
        polylines: Vertices in metres, in the frame of ``grid``. (K, P, 2)
        grid: Extent of the raster in metres and its size in pixels, H rows and W columns.
        width_m: Width of a line in metres, > 0. (The metric AP_raster draws lines that are 5 pixels
            of 0.125 m wide.)
        filled: Whether a polyline is filled as a polygon, bool; None to draw all as lines. The
            border of a polygon has no width. (K,)
        backend: Backend, see `choose_backend`.

    Returns:
        Masks in [0, 1], at least float32, on the device of ``polylines``. (K, H, W)

    Raises:
        ValueError: If a shape is wrong, ``width_m`` is not positive, or ``backend`` is unknown or
            does not support the inputs.
    """
    if polylines.ndim != 3 or polylines.shape[-1] != 2 or polylines.shape[1] < 2:
        raise InputError(
            f"polylines must have shape (K, P, 2) with P >= 2, got {tuple(polylines.shape)}."
        )
    if not width_m > 0:
        raise InputError(f"width_m must be > 0, got {width_m}.")
    flags = _flags(filled, "filled", polylines=polylines)  # all False for None
    polylines = at_least_float32(polylines.detach())
    dx, dy = grid.pixel_size_m
    half_width_m = width_m / 2
    pixel_m = (dx * dy) ** 0.5  # side of a square pixel of equal area
    # Autocast is off, since half precision is too coarse for distances.
    with torch.autocast(polylines.device.type, enabled=False):
        # "auto" becomes the name of a backend: "reference", "cpu" or "triton".
        backend = choose_backend(backend, polylines, kernel="draw_polylines")
        if backend != "reference":
            return _draw(
                polylines,
                flags,
                height=grid.height,
                width=grid.width,
                # Lower corner of the raster and size of a pixel, in metres.
                frame=[grid.x_range[0], grid.y_range[0], dx, dy],
                half_width=half_width_m,
                pixel=pixel_m,
                backend=backend,
            )
        pixels = grid.pixel_centres(polylines.device, polylines.dtype)
        return draw_reference(
            polylines, flags, pixels=pixels, half_width=half_width_m, pixel=pixel_m
        )


def soft_rasters(
    vertices: Tensor,
    height: int,
    width: int,
    is_polygon: Tensor | None = None,
    line_softness: float = 2.0,
    polygon_softness: float = 4.0,
    distance: str = "squared",
    backend: str = "auto",
) -> Tensor:
    r"""Render lines as :math:`\exp(-D / \tau)`, polygons as :math:`\sigma(\pm D / \tau)`.

    D is the distance of a pixel to the nearest edge, or the square of this distance. The sign is +
    inside of a polygon (Zhang et al., Eqs. 2-3). A line is rendered as a thin closed polygon that
    runs along the line and back. The last vertex of a polygon is joined to the first one.

    Args:
        vertices: Vertices in pixels (x = column, y = row); pixel (row, col) is sampled at
            (col, row). (n, V, 2)
        height: Rows H of the raster.
        width: Columns W of the raster.
        is_polygon: Whether an element is a filled polygon, bool; None for lines only. (n,)
        line_softness: :math:`\tau` of lines, > 0, in the unit of D.
        polygon_softness: :math:`\tau` of polygons, > 0, in the unit of D.
        distance: ``"squared"`` for D in square pixels, as in the rasterizer that Zhang et al.
            released, or ``"plain"`` for D in pixels, as in their equations.
        backend: Backend, see `choose_backend`.

    Returns:
        Masks in [0, 1], differentiable in ``vertices``. (n, H, W)

    Raises:
        ValueError: If a shape is wrong, a softness is not positive, ``distance`` is unknown, or
            ``backend`` is unknown or does not support the inputs.
    """
    if vertices.ndim != 3 or vertices.shape[-1] != 2 or not vertices.shape[1]:
        raise InputError(
            f"vertices must have shape (n, V, 2) with V >= 1, got {tuple(vertices.shape)}."
        )
    if not (line_softness > 0 and polygon_softness > 0):
        raise InputError(f"softness must be > 0, got {line_softness} and {polygon_softness}.")
    if distance not in DISTANCES:
        raise InputError(f"distance must be one of {DISTANCES}, got {distance!r}.")
    flags = _flags(is_polygon, "is_polygon", polylines=vertices)  # all False for None
    plain = distance == "plain"
    with torch.autocast(vertices.device.type, enabled=False):
        vertices = at_least_float32(vertices)
        # The second half of each ring is the way back along a line.
        # Differs from Zhang et al.'s Eqs. (2-3) by default: D is squared, as in their rasterizer.
        back = vertices.flip(1) + LANE_GAP_PX
        # Polygons are padded with their last vertex, so that all rings have 2 V vertices.
        padding = vertices[:, -1:].expand_as(vertices)
        second_half = torch.where(flags[:, None, None], padding, back)
        rings = torch.cat([vertices, second_half], dim=1)  # (n, 2 V, 2)
        softness = [line_softness, polygon_softness]
        backend = choose_backend(backend, rings, kernel="soft_rasters")
        if backend != "reference":
            return _soft_rasters(
                rings,
                flags,
                height=height,
                width=width,
                softness=softness,
                plain=plain,
                backend=backend,
            )
        return soft_rasters_reference(
            rings, flags, height=height, width=width, softness=softness, plain=plain
        )


def _flags(flags: Tensor | None, name: str, polylines: Tensor) -> Tensor:
    """Check the flags of the polylines, or create flags that are all false. (n,)"""
    if flags is None:
        return torch.zeros(len(polylines), dtype=torch.bool, device=polylines.device)
    if flags.shape != polylines.shape[:1] or flags.dtype != torch.bool:
        raise InputError(
            f"{name} must be bool of shape {(len(polylines),)}, one flag per polyline, "
            f"got {flags.dtype} of shape {tuple(flags.shape)}."
        )
    return flags
