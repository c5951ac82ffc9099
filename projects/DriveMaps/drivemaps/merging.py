"""Maps of drives from the predictions of their frames, by merging or non-maximum suppression."""

from dataclasses import replace

import numpy as np
import shapely

from drivemaps.area_merging import merge_areas
from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, drive_map
from drivemaps.line_merging import merge_lines
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements

_RADIUS_M = 1.0  # a polyline within this distance of another one runs along it
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

    Args:
        drive: Frames with their predictions.
        config: Parameters of merging; ``MergeConfig()`` by default.

    Returns:
        Lines and closed rings in the global frame, with their confidence as scores.

    Raises:
        InputError: If the lines are too long or too close together to be merged in bounded time.
    """
    config = config or MergeConfig()
    rows = []
    for label, name in enumerate(drive.classes):
        merge_class = merge_areas if name in AREA_CLASSES else merge_lines
        for points, confidence in merge_class(drive, label, config):
            rows.append((label, points, confidence))
    return drive_map(rows)


def suppress(drive: Drive) -> MapElements:
    """Select predictions of all frames by non-maximum suppression, the baseline of `merge`.

    A polyline is dropped if more than half of it lies within 1 m of a polyline of its class that
    has a higher score and is not dropped.

    Args:
        drive: Frames with their predictions.

    Returns:
        Selected predictions in the global frame, with their scores.
    """
    rows = []
    for frame in drive.frames:
        for points, label, score in frame.elements.rows:
            if len(points) > 1:
                rows.append((points, label, score))
    rows.sort(key=_falling_score)
    lines = np.array([shapely.LineString(points) for points, _, _ in rows], dtype=object)
    strips = shapely.buffer(lines, _RADIUS_M)
    tree = shapely.STRtree(strips)
    is_selected = np.zeros(len(rows), dtype=bool)
    selected = []
    for index, (points, label, score) in enumerate(rows):
        line = lines[index]
        rivals = []  # selected polylines of the class
        for near_index in tree.query(line):
            _, near_label, _ = rows[near_index]
            if is_selected[near_index] and near_label == label:
                rivals.append(near_index)
        lengths_along = shapely.length(shapely.intersection(line, strips[rivals]))
        is_duplicate = (lengths_along > _MOST_SHARE * line.length).any()
        if line.length > 0.0 and not is_duplicate:
            is_selected[index] = True
            selected.append((label, points, score))
    return drive_map(selected)


def _falling_score(row: tuple[FloatArray, int, float]) -> float:
    """Key that sorts vertices, labels and scores by falling score."""
    _, _, score = row
    return -score
