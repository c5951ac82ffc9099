"""BEV features and masks as PivotNet sees them: rows from the front, columns from the left."""

import torch
from torch import Tensor

from gsmap.structures.grid import BEVGrid


def front_size(grid: BEVGrid) -> tuple[int, int]:
    """Return the numbers of a raster's pixels along the direction of travel and across it."""
    return (grid.height, grid.width) if grid.forward == "y" else (grid.width, grid.height)


def turned(feats: Tensor, grid: BEVGrid) -> Tensor:
    """Turn a raster with row 0 at the smallest y to the front, or back again. (..., H, W)"""
    return feats.flip(-2) if grid.forward == "y" else feats.transpose(-1, -2).flip(-2, -1)


def centres(shape: tuple[int, int], device: torch.device) -> Tensor:
    """Return the centres (x, y) of a map's cells, [0, 1] over it, row-major. (rows * columns, 2)"""
    rows, cols = ((torch.arange(n, device=device) + 0.5) / n for n in shape)
    return torch.stack(torch.meshgrid(rows, cols, indexing="ij")[::-1], -1).flatten(0, 1)
