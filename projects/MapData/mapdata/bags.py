"""Samples of a bag: images, camera info, transforms and poses of ROS 1, ROS 2 or Foxglove."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.errors import naming
from gsmap.datasets.source import Source
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.extras import import_extra
from gsmap.utils.files import file_name
from mapdata.argoverse2.samples import thin_out
from mapdata.bag_images import write_image
from mapdata.bag_topics import camera_topics, chosen_topics, image_topics
from mapdata.folders.images import read_rig
from mapdata.folders.rig import (
    PoseAt,
    PoseTrack,
    RigCamera,
    RigFrame,
    nearest_images,
    rig_samples,
    rotation_of,
)
from mapdata.foxglove_mcap import FoxgloveBag, is_foxglove
from mapdata.options import InputOptions

_ODOMETRY = "nav_msgs/msg/Odometry"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_VEHICLE_FRAMES = ("base_footprint", "base_link")
_TOLERANCE_NS = 50_000_000
_GAP_NS, _FOREVER_NS = 10**9, 10**20


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: ``.bag``, ``.mcap``, ``.db3``, or a folder of rosbag2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix in (".bag", ".mcap", ".db3")


def read_bag(path: Path, options: InputOptions) -> Source:
    """Read the samples of a bag, in the frame ``ego``, and write their images as files.

    A message that cannot be read is left out and noted. An image that cannot be decoded is noted
    and not written, so that its frame is known to be broken. The folder of a bag's images is named
    by its content, and images that are there are kept.

    Raises:
        RuntimeError: If ``rosbags`` is not installed; the message names the extra.
        ValueError: If the bag is damaged or lacks what is needed; the message lists what it holds.
    """
    highlevel = import_extra("rosbags.highlevel", "bags")
    typesys = import_extra("rosbags.typesys", "bags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with naming(path, "see docs/inference.md"):
        with _of_rosbags():
            bag: Any = highlevel.AnyReader([path], default_typestore=store)
            bag = FoxgloveBag(path) if is_foxglove(path) else bag
            bag.open()
        try:
            return _read(bag, path, options)
        finally:
            bag.close()


@contextmanager
def _of_rosbags() -> Iterator[None]:
    """Turn what rosbags and the parsers below it raise for a damaged bag into a ``ValueError``."""
    try:
        yield
    except MemoryError as error:
        raise ValueError("a length in it asks for more memory than there is") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise ValueError(str(error) or type(error).__name__) from error


def _messages(bag: Any, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """Yield the messages of some connections: connection, time in nanoseconds, content."""
    found = iter(bag.messages(connections)) if connections else iter(())
    while True:
        with _of_rosbags():
            message = next(found, None)
        if message is None:
            return
        yield message


@dataclass
class _Content:
    """What a first pass over a bag finds; topics are those of images."""

    infos: dict[str, Any] = field(default_factory=dict)
    frame_ids: dict[str, str] = field(default_factory=dict)
    times_ns: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    transforms: dict[str, tuple[str, list[int], list[np.ndarray]]] = field(default_factory=dict)
    static: set[str] = field(default_factory=set)
    odometry: tuple[list[int], list[np.ndarray]] = field(default_factory=lambda: ([], []))
    digest: Any = field(default_factory=hashlib.sha256)
    unread: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))


def _read(bag: Any, path: Path, options: InputOptions) -> Source:
    kinds, listing = {c.topic: c.msgtype for c in bag.connections}, _listing(bag)
    calibration, vehicle_frame = options.calibration, options.vehicle_frame
    ground = rigid(np.eye(3), (0, 0, options.vehicle_ground_z_m))
    topics = chosen_topics(kinds, options.topics, listing, calibration is None)
    if calibration is None:
        topics = topics or camera_topics(kinds, listing)
        content = _first_pass(bag, topics)
        vehicle = _vehicle_frame(content, vehicle_frame)
        rig = {t: _camera(name, t, content, vehicle, ground) for name, (t, _) in topics.items()}
    else:
        given, ground = read_rig(calibration, ground)
        images = {name: t for name, (t, _) in topics.items()} or image_topics(kinds)
        topics = {
            camera.name: (_topic_of(camera.name, place, images, kinds), "")
            for camera, place in given
        }
        content = _first_pass(bag, topics)
        vehicle = _vehicle_frame(content, vehicle_frame) if content.transforms else ""
        rig = {topics[camera.name][0]: camera for camera, _ in given}
    content.digest.update(calibration.read_bytes() if calibration else b"")
    times = {name: np.unique(content.times_ns[topic]) for name, (topic, _) in topics.items()}
    first = next((name for name in times if "front" in name.lower()), next(iter(times)))
    wanted = thin_out(times[first], options.rate_hz)
    nearest = nearest_images(times, wanted.tolist(), _TOLERANCE_NS)
    frames = [
        RigFrame(
            f"{path.stem}_{time_ns}",
            time_ns,
            {name: (f"{file_name(name)}/{t}.jpg", t) for name, t in found.items()},
        )
        for time_ns, found in zip(wanted.tolist(), nearest, strict=True)
    ]
    pose_at = _pose_at(content, vehicle, ground)
    samples = rig_samples(path.stem, list(rig.values()), frames, pose_at)
    root = options.frames_dir / f"{file_name(path.stem)}-{content.digest.hexdigest()[:16]}"
    notes = [
        f"{len(reasons)} messages of {topic!r} cannot be read and are left out: {reasons[0]}"
        for topic, reasons in content.unread.items()
    ]
    notes += _write_images(bag, rig, frames, root)
    return Source(samples, "ego", root, pose_at is not None, tuple(notes))


def _topic_of(name: str, place: str, images: Mapping[str, str], kinds: Mapping[str, str]) -> str:
    """Return the topic of a calibrated camera's images: as its file says, or of its name."""
    topic = place if place in kinds else images.get(name)
    if topic is None:
        raise ValueError(
            f"camera {name!r} of the calibration has no images: the bag's are {sorted(images)}; "
            "set its `images` to a topic, or give --topics NAME=IMAGE_TOPIC"
        )
    return topic


