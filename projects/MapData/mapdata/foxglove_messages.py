"""Conversion of Foxglove's protobuf messages to ROS messages."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from gsmap.utils.extras import import_extra


def foxglove_parser(name: str, descriptors: bytes) -> Callable[[bytes], Any]:
    """Create a function that parses a Foxglove message, and converts it to a ROS message.

    Args:
        name: Foxglove's type of the messages, a key of ``ROS_TYPES``.
        descriptors: Protobuf descriptors of the type and its parts, serialized, from the schema of
            an MCAP file.

    Returns:
        Function that converts the bytes of a message to an object with the fields of the ROS type.
    """
    # protobuf is an optional package of the extra `bags`.
    descriptor_pb2 = import_extra("google.protobuf.descriptor_pb2", extra="bags")
    # A separate pool for this file, as files may have different versions of a type.
    pool = import_extra("google.protobuf.descriptor_pool", extra="bags").DescriptorPool()
    factory = import_extra("google.protobuf.message_factory", extra="bags")
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    message_class = factory.GetMessageClass(pool.FindMessageTypeByName(name))
    _, convert = _KINDS[name]
    return lambda content: convert(message_class.FromString(content))


def _header(message: Any) -> Any:
    """ROS header with the time and the frame of a Foxglove message."""
    stamp = SimpleNamespace(sec=message.timestamp.seconds, nanosec=message.timestamp.nanos)
    # Transforms have a parent frame instead of a frame (see `_transform`).
    return SimpleNamespace(stamp=stamp, frame_id=getattr(message, "frame_id", ""))


# The functions below return objects with the fields of a ROS message. The data of images are not
# copied.
def _compressed_image(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message), format=message.format, data=memoryview(message.data)
    )


def _raw_image(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message),
        width=message.width,
        height=message.height,
        encoding=message.encoding,
        step=message.step,
        data=memoryview(message.data),
    )


def _camera_info(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message),
        width=message.width,
        height=message.height,
        distortion_model=message.distortion_model,
        d=list(message.D),
        k=list(message.K),
        p=list(message.P),
    )


def _transforms(message: Any) -> Any:
    """Convert a message with one transform or a list of transforms."""
    items = message.transforms if hasattr(message, "transforms") else [message]
    return SimpleNamespace(transforms=[_transform(item) for item in items])


def _transform(item: Any) -> Any:
    """Convert one of the transforms of a message."""
    header = _header(item)
    header.frame_id = item.parent_frame_id
    transform = SimpleNamespace(translation=item.translation, rotation=item.rotation)
    return SimpleNamespace(header=header, child_frame_id=item.child_frame_id, transform=transform)


# ROS type of a message, and the function that converts the message, by Foxglove's type.
_KINDS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "foxglove.CompressedImage": ("sensor_msgs/msg/CompressedImage", _compressed_image),
    "foxglove.RawImage": ("sensor_msgs/msg/Image", _raw_image),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _camera_info),
    "foxglove.FrameTransform": ("tf2_msgs/msg/TFMessage", _transforms),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", _transforms),
}
ROS_TYPES = {name: msgtype for name, (msgtype, _) in _KINDS.items()}
"""ROS type of each Foxglove type that can be converted."""
