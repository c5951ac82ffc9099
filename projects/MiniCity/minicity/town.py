"""Town: roads, junctions, crossings, car parks, buildings and street furniture."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from minicity.config import make_rng
from minicity.curves import Array, rectangle
from minicity.junctions import Connector, Junction, make_connectors, make_junction
from minicity.network import MARGIN_M, MIN_ROAD_M, PITCH_M, make_chains, make_nodes, make_roads
from minicity.roads import CROSSING_GAP_M, STOP_LINE_M, Lane, Road

LaneKey = tuple[int, bool, int]
"""Key of a lane within its town: index of the road, direction, and index of the lane."""
MAX_SIDE = 8  # largest number of grid nodes along an edge of a town
# Houses cannot touch if their centres are farther apart than this in x or y. The largest house is
# 16 x 12 m, with a diagonal of 20 m.
LARGEST_HOUSE_M = 22.0
END_STOP_M = 0.6  # distance of a stop line without a crossing from the end of its road
BAY_WIDTH_M = 2.6
BAY_LENGTH_M = 5.0
CARPARK_DEPTH_M = 15.0  # extent of a car park away from its road
# Colours of the walls, BGR.
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
    """Car park beside a road. Coordinates are in metres.

    Attributes:
        outline: Outline of the surface. (n, 2)
        driveway: Outline of the strip from the road across the pavement. (4, 2)
        bays: Lines beside the bays, one more than there are bays. Each (2, 2)
        slots: x, y and heading in radians of the place for a vehicle in each bay. (n, 3)
    """

    outline: Array
    driveway: Array
    bays: list[Array]
    slots: Array


@dataclass(frozen=True)
class Building:
    """House on a rectangular footprint.

    Attributes:
        footprint: Corners in metres, anticlockwise. (4, 2)
        height_m: Height in metres.
        color: Colour of the walls, BGR in [0, 255].
    """

    footprint: Array
    height_m: float
    color: tuple[float, float, float]


@dataclass
class Town:
    """Town with all data for a map file and for the renderer. Coordinates are in metres.

    Attributes:
        name: Location name.
        size_m: Edge of the square canvas around the town, in metres.
        roads: Streets between junctions.
        junctions: Junctions of three or four roads.
        lanes: Every lane by its key.
        connectors: Paths across junctions, by the key of the lane that leads to them.
        carparks: Car parks.
        buildings: Houses.
        trees: x, y and height of the trees. (n, 3)
        poles: x, y and height of the lamp posts. (n, 3)
        walkways: Pavement polygons.
        drivable: Union of all surfaces for vehicles.
    """

    name: str
    size_m: float
    roads: list[Road]
    junctions: list[Junction]
    lanes: dict[LaneKey, Lane]
    connectors: dict[LaneKey, list[Connector]]
    carparks: list[Carpark] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    trees: Array = field(default_factory=lambda: np.zeros((0, 3)))
    poles: Array = field(default_factory=lambda: np.zeros((0, 3)))
    walkways: list[Polygon] = field(default_factory=list)
    drivable: Polygon = field(default_factory=Polygon)


def town_side(num_scenes: int) -> int:
    """Number of grid nodes along the edge of a town, for scenes that rarely share a street.

    The town has about 1.3 nodes per scene, but at least 3 and at most ``MAX_SIDE`` along its edge.
    """
    return int(np.clip(np.ceil(np.sqrt(1.3 * num_scenes)), 3, MAX_SIDE))


def make_town(name: str, seed: int, num_scenes: int) -> Town:
    """Build a town. The result depends on the arguments alone.

    Args:
        name: Location name; towns of different names differ for each seed.
        seed: Seed of the data set.
        num_scenes: Number of scenes in the town, which decides its size; 0 gives an empty town.

    Returns:
        The town, with valid polygons.
    """
    if num_scenes == 0:
        return Town(name, 2 * MARGIN_M, roads=[], junctions=[], lanes={}, connectors={})
    side = town_side(num_scenes)
    # Streets (`chains`) join the grid nodes. A road is a street without its parts in junctions.
    # Each step has a separate random generator, so a change of one does not affect the others.
    nodes = make_nodes(side, seed, name=name)
    chains = make_chains(nodes, seed, name=name)
    roads, meetings = make_roads(nodes, chains, seed=seed, name=name)
    for road in roads:
        _add_crossings(road, make_rng(seed, name, "crossings", road.index))
    junctions = []
    for node, meeting in enumerate(meetings):  # the roads that meet at each node
        if len(meeting) >= 3:  # fewer roads make no junction
            arms = [(road_index, at_start) for road_index, at_start, _ in meeting]
            junctions.append(make_junction(node, arms, roads=roads))
    lanes, connectors = connect_lanes(roads, junctions)
    town = Town(
        name=name,
        size_m=2 * MARGIN_M + (side - 1) * PITCH_M,
        roads=roads,
        junctions=junctions,
        lanes=lanes,
        connectors=connectors,
    )
    _add_surroundings(town, make_rng(seed, name, "surroundings"))
    return town


def connect_lanes(
    roads: list[Road], junctions: list[Junction]
) -> tuple[dict[LaneKey, Lane], dict[LaneKey, list[Connector]]]:
    """Make the lanes of all roads and the paths between them.

    Args:
        roads: Roads of the town.
        junctions: Junctions of the roads.

    Returns:
        Lanes by key, and paths across junctions by the key of the lane from which they start.
    """
    lanes_by_road = {road.index: road.lanes() for road in roads}
    connectors: dict[LaneKey, list[Connector]] = {}
    for junction in junctions:
        for connector in make_connectors(junction, lanes_by_road):  # all permitted turns
            connectors.setdefault(connector.source.key, []).append(connector)
    lanes = {}
    for road_lanes in lanes_by_road.values():
        for lane in road_lanes:
            lanes[lane.key] = lane
    return lanes, connectors


def _add_crossings(road: Road, rng: np.random.Generator) -> None:
    """Add random crossings and stop lines to a road, in place."""
    length = road.length_m
    if length < MIN_ROAD_M:
        return
    for at_start in (True, False):
        # Number of lanes that lead to this end of the road.
        lanes_in = road.section.backward if at_start else road.section.forward
        if rng.random() < 0.62:  # a crossing, often with a stop line
            gap_m = CROSSING_GAP_M + float(rng.choice([0.0, 2.0]))
            depth_m = float(rng.uniform(low=2.5, high=4.5))
            stop = lanes_in > 0 and rng.random() < 0.8
            # The crossing begins `gap_m` from this end. The paint of dividers ends before it.
            road.add_crossing(gap_m, depth_m, at_start=at_start, stop=stop)
        elif lanes_in and rng.random() < 0.6:  # only a stop line, at which painted dividers end
            if at_start:
                road.stop_backward = (END_STOP_M, END_STOP_M + STOP_LINE_M)
                road.clear_start_m = END_STOP_M + STOP_LINE_M
            else:
                road.stop_forward = (length - END_STOP_M - STOP_LINE_M, length - END_STOP_M)
                road.clear_end_m = length - END_STOP_M - STOP_LINE_M
    if length > 70 and rng.random() < 0.25:  # a crossing of 3.2 m near the middle of the road
        middle = float(rng.uniform(low=0.4, high=0.6)) * length
        road.crossings.append((middle - 1.6, middle + 1.6))


def road_surface(road: Road) -> list[Polygon]:
    """Kerb-to-kerb polygons of a road, in metres."""
    surfaces = []
    for right, left in road.carriageways():
        outline = road.band_with_mouths(right, left)
        surfaces.append(Polygon(outline))
    return surfaces


def _add_surroundings(town: Town, rng: np.random.Generator) -> None:
    """Add car parks, pavements, houses, trees and lamp posts to a town, in place."""
    surfaces = []  # for vehicles
    medians = []
    pavements = []  # outlines of roads and junctions together with their pavements
    for road in town.roads:
        section = road.section
        surfaces += road_surface(road)
        if section.median_m > 0:
            median = road.band(section.forward_edges[0], section.backward_edges[0])
            medians.append(Polygon(median))
        pavement = road.band(
            right_m=section.right_m - road.style.walkway_m,
            left_m=section.left_m + road.style.walkway_m,
        )
        pavements.append(Polygon(pavement))
    for junction in town.junctions:
        outline = Polygon(junction.outline)
        surfaces.append(outline)
        pavements.append(outline.buffer(2.5))
    streets = shapely.union_all(surfaces)  # roads and junctions, without car parks
    # The outline of a road in a sharp bend may cross itself, which `buffer(0)` repairs.
    areas = [*pavements, *medians, *surfaces]
    blocked = shapely.union_all([area.buffer(0) for area in areas])
    _add_carparks(town, blocked, rng=rng)
    parks = []
    for carpark in town.carparks:
        park = Polygon(carpark.outline).union(Polygon(carpark.driveway))
        parks.append(park)
    town.drivable = shapely.union_all([streets, *parks])
    # Pavements are the parts of these outlines that are neither for vehicles nor medians. Slivers
    # are left out.
    outlines = shapely.union_all([pavement.buffer(0) for pavement in pavements])
    all_medians = shapely.union_all(medians)
    walkways = outlines.difference(town.drivable).difference(all_medians)
    town.walkways = []
    for piece in shapely.get_parts(walkways):
        if piece.geom_type == "Polygon" and piece.area > 0.5:
            town.walkways.append(piece)
    park_margins = [park.buffer(1.0) for park in parks]
    without_houses = shapely.union_all([blocked.buffer(0.6), *park_margins])
    _add_buildings(town, blocked=without_houses, rng=rng)
    _add_furniture(town, rng)


def _add_carparks(town: Town, blocked: Polygon, rng: np.random.Generator) -> None:
    """Add car parks beside random roads, outside of ``blocked`` and of one another, in place."""
    for road in town.roads:
        if road.length_m < 60 or rng.random() > 0.45:
            continue
        sign = 1 if rng.random() < 0.5 else -1
        middle = float(rng.uniform(low=0.35, high=0.65)) * road.length_m
        bays = int(rng.integers(6, 11))
        park = _make_carpark(road, sign, middle_m=middle, bays=bays)
        surface = Polygon(park.outline)
        if surface.buffer(0.3).intersects(blocked):
            continue
        town.carparks.append(park)
        blocked = blocked.union(surface.buffer(0.5))


def _make_carpark(road: Road, sign: int, middle_m: float, bays: int) -> Carpark:
    """Make a car park behind the pavement of a road.

    Args:
        road: The road.
        sign: 1 for the left side of the road, -1 for the right side.
        middle_m: Arc length of the middle of the car park, in metres.
        bays: Number of bays.
    """
    kerb = road.section.left_m if sign > 0 else road.section.right_m
    # Distance of the near edge of the car park from the centre line of the road, in metres.
    near = abs(kerb) + road.style.walkway_m + 0.5
    length = bays * BAY_WIDTH_M
    yaw = road.direction(middle_m)
    center = road.point(middle_m, sign * (near + CARPARK_DEPTH_M / 2))
    outline = rectangle(center, yaw, length_m=length, width_m=CARPARK_DEPTH_M)
    # The driveway overlaps the road by 0.3 m and the car park by 0.5 m, so that no gap is left.
    inner = road.point(middle_m, sign * (abs(kerb) - 0.3))
    mouth = road.point(middle_m, sign * (near + 0.5))
    driveway = rectangle(
        center=0.5 * (inner + mouth),
        yaw_rad=yaw,
        length_m=5.0,
        width_m=float(np.linalg.norm(mouth - inner)),
    )
    # Corners of `rectangle`: front left, back left, back right, front right. `along` is the unit
    # vector along the road, and `across` the unit vector away from the road.
    along = outline[0] - outline[1]
    along = along / np.linalg.norm(along)
    across = sign * (outline[0] - outline[3]) / CARPARK_DEPTH_M
    heading = float(np.arctan2(across[1], across[0]))
    far = center + across * (CARPARK_DEPTH_M / 2 - 0.3)  # middle of the far ends of the bays
    lines = []
    slots = []
    for k in range(bays + 1):  # n bays have n + 1 lines
        end = far + along * (k * BAY_WIDTH_M - length / 2)
        lines.append(np.stack([end, end - BAY_LENGTH_M * across]))
        if k < bays:
            # 2.6 m from the far end of the bay is near its middle.
            slot = end + along * BAY_WIDTH_M / 2 - 2.6 * across
            slots.append(np.append(slot, heading))
    return Carpark(outline, driveway, bays=lines, slots=np.array(slots))


def _add_buildings(town: Town, blocked: Polygon, rng: np.random.Generator) -> None:
    """Add houses along both sides of every road, clear of surfaces and of one another, in place."""
    shapely.prepare(blocked)  # speeds up the many tests of intersection below
    centers = np.zeros((0, 2))  # centres of the houses that have been added
    for road in town.roads:
        dense = rng.random() < 0.75  # houses close to the pavement and to one another
        # `sign` is the side of the road, 1 for left and -1 for right. `kerb` is the distance of its
        # kerb from the centre line.
        for sign, kerb in ((1, road.section.left_m), (-1, -road.section.right_m)):
            arc_m = float(rng.uniform(low=0, high=10))
            while arc_m < road.length_m - 5:
                front = float(rng.uniform(low=8, high=16))
                # The setback is the distance of the front from the kerb.
                max_garden_m = 3.0 if dense else 9.0
                setback = road.style.walkway_m + float(rng.uniform(low=1.0, high=max_garden_m))
                house = _random_building(
                    road=road,
                    at_m=min(arc_m + front / 2, road.length_m - 0.1),
                    front_offset_m=sign * (kerb + setback),
                    front_m=front,
                    rng=rng,
                )
                gap = rng.uniform(low=0.5, high=3.0) if dense else rng.uniform(low=4, high=25)
                arc_m += front + float(gap)
                outline = Polygon(house.footprint)
                center = house.footprint.mean(axis=0)
                # Only houses with small distances in both x and y can touch this one.
                distances = np.abs(centers - center).max(axis=1, initial=0.0)
                neighbours = np.flatnonzero(distances < LARGEST_HOUSE_M)
                if blocked.intersects(outline) or _touches_building(town, outline, neighbours):
                    continue
                town.buildings.append(house)
                centers = np.concatenate([centers, center[None]])


def _touches_building(town: Town, outline: Polygon, candidates: NDArray[np.int64]) -> bool:
    """Whether an outline touches one of the buildings with the indices ``candidates``. (n,)"""
    return any(outline.intersects(Polygon(town.buildings[k].footprint)) for k in candidates)


def _random_building(
    road: Road, at_m: float, front_offset_m: float, front_m: float, rng: np.random.Generator
) -> Building:
    """Create a random house beside a road.

    Args:
        road: The road.
        at_m: Arc length of the middle of the front, in metres.
        front_offset_m: Offset of the front in metres, positive to the left of the road.
        front_m: Length of the front in metres.
        rng: Source of depth, height and colour.
    """
    depth = float(rng.uniform(low=8, high=12))
    center = road.point(at_m, front_offset_m + np.sign(front_offset_m) * depth / 2)
    footprint = rectangle(center, road.direction(at_m), length_m=front_m, width_m=depth)
    is_low = rng.random() < 0.6
    lowest, highest = (4, 9) if is_low else (9, 22)
    height = float(rng.uniform(low=lowest, high=highest))
    shade = float(rng.uniform(low=0.75, high=1.15))
    blue, green, red = WALLS[int(rng.integers(len(WALLS)))]
    return Building(footprint, height, color=(blue * shade, green * shade, red * shade))


def _add_furniture(town: Town, rng: np.random.Generator) -> None:
    """Add trees and lamp posts along every road, clear of houses and vehicles, in place."""
    trees = []
    poles = []
    houses = [Polygon(b.footprint).buffer(1.2) for b in town.buildings]
    keep_clear = shapely.union_all([*houses, town.drivable.buffer(0.5)])
    shapely.prepare(keep_clear)  # speeds up the many tests below
    for road in town.roads:
        tree_share = rng.random()  # share of the places for trees along this road that have one
        # As for houses: the side of the road, and the distance of its kerb from the centre line.
        for sign, kerb in ((1, road.section.left_m), (-1, -road.section.right_m)):
            first_tree = rng.uniform(low=3, high=12)
            for arc_m in np.arange(first_tree, road.length_m - 3, 11.0):
                back = road.style.walkway_m + 1.0  # distance from the kerb: behind the pavement
                if rng.random() < 0.6:
                    back = float(rng.uniform(low=0.9, high=1.5))  # on the pavement
                x, y = road.point(float(arc_m), sign * (kerb + back))
                if rng.random() < tree_share and not keep_clear.contains(shapely.Point(x, y)):
                    trees.append([x, y, rng.uniform(low=3.5, high=7.5)])
            first_pole = rng.uniform(low=2, high=20)
            for arc_m in np.arange(first_pole, road.length_m - 2, 27.0):
                x, y = road.point(float(arc_m), sign * (kerb + 0.65))
                if not keep_clear.contains(shapely.Point(x, y)):
                    poles.append([x, y, rng.uniform(low=5.0, high=8.0)])
    # `reshape` gives the arrays the right shape if there is none.
    town.trees = np.array(trees).reshape(-1, 3)
    town.poles = np.array(poles).reshape(-1, 3)
