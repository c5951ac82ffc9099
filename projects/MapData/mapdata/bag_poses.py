"""Transforms and odometry of a bag: the mounting of the cameras, and the poses of the vehicle.

The pose of a frame is its transform to another frame. Each frame of a bag has a parent, the frame
above it, up to a root such as the map. A transform is static if it is valid for the whole
recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError
from mapdata.folders.rig import PoseTrack

VEHICLE_FRAMES = ("base_footprint", "base_link")  # usual names of the vehicle's frame
_GAP_NS = 10**9  # longest gap between two poses in which the pose is interpolated
# Gap for the track of a static transform. Its single pose is used up to a tenth of the gap before
# and after its time, which is longer than any recording.
_FOREVER_NS = 10**20
_SELDOM_NS = 500_000_000  # transforms with a longer mean interval are valid until the next one
# Smaller changes do not count as a motion. The bound holds for each entry of a pose, metres and
# entries of the rotation alike.
_STILL_M = 1e-3
_STILL_JUMP_M = 0.1  # smaller distances of successive poses do not count as jumps
# Ranks of odometry by the frame whose poses it contains; the lowest rank is preferred.
_OF_VEHICLE = 0
_OF_CONNECTED_FRAME = 1
_OF_UNKNOWN_FRAME = 2


def is_static_topic(topic: str) -> bool:
    """Whether the transforms of a topic are valid for the whole recording."""
    return topic.endswith("tf_static")


@dataclass
class Transforms:
    """Transforms from one frame to one parent, published on one topic.

    Args:
        topic: Topic of the messages.
        child: Name of the frame.
        parent: Name of the frame above it.
        is_static: Whether the topic is static, so that the first message is always valid.
        times_ns: Times of the transforms, in the order of the bag; one time if static. (n,)
        poses: Transforms from the child to the parent, in metres. (4, 4) each
        count: Number of messages, which exceeds the number of poses if the topic is static.
        num_changes: Number of later messages of a static topic that differ from the first one.
    """

    topic: str
    child: str
    parent: str
    is_static: bool
    times_ns: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    count: int = 0
    num_changes: int = 0

    def add(self, time_ns: int, pose: np.ndarray) -> None:
        """Add the transform of a message."""
        self.count += 1
        # A static topic may repeat its message. Only the first one is stored.
        if not self.is_static or not self.times_ns:
            self.times_ns.append(time_ns)
            self.poses.append(pose)
        elif np.abs(pose - self.poses[0]).max() > _STILL_M:
            self.num_changes += 1

    @cached_property
    def moves(self) -> bool:
        """Whether an entry of a pose differs from the first pose by more than `_STILL_M`.

        The value is cached, so it must only be read after all transforms are added.
        """
        return bool(np.abs(np.array(self.poses) - self.poses[0]).max() > _STILL_M)

    def __str__(self) -> str:
        """Return the parent, the number of messages and the topic, for notes."""
        return f"{self.parent!r} ({self.count} messages on {self.topic})"


@dataclass
class Odometry:
    """Poses of one body in one frame, published on one topic.

    Args:
        topic: Topic of the messages.
        parent: Name of the frame that the poses refer to.
        child: Name of the body's frame; may be empty.
        times_ns: Times of the poses. (n,)
        poses: Transforms from the child to the parent, in metres. (4, 4) each
    """

    topic: str
    parent: str
    child: str
    times_ns: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)

    def __str__(self) -> str:
        """Return the topic, the number of poses and both frames, for notes."""
        return f"{self.topic} ({len(self.poses)} poses of {self.child!r} in {self.parent!r})"


class PoseChain:
    """Pose of the ground below a vehicle as a function of time, from a chain of transforms.

    Args:
        steps: Poses of each frame in its parent over time, from the vehicle's frame upwards to the
            root of the frame tree.
        ground: Pose of the ground in the vehicle's frame, in metres. (4, 4)
        span_ns: First and last time at which all tracks have a pose.
    """

    def __init__(
        self, steps: Sequence[PoseTrack], ground: np.ndarray, span_ns: tuple[int, int]
    ) -> None:
        self.steps = steps
        self.ground = ground
        self.span_ns = span_ns

    def __call__(self, time_ns: int) -> np.ndarray | None:
        """Return the pose of the ground in the root at a time; None if a track has none. (4, 4)"""
        pose = self.ground
        for step in self.steps:
            parent_from_child = step.at(time_ns)
            if parent_from_child is None:
                return None
            pose = parent_from_child @ pose
        return pose


@dataclass
class FrameTree:
    """Tree of the frames of a bag, in which each frame has one parent.

    The messages of a bag may give a frame several parents, or transforms on several topics. Each
    pair of topic and parent is a source of transforms, of which one is chosen for each frame. The
    source is preferred whose parent leads to the vehicle, then the source with the most messages,
    then the first topic by name.

    `choose_vehicle` makes the choice. It must be called after all messages are added, and before
    `chain`, `between` and `poses`.

    Args:
        edges: Sources of transforms of each frame, by the topic and the parent.
        notes: Notes on transforms that are not used, or not used in full.
    """

    edges: dict[str, dict[tuple[str, str], Transforms]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _chosen: dict[str, Transforms] = field(default_factory=dict)

    def add(self, topic: str, child: str, parent: str, time_ns: int, pose: np.ndarray) -> None:
        """Add the transform of a message.

        Args:
            topic: Topic of the message.
            child: Name of the frame.
            parent: Name of the frame above it.
            time_ns: Time of the transform.
            pose: Transform from the child to the parent, in metres. (4, 4)
        """
        sources = self.edges.setdefault(child, {})
        key = (topic, parent)
        if key not in sources:
            sources[key] = Transforms(
                topic=topic, child=child, parent=parent, is_static=is_static_topic(topic)
            )
        sources[key].add(time_ns, pose)

    @property
    def frames(self) -> set[str]:
        """Names of all frames, roots included."""
        names = set(self.edges)
        for sources in self.edges.values():
            names.update(parent for _, parent in sources)
        return names

    def choose_vehicle(self, wanted: str | None) -> str:
        """Choose the vehicle's frame, and one parent for each frame.

        Args:
            wanted: Name of the vehicle's frame. None selects the first of ``VEHICLE_FRAMES`` that
                has a transform above it that is not static. If none has, it selects the first of
                them in the bag.

        Returns:
            Name of the vehicle's frame.

        Raises:
            ValueError: If the bag has no such frame, or if the transforms above it form a circle.
        """
        candidates = VEHICLE_FRAMES if wanted is None else (wanted,)
        known_names = [name for name in candidates if name in self.frames]
        if not known_names:
            wanted_names = " or ".join(candidates)
            raise InputError(
                f"its transforms have no frame {wanted_names}: name the frame of the vehicle with "
                "--vehicle-frame, or give --calibration calibration.yaml; there are "
                f"{sorted(self.frames) or 'no transforms at all'}"
            )
        # The choice of the parents depends on the vehicle, so it is made for each candidate.
        for name in known_names:
            self._choose_parents(name)
            lower_frames = self.chain(name)[:-1]  # the root has no transform to a parent
            is_moving = any(not self._chosen[frame].is_static for frame in lower_frames)
            if is_moving:
                break
        else:  # no frame moves
            name = known_names[0]
            self._choose_parents(name)
        if name != known_names[0]:
            self.notes.append(
                f"the vehicle's frame is {name!r}, since {known_names[0]!r} has no moving "
                "transform above"
            )
        return name

    def _choose_parents(self, vehicle: str) -> None:
        """Choose one source of transforms for each frame, and note the others.

        An earlier choice and its notes are dropped.
        """
        self._chosen.clear()
        self.notes.clear()

        def rank(edge: Transforms) -> tuple[bool, int, str]:
            """Sort key of a source of transforms; the smallest key is the best."""
            # Frames such as cameras lie below the vehicle, so their parents lead to it. The parents
            # of the vehicle do not count.
            leads_to_vehicle = edge.child != vehicle and self._leads(edge.parent, vehicle)
            # False precedes True, and the largest count has the smallest negative.
            return not leads_to_vehicle, -edge.count, edge.topic

        for child, sources in self.edges.items():
            best = min(sources.values(), key=rank)
            self._chosen[child] = best
            if best.num_changes:
                self.notes.append(
                    f"{best.num_changes} of the transforms from {child!r} to {best} differ from "
                    "the first, which is used"
                )
            others = [str(edge) for edge in sources.values() if edge is not best]
            if others:
                self.notes.append(
                    f"{child!r} has {len(sources)} sources of transforms: the one to {best} is "
                    f"used, the one to {' and '.join(others)} is not"
                )

    def _leads(self, frame: str, vehicle: str) -> bool:
        """Whether a frame is the vehicle's, or a path of parents leads from it to the vehicle.

        All sources are followed, because parents are not chosen yet.
        """
        visited = set()
        pending = [frame]
        while pending:
            name = pending.pop()
            if name == vehicle:
                return True
            if name not in visited:  # the transforms may form a circle
                visited.add(name)
                pending += [parent for _, parent in self.edges.get(name, ())]
        return False

    def chain(self, frame: str) -> list[str]:
        """Return the names of a frame and of all frames above it, up to the root.

        Raises:
            ValueError: If the transforms form a circle.
        """
        names = [frame]
        while names[-1] in self._chosen:
            parent = self._chosen[names[-1]].parent
            if parent in names:
                raise InputError(f"its transforms lead from {parent!r} back to it")
            names.append(parent)
        return names

    def between(self, vehicle: str, frame: str) -> np.ndarray | None:
        """Return the pose of a frame in the vehicle's frame; None if not connected. (4, 4)

        If a transform between the two moves, its first pose is used, with a note in ``notes``.

        Args:
            vehicle: Name of the vehicle's frame, or of another frame to which the pose refers.
            frame: Name of the frame.

        Raises:
            ValueError: If the transforms form a circle.
        """
        frame_chain = self.chain(frame)
        vehicle_chain = self.chain(vehicle)
        # Both chains end at a root. Their lowest common frame connects the two.
        common = next((name for name in frame_chain if name in vehicle_chain), None)
        if common is None:
            return None
        common_from_vehicle = self._pose_below(common, names=vehicle_chain, frame=frame)
        common_from_frame = self._pose_below(common, names=frame_chain, frame=frame)
        return invert_rigid(common_from_vehicle) @ common_from_frame

    def _pose_below(self, ancestor: str, names: Sequence[str], frame: str) -> np.ndarray:
        """Compute the pose of the first frame of a chain in a frame above it. (4, 4)

        The first pose of each transform is used. Transforms that move are noted, because they
        affect the place of ``frame`` on the vehicle.

        Args:
            ancestor: Name of the frame above.
            names: Names of the chain, from the first frame upwards.
            frame: Name of the sensor's frame, for the notes.
        """
        pose = np.eye(4)
        for name in names[: names.index(ancestor)]:
            edge = self._chosen[name]
            pose = edge.poses[0] @ pose
            note = (
                f"the transform from {name!r} to {edge.parent!r} moves: its first pose is used for "
                f"the place of {frame!r} on the vehicle"
            )
            if edge.moves and note not in self.notes:
                self.notes.append(note)
        return pose

    def poses(self, vehicle: str, ground: np.ndarray) -> PoseChain | None:
        """Compute the poses of the ground below the vehicle from the transforms above its frame.

        Args:
            vehicle: Name of the vehicle's frame.
            ground: Pose of the ground in the vehicle's frame, in metres. (4, 4)

        Returns:
            The poses; None if all transforms are static, or if poses jump back and forth. Jumps are
            noted in ``notes``.

        Raises:
            ValueError: If the transforms form a circle, or a pose is not finite.
        """
        lower_frames = self.chain(vehicle)[:-1]  # the root has no transform to a parent
        edges = [self._chosen[name] for name in lower_frames]
        moving_edges = [edge for edge in edges if not edge.is_static]
        if not moving_edges:
            return None
        # The poses are known at the times at which all moving transforms have a pose. The moving
        # transform next to the vehicle defines the span, which the others can only shorten.
        lowest = moving_edges[0]
        start_ns = min(lowest.times_ns)
        end_ns = max(lowest.times_ns)
        drive_ns = end_ns - start_ns  # duration
        steps = []
        jumps: list[str] = []
        for edge in edges:
            if edge.is_static:
                steps.append(PoseTrack(edge.times_ns, edge.poses, gap_ns=_FOREVER_NS))
                continue
            # Some transforms, such as from the odometry to the map, are sent only when they change.
            # They are valid until the next one.
            count = len(edge.times_ns)
            is_seldom = count == 1 or count * _SELDOM_NS < drive_ns
            holds = edge is not lowest and is_seldom
            # A pose that holds is valid after its time, but not before it.
            start_ns = max(start_ns, min(edge.times_ns))
            if not holds:
                end_ns = min(end_ns, max(edge.times_ns))
            track = PoseTrack(edge.times_ns, edge.poses, gap_ns=_GAP_NS, holds=holds)
            steps.append(track)
            jumps += _jump_notes(track, f"transforms from {edge.child!r} to {edge}")
        self.notes += jumps
        if jumps:
            return None
        return PoseChain(steps, ground=ground, span_ns=(start_ns, end_ns))


def _jump_notes(track: PoseTrack, source: str) -> list[str]:
    """Return a list with one note if poses alternate between two places, otherwise an empty list.

    Such poses are not usable: two publishers seem to send different poses of one frame.

    Args:
        track: Poses over time.
        source: Description of the poses, for the note.
    """
    positions = track.poses[:, :3, 3]  # in metres, in the order of time (n, 3)
    if len(positions) < 5:  # too few to recognise a pattern
        return []
    # If places alternate, the next place is far away, and the place after it is near again. In a
    # steady motion, the place after it is twice as far away.
    to_next = float(np.median(np.linalg.norm(positions[1:] - positions[:-1], axis=1)))
    to_second = float(np.median(np.linalg.norm(positions[2:] - positions[:-2], axis=1)))
    if to_next < 2 * to_second + _STILL_JUMP_M:
        return []
    return [
        f"the {source} jump back and forth by {to_next:.1f} m, as if two publishers sent them: "
        "they are not used"
    ]


def odometry_poses(
    odometries: Sequence[Odometry], tree: FrameTree, vehicle: str, ground: np.ndarray
) -> tuple[PoseChain | None, list[str]]:
    """Compute the poses of the ground below the vehicle from the odometry of one topic.

    Odometry of the vehicle's frame is preferred, then odometry of a frame that is connected to it,
    then odometry without a frame. Among several odometries of one kind, the one with the most poses
    is used.

    Args:
        odometries: All odometries of a bag.
        tree: Frames of the bag.
        vehicle: Name of the vehicle's frame; empty if it is unknown.
        ground: Pose of the ground in the vehicle's frame, in metres. (4, 4)

    Returns:
        The poses (None without usable odometry, or if its poses jump back and forth), and notes on
        assumptions and on odometry that is not used.

    Raises:
        ValueError: If the transforms form a circle, or a pose is not finite.
    """
    # Rank (0 is the best), index in ``odometries``, and transform from the vehicle's frame to the
    # frame of the odometry's body.
    candidates: list[tuple[int, int, np.ndarray]] = []
    notes = []
    for number, odometry in enumerate(odometries):
        child = odometry.child
        if child == vehicle:
            candidates.append((_OF_VEHICLE, number, np.eye(4)))
            continue
        # An unknown body is assumed to be the vehicle.
        if not child or not vehicle:
            candidates.append((_OF_UNKNOWN_FRAME, number, np.eye(4)))
            continue
        # `between` returns the pose of its second frame (the vehicle) in its first (the body).
        child_from_vehicle = tree.between(child, vehicle) if child in tree.frames else None
        if child_from_vehicle is None:
            notes.append(
                f"{odometry} is not used: no transform leads from {child!r} to {vehicle!r}; name "
                "its frame with --vehicle-frame if it is the vehicle's"
            )
        else:
            candidates.append((_OF_CONNECTED_FRAME, number, child_from_vehicle))
    if not candidates:
        return None, notes

    def order(candidate: tuple[int, int, np.ndarray]) -> tuple[int, int]:
        """Sort key of a candidate; the smallest key is the best."""
        rank, number, _ = candidate
        return rank, -len(odometries[number].poses)

    rank, number, child_from_vehicle = min(candidates, key=order)
    best = odometries[number]
    if rank == _OF_UNKNOWN_FRAME and best.child not in VEHICLE_FRAMES:
        notes.append(f"{best} is taken for the poses of the vehicle's frame")
    # `number` is the index of the best candidate, so the others have another index.
    others = [str(odometries[other]) for _, other, _ in candidates if other != number]
    if others:
        notes.append(f"of several odometries {best} is used, and {' and '.join(others)} is not")
    track = PoseTrack(best.times_ns, best.poses, gap_ns=_GAP_NS)
    jumps = _jump_notes(track, f"poses of {best}")
    if jumps:
        return None, notes + jumps
    span_ns = (min(best.times_ns), max(best.times_ns))
    # The track has the poses of the odometry's body, so the ground is given in the body's frame.
    return PoseChain([track], ground=child_from_vehicle @ ground, span_ns=span_ns), notes
