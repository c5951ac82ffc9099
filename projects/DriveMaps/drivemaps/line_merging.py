"""Lines of many frames merged into one set of lines.

Each vertex looks across its line for the same line in the other frames and moves to their mean,
weighted by certainty. The lines of one object then lie on each other; the longest well-supported
ones are kept, others add what these do not cover, and ends that meet are joined.
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

_REACH_M = 1.5  # how far across its line a vertex looks for the same line in another frame
_MAX_TURN_DEG = 30.0  # between two lines that may be the same
_STEP_M = 1.0  # largest distance between vertices while lines are merged
_AT_ONCE = 2000  # vertices whose crossings are looked for together; memory grows with them
_ROUNDS = 3  # how many times vertices move to the mean
_MOST_M = 250_000.0  # length of all lines of a class of a drive, beside _MOST_PER_FRAME_M
_MOST_PER_FRAME_M = 5_000.0
_MOST_PAIRS = 2 * 10**7  # of vertices and segments that are near each other
_MOST_PAIRS_PER_FRAME = 16  # of a vertex, where there are more


@dataclass(frozen=True, eq=False)
class _Strands:
    """The lines of one class in all frames, as dense vertices.

    Args:
        points: Vertices of all lines. (M, 2)
        offsets: Line i owns ``offsets[i]:offsets[i + 1]``. (N + 1,)
        frames: Frame of each vertex. (M,)
        scores: Score of its line. (M,)
        weights: Its weight in a mean: score over variance across the line. (M,)
    """

    points: FloatArray
    offsets: IntArray
    frames: IntArray
    scores: FloatArray
    weights: FloatArray

    @cached_property
    def owners(self) -> IntArray:
        """Line of each vertex. (M,)"""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    @cached_property
    def inner(self) -> IntArray:
        """Vertices that a segment starts at. (S,)"""
        return np.setdiff1d(np.arange(len(self.points)), self.offsets[1:] - 1)


@dataclass(frozen=True, eq=False)
class _Crossings:
    """Where the line across a vertex meets the same line in another frame.

    Args:
        vertices: The vertex. (C,)
        segments: First vertex of the segment that is met. (C,)
        distances: How far to the left of the vertex's line that is, in metres. (C,)
        normals: Direction to the left at every vertex. (M, 2)
    """

    vertices: IntArray
    segments: IntArray
    distances: FloatArray
    normals: FloatArray


def merge_lines(drive: Drive, label: int, config: MergeConfig) -> list[tuple[FloatArray, float]]:
    """Merge the lines of one class.

    Args:
        drive: Frames with their predictions.
        label: The class.
        config: Rules.

    Returns:
        Vertices (n, 2) and confidence of each line: the mean over its length of the share of
        frames, of those that see the place, that found it, weighted by their scores.

    Raises:
        InputError: If the lines are longer or lie closer together than those of a drive do.
    """
    _require_moderate_length(drive, label)
    strands = _strands(drive, label, config)
    if not len(strands.points):
        return []
    for _ in range(_ROUNDS):
        strands = _contracted(strands, _crossings(strands))
    crossings = _crossings(strands)
    support = strands.scores + np.bincount(
        crossings.vertices, strands.scores[crossings.segments], len(strands.points)
    )
    share = support / np.maximum(drive.times_seen(strands.points), 1)
    confidence = np.minimum(median_filter(share, 3), 1.0)  # a sharp corner's vertex meets no line
    parts = _uncovered_parts(strands, crossings, confidence, confidence >= config.min_confidence)
    merged = stitch([np.column_stack([strands.points[p], confidence[p]]) for p in parts])
    long = [line for line in merged if arc_lengths(line)[-1] >= MIN_LENGTH_M]
    return [(line[:, :2], float(line[:, 2].mean())) for line in long]


def _require_moderate_length(drive: Drive, label: int) -> None:
    """Refuse lines that take longer to merge than any drive does.

    Raises:
        InputError: If the lines of a class are too long.
    """
    total_m = 0.0
    for frame in drive.frames:
        chosen = frame.elements.select(frame.elements.labels == label)
        total_m += sum(float(arc_lengths(line)[-1]) for line in chosen.polylines)
    most_m = _MOST_M + _MOST_PER_FRAME_M * len(drive.frames)
    if total_m > most_m:
        raise InputError(
            f"drive {drive.scene!r} has {total_m / 1000:.0f} km of {drive.classes[label]!r} in "
            f"{len(drive.frames)} frames: at most {_MOST_M / 1000:g} km and "
            f"{_MOST_PER_FRAME_M / 1000:g} km a frame are merged; raise --score-thr."
        )


def _strands(drive: Drive, label: int, config: MergeConfig) -> _Strands:
    """Gather the lines of one class, with vertices at most a step apart."""
    rows, counts = [np.zeros((0, 5))], [0]
    for number, frame in enumerate(drive.frames):
        elements = frame.elements
        columns = np.column_stack([elements.points, config.variances(frame)])
        for i in np.flatnonzero(elements.labels == label).tolist():
            line = columns[elements.offsets[i] : elements.offsets[i + 1]]
            along = arc_lengths(line)
            if along[-1] == 0.0:
                continue
            stops = np.union1d(along, np.arange(0.0, along[-1], _STEP_M))
            dense = np.stack([np.interp(stops, along, column) for column in line.T], axis=1)
            score = np.full(len(dense), elements.confidence[i])
            rows.append(np.column_stack([dense, np.full(len(dense), number), score]))
            counts.append(len(dense))
    x, y, variance, frames, scores = np.concatenate(rows).T
    return _Strands(
        np.stack([x, y], axis=1),
        np.cumsum(counts),
        frames.astype(np.int64),
        scores,
        scores / variance,
    )


def _normals(strands: _Strands) -> FloatArray:
    """Return the unit vector to the left of the line at every vertex. (M, 2)"""
    after, before = np.arange(len(strands.points)) + 1, np.arange(len(strands.points)) - 1
    after[strands.offsets[1:] - 1] -= 1
    before[strands.offsets[:-1]] += 1
    along = strands.points[after] - strands.points[before]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)


def _crossings(strands: _Strands) -> _Crossings:
    """Find each vertex's line in the other frames.

    In every frame that is the nearest line with about the same direction, unless the vertex's own
    frame has a line that is nearer to it: lines of one frame are different things.
    """
    normals, inner, points = _normals(strands), strands.inner, strands.points
    ends = np.stack([points[inner], points[inner + 1]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    tree = shapely.STRtree(shapely.box(*low.T, *high.T))
    frames = len(np.unique(strands.frames))
    budget = max(_MOST_PAIRS, _MOST_PAIRS_PER_FRAME * frames * len(points))
    found = []
    for start in range(0, len(points), _AT_ONCE):
        chosen = np.arange(start, min(start + _AT_ONCE, len(points)))
        pairs = _near_pairs(chosen, strands, normals, tree)
        budget -= pairs.shape[1]
        if budget < 0:
            raise InputError(
                f"the {len(points)} vertices of lines of one class, at most {_STEP_M:g} m apart, "
                f"lie too close together: more than {_MOST_PAIRS:.0e} pairs, and "
                f"{_MOST_PAIRS_PER_FRAME} of a vertex and frame, are within {_REACH_M:g} m; raise "
                "--score-thr."
            )
        found.append(_crossings_of(chosen, strands, normals, pairs))
    vertices, segments, distances = map(np.concatenate, zip(*found, strict=True))
    return _Crossings(vertices, segments, distances, normals)


def _near_pairs(
    chosen: IntArray, strands: _Strands, normals: FloatArray, tree: shapely.STRtree
) -> IntArray:
    """Find the segments near some vertices: positions in ``chosen`` and in the tree. (2, n)

    Args:
        chosen: The vertices, one after another. (m,)
        strands: The lines.
        normals: Direction to the left at every vertex. (M, 2)
        tree: Boxes of the segments, in the order of ``strands.inner``.
    """
    centres = strands.points[chosen]
    reach = np.abs(_REACH_M * normals[chosen])
    across = shapely.box(*(centres - reach).T, *(centres + reach).T)
    return tree.query(across)


def _crossings_of(
    chosen: IntArray, strands: _Strands, normals: FloatArray, pairs: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return vertices, segments and distances of the crossings of some vertices. (C,) each

    Args:
        chosen: The vertices, one after another. (m,)
        strands: The lines.
        normals: Direction to the left at every vertex. (M, 2)
        pairs: Vertices and segments that are near each other (`_near_pairs`). (2, n)
    """
    points, owners = strands.points, strands.owners
    vertices, segments = chosen[pairs[0]], strands.inner[pairs[1]]
    other = owners[vertices] != owners[segments]
    vertices, segments = vertices[other], segments[other]
    n, here = normals[vertices], points[vertices]
    first, second = points[segments] - here, points[segments + 1] - here
    before, after = (v[:, 1] * n[:, 0] - v[:, 0] * n[:, 1] for v in (first, second))
    step = after - before  # the segment's extent along the vertex's line
    share = -before / np.where(step == 0.0, np.inf, step)
    distances = (n * (first + share[:, None] * (second - first))).sum(axis=1)
    lengths = np.linalg.norm(second - first, axis=1)
    kept = (
        (before * after <= 0.0)
        & (np.abs(step) > np.cos(np.radians(_MAX_TURN_DEG)) * lengths)
        & (np.abs(distances) <= _REACH_M)
    )
    vertices, segments, distances = vertices[kept], segments[kept], distances[kept]
    same_frame = strands.frames[vertices] == strands.frames[segments]
    nearer = _nearer(vertices - chosen[0], distances, same_frame, len(chosen))
    mutual = ~same_frame & nearer
    vertices, segments, distances = vertices[mutual], segments[mutual], distances[mutual]
    order = np.lexsort((segments, np.abs(distances), strands.frames[segments], vertices))
    key = np.stack([vertices, strands.frames[segments]])[:, order]
    new = np.append(True, (key[:, 1:] != key[:, :-1]).any(axis=0))[: len(order)]
    best = order[new]
    return vertices[best], segments[best], distances[best]