def _listing(bag: Any) -> str:
    """Say what a bag holds."""
    return "; ".join(
        f"{name} ({info.msgtype or 'several types'}, {info.msgcount})"
        for name, info in sorted(bag.topics.items())
    )


def _stamp_ns(header: Any) -> int:
    stamp = header.stamp
    return int(stamp.sec) * 10**9 + int(getattr(stamp, "nanosec", 0) or 0)


def _matrix(place: Any, turn: Any) -> np.ndarray:
    """Return a pose of a message. (4, 4)"""
    pose = rigid(rotation_of((turn.w, turn.x, turn.y, turn.z)), (place.x, place.y, place.z))
    if not np.isfinite(pose).all():
        raise ValueError(f"a position is not finite: {pose[:3, 3].tolist()}")
    return pose


def _first_pass(bag: Any, topics: Mapping[str, tuple[str, str]]) -> _Content:
    """Gather calibration, transforms, poses and the times of all images."""
    content = _Content()
    topic_of: dict[str, list[str]] = defaultdict(list)
    for topic, info in topics.values():
        if info:
            topic_of[info].append(topic)
    images = {topic for topic, _ in topics.values()}
    kinds = (*_TRANSFORMS, _ODOMETRY)
    chosen = [c for c in bag.connections if c.topic in images | set(topic_of) or c.msgtype in kinds]
    for connection, time_ns, raw in _messages(bag, chosen):
        topic, kind = connection.topic, connection.msgtype
        content.digest.update(f"{topic} {kind} {len(raw)}\n".encode())
        content.digest.update(raw)
        try:
            with naming(f"the message at {time_ns} ns", "it is damaged"):
                with _of_rosbags():
                    message = bag.deserialize(raw, kind)
                if topic in topic_of:
                    content.infos |= {t: message for t in topic_of[topic] if t not in content.infos}
                else:
                    _keep(content, message, topic, kind)
        except ValueError as error:
            content.unread[topic].append(str(error))
    for name, (topic, info) in topics.items():
        if topic not in content.frame_ids or (info and topic not in content.infos):
            reason = next((content.unread[t][0] for t in (topic, info) if content.unread[t]), "")
            raise ValueError(
                f"camera {name!r} has no message on {topic} or {info or 'its info'}: choose others "
                f"with --topics, or give --calibration. {reason}"
            )
    return content


def _keep(content: _Content, message: Any, topic: str, kind: str) -> None:
    """Keep an image's time, or the poses of a message."""
    if kind in _TRANSFORMS:
        _add_transforms(content, message.transforms, topic.endswith("tf_static"))
    elif kind == _ODOMETRY:
        pose, time_ns = message.pose.pose, _stamp_ns(message.header)
        content.odometry[1].append(_matrix(pose.position, pose.orientation))
        content.odometry[0].append(time_ns)
    else:
        content.times_ns[topic].append(_stamp_ns(message.header))
        content.frame_ids.setdefault(topic, message.header.frame_id)


