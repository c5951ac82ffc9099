"""Changes of the areas of one class between an old map and new drives.

A pass is one drive past the place, with the map made from it. A view is a frame that has an area in
range. An area is compared with the areas in the maps of the passes, and with the areas that single
frames predict, its detections.
"""

from dataclasses import dataclass, field

import numpy as np
import shapely

from drivemaps.change import (
    ADDED,
    MIN_VIEWS,
    MOVED,
    REMOVED,
    Change,
    Pass,
    Shift,
    on_known_ground,
    smooth_share,
    views_of_passes,
)
from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, DriveFrame
from drivemaps.truth import polygons_of
from gsmap.structures.elements import BoolArray, FloatArray, MapElements

MIN_SHARE_IN_VIEW = 0.8
"""A pass has an area in view if it has at least this part of the outline in view."""
_MIN_OVERLAP = 0.3  # two areas are one object if they share at least this part of the smaller one
_MIN_MOVE_M = 0.75  # an area has moved if its centre is shifted by at least this
_MIN_FRAMES = 3  # smallest number of frames with a detection that can show that an area has moved
_STEP_M = 1.0  # largest distance between successive points of an outline


@dataclass(frozen=True, eq=False)
class _Detections:
    """Areas that a frame predicts.

    Args:
        drive: Drive of the frame.
        frame: The frame.
        areas: Polygons in the global frame.
        scores: Score of each area, in [0, 1].
        variances: Mean variance of the vertices of each area, in square metres.
    """

    drive: Drive
    frame: DriveFrame
    areas: list[shapely.Geometry]
    scores: list[float]
    variances: list[float]


def area_changes(
    old: MapElements, passes: list[Pass], label: int, config: MergeConfig
) -> list[Change]:
    """Find the changes of the areas of one class.

    Args:
        old: Old map in the global frame.
        passes: Drives past the place.
        label: Index of the class.
        config: Parameters of merging, for the variances of predictions.

    Returns:
        Removed and moved areas in the order of the old map, then added areas.
    """
    new_areas = [_areas_of(one_pass.elements, label) for one_pass in passes]
    detections = _detections(passes, label=label, config=config)
    changes = []
    for area, old_score in _scored_areas(old, label):
        outline = _outline(area)
        in_view = _passes_in_view(outline, passes)
        is_seen = _passes_that_have(area, new_areas)
        num_in_view = int(in_view.sum())
        num_missing = int((in_view & ~is_seen).sum())
        views, support, matches = _views_of(outline, area=area, detections=detections)
        # More than half of the passes with the area in view do not have it in their map.
        is_removed = 2 * num_missing > num_in_view
        if is_removed:
            # This is the number of frames that do not show the area. A frame with a detection of
            # score s counts as 1 - s frames without the area. `smooth_share` divides the number by
            # the number of frames with the area in view, and lowers the share if these are few.
            num_without = views - support
            change = Change(
                REMOVED,
                label,
                line=shapely.get_coordinates(area.exterior),
                confidence=old_score * smooth_share(num_without, views),
                passes_in_view=num_in_view,
                num_passes=num_missing,  # passes that agree with the change
            )
            changes.append(change)
        elif num_in_view and len(matches.scores) >= _MIN_FRAMES:
            new_area = _largest_overlap(area, new_areas)
            shift = _shift_of(area, matches)
            # `exceeds` also requires that the shift is large compared to its standard error.
            if new_area is None or not shift.exceeds(_MIN_MOVE_M):
                continue
            share = smooth_share(support, views)  # of the frames that detect the area
            change = Change(
                MOVED,
                label,
                line=shapely.get_coordinates(new_area.exterior),
                confidence=old_score * share * shift.probability(_MIN_MOVE_M),
                passes_in_view=num_in_view,
                num_passes=num_in_view - num_missing,
                moved_m=shift.mean_m,
                moved_std_m=shift.std_m,
            )
            changes.append(change)
    return changes + _added(old, passes, label=label, new_areas=new_areas)


