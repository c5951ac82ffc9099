"""Road users of a scene: the ego vehicle's drive, other traffic, parked vehicles and people."""

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import WorkError
from minicity.curves import Array, arc_lengths, resample, tangents
from minicity.meshes import Color
from minicity.roads import Lane, Road
from minicity.town import Town
from minicity.vehicles import Vehicle

# Category of nuScenes, size (length, width, height) in metres, and share of all moving vehicles.
KINDS: list[tuple[str, tuple[float, float, float], float]] = [
    ("vehicle.car", (4.5, 1.85, 1.55), 0.78),
    ("vehicle.truck", (6.6, 2.2, 2.7), 0.14),
    ("vehicle.bus.rigid", (10.8, 2.5, 3.2), 0.08),
]
CAR_KIND = 0  # index of cars in ``KINDS``
# Colours of vehicles and clothes, BGR.
PAINTS: list[Color] = [
    (225, 225, 225),
    (40, 40, 42),
    (130, 130, 132),
    (40, 40, 170),
    (150, 70, 35),
    (60, 110, 60),
    (70, 150, 200),
]
REACH_M = 75.0  # largest distance of traffic from the drive of the ego vehicle
_LONGEST_SCENE_S = 20  # the paths of other vehicles are long enough for this time
SWING_M = 6.0  # distance in metres in which the phase of a swing grows by 1 radian
PASS_START_M = 3.0  # the start of another pass is shifted by at most this, forward or backward


@dataclass(frozen=True)
class Drive:
    """Drive along a path at constant speed, swinging gently around the lane's centre.

    The drive ends at the end of the path, where the vehicle stops.

    Attributes:
        path: Centre lines of successive lanes, concatenated, in metres. (n, 2)
        speed: Speed along the path in m/s.
        start_m: Arc length along the path at time 0, in metres.
        swing_m: Amplitude of the swing in metres.
        swing_rad: Phase of the swing in radians.
        shift_m: Constant offset to the left in metres.
    """

    path: Array
    speed: float
    start_m: float = 0.0
    swing_m: float = 0.0
    swing_rad: float = 0.0
    shift_m: float = 0.0

    def __post_init__(self) -> None:
        """Tabulate the path as plain lists, from which ``pose`` reads single entries quickly.

        A row has the position x, y and the unit tangent x, y of a point of the path.
        """
        lengths = arc_lengths(self.path)
        rows = np.column_stack([self.path, tangents(self.path)])
        object.__setattr__(self, "_lengths", lengths.tolist())
        object.__setattr__(self, "_rows", rows.tolist())

    def pose(self, time_s: float) -> tuple[float, float, float]:
        """Position x, y in metres and heading in radians at a time in seconds."""
        lengths: list[float] = self._lengths  # type: ignore[attr-defined]
        rows: list[list[float]] = self._rows  # type: ignore[attr-defined]
        arc_m = min(max(self.start_m + self.speed * time_s, 0.0), lengths[-1])
        # The position is between the points i and i + 1 of the path. Interpolate both position and
        # tangent.
        i = min(max(bisect_right(lengths, arc_m) - 1, 0), len(lengths) - 2)
        share = (arc_m - lengths[i]) / (lengths[i + 1] - lengths[i])
        x, y, dx, dy = [a + share * (b - a) for a, b in zip(rows[i], rows[i + 1], strict=True)]
        norm = math.hypot(dx, dy)
        dx = dx / norm
        dy = dy / norm
        phase = self.swing_rad + arc_m / SWING_M
        side = self.shift_m + self.swing_m * math.sin(phase)  # offset to the left of the path
        slope = self.swing_m * math.cos(phase) / SWING_M  # derivative of `side` by `arc_m`
        # The normal to the left of the path is (-dy, dx).
        return x - side * dy, y + side * dx, math.atan2(dy, dx) + math.atan(slope)


def follow_lanes(town: Town, first: Lane, length_m: float, rng: np.random.Generator) -> Array:
    """Create a path along lanes from the beginning of a lane, with random turns at junctions.

    Args:
        town: The town.
        first: First lane.
        length_m: Smallest length of the path in metres. The path is shorter if its last lane has no
            successor.
        rng: Random generator that chooses the turns.

    Returns:
        Path of equally spaced points, in metres. (n, 2)
    """
    lane = first
    pieces = [first.center]
    total = float(arc_lengths(first.center)[-1])
    while total < length_m and town.connectors.get(lane.key):
        options = town.connectors[lane.key]  # paths across the junction at the end of the lane
        connector = options[int(rng.integers(len(options)))]
        lane = connector.target
        # The ends of a connector are points of the two lanes, and are not repeated.
        pieces += [connector.center[1:-1], lane.center]
        total += float(arc_lengths(connector.center)[-1]) + float(arc_lengths(lane.center)[-1])
    return resample(np.concatenate(pieces), spacing_m=1.5)


