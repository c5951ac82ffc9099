"""Lanelets: lanes with a left and a right bound, made from centre lines or the track of a drive."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
import shapely.ops
from scipy.spatial import cKDTree

from drivemaps.directed_lines import (
    border_distances,
    border_tree,
    drop_repeats,
    line_directions,
    resample,
    rotate_to_left,
)
from drivemaps.drive import Drive
from drivemaps.driven_lanes import driven_lanes
from drivemaps.truth import components
from gsmap.structures.elements import FloatArray, MapElements

CENTERLINE = "centerline"
"""Class of centre lines."""
BORDERS = ("divider", "boundary")
"""Classes of lines that bound lanes."""
HALF_WIDTH_M = 1.75
"""Distance in metres of a bound from the centre line if there is no border on that side."""
_MOST_HALF_WIDTH_M = 3.0  # a border farther away belongs to another lane
_MIN_HALF_WIDTH_M = 0.5
# Within this distance, ends are one node of the lane graph, and lines lie on top of each other.
_JOIN_M = 1.0
# Lines that are not longer are dropped. A line is not split closer to an end or another split.
_SHORTEST_M = 2.0
_MIN_SUCCESSOR_COSINE = 0.5  # smallest cosine between the directions of successive lanes
_MIN_PARALLEL_COSINE = 0.7  # smallest |cosine| between a map line and a frame's line along it


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A lane in the direction of travel.

    Args:
        left: Vertices of the left bound between its ends, in metres. (n, 2)
        right: Vertices of the right bound between its ends, in metres. (m, 2)
        entry: Index of the node of the lane graph at which the lane begins.
        exit: Index of the node at which the lane ends.
    """

    left: FloatArray
    right: FloatArray
    entry: int
    exit: int


@dataclass(frozen=True, eq=False)
class LaneGraph:
    """Graph of lanelets. At a node, the bounds of successive lanelets meet in one point per side.

    Args:
        lanelets: Lanelets, the edges of the graph.
        left: End of the left bounds at each node, in metres. (nodes, 2)
        right: End of the right bounds at each node, in metres. (nodes, 2)
        source: Origin of the lanelets, a text that follows "12 lanelets" in reports.
    """

    lanelets: Sequence[Lanelet]
    left: FloatArray
    right: FloatArray
    source: str = "of centre lines"


def lane_graph_of(drive: Drive, elements: MapElements) -> LaneGraph:
    """Construct lanelets from the map of a drive.

    The lines of a map that was merged from frames have no direction of travel, but the centre lines
    of the frames have one. Each centre line of the map gets the direction of most of the frames'
    centre lines along it. In a map without centre lines, lanelets are the lanes that the vehicle
    has driven (`driven_lanes`). The text `LaneGraph.source` then contains the length of the track
    that lies in no lane.

    Args:
        drive: Frames with poses, and with centre lines in the direction of travel if there are any.
        elements: Map of the drive in the global frame.

    Returns:
        Lanelets and nodes.
    """
    borders: list[FloatArray] = []
    for name in BORDERS:
        borders += _lines_of_class(drive, elements, name)
    lines = _lines_of_class(drive, elements, CENTERLINE)
    if not lines:
        # Vehicles of several drives do not follow each other.
        positions_of_scene: dict[str, list[FloatArray]] = {}
        for frame in drive.frames:
            positions_of_scene.setdefault(frame.sample.scene, []).append(frame.origin)
        lanes = driven_lanes(map(np.array, positions_of_scene.values()), borders)
        source = f"of driven lanes ({lanes.outside_m:.0f} of {lanes.driven_m:.0f} m are in no lane)"
        return replace(lane_graph(lanes.centerlines, borders), source=source)
    directed_lines: list[FloatArray] = []
    for frame in drive.frames:
        directed_lines += _lines_of_class(drive, frame.elements, CENTERLINE)
    return lane_graph(_orient_lines(lines, directed_lines), borders)


def _lines_of_class(drive: Drive, elements: MapElements, name: str) -> list[FloatArray]:
    """Lines of a class; empty if the drive does not have the class. each (n, 2)"""
    if name not in drive.classes:
        return []
    label = drive.classes.index(name)
    return elements.select(elements.labels == label).polylines


