"""Samples of a bag: images, camera info, transforms and poses of ROS 1, ROS 2 or Foxglove.

A topic is a named stream of messages in a bag. Camera info is a message with the intrinsics and the
distortion of a camera. The rig is the set of the cameras on the vehicle.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsmap.datasets.errors import explain_errors
from gsmap.datasets.source import Source
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name
from mapdata.argoverse2.samples import thin_out
from mapdata.bag_cameras import build_camera
from mapdata.bag_contents import BagContent, read_content, read_messages, stamp_ns
from mapdata.bag_files import Bag, bag_at, damage_in
from mapdata.bag_images import write_image
from mapdata.bag_poses import PoseChain, odometry_poses
from mapdata.bag_topics import IMAGES, camera_topics, check_topics, image_topics
from mapdata.folders.calibration_file import read_rig
from mapdata.folders.rig import (
    RigCamera,
    RigFrame,
    motion_notes,
    nearest_images,
    rig_samples,
    set_rectification_targets,
)
from mapdata.options import InputOptions
from mapdata.ros_bag import library_errors

_TOLERANCE_NS = 50_000_000  # largest difference in time of the images of one sample
_REACH_NS = 100_000_000  # images up to this time before the first or after the last pose are used
_CHOOSE = "choose cameras with --topics"  # end of a note on a camera that is left out


def read_bag(path: Path, options: InputOptions) -> Source:
    """Read the samples of a bag in the frame ``ego``, and write their images as files.

    Messages and topics that cannot be read are left out, with a note. Images that cannot be decoded
    are not written, with a note; loading a sample with such an image fails later. The name of the
    folder of the images contains a digest of the bag, and existing images are reused.

    Args:
        path: A file, a folder of rosbag2, or a folder with the parts of one recording.
        options: Cameras, frames, rate and calibration of the bag.

    Returns:
        The samples, with notes on assumptions and omissions.

    Raises:
        RuntimeError: If ``rosbags`` is not installed; the message names the extra.
        ValueError: If the bag is damaged, or lacks topics, transforms or poses; the message lists
            its content.
    """
    with explain_errors(path, "see docs/inference.md"):
        try:
            bag = bag_at(path)
            try:
                bag.open()
                return _read_samples(bag, path, options=options)
            finally:
                bag.close()
        except ValueError as error:
            # Damage of the files can cause any other error. If there is damage, it is reported
            # instead, with a remedy.
            damage = damage_in(path)
            if damage is None:
                raise
            raise InputError(damage) from error


def _read_samples(bag: Bag, path: Path, options: InputOptions) -> Source:
    """Read the samples of an open bag.

    The cameras are built first, from their camera info or from a calibration file. Then the images
    are grouped into frames at the times of one camera, and the frames with a pose become samples.
    Finally, the images of these frames are written.
    """
    # Message type of each topic. A connection is the part of a topic that one publisher has
    # written.
    kinds = {connection.topic: connection.msgtype for connection in bag.connections}
    listing = _listing(bag)
    calibration = options.calibration
    notes = list(bag.notes)
    check_topics(kinds, options.topics, listing=listing, needs_info=calibration is None)
    # `topics` has the topic of the images and the topic of the camera info of each camera, by its
    # name. `content` has all messages of the bag except the images: camera info, the tree of
    # frames, odometry, and the times of the images. `rig` has the cameras by their image topic.
    # `ground` is the pose of the ground below the vehicle, in the vehicle's frame. (4, 4)
    if calibration is None:
        ground = rigid(np.eye(3), (0, 0, options.vehicle_ground_z_m or 0.0))
        topics = options.topics or camera_topics(kinds, listing)
        content = read_content(bag, topics)
        vehicle = _choose_vehicle(content, wanted=options.vehicle_frame)
        rig, rig_notes = _build_rig(
            topics, content, vehicle=vehicle, ground=ground, by_hand=bool(options.topics)
        )
        notes += rig_notes
    else:
        calibrated_cameras, ground, calibration_notes = read_rig(
            calibration, options.vehicle_ground_z_m
        )
        notes += calibration_notes
        topics = _topics_of(calibrated_cameras, options=options, kinds=kinds)
        content = read_content(bag, topics)
        for name, camera_topic_pair in topics.items():
            _require_messages(name, camera_topic_pair, content=content)
        if content.tree.frames:
            vehicle = _choose_vehicle(content, wanted=options.vehicle_frame)
        else:  # poses can only come from odometry, of the wanted frame or of any
            vehicle = options.vehicle_frame or ""
        rig = {}
        for camera, _ in calibrated_cameras:
            topic, _ = topics[camera.name]
            rig[topic] = camera
        content.digest.update(calibration.read_bytes())
    _require_own_topics(topics)
    # Images in the folder have the names of the cameras, and the calibration of the info topics.
    content.digest.update(repr(sorted(topics.items())).encode())
    # If a model was trained on cameras of these names, distorted images are rectified to the
    # cameras of the model. The key describes these cameras.
    rectification_key, target_notes = set_rectification_targets(list(rig.values()), options.trained)
    content.digest.update(rectification_key)

    times_ns = {}  # distinct times of the images, ascending, by camera
    for topic, camera in rig.items():
        times_ns[camera.name] = np.unique(content.images[topic].times_ns)
    sampling_camera = _sampling_camera(list(times_ns))
    sampling_times_ns = times_ns[sampling_camera]
    pose_at, pose_notes = _poses(content, vehicle=vehicle, ground=ground)
    # `thin_out` selects times at the requested rate. The times are limited to the poses first, so
    # that the selection starts with the first time that has a pose.
    requested_count = len(thin_out(sampling_times_ns, options.rate_hz))
    times_with_pose = _near_poses(sampling_times_ns, pose_at)
    wanted_ns = thin_out(times_with_pose, options.rate_hz).tolist()
    frames = _group_images(times_ns, wanted_ns, scene=path.stem)
    # Frames without a pose are left out, unless the bag has no poses at all.
    samples = rig_samples(path.stem, list(rig.values()), frames=frames, pose_at=pose_at)

    notes += content.notes() + content.tree.notes + target_notes + pose_notes
    notes += _usage_notes(
        len(samples),
        requested_count,
        times_ns=sampling_times_ns,
        pose_at=pose_at,
        camera=sampling_camera,
    )
    notes += _absence_notes(frames, times_ns, sampling_camera=sampling_camera)
    # The folder of the images depends on the content of the bag and on the rectification.
    digest = content.digest.hexdigest()[:16]
    root = options.frames_dir / f"{file_name(path.stem)}-{digest}"  # `file_name` makes names safe
    sample_times_ns = {sample.timestamp_ns for sample in samples}
    sample_frames = [frame for frame in frames if frame.time_ns in sample_times_ns]
    if pose_at is not None:
        notes += motion_notes(sample_frames, pose_at=pose_at)
    notes += _write_images(bag, rig, frames=sample_frames, frames_dir=root)
    return Source(
        samples=samples,
        frame="ego",
        data_root=root,
        has_poses=pose_at is not None,
        notes=tuple(notes),
    )


def _sampling_camera(names: Sequence[str]) -> str:
    """Camera whose images define the times of the samples.

    It is a front camera if there is one, and otherwise the first camera.
    """
    for name in names:
        if "front" in name.lower():
            return name
    return names[0]


def _group_images(
    times_ns: Mapping[str, np.ndarray], wanted_ns: Sequence[int], scene: str
) -> list[RigFrame]:
    """Group images into frames at the wanted times, each with the nearest image of every camera.

    Args:
        times_ns: Times of the images, ascending, by camera. (n,) each
        wanted_ns: Times of the frames. (m,)
        scene: Name of the scene, with which the tokens of the frames begin.

    Returns:
        The frames. A camera without an image within 50 ms is missing in a frame. The paths of the
        images are relative to the folder of the images.
    """
    frames = []
    nearest = nearest_images(times_ns, wanted_ns, tolerance_ns=_TOLERANCE_NS)
    for frame_ns, image_times in zip(wanted_ns, nearest, strict=True):
        images = {}
        for name, time_ns in image_times.items():
            images[name] = (f"{file_name(name)}/{time_ns}.jpg", time_ns)
        frames.append(RigFrame(token=f"{scene}_{frame_ns}", time_ns=frame_ns, images=images))
    return frames


def _topics_of(
    calibrated_cameras: Sequence[tuple[RigCamera, str]],
    options: InputOptions,
    kinds: Mapping[str, str],
) -> dict[str, tuple[str, str]]:
    """Find the image topic of each calibrated camera; the topic of its camera info is empty.

    A topic that the user has named comes before the one of the calibration file.

    Args:
        calibrated_cameras: Cameras of the calibration file, with their setting ``images``.
        options: Options with the topics that the user has given.
        kinds: Type of the messages, by topic.

    Returns:
        Pairs (topic of the images, "") by the name of the camera.

    Raises:
        ValueError: If a camera has no topic, or the user has named topics that are not used.
    """
    names = [camera.name for camera, _ in calibrated_cameras]
    by_hand = {}
    for name, (topic, info) in options.topics.items():
        if name not in names:
            raise InputError(f"--topics names {name!r}, and the calibration has {sorted(names)}")
        if info:
            raise InputError(
                f"--topics names the camera info {info} of {name!r}, which --calibration replaces: "
                f"give {name}={topic}"
            )
        by_hand[name] = topic
    topics = {}
    for camera, images_setting in calibrated_cameras:
        if camera.name in by_hand:
            topic = by_hand[camera.name]
        else:
            topic = _topic_of(camera.name, images_setting, kinds=kinds)
        topics[camera.name] = (topic, "")
    return topics


def _topic_of(name: str, images_setting: str, kinds: Mapping[str, str]) -> str:
    """Find the topic of a calibrated camera's images by its calibration, or else by its name.

    Args:
        name: Name of the camera.
        images_setting: Setting ``images`` of the camera in the calibration file. It may be a topic.
        kinds: Type of the messages, by topic.
    """
    if kinds.get(images_setting) in IMAGES:
        return images_setting
    if images_setting.startswith("/"):  # a topic: the paths of files are relative
        raise InputError(
            f"camera {name!r} of the calibration: `images` is {images_setting}, which is "
            f"{kinds.get(images_setting, 'not there')}, and must be {' or '.join(IMAGES)}"
        )
    images = image_topics(kinds)
    topic = images.get(name)
    if topic is None:
        raise InputError(
            f"camera {name!r} of the calibration has no images: the bag's are {sorted(images)}; "
            "set its `images` to a topic, or give --topics NAME=IMAGE_TOPIC"
        )
    return topic


def _listing(bag: Bag) -> str:
    """Topics of a bag with their types and numbers of messages, as text."""
    topics = sorted(bag.topics.items())
    return "; ".join(f"{name} ({info.msgtype}, {info.msgcount})" for name, info in topics)


def _choose_vehicle(content: BagContent, wanted: str | None) -> str:
    """Choose the vehicle's frame; an error also names topics that cannot be read."""
    try:
        return content.tree.choose_vehicle(wanted)
    except ValueError as error:
        # `unreadable` topics have no message that can be read. `unread` topics have some messages
        # that cannot be read.
        topics = [*content.unreadable, *content.unread]
        if not topics:
            raise
        raise InputError(
            f"{error}; {', '.join(topics)} cannot be read: {content.reason(topics)}"
        ) from error


