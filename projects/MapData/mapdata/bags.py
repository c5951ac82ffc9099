"""Samples of a bag: images, camera info, transforms and poses of ROS 1, ROS 2 or Foxglove."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.errors import naming
from gsmap.datasets.source import Source
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name
from mapdata.argoverse2.samples import thin_out
from mapdata.bag_cameras import ImageTopic, build_camera, is_calibrated, is_same_calibration
from mapdata.bag_files import Bag, bag_at, damage_in
from mapdata.bag_images import write_image
from mapdata.bag_poses import FrameTree, Odometry, PoseChain, is_static_topic, odometry_poses
from mapdata.bag_topics import camera_topics, check_topics, image_topics
from mapdata.folders.images import read_rig
from mapdata.folders.rig import (
    RigCamera,
    RigFrame,
    nearest_images,
    rectify_as_trained,
    rig_samples,
    rotation_of,
)
from mapdata.options import InputOptions
from mapdata.ros_bag import library_errors

_ODOMETRY = "nav_msgs/msg/Odometry"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_TOLERANCE_NS = 50_000_000
_REACH_NS = 100_000_000  # of the first and the last pose
_AFTER_STAMP = 12  # bytes of a message of ROS up to the end of its stamp
_RULES = b"2"  # of making images, so that those of other rules are not taken
_CHOOSE = "choose cameras with --topics"


def read_bag(path: Path, options: InputOptions) -> Source:
    """Read the samples of a bag, in the frame ``ego``, and write their images as files.

    A message or a topic that cannot be read is left out and noted. An image that cannot be decoded
    is noted and not written, so that its frame is known to be broken. The folder of a bag's images
    is named by its content, and images that are there are kept.

    Raises:
        RuntimeError: If ``rosbags`` is not installed; the message names the extra.
        ValueError: If the bag is damaged or lacks what is needed; the message lists what it holds.
    """
    with naming(path, "see docs/inference.md"):
        try:
            bag = bag_at(path)
            try:
                bag.open()
                return _read(bag, path, options)
            finally:
                bag.close()
        except ValueError as error:
            damage = damage_in(path)
            if damage is None:
                raise
            raise InputError(damage) from error


def _messages(bag: Bag, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """Yield the messages of some connections: connection, time in nanoseconds, content."""
    found = iter(bag.messages(connections)) if connections else iter(())
    while True:
        with library_errors():
            message = next(found, None)
        if message is None:
            return
        yield message


@dataclass
class _Content:
    """What a first pass over a bag finds; infos and images are by the topic of the images."""

    infos: dict[str, Any] = field(default_factory=dict)
    images: dict[str, ImageTopic] = field(default_factory=lambda: defaultdict(ImageTopic))
    tree: FrameTree = field(default_factory=FrameTree)
    odometries: dict[tuple[str, str, str], Odometry] = field(default_factory=dict)
    digest: Any = field(default_factory=hashlib.sha256)
    unread: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    unreadable: dict[str, str] = field(default_factory=dict)
    unstamped: Counter[str] = field(default_factory=Counter)
    changed_infos: Counter[str] = field(default_factory=Counter)

    def add_info(self, topic: str, info: Any) -> bool:
        """Keep the first camera info with focal lengths, and count those that differ from it."""
        known = self.infos.get(topic)
        if known is None or not is_calibrated(known):
            self.infos[topic] = info
            return True
        if not is_same_calibration(known, info):
            self.changed_infos[topic] += 1
        return False

    def reason(self, topics: Sequence[str]) -> str:
        """Return why messages of some topics cannot be read, empty if they can."""
        reasons = [self.unreadable[topic] for topic in topics if topic in self.unreadable]
        reasons += [self.unread[topic][0] for topic in topics if topic in self.unread]
        return reasons[0] if reasons else ""

    def notes(self) -> list[str]:
        """Say what cannot be read or is not used."""
        notes = [f"{topic!r} is left out: {why}" for topic, why in self.unreadable.items()]
        notes += [
            f"{count} messages of the camera info of {topic!r} differ from the first, which is used"
            for topic, count in self.changed_infos.items()
        ]
        notes += [
            f"{len(reasons)} messages of {topic!r} cannot be read and are left out: {reasons[0]}"
            for topic, reasons in self.unread.items()
        ]
        notes += [
            f"{count} transforms or poses of {topic!r} have the stamp 0: their time of recording "
            "is used"
            for topic, count in self.unstamped.items()
        ]
        return notes + [
            note for topic, images in self.images.items() for note in images.notes(topic)
        ]


def _read(bag: Bag, path: Path, options: InputOptions) -> Source:
    kinds, listing = {c.topic: c.msgtype for c in bag.connections}, _listing(bag)
    calibration, notes = options.calibration, list(bag.notes)
    ground = rigid(np.eye(3), (0, 0, options.vehicle_ground_z_m or 0.0))
    check_topics(kinds, options.topics, listing, needs_info=calibration is None)
    topics = dict(options.topics)
    if calibration is None:
        topics = topics or camera_topics(kinds, listing)
        content = _first_pass(bag, topics)
        vehicle = _vehicle(content, options.vehicle_frame)
        rig, of_cameras = _rig(topics, content, vehicle, ground, by_hand=bool(options.topics))
        notes += of_cameras
    else:
        given, ground = read_rig(calibration, ground)
        images = {name: t for name, (t, _) in topics.items()} or image_topics(kinds)
        topics = {
            camera.name: (_topic_of(camera.name, place, images, kinds), "")
            for camera, place in given
        }
        content = _first_pass(bag, topics)
        for name in topics:
            _require_messages(name, topics[name], content)
        has_frames = bool(content.tree.frames)
        vehicle = _vehicle(content, options.vehicle_frame) if has_frames else ""
        rig = {topics[camera.name][0]: camera for camera, _ in given}
    content.digest.update(calibration.read_bytes() if calibration else b"")
    content.digest.update(rectify_as_trained(list(rig.values()), options.trained))
    times = {
        camera.name: np.unique(content.images[topic].times_ns) for topic, camera in rig.items()
    }
    first = next((name for name in times if "front" in name.lower()), next(iter(times)))
    pose_at, of_poses = _poses(content, vehicle, ground)
    asked = len(thin_out(times[first], options.rate_hz))
    wanted = thin_out(_near_poses(times[first], pose_at), options.rate_hz).tolist()
    frames = [
        RigFrame(
            f"{path.stem}_{time_ns}",
            time_ns,
            {name: (f"{file_name(name)}/{t}.jpg", t) for name, t in found.items()},
        )
        for time_ns, found in zip(wanted, nearest_images(times, wanted, _TOLERANCE_NS), strict=True)
    ]
    samples = rig_samples(path.stem, list(rig.values()), frames, pose_at)
    notes += content.notes() + content.tree.notes + of_poses
    notes += _usage(len(samples), asked, times, pose_at, first)
    notes += _absences(frames, times, first)
    root = options.frames_dir / f"{file_name(path.stem)}-{content.digest.hexdigest()[:16]}"
    used = {sample.timestamp_ns for sample in samples}
    notes += _write_images(bag, rig, [frame for frame in frames if frame.time_ns in used], root)
    return Source(samples, "ego", root, pose_at is not None, tuple(notes))


def _topic_of(name: str, place: str, images: Mapping[str, str], kinds: Mapping[str, str]) -> str:
    """Return the topic of a calibrated camera's images: as its file says, or of its name."""
    topic = place if place in kinds else images.get(name)
    if topic is None:
        raise InputError(
            f"camera {name!r} of the calibration has no images: the bag's are {sorted(images)}; "
            "set its `images` to a topic, or give --topics NAME=IMAGE_TOPIC"
        )
    return topic


