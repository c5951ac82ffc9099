"""Merging of the lines of many frames into one set of lines.

Each vertex is matched with the points at which the normal of its line meets the lines of other
frames. It then moves to the mean of itself and these points, weighted by certainty, so that the
lines of one object come to lie on top of each other. The longest well-supported lines are selected
first, other lines add the parts that are not covered yet, and ends that meet are joined.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from drivemaps.config import MergeConfig
from drivemaps.drive import MIN_LENGTH_M, Drive
from drivemaps.line_matching import (
    DenseLines,
    Matches,
    dense_predictions,
    match_vertices,
    normals_of,
)
from drivemaps.stitching import JOIN_M, stitch
from gsmap.structures.elements import BoolArray, FloatArray
from gsmap.structures.polylines import arc_lengths
from gsmap.utils.errors import InputError

_NUM_ROUNDS = 3  # times that all vertices move to the mean
# Limit of the work: the lines of a class may have this total length, plus a length for each frame.
_MOST_M = 250_000.0
_MOST_PER_FRAME_M = 5_000.0


def merge_lines(drive: Drive, label: int, config: MergeConfig) -> list[tuple[FloatArray, float]]:
    """Merge the lines of one class.

    The confidence at a vertex is the sum of the scores of the frames that have a line there,
    divided by the number of frames that have the vertex in their range, and at most 1.

    Args:
        drive: Frames with their predictions.
        label: Index of the class.
        config: Parameters of merging.

    Returns:
        Vertices in metres in the global frame, (n, 2), and mean confidence in [0, 1] of each line.

    Raises:
        InputError: If the lines are too long or too close together to be merged in bounded time.
    """
    _check_total_length(drive, label)
    lines = dense_predictions(drive, label=label, config=config)
    num_vertices = len(lines.points)
    if num_vertices == 0:
        return []
    # The normals and the matches change with the vertices, so each round computes them again.
    for _ in range(_NUM_ROUNDS):
        normals = normals_of(lines)
        matches = match_vertices(lines, normals)
        lines = _move_to_means(lines, normals=normals, matches=matches)
    matches = match_vertices(lines, normals_of(lines))
    # A segment has the index of its first vertex, whose score it takes.
    matched_scores = lines.scores[matches.segments]
    score_sum = lines.scores + np.bincount(matches.vertices, matched_scores, minlength=num_vertices)
    # Frames that have each vertex in their range, with or without a line there. (M,)
    num_frames = drive.count_frames_in_range(lines.points)
    share = score_sum / np.maximum(num_frames, 1)
    # A vertex at a sharp corner has no match. The median of three gives it its neighbours' share.
    filtered_share = median_filter(share, 3)
    confidence = np.minimum(filtered_share, 1.0)
    is_confident = confidence >= config.min_confidence
    parts = _select_parts(lines, matches=matches, confidence=confidence, is_confident=is_confident)
    columns = np.column_stack([lines.points, confidence])  # x, y, confidence. (M, 3)
    merged = []
    # `stitch` joins ends at most JOIN_M apart, and keeps further columns as they are.
    for line in stitch([columns[part] for part in parts]):
        if arc_lengths(line)[-1] >= MIN_LENGTH_M:
            merged.append((line[:, :2], float(line[:, 2].mean())))
    return merged


def _check_total_length(drive: Drive, label: int) -> None:
    """Raise InputError if the lines of a class are too long to be merged in bounded time."""
    total_m = 0.0
    for frame in drive.frames:
        elements = frame.elements.select(frame.elements.labels == label)
        total_m += sum(float(arc_lengths(line)[-1]) for line in elements.polylines)
    most_m = _MOST_M + _MOST_PER_FRAME_M * len(drive.frames)
    if total_m > most_m:
        raise InputError(
            f"drive {drive.name!r} has {total_m / 1000:.0f} km of {drive.classes[label]!r} in "
            f"{len(drive.frames)} frames: at most {_MOST_M / 1000:g} km and "
            f"{_MOST_PER_FRAME_M / 1000:g} km a frame are merged; raise --score-thr."
        )


def _move_to_means(lines: DenseLines, normals: FloatArray, matches: Matches) -> DenseLines:
    """Move each vertex along its normal to the weighted mean of itself and its matches."""
    num_vertices = len(lines.points)
    # A segment has the index of its first vertex, whose weight it takes.
    weights = lines.weights[matches.segments]
    moments = weights * matches.distances
    total = lines.weights + np.bincount(matches.vertices, weights, minlength=num_vertices)
    shift = np.bincount(matches.vertices, moments, minlength=num_vertices) / total
    return replace(lines, points=lines.points + shift[:, None] * normals)


def _select_parts(
    lines: DenseLines, matches: Matches, confidence: FloatArray, is_confident: BoolArray
) -> list[slice]:
    """Select parts of lines that together cover all lines once.

    The support of a line is the sum of the confidence of its vertices that may be selected. Lines
    are visited by falling support. The parts of a line that no previous part covers are selected,
    and the vertices of other lines that match a selected part become covered.

    Args:
        lines: Lines of all frames, which lie on top of each other.
        matches: Matches of their vertices.
        confidence: Confidence of each vertex, in [0, 1]. (M,)
        is_confident: Vertices that may be selected. (M,)

    Returns:
        Vertices of each part; a part lies within one line.
    """
    # Sort the matches by the line of their segment. The segments of the matches
    # line_bounds[i]:line_bounds[i + 1] then belong to line i.
    matched_lines = lines.line_indices[matches.segments]
    matches = matches.select(np.argsort(matched_lines, kind="stable"))
    line_bounds = np.searchsorted(
        lines.line_indices[matches.segments], np.arange(len(lines.offsets))
    )
    # Sum over the vertices of each line.
    support = np.add.reduceat(confidence * is_confident, lines.offsets[:-1])  # (N,)
    is_free = is_confident.copy()
    parts = []
    # Support is rounded, so that lines of equal support keep their order despite rounding errors.
    for index in np.argsort(-support.round(9), kind="stable").tolist():
        line_start = int(lines.offsets[index])
        line_end = int(lines.offsets[index + 1])
        line_matches = slice(line_bounds[index], line_bounds[index + 1])
        vertices = matches.vertices[line_matches]
        segments = matches.segments[line_matches]
        # Runs of free vertices start and end where the flag changes.
        padded_flags = np.r_[False, is_free[line_start:line_end], False]
        changes = np.flatnonzero(np.diff(padded_flags))
        runs = line_start + changes.reshape(-1, 2)
        for start, end in runs.tolist():
            # `stitch` closes gaps of this length, so a shorter part is not needed.
            if arc_lengths(lines.points[start:end])[-1] < JOIN_M:
                continue
            parts.append(slice(start, end))
            # A segment has the index of its first vertex, so the last one begins at `end - 2`.
            is_covered = (segments >= start) & (segments < end - 1)
            is_free[vertices[is_covered]] = False
    return parts