def _added(
    old: MapElements, passes: list[Pass], label: int, new_areas: list[list[shapely.Polygon]]
) -> list[Change]:
    """Find areas in the maps of the passes that the old map does not have.

    Args:
        old: Old map in the global frame.
        passes: Drives past the place.
        label: Index of the class.
        new_areas: Areas of the class in the map of each pass.
    """
    known_areas = _areas_of(old, label)
    changes = []
    for one_pass in passes:
        elements = one_pass.elements.select(one_pass.elements.labels == label)
        for line, _, score in elements.rows:
            # The map of a pass is 2D, so there are no heights to leave out as in `_scored_areas`.
            for area in _polygons([line]):
                outline = _outline(area)
                # The old map gives no information about ground far from all of its elements, so
                # nothing there counts as added.
                if _overlaps(area, known_areas) or not on_known_ground(outline, old).any():
                    continue
                in_view = _passes_in_view(outline, passes)
                is_seen = _passes_that_have(area, new_areas)
                num_seen = int((in_view & is_seen).sum())
                is_present = 2 * num_seen > in_view.sum()  # in more than half of the passes
                if not is_present:
                    continue
                # Number of frames of all passes that have a point of the outline in range, as the
                # mean over the points.
                views_of_points = views_of_passes(outline, passes).sum(axis=0)  # (n,)
                views = float(views_of_points.mean())
                # The score stands for the share of the frames that support the area.
                support = score * views
                change = Change(
                    ADDED,
                    label,
                    line=shapely.get_coordinates(area.exterior),
                    confidence=smooth_share(support, views),
                    passes_in_view=int(in_view.sum()),
                    num_passes=num_seen,
                )
                changes.append(change)
                known_areas.append(area)  # so the next passes do not add it again
    return changes


def _polygons(rings: list[FloatArray]) -> list[shapely.Polygon]:
    """Convert rings to valid polygons, with `polygons_of`.

    A ring that crosses itself becomes several polygons. Rings with a tiny area are left out.
    """
    polygons: list[shapely.Polygon] = shapely.get_parts(polygons_of(rings)).tolist()
    return polygons


def _scored_areas(elements: MapElements, label: int) -> list[tuple[shapely.Polygon, float]]:
    """Areas of one class of a map with their scores."""
    scored = []
    for line, _, score in elements.select(elements.labels == label).rows:
        # An old map may have heights, which are left out.
        for area in _polygons([line[:, :2]]):
            scored.append((area, score))
    return scored


def _areas_of(elements: MapElements, label: int) -> list[shapely.Polygon]:
    """Areas of one class of a map."""
    return [area for area, _ in _scored_areas(elements, label)]


def _outline(area: shapely.Polygon) -> FloatArray:
    """Points of the outline of an area, at most 1 m apart. (n, 2)"""
    return shapely.get_coordinates(shapely.segmentize(area.exterior, _STEP_M))


def _overlaps(area: shapely.Polygon, others: list[shapely.Polygon]) -> bool:
    """Whether an area and any of some others are one object."""
    # The initial value is the maximum if there are no others.
    return bool(_shared_shares(area, others).max(initial=0.0) >= _MIN_OVERLAP)


def _passes_that_have(
    area: shapely.Polygon, areas_of_passes: list[list[shapely.Polygon]]
) -> BoolArray:
    """Whether the map of each pass has an area. (passes,)"""
    return np.array([_overlaps(area, areas) for areas in areas_of_passes])


def _shared_shares(area: shapely.Polygon, others: list[shapely.Polygon]) -> FloatArray:
    """Overlap of an area with each of n others, as a share of the smaller of the two. (n,)"""
    shapes = np.array(others, dtype=object)
    shared_m2 = shapely.area(shapely.intersection(area, shapes))
    smaller_m2 = np.minimum(area.area, shapely.area(shapes))
    shares: FloatArray = shared_m2 / np.maximum(smaller_m2, 1e-9)  # no division by 0
    return shares


