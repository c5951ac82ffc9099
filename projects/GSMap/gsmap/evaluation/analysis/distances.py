"""AP by distance from the vehicle: maps are cut along circles around it."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import shapely

from gsmap.evaluation.analysis.calibration import DISTANCES_M
from gsmap.evaluation.analysis.groups import Groups
from gsmap.evaluation.core.metric import Sample
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.structures.polylines import is_closed

SHORTEST_M = 1.0  # pieces of lines below this, and pieces of areas below 1 m^2, are left out
_SEPARATOR = " at "  # between the token of a sample and the name of a band
# A band is the ground between two circles, inside the first one or beyond the last one. The limits
# of the bands are `DISTANCES_M`. The first is 0 and the last is infinity. The others are the radii
# of the circles.
_RADII_M = DISTANCES_M[1:-1]
# Names of the bands, from the nearest to the farthest. The index of a band is its index here.
_BANDS = [
    *(f"{inner_m:g}-{outer_m:g} m" for inner_m, outer_m in pairwise((0.0, *_RADII_M))),
    f"beyond {_RADII_M[-1]:g} m",
]


def cut_by_distance(samples: Iterable[Sample], areas: Sequence[int]) -> Iterator[Sample]:
    """Cut the map of each sample along circles around the vehicle.

    Args:
        samples: Samples with coordinates in metres, with the vehicle at the origin.
        areas: Labels of the classes that are areas; the others are lines.

    Yields:
        For each sample, one new sample per distance band, with the pieces of elements in the band.
        A piece has the label and the score of its element. The token of a new sample is followed by
        the name of the band, as in ``TOKEN at 0-10 m``.
    """
    for token, predictions, truth in samples:
        pred_bands = _split_by_band(predictions, areas)
        gt_bands = _split_by_band(truth, areas)
        for band, name in enumerate(_BANDS):
            yield Sample(f"{token}{_SEPARATOR}{name}", pred_bands[band], gt_bands[band])


def distance_groups(tokens: Iterable[str]) -> Groups:
    """Return the band of each sample that `cut_by_distance` has created, by token.

    Args:
        tokens: Tokens of the created samples, which contain the names of the bands.
    """
    return Groups({token: token.rsplit(_SEPARATOR, maxsplit=1)[1] for token in tokens})


def _split_by_band(elements: MapElements, areas: Sequence[int]) -> list[MapElements]:
    """Cut all elements, and return the pieces in each band."""
    pieces: list[list[FloatArray]] = [[] for _ in _BANDS]
    owners: list[list[int]] = [[] for _ in _BANDS]  # row of the element of each piece
    # `rows` yields the vertices, the label and the confidence of each element.
    for row, (points, label, _) in enumerate(elements.with_coordinates(2).rows):
        cut = cut_area if label in areas else cut_line
        for band, piece in cut(points):
            pieces[band].append(piece)
            owners[band].append(row)
    band_elements = []
    for band in range(len(_BANDS)):
        rows = np.array(owners[band], dtype=np.int64)
        # Ground truth has no scores.
        scores = None if elements.scores is None else elements.scores[rows]
        band_elements.append(
            MapElements.from_polylines(pieces[band], labels=elements.labels[rows], scores=scores)
        )
    return band_elements


def cut_line(points: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Cut a line where it crosses the circles.

    Args:
        points: Vertices in metres, with the vehicle at the origin. (n, 2)

    Yields:
        Index of the band and vertices (m, 2) of each piece that is at least ``SHORTEST_M`` long.
        The first and the last piece of a ring are joined if they are in one band, because a ring
        may start anywhere.
    """
    if len(points) < 2:
        return
    positions = _cut_positions(points)
    # No part between two positions crosses a circle, so its middle determines its band.
    middles = (positions[1:] + positions[:-1]) / 2
    vertices = _interpolate(points, positions)
    middle_x, middle_y = _interpolate(points, middles).T
    distances = np.hypot(middle_x, middle_y)
    # Band of each part: the number of circles around the vehicle that the part lies beyond.
    bands = np.searchsorted(_RADII_M, distances, side="right")
    changes = np.flatnonzero(np.diff(bands)) + 1  # first part of each piece but the first one
    pieces = []
    for start, end in pairwise([0, *changes.tolist(), len(bands)]):
        # Part i runs from vertex i to vertex i + 1, so the parts start to end - 1 end at vertex
        # end.
        pieces.append((int(bands[start]), vertices[start : end + 1]))
    first_band, first = pieces[0]
    last_band, last = pieces[-1]
    if len(pieces) > 1 and first_band == last_band and is_closed(points):
        pieces.pop()
        pieces[0] = (first_band, np.concatenate([last, first[1:]]))  # their common vertex once
    for band, piece in pieces:
        dx, dy = np.diff(piece, axis=0).T
        if np.hypot(dx, dy).sum() >= SHORTEST_M:
            yield band, piece


