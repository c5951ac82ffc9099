"""Merging of the areas of many frames (crossings) by a weighted vote on each spot of ground."""

from collections import defaultdict

import numpy as np
import shapely

from drivemaps.config import MergeConfig
from drivemaps.drive import MIN_AREA_M2, Drive
from drivemaps.truth import components, polygons_of
from gsmap.structures.elements import FloatArray, IntArray

_MAJORITY = 0.5  # share of the votes above which a spot belongs to an area
# Two detections show one object if they overlap in at least this share of the smaller one.
_MIN_OVERLAP = 0.3
# Tolerance of the simplification of outlines, which follow the edges of several frames.
_SIMPLIFY_M = 0.15


def merge_areas(drive: Drive, label: int, config: MergeConfig) -> list[tuple[FloatArray, float]]:
    """Merge the rings of one class.

    Rings of different frames that overlap are detections of one object. Whether a spot of ground
    belongs to the object is decided by vote. The voters are the frames that detected the object
    and have the spot in their range. A vote is weighted by score over variance. The confidence at a
    spot is the sum of the scores of the frames whose ring contains the spot, divided by the number
    of frames that have it in their range. It is limited to 1.

    Args:
        drive: Frames with their predictions.
        label: Index of the class.
        config: Parameters of merging.

    Returns:
        For each area, a closed ring in metres in the global frame, (n, 2), and its mean confidence
        in [0, 1].
    """
    # Each list has one entry for each detection.
    areas: list[shapely.Geometry] = []
    frames: list[int] = []
    scores: list[float] = []
    weights: list[float] = []
    for frame_index, frame in enumerate(drive.frames):
        elements = frame.elements
        variances = config.variances(frame)  # of each vertex across its outline, in square metres
        for index in frame.predictions_of(label).tolist():
            vertices = slice(elements.offsets[index], elements.offsets[index + 1])
            # A ring that encloses less than MIN_AREA_M2 has no polygon and is left out.
            for area in polygons_of([elements.points[vertices]]):
                score = elements.confidence[index]
                areas.append(area)
                frames.append(frame_index)
                scores.append(score)
                weights.append(score / variances[vertices].mean())
    all_areas = np.array(areas, dtype=object)
    all_frames = np.array(frames, np.int64)
    all_scores = np.array(scores)
    all_weights = np.array(weights)
    merged = []
    for group in _group_by_overlap(all_areas, frames=all_frames):
        voted_areas = _vote(
            drive,
            areas=all_areas[group],
            frames=all_frames[group],
            scores=all_scores[group],
            weights=all_weights[group],
        )
        for ring, confidence in voted_areas:
            if confidence >= config.min_area_confidence:
                merged.append((ring, confidence))
    return merged


def _group_by_overlap(areas: np.ndarray, frames: IntArray) -> list[IntArray]:
    """Group areas that overlap.

    Args:
        areas: Detections of all frames. (A,)
        frames: Index of the frame of each detection. Two detections of one frame are grouped only
            through detections of other frames. (A,)

    Returns:
        Indices of the detections of each group. (n,) each
    """
    first, second = shapely.STRtree(areas).query(areas, predicate="intersects")
    # The query also pairs each area with itself; these pairs are of one frame and dropped, too.
    differ = frames[first] != frames[second]
    first = first[differ]
    second = second[differ]
    shared_m2 = shapely.area(shapely.intersection(areas[first], areas[second]))
    smaller_m2 = np.minimum(shapely.area(areas[first]), shapely.area(areas[second]))
    overlap = shared_m2 >= _MIN_OVERLAP * smaller_m2
    # Groups are connected by pairs. An area without a pair is a group of one.
    return components(len(areas), first[overlap], second[overlap])


def _vote(
    drive: Drive,
    areas: np.ndarray,
    frames: IntArray,
    scores: FloatArray,
    weights: FloatArray,
) -> list[tuple[FloatArray, float]]:
    """Outline the ground of an object by a vote of the frames that detected it.

    Args:
        drive: Frames of the drive.
        areas: Detections of the object. (A,)
        frames: Index of the frame of each detection. (A,)
        scores: Score of each detection, in [0, 1]. (A,)
        weights: Score over mean variance of each detection, in 1 / m^2. (A,)

    Returns:
        For each connected region, a closed ring in metres, (n, 2), and its mean confidence in
        [0, 1].
    """
    # Indices of the detections of each frame.
    rows_of_frame: defaultdict[int, list[int]] = defaultdict(list)
    for row, frame_index in enumerate(frames.tolist()):
        rows_of_frame[frame_index].append(row)
    footprints = {}  # range of each frame, as a polygon in the global frame
    for frame_index in rows_of_frame:
        footprints[frame_index] = drive.footprint(drive.frames[frame_index])
    edges = shapely.boundary([*areas, *footprints.values()])
    # The edges divide the ground into faces. The votes are constant on each face, so they are
    # counted at one spot per face.
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all(edges)]))
    spots = shapely.get_coordinates(shapely.point_on_surface(faces))  # (faces, 2)
    x, y = spots.T
    votes = np.zeros(len(faces))  # summed weights of the frames whose detections contain the spot
    possible_votes = np.zeros(len(faces))  # summed weights of the frames with the spot in range
    support = np.zeros(len(faces))  # sum over the frames of their best score at the spot
    for frame_index, rows in rows_of_frame.items():
        in_rows = [shapely.contains_xy(areas[row], x, y) for row in rows]
        contains = np.array(in_rows)  # (rows, faces)
        weight = weights[rows].mean()
        votes += weight * contains.any(axis=0)
        possible_votes += weight * shapely.contains_xy(footprints[frame_index], x, y)
        support += (scores[rows][:, None] * contains).max(axis=0)
    # A detection may extend beyond the range of its frame. There, `votes` can be larger than
    # `possible_votes`.
    is_chosen = votes > _MAJORITY * np.maximum(possible_votes, votes)
    # All frames of the drive count here, including frames that did not detect the object.
    num_frames = drive.count_frames_in_range(spots)
    confidence = np.minimum(support / np.maximum(num_frames, 1), 1.0)
    outlines = []
    for region in shapely.get_parts(shapely.union_all(faces[is_chosen])):
        if region.area < MIN_AREA_M2:
            continue
        in_region = is_chosen & shapely.contains_xy(region, x, y)
        face_areas_m2 = shapely.area(faces[in_region])
        mean_confidence = np.average(confidence[in_region], weights=face_areas_m2)
        # Holes are dropped, because an area is described by one ring.
        ring = shapely.get_coordinates(region.exterior.simplify(_SIMPLIFY_M))
        outlines.append((ring, float(mean_confidence)))
    return outlines
