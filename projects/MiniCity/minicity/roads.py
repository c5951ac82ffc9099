"""One road between two junctions: its cross-section, lanes, lines and painted style."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from minicity.curves import Array, arc_lengths, interpolate, left_normals, tangents

CROSSING_GAP_M = 0.8
STOP_GAP_M = 1.0
STOP_LINE_M = 0.45


@dataclass(frozen=True)
class CrossSection:
    """Lanes across a road; offsets are metres left of the centre line, forward lanes lie right.

    Attributes:
        forward: Lanes along the centre line.
        backward: Lanes against it; 0 makes a one-way road.
        lane_m: Width of a lane.
        median_m: Width of the raised strip between the directions; 0 for none.
        right_shoulder_m: Width between the outermost forward lane and the kerb.
        left_shoulder_m: The same on the other side.
    """

    forward: int
    backward: int
    lane_m: float
    median_m: float
    right_shoulder_m: float
    left_shoulder_m: float

    @property
    def forward_edges(self) -> list[float]:
        """Offsets of the forward lanes' edges, from the centre to the right kerb side."""
        return [-self.median_m / 2 - i * self.lane_m for i in range(self.forward + 1)]

    @property
    def backward_edges(self) -> list[float]:
        """Offsets of the backward lanes' edges, from the centre to the left kerb side."""
        return [self.median_m / 2 + i * self.lane_m for i in range(self.backward + 1)]

    @property
    def right_m(self) -> float:
        """Offset of the right kerb (negative)."""
        return self.forward_edges[-1] - self.right_shoulder_m

    @property
    def left_m(self) -> float:
        """Offset of the left kerb (positive)."""
        return self.backward_edges[-1] + self.left_shoulder_m

    @property
    def all_offsets(self) -> list[float]:
        """Offsets at which a lane, median or kerb edge meets a junction, from right to left."""
        edges = {self.right_m, self.left_m, *self.forward_edges, *self.backward_edges}
        return sorted(edges)


@dataclass(frozen=True)
class RoadStyle:
    """How a road is painted and surfaced.

    Attributes:
        divider: Centre paint: ``double_yellow``, ``yellow``, ``dashed_white`` or ``white``.
        dash_m: Painted and bare length of a dashed line.
        line_m: Width of a painted line.
        edge_line: Whether a solid line runs along the kerb side of the lanes.
        crossing: Crossing paint: ``zebra`` or ``ladder``.
        wear: Share of paint that has worn off, in [0, 1).
        asphalt: Grey level of the asphalt.
        walkway_m: Width of the pavements.
    """

    divider: str
    dash_m: tuple[float, float]
    line_m: float
    edge_line: bool
    crossing: str
    wear: float
    asphalt: float
    walkway_m: float


@dataclass(frozen=True)
class Lane:
    """A lane: its identity and its centre line in the direction of travel.

    Attributes:
        road: Index of its road.
        forward: Whether it runs along the road's centre line.
        index: 0 for the innermost lane.
        center: Centre line. (n, 2)
        start_node: Junction that it leaves.
        end_node: Junction that it enters.
    """

    road: int
    forward: bool
    index: int
    center: Array
    start_node: int
    end_node: int

    @property
    def key(self) -> tuple[int, bool, int]:
        """Identity of the lane within its town."""
        return (self.road, self.forward, self.index)


