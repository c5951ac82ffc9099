"""MCAP files with messages of ROS 1, ROS 2 and Foxglove, which may be mixed in one file.

A channel of a file is a topic with one encoding and one schema, the definition of the message type.
The summary at the end of a file lists channels and schemas.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra
from mapdata.decompression import begin_bag, import_bounded
from mapdata.foxglove_messages import ROS_TYPES, foxglove_parser
from mapdata.ros_bag import Parser, RosTypes, library_errors

MAGIC = b"\x89MCAP0\r\n"  # first bytes of every MCAP file
_ROS_2_SCHEMAS = ("ros2msg", "ros2idl", "omgidl", "")  # empty: a topic without a definition


@dataclass(frozen=True)
class McapConnection:
    """A topic of an MCAP file, with messages of one type.

    Args:
        topic: Name of the topic.
        msgtype: Type of the messages. Types of ROS have their names of ROS 2.
        encoding: Serialization of the messages: ``cdr`` (ROS 2), ``ros1``, ``protobuf`` (Foxglove),
            or another one that is not supported.
        schema: Definition of the type as a record of ``mcap``; None without a definition.
    """

    topic: str
    msgtype: str
    encoding: str
    # A schema does not distinguish connections, since each file of a recording may repeat it.
    schema: Any = field(default=None, compare=False)


def is_plain_ros2(path: Path) -> bool:
    """Whether the library rosbags can read an MCAP file, because it has messages of ROS 2 only.

    The result is also True for a file that does not begin as an MCAP file or has no summary, so
    that rosbags reports the fault.

    Raises:
        ValueError: If the header or the summary of the file is damaged.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return True
        file.seek(0)
        # `library_errors` turns every error of the library into a ValueError.
        with library_errors():
            # `import_bounded` imports a module of mcap and limits the bytes that it decompresses.
            reader = import_bounded("mcap.reader").make_reader(file)
            if reader.get_header().profile != "ros2":
                return False
            summary = reader.get_summary()
    if summary is None:
        return True
    if any(channel.message_encoding != "cdr" for channel in summary.channels.values()):
        return False
    return all(schema.encoding in _ROS_2_SCHEMAS for schema in summary.schemas.values())


@dataclass
class McapBag:
    """A recording in one or several MCAP files, with messages of any encoding.

    Args:
        paths: The files.
        notes: Notes on the files.
        connections: Topics of the files; known once the bag is open.
        topics: Type (``msgtype``) and number of the messages (``msgcount``) by topic; known once
            the bag is open.
    """

    paths: Sequence[Path]
    notes: list[str] = field(default_factory=list)
    connections: list[McapConnection] = field(default_factory=list)
    topics: dict[str, Any] = field(default_factory=dict)
    _parsers: dict[McapConnection, Parser] = field(default_factory=dict)
    _types: RosTypes = field(init=False)

    def open(self) -> None:
        """Read the topics of the files.

        Raises:
            ValueError: If a file is damaged.
        """
        begin_bag()  # the limit of decompressed bytes is for one bag: they are counted from 0
        self._types = RosTypes()
        for path in self.paths:
            with library_errors(), path.open("rb") as file:
                channels, schemas, counts = _read_channels(file)
            for channel in channels.values():
                connection = _connection_of(channel, schemas.get(channel.schema_id))
                if connection not in self.connections:
                    self.connections.append(connection)
                topic = self.topics.setdefault(
                    channel.topic, SimpleNamespace(msgtype=_listed_type(connection), msgcount=0)
                )
                topic.msgcount += counts.get(channel.id, 0)

    def close(self) -> None:
        """Close the bag; no file is open between calls."""

    def messages(
        self, connections: Iterable[McapConnection]
    ) -> Iterator[tuple[McapConnection, int, bytes]]:
        """Yield the messages of some connections, file by file.

        Within a file, messages are in order of time if the file has an index, or else in the order
        of the file.

        Args:
            connections: Connections of this bag.

        Yields:
            Connection, time of recording in nanoseconds, and serialized content of a message.
        """
        selected = set(connections)
        topics = sorted({connection.topic for connection in selected})
        for path in self.paths:
            with path.open("rb") as file:
                reader = import_bounded("mcap.reader").make_reader(file)
                summary = reader.get_summary()
                # Without an index, sorting by time would need all messages in memory.
                has_index = summary is not None and bool(summary.chunk_indexes)
                connection_of: dict[int, McapConnection] = {}
                for schema, channel, message in reader.iter_messages(
                    topics, log_time_order=has_index
                ):
                    if channel.id not in connection_of:
                        connection_of[channel.id] = _connection_of(channel, schema)
                    connection = connection_of[channel.id]
                    if connection in selected:
                        yield connection, message.log_time, message.data

    def parser(self, connection: McapConnection) -> Parser:
        """Function from the content of a message of a connection to the parsed message.

        It is created once for each connection.

        Raises:
            ValueError: If the encoding or the type of the messages is not supported.
        """
        if connection not in self._parsers:
            self._parsers[connection] = _create_parser(connection, self._types)
        return self._parsers[connection]


