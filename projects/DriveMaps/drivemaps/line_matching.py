"""Matching of densely sampled lines of several frames, at a right angle to the lines."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from drivemaps.config import MergeConfig
from drivemaps.drive import Drive
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.polylines import arc_lengths
from gsmap.utils.errors import InputError

REACH_M = 1.5
"""Largest distance in metres between a vertex and its match, at a right angle to the line."""
STEP_M = 1.0
"""Largest distance in metres between the vertices of densely sampled lines."""
_MAX_TURN_DEG = 30.0  # largest angle between two lines that are matched
_CHUNK_SIZE = 2000  # vertices that are matched at once; memory grows with it
# Limit of the number of pairs of a vertex and a nearby segment that are examined: the larger one of
# `_MOST_PAIRS`, and `_MOST_PAIRS_PER_FRAME` times the number of vertices and of frames.
_MOST_PAIRS = 2 * 10**7
_MOST_PAIRS_PER_FRAME = 16


@dataclass(frozen=True, eq=False)
class DenseLines:
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
        last_vertices = self.offsets[1:] - 1
        return np.setdiff1d(np.arange(len(self.points)), last_vertices)


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of vertices with segments of other lines. There are C matches.

    Args:
        vertices: Index of the vertex. (C,)
        segments: Index of the first vertex of the segment. (C,)
        distances: Distance from the vertex to the segment along the normal of the vertex, in
            metres; positive on the left. (C,)
    """

    vertices: IntArray
    segments: IntArray
    distances: FloatArray

    def select(self, index: IntArray | BoolArray) -> "Matches":
        """Select matches by their indices (K,) or a mask (C,)."""
        return Matches(
            vertices=self.vertices[index],
            segments=self.segments[index],
            distances=self.distances[index],
        )


