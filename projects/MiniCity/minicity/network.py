"""Street network of a town: randomly shifted nodes of a grid, joined by curved roads."""

from dataclasses import dataclass

import numpy as np

from minicity.config import make_rng
from minicity.curves import Array, arc_lengths, hermite, resample, subline, unit
from minicity.roads import CrossSection, Road, RoadStyle

PITCH_M = 115.0  # distance of neighbouring grid nodes before the random offsets are added
MARGIN_M = 130.0  # distance of the grid from the border of the canvas
STATION_M = 3.0  # distance of the points of a centre line
MIN_ROAD_M = 40.0  # shorter roads have no crossings and no stop lines
CORNER_M = (4.0, 8.0)  # smallest and largest space for the rounded corners of a junction
BEND_CUT_M = 40.0  # length of a street that the curve of a bend replaces, on each side
# Steps in the grid to the neighbours at the arms 0, 1, 2 and 3.
STEPS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@dataclass
class Node:
    """Node of the grid, at which streets meet or bend.

    A node has four arms, which are possible streets in the directions 0, 90, 180 and 270 degrees
    plus the rotation ``turn_rad``.

    Attributes:
        position: Centre in metres. (2,)
        turn_rad: Rotation of the four arms from the axes, in radians.
        neighbours: Index of the next node for each arm, or None for an arm without a street.
    """

    position: Array
    turn_rad: float
    neighbours: list[int | None]

    @property
    def degree(self) -> int:
        """Number of streets at the node."""
        return sum(n is not None for n in self.neighbours)

    def arm_dir(self, arm: int) -> Array:
        """Return the unit direction of an arm (0 to 3), away from the node. (2,)"""
        return unit(self.turn_rad + arm * np.pi / 2)