def _listing(bag: Bag) -> str:
    """Say what a bag holds."""
    return "; ".join(
        f"{name} ({info.msgtype}, {info.msgcount})" for name, info in sorted(bag.topics.items())
    )


def _stamp_ns(header: Any) -> int:
    """Return the stamp of a message; where it is 0, the time of recording stands for it."""
    stamp = header.stamp
    return int(stamp.sec) * 10**9 + int(getattr(stamp, "nanosec", 0) or 0)


def _matrix(place: Any, turn: Any) -> np.ndarray:
    """Return a pose of a message. (4, 4)"""
    pose = rigid(rotation_of((turn.w, turn.x, turn.y, turn.z)), (place.x, place.y, place.z))
    if not np.isfinite(pose).all():
        raise InputError(f"a position is not finite: {pose[:3, 3].tolist()}")
    return pose


def _first_pass(bag: Bag, topics: Mapping[str, tuple[str, str]]) -> _Content:
    """Gather calibration, transforms, poses and the times of all images."""
    content = _Content()
    content.digest.update(_RULES)
    topic_of: dict[str, list[str]] = defaultdict(list)
    for topic, info in topics.values():
        if info:
            topic_of[info].append(topic)
    images = {topic for topic, _ in topics.values()}
    kinds = (*_TRANSFORMS, _ODOMETRY)
    wanted = [c for c in bag.connections if c.topic in images | set(topic_of) or c.msgtype in kinds]
    chosen = []
    for connection in wanted:
        try:
            bag.parser(connection)
            chosen.append(connection)
        except ValueError as error:
            content.unreadable[connection.topic] = " ".join(str(error).split())
    known_infos: dict[str, bytes] = {}
    for connection, time_ns, raw in _messages(bag, chosen):
        topic, kind = connection.topic, connection.msgtype
        content.digest.update(f"{topic} {kind} {len(raw)}\n".encode())
        content.digest.update(raw)
        if topic in known_infos and raw[_AFTER_STAMP:] == known_infos[topic]:
            continue  # the camera info that is kept, once more
        try:
            with naming(f"the message at {time_ns} ns", "it is damaged"):
                with library_errors():
                    message = bag.parser(connection)(raw)
                if topic in topic_of:
                    kept = [content.add_info(images_of, message) for images_of in topic_of[topic]]
                    if any(kept):
                        known_infos[topic] = bytes(raw[_AFTER_STAMP:])
                else:
                    _keep(content, message, topic, kind, time_ns)
        except ValueError as error:
            content.unread[topic].append(str(error))
    return content


