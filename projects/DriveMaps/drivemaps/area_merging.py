"""Areas of many frames (crossings) merged by a weighted vote on every spot of ground."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import shapely

from drivemaps.config import MergeConfig
from drivemaps.drive import MIN_AREA_M2, Drive
from drivemaps.truth import components, polygons_of
from gsmap.structures.elements import FloatArray, IntArray

_MAJORITY = 0.5
_MIN_OVERLAP = 0.3  # of the smaller one: rings of different frames that are of one area
_SIMPLIFY_M = 0.15  # a vote's outline changes from one frame's edge to another's


def merge_areas(drive: Drive, label: int, config: MergeConfig) -> list[tuple[FloatArray, float]]:
    """Merge the rings of one class.

    Rings that overlap from frame to frame are one area. A spot belongs to it if the frames that
    see the spot, and know of the area, say so by the majority of their weights.

    Args:
        drive: Frames with their predictions.
        label: The class.
        config: Rules.

    Returns:
        Closed ring (n, 2) and confidence of each area: the mean over its ground of the share of
        frames, of those that see the spot, that found it, weighted by their scores.
    """
    areas, frames, scores, weights = [], [], [], []
    for number, frame in enumerate(drive.frames):
        elements, variances = frame.elements, config.variances(frame)
        for i in np.flatnonzero(elements.labels == label).tolist():
            part = slice(elements.offsets[i], elements.offsets[i + 1])
            for area in polygons_of([elements.points[part]]):
                areas.append(area)
                frames.append(number)
                scores.append(elements.confidence[i])
                weights.append(scores[-1] / variances[part].mean())
    merged = []
    for group in _groups(areas, np.array(frames, np.int64)):
        merged += _voted(
            drive,
            [areas[i] for i in group],
            [frames[i] for i in group],
            np.array([scores[i] for i in group]),
            np.array([weights[i] for i in group]),
        )
    return [(ring, score) for ring, score in merged if score >= config.min_area_confidence]


def _groups(areas: Sequence[shapely.Geometry], frames: IntArray) -> list[IntArray]:
    """Return which areas are the same thing."""
    shapes = np.array(areas, dtype=object)
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    between = frames[first] != frames[second]
    first, second = first[between], second[between]
    shared = shapely.area(shapely.intersection(shapes[first], shapes[second]))
    smaller = np.minimum(shapely.area(shapes[first]), shapely.area(shapes[second]))
    same = shared >= _MIN_OVERLAP * smaller
    return components(len(areas), first[same], second[same])


def _voted(
    drive: Drive,
    areas: Sequence[shapely.Geometry],
    frames: Sequence[int],
    scores: FloatArray,
    weights: FloatArray,
) -> list[tuple[FloatArray, float]]:
    """Return outline and confidence of what the majority of one group's frames say."""
    members = defaultdict(list)
    for i, number in enumerate(frames):
        members[number].append(i)
    footprints = {number: drive.footprint(drive.frames[number]) for number in members}
    edges = [shapely.boundary(shape) for shape in (*areas, *footprints.values())]
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all(edges)]))
    spots = shapely.get_coordinates(shapely.point_on_surface(faces))
    for_it, in_all, support = np.zeros((3, len(faces)))
    for number, rows in members.items():
        inside = np.array([shapely.contains_xy(areas[i], *spots.T) for i in rows])
        weight = weights[rows].mean()
        for_it += weight * inside.any(axis=0)
        in_all += weight * shapely.contains_xy(footprints[number], *spots.T)
        support += (scores[rows][:, None] * inside).max(axis=0)
    chosen = for_it > _MAJORITY * np.maximum(in_all, for_it)
    confidence = np.minimum(support / np.maximum(drive.times_seen(spots), 1), 1.0)
    found = []
    for part in shapely.get_parts(shapely.union_all(faces[chosen])):
        if part.area >= MIN_AREA_M2:
            within = chosen & shapely.contains_xy(part, *spots.T)
            ring = part.exterior.simplify(_SIMPLIFY_M)
            score = np.average(confidence[within], weights=shapely.area(faces[within]))
            found.append((shapely.get_coordinates(ring), float(score)))
    return found