def make_nodes(side: int, seed: int, name: str) -> list[Node]:
    """Make grid nodes with random offsets and rotations, and remove some of their streets.

    Args:
        side: Nodes along each side of the grid.
        seed: Seed of the data set.
        name: Name of the town.

    Returns:
        ``side * side`` nodes, row by row.
    """
    # The state of the generator depends only on these values, not on other parts of the town.
    rng = make_rng(seed, name, "nodes")
    nodes = []
    for i in range(side * side):
        cell = np.array([i % side, i // side])  # column and row in the grid
        position = MARGIN_M + PITCH_M * cell + rng.uniform(low=-17, high=17, size=2)
        neighbours: list[int | None] = []
        for step in STEPS:
            other = cell + step
            inside = bool(np.all(other >= 0) and np.all(other < side))
            other_index = int(other[0] + side * other[1])
            neighbours.append(other_index if inside else None)
        turn_rad = float(rng.uniform(low=-0.3, high=0.3))
        nodes.append(Node(position, turn_rad, neighbours))
    _remove_streets(nodes, rng)
    return nodes


def _remove_streets(nodes: list[Node], rng: np.random.Generator) -> None:
    """Remove random streets in place; each node keeps at least two."""
    streets = []  # index of a node, and the arm of this node at which the street leaves
    for i, node in enumerate(nodes):
        for arm in (0, 1):  # arms 2 and 3 are arm 0 or 1 of a neighbour
            if node.neighbours[arm] is not None:
                streets.append((i, arm))
    for k in rng.permutation(len(streets)):
        i, arm = streets[k]
        other = nodes[i].neighbours[arm]
        assert other is not None
        if min(nodes[i].degree, nodes[other].degree) > 2 and rng.random() < 0.2:
            nodes[i].neighbours[arm] = None
            nodes[other].neighbours[(arm + 2) % 4] = None  # the other end of the street


def random_section(rng: np.random.Generator) -> CrossSection:
    """Choose the lanes, the widths and the median of a road at random."""
    # The order of the draws must not change, because all towns depend on it.
    one_way = rng.random() < 0.12
    forward = int(rng.choice([1, 2, 3], p=[0.35, 0.45, 0.2]))
    backward = 0
    if not one_way:
        difference = rng.choice([-1, 0, 1], p=[0.15, 0.7, 0.15])
        backward = int(np.clip(forward + difference, 1, 3))
    median_m = 0.0
    if not one_way and rng.random() <= 0.33:
        median_m = float(rng.choice([1.6, 2.4, 3.5]))
    shoulder_widths = [0.3, 0.6, 2.3]
    shoulder_shares = [0.4, 0.25, 0.35]
    right_shoulder_m = float(rng.choice(shoulder_widths, p=shoulder_shares))
    left_shoulder_m = float(rng.choice(shoulder_widths, p=shoulder_shares))
    return CrossSection(
        forward=forward,
        backward=backward,
        lane_m=round(float(rng.uniform(low=3.0, high=3.7)), 2),
        median_m=median_m,
        right_shoulder_m=right_shoulder_m,
        left_shoulder_m=left_shoulder_m,
    )


def random_style(rng: np.random.Generator) -> RoadStyle:
    """Choose the paint and the surface of a road at random."""
    dividers = ["double_yellow", "yellow", "dashed_white", "white"]
    dashes = [(3.0, 3.0), (2.0, 4.0), (4.0, 4.0), (3.0, 2.0)]
    divider = str(rng.choice(dividers, p=[0.4, 0.2, 0.2, 0.2]))
    dash_m = dashes[int(rng.integers(len(dashes)))]
    line_m = float(rng.uniform(low=0.14, high=0.22))
    edge_line = bool(rng.random() < 0.35)
    crossing = str(rng.choice(["zebra", "ladder"], p=[0.7, 0.3]))
    # Most roads have little wear. Both values are drawn before one of them is chosen.
    light_wear = rng.uniform(low=0.0, high=0.2)
    heavy_wear = rng.uniform(low=0.2, high=0.55)
    return RoadStyle(
        divider=divider,
        dash_m=dash_m,
        line_m=line_m,
        edge_line=edge_line,
        crossing=crossing,
        wear=float(rng.choice([light_wear, heavy_wear], p=[0.75, 0.25])),
        asphalt=float(rng.uniform(low=62, high=105)),
        walkway_m=float(rng.uniform(low=1.8, high=4.0)),
    )


@dataclass
class Chain:
    """Street from one junction or dead end to the next, through nodes at which it only bends.

    Attributes:
        nodes: Node indices along the street.
        arms: Arm of the first node at which the street leaves, and arm of the last node at which it
            arrives.
        center: Centre line from node to node, in metres. (n, 2)
        section: Lanes across the street.
        style: Paint and surface.
    """

    nodes: list[int]
    arms: tuple[int, int]
    center: Array
    section: CrossSection
    style: RoadStyle


def _curve_to_neighbour(nodes: list[Node], index: int, arm: int) -> Array:
    """Create the curve from a node along one of its arms to the next node, in metres. (60, 2)"""
    node = nodes[index]
    other_index = node.neighbours[arm]
    assert other_index is not None
    other = nodes[other_index]
    return hermite(
        start=node.position,
        start_dir=node.arm_dir(arm),
        end=other.position,
        # The street arrives at the opposite arm, against the direction of this arm.
        end_dir=-other.arm_dir((arm + 2) % 4),
        count=60,
    )


def _join_at_bend(first: Array, second: Array) -> Array:
    """Join two curves, which meet at a node, by a wide bend. (n, 2) and (m, 2) -> (k, 2)"""
    first_length = arc_lengths(first)[-1]
    second_length = arc_lengths(second)[-1]
    head = subline(first, start_m=0.0, end_m=first_length - BEND_CUT_M)
    tail = subline(second, start_m=BEND_CUT_M, end_m=second_length)
    start_dir = head[-1] - head[-2]
    end_dir = tail[1] - tail[0]
    bend = hermite(
        start=head[-1],
        start_dir=start_dir / np.linalg.norm(start_dir),
        end=tail[0],
        end_dir=end_dir / np.linalg.norm(end_dir),
        count=30,
        pull=1.15,  # length of the end tangents relative to the distance of the ends
    )
    return np.concatenate([head[:-1], bend, tail[1:]])  # the ends of the bend are in head and tail


def make_chains(nodes: list[Node], seed: int, name: str) -> list[Chain]:
    """Make all streets. A street bends at a node of degree two and ends at every other node.

    Args:
        nodes: Nodes of the town.
        seed: Seed of the data set.
        name: Name of the town.

    Returns:
        Every street once. A closed ring of nodes that are all of degree two has no end, and is left
        out.
    """
    chains = []
    used_arms: set[tuple[int, int]] = set()
    for i, node in enumerate(nodes):
        if node.degree == 2:
            continue
        for arm in range(4):
            if node.neighbours[arm] is None or (i, arm) in used_arms:
                continue
            rng = make_rng(seed, name, "street", i, arm)
            chain = _follow_street(nodes, start=i, arm=arm, rng=rng)
            # The arms at both ends, so that the street is not followed back from its other end.
            used_arms.add((i, arm))
            used_arms.add((chain.nodes[-1], chain.arms[1]))
            chains.append(chain)
    return chains


def _follow_street(nodes: list[Node], start: int, arm: int, rng: np.random.Generator) -> Chain:
    """Follow a street from an arm of its first node to the node at which it ends."""
    first_arm = arm
    center = _curve_to_neighbour(nodes, start, arm)
    current = nodes[start].neighbours[arm]
    assert current is not None
    visited = [start, current]
    while nodes[current].degree == 2:
        back = (arm + 2) % 4  # arm at which the street arrives
        # The only other arm with a street.
        arm = next(a for a in range(4) if a != back and nodes[current].neighbours[a] is not None)
        center = _join_at_bend(center, _curve_to_neighbour(nodes, current, arm))
        following = nodes[current].neighbours[arm]
        assert following is not None
        current = following
        visited.append(current)
    return Chain(
        nodes=visited,
        arms=(first_arm, (arm + 2) % 4),
        center=center,
        section=random_section(rng),
        style=random_style(rng),
    )


def _half_widths(chain: Chain, at_start: bool) -> tuple[float, float]:
    """Return the distances of the left and the right kerb from the centre line, in metres.

    Left and right are the sides for a driver who leaves the junction. At the end of the street, the
    driver goes against the direction of the centre line, so the sides are exchanged.
    """
    left = chain.section.left_m
    right = -chain.section.right_m  # offsets to the right are negative
    return (left, right) if at_start else (right, left)


def mouth_distances(arms: list[tuple[float, float, float]], corner_m: float) -> list[float]:
    """Compute the distance from the centre of a junction at which each of its roads ends.

    The kerbs between two neighbouring roads meet at ``(w2 + w1 cos(phi)) / sin(phi)`` along the
    first road. Here ``phi`` is the angle between the roads, and ``w1`` and ``w2`` are the half
    widths of both roads on the facing sides. Space for the rounded corner is added.

    Args:
        arms: (angle in radians, left half width, right half width in metres) of each road, in
            anticlockwise order.
        corner_m: Space for the rounded corner, in metres.

    Returns:
        Metres along each road.
    """
    count = len(arms)
    distances = [9.0] * count  # metres; no distance becomes smaller
    for i in range(count):
        j = (i + 1) % count
        angle = (arms[j][0] - arms[i][0]) % (2 * np.pi)
        # The kerbs of nearly opposite roads meet far away or nowhere, so such roads are left out.
        if angle > 0.9 * np.pi or count == 1:
            continue
        w1 = arms[i][1]  # left side of road i
        w2 = arms[j][2]  # right side of the next road
        for road, near, far in ((i, w1, w2), (j, w2, w1)):
            meet = (far + near * np.cos(angle)) / np.sin(angle)
            distances[road] = max(distances[road], meet + corner_m)
    return [float(d) for d in distances]


def make_roads(
    nodes: list[Node], chains: list[Chain], seed: int, name: str
) -> tuple[list[Road], list[list[tuple[int, bool, float]]]]:
    """Make the roads, which are the streets without the parts inside junctions.

    Args:
        nodes: Nodes of the town.
        chains: Streets between nodes.
        seed: Seed of the data set.
        name: Name of the town.

    Returns:
        The roads, one for each street and in their order. For each node, the list of roads that
        meet there, anticlockwise: index of the road, whether it starts there, and its angle in
        radians.
    """
    meetings: list[list[tuple[int, bool, float]]] = [[] for _ in nodes]
    for c, chain in enumerate(chains):
        # Index of the first and of the last entry of `chain.nodes` and `chain.arms`.
        for end, at_start in ((0, True), (-1, False)):
            node = chain.nodes[end]
            angle = nodes[node].turn_rad + chain.arms[end] * np.pi / 2
            meetings[node].append((c, at_start, float(angle % (2 * np.pi))))
    cuts = np.zeros((len(chains), 2))  # length to cut off at the start and at the end, in metres
    for n, meeting in enumerate(meetings):
        meeting.sort(key=lambda m: m[2])  # by angle, anticlockwise
        if nodes[n].degree < 3:  # no junction, so no road is cut
            continue
        arms = []
        for c, at_start, angle in meeting:
            left, right = _half_widths(chains[c], at_start)
            arms.append((angle, left, right))
        corner_rng = make_rng(seed, name, "corner", n)
        corner = float(corner_rng.uniform(low=CORNER_M[0], high=CORNER_M[1]))
        for (c, at_start, _), distance in zip(meeting, mouth_distances(arms, corner), strict=True):
            cuts[c, 0 if at_start else 1] = distance
    roads = []
    for c, chain in enumerate(chains):
        length = arc_lengths(chain.center)[-1]
        part = subline(chain.center, start_m=cuts[c, 0], end_m=length - cuts[c, 1])
        road = Road(
            index=c,
            start_node=chain.nodes[0],
            end_node=chain.nodes[-1],
            center=resample(part, STATION_M),  # points at equal distances of about 3 m
            section=chain.section,
            style=chain.style,
        )
        roads.append(road)
    return roads, meetings