def _add_transforms(content: _Content, transforms: Sequence[Any], is_static: bool) -> None:
    """Keep transforms, of static ones the first."""
    for item in transforms:
        child, parent = item.child_frame_id.lstrip("/"), item.header.frame_id.lstrip("/")
        time_ns = _stamp_ns(item.header)
        pose = _matrix(item.transform.translation, item.transform.rotation)
        if is_static:
            content.static.add(child)
        _, times, poses = content.transforms.setdefault(child, (parent, [], []))
        if not is_static or not times:
            times.append(time_ns)
            poses.append(pose)


def _vehicle_frame(content: _Content, wanted: str | None) -> str:
    frames = set(content.transforms) | {parent for parent, _, _ in content.transforms.values()}
    for name in _VEHICLE_FRAMES if wanted is None else (wanted,):
        if name in frames:
            return name
    raise ValueError(
        f"its transforms have no frame {wanted or ' or '.join(_VEHICLE_FRAMES)!s}: name the "
        f"vehicle's with --vehicle-frame, or give --calibration calibration.yaml; there are "
        f"{sorted(frames) or 'no transforms at all'}"
    )


def _chain(content: _Content, frame: str) -> list[str]:
    """Return a frame and those above it, up to the root."""
    chain = [frame]
    while chain[-1] in content.transforms:
        parent = content.transforms[chain[-1]][0]
        if parent in chain:
            raise ValueError(f"its transforms lead from {parent!r} back to it")
        chain.append(parent)
    return chain


def _camera(
    name: str, topic: str, content: _Content, vehicle: str, ground: np.ndarray
) -> RigCamera:
    """Read a camera's calibration and its place on the vehicle."""
    info, frame = content.infos[topic], content.frame_ids[topic].lstrip("/")
    above, of_vehicle = _chain(content, frame), _chain(content, vehicle)
    if above[-1] != of_vehicle[-1]:
        raise ValueError(
            f"camera {name!r}: no transform leads from its frame {frame!r} to {vehicle!r}: give "
            "--calibration calibration.yaml, or another --vehicle-frame; there are those of "
            f"{sorted(content.transforms)}"
        )

    def root_from(chain: Sequence[str]) -> np.ndarray:
        pose = np.eye(4)
        for step in chain[:-1]:
            pose = content.transforms[step][2][0] @ pose
        return pose

    vehicle_from_cam = invert_rigid(root_from(of_vehicle)) @ root_from(above)

    def value(key: str) -> np.ndarray:
        found = getattr(info, key) if hasattr(info, key) else getattr(info, key.upper())
        return np.asarray(found, np.float64)

    rectified = "rect" in topic.rsplit("/", 2)[-1] or "rect" in topic.rsplit("/", 2)[-2]
    return RigCamera(
        name,
        value("p").reshape(3, 4)[:, :3] if rectified else value("k").reshape(3, 3),
        invert_rigid(vehicle_from_cam) @ ground,
        (int(info.width), int(info.height)),
        np.zeros(0) if rectified else value("d"),
        str(info.distortion_model),
    )


def _pose_at(content: _Content, vehicle: str, ground: np.ndarray) -> PoseAt | None:
    """Return the ground's poses by the transforms above the vehicle, or else by odometry."""
    above = _chain(content, vehicle)[:-1]
    if content.static.issuperset(above):
        steps = [PoseTrack(*content.odometry)] if content.odometry[0] else []
    else:
        gaps = [_FOREVER_NS if frame in content.static else _GAP_NS for frame in above]
        found = [content.transforms[frame] for frame in above]
        steps = [PoseTrack(t, poses, gap) for (_, t, poses), gap in zip(found, gaps, strict=True)]

    def pose_at(time_ns: int) -> np.ndarray | None:
        pose = ground
        for step in steps:
            parent_from_child = step.at(time_ns)
            if parent_from_child is None:
                return None
            pose = parent_from_child @ pose
        return pose

    return pose_at if steps else None


def _write_images(
    bag: Any, rig: Mapping[str, RigCamera], frames: Sequence[RigFrame], frames_dir: Path
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
    for connection, _, raw in _messages(bag, chosen) if missing else ():
        camera = rig[connection.topic]
        try:
            with _of_rosbags():
                message = bag.deserialize(raw, connection.msgtype)
                target = missing.pop((camera.name, _stamp_ns(message.header)), None)
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
