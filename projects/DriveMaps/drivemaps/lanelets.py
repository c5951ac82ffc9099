"""Lanelets of a map: lanes with a left and a right bound, made from centre lines."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
import shapely.ops
from scipy.spatial import cKDTree

from drivemaps.drive import Drive
from drivemaps.truth import components
from gsmap.structures.elements import FloatArray, IntArray, MapElements

CENTERLINE = "centerline"
BORDERS = ("divider", "boundary")
HALF_WIDTH_M = 1.75  # of a side of a lane beside which no border lies
_MOST_HALF_WIDTH_M = 3.0  # a border farther away belongs to another lane
_JOIN_M = 1.0  # ends that are so near are one place of the graph of lanes
_SHORTEST_M = 2.0  # a lane is not split nearer to its ends
_STEP_M = 2.0  # between points at which directions and widths are measured
_ALIKE = 0.5  # least cosine between directions of lanes that follow one another
_ALONG = 0.7  # least cosine between a line and a piece that has its direction, or its opposite


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A lane in the direction of travel.

    Args:
        left: Vertices of the left bound between its ends, in metres. (n, 2)
        right: Vertices of the right bound between its ends, in metres. (m, 2)
        entry: Place of the graph of lanes at which the lane begins.
        exit: Place at which it ends.
    """

    left: FloatArray
    right: FloatArray
    entry: int
    exit: int


@dataclass(frozen=True, eq=False)
class LaneGraph:
    """Lanelets that share the ends of their bounds where they follow one another.

    Args:
        lanelets: The lanelets.
        left: Left end of the bounds at each place, in metres. (places, 2)
        right: Right end of the bounds at each place, in metres. (places, 2)
    """

    lanelets: Sequence[Lanelet]
    left: FloatArray
    right: FloatArray


def lane_graph_of(drive: Drive, elements: MapElements) -> LaneGraph:
    """Make lanelets of the centre lines of a drive's map.

    Maps keep no direction of lines. The direction of travel is the one that the frames' centre
    lines have along a line of the map.

    Args:
        drive: Frames with centre lines in the direction of travel.
        elements: Map of the drive in the global frame.

    Returns:
        The lanelets; none if the drive has no class ``centerline``.
    """
    if CENTERLINE not in drive.classes:
        return lane_graph([], [])
    label = drive.classes.index(CENTERLINE)
    pieces: list[FloatArray] = []
    for frame in drive.frames:
        pieces += frame.elements.select(frame.elements.labels == label).polylines
    lines = elements.select(elements.labels == label).polylines
    borders: list[FloatArray] = []
    for name in BORDERS:
        if name in drive.classes:
            of_class = elements.labels == drive.classes.index(name)
            borders += elements.select(of_class).polylines
    return lane_graph(_directed(lines, pieces), borders)


def lane_graph(centerlines: Iterable[FloatArray], borders: Sequence[FloatArray]) -> LaneGraph:
    """Make lanelets of centre lines.

    A line is split where another one begins or ends on it, and of lines that lie on each other one
    is taken. A bound runs parallel to its centre line, at the median distance of the borders beside
    it, or at 1.75 m where there are none.

    Args:
        centerlines: Lines in the direction of travel, in metres. each (n >= 2, 2)
        borders: Dividers and boundaries, in metres. each (n, 2)
    """
    distinct = [_without_repeats(np.asarray(line)[:, :2]) for line in centerlines]
    lines = _split([line for line in distinct if len(line) > 1])
    if not lines:
        return LaneGraph([], np.empty((0, 2)), np.empty((0, 2)))
    ends = np.array([line[index] for line in lines for index in (0, -1)])  # (2 lanes, 2)
    headings = np.array([_directions(line)[index] for line in lines for index in (0, -1)])
    tree = shapely.STRtree([shapely.LineString(border) for border in borders if len(border) > 1])
    widths = np.array([[_half_width(line, side, tree) for side in (1, -1)] for line in lines])
    of_ends = np.repeat(widths, 2, axis=0)  # left and right. (2 lanes, 2)
    groups = _places(ends, headings)
    place_of = np.empty(len(ends), np.int64)
    left = np.empty((len(groups), 2))
    right = np.empty((len(groups), 2))
    for place, members in enumerate(groups):
        place_of[members] = place
        middle = ends[members].mean(axis=0)
        heading = headings[members].mean(axis=0)
        to_left = _to_left(heading / np.linalg.norm(heading))
        left_m, right_m = of_ends[members].mean(axis=0)
        left[place] = middle + left_m * to_left
        right[place] = middle - right_m * to_left
    lanelets: list[Lanelet] = []
    known: dict[tuple[int, int], list[shapely.LineString]] = {}
    for number, line in enumerate(lines):
        entry = int(place_of[2 * number])
        end = int(place_of[2 * number + 1])
        shape = shapely.LineString(line)
        alike = known.setdefault((entry, end), [])
        if any(shapely.hausdorff_distance(shape, other) <= _JOIN_M for other in alike):
            continue  # lines that lie on each other make one lane
        alike.append(shape)
        to_left = _to_left(_directions(line))[1:-1]
        inner = line[1:-1]
        left_m, right_m = widths[number]
        lanelets.append(
            Lanelet(inner + left_m * to_left, inner - right_m * to_left, entry=entry, exit=end)
        )
    return LaneGraph(lanelets, left, right)