def _keep(content: _Content, message: Any, topic: str, kind: str, recorded_ns: int) -> None:
    """Keep an image's time, or the poses of a message."""
    if kind in _TRANSFORMS:
        is_static = is_static_topic(topic)
        for item in message.transforms:
            pose = _matrix(item.transform.translation, item.transform.rotation)
            child, parent = item.child_frame_id.lstrip("/"), item.header.frame_id.lstrip("/")
            stamp_ns = _stamp_ns(item.header)
            content.tree.add(topic, child, parent, stamp_ns or recorded_ns, pose)
            if not stamp_ns and not is_static:
                content.unstamped[topic] += 1
        return
    stamp_ns = _stamp_ns(message.header)
    time_ns = stamp_ns or recorded_ns
    if kind == _ODOMETRY:
        pose = _matrix(message.pose.pose.position, message.pose.pose.orientation)
        parent, child = message.header.frame_id.lstrip("/"), message.child_frame_id.lstrip("/")
        key = topic, parent, child
        odometry = content.odometries.setdefault(key, Odometry(*key))
        odometry.poses.append(pose)
        odometry.times_ns.append(time_ns)
        if not stamp_ns:
            content.unstamped[topic] += 1
    else:
        content.images[topic].add(message, time_ns)
        content.images[topic].unstamped += not stamp_ns


def _vehicle(content: _Content, wanted: str | None) -> str:
    """Choose the vehicle's frame; an error names topics that cannot be read, too."""
    try:
        return content.tree.choose_vehicle(wanted)
    except ValueError as error:
        topics = [*content.unreadable, *content.unread]
        unread = f"; {', '.join(topics)} cannot be read: {content.reason(topics)}" if topics else ""
        raise InputError(f"{error}{unread}") from error


def _require_messages(name: str, topics: tuple[str, str], content: _Content) -> None:
    """Raise a ``ValueError`` unless there are images of a camera, and its info if it has one."""
    topic, info = topics
    if not content.images[topic].times_ns or (info and topic not in content.infos):
        raise InputError(
            f"camera {name!r} has no message on {topic} or {info or 'its info'}: choose others "
            f"with --topics, or give --calibration. {content.reason(topics)}".rstrip(" .")
        )


def _rig(
    topics: Mapping[str, tuple[str, str]],
    content: _Content,
    vehicle: str,
    ground: np.ndarray,
    by_hand: bool,
) -> tuple[dict[str, RigCamera], list[str]]:
    """Return the cameras by the topic of their images, and what is to be said of them.

    A camera that cannot be used is left out, unless it was asked for or there is no other.
    """
    rig, notes = {}, []
    left_out: dict[str, ValueError] = {}
    is_any_readable = any(not content.images[topic].trouble for topic, _ in topics.values())
    for name, pair in topics.items():
        trouble = content.images[pair[0]].trouble
        try:
            if trouble and is_any_readable and not by_hand:
                raise InputError(f"camera {name!r}: {trouble}")
            rig[pair[0]], assumed = _camera(name, pair, content, vehicle, ground)
            notes += assumed
        except ValueError as error:
            left_out[name] = error
    if left_out and (by_hand or not rig):
        raise next(iter(left_out.values()))
    notes += [
        f"{topics[name][0]} is left out: {str(error).rstrip('.')}; {_CHOOSE}"
        for name, error in left_out.items()
    ]
    return rig, notes


