"""Rasters of predicted elements, as they are written to a map prior."""

from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from gsmap.ops.polyline_raster import soft_rasters
from gsmap.structures.grid import BEVGrid


def draw_elements(
    points_m: Tensor,
    labels: Tensor,
    grid: BEVGrid,
    classes: Sequence[str],
    areas: Collection[str],
    softness: float = 2.0,
    released_pixels: bool = False,
) -> Tensor:
    """Draw elements with soft edges, in one channel per class.

    D is the squared distance of a pixel from the nearest edge of an element, in squared pixels. For
    a line, the value of the pixel is exp(-D / softness). Areas are filled: the value is the sigmoid
    of D / softness inside of an area, and of -D / softness outside. Where elements of a class
    overlap, the largest value is used.

    Args:
        points_m: Points of the elements in metres. (n, P, 2)
        labels: Class indices. (n,)
        grid: Extent and cells of the raster, H rows and W columns.
        classes: Names of the classes.
        areas: Names of the classes whose elements are filled.
        softness: Divisor of the squared distances, in squared pixels, > 0.
        released_pixels: Sample each pixel at its lower corner, as the released code of HRMapNet
            does, and not at its centre.

    Returns:
        Values in [0, 1]. (classes, H, W)
    """
    raster = points_m.new_zeros((len(classes), grid.height, grid.width))
    vertices = grid.px_from_metres(points_m)  # (0, 0) is the lower corner of the first pixel
    if not released_pixels:
        # `soft_rasters` samples pixel (row, col) at (col, row), its lower corner. The shift by half
        # a pixel makes it sample the centre.
        vertices = vertices - 0.5
    for label, name in enumerate(classes):
        lines = vertices[labels == label]
        if not len(lines):
            continue
        is_area = torch.full((len(lines),), name in areas, device=lines.device)
        masks = soft_rasters(
            lines,
            height=grid.height,
            width=grid.width,
            is_polygon=is_area,
            line_softness=softness,
            polygon_softness=softness,
        )
        raster[label] = masks.amax(0)
    return raster
