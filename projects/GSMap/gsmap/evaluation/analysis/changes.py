"""Precision and recall of found map changes, and grouping of samples by changes in their range."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis.change_files import KINDS, STEP_M, MapChange
from gsmap.evaluation.core.report import UNDEFINED
from gsmap.structures.elements import BoolArray, FloatArray, IntArray
from gsmap.structures.polylines import is_closed
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError

NEAR_M = 1.5
"""Largest distance in metres between a found and a true change that match. It is the loosest
threshold of AP_chamfer."""
MIN_VIEWS = 5
"""A point of a change is in view if it is in the range of at least this number of samples."""
SHORTEST_M = 5.0
"""A changed line must be found if at least this length of it, in metres, is in view."""
WANTED_RECALL = 0.6
"""Recall at which the precision is reported."""
CHANGED = "changed"
UNCHANGED = "unchanged"


@dataclass(frozen=True, eq=False)
class Views:
    """Poses of the samples of one map, and the range that each sample covers.

    Attributes:
        frame_from_global: Transforms from the global frame to the annotation frames of the S
            samples, in metres, without height, roll and pitch. (S, 4, 4)
        x_range: Smallest and largest x of the range in the annotation frame, in metres.
        y_range: Smallest and largest y of the range in the annotation frame, in metres.
    """

    frame_from_global: FloatArray
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def contains(self, sample: int, points: FloatArray) -> BoolArray:
        """Find the points in the range of a sample. Heights are ignored.

        Args:
            sample: Index of the sample.
            points: Points in the global frame, in metres. (n, 2)

        Returns:
            True for points in range. (n,)
        """
        transform = self.frame_from_global[sample]
        x, y = (points @ transform[:2, :2].T + transform[:2, 3]).T
        is_in_x = (x >= self.x_range[0]) & (x <= self.x_range[1])
        is_in_y = (y >= self.y_range[0]) & (y <= self.y_range[1])
        return is_in_x & is_in_y

    def count(self, points: FloatArray) -> IntArray:
        """Count the samples that have each point in range. (n, 2) -> (n,)"""
        counts = np.zeros(len(points), dtype=np.int64)
        for sample in range(len(self.frame_from_global)):
            counts += self.contains(sample, points)
        return counts


def views_by_map(annotations: AnnotationFile) -> dict[str, Views]:
    """Collect the views of the samples of an annotation file, by the name of their map.

    The samples of a map are in the order of the file.

    Raises:
        ValueError: If the poses of the samples are not known.
    """
    if not annotations.meta.has_poses:
        raise InputError(f"{annotations.path} knows no poses, which changes need.")
    poses: dict[str, list[FloatArray]] = {}
    for sample in annotations:
        poses.setdefault(sample.map_name, []).append(level_pose(sample.global_from_frame))
    meta = annotations.meta
    views = {}
    for name, global_from_frame in poses.items():
        frame_from_global = invert_rigid(np.array(global_from_frame))
        views[name] = Views(frame_from_global, meta.x_range, y_range=meta.y_range)
    return views


def level_pose(pose: FloatArray) -> FloatArray:
    """Remove height, roll and pitch from a pose, since changes are 2D. (4, 4) -> (4, 4)"""
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    level = np.eye(4)
    level[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    level[:2, 3] = pose[:2, 3]
    return level


def with_map_names(
    changes: Iterable[MapChange], map_names: Sequence[str], where: str
) -> list[MapChange]:
    """Set the map of changes without the name of a map, if there is only one map.

    Args:
        changes: Changes of a file. The name of the map is empty if the file does not contain it.
        map_names: Names of the maps of the annotation file.
        where: Name of the file of changes, for the message.

    Returns:
        All changes, in their order.

    Raises:
        ValueError: If a change has no name of a map and there are several maps, or none.
    """
    named = []
    for change in changes:
        if not change.map_name:
            if len(map_names) != 1:
                raise InputError(
                    f"{where} has changes without the property `map`, and the annotation file has "
                    f"{len(map_names)} maps: name one for each change."
                )
            change = replace(change, map_name=map_names[0])
        named.append(change)
    return named


def changed_samples(changes: Sequence[MapChange], annotations: AnnotationFile) -> dict[str, str]:
    """Group samples by whether a change lies in their range.

    Args:
        changes: True changes.
        annotations: The samples.

    Returns:
        ``"changed"`` or ``"unchanged"`` for each sample, by token.

    Raises:
        ValueError: If a change does not name its map, and the samples are on several maps.
    """
    views = views_by_map(annotations)
    changes = with_map_names(changes, sorted(views), where="the file")
    tokens: dict[str, list[str]] = {}
    names = annotations.column("map_name")
    for token, map_name in zip(annotations.column("token"), names, strict=True):
        tokens.setdefault(map_name, []).append(token)
    group_of = {}
    for map_name, tokens_of_map in tokens.items():
        points = _points_along([change for change in changes if change.map_name == map_name])
        for index, token in enumerate(tokens_of_map):  # the views have this order, too
            is_changed = views[map_name].contains(index, points).any()
            group_of[token] = CHANGED if is_changed else UNCHANGED
    return group_of


def _points_along(changes: Sequence[MapChange]) -> FloatArray:
    """Points at equal steps (`MapChange.samples`) along old and new places of changes. (M, 2)"""
    points = [np.zeros((0, 2))]  # `np.concatenate` needs an array even without changes
    for change in changes:
        points.append(change.samples())
        if change.old_points is not None:  # a moved element
            points.append(replace(change, points=change.old_points).samples())
    return np.concatenate(points)


def change_figures(
    found: Sequence[MapChange],
    truth: Sequence[MapChange],
    annotations: AnnotationFile,
    found_file: str | Path = "the file of found changes",
) -> dict[str, float]:
    """Compute precision and recall of changes.

    Precision is the share of the found changes that are correct. A found change is correct if at
    least half of its length lies within `NEAR_M` of true changes of equal map, class and kind. For
    this, all true changes count, in view or not.

    Recall is the share of the true changes in view that are found. A true change is in view if at
    least `SHORTEST_M` of a line, or half of the outline of an area, is in the range of at least
    `MIN_VIEWS` samples. It is found if at least half of its length in view lies within `NEAR_M` of
    found changes of equal map, class and kind.

    Args:
        found: Changes found by a model.
        truth: All true changes.
        annotations: Samples of the drives in which the changes were found.
        found_file: File of the found changes, for messages.

    Returns:
        Figures by key, such as ``added/precision``. ``precision`` and ``recall`` exist for the
        changes of each kind, and for the changes of all kinds together (``all``). In both cases,
        the kinds of a found and a true change must be equal. For ``any_kind``, they need not be
        equal, and a found change is also correct at the old place of a moved element. All are -1 if
        there is no change to count. ``num_found`` and ``num_true`` are the numbers of found changes
        and of true changes in view, of each kind and of all kinds. The largest precision over all
        confidence thresholds with a recall of at least 0.6 is ``all/precision_at_recall_0.6``. It
        is -1 if there is no such threshold.

    Raises:
        ValueError: If the map of a found change is unknown, or if a change does not name its map
            and the samples are on several maps.
    """
    views = views_by_map(annotations)
    found = with_map_names(found, sorted(views), where=str(found_file))
    truth = with_map_names(truth, sorted(views), where="the file of true changes")
    unknown = sorted({change.map_name for change in found} - views.keys())
    if unknown:
        raise InputError(
            f"{found_file} has a change on the map {unknown[0]!r}, and the samples are on "
            f"{sorted(views)!r:.200}: give the annotation file of its drives."
        )
    targets = _targets(truth, views)  # the true changes in view, which must be found
    strict = _Comparison.from_changes(found, truth, targets=targets, same_kind=True)
    loose = _Comparison.from_changes(found, truth, targets=targets, same_kind=False)
    figures: dict[str, float] = {}
    for kind in (*KINDS, "all"):
        is_found_kind = _has_kind(found, kind)
        is_true_kind = _has_kind(list(targets), kind)
        figures[f"{kind}/precision"] = _share(strict.hits[is_found_kind])
        figures[f"{kind}/recall"] = _share(strict.limits[is_true_kind] >= 0)
        figures[f"{kind}/num_found"] = float(is_found_kind.sum())
        figures[f"{kind}/num_true"] = float(is_true_kind.sum())
    best_precision = UNDEFINED  # -1
    for threshold in np.unique(strict.confidences):
        recall = _share(strict.limits >= threshold)
        if recall >= WANTED_RECALL:
            precision = _share(strict.hits[strict.confidences >= threshold])
            best_precision = max(best_precision, precision)
    figures[f"all/precision_at_recall_{WANTED_RECALL}"] = best_precision
    figures["any_kind/precision"] = _share(loose.hits)
    figures["any_kind/recall"] = _share(loose.limits >= 0)
    return figures


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Matches of F found changes and T targets, the true changes in view that must be found.

    Attributes:
        hits: Whether each found change is correct. (F,)
        confidences: Confidence of each found change. (F,)
        limits: Largest confidence threshold at which each target is found, where found changes
            below the threshold do not count; -1 if the target is not found. (T,)
    """

    hits: BoolArray
    confidences: FloatArray
    limits: FloatArray

    @classmethod
    def from_changes(
        cls,
        found: Sequence[MapChange],
        truth: Sequence[MapChange],
        targets: Mapping[MapChange, FloatArray],
        same_kind: bool,
    ) -> "_Comparison":
        """Compare found with true changes.

        Args:
            found: Found changes.
            truth: All true changes.
            targets: The true changes that must be found, each with its points in view (M, 2).
            same_kind: Whether kinds must be equal.
        """
        hits = np.zeros(len(found), dtype=np.bool_)
        confidences = np.zeros(len(found))
        for index, change in enumerate(found):
            hits[index] = _is_correct(change, truth, same_kind)
            confidences[index] = change.confidence
        limits = np.zeros(len(targets))
        for index, (target, points) in enumerate(targets.items()):
            limits[index] = _confidence_limit(target, points, found=found, same_kind=same_kind)
        return cls(hits, confidences, limits=limits)


