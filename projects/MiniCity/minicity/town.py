"""A whole town: roads, junctions, crossings, car parks, buildings and street furniture."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely.geometry import Polygon

from minicity.config import make_rng
from minicity.curves import Array, rectangle
from minicity.junctions import Connector, Junction, make_connectors, make_junction
from minicity.network import MARGIN_M, MIN_ROAD_M, PITCH_M, make_chains, make_nodes, make_roads
from minicity.roads import CROSSING_GAP_M, STOP_LINE_M, Lane, Road

MAX_SIDE = 8
LARGEST_HOUSE_M = 22.0
WALLS = [
    (150, 165, 190),
    (120, 140, 175),
    (175, 180, 185),
    (110, 125, 150),
    (165, 160, 150),
    (95, 105, 130),
]


@dataclass(frozen=True)
class Carpark:
    """A car park beside a road.

    Attributes:
        outline: Its surface. (n, 2)
        driveway: The strip that joins it to the road, across the pavement. (4, 2)
        bays: Lines between the bays. Each (2, 2)
        slots: Centres and headings of the bays. (n, 3)
    """

    outline: Array
    driveway: Array
    bays: list[Array]
    slots: Array


@dataclass(frozen=True)
class Building:
    """A house: footprint and height in metres, wall colour in BGR."""

    footprint: Array
    height_m: float
    color: tuple[float, float, float]


@dataclass
class Town:
    """All that a map file and a renderer need to know of one town.

    Attributes:
        name: Its location name.
        size_m: Edge of the square canvas that holds it.
        roads: Streets between junctions.
        junctions: Meeting places of three or more streets.
        lanes: Every lane by its key.
        connectors: Paths across junctions by the key of the lane they leave.
        carparks: Car parks.
        buildings: Houses.
        trees: x, y, height of trees. (n, 3)
        poles: x, y, height of lamp posts and signals. (n, 3)
        walkways: Pavement polygons.
        drivable: Union of all surfaces for vehicles.
    """

    name: str
    size_m: float
    roads: list[Road]
    junctions: list[Junction]
    lanes: dict[tuple[int, bool, int], Lane]
    connectors: dict[tuple[int, bool, int], list[Connector]]
    carparks: list[Carpark] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    trees: Array = field(default_factory=lambda: np.zeros((0, 3)))
    poles: Array = field(default_factory=lambda: np.zeros((0, 3)))
    walkways: list[Polygon] = field(default_factory=list)
    drivable: Polygon = field(default_factory=Polygon)


def town_side(num_scenes: int) -> int:
    """Grid nodes along a town's edge, so that its scenes rarely share a street."""
    return int(np.clip(np.ceil(np.sqrt(1.3 * num_scenes)), 3, MAX_SIDE))


def make_town(name: str, seed: int, num_scenes: int) -> Town:
    """Build a town. The result depends on the arguments alone.

    Args:
        name: Location name; two names with one seed give unrelated towns.
        seed: Seed of the data set.
        num_scenes: Scenes that will be driven in it: decides its size; 0 gives an empty town.

    Returns:
        The town, its polygons valid.
    """
    if num_scenes == 0:
        return Town(name, 2 * MARGIN_M, [], [], {}, {})
    side = town_side(num_scenes)
    nodes = make_nodes(side, seed, name)
    roads, meetings = make_roads(nodes, make_chains(nodes, seed, name), seed, name)
    for road in roads:
        _add_crossings(road, make_rng(seed, name, "crossings", road.index))
    lanes_by_road = {road.index: road.lanes() for road in roads}
    junctions = [
        make_junction(n, [(c, at_start) for c, at_start, _ in meeting], roads)
        for n, meeting in enumerate(meetings)
        if len(meeting) >= 3
    ]
    connectors: dict[tuple[int, bool, int], list[Connector]] = {}
    for junction in junctions:
        for connector in make_connectors(junction, lanes_by_road):
            connectors.setdefault(connector.source.key, []).append(connector)
    lanes = {lane.key: lane for group in lanes_by_road.values() for lane in group}
    size = 2 * MARGIN_M + (side - 1) * PITCH_M
    town = Town(name, size, roads, junctions, lanes, connectors)
    _add_surroundings(town, make_rng(seed, name, "surroundings"))
    return town