def _require_messages(name: str, topics: tuple[str, str], content: BagContent) -> None:
    """Raise a ``ValueError`` if a camera has no images, or lacks its camera info.

    ``topics`` are the topics of its images and of its camera info; the second may be empty.
    """
    topic, info = topics
    has_images = bool(content.images[topic].times_ns)
    lacks_info = bool(info) and topic not in content.infos  # by the topic of the images
    if not has_images or lacks_info:
        raise InputError(
            f"camera {name!r} has no message on {topic} or {info or 'its info'}: choose others "
            f"with --topics, or give --calibration. {content.reason(topics)}".rstrip(" .")
        )


def _require_own_topics(topics: Mapping[str, tuple[str, str]]) -> None:
    """Raise a ``ValueError`` if two cameras have one topic of images."""
    camera_of: dict[str, str] = {}
    for name, (topic, _) in topics.items():
        if topic in camera_of:
            raise InputError(
                f"cameras {camera_of[topic]!r} and {name!r} have one topic of images, {topic}: "
                "name another topic for one of them."
            )
        camera_of[topic] = name


def _build_rig(
    topics: Mapping[str, tuple[str, str]],
    content: BagContent,
    vehicle: str,
    ground: np.ndarray,
    by_hand: bool,
) -> tuple[dict[str, RigCamera], list[str]]:
    """Build the cameras by the topic of their images, with notes on assumptions.

    Unusable cameras are left out with a note. If the user named the topics (``by_hand``), or if no
    camera is usable, the first error is raised instead.
    """
    rig = {}
    notes = []
    errors: dict[str, ValueError] = {}
    # `trouble` is the reason why the images of a topic cannot be used; empty if they can.
    is_any_usable = any(not content.images[topic].trouble for topic, _ in topics.values())
    for name, camera_topic_pair in topics.items():
        topic = camera_topic_pair[0]
        trouble = content.images[topic].trouble
        try:
            if trouble and is_any_usable and not by_hand:
                raise InputError(f"camera {name!r}: {trouble}")
            rig[topic], camera_notes = _build_camera(
                name, camera_topic_pair, content=content, vehicle=vehicle, ground=ground
            )
            notes += camera_notes
        except ValueError as error:
            errors[name] = error
    if errors and (by_hand or not rig):
        raise next(iter(errors.values()))
    for name, camera_error in errors.items():
        reason = str(camera_error).rstrip(".")
        notes.append(f"{topics[name][0]} is left out: {reason}; {_CHOOSE}")
    return rig, notes