def _has_kind(changes: Sequence[MapChange], kind: str) -> BoolArray:
    """Whether each change is of a kind; ``all`` is every kind. (N,)"""
    return np.array([kind in ("all", change.kind) for change in changes], dtype=np.bool_)


def _share(values: BoolArray) -> float:
    """Share of the values that are True; -1 without values."""
    return float(values.mean()) if len(values) else UNDEFINED


def _targets(truth: Sequence[MapChange], views: Mapping[str, Views]) -> dict[MapChange, FloatArray]:
    """True changes that must be found, each with its points in view (M, 2).

    Changes on maps without samples are left out. `MapChange` is hashed by its identity, so changes
    with equal values are different keys.
    """
    targets = {}
    for change in truth:
        if change.map_name not in views:
            continue
        points = change.samples()  # points at equal steps; none for a change of length 0
        in_view = points[views[change.map_name].count(points) >= MIN_VIEWS]
        # The points are `STEP_M` apart, so lengths are compared as numbers of points.
        least_points = len(points) / 2 if is_closed(change.points) else SHORTEST_M / STEP_M
        if len(in_view) >= max(least_points, 1):
            targets[change] = in_view
    return targets


def _is_correct(change: MapChange, truth: Sequence[MapChange], same_kind: bool) -> bool:
    """Whether at least half of a found change lies near true changes that it may match.

    It is False for a change of length 0, which has no points.
    """
    lines = []
    for other in truth:
        if _may_match(change, other, same_kind):
            lines.append(shapely.LineString(other.points))
            # A moved element may be found as an element that is removed from its old place.
            if not same_kind and other.old_points is not None:
                lines.append(shapely.LineString(other.old_points))
    points = shapely.points(change.samples())
    # Without lines, the union is empty, and no point is near it.
    is_near = shapely.dwithin(points, shapely.union_all(lines), NEAR_M)
    return bool(len(points)) and bool(is_near.mean() >= 0.5)


