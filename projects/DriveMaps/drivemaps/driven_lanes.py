"""Centre lines of the lanes that a vehicle has driven, between dividers and boundaries."""

from collections.abc import Sequence
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

_WIDTH_M = (2.0, 5.0)  # smallest and largest width of a lane whose middle is known
_MOST_APART_M = 8.0  # largest width of a lane, such as a lane in which cars are parked
_MOST_GAP_M = 30.0  # largest distance of the positions of successive frames of one track
_LEAST_STEP_M = 0.5  # a vehicle that moves less stands still
_MOST_CROSSING_M = 50.0  # longest stretch without borders, such as a junction, between two lanes
_LANE_CHANGE_M = 1.0  # jump of the middle of the lane between two points
_FILTER = 5  # points of the median filter along the track
# Largest distance of a point from a point of an earlier pass through its lane. The points of a pass
# are at most 2 m apart.
_REPEAT_M = 1.5
_MOST_POINTS = 25  # number of points after which a centre line is cut, as the width of lanes varies
_LEAST_POINTS = 3  # smallest number of points between two cuts of a centre line
_MIN_PARALLEL_COSINE = 0.7  # smallest cosine between the directions of two passes through one lane
# The lane between two points of a track has one of these kinds.
_OUTSIDE = 0  # no lane, such as where the vehicle changes lanes
_BORDERED = 1  # a lane with a border on each side
_OPEN = 2  # without borders, between two lanes


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


