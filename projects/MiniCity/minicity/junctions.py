"""Junctions: outlines between the mouths of their roads, and driving paths across them.

A mouth is the cross-section of a road where it meets a junction.
"""

from dataclasses import dataclass

import numpy as np

from minicity.curves import Array, hermite
from minicity.roads import Lane, Road

CONNECTOR_M = 3.2  # width of the lane of a `Connector` in map files
STRAIGHT_RAD = 0.6  # a smaller turning angle counts as straight on


@dataclass(frozen=True)
class Junction:
    """Junction of three or four roads.

    Attributes:
        node: Index of the node of the road network that the junction lies at.
        outline: Closed outline of kerbs and road mouths in metres, anticlockwise. (n, 2)
        corners: Kerb lines between neighbouring roads, in metres. Each (m, 2)
        arms: Index of each road, and whether the road starts here; anticlockwise.
    """

    node: int
    outline: Array
    corners: list[Array]
    arms: list[tuple[int, bool]]


@dataclass(frozen=True)
class Connector:
    """Path across a junction from a lane into a lane of another road.

    Attributes:
        source: Lane that leads to the junction.
        target: Lane that leaves the junction.
        center: Centre line of the path between the two lanes, in metres. (n, 2)
    """

    source: Lane
    target: Lane
    center: Array


def mouth(road: Road, at_start: bool) -> Array:
    """Points of the mouth of a road at a junction.

    The points go from the right kerb to the left kerb, as seen by a driver who leaves the junction.

    Args:
        road: The road.
        at_start: Whether the junction lies at the start of the road.

    Returns:
        Edges of lanes, median and kerbs at the end of the road, in metres. (n, 2)
    """
    end = 0 if at_start else -1
    points = np.stack([road.line(offset_m)[end] for offset_m in road.section.all_offsets])
    # Offsets go from right to left for a driver in the direction of the centre line. At the end of
    # the road this driver enters the junction, so the order is reversed for a driver who leaves it.
    return points if at_start else points[::-1]


def _outward(road: Road, at_start: bool) -> Array:
    """Unit direction in which a road leaves a junction. (2,)"""
    step = road.center[1] - road.center[0] if at_start else road.center[-2] - road.center[-1]
    return step / np.linalg.norm(step)


def make_junction(node: int, arms: list[tuple[int, bool]], roads: list[Road]) -> Junction:
    """Join the mouths of the roads at a node by rounded kerbs.

    Args:
        node: Index of the node.
        arms: Index of each road, and whether it starts here; anticlockwise.
        roads: All roads of the town.

    Returns:
        The junction.
    """
    mouths = [mouth(roads[r], at_start) for r, at_start in arms]
    outward = [_outward(roads[r], at_start) for r, at_start in arms]
    corners = []
    ring = []  # mouths and corners in turn
    for i in range(len(arms)):
        j = (i + 1) % len(arms)  # next road anticlockwise
        # The corner leads from the left kerb of road i, along the junction, to the right kerb of
        # road j. The tangents at its ends (`pull`) are longer for sharper turns.
        turn_rad = float(np.arccos(np.clip(-outward[i] @ outward[j], -1, 1)))
        corner = hermite(
            start=mouths[i][-1],
            start_dir=-outward[i],
            end=mouths[j][0],
            end_dir=outward[j],
            count=12,
            pull=1.0 + 0.25 * turn_rad,
        )
        corners.append(corner)
        ring += [mouths[i], corner[1:-1]]  # a corner starts and ends with points of the mouths
    return Junction(node, np.concatenate(ring), corners=corners, arms=arms)


def _turning_angle(source: Lane, target: Lane) -> float:
    """Angle in radians from the end of one lane to the start of another, positive to the left."""
    # The signed angle is the arctangent of the cross product over the dot product.
    last_step = source.center[-1] - source.center[-2]
    first_step = target.center[1] - target.center[0]
    cross = last_step[0] * first_step[1] - last_step[1] * first_step[0]
    return float(np.arctan2(cross, last_step @ first_step))


def _choose_target(source: Lane, lanes_in: int, targets: list[Lane]) -> Lane | None:
    """Choose the lane into which a driver turns.

    Args:
        source: Lane that leads to the junction.
        lanes_in: Number of lanes of the road of ``source`` in its direction, including ``source``.
        targets: Lanes of one road that leave the junction, the innermost one first.

    Returns:
        The lane, or None if drivers make this turn from another lane than ``source``.
    """
    angle = _turning_angle(source, targets[0])
    if angle > STRAIGHT_RAD:  # a left turn, from the innermost lane to the innermost one
        return targets[0] if source.index == 0 else None
    if angle < -STRAIGHT_RAD:  # a right turn, from the outermost lane to the outermost one
        return targets[-1] if source.index == lanes_in - 1 else None
    # Straight on, into the lane with the index of `source`, or into the outermost lane if the road
    # has fewer lanes.
    return targets[min(source.index, len(targets) - 1)]


def make_connectors(junction: Junction, lanes_by_road: dict[int, list[Lane]]) -> list[Connector]:
    """Make all permitted paths across a junction. There are no U-turns.

    Args:
        junction: The junction.
        lanes_by_road: Lanes of every road of the town, by road index. The lanes of each direction
            go from the innermost to the outermost one, as `Road.lanes` returns them.

    Returns:
        One path per permitted turn of each lane.
    """
    incoming: dict[int, list[Lane]] = {}
    outgoing: dict[int, list[Lane]] = {}
    for r, at_start in junction.arms:
        for lane in lanes_by_road[r]:
            # Forward lanes lead away from the junction if it is at the start of the road.
            is_incoming = lane.forward != at_start
            lanes = incoming if is_incoming else outgoing
            lanes.setdefault(r, []).append(lane)
    connectors = []
    for r_in, sources in incoming.items():
        for r_out, targets in outgoing.items():
            if r_in == r_out:
                continue
            for source in sources:
                target = _choose_target(source, lanes_in=len(sources), targets=targets)
                if target is not None:
                    path = _connector_path(source, target)
                    connectors.append(Connector(source, target, center=path))
    return connectors


def _connector_path(source: Lane, target: Lane) -> Array:
    """Smooth curve from the end of one lane to the start of another, in metres. (16, 2)"""
    last_step = source.center[-1] - source.center[-2]
    first_step = target.center[1] - target.center[0]
    return hermite(
        start=source.center[-1],
        start_dir=last_step / np.linalg.norm(last_step),
        end=target.center[0],
        end_dir=first_step / np.linalg.norm(first_step),
        count=16,
        pull=1.1,
    )