def _add_crossings(road: Road, rng: np.random.Generator) -> None:
    length = road.length_m
    if length < MIN_ROAD_M:
        return
    for at_start in (True, False):
        comes_in = road.section.backward if at_start else road.section.forward
        if rng.random() < 0.62:
            gap = CROSSING_GAP_M + float(rng.choice([0.0, 2.0]))
            road.add_crossing(
                gap, float(rng.uniform(2.5, 4.5)), at_start, comes_in > 0 and rng.random() < 0.8
            )
        elif comes_in and rng.random() < 0.6:
            if at_start:
                road.stop_backward, road.clear_start_m = (0.6, 0.6 + STOP_LINE_M), 0.6 + STOP_LINE_M
            else:
                road.stop_forward = (length - 0.6 - STOP_LINE_M, length - 0.6)
                road.clear_end_m = length - 0.6 - STOP_LINE_M
    if length > 70 and rng.random() < 0.25:
        middle = float(rng.uniform(0.4, 0.6)) * length
        road.crossings.append((middle - 1.6, middle + 1.6))


def road_surface(road: Road) -> list[Polygon]:
    """Kerb-to-kerb polygons of a road."""
    return [Polygon(road.band_with_mouths(right, left)) for right, left in road.carriageways()]


def _add_surroundings(town: Town, rng: np.random.Generator) -> None:
    surfaces = [p for road in town.roads for p in road_surface(road)]
    surfaces += [Polygon(j.outline) for j in town.junctions]
    medians = [
        Polygon(road.band(road.section.forward_edges[0], road.section.backward_edges[0]))
        for road in town.roads
        if road.section.median_m > 0
    ]
    streets = shapely.union_all(surfaces)
    pavements = [
        Polygon(
            road.band(
                road.section.right_m - road.style.walkway_m,
                road.section.left_m + road.style.walkway_m,
            )
        )
        for road in town.roads
    ]
    pavements += [Polygon(j.outline).buffer(2.5) for j in town.junctions]
    blocked = shapely.union_all([p.buffer(0) for p in [*pavements, *medians, *surfaces]])
    _add_carparks(town, blocked, rng)
    parks = [Polygon(p.outline).union(Polygon(p.driveway)) for p in town.carparks]
    town.drivable = shapely.union_all([streets, *parks])
    around = shapely.union_all([p.buffer(0) for p in pavements])
    raised = shapely.union_all(medians)
    pieces = shapely.get_parts(around.difference(town.drivable).difference(raised))
    town.walkways = [p for p in pieces if p.geom_type == "Polygon" and p.area > 0.5]
    _add_buildings(
        town, shapely.union_all([blocked.buffer(0.6), *[p.buffer(1.0) for p in parks]]), rng
    )
    _add_furniture(town, rng)


def _add_carparks(town: Town, blocked: Polygon, rng: np.random.Generator) -> None:
    for road in town.roads:
        if road.length_m < 60 or rng.random() > 0.45:
            continue
        sign = 1 if rng.random() < 0.5 else -1
        kerb = road.section.left_m if sign > 0 else road.section.right_m
        near = abs(kerb) + road.style.walkway_m + 0.5
        middle = float(rng.uniform(0.35, 0.65)) * road.length_m
        bays, depth, width = int(rng.integers(6, 11)), 15.0, 2.6
        length = bays * width
        yaw = road.direction(middle)
        center = road.point(middle, sign * (near + depth / 2))
        outline = rectangle(center, yaw, length, depth)
        if Polygon(outline).buffer(0.3).intersects(blocked):
            continue
        inner = road.point(middle, sign * (abs(kerb) - 0.3))
        mouth = road.point(middle, sign * (near + 0.5))
        driveway = rectangle(0.5 * (inner + mouth), yaw, 5.0, float(np.linalg.norm(mouth - inner)))
        along, across = outline[0] - outline[1], sign * (outline[0] - outline[3]) / depth
        along = along / np.linalg.norm(along)
        far = center + across * (depth / 2 - 0.3)
        ends = [far + along * (k * width - length / 2) for k in range(bays + 1)]
        lines = [np.stack([e, e - 5.0 * across]) for e in ends]
        heading = float(np.arctan2(across[1], across[0]))
        slots = [np.append(e + along * width / 2 - 2.6 * across, heading) for e in ends[:-1]]
        town.carparks.append(Carpark(outline, driveway, lines, np.array(slots)))
        blocked = blocked.union(Polygon(outline).buffer(0.5))


