"""Transforms and odometry of a bag: where the cameras are on the vehicle, and its poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError
from mapdata.folders.rig import PoseTrack

VEHICLE_FRAMES = ("base_footprint", "base_link")
_GAP_NS = 10**9
_FOREVER_NS = 10**20
_SELDOM_NS = 500_000_000  # a transform that comes less often on average holds until its next one
_STILL_M = 1e-3
_STILL_JUMP_M = 0.1


def is_static_topic(topic: str) -> bool:
    """Whether the transforms of a topic hold for the whole recording."""
    return topic.endswith("tf_static")


@dataclass
class Transforms:
    """The transforms of one frame to one parent, from one topic.

    Args:
        topic: The topic.
        child: The frame.
        parent: The frame above it.
        is_static: Whether they come from a static topic, of which the first message counts.
        times_ns: Their times, as they came. (n,)
        poses: From the child to the parent. each (4, 4)
        count: Number of messages.
        changed: Number of static ones that differ from the first.
    """

    topic: str
    child: str
    parent: str
    is_static: bool
    times_ns: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    count: int = 0
    changed: int = 0

    def add(self, time_ns: int, pose: np.ndarray) -> None:
        """Add a message."""
        self.count += 1
        if not self.is_static or not self.times_ns:
            self.times_ns.append(time_ns)
            self.poses.append(pose)
        elif np.abs(pose - self.poses[0]).max() > _STILL_M:
            self.changed += 1

    @cached_property
    def moves(self) -> bool:
        """Whether its pose changes, by a millimetre or more; computed once all are there."""
        return bool(np.abs(np.array(self.poses) - self.poses[0]).max() > _STILL_M)

    def __str__(self) -> str:
        return f"{self.parent!r} ({self.count} messages on {self.topic})"


@dataclass
class Odometry:
    """The poses of one topic of odometry, of one body in one frame.

    Args:
        topic: The topic.
        parent: The frame that poses are in.
        child: The frame of the body, maybe empty.
        times_ns: Their times. (n,)
        poses: From the child to the parent. each (4, 4)
    """

    topic: str
    parent: str
    child: str
    times_ns: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.topic} ({len(self.poses)} poses of {self.child!r} in {self.parent!r})"


class PoseChain:
    """The poses of a vehicle's ground, by transforms one above the other.

    Args:
        steps: Tracks from the vehicle upwards.
        ground: Pose of the ground in the vehicle's frame. (4, 4)
        span_ns: First and last time at which all tracks have poses.
    """

    def __init__(
        self, steps: Sequence[PoseTrack], ground: np.ndarray, span_ns: tuple[int, int]
    ) -> None:
        self.steps, self.ground, self.span_ns = steps, ground, span_ns

    def __call__(self, time_ns: int) -> np.ndarray | None:
        """Return the pose at a time, or None where one of the tracks has none. (4, 4)"""
        pose = self.ground
        for step in self.steps:
            parent_from_child = step.at(time_ns)
            if parent_from_child is None:
                return None
            pose = parent_from_child @ pose
        return pose


@dataclass
class FrameTree:
    """The frames of a bag, each with one parent.

    Of several parents or topics, that counts which leads to the vehicle; of others, the one with
    the most messages, and of as many the first by name.

    Args:
        edges: Sources of each frame's transforms, by topic and parent.
        notes: What is not used, and what was assumed.
    """

    edges: dict[str, dict[tuple[str, str], Transforms]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _chosen: dict[str, Transforms] = field(default_factory=dict)

    def add(self, topic: str, child: str, parent: str, time_ns: int, pose: np.ndarray) -> None:
        """Add the transform of a message."""
        sources = self.edges.setdefault(child, {})
        key = topic, parent
        if key not in sources:
            sources[key] = Transforms(topic, child, parent, is_static_topic(topic))
        sources[key].add(time_ns, pose)

    @property
    def frames(self) -> set[str]:
        """The names of all frames."""
        return set(self.edges).union(
            parent for sources in self.edges.values() for _, parent in sources
        )

    def choose_vehicle(self, wanted: str | None) -> str:
        """Choose the vehicle's frame, and one parent for each frame.

        Args:
            wanted: The vehicle's frame; None takes the first of ``VEHICLE_FRAMES`` that is there
                and moves, or else that is there.

        Raises:
            ValueError: If there is no such frame.
        """
        names = VEHICLE_FRAMES if wanted is None else (wanted,)
        there = [name for name in names if name in self.frames]
        if not there:
            raise InputError(
                f"its transforms have no frame {wanted or ' or '.join(VEHICLE_FRAMES)!s}: name the "
                f"vehicle's with --vehicle-frame, or give --calibration calibration.yaml; there "
                f"are {sorted(self.frames) or 'no transforms at all'}"
            )
        for name in there:
            self._settle(name)
            if any(not self._chosen[frame].is_static for frame in self.chain(name)[:-1]):
                break
        else:
            name = there[0]
            self._settle(name)
        if name != there[0]:
            self.notes.append(
                f"the vehicle's frame is {name!r}, since {there[0]!r} has no moving transform above"
            )
        return name

    def _settle(self, vehicle: str) -> None:
        """Choose one parent for each frame, and note what is not used."""
        self._chosen.clear()
        self.notes.clear()
        for child, sources in self.edges.items():
            best = min(
                sources.values(),
                key=lambda edge: (
                    edge.child == vehicle or not self._leads(edge.parent, vehicle),
                    -edge.count,
                    edge.topic,
                ),
            )
            self._chosen[child] = best
            if best.changed:
                self.notes.append(
                    f"{best.changed} of the transforms from {child!r} to {best} differ from the "
                    "first, which is used"
                )
            others = [str(edge) for edge in sources.values() if edge is not best]
            if others:
                self.notes.append(
                    f"{child!r} has {len(sources)} sources of transforms: that to {best} is used, "
                    f"that to {' and '.join(others)} is not"
                )

    def _leads(self, frame: str, vehicle: str) -> bool:
        """Whether a frame is the vehicle's, or one of the ways up from it passes there."""
        seen, todo = set(), [frame]
        while todo:
            name = todo.pop()
            if name == vehicle:
                return True
            if name not in seen:
                seen.add(name)
                todo += [parent for _, parent in self.edges.get(name, ())]
        return False

    def chain(self, frame: str) -> list[str]:
        """Return a frame and those above it, up to the root; ValueError if they form a circle."""
        chain = [frame]
        while chain[-1] in self._chosen:
            parent = self._chosen[chain[-1]].parent
            if parent in chain:
                raise InputError(f"its transforms lead from {parent!r} back to it")
            chain.append(parent)
        return chain

    def between(self, vehicle: str, frame: str) -> np.ndarray | None:
        """Return the pose of a frame on the vehicle, or None if they are not connected. (4, 4)

        Of transforms that move between the two, the first counts, which is noted.
        """
        above, of_vehicle = self.chain(frame), self.chain(vehicle)
        common = next((name for name in above if name in of_vehicle), None)
        if common is None:
            return None
        poses = []
        for chain in (of_vehicle, above):
            pose = np.eye(4)
            for name in chain[: chain.index(common)]:
                edge = self._chosen[name]
                pose = edge.poses[0] @ pose
                note = (
                    f"the transform from {name!r} to {edge.parent!r} moves, and is used as it is "
                    f"at first for where {frame!r} is on the vehicle"
                )
                if edge.moves and note not in self.notes:
                    self.notes.append(note)
            poses.append(pose)
        return invert_rigid(poses[0]) @ poses[1]

    def poses(self, vehicle: str, ground: np.ndarray) -> PoseChain | None:
        """Return the poses of the ground by the moving transforms above the vehicle, or None."""
        above = [self._chosen[name] for name in self.chain(vehicle)[:-1]]
        moving = [edge for edge in above if not edge.is_static]
        if not moving:
            return None
        start_ns, end_ns = min(moving[0].times_ns), max(moving[0].times_ns)
        drive_ns, steps = end_ns - start_ns, []
        jumps: list[str] = []
        for edge in above:
            if edge.is_static:
                steps.append(PoseTrack(edge.times_ns, edge.poses, _FOREVER_NS))
                continue
            count = len(edge.times_ns)
            is_seldom = count == 1 or count * _SELDOM_NS < drive_ns
            holds = edge is not moving[0] and is_seldom
            start_ns = max(start_ns, min(edge.times_ns))
            end_ns = end_ns if holds else min(end_ns, max(edge.times_ns))
            steps.append(PoseTrack(edge.times_ns, edge.poses, _GAP_NS, holds))
            jumps += _jumps(steps[-1], f"transforms from {edge.child!r} to {edge}")
        self.notes += jumps
        return None if jumps else PoseChain(steps, ground, (start_ns, end_ns))