def _to_left(directions: FloatArray) -> FloatArray:
    """Turn directions to the left by a right angle. (..., 2)"""
    return np.stack([-directions[..., 1], directions[..., 0]], axis=-1)


def _without_repeats(line: FloatArray) -> FloatArray:
    """Line without vertices that equal the one before, which have no direction. (n, 2)"""
    differs = (np.diff(line, axis=0) != 0).any(axis=1)
    return line[np.append(True, differs)]


def _directions(line: FloatArray) -> FloatArray:
    """Unit direction of a line at each vertex. (n, 2)"""
    steps = np.diff(line, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    mean = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)


def _resampled(line: FloatArray) -> FloatArray:
    """Points of a line at most `_STEP_M` apart, its ends among them. (n >= 2, 2)"""
    shape = shapely.LineString(line)
    count = max(int(np.ceil(shape.length / _STEP_M)), 1) + 1
    distances = np.linspace(0.0, shape.length, count)
    return shapely.get_coordinates(shapely.line_interpolate_point(shape, distances))


def _directed(lines: Sequence[FloatArray], pieces: Sequence[FloatArray]) -> list[FloatArray]:
    """Turn lines into the direction that most of the pieces along them have. each (n, 2)"""
    points = [_resampled(piece[:, :2]) for piece in pieces if len(piece) > 1]
    if not points:
        return list(lines)
    tree = cKDTree(np.concatenate(points))
    directions = np.concatenate([_directions(piece) for piece in points])
    directed = []
    for line in lines:
        samples = _resampled(line[:, :2])
        _, nearest = tree.query(samples, k=8, distance_upper_bound=_JOIN_M)
        rows, columns = np.nonzero(nearest < len(directions))
        found = directions[nearest[rows, columns]]
        cosines = (_directions(samples)[rows] * found).sum(axis=1)
        votes = np.sign(cosines[np.abs(cosines) > _ALONG]).sum()
        directed.append(line[::-1] if votes < 0 else line)
    return directed


def _split(lines: Sequence[FloatArray]) -> list[FloatArray]:
    """Split lines where another one begins or ends on them in its direction. each (n, 2)"""
    long_lines = []
    ends = []
    headings = []
    for line in lines:
        if shapely.LineString(line).length <= _SHORTEST_M:
            continue
        directions = _directions(line)
        long_lines.append(line)
        ends += [line[0], line[-1]]
        headings += [directions[0], directions[-1]]
    tree = shapely.STRtree(shapely.points(ends) if ends else [])
    parts = []
    for number, line in enumerate(long_lines):
        shape = shapely.LineString(line)
        cuts = [0.0, shape.length]
        for end in sorted(tree.query(shape, predicate="dwithin", distance=_JOIN_M).tolist()):
            if end // 2 == number:
                continue
            cut = shape.project(shapely.Point(ends[end]))
            around = np.clip([cut - 0.5, cut + 0.5], 0.0, shape.length)
            before, after = shapely.get_coordinates(shapely.line_interpolate_point(shape, around))
            follows = (after - before) @ headings[end] > _ALIKE
            if follows and min(abs(cut - other) for other in cuts) > _SHORTEST_M:
                cuts.append(cut)
        cuts.sort()
        for low, high in pairwise(cuts):
            part = shapely.ops.substring(shape, low, high)
            parts.append(_resampled(shapely.get_coordinates(part)))
    return parts


def _places(ends: FloatArray, headings: FloatArray) -> list[IntArray]:
    """Group ends of lanes that are near each other and have about one direction. each (n,)"""
    pairs = cKDTree(ends).query_pairs(_JOIN_M, output_type="ndarray")
    first, second = pairs.T
    alike = (headings[first] * headings[second]).sum(axis=1) > _ALIKE
    return components(len(ends), first[alike], second[alike])


def _half_width(line: FloatArray, side: int, borders: shapely.STRtree) -> float:
    """Distance from a centre line to the border beside it, in metres; side 1 is left, -1 right."""
    across = side * _MOST_HALF_WIDTH_M * _to_left(_directions(line))
    rays = shapely.linestrings(np.stack([line, line + across], axis=1))
    rows, found = borders.query(rays, predicate="intersects")
    nearest = np.full(len(line), np.inf)
    starts = shapely.points(line[rows])
    crossings = shapely.intersection(rays[rows], borders.geometries[found])
    np.minimum.at(nearest, rows, shapely.distance(starts, crossings))
    hits = nearest[np.isfinite(nearest)]
    if 2 * len(hits) < len(line):
        return HALF_WIDTH_M
    return max(float(np.median(hits)), 0.5)
