"""Changes of the lines of one class between an old map and later drives (passes).

Lines are sampled densely (`DenseLines`), so that a change can be a part of a line. A part is a
slice of the vertices of one line. A vertex of an old line is matched with the nearest line of
similar direction in every other frame; its distance from this line is its shift in the frame.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from drivemaps.change import (
    ADDED,
    MIN_VIEWS,
    MOVED,
    REMOVED,
    Change,
    Pass,
    Shift,
    near_lines,
    on_known_ground,
    smooth_share,
    views_of_passes,
)
from drivemaps.config import MergeConfig
from drivemaps.line_matching import (
    REACH_M,
    DenseLines,
    Matches,
    dense_elements,
    dense_predictions,
    join_lines,
    match_vertices,
    normals_of,
)
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.structures.polylines import arc_lengths

_MIN_OLD_CONFIDENCE = 0.4  # smallest confidence of an old line that is removed or moved
_MIN_NEW_CONFIDENCE = 0.6  # smallest confidence of a line that is added
_MIN_LENGTH_M = 8.0  # shorter changed parts are ignored, unless they are whole lines
_MIN_MOVE_M = 0.5  # smallest shift of a vertex that counts as a move
_MIN_FRAMES = 3  # smallest number of matched frames that can show that a part has moved
_WINDOW = 5  # number of vertices of the running median along a line


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Evidence of the passes for and against M vertices.

    A pass detects a vertex if its map has a line of the class near the vertex.

    Args:
        views: Number of frames of each pass that have a vertex in range. (passes, M)
        is_seen: Whether a pass detects a vertex. (passes, M)
    """

    views: IntArray
    is_seen: BoolArray

    @classmethod
    def of_points(cls, points: FloatArray, passes: list[Pass], label: int) -> "_Evidence":
        """Collect the evidence of the passes for points (M, 2), with the lines of one class."""
        is_seen = []
        for one_pass in passes:
            elements = one_pass.elements
            lines = elements.select(elements.labels == label).polylines
            is_seen.append(near_lines(points, lines, within_m=REACH_M))
        return cls(views_of_passes(points, passes), is_seen=np.stack(is_seen))

    @property
    def is_in_view(self) -> BoolArray:
        """Whether enough frames of a pass have a vertex in range. (passes, M)"""
        return self.views >= MIN_VIEWS

    @property
    def is_missing(self) -> BoolArray:
        """Whether most passes with a vertex in view do not detect it; False without any. (M,)"""
        num_missing = (self.is_in_view & ~self.is_seen).sum(axis=0)
        return 2 * num_missing > self.is_in_view.sum(axis=0)

    @property
    def is_present(self) -> BoolArray:
        """Whether most passes with a vertex in view detect it; False without any. (M,)"""
        num_seen = (self.is_in_view & self.is_seen).sum(axis=0)
        return 2 * num_seen > self.is_in_view.sum(axis=0)

    def count_passes(self, part: slice, seen: bool) -> tuple[int, int]:
        """Count the passes that have a part of a line in view, and the agreeing passes among them.

        A pass has the part in view if it has more than half of the part's vertices in view. It
        detects the part if it detects more than half of the vertices in view, and misses the part
        if it misses more than half of them.

        Args:
            part: Slice of the n vertices of the part.
            seen: If True, passes that detect the part agree. If False, passes that miss it agree.

        Returns:
            Number of passes that have the part in view, and number of agreeing passes.
        """
        in_view = self.is_in_view[:, part]  # (passes, n)
        num_in_view = in_view.sum(axis=1)
        # Vertices in view that a pass detects if ``seen`` is True, or else misses.
        num_agreeing = (in_view & (self.is_seen[:, part] == seen)).sum(axis=1)
        num_vertices = in_view.shape[1]
        has_part = 2 * num_in_view > num_vertices
        agrees = has_part & (2 * num_agreeing > num_in_view)
        return int(has_part.sum()), int(agrees.sum())