def lane_graph(centerlines: Iterable[FloatArray], borders: Sequence[FloatArray]) -> LaneGraph:
    """Construct lanelets from centre lines.

    A line is split where another line begins or ends on it. If several lines lie on top of each
    other, only the first is used. A bound is parallel to its centre line. Its distance is the
    median distance of the borders beside the line, or 1.75 m if most of the line has no border.

    Args:
        centerlines: Lines in the direction of travel, in metres. each (n >= 2, 2)
        borders: Dividers and boundaries, in metres. each (n, 2)

    Returns:
        Lanelets and nodes.
    """
    nonempty = []
    # Repeated vertices are dropped, because a line has no direction at them.
    for centerline in centerlines:
        vertices = drop_repeats(np.asarray(centerline)[:, :2])
        if len(vertices) > 1:
            nonempty.append(vertices)
    lines = _split(nonempty)
    if not lines:
        return LaneGraph([], left=np.empty((0, 2)), right=np.empty((0, 2)))
    tree = border_tree(list(borders))
    directions = []
    half_widths = []
    ends = []
    end_directions = []
    for line in lines:
        directions_of_line = line_directions(line)
        left_m = _half_width(line, side=1, borders=tree)
        right_m = _half_width(line, side=-1, borders=tree)
        directions.append(directions_of_line)
        half_widths.append((left_m, right_m))
        ends += [line[0], line[-1]]
        end_directions += [directions_of_line[0], directions_of_line[-1]]
    nodes = _Nodes(
        ends=np.array(ends),
        directions=np.array(end_directions),
        half_widths_m=np.repeat(half_widths, 2, axis=0),  # equal at both ends of a lane
    )
    lanelets: list[Lanelet] = []
    lanes_between: dict[tuple[int, int], list[shapely.LineString]] = {}
    for index, line in enumerate(lines):
        entry_node = int(nodes.node_of_end[2 * index])
        exit_node = int(nodes.node_of_end[2 * index + 1])
        lane = shapely.LineString(line)
        # Lanes between two nodes that lie on top of each other are one lane.
        # They are compared by their Hausdorff distance, the largest distance of one to the other.
        known_lanes = lanes_between.setdefault((entry_node, exit_node), [])
        if any(shapely.hausdorff_distance(lane, known) <= _JOIN_M for known in known_lanes):
            continue
        known_lanes.append(lane)
        # Both ends of a bound are points of the nodes, so a lanelet stores the vertices between.
        inner = line[1:-1]
        to_left = rotate_to_left(directions[index])[1:-1]
        left_m, right_m = half_widths[index]
        left = inner + left_m * to_left
        right = inner - right_m * to_left
        lanelets.append(Lanelet(left, right, entry=entry_node, exit=exit_node))
    return LaneGraph(lanelets, left=nodes.left, right=nodes.right)


class _Nodes:
    """Nodes of a lane graph: groups of lane ends that are close together with similar directions.

    Args:
        ends: Ends of the centre lines in metres; lane i begins at end 2 i and stops at end
            2 i + 1. (E, 2)
        directions: Unit direction of travel at each end. (E, 2)
        half_widths_m: For each end, the distances in metres of the left and the right bound of its
            lane from the centre line. (E, 2)

    Attributes:
        node_of_end: Index of the node of each end. (E,)
        left: Point of each node at which the left bounds meet, in metres. (nodes, 2)
        right: Point of each node at which the right bounds meet, in metres. (nodes, 2)
    """

    def __init__(self, ends: FloatArray, directions: FloatArray, half_widths_m: FloatArray) -> None:
        pairs = cKDTree(ends).query_pairs(_JOIN_M, output_type="ndarray")
        first, second = pairs.T
        cosines = (directions[first] * directions[second]).sum(axis=1)
        is_joined = cosines > _MIN_SUCCESSOR_COSINE
        # Ends that are connected by such pairs form a group. An end without a pair is a group, too.
        groups = components(len(ends), first[is_joined], second[is_joined])
        self.node_of_end = np.empty(len(ends), np.int64)
        self.left = np.empty((len(groups), 2))
        self.right = np.empty((len(groups), 2))
        for node, members in enumerate(groups):
            self.node_of_end[members] = node
            middle = ends[members].mean(axis=0)
            direction = directions[members].mean(axis=0)
            to_left = rotate_to_left(direction / np.linalg.norm(direction))
            left_m, right_m = half_widths_m[members].mean(axis=0)
            self.left[node] = middle + left_m * to_left
            self.right[node] = middle - right_m * to_left