def _confidence_limit(
    target: MapChange, in_view: FloatArray, found: Sequence[MapChange], same_kind: bool
) -> float:
    """Compute the largest confidence threshold at which a true change is found; -1 if it is not.

    Found changes with a confidence below the threshold do not count.

    Args:
        target: The true change.
        in_view: Points of the true change that are in view. (M, 2)
        found: Found changes.
        same_kind: Whether kinds must be equal.
    """
    points = shapely.points(in_view)
    # Largest confidence of the found changes near each point; -1 if none is near.
    confidences = np.full(len(points), -1.0)
    for change in found:
        if _may_match(target, change, same_kind):
            is_near = shapely.dwithin(points, shapely.LineString(change.points), NEAR_M)
            confidences[is_near] = np.maximum(confidences[is_near], change.confidence)
    # The target is found if at least half of its points are near changes that count. The largest
    # threshold with this property is the confidence of the last of these points, if the points are
    # sorted by falling confidence.
    num_half = (len(confidences) + 1) // 2  # half of the number of points, rounded up
    falling_confidences = np.sort(confidences)[::-1]
    return float(falling_confidences[num_half - 1])


def _may_match(change: MapChange, other: MapChange, same_kind: bool) -> bool:
    """Whether two changes have equal maps and classes and, with ``same_kind``, equal kinds."""
    if (change.map_name, change.class_name) != (other.map_name, other.class_name):
        return False
    return not same_kind or change.kind == other.kind
