"""Who is on the street: the ego vehicle's drive, other traffic, parked vehicles and people."""

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from minicity.curves import Array, arc_lengths, resample, tangents
from minicity.meshes import Color
from minicity.roads import Lane
from minicity.town import Town
from minicity.vehicles import Vehicle

KINDS: list[tuple[str, tuple[float, float, float], float]] = [
    ("vehicle.car", (4.5, 1.85, 1.55), 0.78),
    ("vehicle.truck", (6.6, 2.2, 2.7), 0.14),
    ("vehicle.bus.rigid", (10.8, 2.5, 3.2), 0.08),
]
PAINTS: list[Color] = [
    (225, 225, 225),
    (40, 40, 42),
    (130, 130, 132),
    (40, 40, 170),
    (150, 70, 35),
    (60, 110, 60),
    (70, 150, 200),
]
REACH_M = 75.0
SWING_M = 6.0


@dataclass(frozen=True)
class Drive:
    """A path driven at constant speed, swinging gently about the lane's centre.

    Attributes:
        path: Lane centres one after another. (n, 2)
        speed: Speed along it in m/s.
        start_m: Arc length at time 0.
        swing_m: Amplitude of the swing.
        swing_rad: Phase of the swing.
        shift_m: Constant offset to the left.
    """

    path: Array
    speed: float
    start_m: float = 0.0
    swing_m: float = 0.0
    swing_rad: float = 0.0
    shift_m: float = 0.0

    def __post_init__(self) -> None:
        """Prepare the path's tables: plain lists, since ``pose`` reads single entries."""
        lengths = arc_lengths(self.path)
        rows = np.column_stack([self.path, tangents(self.path)])
        object.__setattr__(self, "_lengths", lengths.tolist())
        object.__setattr__(self, "_rows", rows.tolist())

    def pose(self, time_s: float) -> tuple[float, float, float]:
        """x, y and heading at a time."""
        lengths: list[float] = self._lengths  # type: ignore[attr-defined]
        rows: list[list[float]] = self._rows  # type: ignore[attr-defined]
        at = min(max(self.start_m + self.speed * time_s, 0.0), lengths[-1])
        i = min(max(bisect_right(lengths, at) - 1, 0), len(lengths) - 2)
        share = (at - lengths[i]) / (lengths[i + 1] - lengths[i])
        x, y, dx, dy = (a + share * (b - a) for a, b in zip(rows[i], rows[i + 1], strict=True))
        norm = math.hypot(dx, dy)
        dx, dy = dx / norm, dy / norm
        phase = self.swing_rad + at / SWING_M
        side = self.shift_m + self.swing_m * math.sin(phase)
        slope = self.swing_m * math.cos(phase) / SWING_M
        return x - side * dy, y + side * dx, math.atan2(dy, dx) + math.atan(slope)


def follow_lanes(town: Town, first: Lane, length_m: float, rng: np.random.Generator) -> Array:
    """A path that starts at the head of a lane and turns at random at junctions. (n, 2)"""
    pieces, total, lane = [first.center], float(arc_lengths(first.center)[-1]), first
    while total < length_m and town.connectors.get(lane.key):
        options = town.connectors[lane.key]
        choice = options[int(rng.integers(len(options)))]
        pieces += [choice.center[1:-1], choice.target.center]
        total += sum(float(arc_lengths(p)[-1]) for p in (choice.center, choice.target.center))
        lane = choice.target
    return resample(np.concatenate(pieces), 1.5)


def plan_ego(town: Town, scene: int, duration_s: float, rng: np.random.Generator) -> Drive:
    """Plan the ego vehicle's drive.

    Scenes of one town start on different roads, often at junctions.

    Args:
        town: The town.
        scene: Number of the scene in its town.
        duration_s: Length of the scene in seconds.
        rng: Draws lane, speed and start.
    """
    order = np.random.default_rng(len(town.roads)).permutation(len(town.roads))
    for attempt in range(60):
        road = town.roads[int(order[(scene + attempt * 7) % len(order)])]
        lanes = road.lanes()
        lane = lanes[int(rng.integers(len(lanes)))]
        speed = float(rng.uniform(5.0, 13.0))
        needed = speed * duration_s + 8.0
        lane_m = float(arc_lengths(lane.center)[-1])
        latest = max(lane_m - 6.0, 0.0)
        start = float(
            rng.uniform(max(0.0, latest - needed - 10.0), latest)
            if rng.random() < 0.6
            else rng.uniform(0, latest)
        )
        path = follow_lanes(town, lane, start + needed, rng)
        if arc_lengths(path)[-1] >= start + needed - 4.0:
            swing = float(rng.uniform(0.0, 0.55))
            return Drive(
                path, speed, start, swing, float(rng.uniform(0, 6.28)), float(rng.normal(0, 0.2))
            )
    raise RuntimeError(
        f"town {town.name} has no drive of {duration_s} s: please report this with the seed."
    )


@dataclass(frozen=True)
class Actor:
    """A vehicle or person and how it moves.

    Attributes:
        model: What it is; position and heading are ignored where ``drive`` is set.
        drive: Its path, None for what stands still.
    """

    model: Vehicle
    drive: Drive | None

    def at(self, time_s: float) -> Vehicle:
        """The actor at a time."""
        if self.drive is None:
            return self.model
        x, y, yaw = self.drive.pose(time_s)
        m = self.model
        center = np.array([x, y, m.size[2] / 2])
        return Vehicle(m.category, center, yaw, m.size, m.color, m.identity, self.drive.speed)


