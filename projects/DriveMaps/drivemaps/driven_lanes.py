"""Centre lines of the lanes that a vehicle has driven, computed from dividers and boundaries."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from drivemaps.directed_lines import (
    border_distances,
    border_tree,
    line_directions,
    resample,
    rotate_to_left,
)
from gsmap.structures.elements import FloatArray, IntArray

# Smallest and largest width of a lane whose middle is taken as its centre line. The middle of a
# wider lane is interpolated.
_WIDTH_M = (2.0, 5.0)
_MOST_APART_M = 8.0  # largest width of a lane, such as a lane in which cars are parked
_MOST_GAP_M = 30.0  # largest distance between successive positions of one track
_LEAST_STEP_M = 0.5  # a vehicle that moves less between two positions counts as standing
_MOST_CROSSING_M = 50.0  # longest stretch without borders, such as a junction, between two lanes
_LANE_CHANGE_M = 1.0  # the lane changes where its middle moves sideways by more than this in a step
_FILTER = 5  # points of the median filter along the track, which removes short outliers
# Largest distance of a point from a point of an earlier pass through its lane. The points of a pass
# are at most 2 m apart.
_REPEAT_M = 1.5
_MOST_POINTS = 25  # a longer centre line is cut, because the width of the lane varies along it
_LEAST_POINTS = 3  # smallest number of points between two cuts of a centre line
_MIN_PARALLEL_COSINE = 0.7  # smallest cosine between the directions of two passes through one lane
# Kinds of the lane between two successive points of a track.
_OUTSIDE = 0  # no lane, such as where the vehicle changes lanes
_BORDERED = 1  # a lane with a border on each side
_OPEN = 2  # a stretch without borders that joins two lanes, such as a junction


class DrivenLanes(NamedTuple):
    """Lanes along the track of a vehicle.

    Attributes:
        centerlines: Centre lines in the direction of travel, in metres. each (n >= 2, 2)
        driven_m: Length of the track in metres.
        outside_m: Length of the parts of the track that lie in no lane, in metres.
    """

    centerlines: list[FloatArray]
    driven_m: float
    outside_m: float


def driven_lanes(
    positions_of_drives: Iterable[FloatArray], borders: list[FloatArray]
) -> DrivenLanes:
    """Find the lanes along the tracks of a vehicle in one or more drives.

    A lane lies between the nearest border on the left of the vehicle and the nearest one on the
    right. Where these borders are 2 to 5 m apart, the centre line is in the middle between them.
    Where they are 5 to 8 m apart, the distance of the centre line from the track is interpolated
    from the places before and after. A lane begins and ends where the vehicle changes lanes. A
    stretch of at most 50 m without borders, such as a junction, joins the lanes before and after.

    Args:
        positions_of_drives: Positions of the vehicle in each drive, in the order of time, in
            metres. (n, 2) each
        borders: Dividers and boundaries, in metres. each (m, 2)

    Returns:
        The lanes. Stretches with borders and stretches without borders have separate centre lines.
        A lane that is driven twice has one centre line.
    """
    tree = border_tree(borders)
    lanes = []
    for positions in positions_of_drives:
        for track in _tracks(positions):
            lanes.append(_lane_along(track, borders=tree))
    if not lanes:
        return DrivenLanes([], driven_m=0.0, outside_m=0.0)
    earlier_points = _earlier_points(lanes)
    stretches: list[tuple[int, int]] = []  # indices of the first and the last point of each
    driven_m = 0.0
    outside_m = 0.0
    first_point = 0  # index, among the points of all lanes, of the first point of the lane
    for lane in lanes:
        is_lane = lane.kinds != _OUTSIDE
        driven_m += float(lane.steps_m.sum())
        outside_m += float(lane.steps_m[~is_lane].sum())
        end_point = first_point + len(lane.centers)
        is_repeated = earlier_points[first_point:end_point] >= 0
        # A step between two points is new unless both points repeat an earlier pass.
        is_new = ~(is_repeated[:-1] & is_repeated[1:])
        new_kinds = np.where(is_lane & is_new, lane.kinds, _OUTSIDE)
        for start, stop in _runs(new_kinds):
            if new_kinds[start] != _OUTSIDE:
                # Step i leads from point i to point i + 1, so these steps end at point `stop`.
                stretches.append((first_point + start, first_point + stop))
        first_point = end_point
    points = np.concatenate([lane.centers for lane in lanes])
    centerlines = _join_repeats(points, stretches, earlier_points)
    return DrivenLanes(centerlines, driven_m=driven_m, outside_m=outside_m)


class _Lane(NamedTuple):
    """Lane along a track, at points in equal steps.

    Attributes:
        centers: Middle of the lane at each point, in metres. (n, 2)
        steps_m: Distances on the track between successive points, in metres. (n - 1,)
        kinds: Kind of the lane between successive points: ``_OUTSIDE``, ``_BORDERED`` or ``_OPEN``.
            (n - 1,)
    """

    centers: FloatArray
    steps_m: FloatArray
    kinds: IntArray


def _lane_along(track: FloatArray, borders: shapely.STRtree) -> _Lane:
    """Find the lane along a track.

    Args:
        track: Positions of the vehicle in metres. (n >= 2, 2)
        borders: Search tree of the dividers and boundaries, from `border_tree`.
    """
    points = resample(track)  # in equal steps of at most 2 m
    left_m = border_distances(points, side=1, borders=borders, reach_m=_MOST_APART_M)
    right_m = border_distances(points, side=-1, borders=borders, reach_m=_MOST_APART_M)
    apart_m = left_m + right_m  # infinite where a border is missing
    is_bordered = (apart_m >= _WIDTH_M[0]) & (apart_m <= _MOST_APART_M)
    known = np.flatnonzero(is_bordered & (apart_m <= _WIDTH_M[1]))
    # Offsets of the centre line to the left of the track. They are measured at the known points,
    # and interpolated at all other points.
    offsets_m = np.zeros(len(points))
    if len(known):
        known_offsets_m = (left_m[known] - right_m[known]) / 2
        # Before the first and after the last known point, the offset is constant.
        offsets_m = np.interp(np.arange(len(points)), known, known_offsets_m)
    offsets_m = median_filter(offsets_m, size=_FILTER, mode="nearest")
    is_bordered = median_filter(is_bordered, size=_FILTER, mode="nearest")
    to_left = rotate_to_left(line_directions(points))
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    kinds = np.where(is_bordered[:-1], _BORDERED, _OPEN)
    kinds[np.abs(np.diff(offsets_m)) > _LANE_CHANGE_M] = _OUTSIDE
    # Stretches without borders that are long or do not lie between two lanes are no lane.
    for start, stop in _runs(kinds):
        joins_lanes = start > 0 and stop < len(kinds)
        if joins_lanes:
            joins_lanes = kinds[start - 1] == kinds[stop] == _BORDERED
        is_short = steps_m[start:stop].sum() <= _MOST_CROSSING_M
        if kinds[start] == _OPEN and not (joins_lanes and is_short):
            kinds[start:stop] = _OUTSIDE
    centers = points + offsets_m[:, None] * to_left
    return _Lane(centers, steps_m=steps_m, kinds=kinds)


def _tracks(positions: FloatArray) -> list[FloatArray]:
    """Split positions into tracks at large gaps, without positions at a stop. each (n >= 2, 2)"""
    tracks: list[list[FloatArray]] = []
    for position in positions:
        step_m = np.linalg.norm(position - tracks[-1][-1]) if tracks else np.inf
        if step_m > _MOST_GAP_M:
            tracks.append([position])
        elif step_m >= _LEAST_STEP_M:
            tracks[-1].append(position)
    return [np.array(track) for track in tracks if len(track) > 1]


def _earlier_points(lanes: Sequence[_Lane]) -> IntArray:
    """Find the points at which the vehicle has driven through a lane before.

    Args:
        lanes: Lanes in the order in which they were driven.

    Returns:
        For each point of all lanes, the index of the first point that was driven at its place and
        in its direction; -1 if there was no earlier pass. (points,)
    """
    centers = []
    all_directions = []
    in_lane = []
    for lane in lanes:
        centers.append(lane.centers)
        all_directions.append(line_directions(lane.centers))
        # A point is in a lane if the step after it is in a lane. No step follows the last point of
        # a track.
        in_lane.append(np.append(lane.kinds != _OUTSIDE, False))
    points = np.concatenate(centers)
    directions = np.concatenate(all_directions)
    is_in_lane = np.concatenate(in_lane)
    tree = cKDTree(points)
    earlier_points = np.full(len(points), -1)
    for later, neighbours in enumerate(tree.query_ball_point(points, _REPEAT_M)):
        earlier = np.array(neighbours)
        cosines = directions[earlier] @ directions[later]
        is_along = is_in_lane[earlier] & (cosines > _MIN_PARALLEL_COSINE)
        # The last `_FILTER` points before a point belong to the current pass.
        is_earlier_pass = earlier < later - _FILTER
        earlier = earlier[is_along & is_earlier_pass]
        if len(earlier):
            distances_m = np.linalg.norm(points[earlier] - points[later], axis=1)
            nearest = earlier[distances_m.argmin()]
            # The nearest point may itself repeat a pass. Then the point of the first pass is used.
            first = earlier_points[nearest]
            earlier_points[later] = nearest if first < 0 else first
    return earlier_points


def _join_repeats(
    points: FloatArray, stretches: Sequence[tuple[int, int]], earlier_points: IntArray
) -> list[FloatArray]:
    """Build the centre lines of stretches, joined to the earlier stretches that they meet.

    Args:
        points: Points of all lanes, in metres. (n, 2)
        stretches: Indices of the first and the last point of each stretch, in ascending order.
        earlier_points: First point driven at the place of each point; -1 if there is none. (n,)

    Returns:
        Centre lines. A stretch is cut where another stretch meets it, and after each 25 points.
        each (n, 2)
    """
    joints = _joints(stretches, earlier_points)
    joined_points = sorted(set(joints.values()))
    centerlines = []
    for first, last in stretches:
        # Points at which other stretches meet this one.
        inner_points = slice(bisect_right(joined_points, first), bisect_left(joined_points, last))
        meetings = [first, *joined_points[inner_points], last]
        cuts = list(meetings)
        for start, stop in pairwise(meetings):
            # No piece at the end has fewer points than _LEAST_POINTS.
            cuts += range(start + _MOST_POINTS, stop - _LEAST_POINTS, _MOST_POINTS)
        for start, stop in pairwise(sorted(cuts)):
            indices = np.arange(start, stop + 1)
            # An end that meets an earlier stretch is replaced by the point of that stretch.
            indices[0] = joints.get(start, start)
            indices[-1] = joints.get(stop, stop)
            centerlines.append(points[indices])
    return centerlines


def _joints(stretches: Sequence[tuple[int, int]], earlier_points: IntArray) -> dict[int, int]:
    """Find the ends of stretches that meet an earlier stretch, and the points where they meet it.

    Args:
        stretches: Indices of the first and the last point of each stretch, in ascending order.
        earlier_points: First point driven at the place of each point; -1 if there is none. (n,)

    Returns:
        Point of the earlier stretch, by the point of the end that joins it. A point near an end of
        the earlier stretch is replaced by this end.
    """
    joints = {}
    ends = [point for stretch in stretches for point in stretch]
    last_points = [last for _, last in stretches]
    for end in ends:
        meeting = int(earlier_points[end])  # -1, without an earlier pass, is in no stretch
        # The first stretch that ends at this point or later, if there is one.
        index = bisect_left(last_points, meeting)
        if index == len(stretches) or meeting < stretches[index][0]:
            continue
        first, last = stretches[index]
        if meeting - first < _LEAST_POINTS:
            meeting = first
        elif last - meeting < _LEAST_POINTS:
            meeting = last
        joints[end] = meeting
    return joints


def _runs(values: IntArray) -> list[tuple[int, int]]:
    """Start index and (exclusive) stop index of each run of equal values."""
    changes = np.flatnonzero(np.diff(values)) + 1
    return list(pairwise([0, *changes.tolist(), len(values)]))