def _camera(
    name: str, topics: tuple[str, str], content: _Content, vehicle: str, ground: np.ndarray
) -> tuple[RigCamera, list[str]]:
    """Return a camera by its info and its place on the vehicle, and what was assumed."""
    _require_messages(name, topics, content)
    images, info = content.images[topics[0]], content.infos[topics[0]]
    frame = images.frame_id or info.header.frame_id.lstrip("/")
    vehicle_from_cam = content.tree.between(vehicle, frame)
    if vehicle_from_cam is None:
        raise InputError(
            f"camera {name!r}: no transform leads from its frame {frame!r} to {vehicle!r}: give "
            "--calibration calibration.yaml, or another --vehicle-frame; there are those of "
            f"{sorted(content.tree.edges)}"
        )
    return build_camera(name, images, info, topics, invert_rigid(vehicle_from_cam) @ ground)


def _poses(
    content: _Content, vehicle: str, ground: np.ndarray
) -> tuple[PoseChain | None, list[str]]:
    """Return the ground's poses by the transforms above the vehicle, or else by odometry."""
    chain = content.tree.poses(vehicle, ground) if vehicle else None
    if chain is not None:
        return chain, []
    return odometry_poses(list(content.odometries.values()), content.tree, vehicle, ground)


def _near_poses(times_ns: np.ndarray, pose_at: PoseChain | None) -> np.ndarray:
    """Return the times that the poses span, or all where there are none. (n,) -> (m,)"""
    if pose_at is None:
        return times_ns
    start_ns, end_ns = pose_at.span_ns
    near = times_ns[(times_ns >= start_ns - _REACH_NS) & (times_ns <= end_ns + _REACH_NS)]
    return near if len(near) else times_ns


def _usage(
    count: int,
    asked: int,
    times_ns: Mapping[str, np.ndarray],
    pose_at: PoseChain | None,
    first: str,
) -> list[str]:
    """Say how many of the samples that were asked for have a pose; ValueError if none has."""
    if pose_at is None or count >= asked:
        return []
    where = (
        f"the images of {first!r} are from {_span(times_ns[first])}, the poses from "
        f"{_span(pose_at.span_ns)}; gaps of more than 1 s are not bridged"
    )
    if not count:
        raise InputError(
            f"no image has a pose near its time: {where}; images and transforms need one clock"
        )
    return [f"{count} of {asked} samples used: the others have no pose near them: {where}"]


def _absences(
    frames: Sequence[RigFrame], times_ns: Mapping[str, np.ndarray], first: str
) -> list[str]:
    """Say which cameras have no image at some samples."""
    notes = []
    for name, found in times_ns.items():
        count = sum(name not in frame.images for frame in frames)
        note = f"camera {name!r} has no image within 50 ms at {count} of {len(frames)} samples"
        if count == len(frames):
            of_first = _span(times_ns[first])
            note += f": its images are from {_span(found)}, those of {first!r} from {of_first}"
        notes += [note] if count else []
    return notes


def _span(times_ns: Sequence[int] | np.ndarray) -> str:
    """Return the first and last of ascending times in words."""
    return f"{times_ns[0] / 1e9:.3f} to {times_ns[-1] / 1e9:.3f} s"


def _write_images(
    bag: Bag, rig: Mapping[str, RigCamera], frames: Sequence[RigFrame], frames_dir: Path
) -> list[str]:
    """Write the images of frames that are not there yet; say which cannot be used, and why."""
    missing = {
        (name, time_ns): frames_dir / path
        for frame in frames
        for name, (path, time_ns) in frame.images.items()
        if not (frames_dir / path).is_file()
    }
    chosen = [c for c in bag.connections if c.topic in rig]
    unusable = []
    for connection, recorded_ns, raw in _messages(bag, chosen) if missing else ():
        camera = rig[connection.topic]
        try:
            with library_errors():
                message = bag.parser(connection)(raw)
                time_ns = _stamp_ns(message.header) or recorded_ns
                target = missing.pop((camera.name, time_ns), None)
        except ValueError:
            continue  # the first pass has named it
        if target is not None:
            where = f"camera {camera.name!r}, image at {target.stem} ns"
            try:
                with naming(where, "its frame is left out"):
                    write_image(message, camera, target, where)
            except ValueError as error:
                unusable.append(str(error))
    return unusable