def plan_ego(town: Town, scene: int, duration_s: float, rng: np.random.Generator) -> Drive:
    """Plan the ego vehicle's drive.

    Scenes of one town start on different roads. Most drives reach a junction.

    Args:
        town: The town.
        scene: Number of the scene in its town, where further passes of a street are not counted.
        duration_s: Duration of the scene in seconds.
        rng: Random generator that chooses lane, speed, start and swing.

    Returns:
        A drive whose path is long enough for the scene.

    Raises:
        RuntimeError: If the town has no path of sufficient length.
    """
    # A fixed order of the roads spreads the scenes over the town. An attempt fails if the lanes end
    # too early; the next one takes a road seven places further on.
    order = np.random.default_rng(len(town.roads)).permutation(len(town.roads))
    for attempt in range(60):
        road = town.roads[int(order[(scene + attempt * 7) % len(order)])]
        lanes = road.lanes()
        lane = lanes[int(rng.integers(len(lanes)))]
        speed = float(rng.uniform(low=5.0, high=13.0))
        length = speed * duration_s + 8.0  # the path goes on for 8 m after the drive
        lane_m = float(arc_lengths(lane.center)[-1])
        latest = max(lane_m - 6.0, 0.0)  # 6 m before the end of the lane
        # With probability 0.6, the drive ends near the junction at the end of the lane or beyond
        # it. Otherwise it starts anywhere on the lane.
        earliest = max(0.0, latest - length - 10.0) if rng.random() < 0.6 else 0.0
        start = float(rng.uniform(low=earliest, high=latest))
        path = follow_lanes(town, lane, length_m=start + length, rng=rng)
        if arc_lengths(path)[-1] >= start + length - 4.0:  # 4 m after the drive are enough
            return Drive(
                path=path,
                speed=speed,
                start_m=start,
                swing_m=float(rng.uniform(low=0.0, high=0.55)),
                swing_rad=float(rng.uniform(low=0, high=6.28)),
                shift_m=float(rng.normal(loc=0, scale=0.2)),
            )
    raise WorkError(
        f"town {town.name} has no drive of {duration_s} s: please report this with the seed."
    )


def vary_drive(drive: Drive, rng: np.random.Generator) -> Drive:
    """Vary start, speed and position in the lane of a drive, for another pass along its path.

    Args:
        drive: Drive of `plan_ego`.
        rng: Random generator of the differences.

    Returns:
        A drive along the path of ``drive``, which is also long enough for the scene.
    """
    # The path of `plan_ego` ends at least 4 m after the drive.
    start = drive.start_m + float(rng.uniform(low=-PASS_START_M, high=PASS_START_M))
    return replace(
        drive,
        speed=drive.speed * float(rng.uniform(low=0.8, high=1.0)),
        start_m=max(start, 0.0),
        swing_m=float(rng.uniform(low=0.0, high=0.55)),
        swing_rad=float(rng.uniform(low=0, high=6.28)),
        shift_m=float(rng.normal(loc=0, scale=0.2)),
    )


@dataclass(frozen=True)
class Actor:
    """Vehicle or person of a scene.

    Attributes:
        model: Kind, size and paint. Its position and heading are used only if ``drive`` is None.
        drive: Motion; None for vehicles and people at rest.
    """

    model: Vehicle
    drive: Drive | None

    def at(self, time_s: float) -> Vehicle:
        """Vehicle or person at a time in seconds."""
        if self.drive is None:
            return self.model
        x, y, yaw = self.drive.pose(time_s)
        center = np.array([x, y, self.model.size[2] / 2])
        return Vehicle(
            category=self.model.category,
            center=center,
            yaw_rad=yaw,
            size=self.model.size,
            color=self.model.color,
            identity=self.model.identity,
            speed=self.drive.speed,
        )


