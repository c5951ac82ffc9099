"""Bags of ROS 1 and ROS 2, read with rosbags.

If the messages of one topic cannot be parsed, the other topics can still be read.
"""

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

# Largest number of fields of all types of a bag; rosbags generates some lines of code for each.
_MOST_FIELDS = 10_000
_MOST_LETTERS = 100_000  # largest size of the definition of a type

Parser = Callable[[bytes], Any]  # from the content of a message to the message


@contextmanager
def library_errors() -> Iterator[None]:
    """Convert any error that rosbags or its parsers raise for a damaged bag to a ``ValueError``.

    Errors of the operating system, which have an error number, are raised unchanged.
    """
    try:
        yield
    except MemoryError as error:
        raise InputError("a length in it asks for more memory than there is") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise InputError(str(error) or type(error).__name__) from error


class _AddressedPath(type(Path())):  # type: ignore[misc]
    """Path whose special characters are escaped in formatted strings, as in an SQLite URI.

    rosbags opens the URI ``f"file:{path}"`` and does not escape them.
    """

    def __format__(self, _: str) -> str:
        return str(self).replace("%", "%25").replace("?", "%3f").replace("#", "%23")


class RosTypes:
    """Message types of a bag, created on demand.

    If a definition contradicts another one or cannot be parsed, other types are not affected.
    """

    def __init__(self) -> None:
        self._typesys = import_extra("rosbags.typesys", extra="bags")
        self._common_store = self._empty_store()
        self._field_count = 0

    def _empty_store(self) -> Any:
        """Type store of rosbags without types. A store holds types and their generated parsers."""
        return self._typesys.get_typestore(self._typesys.Stores.EMPTY)

    def parser(self, msgtype: str, definition: str, is_idl: bool, is_ros1: bool) -> Parser:
        """Create a function that parses messages of a type.

        Args:
            msgtype: Type of the messages, such as ``sensor_msgs/msg/Image``.
            definition: Definition of the type in the bag. If it is empty, the definition of ROS 2
                Humble is used.
            is_idl: Whether the definition is in IDL.
            is_ros1: Whether the messages are serialized as in ROS 1.

        Returns:
            Function from the content of a message to the message.

        Raises:
            ValueError: If the definition cannot be parsed, or is too large.
        """
        with library_errors():
            store = self._store_with(msgtype, definition, is_idl=is_idl)
            if msgtype not in store.fielddefs:
                raise InputError(f"the bag does not define its type {msgtype!r}")
        deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        return lambda content: deserialize(content, msgtype)

    def _store_with(self, msgtype: str, definition: str, is_idl: bool) -> Any:
        """Return a type store of rosbags that contains the types of a definition."""
        if not definition:
            return _standard_store()
        if len(definition) > _MOST_LETTERS:
            raise InputError(
                f"its definition has {len(definition)} letters, more than {_MOST_LETTERS}"
            )
        types = _parse_types(self._typesys, msgtype, definition=definition, is_idl=is_idl)
        self._count_fields(types)
        try:
            self._common_store.register(types)
            return self._common_store
        except self._typesys.TypesysError:  # a type of another topic has another definition
            store = self._empty_store()
            store.register(types)
            return store

    def _count_fields(self, types: Mapping[str, Any]) -> None:
        """Count the fields of types, since rosbags generates code for each of them.

        Raises:
            ValueError: If the bag has too many fields, or a type has an array of empty messages.
        """
        counts: dict[str, int] = {}
        known_types = self._common_store.fielddefs | types
        nodes = self._typesys.base.Nodetype

        def count_values(node: Any, description: Any) -> int:
            """Least number of values of a field.

            Args:
                node: Kind of the field's type: basic, another message, array or sequence.
                description: For a basic type, its name first. For a message, the name of its type.
                    For an array or a sequence, node and description of its items, and their number.
            """
            if node == nodes.BASE:
                return 1
            if node == nodes.NAME:
                return count_values_of_type(description)
            # A sequence, whose length varies, and an array of numbers count as one value. Other
            # arrays have a fixed length and count the values of each item.
            (item_node, item_description), length = description
            values = count_values(item_node, item_description)
            if not values:
                raise InputError("it has an array of values without any field")
            is_plain = item_node == nodes.BASE and item_description[0] != "string"
            return 1 if node == nodes.SEQUENCE or is_plain else values * length

        def count_values_of_type(name: str) -> int:
            """Least number of values of a message of a type, which is counted on first use."""
            if name not in known_types:
                return 1  # rosbags raises an error for it
            if name not in counts:
                # Ends the recursion if the type contains itself; rosbags rejects such a type.
                counts[name] = 1
                constants, fields = known_types[name]
                # A field is its name, then node and description of its type.
                values = sum(count_values(node, description) for _, (node, description) in fields)
                counts[name] = values
                self._field_count += len(constants) + values
                if self._field_count > _MOST_FIELDS:
                    raise InputError(
                        f"the types of the bag have more than {_MOST_FIELDS} fields, and items of "
                        "arrays count as fields"
                    )
            return counts[name]

        for name in types:
            count_values_of_type(name)