def line_changes(
    old: MapElements, passes: list[Pass], label: int, config: MergeConfig
) -> list[Change]:
    """Find the changes of the lines of one class.

    A line of low confidence is not reported as a change. Its only use is as evidence that a line
    near it is not new, or has not been removed.

    Args:
        old: Old map in the global frame.
        passes: Drives past the place.
        label: Index of the class.
        config: Parameters of merging, for the variances of predictions.

    Returns:
        Removed, moved and added parts of lines.
    """
    lines = dense_elements(old.select(old.confidence >= _MIN_OLD_CONFIDENCE), label)
    if not len(lines.points):
        return _added(old, passes, label)
    predictions = [dense_predictions(one_pass.drive, label, config) for one_pass in passes]
    # Joined lines keep their frames apart; the old lines count as one frame. They come first, so
    # their vertices have the indices 0 to `num_old` - 1.
    joined = join_lines([lines, *predictions])
    normals = normals_of(joined)
    num_old = len(lines.points)
    matches = match_vertices(joined, normals, queries=np.arange(num_old))
    evidence = _Evidence.of_points(lines.points, passes, label)
    # The support of an old vertex is the sum of the scores of the predictions that match it.
    scores = joined.scores[matches.segments]
    support = np.bincount(matches.vertices, scores, minlength=num_old)
    changes = []
    views = evidence.views.sum(axis=0)
    for part in _parts(lines, evidence.is_missing):
        in_view, num_agreeing = evidence.count_passes(part, seen=False)
        if not num_agreeing:
            continue
        # Mean number of frames in which a vertex of the part is in range and not detected. A frame
        # with a match of score s counts as 1 - s such frames.
        num_without = float((views - support)[part].mean())
        old_score = float(lines.scores[part].mean())
        change = Change(
            REMOVED,
            label,
            line=lines.points[part],
            confidence=old_score * smooth_share(num_without, float(views[part].mean())),
            passes_in_view=in_view,
            num_passes=num_agreeing,
        )
        changes.append(change)
    lines_of_passes = [dense_elements(one_pass.elements, label) for one_pass in passes]
    maps = join_lines([lines, *lines_of_passes])
    moves = _Moves(
        maps=maps,
        map_matches=match_vertices(maps, normals_of(maps), queries=np.arange(num_old)),
        frames=joined,
        frame_matches=matches,
    )
    changes += _moved(lines, normals[:num_old], moves=moves, evidence=evidence, label=label)
    return changes + _added(old, passes, label)


@dataclass(frozen=True, eq=False)
class _Moves:
    """Distances of new lines from the vertices of old lines, in metres, positive to the left.

    The distances are measured in the maps of the passes, which are more accurate than single
    frames. The errors of the distances are estimated from the frames.

    Args:
        maps: Old lines, followed by the lines of the maps of the passes.
        map_matches: Matches of the old vertices with the maps, at most one per vertex and pass.
        frames: Old lines, followed by the predicted lines of all frames.
        frame_matches: Matches of the old vertices with the predictions.
    """

    maps: DenseLines
    map_matches: Matches
    frames: DenseLines
    frame_matches: Matches

    def shifts(self, num_vertices: int) -> FloatArray:
        """Mean distance at each old vertex over the passes; 0 without a match. (M,)"""
        matches = self.map_matches
        totals = np.bincount(matches.vertices, matches.distances, minlength=num_vertices)
        counts = np.bincount(matches.vertices, minlength=num_vertices)
        return totals / np.maximum(counts, 1)

    def shift_of(self, part: slice) -> Shift | None:
        """Mean distance over a part of an old line, and its error; None if too few frames match."""
        # In `maps`, the map of a pass is one frame, so the result has one entry per pass.
        by_pass = _by_frame(self.maps, _within(self.map_matches, part))
        by_frame = _by_frame(self.frames, _within(self.frame_matches, part))
        if len(by_frame.distances) < _MIN_FRAMES:
            return None
        frame_shift = Shift.of_frames(
            by_frame.distances, variances=by_frame.variances, weights=by_frame.weights
        )
        return Shift(float(by_pass.distances.mean()), std_m=frame_shift.std_m)


class _FrameDistances(NamedTuple):
    """Distances of new lines from a part of an old line, in F frames.

    Attributes:
        distances: Mean distance in each frame, in metres. (F,)
        variances: Mean variance of the predicted vertices, in square metres. (F,)
        weights: Weight of each frame. (F,)
    """

    distances: FloatArray
    variances: FloatArray
    weights: FloatArray


def _within(matches: Matches, part: slice) -> Matches:
    """Select the matches of the vertices of a part."""
    is_in_part = (matches.vertices >= part.start) & (matches.vertices < part.stop)
    return matches.select(is_in_part)


