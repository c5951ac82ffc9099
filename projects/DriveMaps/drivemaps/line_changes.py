"""Changes of the lines of one class."""

from dataclasses import dataclass

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

_MIN_LENGTH_M = 8.0  # shorter changed parts are ignored, unless they are whole lines
_MIN_MOVE_M = 0.5  # a vertex has moved if it is shifted by at least this
_MIN_FRAMES = 3  # smallest number of matched frames that can show that a vertex has moved
_WINDOW = 5  # number of vertices of the running median along a line


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Views of M vertices by the passes.

    Args:
        views: Number of frames of each pass that have a vertex in range. (passes, M)
        is_seen: Whether the map of a pass has a line of the class near a vertex. (passes, M)
    """

    views: IntArray
    is_seen: BoolArray

    @classmethod
    def of_points(cls, points: FloatArray, passes: list[Pass], label: int) -> "_Evidence":
        """Collect the views of points (M, 2) by the passes, for a class."""
        is_seen = []
        for one_pass in passes:
            elements = one_pass.elements
            lines = elements.select(elements.labels == label).polylines
            is_seen.append(near_lines(points, lines, within_m=REACH_M))
        return cls(views_of_passes(points, passes), is_seen=np.stack(is_seen))

    @property
    def is_in_view(self) -> BoolArray:
        """Whether a vertex is in view of a pass. (passes, M)"""
        return self.views >= MIN_VIEWS

    @property
    def is_missing(self) -> BoolArray:
        """Whether most passes in view do not see a vertex. (M,)"""
        num_missing = (self.is_in_view & ~self.is_seen).sum(axis=0)
        return 2 * num_missing > self.is_in_view.sum(axis=0)

    @property
    def is_present(self) -> BoolArray:
        """Whether most passes in view see a vertex. (M,)"""
        num_seen = (self.is_in_view & self.is_seen).sum(axis=0)
        return 2 * num_seen > self.is_in_view.sum(axis=0)

    def count_passes(self, part: slice, seen: bool) -> tuple[int, int]:
        """Count the passes that have a part of a line in view, and those that agree on it.

        A pass has the part in view if it has more than half of the vertices in view. It sees the
        part, or misses it, if it sees or misses more than half of the vertices in view.

        Args:
            part: Vertices of the part, n in number.
            seen: True counts the passes that see the part as agreeing, False those that miss it.

        Returns:
            Number of passes that have the part in view, and number of these that agree.
        """
        in_view = self.is_in_view[:, part]  # (passes, n)
        num_in_view = in_view.sum(axis=1)
        num_agreeing = (in_view & (self.is_seen[:, part] == seen)).sum(axis=1)
        num_vertices = in_view.shape[1]
        has_part = 2 * num_in_view > num_vertices
        agrees = has_part & (2 * num_agreeing > num_in_view)
        return int(has_part.sum()), int(agrees.sum())


def line_changes(
    old: MapElements, passes: list[Pass], label: int, config: MergeConfig
) -> list[Change]:
    """Find the changes of the lines of one class.

    Args:
        old: Old map in the global frame.
        passes: Drives past the place.
        label: Index of the class.
        config: Parameters of merging, for the variances of predictions.

    Returns:
        Removed, moved and added parts of lines.
    """
    lines = dense_elements(old, label)
    if not len(lines.points):
        return _added(old, passes, label)
    predictions = [dense_predictions(one_pass.drive, label, config) for one_pass in passes]
    # The old lines come first, so their vertices have the indices up to `num_old`.
    joined = join_lines([lines, *predictions])
    normals = normals_of(joined)
    num_old = len(lines.points)
    matches = match_vertices(joined, normals, queries=np.arange(num_old))
    evidence = _Evidence.of_points(lines.points, passes, label)
    # Sum of the scores of the predictions that match each old vertex.
    scores = joined.scores[matches.segments]
    support = np.bincount(matches.vertices, scores, minlength=num_old)
    changes = []
    views = evidence.views.sum(axis=0)
    for part in _parts(lines, evidence.is_missing):
        in_view, num_passes = evidence.count_passes(part, seen=False)
        if not num_passes:
            continue
        num_without = float((views - support)[part].mean())  # a match counts by its score
        old_score = float(lines.scores[part].mean())
        change = Change(
            REMOVED,
            label,
            line=lines.points[part],
            confidence=old_score * smooth_share(num_without, float(views[part].mean())),
            passes_in_view=in_view,
            num_passes=num_passes,
        )
        changes.append(change)
    changes += _moved(joined, normals[:num_old], matches=matches, evidence=evidence, label=label)
    return changes + _added(old, passes, label)


def _moved(
    joined: DenseLines, normals: FloatArray, matches: Matches, evidence: _Evidence, label: int
) -> list[Change]:
    """Find parts of the old lines that moved across their direction.

    Args:
        joined: The old lines, followed by the lines of all frames.
        normals: Unit vector to the left of each vertex of the old lines. (M, 2)
        matches: Matches of the vertices of the old lines.
        evidence: Views of the vertices of the old lines.
        label: Index of the class.
    """
    num_old = len(normals)
    # Shift of each vertex: weighted mean distance of its matches, smoothed along its line.
    weights = joined.weights[matches.segments]
    total = np.bincount(matches.vertices, weights, minlength=num_old)
    moments = np.bincount(matches.vertices, weights * matches.distances, minlength=num_old)
    num_frames = np.bincount(matches.vertices, minlength=num_old)
    has_frames = num_frames >= _MIN_FRAMES
    shifts = np.where(has_frames, moments / np.where(total > 0, total, 1.0), 0.0)
    old_lines = _first_lines(joined, num_old)
    for start, end in zip(old_lines.offsets[:-1], old_lines.offsets[1:], strict=True):
        shifts[start:end] = median_filter(shifts[start:end], _WINDOW, mode="nearest")
    support = np.bincount(matches.vertices, joined.scores[matches.segments], minlength=num_old)
    views = evidence.views.sum(axis=0)
    changes = []
    for side in (1.0, -1.0):  # left and right
        has_moved = has_frames & evidence.is_present & (side * shifts >= _MIN_MOVE_M)
        for part in _parts(old_lines, has_moved):
            in_part = (matches.vertices >= part.start) & (matches.vertices < part.stop)
            shift = _shift_of(joined, matches.select(in_part))
            in_view, num_passes = evidence.count_passes(part, seen=True)
            if not num_passes or not shift.exceeds(_MIN_MOVE_M):
                continue
            share = smooth_share(float(support[part].mean()), float(views[part].mean()))
            share *= float(old_lines.scores[part].mean())
            change = Change(
                MOVED,
                label,
                line=old_lines.points[part] + shifts[part, None] * normals[part],
                confidence=share * shift.probability(_MIN_MOVE_M),
                passes_in_view=in_view,
                num_passes=num_passes,
                moved_m=abs(shift.mean_m),
                moved_std_m=shift.std_m,
            )
            changes.append(change)
    return changes


def _first_lines(lines: DenseLines, num_vertices: int) -> DenseLines:
    """The first lines, which have ``num_vertices`` vertices in all."""
    last = int(np.searchsorted(lines.offsets, num_vertices))  # number of these lines
    return DenseLines(
        points=lines.points[:num_vertices],
        offsets=lines.offsets[: last + 1],
        frames=lines.frames[:num_vertices],
        scores=lines.scores[:num_vertices],
        weights=lines.weights[:num_vertices],
    )


def _shift_of(joined: DenseLines, matches: Matches) -> Shift:
    """Mean distance of the matches of one part, from the mean of each frame."""
    # `rows` numbers the frames with matches, and `counts` are their numbers of matches.
    _, rows = np.unique(joined.frames[matches.segments], return_inverse=True)
    counts = np.bincount(rows)
    scores = joined.scores[matches.segments]
    variances = scores / joined.weights[matches.segments]  # as a weight is score over variance
    mean_variances = np.bincount(rows, variances) / counts
    mean_scores = np.bincount(rows, scores) / counts
    return Shift.of_frames(
        np.bincount(rows, matches.distances) / counts,
        variances=mean_variances,
        weights=counts * mean_scores / mean_variances,
    )


def _added(old: MapElements, passes: list[Pass], label: int) -> list[Change]:
    """Find parts of lines in the maps of the passes that the old map does not have."""
    known_lines = old.select(old.labels == label).polylines
    changes = []
    for one_pass in passes:
        lines = dense_elements(one_pass.elements, label)
        if not len(lines.points):
            continue
        evidence = _Evidence.of_points(lines.points, passes, label)
        is_new = ~near_lines(lines.points, known_lines, within_m=REACH_M)
        is_new &= on_known_ground(lines.points, old) & evidence.is_present
        views = evidence.views.sum(axis=0)
        for part in _parts(lines, is_new):
            in_view, num_passes = evidence.count_passes(part, seen=True)
            if not num_passes:
                continue
            num_views = float(views[part].mean())
            score = float(lines.scores[part].mean())
            change = Change(
                ADDED,
                label,
                line=lines.points[part],
                confidence=smooth_share(score * num_views, num_views),
                passes_in_view=in_view,
                num_passes=num_passes,
            )
            changes.append(change)
            known_lines = [*known_lines, change.line]  # so the next passes do not add it again
    return changes


def _parts(lines: DenseLines, flags: BoolArray) -> list[slice]:
    """Find the parts of lines whose vertices have a flag.

    A part is at least 8 m long, or a whole line. The flags are smoothed along a line by a running
    median, so that one or two deviating vertices neither interrupt a part nor make one.

    Args:
        lines: Lines. M vertices
        flags: Flag of each vertex. (M,)
    """
    parts = []
    for start, end in zip(lines.offsets[:-1].tolist(), lines.offsets[1:].tolist(), strict=True):
        smooth = median_filter(flags[start:end], _WINDOW, mode="nearest")
        # Each run of true flags begins and ends with a change of the padded flags.
        changes = np.flatnonzero(np.diff(np.r_[False, smooth, False]))
        runs = start + changes.reshape(-1, 2)
        for first, last in runs.tolist():
            part = slice(first, last)
            is_whole = (first, last) == (start, end)
            if last - first < 2:
                continue
            if is_whole or arc_lengths(lines.points[part])[-1] >= _MIN_LENGTH_M:
                parts.append(part)
    return parts
