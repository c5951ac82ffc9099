"""MCAP files of Foxglove's messages (protobuf), with the interface of a rosbags reader."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gsmap.utils.extras import import_extra

MAGIC = b"\x89MCAP0\r\n"


def is_foxglove(path: Path) -> bool:
    """Whether a file is an MCAP whose messages are protobuf."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
    summary = FoxgloveBag(path).summary
    return bool(summary) and any(
        c.message_encoding == "protobuf" for c in summary.channels.values()
    )


@dataclass(frozen=True)
class Connection:
    """A topic, and the type of ROS that its messages are given as."""

    topic: str
    msgtype: str


@dataclass
class FoxgloveBag:
    """Cameras and transforms of an MCAP of Foxglove's messages, as rosbags would give them.

    Args:
        path: The file.
    """

    path: Path

    def reader(self, file: Any) -> Any:
        """Return a reader of the file; RuntimeError if ``mcap`` is not installed."""
        return import_extra("mcap.reader", "bags").make_reader(file)

    @cached_property
    def summary(self) -> Any:
        """What the file says of itself, or None."""
        with self.path.open("rb") as file:
            return self.reader(file).get_summary()

    @cached_property
    def _channels(self) -> dict[str, tuple[str, Callable[[bytes], Any]]]:
        """Name of the messages of each topic, and what parses them."""
        parsers: dict[int, Callable[[bytes], Any]] = {}
        found = {}
        for channel in self.summary.channels.values() if self.summary else ():
            schema = self.summary.schemas.get(channel.schema_id)
            if schema is not None and schema.encoding == "protobuf":
                if schema.id not in parsers:
                    parsers[schema.id] = _parser(schema.name, schema.data)
                found[channel.topic] = schema.name, parsers[schema.id]
        return found

    @cached_property
    def connections(self) -> list[Connection]:
        """The topics."""
        return [
            Connection(topic, _KINDS.get(name, (name,))[0])
            for topic, (name, _) in self._channels.items()
        ]

    @cached_property
    def topics(self) -> dict[str, Any]:
        """Type and number of the messages of each topic."""
        statistics = self.summary.statistics
        counts = statistics.channel_message_counts if statistics else {}
        number = {c.topic: counts.get(c.id, 0) for c in self.summary.channels.values()}
        return {
            topic: SimpleNamespace(msgtype=name, msgcount=number[topic])
            for topic, (name, _) in self._channels.items()
        }

    def open(self) -> None:
        """Read what the file holds."""
        assert self.connections is not None

    def close(self) -> None:
        """Nothing stays open."""

    def messages(
        self, connections: Iterable[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, time in nanoseconds and content of messages, in their order of time."""
        chosen = {connection.topic: connection for connection in connections}
        with self.path.open("rb") as file:
            for _, channel, message in self.reader(file).iter_messages(topics=list(chosen)):
                # the content alone does not say which of two types it is
                content = channel.topic.encode() + b"\n" + message.data
                yield chosen[channel.topic], message.log_time, content

    def deserialize(self, raw: bytes, msgtype: str) -> Any:
        """Return a message as ROS has it; ValueError if it cannot be parsed."""
        topic, _, content = raw.partition(b"\n")
        name, parse = self._channels[topic.decode()]
        return _KINDS[name][1](parse(content))


def _parser(name: str, descriptors: bytes) -> Callable[[bytes], Any]:
    """Return what parses messages of a type, of which a schema holds the description."""
    pb2 = import_extra("google.protobuf.descriptor_pb2", "bags")
    pool = import_extra("google.protobuf.descriptor_pool", "bags").DescriptorPool()
    factory = import_extra("google.protobuf.message_factory", "bags")
    for file in pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    parse: Callable[[bytes], Any] = factory.GetMessageClass(
        pool.FindMessageTypeByName(name)
    ).FromString
    return parse


def _header(message: Any) -> Any:
    stamp = SimpleNamespace(sec=message.timestamp.seconds, nanosec=message.timestamp.nanos)
    return SimpleNamespace(stamp=stamp, frame_id=getattr(message, "frame_id", ""))


def _compressed(message: Any) -> Any:
    data = memoryview(message.data)
    return SimpleNamespace(header=_header(message), format=message.format, data=data)


def _raw(message: Any) -> Any:
    names = ("width", "height", "encoding", "step")
    fields = {name: getattr(message, name) for name in names}
    return SimpleNamespace(header=_header(message), data=memoryview(message.data), **fields)


def _info(message: Any) -> Any:
    matrices = {"d": list(message.D), "k": list(message.K), "p": list(message.P)}
    size = {"width": message.width, "height": message.height}
    model = message.distortion_model
    return SimpleNamespace(header=_header(message), distortion_model=model, **matrices, **size)


def _transforms(message: Any) -> Any:
    items = message.transforms if hasattr(message, "transforms") else [message]
    return SimpleNamespace(transforms=[_transform(item) for item in items])


def _transform(item: Any) -> Any:
    header = _header(item)
    header.frame_id = item.parent_frame_id
    pose = SimpleNamespace(translation=item.translation, rotation=item.rotation)
    return SimpleNamespace(header=header, child_frame_id=item.child_frame_id, transform=pose)


_KINDS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "foxglove.CompressedImage": ("sensor_msgs/msg/CompressedImage", _compressed),
    "foxglove.RawImage": ("sensor_msgs/msg/Image", _raw),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _info),
    "foxglove.FrameTransform": ("tf2_msgs/msg/TFMessage", _transforms),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", _transforms),
}