def _add_buildings(town: Town, blocked: Polygon, rng: np.random.Generator) -> None:
    """Line both sides of every road with houses that touch neither a surface nor one another."""
    shapely.prepare(blocked)
    built = np.full((0, 2), np.inf)
    for road in town.roads:
        dense = rng.random() < 0.75
        for sign, kerb in ((1, road.section.left_m), (-1, -road.section.right_m)):
            at = float(rng.uniform(0, 10))
            while at < road.length_m - 5:
                front = float(rng.uniform(8, 16))
                setback = road.style.walkway_m + float(rng.uniform(1.0, 3.0 if dense else 9.0))
                middle = min(at + front / 2, road.length_m - 0.1)
                house = _draw_building(road, middle, sign * (kerb + setback), front, rng)
                at += front + float(rng.uniform(0.5, 3.0) if dense else rng.uniform(4, 25))
                outline, center = Polygon(house.footprint), house.footprint.mean(0)
                near = np.flatnonzero(np.abs(built - center).max(1, initial=0.0) < LARGEST_HOUSE_M)
                if blocked.intersects(outline) or any(
                    outline.intersects(Polygon(town.buildings[k].footprint)) for k in near
                ):
                    continue
                town.buildings.append(house)
                built = np.concatenate([built, center[None]])


def _draw_building(
    road: Road, at_m: float, front_offset_m: float, front_m: float, rng: np.random.Generator
) -> Building:
    """A house whose front lies ``front_offset_m`` left of a road (right if negative)."""
    depth = float(rng.uniform(8, 12))
    center = road.point(at_m, front_offset_m + np.sign(front_offset_m) * depth / 2)
    footprint = rectangle(center, road.direction(at_m), front_m, depth)
    height = float(rng.uniform(4, 9) if rng.random() < 0.6 else rng.uniform(9, 22))
    shade = float(rng.uniform(0.75, 1.15))
    blue, green, red = WALLS[int(rng.integers(len(WALLS)))]
    return Building(footprint, height, (blue * shade, green * shade, red * shade))


def _add_furniture(town: Town, rng: np.random.Generator) -> None:
    trees, poles = [], []
    keep_clear = shapely.union_all(
        [Polygon(b.footprint).buffer(1.2) for b in town.buildings] + [town.drivable.buffer(0.5)]
    )
    shapely.prepare(keep_clear)
    for road in town.roads:
        leafy = rng.random()
        for sign, kerb in ((1, road.section.left_m), (-1, -road.section.right_m)):
            for at in np.arange(rng.uniform(3, 12), road.length_m - 3, 11.0):
                back = (
                    float(rng.uniform(0.9, 1.5))
                    if rng.random() < 0.6
                    else road.style.walkway_m + 1.0
                )
                spot = road.point(float(at), sign * (kerb + back))
                if rng.random() < leafy and not keep_clear.contains(shapely.Point(spot)):
                    trees.append([*spot, rng.uniform(3.5, 7.5)])
            for at in np.arange(rng.uniform(2, 20), road.length_m - 2, 27.0):
                spot = road.point(float(at), sign * (kerb + 0.65))
                if not keep_clear.contains(shapely.Point(spot)):
                    poles.append([*spot, rng.uniform(5.0, 8.0)])
    town.trees = np.array(trees).reshape(-1, 3)
    town.poles = np.array(poles).reshape(-1, 3)
