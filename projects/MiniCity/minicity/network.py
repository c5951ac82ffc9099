"""The street network of a town: jittered grid nodes joined by curved roads."""

from dataclasses import dataclass

import numpy as np

from minicity.config import make_rng
from minicity.curves import Array, arc_lengths, hermite, resample, subline, unit
from minicity.roads import CrossSection, Road, RoadStyle

PITCH_M = 115.0
MARGIN_M = 130.0
STATION_M = 3.0
MIN_ROAD_M = 40.0
CORNER_M = (4.0, 8.0)
STEPS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@dataclass
class Node:
    """A crossing point of the grid.

    Attributes:
        position: Centre in metres. (2,)
        turn_rad: Angle by which its four arms are turned from the axes.
        neighbours: Node index per arm, at 0, 90, 180, 270 degrees plus the turn, or None.
    """

    position: Array
    turn_rad: float
    neighbours: list[int | None]

    @property
    def degree(self) -> int:
        """Number of roads that meet here."""
        return sum(n is not None for n in self.neighbours)

    def arm_dir(self, arm: int) -> Array:
        """Unit direction in which an arm leaves. (2,)"""
        return unit(self.turn_rad + arm * np.pi / 2)


def make_nodes(side: int, seed: int, name: str) -> list[Node]:
    """Make grid nodes, moved and turned at random, with some of the streets left out.

    Args:
        side: Nodes along each side of the grid.
        seed: Seed of all towns.
        name: Name of the town.
    """
    rng = make_rng(seed, name, "nodes")
    nodes = []
    for i in range(side * side):
        cell = np.array([i % side, i // side])
        position = MARGIN_M + PITCH_M * cell + rng.uniform(-17, 17, 2)
        neighbours: list[int | None] = []
        for step in STEPS:
            other = cell + step
            inside = bool(np.all(other >= 0) and np.all(other < side))
            neighbours.append(int(other[0] + side * other[1]) if inside else None)
        nodes.append(Node(position, float(rng.uniform(-0.3, 0.3)), neighbours))
    streets = [
        (i, arm)
        for i in range(len(nodes))
        for arm in (0, 1)
        if nodes[i].neighbours[arm] is not None
    ]
    for k in rng.permutation(len(streets)):
        i, arm = streets[k]
        other = nodes[i].neighbours[arm]
        assert other is not None
        if min(nodes[i].degree, nodes[other].degree) > 2 and rng.random() < 0.2:
            nodes[i].neighbours[arm] = None
            nodes[other].neighbours[(arm + 2) % 4] = None
    return nodes


def random_section(rng: np.random.Generator) -> CrossSection:
    """Draw lanes, widths and median of a road."""
    one_way = rng.random() < 0.12
    forward = int(rng.choice([1, 2, 3], p=[0.35, 0.45, 0.2]))
    backward = (
        0 if one_way else int(np.clip(forward + rng.choice([-1, 0, 1], p=[0.15, 0.7, 0.15]), 1, 3))
    )
    median = 0.0 if one_way or rng.random() > 0.33 else float(rng.choice([1.6, 2.4, 3.5]))
    shoulders = [float(rng.choice([0.3, 0.6, 2.3], p=[0.4, 0.25, 0.35])) for _ in range(2)]
    return CrossSection(
        forward, backward, round(float(rng.uniform(3.0, 3.7)), 2), median, *shoulders
    )


def random_style(rng: np.random.Generator) -> RoadStyle:
    """Draw paint and surface of a road."""
    dashes = [(3.0, 3.0), (2.0, 4.0), (4.0, 4.0), (3.0, 2.0)]
    return RoadStyle(
        divider=str(
            rng.choice(["double_yellow", "yellow", "dashed_white", "white"], p=[0.4, 0.2, 0.2, 0.2])
        ),
        dash_m=dashes[int(rng.integers(len(dashes)))],
        line_m=float(rng.uniform(0.14, 0.22)),
        edge_line=bool(rng.random() < 0.35),
        crossing=str(rng.choice(["zebra", "ladder"], p=[0.7, 0.3])),
        wear=float(rng.choice([rng.uniform(0.0, 0.2), rng.uniform(0.2, 0.55)], p=[0.75, 0.25])),
        asphalt=float(rng.uniform(62, 105)),
        walkway_m=float(rng.uniform(1.8, 4.0)),
    )


@dataclass
class Chain:
    """A street from one junction or dead end to the next, through nodes where it merely bends.

    Attributes:
        nodes: Node indices along it.
        arms: (arm at which it leaves the first node, arm at which it enters the last node).
        center: Centre line from node to node. (n, 2)
        section: Lanes across it.
        style: Paint and surface.
    """

    nodes: list[int]
    arms: tuple[int, int]
    center: Array
    section: CrossSection
    style: RoadStyle


def _leg(nodes: list[Node], a: int, arm: int) -> Array:
    """The curve from node ``a`` along ``arm`` to the next node."""
    b = nodes[a].neighbours[arm]
    assert b is not None
    arrive = -nodes[b].arm_dir((arm + 2) % 4)
    return hermite(nodes[a].position, nodes[a].arm_dir(arm), nodes[b].position, arrive, 60)


def _join(first: Array, second: Array) -> Array:
    """Two legs that meet at a bend, the corner replaced by a wide curve."""
    cut = 40.0
    first_length, second_length = arc_lengths(first)[-1], arc_lengths(second)[-1]
    head, tail = subline(first, 0.0, first_length - cut), subline(second, cut, second_length)
    start_dir, end_dir = head[-1] - head[-2], tail[1] - tail[0]
    bend = hermite(
        head[-1],
        start_dir / np.linalg.norm(start_dir),
        tail[0],
        end_dir / np.linalg.norm(end_dir),
        30,
        1.15,
    )
    return np.concatenate([head[:-1], bend, tail[1:]])


def make_chains(nodes: list[Node], seed: int, name: str) -> list[Chain]:
    """Make all streets; a node of degree two is a bend of its street, any other an end.

    Args:
        nodes: Nodes of the town.
        seed: Seed of all towns.
        name: Name of the town.
    """
    chains = []
    used: set[tuple[int, int]] = set()
    for i, node in enumerate(nodes):
        if node.degree == 2:
            continue
        for arm in range(4):
            if node.neighbours[arm] is None or (i, arm) in used:
                continue
            chain = _follow(nodes, i, arm, make_rng(seed, name, "street", i, arm))
            used |= {(i, arm), (chain.nodes[-1], chain.arms[1])}
            chains.append(chain)
    return chains


def _follow(nodes: list[Node], start: int, arm: int, rng: np.random.Generator) -> Chain:
    visited, first_arm = [start], arm
    center = _leg(nodes, start, arm)
    current = nodes[start].neighbours[arm]
    assert current is not None
    visited.append(current)
    while nodes[current].degree == 2:
        back = (arm + 2) % 4
        arm = next(a for a in range(4) if a != back and nodes[current].neighbours[a] is not None)
        center = _join(center, _leg(nodes, current, arm))
        following = nodes[current].neighbours[arm]
        assert following is not None
        current = following
        visited.append(current)
    return Chain(
        visited, (first_arm, (arm + 2) % 4), center, random_section(rng), random_style(rng)
    )


def _half_widths(chain: Chain, at_start: bool) -> tuple[float, float]:
    """Metres from the centre line to the (left, right) kerb, seen looking out of the junction."""
    left, right = chain.section.left_m, -chain.section.right_m
    return (left, right) if at_start else (right, left)


def mouth_distances(arms: list[tuple[float, float, float]], corner_m: float) -> list[float]:
    """How far from a junction's centre each of its roads has to end.

    Two neighbouring kerbs meet at ``(w2 + w1 cos(phi)) / sin(phi)`` along the first road, ``phi``
    being the angle between the roads and ``w`` the half widths; the corner's radius is added.

    Args:
        arms: (angle in radians, left half width, right half width) of the roads, anticlockwise.
        corner_m: Space left for the rounded corner.

    Returns:
        Metres along each road.
    """
    count = len(arms)
    distances = [9.0] * count
    for i in range(count):
        j = (i + 1) % count
        angle = (arms[j][0] - arms[i][0]) % (2 * np.pi)
        if angle > 0.9 * np.pi or count == 1:
            continue
        w1, w2 = arms[i][1], arms[j][2]
        for k, near, far in ((i, w1, w2), (j, w2, w1)):
            meet = (far + near * np.cos(angle)) / np.sin(angle)
            distances[k] = max(distances[k], meet + corner_m)
    return [float(d) for d in distances]


def make_roads(
    nodes: list[Node], chains: list[Chain], seed: int, name: str
) -> tuple[list[Road], list]:
    """Cut the streets back to their junctions.

    Args:
        nodes: Nodes of the town.
        chains: Streets between nodes.
        seed: Seed of all towns.
        name: Name of the town.

    Returns:
        The roads and, per node, (road index, at its start, angle) anticlockwise by angle.
    """
    meetings: list[list[tuple[int, bool, float]]] = [[] for _ in nodes]
    for c, chain in enumerate(chains):
        for end, at_start in ((0, True), (-1, False)):
            node = chain.nodes[end]
            angle = nodes[node].turn_rad + chain.arms[end] * np.pi / 2
            meetings[node].append((c, at_start, float(angle % (2 * np.pi))))
    cuts = np.zeros((len(chains), 2))
    for n, meeting in enumerate(meetings):
        meeting.sort(key=lambda m: m[2])
        if nodes[n].degree < 3:
            continue
        arms = [(angle, *_half_widths(chains[c], at_start)) for c, at_start, angle in meeting]
        corner = float(make_rng(seed, name, "corner", n).uniform(*CORNER_M))
        for (c, at_start, _), distance in zip(meeting, mouth_distances(arms, corner), strict=True):
            cuts[c, 0 if at_start else 1] = distance
    roads = []
    for c, chain in enumerate(chains):
        length = arc_lengths(chain.center)[-1]
        center = resample(subline(chain.center, cuts[c, 0], length - cuts[c, 1]), STATION_M)
        roads.append(Road(c, chain.nodes[0], chain.nodes[-1], center, chain.section, chain.style))
    return roads, meetings
