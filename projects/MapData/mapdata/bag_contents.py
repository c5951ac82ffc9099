"""First pass over a bag, which reads calibrations, transforms, poses, and the times of images.

A bag is a recording of ROS: messages on topics. A connection of a bag stands for messages of one
topic and one type. The stamp of a message is the time that its publisher has written into it. A
camera info is the message with the calibration of a camera.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.datasets.errors import explain_errors
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError
from mapdata.bag_cameras import ImageTopic, is_calibrated, is_same_calibration
from mapdata.bag_files import Bag
from mapdata.bag_poses import FrameTree, Odometry, is_static_topic
from mapdata.folders.rig import rotation_of
from mapdata.ros_bag import library_errors

_ODOMETRY = "nav_msgs/msg/Odometry"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
# Index of the first byte after the stamp of a camera info: 4 bytes of a sequence number (ROS 1) or
# of the encoding (ROS 2), and 8 bytes of the stamp.
_STAMP_END = 12
# Version of the rules by which images are written. It is a part of the digest that names the folder
# of the images, so images that were written by another version are not reused.
_RULES = b"2"


@dataclass
class BagContent:
    """Content of a bag, except the images themselves.

    Args:
        infos: Camera info, by the topic of the images.
        images: Coordinate frame, times and sizes of the images, by their topic.
        tree: Tree of the coordinate frames that the transforms connect.
        odometries: Odometry, by topic, parent frame and child frame.
        digest: SHA-256 object of all messages. The folder of the images is named by its digest.
        unread: Errors of single messages that cannot be read, at least one for each topic in it.
        unreadable: Reason why no message of a topic can be read, by topic.
        unstamped: Number of transforms and poses with the stamp 0, by topic.
        changed_infos: Number of camera infos that differ from the first one of the camera, by the
            topic of the images.
    """

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
        """Store the first camera info with focal lengths, and count later ones that differ from it.

        Until there is one with focal lengths, each camera info is stored in place of the previous
        one, so that a bag without focal lengths has a camera info to report.

        Args:
            topic: Topic of the images.
            info: Message with the camera info.

        Returns:
            Whether the camera info was stored.
        """
        first_info = self.infos.get(topic)
        if first_info is None or not is_calibrated(first_info):
            self.infos[topic] = info
            return True
        if not is_same_calibration(first_info, info):
            self.changed_infos[topic] += 1
        return False

    def add(self, message: Any, topic: str, kind: str, recorded_ns: int) -> None:
        """Add the transforms, the odometry or the image of a message.

        Args:
            message: The message.
            topic: Topic of the message.
            kind: Type of the message.
            recorded_ns: Time of recording, used if a stamp is 0.
        """
        if kind in _TRANSFORMS:
            self._add_transforms(message, topic=topic, recorded_ns=recorded_ns)
        elif kind == _ODOMETRY:
            self._add_odometry(message, topic=topic, recorded_ns=recorded_ns)
        else:
            self._add_image(message, topic=topic, recorded_ns=recorded_ns)

    def _add_transforms(self, message: Any, topic: str, recorded_ns: int) -> None:
        is_static = is_static_topic(topic)
        for item in message.transforms:
            pose = _pose_matrix(item.transform.translation, item.transform.rotation)
            child = item.child_frame_id.lstrip("/")  # old names of frames begin with a slash
            parent = item.header.frame_id.lstrip("/")
            stamp = stamp_ns(item.header)
            self.tree.add(
                topic, child=child, parent=parent, time_ns=stamp or recorded_ns, pose=pose
            )
            # Transforms of static topics are valid at all times, so their stamps do not matter.
            if not stamp and not is_static:
                self.unstamped[topic] += 1

    def _add_odometry(self, message: Any, topic: str, recorded_ns: int) -> None:
        stamp = stamp_ns(message.header)
        pose = _pose_matrix(message.pose.pose.position, message.pose.pose.orientation)
        parent = message.header.frame_id.lstrip("/")
        child = message.child_frame_id.lstrip("/")
        key = (topic, parent, child)
        odometry = self.odometries.setdefault(
            key, Odometry(topic=topic, parent=parent, child=child)
        )
        odometry.poses.append(pose)
        odometry.times_ns.append(stamp or recorded_ns)
        if not stamp:
            self.unstamped[topic] += 1

    def _add_image(self, message: Any, topic: str, recorded_ns: int) -> None:
        stamp = stamp_ns(message.header)
        images = self.images[topic]
        images.add(message, time_ns=stamp or recorded_ns)
        if not stamp:
            images.unstamped += 1

    def reason(self, topics: Sequence[str]) -> str:
        """Return the reason why messages of any of the topics cannot be read; empty if all can."""
        for topic in topics:
            if topic in self.unreadable:
                return self.unreadable[topic]
        for topic in topics:
            if topic in self.unread:
                return self.unread[topic][0]
        return ""

    def notes(self) -> list[str]:
        """Return notes on messages that cannot be read or are not used."""
        notes = [f"{topic!r} is left out: {reason}" for topic, reason in self.unreadable.items()]
        for topic, count in self.changed_infos.items():
            notes.append(
                f"{count} messages of the camera info of {topic!r} differ from the first, which is "
                "used"
            )
        for topic, reasons in self.unread.items():
            notes.append(
                f"{len(reasons)} messages of {topic!r} cannot be read and are left out: "
                f"{reasons[0]}"
            )
        for topic, count in self.unstamped.items():
            notes.append(
                f"{count} transforms or poses of {topic!r} have the stamp 0: their time of "
                "recording is used"
            )
        for topic, images in self.images.items():
            notes += images.notes(topic)
        return notes


def read_messages(bag: Bag, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """Yield connection, time of recording in nanoseconds, and serialized content of messages.

    Args:
        bag: The bag, open.
        connections: Connections whose messages are read.

    Raises:
        ValueError: If the bag is damaged.
    """
    if not connections:  # nothing can be read
        return
    messages = iter(bag.messages(connections))
    while True:
        # Only the reading is in this context, not the code of the caller, which runs at ``yield``.
        # The context converts all errors of the reading library to a ``ValueError``.
        with library_errors():
            message = next(messages, None)
        if message is None:
            return
        yield message


def stamp_ns(header: Any) -> int:
    """Stamp of a message's header in nanoseconds; 0 if the publisher set none."""
    stamp = header.stamp
    # A ROS time has seconds `sec` and the nanoseconds beyond them.
    return int(stamp.sec) * 10**9 + int(getattr(stamp, "nanosec", 0) or 0)