@cache
def _standard_store() -> Any:
    """Type store with the types of ROS 2 Humble."""
    typesys = import_extra("rosbags.typesys", extra="bags")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def _parse_types(typesys: Any, msgtype: str, definition: str, is_idl: bool) -> dict[str, Any]:
    """Parse the types of a definition, which also contains the types of nested messages.

    A definition in IDL may have several sections. Each begins with a line of "=" and a line
    ``IDL: name``.
    """
    if not is_idl:
        return dict(typesys.get_types_from_msg(definition, msgtype))
    separator = "=" * 80 + "\n"
    if not definition.startswith(f"{separator}IDL: "):
        return dict(typesys.get_types_from_idl(definition))
    types: dict[str, Any] = {}
    for section in definition.split(separator)[1:]:
        text = section.partition("\n")[2]  # below the line ``IDL: name``
        types |= typesys.get_types_from_idl(text)
    return types


@dataclass
class RosBag:
    """A recording in one or several parts, read with rosbags.

    Args:
        paths: Bags of ROS 1, or files or folders of rosbag2.
        notes: Notes on the files.
        connections: Connections of rosbags; known once the bag is open.
    """

    paths: Sequence[Path]
    notes: list[str] = field(default_factory=list)
    connections: list[Any] = field(default_factory=list)
    _readers: list[Any] = field(default_factory=list)
    _parsers: dict[tuple[str, str], Parser] = field(default_factory=dict)
    _is_ros1: bool = False
    _types: RosTypes = field(init=False)

    def open(self) -> None:
        """Open the files and read their connections.

        Raises:
            ValueError: If a file is damaged.
        """
        begin_bag()  # starts to count the decompressed bytes, which `import_bounded` limits
        self._types = RosTypes()
        # A folder is a bag of ROS 2, whatever its name.
        self._is_ros1 = self.paths[0].suffix == ".bag" and not self.paths[0].is_dir()
        module = "rosbags.rosbag1" if self._is_ros1 else "rosbags.rosbag2"
        reader_type = import_bounded(module).Reader
        for path in self.paths:
            with library_errors():
                # rosbags builds an address of the file from the path.
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
        """Type (``msgtype``) and number of the messages (``msgcount``) by topic."""
        topics: dict[str, Any] = {}
        for connection in self.connections:
            topic = topics.setdefault(
                connection.topic, SimpleNamespace(msgtype=connection.msgtype, msgcount=0)
            )
            topic.msgcount += connection.msgcount
            if topic.msgtype != connection.msgtype:
                topic.msgtype = "several types"
        return topics

    def messages(self, connections: Iterable[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time in nanoseconds and content of messages, in order of time.

        Args:
            connections: Connections whose messages are read, entries of ``connections``.
        """
        # Connections are tuples with long texts (definitions), so their identities are compared.
        selected_ids = set(map(id, connections))
        streams = []
        for reader in self._readers:
            selected = [item for item in reader.connections if id(item) in selected_ids]
            if selected:
                streams.append(reader.messages(connections=selected))
        yield from merge(*streams, key=lambda message: message[1])

    def parser(self, connection: Any) -> Parser:
        """Function that parses the messages of a connection.

        Raises:
            ValueError: If the type of the messages is not supported.
        """
        definition = connection.msgdef.data
        key = (connection.msgtype, definition)
        if key not in self._parsers:
            self._parsers[key] = self._types.parser(
                connection.msgtype,
                definition,
                is_idl=connection.msgdef.format.name == "IDL",
                is_ros1=self._is_ros1,
            )
        return self._parsers[key]