def _random_vehicle(rng: np.random.Generator, identity: str, only_cars: bool = False) -> Vehicle:
    """Create a vehicle of random kind, size and paint at the origin.

    Args:
        rng: Random generator of kind, size and paint.
        identity: Name of the vehicle, unique in its scene. Names begin with m for moving vehicles,
            with p for parked ones, and with w for people.
        only_cars: Whether the kind is always a car.
    """
    kind = CAR_KIND
    if not only_cars:
        kind = int(rng.choice(len(KINDS), p=[share for _, _, share in KINDS]))
    category, (length, width, height), _ = KINDS[kind]
    scale = float(rng.uniform(low=0.93, high=1.07))
    size = (round(length * scale, 3), round(width * scale, 3), round(height * scale, 3))
    color = PAINTS[int(rng.integers(len(PAINTS)))]
    return Vehicle(
        category, center=np.zeros(3), yaw_rad=0.0, size=size, color=color, identity=identity
    )


def _actor_at_rest(model: Vehicle, position: Array, yaw: float) -> Actor:
    """Actor that stands on the ground at a position (2,) in metres."""
    center = np.append(position, model.size[2] / 2)
    return Actor(replace(model, center=center, yaw_rad=yaw), drive=None)


def make_actors(town: Town, ego: Drive, duration_s: float, rng: np.random.Generator) -> list[Actor]:
    """Make the traffic around the ego vehicle's drive, with gaps between all road users.

    Args:
        town: The town.
        ego: The ego vehicle's drive.
        duration_s: Duration of the scene in seconds.
        rng: Random generator of all choices.

    Returns:
        Moving vehicles, parked vehicles and people.
    """
    # Gaps are checked at these times only. Earlier candidates have priority over later ones.
    times = np.linspace(0.0, duration_s, num=8).tolist()
    ego_track = np.array([ego.pose(t)[:2] for t in times])
    density = float(rng.uniform(low=0.25, high=1.0))
    candidates = [
        *_moving_vehicles(town, ego_track, density=density, rng=rng),
        *_parked_vehicles(town, ego_track, density=density, rng=rng),
        *_people(town, ego_track, rng=rng),
    ]
    actors: list[Actor] = []
    tracks: list[NDArray[np.float64]] = []
    for actor in candidates:
        track = np.array([actor.at(t).center[:2] for t in times])
        ego_gap, actor_gap = _least_gaps(actor)
        if _least_distance(track, ego_track) < ego_gap:
            continue
        if any(_least_distance(track, other) < actor_gap for other in tracks):
            continue
        actors.append(actor)
        tracks.append(track)
    return actors


def _least_distance(track: Array, other: Array) -> float:
    """Smallest distance in metres between the positions of two tracks (T, 2) at equal times."""
    return np.linalg.norm(track - other, axis=1).min()


def _least_gaps(actor: Actor) -> tuple[float, float]:
    """Smallest allowed distances in metres from an actor to the ego vehicle and to other actors.

    Distances are between centres.
    """
    if actor.model.category.startswith("human"):
        return 2.5, 0.7
    half = actor.model.size[0] / 2  # half the length of the vehicle
    # A parked vehicle may stand beside the ego vehicle; a moving one may approach it lengthwise.
    ego_gap = 2.8 + 0.35 * half if actor.drive is None else 3.6 + half
    return ego_gap, 1.2 + 0.6 * half


def _is_near(points: Array, track: Array) -> bool:
    """Whether any point (n, 2) lies within ``REACH_M`` of a track (T, 2), in metres."""
    distances = np.linalg.norm(points[:, None] - track[None], axis=-1)
    return bool(distances.min() < REACH_M)


def _moving_vehicles(
    town: Town, track: Array, density: float, rng: np.random.Generator
) -> list[Actor]:
    """Vehicles on the lanes near a track.

    Args:
        town: The town.
        track: Positions of the ego vehicle in metres. (T, 2)
        density: Number of vehicles relative to dense traffic, in (0, 1].
        rng: Random generator of all choices.
    """
    actors: list[Actor] = []
    for lane in town.lanes.values():
        if not _is_near(lane.center[::6], track):  # every sixth point is enough
            continue
        arc_m = float(rng.uniform(low=0, high=40))  # position of the next vehicle on the lane
        lane_m = float(arc_lengths(lane.center)[-1])
        # All vehicles of a lane are at rest, or they all drive at one speed, which keeps their
        # distances constant.
        driving_speed = rng.uniform(low=4, high=12)
        speed = float(rng.choice([0.0, driving_speed], p=[0.25, 0.75]))
        while arc_m < lane_m:
            drive = Drive(
                path=follow_lanes(town, lane, length_m=arc_m + speed * _LONGEST_SCENE_S, rng=rng),
                speed=speed,
                start_m=arc_m,
                swing_m=0.1,
                swing_rad=float(rng.uniform(low=0, high=6)),
                shift_m=float(rng.normal(loc=0, scale=0.1)),
            )
            actors.append(Actor(_random_vehicle(rng, f"m{len(actors)}"), drive=drive))
            arc_m += float(rng.uniform(low=12, high=60)) / density
    return actors


