"""Road between two junctions: cross-section, lanes, lines and paint."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from minicity.curves import Array, arc_lengths, interpolate, left_normals, tangents

CROSSING_GAP_M = 0.8  # least distance from the end of a road to a crossing
STOP_GAP_M = 1.0  # distance from a crossing to its stop line
STOP_LINE_M = 0.45  # width of a stop line
_BARE_M = 0.3  # length without divider paint at a crossing that has no stop line


@dataclass(frozen=True)
class CrossSection:
    """Lanes across a road.

    Offsets are in metres, positive to the left of the centre line. Forward lanes lie on its right.

    Attributes:
        forward: Number of lanes with traffic in the direction of the centre line.
        backward: Number of lanes with traffic against it; 0 for a one-way road.
        lane_m: Width of a lane in metres.
        median_m: Width of the raised strip between the directions in metres; 0 for none.
        right_shoulder_m: Width between the outermost forward lane and the right kerb, in metres.
        left_shoulder_m: Width between the outermost backward lane and the left kerb, in metres.
    """

    forward: int
    backward: int
    lane_m: float
    median_m: float
    right_shoulder_m: float
    left_shoulder_m: float

    @property
    def forward_edges(self) -> list[float]:
        """Offsets of the edges of the forward lanes, from the innermost to the outermost edge.

        The outermost edge is at the right kerb only without a shoulder.
        """
        return [-self.median_m / 2 - i * self.lane_m for i in range(self.forward + 1)]

    @property
    def backward_edges(self) -> list[float]:
        """Offsets of the edges of the backward lanes, from the innermost to the outermost edge.

        The outermost edge is at the left kerb only without a shoulder.
        """
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
        # A set, since neighbours without a median or a shoulder share an edge.
        edges = {self.right_m, self.left_m, *self.forward_edges, *self.backward_edges}
        return sorted(edges)


@dataclass(frozen=True)
class RoadStyle:
    """Paint and surface of a road.

    Attributes:
        divider: Centre paint: ``double_yellow``, ``yellow``, ``dashed_white`` or ``white``.
        dash_m: Painted and bare length of a dashed line, in metres.
        line_m: Width of a painted line in metres.
        edge_line: Whether a solid line runs along the kerb side of the lanes.
        crossing: Crossing paint: ``zebra`` or ``ladder``.
        wear: Share of the paint that is worn off, in [0, 1).
        asphalt: Grey level of the asphalt, in [0, 255].
        walkway_m: Width of the pavements in metres.
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
    """Lane of a road.

    Attributes:
        road: Index of the road.
        forward: Whether the lane runs along the road's centre line.
        index: Position among the lanes of its direction, 0 for the innermost lane.
        center: Centre line in the direction of travel, in metres. (n, 2)
        start_node: Node at which the lane starts.
        end_node: Node at which the lane ends.
    """

    road: int
    forward: bool
    index: int
    center: Array
    start_node: int
    end_node: int

    @property
    def key(self) -> tuple[int, bool, int]:
        """Identity of the lane within its town: road, direction and index."""
        return (self.road, self.forward, self.index)