def _pose_matrix(position: Any, orientation: Any) -> np.ndarray:
    """Pose from the position and the quaternion of a message. (4, 4)

    Raises:
        ValueError: If the position is not finite, or the quaternion does not have the length 1.
    """
    wxyz = (orientation.w, orientation.x, orientation.y, orientation.z)
    pose = rigid(rotation_of(wxyz), (position.x, position.y, position.z))
    if not np.isfinite(pose).all():
        raise InputError(f"a position is not finite: {pose[:3, 3].tolist()}")
    return pose


def read_content(bag: Bag, topics: Mapping[str, tuple[str, str]]) -> BagContent:
    """Read the content of a bag, except the images themselves.

    Args:
        bag: The bag, open.
        topics: For each camera, the topics of its images and of its camera info. The topic of the
            camera info is empty if there is none.

    Returns:
        The content; messages that cannot be read are left out and noted.
    """
    content = BagContent()
    content.digest.update(_RULES)
    image_topics_of: dict[str, list[str]] = defaultdict(list)  # by the topic of the camera info
    for image_topic, info_topic in topics.values():
        if info_topic:
            image_topics_of[info_topic].append(image_topic)
    connections = _readable_connections(bag, topics=topics, content=content)
    # Content of the stored camera info after its stamp, by its topic. Equal messages are not
    # parsed.
    known_infos: dict[str, bytes] = {}
    for connection, recorded_ns, raw in read_messages(bag, connections):
        topic = connection.topic
        kind = connection.msgtype
        content.digest.update(f"{topic} {kind} {len(raw)}\n".encode())
        content.digest.update(raw)
        if topic in known_infos and raw[_STAMP_END:] == known_infos[topic]:
            continue  # it repeats the stored camera info
        try:
            with explain_errors(f"the message at {recorded_ns} ns", "it is damaged"):
                with library_errors():
                    message = bag.parser(connection)(raw)
                if topic in image_topics_of:  # a camera info
                    for image_topic in image_topics_of[topic]:
                        if content.add_info(image_topic, message):
                            known_infos[topic] = bytes(raw[_STAMP_END:])
                else:
                    content.add(message, topic, kind=kind, recorded_ns=recorded_ns)
        except ValueError as error:
            content.unread[topic].append(str(error))
    return content


def _readable_connections(
    bag: Bag, topics: Mapping[str, tuple[str, str]], content: BagContent
) -> list[Any]:
    """Select the connections of cameras, transforms and odometry that can be read.

    For topics of these kinds that cannot be read, the reasons are stored in ``content.unreadable``.
    """
    camera_topics = set()
    for image_topic, info_topic in topics.values():
        camera_topics.add(image_topic)
        if info_topic:
            camera_topics.add(info_topic)
    readable = []
    for connection in bag.connections:
        is_pose = connection.msgtype in _TRANSFORMS or connection.msgtype == _ODOMETRY
        if connection.topic not in camera_topics and not is_pose:
            continue
        try:
            bag.parser(connection)  # raises an error if the type of the messages is unknown
            readable.append(connection)
        except ValueError as error:
            reason = " ".join(str(error).split())  # in one line
            content.unreadable[connection.topic] = reason
    return readable