def driven_lanes(positions: FloatArray, borders: list[FloatArray]) -> DrivenLanes:
    """Find the lanes along the track of a vehicle.

    A lane lies between the nearest border on the left and on the right. Its centre line is their
    middle where they are 2 to 5 m apart. Where they are 5 to 8 m apart, the distance of the centre
    line from the track is interpolated between the places before and after. A lane begins and ends
    where the vehicle changes lanes. A stretch of at most 50 m without borders between two lanes,
    such as a junction, joins them.

    Args:
        positions: Positions of the vehicle in the order of time, in metres. (n, 2)
        borders: Dividers and boundaries, in metres. each (m, 2)

    Returns:
        Centre lines, with a separate line for each stretch with borders and each stretch without
        borders. A lane that is driven twice has one centre line.
    """
    tree = border_tree(borders)
    lanes = [_lane_along(track, tree) for track in _tracks(positions)]
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
        states = np.where(is_lane & is_new, lane.kinds, _OUTSIDE)
        for start, stop in _runs(states):
            if states[start] != _OUTSIDE:
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
        borders: Dividers and boundaries (`border_tree`).
    """
    points = resample(track)
    left_m = border_distances(points, side=1, borders=borders, reach_m=_MOST_APART_M)
    right_m = border_distances(points, side=-1, borders=borders, reach_m=_MOST_APART_M)
    apart_m = left_m + right_m
    is_bordered = (apart_m >= _WIDTH_M[0]) & (apart_m <= _MOST_APART_M)
    known = np.flatnonzero(is_bordered & (apart_m <= _WIDTH_M[1]))
    offsets_m = np.zeros(len(points))
    if len(known):
        known_offsets_m = (left_m[known] - right_m[known]) / 2
        offsets_m = np.interp(np.arange(len(points)), known, known_offsets_m)
    offsets_m = median_filter(offsets_m, size=_FILTER, mode="nearest")
    is_bordered = median_filter(is_bordered, size=_FILTER, mode="nearest")
    to_left = rotate_to_left(line_directions(points))
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    kinds = np.where(is_bordered[:-1], _BORDERED, _OPEN)
    kinds[np.abs(np.diff(offsets_m)) > _LANE_CHANGE_M] = _OUTSIDE
    for start, stop in _runs(kinds):
        joins_lanes = start > 0 and stop < len(kinds)
        if joins_lanes:
            joins_lanes = kinds[start - 1] == kinds[stop] == _BORDERED
        is_short = steps_m[start:stop].sum() <= _MOST_CROSSING_M
        if kinds[start] == _OPEN and not (joins_lanes and is_short):
            kinds[start:stop] = _OUTSIDE
    return _Lane(points + offsets_m[:, None] * to_left, steps_m=steps_m, kinds=kinds)


def _tracks(positions: FloatArray) -> list[FloatArray]:
    """Split positions at large gaps; positions of a standing vehicle are dropped. each (n, 2)"""
    tracks: list[list[FloatArray]] = []
    for position in positions:
        step_m = np.linalg.norm(position - tracks[-1][-1]) if tracks else np.inf
        if step_m > _MOST_GAP_M:
            tracks.append([position])
        elif step_m >= _LEAST_STEP_M:
            tracks[-1].append(position)
    return [np.array(track) for track in tracks if len(track) > 1]


def _earlier_points(lanes: Sequence[_Lane]) -> IntArray:
    """Points of an earlier pass through a lane.

    Args:
        lanes: Lanes in the order in which they were driven.

    Returns:
        Index, among the points of all lanes, of the first point driven at the place and in the
        direction of each point; -1 if there is none. (points,)
    """
    centers = []
    all_directions = []
    in_lane = []
    for lane in lanes:
        centers.append(lane.centers)
        all_directions.append(line_directions(lane.centers))
        # A point is in a lane if the step after it is; the last point of a track has no step.
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
        # The last `_FILTER` points before a point count as the same pass.
        is_earlier_pass = earlier < later - _FILTER
        earlier = earlier[is_along & is_earlier_pass]
        if len(earlier):
            distances_m = np.linalg.norm(points[earlier] - points[later], axis=1)
            nearest = earlier[distances_m.argmin()]
            first = earlier_points[nearest]
            earlier_points[later] = nearest if first < 0 else first
    return earlier_points


def _join_repeats(
    points: FloatArray, stretches: Sequence[tuple[int, int]], earlier_points: IntArray
) -> list[FloatArray]:
    """Join the ends of stretches to the earlier stretches that they meet.

    Args:
        points: Points of all lanes, in metres. (n, 2)
        stretches: Indices of the first and the last point of each stretch.
        earlier_points: First point driven at the place of each point; -1 if there is none. (n,)

    Returns:
        Centre lines of the stretches, which are divided where another one meets them, and after 25
        points. each (n, 2)
    """
    joints = _joints(stretches, earlier_points)
    centerlines = []
    for first, last in stretches:
        meetings = [first, last]  # points at which other stretches meet this one, and its ends
        for point in set(joints.values()):
            if first < point < last:
                meetings.append(point)
        meetings.sort()
        cuts = list(meetings)
        for start, stop in pairwise(meetings):
            cuts += range(start + _MOST_POINTS, stop - _LEAST_POINTS, _MOST_POINTS)
        for start, stop in pairwise(sorted(cuts)):
            indices = np.arange(start, stop + 1)
            indices[0] = joints.get(start, start)
            indices[-1] = joints.get(stop, stop)
            centerlines.append(points[indices])
    return centerlines


def _joints(stretches: Sequence[tuple[int, int]], earlier_points: IntArray) -> dict[int, int]:
    """Find the ends of stretches that meet an earlier stretch.

    Args:
        stretches: Indices of the first and the last point of each stretch.
        earlier_points: First point driven at the place of each point; -1 if there is none. (n,)

    Returns:
        For each of these ends, the point of the earlier stretch that it joins. A point near an end
        of the earlier stretch is replaced by that end.
    """
    joints = {}
    ends = [point for stretch in stretches for point in stretch]
    for end in ends:
        meeting = int(earlier_points[end])
        for first, last in stretches:
            if first <= meeting <= last:
                if meeting - first < _LEAST_POINTS:
                    meeting = first
                elif last - meeting < _LEAST_POINTS:
                    meeting = last
                joints[end] = meeting
                break
    return joints


def _runs(values: IntArray) -> list[tuple[int, int]]:
    """Start and stop index of each run of equal values."""
    changes = np.flatnonzero(np.diff(values)) + 1
    return list(pairwise([0, *changes.tolist(), len(values)]))