def _parked_vehicles(
    town: Town, track: Array, density: float, rng: np.random.Generator
) -> list[Actor]:
    """Cars on wide shoulders and in car parks near a track.

    Args:
        town: The town.
        track: Positions of the ego vehicle in metres. (T, 2)
        density: Traffic relative to dense traffic, in (0, 1].
        rng: Random generator of all choices.
    """
    actors = _cars_on_shoulders(town, track, density=density, rng=rng)
    for park in town.carparks:
        if not _is_near(park.slots[:, :2], track):
            continue
        for slot in park.slots:  # x, y, heading
            if rng.random() < 0.65:
                car = _random_vehicle(rng, f"p{len(actors)}", only_cars=True)
                actors.append(_actor_at_rest(car, slot[:2], yaw=slot[2]))
    return actors


def _cars_on_shoulders(
    town: Town, track: Array, density: float, rng: np.random.Generator
) -> list[Actor]:
    """Cars on wide shoulders near a track.

    Args:
        town: The town.
        track: Positions of the ego vehicle in metres. (T, 2)
        density: Traffic relative to dense traffic, in (0, 1]. In denser traffic, more parking
            places are in use.
        rng: Random generator of all choices.
    """
    actors: list[Actor] = []
    for road in town.roads:
        section = road.section
        if not _is_near(road.center[::6], track):  # every sixth point is enough
            continue
        # Cars on the left shoulder of a road with opposite traffic face backwards.
        left_turn = np.pi if section.backward else 0.0
        # Right side, then left side: offset of the parked cars (1.15 m inside of the kerb), width
        # of the shoulder, and turn of the cars from the direction of the road.
        for offset, width, turn in (
            (section.right_m + 1.15, section.right_shoulder_m, 0.0),
            (section.left_m - 1.15, section.left_shoulder_m, left_turn),
        ):
            arc_m = float(rng.uniform(low=4, high=12))
            if width <= 2:  # no room for a car
                continue
            while arc_m < road.length_m - 12:
                if rng.random() < 0.55 * density + 0.15:
                    car = _random_vehicle(rng, f"p{len(actors)}", only_cars=True)
                    yaw = road.direction(arc_m) + turn
                    actors.append(_actor_at_rest(car, road.point(arc_m, offset), yaw=yaw))
                arc_m += 6.2  # length of a parking place
    return actors


def _people(town: Town, track: Array, rng: np.random.Generator) -> list[Actor]:
    """People on the pavements and crossings near a track (T, 2) in metres."""
    actors: list[Actor] = []
    for road in town.roads:
        if not _is_near(road.center[::6], track):
            continue
        for arc_m, offset in _people_spots(road, rng):
            height = round(float(rng.uniform(low=1.5, high=1.9)), 3)
            person = Vehicle(
                category="human.pedestrian.adult",
                center=np.zeros(3),
                yaw_rad=0.0,
                size=(0.5, 0.6, height),
                color=PAINTS[int(rng.integers(len(PAINTS)))],
                identity=f"w{len(actors)}",
            )
            yaw = float(rng.uniform(low=0, high=6.28))
            actors.append(_actor_at_rest(person, road.point(arc_m, offset), yaw=yaw))
    return actors


def _people_spots(road: Road, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Random arc lengths and offsets of people beside a road and on its crossings, in metres."""
    section = road.section
    spots = []
    for _ in range(int(road.length_m / 18)):
        # 1.2 m beyond the kerb, on the pavement of one side or the other.
        offset = section.right_m - 1.2 if rng.random() < 0.5 else section.left_m + 1.2
        arc_m = float(rng.uniform(low=0, high=road.length_m))
        spots.append((arc_m, offset))
    for start, end in road.crossings:
        if rng.random() < 0.4:
            arc_m = float(rng.uniform(low=start, high=end))
            offset = float(rng.uniform(low=section.right_m, high=section.left_m))
            spots.append((arc_m, offset))
    return spots
