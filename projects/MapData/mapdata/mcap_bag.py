"""MCAP files whose messages are not all those of ROS 2: also of ROS 1, of Foxglove, and mixed."""

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

MAGIC = b"\x89MCAP0\r\n"
_OF_ROS_2 = ("ros2msg", "ros2idl", "omgidl", "")


@dataclass(frozen=True)
class McapConnection:
    """A topic of an MCAP file.

    Args:
        topic: Its name.
        msgtype: Type of ROS that its messages are given as, or their own.
        encoding: How they are serialized.
        schema: Description of their type, or None.
    """

    topic: str
    msgtype: str
    encoding: str
    schema: Any = field(default=None, compare=False)


def is_plain_ros2(path: Path) -> bool:
    """Whether rosbags can read an MCAP file: one of ROS 2 alone, or damaged."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return True
        file.seek(0)
        with library_errors():
            reader = import_bounded("mcap.reader").make_reader(file)
            if reader.get_header().profile != "ros2":
                return False
            summary = reader.get_summary()
    if summary is None:
        return True
    encodings = {channel.message_encoding for channel in summary.channels.values()}
    return encodings <= {"cdr"} and all(s.encoding in _OF_ROS_2 for s in summary.schemas.values())


@dataclass
class McapBag:
    """The parts of one recording in MCAP, with messages of any encoding.

    Args:
        paths: The files.
        notes: What is to be said about the files.
    """

    paths: Sequence[Path]
    notes: list[str] = field(default_factory=list)
    connections: list[McapConnection] = field(default_factory=list)
    topics: dict[str, Any] = field(default_factory=dict)
    _parsers: dict[McapConnection, Parser] = field(default_factory=dict)
    _types: RosTypes = field(init=False)

    def open(self) -> None:
        """Read which topics there are; ValueError if that fails."""
        begin_bag()
        self._types = RosTypes()
        for path in self.paths:
            with library_errors(), path.open("rb") as file:
                channels, schemas, counts = _contents(file)
            for channel in channels.values():
                connection = _connection(channel, schemas.get(channel.schema_id))
                if connection not in self.connections:
                    self.connections.append(connection)
                topic = self.topics.setdefault(
                    channel.topic, SimpleNamespace(msgtype=_listed_type(connection), msgcount=0)
                )
                topic.msgcount += counts.get(channel.id, 0)

    def close(self) -> None:
        """Nothing stays open."""

    def messages(
        self, connections: Iterable[McapConnection]
    ) -> Iterator[tuple[McapConnection, int, bytes]]:
        """Yield connection, time in nanoseconds and content of messages, file by file."""
        chosen = set(connections)
        topics = sorted({connection.topic for connection in chosen})
        for path in self.paths:
            with path.open("rb") as file:
                reader = import_bounded("mcap.reader").make_reader(file)
                summary = reader.get_summary()
                # without an index, messages in order would all lie in memory
                has_index = summary is not None and bool(summary.chunk_indexes)
                known: dict[int, McapConnection] = {}
                for schema, channel, message in reader.iter_messages(
                    topics, log_time_order=has_index
                ):
                    if channel.id not in known:
                        known[channel.id] = _connection(channel, schema)
                    if known[channel.id] in chosen:
                        yield known[channel.id], message.log_time, message.data

    def parser(self, connection: McapConnection) -> Parser:
        """Return what parses the messages of a connection; ValueError if nothing does."""
        if connection not in self._parsers:
            self._parsers[connection] = _parser_of(connection, self._types)
        return self._parsers[connection]


def _contents(file: Any) -> tuple[dict[int, Any], dict[int, Any], dict[int, int]]:
    """Return the channels and schemas of an MCAP by their number, and each channel's messages."""
    summary = import_bounded("mcap.reader").make_reader(file).get_summary()
    if summary is not None and summary.channels:
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        return summary.channels, summary.schemas, counts
    records = import_extra("mcap.records", "bags")
    channels, schemas, counted = {}, {}, Counter[int]()
    file.seek(0)
    for record in import_bounded("mcap.stream_reader").StreamReader(file).records:
        if isinstance(record, records.Message):
            counted[record.channel_id] += 1
        elif isinstance(record, records.Channel):
            channels[record.id] = record
        elif isinstance(record, records.Schema):
            schemas[record.id] = record
    return channels, schemas, counted


def _connection(channel: Any, schema: Any) -> McapConnection:
    """Return the connection of a channel, its type named as in ROS 2."""
    name, encoding = "" if schema is None else schema.name, channel.message_encoding
    if encoding == "protobuf":
        name = ROS_TYPES.get(name, name)
    elif encoding == "ros1" and name.count("/") == 1:
        name = name.replace("/", "/msg/")
    return McapConnection(channel.topic, name, encoding, schema)


def _listed_type(connection: McapConnection) -> str:
    """Return a connection's type as a listing names it, with an encoding that is not ROS'."""
    name = connection.schema.name if connection.schema else "no type"
    is_known = connection.encoding in ("cdr", "ros1") or name in ROS_TYPES
    return name if is_known else f"{name} in {connection.encoding}"


def _parser_of(connection: McapConnection, types: RosTypes) -> Parser:
    """Return what parses the messages of a connection."""
    schema, encoding = connection.schema, connection.encoding
    with library_errors():
        if encoding == "protobuf" and schema is not None and schema.name in ROS_TYPES:
            return foxglove_parser(schema.name, schema.data)
        if encoding not in ("cdr", "ros1"):
            raise InputError(f"its messages are in the encoding {encoding!r}")
        text = "" if schema is None else schema.data.decode()
        is_idl = schema is not None and schema.encoding in ("ros2idl", "omgidl")
    return types.parser(connection.msgtype, text, is_idl, encoding == "ros1")