@dataclass
class Road:
    """Road between two nodes, cut back to the mouths of its junctions.

    A mouth is the cross-section at which a road meets a junction. Arc lengths are in metres along
    the centre line.

    Attributes:
        index: Number of the road in its town.
        start_node: Node at the first point.
        end_node: Node at the last point.
        center: Centre line from mouth to mouth, in metres. (n, 2)
        section: Lanes across the road.
        style: Paint and surface.
        crossings: Arc lengths (start, end) of pedestrian crossings, in any order.
        clear_start_m: Arc length at which divider paint begins, beyond a crossing or a stop line
            at the start of the road.
        clear_end_m: Arc length at which divider paint ends, before a stop line or a crossing at
            the end of the road. 0, the default, is replaced by the length of the road.
        stop_forward: Arc lengths (start, end) of the stop line for forward lanes, which lies near
            the end of the road; None without one.
        stop_backward: Arc lengths (start, end) of the stop line for backward lanes, which lies near
            the start of the road; None without one.
        shift_m: Distance in metres by which the painted lines between lanes are moved from the
            offsets in ``section``, positive to the left. The lanes follow their lines. Kerbs,
            medians and the outermost edges of the lanes stay.
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
    shift_m: float = 0.0

    def __post_init__(self) -> None:
        """Compute the arc lengths and normals of the centre line."""
        self._lengths = arc_lengths(self.center)
        self._normals = left_normals(self.center)
        if self.clear_end_m == 0:
            self.clear_end_m = self.length_m

    @property
    def length_m(self) -> float:
        """Length of the centre line in metres."""
        return float(self._lengths[-1])

    def line(self, offset_m: float, start_m: float = 0.0, end_m: float | None = None) -> Array:
        """Line parallel to the centre line.

        Args:
            offset_m: Offset in metres, positive to the left.
            start_m: Arc length of the first point, in metres.
            end_m: Arc length of the last point, in metres; None for the end of the road.

        Returns:
            Points in metres. (n, 2)
        """
        end_m = self.length_m if end_m is None else end_m
        # Vertices of the centre line within 5 cm of the ends are left out: they would almost
        # coincide with the first or last point.
        inner = self._lengths[(self._lengths > start_m + 0.05) & (self._lengths < end_m - 0.05)]
        arc_m = np.concatenate([[start_m], inner, [end_m]])
        points = interpolate(self.center, self._lengths, at=arc_m)
        return points + offset_m * interpolate(self._normals, self._lengths, at=arc_m)

    def band(
        self, right_m: float, left_m: float, start_m: float = 0.0, end_m: float | None = None
    ) -> Array:
        """Outline of the area between two offsets and two arc lengths, anticlockwise.

        Args:
            right_m: Offset of the right side in metres.
            left_m: Offset of the left side in metres.
            start_m: Arc length at which the area begins, in metres.
            end_m: Arc length at which the area ends, in metres; None for the end of the road.

        Returns:
            The right side, then the left side against the centre line, in metres. (n, 2)
        """
        right = self.line(right_m, start_m, end_m=end_m)
        left = self.line(left_m, start_m, end_m=end_m)
        return np.concatenate([right, left[::-1]])

    def band_with_mouths(self, right_m: float, left_m: float) -> Array:
        """Outline of the whole road between two offsets in metres, anticlockwise. (n, 2)

        At both ends of the road, the outline also has a vertex at each entry of
        ``section.all_offsets`` between the two offsets. The outlines of the junctions have vertices
        at these points, too, so that no gap is left.
        """
        start_points = []
        end_points = []
        for offset_m in self.section.all_offsets:  # from right to left
            if right_m < offset_m < left_m:
                line = self.line(offset_m)
                start_points.append(line[0])
                end_points.append(line[-1])
        # Along the right side, across the end, back along the left side, and across the start. The
        # points across the start go from left to right, so their order is reversed.
        start = np.array(start_points[::-1]).reshape(-1, 2)  # (0, 2) without points
        end = np.array(end_points).reshape(-1, 2)
        return np.concatenate([self.line(right_m), end, self.line(left_m)[::-1], start])

    def direction(self, at_m: float) -> float:
        """Heading of the centre line at an arc length, in radians anticlockwise from +x."""
        # The interpolated tangent is shorter than 1 in a bend, but only its direction is used.
        tangent = interpolate(tangents(self.center), self._lengths, at=np.array([at_m]))[0]
        return float(np.arctan2(tangent[1], tangent[0]))

    def point(self, at_m: float, offset_m: float) -> Array:
        """Point at an arc length and an offset, in metres. (2,)"""
        arc_m = np.array([at_m])
        normal = interpolate(self._normals, self._lengths, at=arc_m)[0]
        return interpolate(self.center, self._lengths, at=arc_m)[0] + offset_m * normal

    @property
    def has_center_line(self) -> bool:
        """Whether paint instead of a median separates the two directions."""
        return self.section.median_m == 0 and self.section.backward > 0

    @property
    def forward_edges(self) -> list[float]:
        """Offsets of the forward lanes' edges in metres, with ``shift_m``, the innermost first."""
        return self._shift_edges(self.section.forward_edges)

    @property
    def backward_edges(self) -> list[float]:
        """Offsets of the backward lanes' edges in metres, with ``shift_m``, the innermost first."""
        return self._shift_edges(self.section.backward_edges)

    def _shift_edges(self, edges: list[float]) -> list[float]:
        """Shift the edges that are painted lines between two lanes."""
        if self.shift_m == 0:
            return edges
        # The first, innermost edge is a line between two lanes only if the road has a centre line.
        # The last, outermost edge never is.
        first = 0 if self.has_center_line else 1
        last = len(edges) - 1
        shifted = []
        for i, edge in enumerate(edges):
            is_line = first <= i < last
            shifted.append(edge + self.shift_m if is_line else edge)
        return shifted

    def carriageways(self) -> list[tuple[float, float]]:
        """Offsets (right, left) of each kerb-to-kerb surface: two for a road with a median."""
        section = self.section
        if section.median_m > 0:
            return [
                (section.right_m, section.forward_edges[0]),
                (section.backward_edges[0], section.left_m),
            ]
        return [(section.right_m, section.left_m)]

    def lanes(self) -> list[Lane]:
        """Lanes of the road: forward ones, then backward ones, each from the innermost."""
        lanes = []
        for i, (inner, outer) in enumerate(pairwise(self.forward_edges)):
            lane = Lane(
                road=self.index,
                forward=True,
                index=i,
                center=self.line(0.5 * (inner + outer)),
                start_node=self.start_node,
                end_node=self.end_node,
            )
            lanes.append(lane)
        for i, (inner, outer) in enumerate(pairwise(self.backward_edges)):
            lane = Lane(
                road=self.index,
                forward=False,
                index=i,
                center=self.line(0.5 * (inner + outer))[::-1],  # against the centre line
                start_node=self.end_node,
                end_node=self.start_node,
            )
            lanes.append(lane)
        return lanes

    def add_crossing(self, start_m: float, depth_m: float, at_start: bool, stop: bool) -> None:
        """Add a crossing near one end of the road. Divider paint begins or ends beyond it.

        Args:
            start_m: Distance in metres between this end of the road and the side of the crossing
                that is nearer to it. It is an arc length only at the start of the road.
            depth_m: Extent of the crossing along the road, in metres.
            at_start: Whether this end is the start of the centre line.
            stop: Whether to add a stop line before the crossing, for vehicles that drive towards
                this end.
        """
        # `far_m` (far side of the crossing) and `clear_m` (start of the paint) are distances from
        # this end, too. Vehicles that drive towards the start of the road use backward lanes.
        far_m = start_m + depth_m
        bare_m = STOP_GAP_M + STOP_LINE_M if stop else _BARE_M
        clear_m = far_m + bare_m
        if at_start:
            self.crossings.append((start_m, far_m))
            self.clear_start_m = clear_m
            if stop:
                self.stop_backward = (far_m + STOP_GAP_M, clear_m)
        else:
            # Arc lengths count from the other end, so the distances are subtracted.
            length_m = self.length_m
            self.crossings.append((length_m - far_m, length_m - start_m))
            self.clear_end_m = length_m - clear_m
            if stop:
                self.stop_forward = (length_m - clear_m, length_m - far_m - STOP_GAP_M)
