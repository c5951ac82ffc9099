"""True maps of drives, merged from the ground truth of their samples."""

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drivemaps.drive import MIN_AREA_M2, MIN_LENGTH_M, Drive, drive_map
from drivemaps.stitching import stitch
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, IntArray, MapElements

# Vertices are rounded to this grid, so that a point of the map has equal coordinates in all samples
# that contain it. The rounding errors of the poses are far smaller than the grid.
GRID_M = 0.002
_OVERLAP_M = 0.2  # pieces that share more length than this belong to one line


def true_map(drive: Drive) -> MapElements:
    """Merge the ground truth of the samples of a drive to one map.

    The ground truth of each sample is a cut-out of one map. Pieces that run along each other are
    united to one line, and overlapping areas to one area.

    Args:
        drive: Frames with their ground truth.

    Returns:
        Elements in the global frame, without scores.
    """
    rows = []  # label, vertices and score of each element
    for label, name in enumerate(drive.classes):
        pieces = []
        for frame in drive.frames:
            # The elements of all frames are in the global frame, so they can be united directly.
            elements = frame.elements.select(frame.elements.labels == label)
            for line in elements.polylines:
                if len(line) > 1:
                    pieces.append(line)
        unite = _unite_areas if name in AREA_CLASSES else _unite_lines
        for line in unite(pieces):
            rows.append((label, line, 1.0))  # `drive_map` takes rows with a score
    # `drive_map` simplifies and sorts the elements. With `scored=False`, it drops the scores.
    return drive_map(rows, scored=False)


def components(count: int, first: IntArray, second: IntArray) -> list[IntArray]:
    """Group members that are connected by pairs, directly or through other members.

    Args:
        count: Number of members.
        first: Index of one member of each pair. (pairs,)
        second: Index of the other member of each pair. (pairs,)

    Returns:
        Indices of the members of each group. A member without a pair is a group alone. The groups
        are ordered by their first members. each (n,)
    """
    links = (np.ones(len(first)), (first, second))  # values, rows and columns of the graph
    graph = coo_array(links, shape=(count, count))
    num_groups, group_of = connected_components(graph, directed=False)
    return [np.flatnonzero(group_of == group) for group in range(num_groups)]


def polygons_of(rings: Sequence[FloatArray]) -> list[shapely.Geometry]:
    """Convert rings to the areas that they enclose, without areas below ``MIN_AREA_M2``.

    Args:
        rings: Vertices of the rings in metres. each (n, 2)

    Returns:
        Valid multipolygons.
    """
    areas = []
    for ring in rings:
        if len(ring) < 3:
            continue
        # A ring that runs back along itself becomes a collection of polygons, multipolygons and
        # lines. The second `get_parts` splits the multipolygons. The lines are left out.
        parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(shapely.Polygon(ring))))
        polygons = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
        area = shapely.multipolygons(polygons)
        if area.area >= MIN_AREA_M2:
            areas.append(area)
    return areas


def _unite_areas(rings: Sequence[FloatArray]) -> list[FloatArray]:
    """Outer rings of the union of areas. each (n, 2)"""
    union = shapely.union_all(polygons_of(rings), grid_size=GRID_M)
    outer_rings = []
    for part in shapely.get_parts(union):
        if part.area >= MIN_AREA_M2:
            outer_rings.append(shapely.get_coordinates(part.exterior))
    return outer_rings


def _unite_lines(pieces: Sequence[FloatArray]) -> list[FloatArray]:
    """Unite the pieces that run along each other, and return the lines. each (n, 2)"""
    lines = np.array([shapely.LineString(piece) for piece in pieces], dtype=object)  # (N,)
    # The length of a line inside of the strip around another line is their shared length. Copies of
    # a line differ by much less than the grid, so twice the grid to each side is a safe width. Flat
    # ends keep the strip from reaching beyond its line.
    strips = shapely.buffer(lines, 2 * GRID_M, cap_style="flat")
    # Indices of lines, and of the strips that they intersect. A line is also paired with its strip,
    # which does no harm.
    first, second = shapely.STRtree(strips).query(lines, predicate="intersects")
    shared_m = shapely.length(shapely.intersection(lines[first], strips[second]))
    overlap = shared_m > _OVERLAP_M
    united = []
    for group in components(len(lines), first[overlap], second[overlap]):
        union = shapely.union_all(lines[group], grid_size=GRID_M)
        united.append(shapely.line_merge(union))
    parts = shapely.get_parts(np.array(united, dtype=object))
    # `line_merge` has joined lines at points where exactly two of them end. `stitch` also joins
    # lines of different groups, across gaps of up to 2 m, and straight on at forks.
    stitched = stitch([shapely.get_coordinates(part) for part in parts])
    # Short lines are dropped only now, as a part between two forks may be short before stitching.
    long_lines = []
    for line in stitched:
        if shapely.LineString(line).length >= MIN_LENGTH_M:
            long_lines.append(line)
    return long_lines
