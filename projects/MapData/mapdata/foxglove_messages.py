"""Foxglove's messages (protobuf), given as those of ROS."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from gsmap.utils.extras import import_extra


def foxglove_parser(name: str, descriptors: bytes) -> Callable[[bytes], Any]:
    """Return a function that makes a message of ROS of the content of one of Foxglove's.

    Args:
        name: Type of the messages, one of ``ROS_TYPES``.
        descriptors: Their description, from the schema of an MCAP.
    """
    pb2 = import_extra("google.protobuf.descriptor_pb2", "bags")
    pool = import_extra("google.protobuf.descriptor_pool", "bags").DescriptorPool()
    factory = import_extra("google.protobuf.message_factory", "bags")
    for file in pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    parse = factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString
    convert = _KINDS[name][1]
    return lambda content: convert(parse(content))


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
ROS_TYPES = {name: msgtype for name, (msgtype, _) in _KINDS.items()}