def _model(rng: np.random.Generator, identity: str, only_cars: bool = False) -> Vehicle:
    kind = 0 if only_cars else int(rng.choice(len(KINDS), p=[k[2] for k in KINDS]))
    category, size, _ = KINDS[kind]
    scale = float(rng.uniform(0.93, 1.07))
    size = (round(size[0] * scale, 3), round(size[1] * scale, 3), round(size[2] * scale, 3))
    color = PAINTS[int(rng.integers(len(PAINTS)))]
    return Vehicle(category, np.zeros(3), 0.0, size, color, identity)


def _stand(model: Vehicle, x: float, y: float, yaw: float) -> Actor:
    center = np.array([x, y, model.size[2] / 2])
    return Actor(
        Vehicle(model.category, center, yaw, model.size, model.color, model.identity), None
    )


def make_actors(town: Town, ego: Drive, duration_s: float, rng: np.random.Generator) -> list[Actor]:
    """Make the traffic around the ego vehicle's drive; nobody touches it or one another.

    Args:
        town: The town.
        ego: The ego vehicle's drive.
        duration_s: Length of the scene in seconds.
        rng: Draws who is there.
    """
    times = np.linspace(0.0, duration_s, 8).tolist()
    ego_track = np.array([ego.pose(t)[:2] for t in times])
    density = float(rng.uniform(0.25, 1.0))
    candidates = _moving(town, ego_track, density, rng) + _parked(town, ego_track, density, rng)
    candidates += _people(town, ego_track, rng)
    kept: list[Actor] = []
    tracks: list[NDArray[np.float64]] = []
    for actor in candidates:
        track = np.array([actor.at(t).center[:2] for t in times])
        to_ego, to_others = _room(actor)
        if all(
            np.linalg.norm(track - other, axis=1).min() >= gap
            for other, gap in [(ego_track, to_ego), *((t, to_others) for t in tracks)]
        ):
            kept.append(actor)
            tracks.append(track)
    return kept


def _room(actor: Actor) -> tuple[float, float]:
    """Least distance in metres that an actor keeps from the ego vehicle and from the others."""
    if actor.model.category.startswith("human"):
        return 2.5, 0.7
    half = actor.model.size[0] / 2
    # What is parked may stand beside the ego vehicle; what moves may come at it lengthwise.
    to_ego = 2.8 + 0.35 * half if actor.drive is None else 3.6 + half
    return to_ego, 1.2 + 0.6 * half


def _near(points: Array, track: Array, reach_m: float) -> bool:
    return bool(np.linalg.norm(points[:, None] - track[None], axis=-1).min() < reach_m)


def _moving(town: Town, track: Array, density: float, rng: np.random.Generator) -> list[Actor]:
    actors: list[Actor] = []
    for lane in town.lanes.values():
        if not _near(lane.center[::6], track, REACH_M):
            continue
        at = float(rng.uniform(0, 40))
        lane_m = float(arc_lengths(lane.center)[-1])
        speed = float(rng.choice([0.0, rng.uniform(4, 12)], p=[0.25, 0.75]))
        while at < lane_m:
            path = follow_lanes(town, lane, at + speed * 20, rng)
            drive = Drive(path, speed, at, 0.1, float(rng.uniform(0, 6)), float(rng.normal(0, 0.1)))
            actors.append(Actor(_model(rng, f"m{len(actors)}"), drive))
            at += float(rng.uniform(12, 60)) / density
    return actors


def _parked(town: Town, track: Array, density: float, rng: np.random.Generator) -> list[Actor]:
    actors: list[Actor] = []
    for road in town.roads:
        section = road.section
        if not _near(road.center[::6], track, REACH_M):
            continue
        for offset, width, turned in (
            (section.right_m + 1.15, section.right_shoulder_m, 0.0),
            (section.left_m - 1.15, section.left_shoulder_m, np.pi if section.backward else 0.0),
        ):
            at = float(rng.uniform(4, 12))
            while width > 2 and at < road.length_m - 12:
                if rng.random() < 0.55 * density + 0.15:
                    x, y = road.point(at, offset)
                    actors.append(
                        _stand(
                            _model(rng, f"p{len(actors)}", True), x, y, road.direction(at) + turned
                        )
                    )
                at += 6.2
    for park in town.carparks:
        if _near(park.slots[:, :2], track, REACH_M):
            for x, y, yaw in park.slots:
                if rng.random() < 0.65:
                    actors.append(_stand(_model(rng, f"p{len(actors)}", True), x, y, yaw))
    return actors


def _people(town: Town, track: Array, rng: np.random.Generator) -> list[Actor]:
    actors: list[Actor] = []
    for road in town.roads:
        if not _near(road.center[::6], track, REACH_M):
            continue
        section = road.section
        spots = []
        for _ in range(int(road.length_m / 18)):
            side = section.right_m - 1.2 if rng.random() < 0.5 else section.left_m + 1.2
            spots.append((float(rng.uniform(0, road.length_m)), side))
        for a, b in road.crossings:
            if rng.random() < 0.4:
                spots.append(
                    (float(rng.uniform(a, b)), float(rng.uniform(section.right_m, section.left_m)))
                )
        for at, offset in spots:
            x, y = road.point(at, offset)
            size = (0.5, 0.6, round(float(rng.uniform(1.5, 1.9)), 3))
            color = PAINTS[int(rng.integers(len(PAINTS)))]
            model = Vehicle(
                "human.pedestrian.adult", np.zeros(3), 0.0, size, color, f"w{len(actors)}"
            )
            actors.append(_stand(model, x, y, float(rng.uniform(0, 6.28))))
    return actors