def _build_camera(
    name: str, topics: tuple[str, str], content: BagContent, vehicle: str, ground: np.ndarray
) -> tuple[RigCamera, list[str]]:
    """Build a camera from its camera info and its mounting, with notes on assumptions."""
    _require_messages(name, topics, content=content)
    images = content.images[topics[0]]
    info = content.infos[topics[0]]
    # Frames of ROS 1 may have a leading slash, which the transforms of `content` do not have.
    frame = images.frame_id or info.header.frame_id.lstrip("/")
    vehicle_from_cam = content.tree.between(vehicle, frame)
    if vehicle_from_cam is None:
        raise InputError(
            f"camera {name!r}: no transform leads from its frame {frame!r} to {vehicle!r}: give "
            "--calibration calibration.yaml, or another --vehicle-frame; there are transforms of "
            f"{sorted(content.tree.edges)}"
        )
    cam_from_ground = invert_rigid(vehicle_from_cam) @ ground
    return build_camera(name, images, info=info, topics=topics, cam_from_ground=cam_from_ground)


def _poses(
    content: BagContent, vehicle: str, ground: np.ndarray
) -> tuple[PoseChain | None, list[str]]:
    """Poses of the ground from the transforms of the vehicle's frame, or else from odometry.

    ``vehicle`` is empty if the bag has no transforms. The poses are None if there are none. They
    come with notes on assumptions.
    """
    chain = content.tree.poses(vehicle, ground) if vehicle else None
    if chain is not None:
        return chain, []
    odometries = list(content.odometries.values())
    return odometry_poses(odometries, content.tree, vehicle=vehicle, ground=ground)


