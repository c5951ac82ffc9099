"""Joining of the lines of a map that is stored in pieces, without copies of lines."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import shapely

from gsmap.datasets.annotations.record import MapInstance
from gsmap.structures.classes import DIRECTED_CLASSES
from gsmap.structures.polylines import Points, is_closed

_COPY_M = 0.01  # largest distance of two copies of a line in the plane
_SAME_PLACE_M = 0.1  # ends of lines within this distance in the plane are one place
# Largest difference in height of one place, and of copies. Roads above one another differ by more.
_SAME_HEIGHT_M = 1.0
_WAY_M = 1.0  # length along which the direction of a line at its end is measured
_SAME_WAY = 0.98  # least cosine of the angle of two ways that are one road, 11 degrees

_FIRST, _LAST = 0, -1  # indices of the first and the last vertex of a line
_End = tuple[int, int]  # end of a line: index of the line, and _FIRST or _LAST


def join_lines(instances: Sequence[MapInstance], classes: Sequence[str]) -> list[MapInstance]:
    """Join lines of one class whose ends meet, such as lines of a map that is stored in tiles.

    Two ends meet if they are within 0.1 m of each other in the plane and, with heights, within 1 m
    in height. Lines are joined at places where exactly two ends meet, but not at forks, where three
    or more meet. Lines may be reversed, except for ``DIRECTED_CLASSES``: a centre line that ends is
    joined to one that starts there, if only one does. A lane that leads back along the line does
    not count.

    Rings are not changed. Copies of a line or a ring are left out: some maps store the line
    between two lanes with each of them. Centre lines of opposite directions are no copies.

    Args:
        instances: Map elements, in metres.
        classes: Names of the classes, in the order of the labels.

    Returns:
        The rings, then the joined lines of each class.
    """
    joined = []
    rings_of: dict[int, list[np.ndarray]] = {}  # rings by label
    lines_of: dict[int, list[np.ndarray]] = {}  # lines by label
    for instance in instances:
        points = np.array(instance.points, np.float64)
        points_of = rings_of if is_closed(points) else lines_of
        points_of.setdefault(instance.label, []).append(points)
    for label, rings in rings_of.items():
        is_directed = classes[label] in DIRECTED_CLASSES
        for points in without_copies(rings, is_directed=is_directed):
            joined.append(MapInstance(label=label, points=points))
    for label in sorted(lines_of):
        is_directed = classes[label] in DIRECTED_CLASSES
        _snap_ends(lines_of[label])
        lines = without_copies(lines_of[label], is_directed=is_directed)
        for points in _chain_lines(lines, is_directed=is_directed):
            joined.append(MapInstance(label=label, points=points))
    return joined


def without_copies(lines: Sequence[Points], is_directed: bool) -> list[Points]:
    """Leave out lines that are within 1 cm of an earlier one in the plane all along.

    Copies have nearly equal heights, if there are any. The start of a ring does not count.

    Args:
        lines: Lines or rings in metres. (n, dim) each
        is_directed: Whether copies must also have one direction.

    Returns:
        The first line of each set of copies. (n, dim) each
    """
    shapes = np.array([shapely.LineString(line[:, :2]) for line in lines], dtype=object)
    bounds = shapely.bounds(shapes)  # (lines, 4)
    lowest_m = np.array([line[:, 2:].min(initial=np.inf) for line in lines])
    highest_m = np.array([line[:, 2:].max(initial=-np.inf) for line in lines])
    kept: list[int] = []
    for index, shape in enumerate(shapes):
        # Copies have nearly equal bounding boxes, which are fast to compare.
        is_near = (np.abs(bounds[kept] - bounds[index]) <= _COPY_M).all(axis=1)
        if lines[index].shape[1] == 3:
            is_near &= np.abs(lowest_m[kept] - lowest_m[index]) <= _SAME_HEIGHT_M
            is_near &= np.abs(highest_m[kept] - highest_m[index]) <= _SAME_HEIGHT_M
        earlier = np.array(kept, dtype=np.int64)[is_near]
        # Points between the vertices count, too: lines may join the same vertices in another order.
        distances = shapely.hausdorff_distance(shapes[earlier], shape, densify=0.25)
        copies = earlier[distances <= _COPY_M].tolist()
        if is_directed:
            copies = [copy for copy in copies if _have_one_direction(lines[copy], lines[index])]
        if not copies:
            kept.append(index)
    return [lines[index] for index in kept]


def _have_one_direction(line: Points, copy: Points) -> bool:
    """Whether a line or a ring and its copy have one direction in the plane. (n, dim) each"""
    if is_closed(line) and is_closed(copy):
        is_ccw, is_copy_ccw = shapely.is_ccw(shapely.linestrings([line[:, :2], copy[:, :2]]))
        return bool(is_ccw == is_copy_ccw)
    ends = line[[_FIRST, _LAST], :2]
    copy_ends = copy[[_FIRST, _LAST], :2]
    distance_m = np.linalg.norm(ends - copy_ends, axis=1).sum()
    reversed_distance_m = np.linalg.norm(ends - copy_ends[::-1], axis=1).sum()
    return bool(distance_m <= reversed_distance_m)


def _snap_ends(lines: Sequence[Points]) -> None:
    """Give equal coordinates to the ends of lines that meet, in place. (n, dim) each"""
    places: list[np.ndarray] = []
    for line in lines:
        for end in (_FIRST, _LAST):
            other_end = line[-1 - end]  # vertex -1 for end 0, and vertex 0 for end -1
            place = _nearby_place(places, line[end])
            if place is None:
                places.append(line[end].copy())
            elif not (other_end == place).all():  # otherwise a short line would become a point
                line[end] = place


def _nearby_place(places: Sequence[np.ndarray], point: np.ndarray) -> np.ndarray | None:
    """First place near a point in the plane and in height; None if there is none. (dim,)"""
    for place in places:
        is_near = np.linalg.norm(place[:2] - point[:2]) <= _SAME_PLACE_M
        if is_near and np.abs(place[2:] - point[2:]).max(initial=0.0) <= _SAME_HEIGHT_M:
            return place
    return None


def _chain_lines(lines: Sequence[Points], is_directed: bool) -> Iterator[Points]:
    """Yield lines that are joined where their ends are equal. (n, dim) each"""
    joints = _find_joints(lines, is_directed=is_directed)
    # A chain begins at an end without a joint, and if possible at the start of a line. Closed
    # chains have no such end. They come last, and begin at their first line.
    all_ends = [(index, end) for end in (_FIRST, _LAST) for index in range(len(lines))]
    free_ends = [end for end in all_ends if end not in joints]
    visited: set[int] = set()
    for start in (*free_ends, *all_ends):
        parts: list[Points] = []
        position: _End | None = start
        while position is not None and position[0] not in visited:
            index, entry = position
            visited.add(index)
            points = lines[index] if entry == _FIRST else lines[index][::-1]
            parts.append(points[1:] if parts else points)  # the joint is in the part before
            position = joints.get((index, -1 - entry))
        if parts:
            yield np.concatenate(parts)


def _find_joints(lines: Sequence[Points], is_directed: bool) -> Mapping[_End, _End]:
    """Ends that are joined, each with its partner: at their place, no other ends fit them."""
    ends_at: dict[tuple[float, ...], list[_End]] = {}  # ends of lines by their coordinates
    for index, line in enumerate(lines):
        for vertex in (_FIRST, _LAST):
            ends_at.setdefault(tuple(line[vertex].tolist()), []).append((index, vertex))
    joints = {}
    for ends in ends_at.values():
        partners: dict[_End, list[_End]] = {}
        for end in ends:
            partners[end] = [other for other in ends if _fit(lines, end, other, is_directed)]
        for end, others in partners.items():
            if len(others) == 1 and partners[others[0]] == [end]:
                joints[end] = others[0]
    return joints


def _fit(lines: Sequence[Points], end: _End, other: _End, is_directed: bool) -> bool:
    """Whether two ends at one place may be joined.

    Args:
        lines: Lines in metres. (n, dim) each
        end: End of a line.
        other: Other end at its place.
        is_directed: Whether one line must end there, and the other one start and not lead back.
    """
    index, vertex = end
    other_index, other_vertex = other
    if index == other_index:
        return False
    if not is_directed:
        return True
    away = _direction_away(lines[index], vertex)
    other_away = _direction_away(lines[other_index], other_vertex)
    return vertex != other_vertex and bool(away @ other_away < _SAME_WAY)


def _direction_away(line: Points, vertex: int) -> npt.NDArray[np.float64]:
    """Unit direction in the plane from an end of a line into the line. (2,)"""
    shape = shapely.LineString(line[:, :2])
    # A negative distance is measured from the last vertex.
    inside = shapely.line_interpolate_point(shape, _WAY_M if vertex == _FIRST else -_WAY_M)
    offset = shapely.get_coordinates(inside)[0] - line[vertex, :2]
    # A line that leads back to its end within this distance has no direction.
    return offset / max(np.linalg.norm(offset), 1e-9)
