"""Merging of the lines of many frames into one set of lines.

Each vertex is matched, across its line, with the lines of the other frames and moves to their
mean, weighted by certainty. The lines of one object then lie on top of each other. The longest
well-supported lines are selected first, other lines add the parts that are not covered yet, and
ends that meet are joined.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from scipy.ndimage import median_filter

from drivemaps.config import MergeConfig
from drivemaps.drive import MIN_LENGTH_M, Drive
from drivemaps.stitching import JOIN_M, stitch
from gsmap.structures.elements import BoolArray, FloatArray, IntArray
from gsmap.structures.polylines import arc_lengths
from gsmap.utils.errors import InputError

_REACH_M = 1.5  # largest distance, across a line, of a vertex from its matches
_MAX_TURN_DEG = 30.0  # largest angle between two lines that are matched
_STEP_M = 1.0  # largest distance between vertices while lines are merged
_CHUNK_SIZE = 2000  # vertices that are matched at once; memory grows with it
_NUM_ROUNDS = 3  # times that all vertices move to the mean
# Limits of the work: total length of the lines of a class, a constant plus a part per frame.
_MOST_M = 250_000.0
_MOST_PER_FRAME_M = 5_000.0
# Pairs of a vertex and a segment near it: the larger one of a constant and a number per vertex and
# frame.
_MOST_PAIRS = 2 * 10**7
_MOST_PAIRS_PER_FRAME = 16


@dataclass(frozen=True, eq=False)
class _DenseLines:
    """Densely sampled lines of one class from all frames.

    Args:
        points: Vertices of all lines in metres, in the global frame. (M, 2)
        offsets: Line i has the vertices ``offsets[i]:offsets[i + 1]``. (N + 1,)
        frames: Index of the frame of each vertex. (M,)
        scores: Score of the line of each vertex, in [0, 1]. (M,)
        weights: Weight of each vertex in a mean: score over variance across the line, in 1 / m^2.
            (M,)
    """

    points: FloatArray
    offsets: IntArray
    frames: IntArray
    scores: FloatArray
    weights: FloatArray

    @cached_property
    def line_indices(self) -> IntArray:
        """Index of the line of each vertex. (M,)"""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    @cached_property
    def segment_starts(self) -> IntArray:
        """Vertices at which a segment starts: all but the last one of each line. (S,)"""
        return np.setdiff1d(np.arange(len(self.points)), self.offsets[1:] - 1)


@dataclass(frozen=True, eq=False)
class _Matches:
    """Matches of vertices with segments of other lines, C in number.

    Args:
        vertices: Index of the vertex. (C,)
        segments: Index of the first vertex of the segment. (C,)
        distances: Distance from the vertex to the segment along the normal of the vertex, in
            metres; positive on the left. (C,)
    """

    vertices: IntArray
    segments: IntArray
    distances: FloatArray

    def select(self, index: IntArray | BoolArray) -> "_Matches":
        """Select matches by their indices (K,) or a mask (C,)."""
        return _Matches(
            vertices=self.vertices[index],
            segments=self.segments[index],
            distances=self.distances[index],
        )


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
    lines = _sample_lines(drive, label=label, config=config)
    num_vertices = len(lines.points)
    if num_vertices == 0:
        return []
    for _ in range(_NUM_ROUNDS):
        normals = _normals(lines)
        matches = _match_vertices(lines, normals)
        lines = _move_to_means(lines, normals=normals, matches=matches)
    matches = _match_vertices(lines, _normals(lines))
    matched_scores = lines.scores[matches.segments]
    support = lines.scores + np.bincount(matches.vertices, matched_scores, minlength=num_vertices)
    share = support / np.maximum(drive.times_seen(lines.points), 1)
    smooth_share = median_filter(share, 3)  # the vertex of a sharp corner has no match
    confidence = np.minimum(smooth_share, 1.0)
    is_confident = confidence >= config.min_confidence
    parts = _select_parts(lines, matches=matches, confidence=confidence, is_confident=is_confident)
    columns = np.column_stack([lines.points, confidence])  # x, y, confidence. (M, 3)
    merged = []
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
            f"drive {drive.scene!r} has {total_m / 1000:.0f} km of {drive.classes[label]!r} in "
            f"{len(drive.frames)} frames: at most {_MOST_M / 1000:g} km and "
            f"{_MOST_PER_FRAME_M / 1000:g} km a frame are merged; raise --score-thr."
        )


def _sample_lines(drive: Drive, label: int, config: MergeConfig) -> _DenseLines:
    """Sample the lines of one class, with vertices at most ``_STEP_M`` apart."""
    points = [np.zeros((0, 2))]
    variances = [np.zeros(0)]
    frames = [np.zeros(0, np.int64)]
    scores = [np.zeros(0)]
    counts = [0]
    for frame_index, frame in enumerate(drive.frames):
        elements = frame.elements
        vertex_variances = config.variances(frame)
        for index in np.flatnonzero(elements.labels == label).tolist():
            vertices = slice(elements.offsets[index], elements.offsets[index + 1])
            line = elements.points[vertices]
            along = arc_lengths(line)
            if along[-1] == 0.0:
                continue
            steps = np.arange(0.0, along[-1], _STEP_M)
            positions = np.union1d(along, steps)
            x = np.interp(positions, along, line[:, 0])
            y = np.interp(positions, along, line[:, 1])
            points.append(np.stack([x, y], axis=1))
            variances.append(np.interp(positions, along, vertex_variances[vertices]))
            frames.append(np.full(len(positions), frame_index))
            scores.append(np.full(len(positions), elements.confidence[index]))
            counts.append(len(positions))
    all_scores = np.concatenate(scores)
    return _DenseLines(
        points=np.concatenate(points),
        offsets=np.cumsum(counts),
        frames=np.concatenate(frames),
        scores=all_scores,
        weights=all_scores / np.concatenate(variances),
    )


def _normals(lines: _DenseLines) -> FloatArray:
    """Unit vector to the left of the line at each vertex. (M, 2)"""
    vertices = np.arange(len(lines.points))
    following = vertices + 1
    following[lines.offsets[1:] - 1] -= 1
    previous = vertices - 1
    previous[lines.offsets[:-1]] += 1
    along = lines.points[following] - lines.points[previous]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)


def _match_vertices(lines: _DenseLines, normals: FloatArray) -> _Matches:
    """Match each vertex with the nearest line of about its direction in each other frame.

    There is no match if the frame of the vertex has another line at less than twice the distance:
    lines of one frame belong to different objects.

    Args:
        lines: Lines of all frames.
        normals: Unit vector to the left of the line at each vertex. (M, 2)

    Returns:
        At most one match per vertex and frame, ordered by vertex.

    Raises:
        InputError: If too many pairs of a vertex and a segment are near each other.
    """
    points = lines.points
    starts = points[lines.segment_starts]
    ends = points[lines.segment_starts + 1]
    tree = shapely.STRtree(_boxes(np.minimum(starts, ends), np.maximum(starts, ends)))
    num_frames = len(np.unique(lines.frames))
    num_pairs_left = max(_MOST_PAIRS, _MOST_PAIRS_PER_FRAME * num_frames * len(points))
    reach = np.abs(_REACH_M * normals)
    chunks = []
    for start in range(0, len(points), _CHUNK_SIZE):
        chunk = slice(start, start + _CHUNK_SIZE)
        boxes = _boxes(points[chunk] - reach[chunk], points[chunk] + reach[chunk])
        positions, segments = tree.query(boxes)
        num_pairs_left -= len(positions)
        if num_pairs_left < 0:
            raise InputError(
                f"the {len(points)} vertices of lines of one class, at most {_STEP_M:g} m apart, "
                f"lie too close together: more than {_MOST_PAIRS:.0e} pairs, and "
                f"{_MOST_PAIRS_PER_FRAME} of a vertex and frame, are within {_REACH_M:g} m; raise "
                "--score-thr."
            )
        candidates = _match_pairs(
            lines, normals, vertices=start + positions, segments=lines.segment_starts[segments]
        )
        chunks.append(_select_matches(lines, candidates))
    return _concatenate(chunks)


def _concatenate(chunks: list[_Matches]) -> _Matches:
    """Concatenate matches."""
    vertices = []
    segments = []
    distances = []
    for chunk in chunks:
        vertices.append(chunk.vertices)
        segments.append(chunk.segments)
        distances.append(chunk.distances)
    return _Matches(
        vertices=np.concatenate(vertices),
        segments=np.concatenate(segments),
        distances=np.concatenate(distances),
    )


def _boxes(low: FloatArray, high: FloatArray) -> np.ndarray:
    """Axis-aligned rectangles as polygons. (n, 2), (n, 2) -> (n,)"""
    return shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])


def _match_pairs(
    lines: _DenseLines, normals: FloatArray, vertices: IntArray, segments: IntArray
) -> _Matches:
    """Match vertices with segments that cross their normals at about a right angle.

    Args:
        lines: Lines of all frames.
        normals: Unit vector to the left of the line at each vertex. (M, 2)
        vertices: Index of the vertex of each pair. (pairs,)
        segments: Index of the first vertex of the segment of each pair. (pairs,)

    Returns:
        Matches of different lines, also of one frame, in the order of the pairs.
    """
    differ = lines.line_indices[vertices] != lines.line_indices[segments]
    vertices = vertices[differ]
    segments = segments[differ]
    normal = normals[vertices]
    vertex = lines.points[vertices]
    start = lines.points[segments] - vertex
    end = lines.points[segments + 1] - vertex
    # Positions along the line of the vertex; the segment crosses the normal at position 0.
    start_along = start[:, 1] * normal[:, 0] - start[:, 0] * normal[:, 1]
    end_along = end[:, 1] * normal[:, 0] - end[:, 0] * normal[:, 1]
    extent = end_along - start_along  # of the segment along the line of the vertex, in metres
    fraction = -start_along / np.where(extent == 0.0, np.inf, extent)
    distances = (normal * (start + fraction[:, None] * (end - start))).sum(axis=1)
    lengths = np.linalg.norm(end - start, axis=1)
    crosses = start_along * end_along <= 0.0
    is_parallel = np.abs(extent) > np.cos(np.radians(_MAX_TURN_DEG)) * lengths
    is_near = np.abs(distances) <= _REACH_M
    return _Matches(vertices, segments, distances).select(crosses & is_parallel & is_near)


def _select_matches(lines: _DenseLines, candidates: _Matches) -> _Matches:
    """Select the nearest match of each vertex in each other frame, ordered by vertex and frame.

    A candidate in the frame of the vertex is a rival: the next line on its side of the vertex.
    Matches beyond half the distance of a rival are dropped.

    Args:
        lines: Lines of all frames.
        candidates: Matches of some vertices, also within one frame.
    """
    vertices = candidates.vertices
    in_one_frame = lines.frames[vertices] == lines.frames[candidates.segments]
    is_selected = ~in_one_frame
    distinct, rows = np.unique(vertices, return_inverse=True)
    for side in (1.0, -1.0):  # left and right
        distances = side * candidates.distances
        is_rival = in_one_frame & (distances >= 0.0)
        nearest_rival_m = np.full(len(distinct), np.inf)
        np.minimum.at(nearest_rival_m, rows[is_rival], distances[is_rival])
        is_selected &= distances <= nearest_rival_m[rows] / 2.0
    matches = candidates.select(is_selected)
    frames = lines.frames[matches.segments]
    order = np.lexsort((matches.segments, np.abs(matches.distances), frames, matches.vertices))
    matches = matches.select(order)
    is_new_vertex = np.diff(matches.vertices, prepend=-1) != 0
    is_new_frame = np.diff(frames[order], prepend=-1) != 0
    return matches.select(is_new_vertex | is_new_frame)


def _move_to_means(lines: _DenseLines, normals: FloatArray, matches: _Matches) -> _DenseLines:
    """Move each vertex along its normal to the weighted mean of its line in all frames."""
    num_vertices = len(lines.points)
    weights = lines.weights[matches.segments]
    moments = weights * matches.distances
    total = lines.weights + np.bincount(matches.vertices, weights, minlength=num_vertices)
    shift = np.bincount(matches.vertices, moments, minlength=num_vertices) / total
    return replace(lines, points=lines.points + shift[:, None] * normals)


def _select_parts(
    lines: _DenseLines, matches: _Matches, confidence: FloatArray, is_confident: BoolArray
) -> list[slice]:
    """Select parts of lines that together cover all lines once, the best supported line first.

    Args:
        lines: Lines of all frames, which lie on top of each other.
        matches: Matches of their vertices.
        confidence: Confidence of each vertex, in [0, 1]. (M,)
        is_confident: Vertices that may be selected. (M,)

    Returns:
        Vertices of each part, of one line.
    """
    matched_lines = lines.line_indices[matches.segments]
    matches = matches.select(np.argsort(matched_lines, kind="stable"))
    line_bounds = np.searchsorted(
        lines.line_indices[matches.segments], np.arange(len(lines.offsets))
    )
    support = np.add.reduceat(confidence * is_confident, lines.offsets[:-1])
    is_free = is_confident.copy()
    parts = []
    for index in np.argsort(-support.round(9), kind="stable").tolist():
        line_start = int(lines.offsets[index])
        line_end = int(lines.offsets[index + 1])
        line_matches = slice(line_bounds[index], line_bounds[index + 1])
        vertices = matches.vertices[line_matches]
        segments = matches.segments[line_matches]
        changes = np.diff(np.r_[False, is_free[line_start:line_end], False])
        edges = line_start + np.flatnonzero(changes).reshape(-1, 2)
        for start, end in edges.tolist():
            if arc_lengths(lines.points[start:end])[-1] < JOIN_M:
                continue
            parts.append(slice(start, end))
            is_covered = (segments >= start) & (segments < end - 1)
            is_free[vertices[is_covered]] = False
    return parts