def _near_poses(times_ns: np.ndarray, pose_at: PoseChain | None) -> np.ndarray:
    """Select the times within the span of the poses, or up to 0.1 s outside of it. (n,) -> (m,)

    All times are returned if no time is selected, or if there are no poses.
    """
    if pose_at is None:
        return times_ns
    start_ns, end_ns = pose_at.span_ns
    near = times_ns[(times_ns >= start_ns - _REACH_NS) & (times_ns <= end_ns + _REACH_NS)]
    return near if len(near) else times_ns


def _usage_notes(
    count: int,
    requested_count: int,
    times_ns: np.ndarray,
    pose_at: PoseChain | None,
    camera: str,
) -> list[str]:
    """Note on requested samples without a pose; a ``ValueError`` if no sample has a pose.

    Args:
        count: Number of samples with a pose.
        requested_count: Number of samples at the requested rate, with or without a pose.
        times_ns: Times of the images of ``camera``, which define the samples. (n,)
        pose_at: Poses, or None.
        camera: Name of the camera.
    """
    if pose_at is None or count >= requested_count:
        return []
    where = (
        f"the images of {camera!r} are from {_span_text(times_ns)}, the poses from "
        f"{_span_text(pose_at.span_ns)}; gaps of more than 1 s are not bridged"
    )
    if not count:
        raise InputError(
            f"no image has a pose near its time: {where}; images and transforms need one clock"
        )
    return [
        f"{count} of {requested_count} samples used: the others have no pose near them: {where}"
    ]


