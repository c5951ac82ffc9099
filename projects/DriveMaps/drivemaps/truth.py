"""The true map of a drive: its samples' ground truth, which is cut from one map, put together."""

from collections.abc import Sequence
from itertools import chain

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drivemaps.drive import MIN_AREA_M2, MIN_LENGTH_M, Drive, drive_map
from drivemaps.stitching import stitch
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, IntArray, MapElements

GRID_M = 0.002  # equal points of two samples differ by the rounding of their frames, far less
_OVERLAP_M = 0.2  # pieces that share so much length are of one line


def true_map(drive: Drive) -> MapElements:
    """Put the samples' ground truth together.

    Pieces that run along each other are one line; areas that overlap are one area. The map is in
    the global frame and has no scores.
    """
    found = []
    for label, name in enumerate(drive.classes):
        pieces = chain.from_iterable(
            frame.elements.select(frame.elements.labels == label).polylines
            for frame in drive.frames
        )
        merge = _united_areas if name in AREA_CLASSES else _united_lines
        found += [(label, line, 1.0) for line in merge([p for p in pieces if len(p) > 1])]
    return drive_map(found, scored=False)


def components(count: int, first: IntArray, second: IntArray) -> list[IntArray]:
    """Return the groups that pairs connect, in the order of their first members. each (n,)

    Args:
        count: Number of members.
        first: One member of each pair. (pairs,)
        second: The other. (pairs,)
    """
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    groups, member_of = connected_components(graph, directed=False)
    return [np.flatnonzero(member_of == group) for group in range(groups)]


def polygons_of(rings: Sequence[FloatArray]) -> list[shapely.Geometry]:
    """Return the areas inside rings; what is too small is left out."""
    areas = [shapely.make_valid(shapely.Polygon(ring)) for ring in rings if len(ring) > 2]
    return [area for area in areas if area.area >= MIN_AREA_M2]


def _united_areas(rings: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the outer rings of the union."""
    parts = shapely.get_parts(shapely.union_all(polygons_of(rings), grid_size=GRID_M))
    return [shapely.get_coordinates(p.exterior) for p in parts if p.area >= MIN_AREA_M2]


def _united_lines(pieces: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the lines that the pieces cover."""
    lines = np.array([shapely.LineString(piece) for piece in pieces], dtype=object)
    strips = shapely.buffer(lines, 2 * GRID_M, cap_style="flat")
    first, second = shapely.STRtree(strips).query(lines, predicate="intersects")
    shared = shapely.length(shapely.intersection(lines[first], strips[second])) > _OVERLAP_M
    merged = [
        shapely.line_merge(shapely.union_all(lines[group], grid_size=GRID_M))
        for group in components(len(lines), first[shared], second[shared])
    ]
    parts = shapely.get_parts(np.array(merged, dtype=object))
    kept = parts[shapely.length(parts) >= MIN_LENGTH_M]
    return stitch([shapely.get_coordinates(line) for line in kept])
