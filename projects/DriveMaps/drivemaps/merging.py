"""One map out of the predictions of a drive's frames: merged, or merely thinned out."""

from dataclasses import replace
from itertools import compress

import numpy as np
import shapely

from drivemaps.area_merging import merge_areas
from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, drive_map
from drivemaps.line_merging import merge_lines
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import MapElements

_RADIUS_M = 1.0  # how far apart polylines may run along each other
_SHARE = 0.5  # of the length that may do so


def confident(drive: Drive, min_score: float) -> Drive:
    """Return a drive without the predictions below a score."""
    frames = [
        replace(f, elements=f.elements.select(f.elements.confidence >= min_score))
        for f in drive.frames
    ]
    return replace(drive, frames=frames)


def merge(drive: Drive, config: MergeConfig | None = None) -> MapElements:
    """Merge the predictions of all frames into one map; the same input gives the same map.

    Its lines and closed rings are in the global frame, with their confidence as scores.
    """
    config, found = config or MergeConfig(), []
    for label, name in enumerate(drive.classes):
        merge_class = merge_areas if name in AREA_CLASSES else merge_lines
        found += [(label, *merged) for merged in merge_class(drive, label, config)]
    return drive_map(found)


def suppress(drive: Drive) -> MapElements:
    """Thin the predictions of all frames out by non-maximum suppression: the plain baseline.

    By falling score, a polyline is dropped if a kept one of its class is within 1 m of more than
    half of it. The map is in the global frame and keeps the scores.
    """
    rows = [row for frame in drive.frames for row in frame.elements.rows if len(row[0]) > 1]
    rows.sort(key=lambda row: -row[2])
    lines = np.array([shapely.LineString(line) for line, *_ in rows], dtype=object)
    strips = shapely.buffer(lines, _RADIUS_M)
    tree, kept = shapely.STRtree(strips), np.zeros(len(rows), dtype=bool)
    for i, (_, label, _) in enumerate(rows):
        near = [j for j in tree.query(lines[i]) if kept[j] and rows[j][1] == label]
        along = shapely.length(shapely.intersection(lines[i], strips[near]))
        kept[i] = lines[i].length > 0.0 and not (along > _SHARE * lines[i].length).any()
    return drive_map((label, line, score) for line, label, score in compress(rows, kept))
