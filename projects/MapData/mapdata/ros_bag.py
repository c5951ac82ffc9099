"""Bags of ROS 1 and ROS 2 as rosbags reads them, each topic by itself."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from heapq import merge
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra
from mapdata.decompression import begin_bag, import_bounded

_MOST_FIELDS = 10_000  # of the types of a bag; rosbags makes some lines of code for each
_MOST_LETTERS = 100_000  # of a definition

Parser = Callable[[bytes], Any]


@contextmanager
def library_errors() -> Iterator[None]:
    """Turn what rosbags and the parsers below it raise for a damaged bag into a ``ValueError``."""
    try:
        yield
    except MemoryError as error:
        raise InputError("a length in it asks for more memory than there is") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise InputError(str(error) or type(error).__name__) from error


class _AddressedPath(type(Path())):  # type: ignore[misc]
    """A path that rosbags can put into an address of SQLite, whatever signs it has."""

    def __format__(self, _: str) -> str:
        return str(self).replace("%", "%25").replace("?", "%3f").replace("#", "%23")


class RosTypes:
    """The types of a bag's messages, made as they are needed.

    Definitions that contradict each other, or that cannot be read, concern their own type alone.
    """

    def __init__(self) -> None:
        self._typesys = import_extra("rosbags.typesys", "bags")
        self._common = self._empty()
        self._fields = 0

    def _empty(self) -> Any:
        return self._typesys.get_typestore(self._typesys.Stores.EMPTY)

    def parser(self, msgtype: str, definition: str, is_idl: bool, is_ros1: bool) -> Parser:
        """Return a function that makes a message of its content.

        Args:
            msgtype: Type of the messages, such as ``sensor_msgs/msg/Image``.
            definition: Its definition as the bag holds it; empty takes that of ROS 2 Humble.
            is_idl: Whether the definition is in IDL.
            is_ros1: Whether the content is serialized as in ROS 1.

        Raises:
            ValueError: If the definition cannot be read.
        """
        with library_errors():
            store = self._store_of(msgtype, definition, is_idl)
            if msgtype not in store.fielddefs:
                raise InputError(f"the bag does not define its type {msgtype!r}")
        deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        return lambda content: deserialize(content, msgtype)

    def _store_of(self, msgtype: str, definition: str, is_idl: bool) -> Any:
        """Return a store that has a type."""
        if not definition:
            return _standard_store()
        if len(definition) > _MOST_LETTERS:
            raise InputError(f"its definition has {len(definition)} letters, not {_MOST_LETTERS}")
        types = _types(self._typesys, msgtype, definition, is_idl)
        self._count_fields(types)
        try:
            self._common.register(types)
            return self._common
        except self._typesys.TypesysError:  # it contradicts a type of another topic
            store = self._empty()
            store.register(types)
            return store

    def _count_fields(self, types: Mapping[str, Any]) -> None:
        """Refuse types that take too long to make readers of, or whose messages have no size.

        Raises:
            ValueError: If they have too many fields, or arrays of values without any.
        """
        sizes: dict[str, int] = {}
        known = self._common.fielddefs | types

        def size_of(kind: Any, of_kind: Any) -> int:
            """Return how many values a field has at least."""
            nodes = self._typesys.base.Nodetype
            if kind == nodes.BASE:
                return 1
            if kind == nodes.NAME:
                return size_of_type(of_kind)
            item, count = of_kind
            values = size_of(*item)
            if not values:
                raise InputError("it has an array of values without any field")
            is_plain = item[0] == nodes.BASE and item[1][0] != "string"
            return 1 if kind == nodes.SEQUENCE or is_plain else values * count

        def size_of_type(name: str) -> int:
            if name not in known:
                return 1  # which rosbags says
            if name not in sizes:
                sizes[name] = 1  # a type of itself, which rosbags refuses
                constants, fields = known[name]
                values = sum(size_of(*of_field) for _, of_field in fields)
                sizes[name] = values
                self._fields += len(constants) + values
                if self._fields > _MOST_FIELDS:
                    raise InputError(
                        f"the types of the bag have more than {_MOST_FIELDS} fields, arrays counted"
                    )
            return sizes[name]

        for name in types:
            size_of_type(name)


@cache
def _standard_store() -> Any:
    """Return the types of ROS 2 Humble."""
    typesys = import_extra("rosbags.typesys", "bags")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def _types(typesys: Any, msgtype: str, definition: str, is_idl: bool) -> dict[str, Any]:
    """Return the types that a definition names."""
    if not is_idl:
        return dict(typesys.get_types_from_msg(definition, msgtype))
    separator = "=" * 80 + "\n"
    if not definition.startswith(f"{separator}IDL: "):
        return dict(typesys.get_types_from_idl(definition))
    found: dict[str, Any] = {}
    for part in definition.split(separator)[1:]:
        found |= typesys.get_types_from_idl(part.partition("\n")[2])
    return found


@dataclass
class RosBag:
    """The parts of one recording, read by rosbags.

    Args:
        paths: Bags of ROS 1, or files or folders of rosbag2.
        notes: What is to be said about the files.
    """

    paths: Sequence[Path]
    notes: list[str] = field(default_factory=list)
    connections: list[Any] = field(default_factory=list)
    _readers: list[Any] = field(default_factory=list)
    _parsers: dict[tuple[str, str], Parser] = field(default_factory=dict)
    _is_ros1: bool = False
    _types: RosTypes = field(init=False)

    def open(self) -> None:
        """Read which topics there are; ValueError if that fails."""
        begin_bag()
        self._types = RosTypes()
        self._is_ros1 = self.paths[0].suffix == ".bag"
        module = "rosbags.rosbag1" if self._is_ros1 else "rosbags.rosbag2"
        reader_type = import_bounded(module).Reader
        for path in self.paths:
            with library_errors():
                reader = reader_type(_AddressedPath(path))
                reader.open()
            self._readers.append(reader)
            self.connections += reader.connections

    def close(self) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()
        self._readers.clear()

    @property
    def topics(self) -> dict[str, Any]:
        """Type and number of the messages of each topic."""
        found: dict[str, Any] = {}
        for connection in self.connections:
            topic = found.setdefault(
                connection.topic, SimpleNamespace(msgtype=connection.msgtype, msgcount=0)
            )
            topic.msgcount += connection.msgcount
            if topic.msgtype != connection.msgtype:
                topic.msgtype = "several types"
        return found

    def messages(self, connections: Iterable[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time in nanoseconds and content of messages, in their order of time."""
        parts = []
        for reader in self._readers:
            known = {id(connection) for connection in reader.connections}
            of_reader = [c for c in connections if id(c) in known]
            if of_reader:
                parts.append(reader.messages(connections=of_reader))
        yield from merge(*parts, key=lambda message: message[1])

    def parser(self, connection: Any) -> Parser:
        """Return what parses the messages of a connection; ValueError if nothing does."""
        key = connection.msgtype, connection.msgdef.data
        if key not in self._parsers:
            is_idl = connection.msgdef.format.name == "IDL"
            self._parsers[key] = self._types.parser(*key, is_idl, self._is_ros1)
        return self._parsers[key]