def _cut_positions(points: FloatArray) -> FloatArray:
    """Find the positions of the vertices of a line and of its crossings with the circles.

    The position i + s is at the share s, in [0, 1], of the segment from vertex i to vertex i + 1.

    Args:
        points: Vertices in metres, with the vehicle at the origin. (n, 2)

    Returns:
        Positions in [0, n - 1], sorted and without repetitions. (k,)
    """
    start = points[:-1]
    step = np.diff(points, axis=0)
    radii = np.array(_RADII_M)[:, None]
    # A point start + share * step is on a circle if
    # a * share**2 + 2 * b * share + |start|**2 - radius**2 is zero.
    a = (step**2).sum(axis=1)
    b = (start * step).sum(axis=1)
    # A share is NaN or infinite where the line through a segment misses a circle or a segment has
    # no length. The comparison below leaves it out.
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(b**2 - a * ((start**2).sum(axis=1) - radii**2))
        shares = np.stack([-b - root, -b + root]) / a  # (2, radii, n - 1)
    is_inside = (shares > 0) & (shares < 1)
    crossings = (shares + np.arange(len(step)))[is_inside]
    vertices = np.arange(float(len(points)))
    return np.unique(np.concatenate([vertices, crossings]))


def _interpolate(points: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate the points of a line at the positions of `_cut_positions`. (k, 2)"""
    x, y = points.T
    indices = np.arange(len(points))
    return np.stack([np.interp(positions, indices, x), np.interp(positions, indices, y)], axis=1)


def cut_area(points: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Cut an area along the circles.

    Args:
        points: Outline in metres, with the vehicle at the origin. (n, 2)

    Yields:
        Index of the band and closed outline (m, 2) of each piece with an area of at least
        ``SHORTEST_M`` squared. Holes of a piece are left out.
    """
    if len(np.unique(points, axis=0)) < 3:  # not an area
        return
    # `make_valid` converts an outline that crosses itself to a collection of polygons,
    # multi-polygons and lines. The second `get_parts` splits the multi-polygons. Lines are left
    # out, as their area is 0.
    collection = shapely.make_valid(shapely.Polygon(points))
    members = shapely.get_parts(collection)
    parts = shapely.get_parts(members)
    for area in parts[shapely.area(parts) > 0]:
        for band, band_area in enumerate(_BAND_AREAS):
            for piece in shapely.get_parts(area & band_area):  # the intersection
                if piece.area >= SHORTEST_M**2:
                    yield band, shapely.get_coordinates(piece.exterior)


def _band_areas() -> list[shapely.Geometry]:
    """Create the area of each band; the last one ends far beyond any map."""
    far_m = 1e6
    centre = shapely.Point(0, 0)
    areas = []
    inner: shapely.Geometry = centre  # a point, so the first area is the whole inner disc
    for radius_m in (*_RADII_M, far_m):
        outer = centre.buffer(radius_m, quad_segs=64)
        areas.append(outer.difference(inner))
        inner = outer
    return areas


_BAND_AREAS = _band_areas()