def _jumps(track: PoseTrack, what: str) -> list[str]:
    """Say if poses go back and forth between two places, as those of two publishers do."""
    places = track.poses[:, :3, 3]
    if len(places) < 5:
        return []
    to_next = float(np.median(np.linalg.norm(places[1:] - places[:-1], axis=1)))
    to_second = float(np.median(np.linalg.norm(places[2:] - places[:-2], axis=1)))
    if to_next < 2 * to_second + _STILL_JUMP_M:
        return []
    return [
        f"the {what} jump back and forth by {to_next:.1f} m, as if two publishers sent them: they "
        "are not used"
    ]


def odometry_poses(
    odometries: Sequence[Odometry], tree: FrameTree, vehicle: str, ground: np.ndarray
) -> tuple[PoseChain | None, list[str]]:
    """Return the poses of the ground by the odometry of one topic, and what is to be said of it.

    That of the vehicle's frame counts before that of a body that is fixed to it, and this before
    one that names none; of several, the one with the most poses.

    Args:
        odometries: All of a bag.
        tree: Its frames.
        vehicle: The vehicle's frame; empty where only a calibration file says where cameras are.
        ground: Pose of the ground in the vehicle's frame. (4, 4)
    """
    usable: list[tuple[int, int, np.ndarray]] = []
    notes = []
    for number, odometry in enumerate(odometries):
        child = odometry.child
        if child == vehicle or not child or not vehicle:
            usable.append((0 if child == vehicle else 2, number, np.eye(4)))
            continue
        child_from_vehicle = tree.between(child, vehicle) if child in tree.frames else None
        if child_from_vehicle is None:
            notes.append(
                f"{odometry} is not used: no transform leads from {child!r} to {vehicle!r}; name "
                "its frame with --vehicle-frame if it is the vehicle's"
            )
        else:
            usable.append((1, number, child_from_vehicle))
    if not usable:
        return None, notes
    rank, number, child_from_vehicle = min(
        usable, key=lambda entry: (entry[0], -len(odometries[entry[1]].poses))
    )
    best = odometries[number]
    if rank == 2 and best.child not in VEHICLE_FRAMES:
        notes.append(f"{best} is taken for the poses of the vehicle's frame")
    others = [str(odometries[other]) for _, other, _ in usable if other != number]
    if others:
        notes.append(f"of several odometries {best} is used, and {' and '.join(others)} is not")
    span_ns = min(best.times_ns), max(best.times_ns)
    track = PoseTrack(best.times_ns, best.poses, _GAP_NS)
    if jumps := _jumps(track, f"poses of {best}"):
        return None, notes + jumps
    return PoseChain([track], child_from_vehicle @ ground, span_ns), notes