def _orient_lines(
    lines: Sequence[FloatArray], directed_lines: Sequence[FloatArray]
) -> list[FloatArray]:
    """Reverse the lines along which most directed lines run in the opposite direction.

    Args:
        lines: Lines of the map in metres, without a direction of travel. each (n, 2)
        directed_lines: Lines of the frames in the direction of travel, in metres. each (n, 2)

    Returns:
        The lines of the map in the direction of travel. each (n, 2)
    """
    directed_points = []
    point_directions = []
    for directed_line in directed_lines:
        if len(directed_line) > 1:
            points = resample(directed_line[:, :2])
            directed_points.append(points)
            point_directions.append(line_directions(points))
    if not directed_points:
        return list(lines)
    tree = cKDTree(np.concatenate(directed_points))
    directions = np.concatenate(point_directions)
    oriented = []
    for line in lines:
        samples = resample(line[:, :2])
        _, neighbours = tree.query(samples, k=8, distance_upper_bound=_JOIN_M)
        # Each sample has up to eight neighbours, as several frames detect a line. A missing
        # neighbour has the index `len(directions)`.
        rows, columns = np.nonzero(neighbours < len(directions))
        neighbour_directions = directions[neighbours[rows, columns]]
        cosines = (line_directions(samples)[rows] * neighbour_directions).sum(axis=1)
        is_parallel = np.abs(cosines) > _MIN_PARALLEL_COSINE
        votes = np.sign(cosines[is_parallel]).sum()  # each near point votes +1 or -1
        is_opposite = votes < 0
        oriented.append(line[::-1] if is_opposite else line)
    return oriented


def _split(lines: Sequence[FloatArray]) -> list[FloatArray]:
    """Split lines where another line of about the same direction begins or ends on them.

    Args:
        lines: Lines in metres; lines of 2 m and less are dropped. each (n, 2)

    Returns:
        Parts of the lines, sampled at most ``STEP_M`` apart. each (n, 2)
    """
    long_lines = []
    ends = []
    end_directions = []
    for line in lines:
        if shapely.LineString(line).length <= _SHORTEST_M:
            continue
        directions = line_directions(line)
        long_lines.append(line)
        ends += [line[0], line[-1]]
        end_directions += [directions[0], directions[-1]]
    tree = shapely.STRtree(shapely.points(ends) if ends else [])
    parts = []
    for index, line in enumerate(long_lines):
        shape = shapely.LineString(line)
        cuts = [0.0, shape.length]  # positions along the line in metres
        near_ends = tree.query(shape, predicate="dwithin", distance=_JOIN_M)
        # A cut excludes later cuts close to it, so the order of the ends counts. It is sorted, as
        # the tree returns the ends in any order.
        for end in sorted(near_ends.tolist()):
            if end // 2 == index:  # an end of the line itself: line i has the ends 2 i and 2 i + 1
                continue
            cut = shape.project(shapely.Point(ends[end]))
            # Compare the direction of this line around the cut with the direction of the other line
            # at its end.
            around = np.clip([cut - 0.5, cut + 0.5], 0.0, shape.length)
            before, after = shapely.get_coordinates(shapely.line_interpolate_point(shape, around))
            # The points are about 1 m apart, so the product is about the cosine of the directions.
            follows = (after - before) @ end_directions[end] > _MIN_SUCCESSOR_COSINE
            if follows and min(abs(cut - other) for other in cuts) > _SHORTEST_M:
                cuts.append(cut)
        cuts.sort()
        for start, stop in pairwise(cuts):
            part = shapely.ops.substring(shape, start, stop)
            parts.append(resample(shapely.get_coordinates(part)))
    return parts


def _half_width(line: FloatArray, side: int, borders: shapely.STRtree) -> float:
    """Median distance from a centre line to the borders beside it.

    Args:
        line: Centre line in metres. (n, 2)
        side: 1 for the left side, -1 for the right side.
        borders: Spatial index of dividers and boundaries.

    Returns:
        Distance in metres, at least 0.5; ``HALF_WIDTH_M`` if most vertices have no border beside
        them.
    """
    nearest_m = border_distances(line, side, borders=borders, reach_m=_MOST_HALF_WIDTH_M)
    # The distance is infinite at vertices without a border in reach.
    finite_m = nearest_m[np.isfinite(nearest_m)]
    if 2 * len(finite_m) < len(line):
        return HALF_WIDTH_M
    return max(float(np.median(finite_m)), _MIN_HALF_WIDTH_M)
