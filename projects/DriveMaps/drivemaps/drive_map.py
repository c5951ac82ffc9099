"""The map of a drive, and what every way of making one shares."""

from collections.abc import Iterable

import numpy as np
import shapely

from gsmap.structures.elements import FloatArray, MapElements

MIN_LENGTH_M = 2.0
MIN_AREA_M2 = 1.0
SIMPLIFY_M = 0.02


def drive_map(found: Iterable[tuple[int, FloatArray, float]], scored: bool = True) -> MapElements:
    """Order elements, and drop the vertices that a line does not need.

    Args:
        found: Label, vertices (n, 2) and score of each element.
        scored: Whether the map keeps the scores.

    Returns:
        The elements by class, then by falling score. (N,)
    """
    rows = [
        (label, shapely.get_coordinates(shapely.LineString(line[:, :2]).simplify(SIMPLIFY_M)), s)
        for label, line, s in found
    ]
    rows.sort(key=lambda row: (row[0], -round(row[2], 9), *np.round(row[1][0], 6)))
    labels, lines, scores = ([row[i] for row in rows] for i in range(3))
    return MapElements.from_polylines(lines, labels, scores if scored else None)
