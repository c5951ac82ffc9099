"""Cells of a map prior that the lines and areas of a vector map cover.

A prior is stored in tiles, squares of cells. Lines are cut into short pieces, and each piece is
drawn only on the tiles that it may touch.
"""

from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from gsmap.ops.polyline_raster import draw_polylines
from gsmap.prior.file_format import TileKey
from gsmap.prior.settings import PriorSettings
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FARTHEST_M, FloatArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed
from gsmap.utils.errors import InputError

_LEAST_CELLS = 1.01  # width of a line in cells
_MOST_PIECES = 1_000_000  # largest number of pieces of lines and areas, in all tiles together
_CHUNK = 64  # pieces of a tile that are drawn at a time, which bounds the memory
Piece = tuple[int, bool, FloatArray]
"""Class index, whether the piece is a filled area, and vertices in metres (n, 2)."""


def covered_cells(
    elements: MapElements, settings: PriorSettings, width_m: float
) -> Iterator[tuple[TileKey, NDArray[np.bool_]]]:
    """Iterate over the tiles that a map touches, each with the cells that it covers.

    Closed elements of `AREA_CLASSES` are filled. A cell counts as covered if at least half of its
    area is covered.

    Args:
        elements: Map in the global frame, in metres.
        settings: Classes, cells and tiles of the prior.
        width_m: Width of a line in metres, > 0; at least a little more than a cell is used.

    Returns:
        Column and row of each tile, and whether an element of each of the C classes covers each
        cell, (C, tile_cells, tile_cells). Tiles are in ascending order of column and row.

    Raises:
        ValueError: If a label or a vertex is out of range, or the map is too large.
    """
    num_classes = len(settings.classes)
    is_unknown = (elements.labels < 0) | (elements.labels >= num_classes)
    if is_unknown.any():
        raise InputError(f"labels of elements must be in [0, {num_classes}), the prior's classes.")
    if np.abs(elements.points[:, :2]).max(initial=0.0) > FARTHEST_M:
        raise InputError(f"vertices must be within {FARTHEST_M:g} m of the origin.")
    # A line that is narrower than a cell would cover less than half of each cell.
    width_m = max(width_m, _LEAST_CELLS * settings.cell_m)
    pieces_of_tile = _pieces_by_tile(elements, settings=settings, width_m=width_m)
    side = settings.tile_cells
    extent = (0.0, settings.tile_m)
    grid = BEVGrid(x_range=extent, y_range=extent, height=side, width=side)
    for key, pieces in sorted(pieces_of_tile.items()):
        # Vertices are drawn relative to the tile's corner, so that float32 is precise enough.
        corner = settings.tile_m * np.array(key)
        covered = np.zeros((num_classes, side, side), dtype=np.bool_)
        for first in range(0, len(pieces), _CHUNK):
            chunk = pieces[first : first + _CHUNK]
            lengths = [len(points) for _, _, points in chunk]
            # Pieces have different numbers of vertices: shorter ones repeat their last vertex.
            padded = np.zeros((len(chunk), max(lengths), 2))
            for row, (_, _, points) in zip(padded, chunk, strict=True):
                row[: len(points)] = points - corner
                row[len(points) :] = points[-1] - corner
            filled = torch.tensor([is_filled for _, is_filled, _ in chunk])
            lines = torch.from_numpy(padded).float()
            # `draw_polylines` returns the share of each cell's area that a piece covers.
            shares = draw_polylines(lines, grid, width_m=width_m, filled=filled)
            masks = shares.numpy() >= 0.5
            for mask, (label, _, _) in zip(masks, chunk, strict=True):
                covered[label] |= mask
        if covered.any():
            yield key, covered


def _pieces_by_tile(
    elements: MapElements, settings: PriorSettings, width_m: float
) -> dict[TileKey, list[Piece]]:
    """Distribute areas and short pieces of lines to the tiles that they may touch.

    Raises:
        ValueError: If there may be more than ``_MOST_PIECES`` pieces in all tiles.
    """
    pieces_of_tile: dict[TileKey, list[Piece]] = defaultdict(list)
    num_pieces = 0
    for line, label, _ in elements.rows:
        if len(line) < 2:
            continue
        points = line[:, :2]
        is_area = settings.classes[label] in AREA_CLASSES and is_closed(points)
        # Compute an upper bound of the number of pieces before any of them is created.
        if is_area:
            # Add 2, because the area may begin and end in the middle of a tile.
            tiles_along_axes = np.ptp(points, axis=0) / settings.tile_m + 2
            most_pieces = tiles_along_axes.prod()
        else:
            # The line is cut into segments of a quarter of a tile. A shorter segment may begin at
            # each vertex, so the number of vertices is added below.
            length_m = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
            most_pieces = length_m / settings.tile_m * 4
        num_pieces += int(most_pieces) + len(line)
        if num_pieces > _MOST_PIECES:
            raise InputError(
                f"the map covers more than {_MOST_PIECES} tiles: its coordinates are no metres, or "
                "it must be split."
            )
        shapes = [points]  # an area is not cut
        if not is_area:
            shapes = _short_segments(points, longest_m=settings.tile_m / 4)
        for shape in shapes:
            # First and last tile (column, row) of the bounding box, which is widened on each side
            # because a drawn line has a width.
            low = np.floor((shape.min(axis=0) - width_m) / settings.tile_m).astype(int)
            high = np.floor((shape.max(axis=0) + width_m) / settings.tile_m).astype(int)
            for column in range(low[0], high[0] + 1):
                for row in range(low[1], high[1] + 1):
                    pieces_of_tile[column, row].append((label, is_area, shape))
    return pieces_of_tile


def _short_segments(points: FloatArray, longest_m: float) -> list[FloatArray]:
    """Cut a line into segments of at most ``longest_m``. (P, 2) -> list of (2, 2)"""
    segments = []
    for start, end in pairwise(points):
        length_m = np.linalg.norm(end - start)
        count = max(1, int(np.ceil(length_m / longest_m)))
        cuts = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
        segments += [cuts[index : index + 2] for index in range(count)]
    return segments