def _absence_notes(
    frames: Sequence[RigFrame], times_ns: Mapping[str, np.ndarray], sampling_camera: str
) -> list[str]:
    """Notes on cameras that lack an image in some frames.

    The images of ``sampling_camera`` define the times of the frames.
    """
    notes = []
    for name, image_times in times_ns.items():
        count = sum(name not in frame.images for frame in frames)
        if not count:
            continue
        note = f"camera {name!r} has no image within 50 ms at {count} of {len(frames)} samples"
        if count == len(frames):
            note += (
                f": its images are from {_span_text(image_times)}, and the images of "
                f"{sampling_camera!r} are from {_span_text(times_ns[sampling_camera])}"
            )
        notes.append(note)
    return notes


def _span_text(times_ns: Sequence[int] | np.ndarray) -> str:
    """First and last of ascending times, as text."""
    return f"{times_ns[0] / 1e9:.3f} to {times_ns[-1] / 1e9:.3f} s"


def _write_images(
    bag: Bag, rig: Mapping[str, RigCamera], frames: Sequence[RigFrame], frames_dir: Path
) -> list[str]:
    """Write the missing image files of frames, with notes on unusable images."""
    missing = {}  # files to write, by the name of the camera and the time of the image
    for frame in frames:
        for name, (path, time_ns) in frame.images.items():
            if not (frames_dir / path).is_file():
                missing[name, time_ns] = frames_dir / path
    if not missing:
        return []
    connections = [connection for connection in bag.connections if connection.topic in rig]
    notes = []
    # Each item has the connection, the time of recording in nanoseconds, and the bytes of a
    # message.
    for connection, recorded_ns, raw in read_messages(bag, connections):
        camera = rig[connection.topic]
        try:
            with library_errors():  # converts errors of the library to ValueError
                message = bag.parser(connection)(raw)
                # A stamp of 0 means that the publisher set none.
                time_ns = stamp_ns(message.header) or recorded_ns
                target = missing.pop((camera.name, time_ns), None)
        except ValueError:
            continue  # `read_content` has already made a note of this message
        if target is None:  # the image is in no frame, or its file exists
            continue
        where = f"camera {camera.name!r}, image at {target.stem} ns"
        try:
            with explain_errors(where, "its frame is left out"):
                write_image(message, camera, target=target, where=where)
        except ValueError as error:
            notes.append(str(error))
    return notes