def _read_channels(file: Any) -> tuple[dict[int, Any], dict[int, Any], dict[int, int]]:
    """Read the channels and schemas of a file by id, and the number of messages of each channel."""
    summary = import_bounded("mcap.reader").make_reader(file).get_summary()
    if summary is not None and summary.channels:
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        return summary.channels, summary.schemas, counts
    # Without channels in a summary, all records of the file are read.
    records = import_extra("mcap.records", extra="bags")
    channels = {}
    schemas = {}
    message_counts = Counter[int]()
    file.seek(0)
    for record in import_bounded("mcap.stream_reader").StreamReader(file).records:
        if isinstance(record, records.Message):
            message_counts[record.channel_id] += 1
        elif isinstance(record, records.Channel):
            channels[record.id] = record
        elif isinstance(record, records.Schema):
            schemas[record.id] = record
    return channels, schemas, message_counts


def _connection_of(channel: Any, schema: Any) -> McapConnection:
    """Connection of a channel, with the type named as in ROS 2.

    ``ROS_TYPES`` has the ROS type of each Foxglove type that can be converted. A type of ROS 1,
    such as ``sensor_msgs/Image``, is named ``sensor_msgs/msg/Image`` in ROS 2.
    """
    name = "" if schema is None else schema.name
    encoding = channel.message_encoding
    if encoding == "protobuf":
        name = ROS_TYPES.get(name, name)
    elif encoding == "ros1" and name.count("/") == 1:
        name = name.replace("/", "/msg/")
    return McapConnection(channel.topic, msgtype=name, encoding=encoding, schema=schema)


def _listed_type(connection: McapConnection) -> str:
    """Type of the messages of a connection, for a list of topics.

    The encoding is added, except for encodings of ROS and types of Foxglove (``ROS_TYPES``).
    """
    name = connection.schema.name if connection.schema else "no type"
    is_known = connection.encoding in ("cdr", "ros1") or name in ROS_TYPES
    return name if is_known else f"{name} in {connection.encoding}"


def _create_parser(connection: McapConnection, types: RosTypes) -> Parser:
    """Create a function that parses the messages of a connection.

    The caller adds the name of the topic to the message of an error.

    Args:
        connection: The connection.
        types: Types of ROS messages in this bag.

    Raises:
        ValueError: If the encoding or the type of the messages is not supported.
    """
    schema = connection.schema
    encoding = connection.encoding
    with library_errors():
        if encoding == "protobuf" and schema is not None and schema.name in ROS_TYPES:
            # This parser also converts the messages to messages of ROS.
            return foxglove_parser(schema.name, schema.data)
        if encoding not in ("cdr", "ros1"):
            raise InputError(f"its messages are in the encoding {encoding!r}")
        definition = "" if schema is None else schema.data.decode()
        # ROS 2 definitions are written in IDL or in the format of .msg files.
        is_idl = schema is not None and schema.encoding in ("ros2idl", "omgidl")
    return types.parser(connection.msgtype, definition, is_idl=is_idl, is_ros1=encoding == "ros1")