@dataclass
class Road:
    """A road between two nodes, cut back to the mouths of its junctions.

    Attributes:
        index: Number of the road in its town.
        start_node: Node at the first point.
        end_node: Node at the last point.
        center: Centre line from mouth to mouth. (n, 2)
        section: Lanes across the road.
        style: Paint and surface.
        crossings: Arc lengths (start, end) of pedestrian crossings.
        clear_start_m: Arc length at which divider paint begins.
        clear_end_m: Arc length at which divider paint ends.
        stop_forward: Arc lengths of the stop line for forward lanes, or None.
        stop_backward: Arc lengths of the stop line for backward lanes, or None.
    """

    index: int
    start_node: int
    end_node: int
    center: Array
    section: CrossSection
    style: RoadStyle
    crossings: list[tuple[float, float]] = field(default_factory=list)
    clear_start_m: float = 0.0
    clear_end_m: float = 0.0
    stop_forward: tuple[float, float] | None = None
    stop_backward: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Prepare the tables that lines at an offset are read from."""
        self._lengths = arc_lengths(self.center)
        self._normals = left_normals(self.center)
        self.clear_end_m = self.clear_end_m or self.length_m

    @property
    def length_m(self) -> float:
        """Length of the centre line."""
        return float(self._lengths[-1])

    def line(self, offset_m: float, start_m: float = 0.0, end_m: float | None = None) -> Array:
        """The line at an offset between two arc lengths of the centre line. (n, 2)"""
        end_m = self.length_m if end_m is None else end_m
        inner = self._lengths[(self._lengths > start_m + 0.05) & (self._lengths < end_m - 0.05)]
        at = np.concatenate([[start_m], inner, [end_m]])
        points = interpolate(self.center, self._lengths, at)
        return points + offset_m * interpolate(self._normals, self._lengths, at)

    def band(
        self, right_m: float, left_m: float, start_m: float = 0.0, end_m: float | None = None
    ) -> Array:
        """The outline, anticlockwise, between two offsets and two arc lengths. (n, 2)"""
        right = self.line(right_m, start_m, end_m)
        return np.concatenate([right, self.line(left_m, start_m, end_m)[::-1]])

    def band_with_mouths(self, right_m: float, left_m: float) -> Array:
        """The whole band, its ends with every vertex that the junctions' mouths have. (n, 2)"""
        between = [o for o in self.section.all_offsets if right_m < o < left_m]
        end = np.array([self.line(o)[-1] for o in between]).reshape(-1, 2)
        start = np.array([self.line(o)[0] for o in reversed(between)]).reshape(-1, 2)
        return np.concatenate([self.line(right_m), end, self.line(left_m)[::-1], start])

    def direction(self, at_m: float) -> float:
        """Heading of the centre line at an arc length, in radians."""
        step = interpolate(tangents(self.center), self._lengths, np.array([at_m]))[0]
        return float(np.arctan2(step[1], step[0]))

    def point(self, at_m: float, offset_m: float) -> Array:
        """The point at an arc length and an offset. (2,)"""
        at = np.array([at_m])
        normal = interpolate(self._normals, self._lengths, at)[0]
        return interpolate(self.center, self._lengths, at)[0] + offset_m * normal

    def carriageways(self) -> list[tuple[float, float]]:
        """Offsets (right, left) of each kerb-to-kerb surface: two where a median parts them."""
        section = self.section
        if section.median_m > 0:
            return [
                (section.right_m, section.forward_edges[0]),
                (section.backward_edges[0], section.left_m),
            ]
        return [(section.right_m, section.left_m)]

    def lanes(self) -> list[Lane]:
        """All lanes of the road."""
        found = []
        for forward, edges in (
            (True, self.section.forward_edges),
            (False, self.section.backward_edges),
        ):
            for i, (inner, outer) in enumerate(pairwise(edges)):
                center = self.line(0.5 * (inner + outer))
                nodes = (self.start_node, self.end_node)
                if not forward:
                    center, nodes = center[::-1], nodes[::-1]
                found.append(Lane(self.index, forward, i, center, *nodes))
        return found

    def add_crossing(self, start_m: float, depth_m: float, at_start: bool, stop: bool) -> None:
        """Put a crossing near one end, perhaps with a stop line before it, and clear the paint."""
        far = start_m + depth_m
        clear = far + (STOP_GAP_M + STOP_LINE_M if stop else 0.3)
        if at_start:
            self.crossings.append((start_m, far))
            self.clear_start_m = clear
            if stop:
                self.stop_backward = (far + STOP_GAP_M, clear)
        else:
            length = self.length_m
            self.crossings.append((length - far, length - start_m))
            self.clear_end_m = length - clear
            if stop:
                self.stop_forward = (length - clear, length - far - STOP_GAP_M)