def sample_line(line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add vertices to a line, so that they are at most ``STEP_M`` apart.

    Args:
        line: Vertices of a line with a length, in metres. (n, 2)

    Returns:
        Vertices (m, 2), which include the given ones, and their positions along the line in metres
        (m,). Repeated vertices are returned once.
    """
    along = arc_lengths(line)  # position of each vertex along the line
    steps = np.arange(0.0, along[-1], STEP_M)
    positions = np.union1d(along, steps)
    x = np.interp(positions, along, line[:, 0])
    y = np.interp(positions, along, line[:, 1])
    return np.stack([x, y], axis=1), positions


def dense_predictions(drive: Drive, label: int, config: MergeConfig) -> DenseLines:
    """Sample the predicted lines of one class, with vertices at most ``STEP_M`` apart.

    Args:
        drive: Frames with their predictions.
        label: Index of the class.
        config: Parameters of merging, for the weights.

    Returns:
        The lines of all frames, without lines of length 0.
    """
    # Each list begins with an empty entry, so that it can be concatenated without any line.
    points = [np.zeros((0, 2))]
    variances = [np.zeros(0)]
    frames = [np.zeros(0, np.int64)]
    scores = [np.zeros(0)]
    counts = [0]  # the cumulative sum of the counts gives the offsets, which begin with 0
    for frame_index, frame in enumerate(drive.frames):
        elements = frame.elements
        vertex_variances = config.variances(frame)  # across the line, for all vertices of a frame
        for index in frame.predictions_of(label).tolist():
            vertices = slice(elements.offsets[index], elements.offsets[index + 1])
            line = elements.points[vertices]
            along = arc_lengths(line)
            if along[-1] == 0.0:
                continue
            dense_line, positions = sample_line(line)
            points.append(dense_line)
            variances.append(np.interp(positions, along, vertex_variances[vertices]))
            frames.append(np.full(len(positions), frame_index))
            scores.append(np.full(len(positions), elements.confidence[index]))
            counts.append(len(positions))
    all_scores = np.concatenate(scores)
    return DenseLines(
        points=np.concatenate(points),
        offsets=np.cumsum(counts),
        frames=np.concatenate(frames),
        scores=all_scores,
        weights=all_scores / np.concatenate(variances),
    )


def normals_of(lines: DenseLines) -> FloatArray:
    """Unit vector to the left of the line at each vertex. (M, 2)"""
    vertices = np.arange(len(lines.points))
    # An end of a line has only one neighbour. The end itself takes the place of the other one.
    following = vertices + 1
    following[lines.offsets[1:] - 1] -= 1
    previous = vertices - 1
    previous[lines.offsets[:-1]] += 1
    along = lines.points[following] - lines.points[previous]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    # The limit prevents a division by 0 where the neighbours of a vertex coincide.
    return left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)


def match_vertices(
    lines: DenseLines, normals: FloatArray, queries: IntArray | None = None
) -> Matches:
    """Match each vertex with the nearest line of similar direction in each other frame.

    A match is rejected if the frame of the vertex has another line on the side of the match, at
    less than twice the distance of the match. Lines of one frame belong to different objects, so
    the match could belong to this other line.

    Args:
        lines: Lines of all frames.
        normals: Unit vector to the left of the line at each vertex. (M, 2)
        queries: Indices of the vertices to match, in ascending order; by default all. (Q,)

    Returns:
        At most one match per vertex and frame, ordered by vertex.

    Raises:
        InputError: If too many pairs of a vertex and a segment are near each other.
    """
    points = lines.points
    starts = points[lines.segment_starts]
    ends = points[lines.segment_starts + 1]
    tree = shapely.STRtree(_boxes(np.minimum(starts, ends), np.maximum(starts, ends)))
    if queries is None:
        queries = np.arange(len(points))
    num_frames = len(np.unique(lines.frames))
    num_pairs_left = max(_MOST_PAIRS, _MOST_PAIRS_PER_FRAME * num_frames * len(points))
    # The normal of a vertex is searched up to REACH_M on both sides. The bounding box of this
    # segment extends by ``reach`` to both sides of the vertex. (M, 2)
    reach = np.abs(REACH_M * normals)
    chunks = []
    for start in range(0, max(len(queries), 1), _CHUNK_SIZE):  # without queries: one empty chunk
        chunk = queries[start : start + _CHUNK_SIZE]
        boxes = _boxes(points[chunk] - reach[chunk], points[chunk] + reach[chunk])
        # Pairs of a vertex of the chunk and a segment whose boxes intersect, as indices into
        # `boxes` and into `lines.segment_starts`.
        box_indices, segment_indices = tree.query(boxes)
        num_pairs_left -= len(box_indices)
        if num_pairs_left < 0:
            raise InputError(
                f"the lines of one class lie too close together: more than {_MOST_PAIRS:.0e} pairs "
                f"of a vertex and a segment are within {REACH_M:g} m, and more than "
                f"{_MOST_PAIRS_PER_FRAME} for each of the {len(points)} vertices and each frame; "
                "raise --score-thr."
            )
        candidates = _match_pairs(
            lines,
            normals,
            vertices=chunk[box_indices],
            segments=lines.segment_starts[segment_indices],
        )
        chunks.append(_select_matches(lines, candidates))
    return _concatenate(chunks)


def _concatenate(chunks: list[Matches]) -> Matches:
    """Concatenate matches."""
    vertices = []
    segments = []
    distances = []
    for chunk in chunks:
        vertices.append(chunk.vertices)
        segments.append(chunk.segments)
        distances.append(chunk.distances)
    return Matches(
        vertices=np.concatenate(vertices),
        segments=np.concatenate(segments),
        distances=np.concatenate(distances),
    )


def _boxes(low: FloatArray, high: FloatArray) -> np.ndarray:
    """Axis-aligned rectangles as polygons, from two opposite corners. (n, 2), (n, 2) -> (n,)"""
    return shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])


def _match_pairs(
    lines: DenseLines, normals: FloatArray, vertices: IntArray, segments: IntArray
) -> Matches:
    """Match vertices with segments that cross their normals at about a right angle.

    Args:
        lines: Lines of all frames.
        normals: Unit vector to the left of the line at each vertex. (M, 2)
        vertices: Index of the vertex of each pair. (pairs,)
        segments: Index of the first vertex of the segment of each pair. (pairs,)

    Returns:
        Matches between different lines, which may belong to one frame, in the order of the pairs.
    """
    differ = lines.line_indices[vertices] != lines.line_indices[segments]
    vertices = vertices[differ]
    segments = segments[differ]
    normal = normals[vertices]
    vertex = lines.points[vertices]
    start = lines.points[segments] - vertex
    end = lines.points[segments + 1] - vertex
    # Components across the normal, that is along the line of the vertex, in metres. A segment
    # crosses the normal where this component is 0.
    start_along = start[:, 1] * normal[:, 0] - start[:, 0] * normal[:, 1]
    end_along = end[:, 1] * normal[:, 0] - end[:, 0] * normal[:, 1]
    extent = end_along - start_along
    # Position of the crossing on the segment, from 0 (start) to 1 (end). A segment that is parallel
    # to the normal has extent 0. Its position is set to 0, and `is_aligned` then rejects it.
    fraction = -start_along / np.where(extent == 0.0, np.inf, extent)
    distances = (normal * (start + fraction[:, None] * (end - start))).sum(axis=1)
    lengths = np.linalg.norm(end - start, axis=1)
    crosses = start_along * end_along <= 0.0  # the ends lie on both sides of the normal
    # Lines may have opposite directions, because the direction of a predicted line is arbitrary.
    is_aligned = np.abs(extent) > np.cos(np.radians(_MAX_TURN_DEG)) * lengths
    is_near = np.abs(distances) <= REACH_M
    return Matches(vertices, segments, distances).select(crosses & is_aligned & is_near)


def _select_matches(lines: DenseLines, candidates: Matches) -> Matches:
    """Select the nearest match of each vertex in each other frame, ordered by vertex and frame.

    A candidate in the frame of the vertex is a rival: another line of the same frame, on one side
    of the vertex. Matches on this side beyond half the distance of the nearest rival are dropped.

    Args:
        lines: Lines of all frames.
        candidates: Matches of some vertices, including matches within one frame.
    """
    vertices = candidates.vertices
    in_one_frame = lines.frames[vertices] == lines.frames[candidates.segments]
    is_selected = ~in_one_frame
    distinct, rows = np.unique(vertices, return_inverse=True)  # vertices[i] is distinct[rows[i]]
    for side in (1.0, -1.0):  # left and right
        distances = side * candidates.distances
        is_rival = in_one_frame & (distances >= 0.0)  # at distance 0: a rival on both sides
        nearest_rival_m = np.full(len(distinct), np.inf)
        np.minimum.at(nearest_rival_m, rows[is_rival], distances[is_rival])
        # Candidates on the other side have negative distances here, and stay.
        is_selected &= distances <= nearest_rival_m[rows] / 2.0
    matches = candidates.select(is_selected)
    frames = lines.frames[matches.segments]
    # Matches are sorted by vertex, then by frame, distance and segment. For each vertex and frame,
    # only the first one is kept, which is the nearest.
    order = np.lexsort((matches.segments, np.abs(matches.distances), frames, matches.vertices))
    matches = matches.select(order)
    # The first match is always kept, because no vertex has the index -1.
    is_new_vertex = np.diff(matches.vertices, prepend=-1) != 0
    is_new_frame = np.diff(frames[order], prepend=-1) != 0
    return matches.select(is_new_vertex | is_new_frame)


def dense_elements(elements: MapElements, label: int) -> DenseLines:
    """Sample the lines of one class of a map as one frame, with vertices at most ``STEP_M`` apart.

    Args:
        elements: Map in the global frame.
        label: Index of the class.

    Returns:
        The lines without lines of length 0. All weights are 1, and the index of the frame is 0.
    """
    # As in `dense_predictions`, the lists begin with an empty entry.
    points = [np.zeros((0, 2))]
    scores = [np.zeros(0)]
    counts = [0]
    for line, _, score in elements.select(elements.labels == label).rows:
        if len(line) > 1 and arc_lengths(line[:, :2])[-1] > 0.0:
            vertices, _ = sample_line(line[:, :2])
            points.append(vertices)
            scores.append(np.full(len(vertices), score))
            counts.append(len(vertices))
    all_points = np.concatenate(points)
    return DenseLines(
        points=all_points,
        offsets=np.cumsum(counts),
        frames=np.zeros(len(all_points), dtype=np.int64),
        scores=np.concatenate(scores),
        weights=np.ones(len(all_points)),
    )


def join_lines(parts: Sequence[DenseLines]) -> DenseLines:
    """Join lines of different frames.

    Args:
        parts: Groups of lines. The frame indices of each part are shifted, so that they follow the
            frame indices of the previous part.
    """
    # The empty entries allow a concatenation without groups.
    points = [np.zeros((0, 2))]
    frames = [np.zeros(0, np.int64)]
    scores = [np.zeros(0)]
    weights = [np.zeros(0)]
    counts = [np.zeros(1, np.int64)]  # their cumulative sum, the offsets, begins with 0
    num_frames = 0
    for part in parts:
        points.append(part.points)
        frames.append(part.frames + num_frames)
        scores.append(part.scores)
        weights.append(part.weights)
        counts.append(np.diff(part.offsets))
        num_frames += int(part.frames.max(initial=-1)) + 1  # adds 0 for a group without lines
    return DenseLines(
        points=np.concatenate(points),
        offsets=np.cumsum(np.concatenate(counts)),
        frames=np.concatenate(frames),
        scores=np.concatenate(scores),
        weights=np.concatenate(weights),
    )
