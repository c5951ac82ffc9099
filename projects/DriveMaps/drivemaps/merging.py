"""Maps of drives from the predictions of their frames, by merging or non-maximum suppression."""

from dataclasses import replace

import numpy as np
import shapely

from drivemaps.area_merging import merge_areas
from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, drive_map
from drivemaps.lanelets import CENTERLINE
from drivemaps.line_merging import merge_lines
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import IntArray, MapElements

_RADIUS_M = 1.0  # a polyline within this distance of another one runs along it
_MOST_VERTICES = 1000  # largest number of vertices of a line that is compared with other lines
_MOST_SHARE = 0.5  # share of a polyline's length that may run along another one


def confident(drive: Drive, min_score: float) -> Drive:
    """Select the predictions of a drive by their scores.

    Args:
        drive: Frames with their predictions.
        min_score: Smallest score of a selected prediction, in [0, 1].

    Returns:
        Drive of the selected predictions.
    """
    frames = []
    for frame in drive.frames:
        is_confident = frame.elements.confidence >= min_score
        frames.append(replace(frame, elements=frame.elements.select(is_confident)))
    return replace(drive, frames=frames)


def merge(drive: Drive, config: MergeConfig | None = None) -> MapElements:
    """Merge the predictions of all frames into one map, deterministically.

    A model may predict an object of a frame several times. Therefore a line is left out if it runs
    along a line of its frame and class that has a higher score, as in `suppress`. Predictions with
    a score of 0 are left out, too.

    Args:
        drive: Frames with their predictions.
        config: Parameters of merging; ``MergeConfig()`` by default.

    Returns:
        Lines and closed rings in metres in the global frame, with their confidence as scores.

    Raises:
        InputError: If the lines are too long or too close together to be merged in bounded time
            (raised by `merge_lines`).
    """
    config = config or MergeConfig()
    drive = _without_duplicates(drive)
    rows = []
    for label, name in enumerate(drive.classes):
        merge_class = merge_areas if name in AREA_CLASSES else merge_lines
        # Both functions return the merged elements of one class: vertices and confidence of each.
        for points, confidence in merge_class(drive, label, config):
            rows.append((label, points, confidence))
    return drive_map(rows)  # simplifies and sorts the elements


def suppress(drive: Drive) -> MapElements:
    """Select predictions of all frames by non-maximum suppression, the baseline of `merge`.

    A polyline is dropped if more than half of it lies within 1 m of a polyline of its class that
    has a higher score and is not dropped.

    Args:
        drive: Frames with their predictions.

    Returns:
        Selected predictions in the global frame, with their scores.
    """
    lines = []
    labels = []
    scores = []
    for frame in drive.frames:
        for points, label, score in frame.elements.rows:
            lines.append(points)
            labels.append(label)
            scores.append(score)
    elements = MapElements.from_polylines(lines, labels=labels, scores=scores)
    rows = []
    for points, label, score in elements.select(_select_distinct(elements)).rows:
        rows.append((label, points, score))
    return drive_map(rows)


def _without_duplicates(drive: Drive) -> Drive:
    """Leave out the lines of each frame that run along a line with a higher score.

    Three kinds of elements are always kept: areas, centre lines (their paths share parts), and
    lines with so many vertices that a comparison would take long.
    """
    # For each class, whether its elements are always kept.
    may_overlap = np.array([name in (*AREA_CLASSES, CENTERLINE) for name in drive.classes])
    frames = []
    for frame in drive.frames:
        elements = frame.elements
        is_kept = may_overlap[elements.labels] | (elements.num_points > _MOST_VERTICES)
        compared = np.flatnonzero(~is_kept)
        distinct = _select_distinct(elements.select(compared))  # indices into `compared`
        is_kept[compared[distinct]] = True
        frames.append(replace(frame, elements=elements.select(is_kept)))
    return replace(drive, frames=frames)


def _select_distinct(elements: MapElements) -> IntArray:
    """Select polylines by non-maximum suppression within each class.

    Args:
        elements: Polylines in metres.

    Returns:
        Indices of the selected polylines, by falling score. Polylines of length 0 are not selected.
    """
    lines = []
    for points in elements.polylines:
        # A line of shapely needs two points. A single point becomes an empty line, of length 0.
        coordinates = points[:, :2] if len(points) > 1 else None
        lines.append(shapely.LineString(coordinates))
    shapes = np.array(lines, dtype=object)
    strips = shapely.buffer(shapes, _RADIUS_M)  # area within 1 m of each line
    tree = shapely.STRtree(strips)
    # From the highest score to the lowest; lines with equal scores keep their order.
    order = np.argsort(-elements.confidence, kind="stable")
    is_selected = np.zeros(len(elements), dtype=bool)
    selected = []
    for index in order.tolist():
        line = shapes[index]
        near = tree.query(line)
        has_class = elements.labels[near] == elements.labels[index]
        rivals = near[is_selected[near] & has_class]  # selected lines of the class
        # Length of the part of the line that runs along each rival.
        lengths_along = shapely.length(shapely.intersection(line, strips[rivals]))
        is_duplicate = (lengths_along > _MOST_SHARE * line.length).any()
        if line.length > 0.0 and not is_duplicate:
            is_selected[index] = True
            selected.append(index)
    return np.array(selected, dtype=np.int64)