def _largest_overlap(
    area: shapely.Polygon, areas_of_passes: list[list[shapely.Polygon]]
) -> shapely.Polygon | None:
    """Find the new area that overlaps most with an old area.

    None if all new areas are other objects, by `_MIN_OVERLAP`.
    """
    best = None
    largest_share = _MIN_OVERLAP
    for areas in areas_of_passes:
        for other, share in zip(areas, _shared_shares(area, areas).tolist(), strict=True):
            if share >= largest_share:
                best = other
                largest_share = share
    return best


def _passes_in_view(outline: FloatArray, passes: list[Pass]) -> BoolArray:
    """Whether each pass has an outline in view. (n, 2) -> (passes,)"""
    is_in_view = views_of_passes(outline, passes) >= MIN_VIEWS
    in_view: BoolArray = is_in_view.mean(axis=1) >= MIN_SHARE_IN_VIEW
    return in_view


def _detections(passes: list[Pass], label: int, config: MergeConfig) -> list[_Detections]:
    """Areas that the frames of all passes predict."""
    detections = []
    for one_pass in passes:
        for frame in one_pass.drive.frames:
            elements = frame.elements
            vertex_variances = config.variances(frame)
            areas = []
            scores = []
            variances = []
            for index in frame.predictions_of(label).tolist():
                vertices = slice(elements.offsets[index], elements.offsets[index + 1])
                # The ring gives one multipolygon, or none if its area is tiny. The parts of a ring
                # that crosses itself are not separated as in `_polygons`, because only overlaps and
                # the centre are used.
                for area in polygons_of([elements.points[vertices]]):
                    areas.append(area)
                    scores.append(float(elements.confidence[index]))
                    variances.append(float(vertex_variances[vertices].mean()))
            entry = _Detections(
                one_pass.drive, frame, areas=areas, scores=scores, variances=variances
            )
            detections.append(entry)
    return detections


@dataclass
class _Matches:
    """Detections of one area, at most one for each frame that has the whole area in range.

    Attributes:
        centres: Centre of each detection in metres. (2,)
        scores: Score of each detection, in [0, 1].
        variances: Variance of each detection in square metres, the mean over its vertices.
    """

    centres: list[FloatArray] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    variances: list[float] = field(default_factory=list)


def _views_of(
    outline: FloatArray, area: shapely.Polygon, detections: list[_Detections]
) -> tuple[float, float, _Matches]:
    """Count the frames that have an area in range, and find the area's detections in them.

    A frame with a part of the outline in range counts as this part of a frame.

    Args:
        outline: Points of the outline. (n, 2)
        area: The area.
        detections: Predicted areas of all frames of the passes.

    Returns:
        Number of frames with the area in range, sum of the scores of the best detection in each of
        these frames, and the detections in the frames with the whole area in range.
    """
    views = 0.0
    support = 0.0
    matches = _Matches()
    for entry in detections:
        share_in_range = float(entry.drive.in_range(entry.frame, outline).mean())
        if share_in_range == 0.0:
            continue
        views += share_in_range
        shares = _shared_shares(area, entry.areas)
        if shares.max(initial=0.0) >= _MIN_OVERLAP:
            best = int(shares.argmax())
            support += share_in_range * entry.scores[best]
            # The centre of a detection is not that of the area if a part of it is out of range.
            if share_in_range == 1.0:
                matches.centres.append(shapely.get_coordinates(entry.areas[best].centroid)[0])
                matches.scores.append(entry.scores[best])
                matches.variances.append(entry.variances[best])
    return views, support, matches


def _shift_of(area: shapely.Polygon, matches: _Matches) -> Shift:
    """Mean shift of the centres of detections from the centre of an area, in metres."""
    centre = shapely.get_coordinates(area.centroid)[0]
    shifts = np.array(matches.centres) - centre  # (F, 2)
    variances = np.array(matches.variances)
    weights = np.array(matches.scores) / variances
    mean = weights @ shifts / weights.sum()  # (2,)
    direction = mean / max(float(np.linalg.norm(mean)), 1e-9)
    # The distance in each frame is the component of its shift along the mean shift. Components
    # across it cancel in the mean.
    return Shift.of_frames(shifts @ direction, variances=variances, weights=weights)
