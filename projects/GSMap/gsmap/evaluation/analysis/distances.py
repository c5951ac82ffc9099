"""AP at distances from the vehicle: of the map cut along circles around it."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import shapely

from gsmap.evaluation.analysis.calibration import DISTANCES_M
from gsmap.evaluation.analysis.groups import Groups
from gsmap.evaluation.core.metric import Sample
from gsmap.structures.elements import FloatArray, IntArray, MapElements
from gsmap.structures.polylines import is_closed

SHORTEST_M = 1.0  # shorter pieces of lines, and areas of fewer square metres, are left out
_SEPARATOR = " at "
_BANDS = [
    f"{low:g}-{high:g} m" if np.isfinite(high) else f"beyond {low:g} m"
    for low, high in pairwise(DISTANCES_M)
]


def cut_by_distance(samples: Iterable[Sample], areas: Sequence[int]) -> Iterator[Sample]:
    """Cut the map of each sample along circles around the vehicle.

    Args:
        samples: Token, predictions and ground truth of each, in metres around the vehicle.
        areas: Labels of the classes that are areas; the others are lines.

    Yields:
        For each sample one with the pieces in each band. A piece has the label and the score of
        its element.
    """
    for token, predictions, truth in samples:
        sides = (_in_bands(elements, areas) for elements in (predictions, truth))
        for name, *pieces in zip(_BANDS, *sides, strict=True):
            yield Sample(f"{token}{_SEPARATOR}{name}", *pieces)


def distance_groups(tokens: Iterable[str]) -> Groups:
    """Return the band of each sample that `cut_by_distance` made."""
    return Groups({token: token.rsplit(_SEPARATOR, 1)[1] for token in tokens})


def _in_bands(elements: MapElements, areas: Sequence[int]) -> list[MapElements]:
    """Return the pieces of all elements in each band."""
    pieces: list[list[FloatArray]] = [[] for _ in _BANDS]
    owners: list[list[int]] = [[] for _ in pieces]
    for row, (points, label, _) in enumerate(elements.with_coordinates(2).rows):
        cut = cut_area if label in areas else cut_line
        for band, piece in cut(points):
            pieces[band].append(piece)
            owners[band].append(row)
    scores = elements.scores
    return [
        MapElements.from_polylines(
            own, elements.labels[rows], None if scores is None else scores[rows]
        )
        for own, rows in zip(pieces, map(_rows, owners), strict=True)
    ]


def _rows(numbers: list[int]) -> IntArray:
    return np.array(numbers, dtype=np.int64)


def cut_line(points: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Cut a line where it crosses the circles.

    Args:
        points: Vertices in metres around the vehicle. (n, 2)

    Yields:
        Band and vertices (m, 2) of each piece that is at least ``SHORTEST_M`` long. A ring that
        is cut is not cut at its start, too.
    """
    if len(points) < 2:
        return
    places = _crossings(points)
    vertices, middles = (_at(points, at) for at in (places, (places[1:] + places[:-1]) / 2))
    bands = np.searchsorted(DISTANCES_M[1:-1], np.hypot(*middles.T), side="right")
    ends = [0, *(np.flatnonzero(np.diff(bands)) + 1).tolist(), len(bands)]
    runs = [(int(bands[a]), vertices[a : b + 1]) for a, b in pairwise(ends)]
    if len(runs) > 1 and runs[0][0] == runs[-1][0] and is_closed(points):
        band, last = runs.pop()
        runs[0] = band, np.concatenate([last, runs[0][1][1:]])
    for band, piece in runs:
        if np.hypot(*np.diff(piece, axis=0).T).sum() >= SHORTEST_M:
            yield band, piece


def _crossings(points: FloatArray) -> FloatArray:
    """Return where the vertices and the circles are along a line, in segments, sorted."""
    start, step = points[:-1], np.diff(points, axis=0)
    radii = np.array(DISTANCES_M[1:-1])[:, None]
    a, b = (step**2).sum(1), (start * step).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a line that misses a circle: NaN
        root = np.sqrt(b**2 - a * ((start**2).sum(1) - radii**2))
        shares = np.stack([-b - root, -b + root]) / a  # (2, radii, n - 1)
    inside = (shares > 0) & (shares < 1)
    places = (shares + np.arange(len(step)))[inside]
    return np.unique(np.concatenate([np.arange(float(len(points))), places]))


def _at(points: FloatArray, places: FloatArray) -> FloatArray:
    """Return the points at places along a line, in segments. (k, 2)"""
    numbers = np.arange(len(points))
    return np.stack([np.interp(places, numbers, values) for values in points.T], axis=1)


def cut_area(points: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Cut an area along the circles.

    Args:
        points: Its outline in metres around the vehicle. (n, 2)

    Yields:
        Band and closed outline (m, 2) of each piece of at least ``SHORTEST_M`` squared.
    """
    if len(np.unique(points, axis=0)) < 3:
        return
    # an outline that crosses itself becomes several areas, and lines
    valid = shapely.get_parts(shapely.get_parts(shapely.make_valid(shapely.Polygon(points))))
    for area in valid[shapely.area(valid) > 0]:
        for band, ring in enumerate(_RINGS):
            for piece in shapely.get_parts(area & ring):
                if piece.area >= SHORTEST_M**2:
                    yield band, shapely.get_coordinates(piece.exterior)


def _rings() -> list[shapely.Geometry]:
    """Return each band as an area; the last ends far beyond any map."""
    far = 1e6
    discs = [shapely.Point(0, 0).buffer(min(d, far), quad_segs=64) for d in DISTANCES_M[1:]]
    return [outer.difference(inner) for inner, outer in pairwise([shapely.Point(0, 0), *discs])]


_RINGS = _rings()