def _nearer(
    vertices: IntArray, distances: FloatArray, same_frame: BoolArray, count: int
) -> BoolArray:
    """Whether what is met is nearer to the vertex than to the next lines of its frame. (C,)"""
    limits = []
    for side in (1.0, -1.0):
        limit = np.full(count, np.inf)
        beside = same_frame & (side * distances >= 0.0)
        np.minimum.at(limit, vertices[beside], side * distances[beside])
        limits.append(side * distances <= limit[vertices] / 2.0)
    return limits[0] & limits[1]


def _contracted(strands: _Strands, crossings: _Crossings) -> _Strands:
    """Move every vertex across its line to the weighted mean of its line in all frames."""
    weights, count = strands.weights[crossings.segments], len(strands.points)
    total = strands.weights + np.bincount(crossings.vertices, weights, count)
    shift = np.bincount(crossings.vertices, weights * crossings.distances, count) / total
    return replace(strands, points=strands.points + shift[:, None] * crossings.normals)


def _uncovered_parts(
    strands: _Strands, crossings: _Crossings, confidence: FloatArray, kept: BoolArray
) -> list[slice]:
    """Choose parts of lines that together cover all lines once, the best supported first."""
    owners = strands.owners
    order = np.argsort(owners[crossings.segments], kind="stable")
    segments, vertices = crossings.segments[order], crossings.vertices[order]
    bounds = np.searchsorted(owners[segments], np.arange(len(strands.offsets)))
    support = np.add.reduceat(confidence * kept, strands.offsets[:-1])
    free, chosen = kept.copy(), []
    for i in np.argsort(-support.round(9), kind="stable").tolist():
        begin, end = strands.offsets[i : i + 2].tolist()
        edges = np.flatnonzero(np.diff(np.r_[False, free[begin:end], False])).reshape(-1, 2)
        of_line = slice(bounds[i], bounds[i + 1])
        for a, b in (begin + edges).tolist():
            if arc_lengths(strands.points[a:b])[-1] < JOIN_M:
                continue
            chosen.append(slice(a, b))
            met = (segments[of_line] >= a) & (segments[of_line] < b - 1)
            free[vertices[of_line][met]] = False
    return chosen