def _moved(
    lines: DenseLines, normals: FloatArray, moves: _Moves, evidence: _Evidence, label: int
) -> list[Change]:
    """Find parts of the old lines that moved across their direction.

    Args:
        lines: Old lines, with M vertices in all.
        normals: Unit vector to the left of each vertex of the old lines. (M, 2)
        moves: Distances of the new lines.
        evidence: Evidence of the passes for the vertices of the old lines.
        label: Index of the class.

    Returns:
        Changes of the parts whose shift is at least 0.5 m and significant (`Shift.exceeds`).
    """
    num_old = len(normals)
    # The shift of a vertex is its mean distance over the passes, smoothed along its line.
    shifts = moves.shifts(num_old)
    for start, end in zip(lines.offsets[:-1], lines.offsets[1:], strict=True):
        shifts[start:end] = median_filter(shifts[start:end], _WINDOW, mode="nearest")
    matches = moves.frame_matches
    scores = moves.frames.scores[matches.segments]
    support = np.bincount(matches.vertices, scores, minlength=num_old)
    views = evidence.views.sum(axis=0)
    changes = []
    # Each side is searched alone, so that a part moved to one side only.
    for side in (1.0, -1.0):  # left and right
        has_moved = evidence.is_present & (side * shifts >= _MIN_MOVE_M)
        for part in _parts(lines, has_moved):
            shift = moves.shift_of(part)
            in_view, num_agreeing = evidence.count_passes(part, seen=True)
            if shift is None or not num_agreeing or not shift.exceeds(_MIN_MOVE_M):
                continue
            share = smooth_share(float(support[part].mean()), float(views[part].mean()))
            share *= float(lines.scores[part].mean())  # confidence of the old line
            change = Change(
                MOVED,
                label,
                line=lines.points[part] + shifts[part, None] * normals[part],
                confidence=share * shift.probability(_MIN_MOVE_M),
                passes_in_view=in_view,
                num_passes=num_agreeing,
                moved_m=abs(shift.mean_m),
                moved_std_m=shift.std_m,
            )
            changes.append(change)
    return changes


def _by_frame(joined: DenseLines, matches: Matches) -> _FrameDistances:
    """Average the matches of each frame that has matches.

    The weight of a frame is the number of its matches times mean score over mean variance.
    """
    # `rows` is the index of each match's frame among these frames, and `counts` is the number of
    # matches of each of these frames.
    _, rows = np.unique(joined.frames[matches.segments], return_inverse=True)
    counts = np.bincount(rows)
    scores = joined.scores[matches.segments]
    variances = scores / joined.weights[matches.segments]  # as a weight is score over variance
    mean_variances = np.bincount(rows, variances) / counts
    mean_scores = np.bincount(rows, scores) / counts
    return _FrameDistances(
        np.bincount(rows, matches.distances) / counts,
        variances=mean_variances,
        weights=counts * mean_scores / mean_variances,
    )


def _added(old: MapElements, passes: list[Pass], label: int) -> list[Change]:
    """Find parts of lines in the maps of the passes that the old map does not have."""
    known_lines = old.select(old.labels == label).polylines
    changes = []
    for one_pass in passes:
        elements = one_pass.elements
        is_sure = elements.confidence >= _MIN_NEW_CONFIDENCE
        lines = dense_elements(elements.select(is_sure), label)
        if not len(lines.points):
            continue
        evidence = _Evidence.of_points(lines.points, passes, label)
        is_new = ~near_lines(lines.points, known_lines, within_m=REACH_M)
        # The old map has no information about ground far from all of its elements.
        is_new &= on_known_ground(lines.points, old) & evidence.is_present
        views = evidence.views.sum(axis=0)
        for part in _parts(lines, is_new):
            in_view, num_agreeing = evidence.count_passes(part, seen=True)
            if not num_agreeing:
                continue
            num_views = float(views[part].mean())
            score = float(lines.scores[part].mean())
            # The score is taken as the share of the frames that support the part.
            support = score * num_views
            change = Change(
                ADDED,
                label,
                line=lines.points[part],
                confidence=smooth_share(support, num_views),
                passes_in_view=in_view,
                num_passes=num_agreeing,
            )
            changes.append(change)
            # The line is known from now on, so the next passes do not add it again.
            known_lines = [*known_lines, change.line]
    return changes


def _parts(lines: DenseLines, flags: BoolArray) -> list[slice]:
    """Find the parts of lines in which a flag is set.

    A part has at least two vertices, and is at least 8 m long or a whole line. The flags are
    smoothed along each line by a running median, so that one or two deviating vertices neither
    split a part nor form one.

    Args:
        lines: Lines with M vertices in all.
        flags: Flag of each vertex. (M,)

    Returns:
        Slice of the vertices of each part.
    """
    parts = []
    for start, end in zip(lines.offsets[:-1].tolist(), lines.offsets[1:].tolist(), strict=True):
        smooth = median_filter(flags[start:end], _WINDOW, mode="nearest")
        # Each run of true flags begins and ends with a change of the padded flags, so the changes
        # in pairs are the first vertex of a run and the vertex after its last one.
        flag_changes = np.flatnonzero(np.diff(np.r_[False, smooth, False]))
        runs = start + flag_changes.reshape(-1, 2)
        for first, last in runs.tolist():
            part = slice(first, last)
            is_whole = (first, last) == (start, end)
            if last - first < 2:
                continue
            if is_whole or arc_lengths(lines.points[part])[-1] >= _MIN_LENGTH_M:
                parts.append(part)
    return parts
