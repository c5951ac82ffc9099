"""Junctions: their outline between the mouths of their roads, and the paths that cross them."""

from dataclasses import dataclass

import numpy as np

from minicity.curves import Array, hermite
from minicity.roads import Lane, Road

CONNECTOR_M = 3.2


@dataclass(frozen=True)
class Junction:
    """Where three or four roads meet.

    Attributes:
        node: Its node.
        outline: Kerb outline and road mouths, anticlockwise. (n, 2)
        corners: The kerb lines between neighbouring roads. Each (m, 2)
        arms: (road index, at its start) anticlockwise.
    """

    node: int
    outline: Array
    corners: list[Array]
    arms: list[tuple[int, bool]]


@dataclass(frozen=True)
class Connector:
    """The path from a lane into a lane of another road.

    Attributes:
        source: Lane that is left.
        target: Lane that is entered.
        center: Path across the junction. (n, 2)
    """

    source: Lane
    target: Lane
    center: Array


def mouth(road: Road, at_start: bool) -> Array:
    """A road's mouth from its right to its left kerb, seen from the junction. (n, 2)"""
    offsets = road.section.all_offsets
    points = np.stack([road.line(o)[0 if at_start else -1] for o in offsets])
    return points if at_start else points[::-1]


def _outward(road: Road, at_start: bool) -> Array:
    step = road.center[1] - road.center[0] if at_start else road.center[-2] - road.center[-1]
    return step / np.linalg.norm(step)


def make_junction(node: int, arms: list[tuple[int, bool]], roads: list[Road]) -> Junction:
    """Join the mouths of the roads at a node by rounded kerbs.

    Args:
        node: Index of the node.
        arms: Index of each road, and whether its start is here; anticlockwise.
        roads: All roads.
    """
    mouths = [mouth(roads[r], at_start) for r, at_start in arms]
    outward = [_outward(roads[r], at_start) for r, at_start in arms]
    corners = []
    for i in range(len(arms)):
        j = (i + 1) % len(arms)
        turn = float(np.arccos(np.clip(-outward[i] @ outward[j], -1, 1)))
        pull = 1.0 + 0.25 * turn
        corners.append(hermite(mouths[i][-1], -outward[i], mouths[j][0], outward[j], 12, pull))
    ring = [part for m, corner in zip(mouths, corners, strict=True) for part in (m, corner[1:-1])]
    return Junction(node, np.concatenate(ring), corners, arms)


def _turn(source: Lane, target: Lane) -> float:
    """Signed turning angle from the end of one lane to the start of another; left is positive."""
    a, b = source.center[-1] - source.center[-2], target.center[1] - target.center[0]
    return float(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b))


def _choose_target(source: Lane, lanes_in: int, targets: list[Lane], turn: float) -> Lane | None:
    """The lane that a driver would enter, or None where the turn is made from another lane."""
    if turn > 0.6:
        return targets[0] if source.index == 0 else None
    if turn < -0.6:
        return targets[-1] if source.index == lanes_in - 1 else None
    return targets[min(source.index, len(targets) - 1)]


def make_connectors(junction: Junction, lanes_by_road: dict[int, list[Lane]]) -> list[Connector]:
    """All permitted paths across a junction."""
    incoming: dict[int, list[Lane]] = {}
    outgoing: dict[int, list[Lane]] = {}
    for r, at_start in junction.arms:
        for lane in lanes_by_road[r]:
            enters = lane.forward != at_start
            (incoming if enters else outgoing).setdefault(r, []).append(lane)
    found = []
    for r_in, sources in incoming.items():
        for r_out, targets in outgoing.items():
            if r_in == r_out:
                continue
            for source in sources:
                target = _choose_target(source, len(sources), targets, _turn(source, targets[0]))
                if target is not None:
                    found.append(Connector(source, target, _path(source, target)))
    return found


def _path(source: Lane, target: Lane) -> Array:
    a, b = source.center[-1] - source.center[-2], target.center[1] - target.center[0]
    return hermite(
        source.center[-1], a / np.linalg.norm(a), target.center[0], b / np.linalg.norm(b), 16, 1.1
    )
