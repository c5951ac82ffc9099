"""Reading of Lanelet2 maps (OSM XML), written by `write_lanelet2` or by other programs."""

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

import numpy as np

from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.map_reading import CLASS_KEY, ClassRule, ElementCollector, MapFile, score_of
from gsmap.structures.elements import FloatArray
from gsmap.utils.errors import InputError
from gsmap.utils.files import fetch_advice

CLASS_OF_TYPE = {
    "line_thin": "divider",
    "line_thick": "divider",
    "road_border": "boundary",
    "curbstone": "boundary",
    "guard_rail": "boundary",
    "wall": "boundary",
    "fence": "boundary",
    "zebra_marking": "ped_crossing",
    "pedestrian_marking": "ped_crossing",
    "stop_line": "stop_line",
}
"""Class of line strings by their Lanelet2 type. A type not listed is used if it is a class name."""
_CROSSING = "ped_crossing"
_BLOCK = 1 << 20  # bytes that are read at once
_DEEPEST = 20  # largest depth of nested XML elements
_MOST_PARTS = 10_000_000  # largest number of parts: nodes, ways, relations, and references to them
# Largest number of nodes of all crosswalk rings together, as a multiple of the parts of the file.
# Without this limit, the crosswalks of a small file could repeat one long line any number of times.
_MOST_USES = 4
_MOST_APART_M = 10.0  # largest distance between the local position of a node and its degrees
_KINDS = ("node", "way", "relation")


class _Node(NamedTuple):
    """Position of a node.

    Attributes:
        degrees: Longitude and latitude in degrees, or None if the node has none.
        local: x and y in the global frame in metres, or None if the node has none.
    """

    degrees: tuple[float, float] | None
    local: tuple[float, float] | None


class _Way(NamedTuple):
    """Line string.

    Attributes:
        nodes: IDs of its nodes.
        tags: Tags by their keys; untrusted.
    """

    nodes: list[str]
    tags: dict[str, str]

    @property
    def ring_or_line(self) -> list[str]:
        """IDs of its nodes, with the first node of an area repeated at the end."""
        is_area = self.tags.get("area") == "yes"
        # Slices are compared, because a way may have no nodes. It is then returned as it is.
        if is_area and self.nodes[:1] != self.nodes[-1:]:
            return [*self.nodes, self.nodes[0]]
        return self.nodes


class _Relation(NamedTuple):
    """Lanelet, area or regulatory element.

    Attributes:
        ways_of_role: IDs of the members that are ways, by their role, such as ``left``.
        tags: Tags by their keys; untrusted.
    """

    ways_of_role: dict[str, list[str]]
    tags: dict[str, str]

    @property
    def way_ids(self) -> list[str]:
        """IDs of the members that are ways."""
        return list(chain.from_iterable(self.ways_of_role.values()))


def read_lanelet2(
    path: str | Path,
    classes: Sequence[str],
    origin: MapOrigin | MapGrid | None = None,
    rule: ClassRule | None = None,
) -> MapFile:
    """Read the line strings, polygons and crosswalks of a Lanelet2 map.

    A line string gets its class from the tag ``class``, or else from its type (`CLASS_OF_TYPE`). A
    lanelet of the subtype ``crosswalk`` is an area of the class ``ped_crossing``. The tag ``score``
    is the confidence of an element. Positions are ``local_x`` and ``local_y`` if all used nodes
    have them, and otherwise longitude and latitude.
    Other line strings and relations are only counted, and so are degrees that contradict the local
    positions.

    Args:
        path: File, which may be untrusted. A file with a document type declaration is refused,
            because it could declare XML entities that expand to a very long text.
        classes: Class names in label order.
        origin: Position of the global frame on the Earth, to convert or to check positions.
        rule: Tag that gives a line string its class. Types and crosswalks are then not used.

    Returns:
        Elements in the global frame, and the number of elements that are not used.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is malformed or too large, a number is not finite or out of range,
            a node or a bound of a crosswalk is missing, a crosswalk has several left or right
            bounds, degrees have no origin, or no element can be used.
        RuntimeError: If an origin is given and ``pyproj`` is missing.
    """
    path = Path(path)
    parser = _Parser(path)
    parser.read()
    # The collector takes the lines that have a class, and counts all others by the reason.
    collector = ElementCollector(path, classes, rule=rule or ClassRule(CLASS_KEY))
    collector.unused.update(parser.num_deleted)
    uses_crosswalks = rule is None and _CROSSING in classes
    crosswalks = parser.crosswalks() if uses_crosswalks else {}
    lines = []  # class, IDs of the nodes, and score
    # IDs of ways that are bounds of crosswalks. They are part of the rings, not lines of the map.
    bound_ids: set[str] = set()
    for relation_id, relation in crosswalks.items():
        ring = parser.ring_of(relation_id, relation)
        lines.append((_CROSSING, ring, score_of(relation.tags)))
        bound_ids.update(relation.way_ids)
    for way_id, way in parser.ways.items():
        if way_id in bound_ids:
            collector.unused.update(_unused_bound(way, classes))
            continue
        tags = way.tags if rule else _with_class(way.tags, classes)
        class_name = collector.class_of(tags)  # None for an element that is only counted
        if class_name is not None:
            lines.append((class_name, way.ring_or_line, score_of(way.tags)))
    for relation_id, relation in parser.relations.items():
        if relation_id not in crosswalks:
            kind = relation.tags.get("type", "")
            collector.unused[f"relation {kind[:40]!r}"] += 1
    nodes_of_lines = [nodes for _, nodes, _ in lines]
    is_local = parser.have_local_positions(nodes_of_lines)
    if not is_local and origin is None:
        raise InputError(
            f"{path} has nodes without local_x and local_y, and the origin of the global frame is "
            "not known: give --origin or --crs."
        )
    if is_local:
        collector.unused.update(parser.contradictions(origin, nodes_of_lines))
    for class_name, nodes, score in lines:
        collector.add(class_name, parser.positions(nodes, is_local=is_local), score=score)
    # With the origin, `finish` converts degrees to metres. Without it, lines are in metres already.
    return collector.finish(None if is_local else origin)


def _with_class(tags: Mapping[str, str], classes: Sequence[str]) -> dict[str, str]:
    """Return tags with a class name, taken from the Lanelet2 type if the given tags have none."""
    if tags.get(CLASS_KEY) in classes:
        return dict(tags)
    kind = tags.get("type", "")
    if kind in CLASS_OF_TYPE:
        return {CLASS_KEY: CLASS_OF_TYPE[kind]}
    if kind in classes:
        return {CLASS_KEY: kind}
    # The value is not a class. It describes the line string in the count of unused elements.
    subtype = tags.get("subtype", "")
    return {CLASS_KEY: f"{kind}/{subtype}" if subtype else kind}


def _unused_bound(way: _Way, classes: Sequence[str]) -> list[str]:
    """Reason to count the bound of a crosswalk, if it has the type of another class (a kerb)."""
    name = _with_class(way.tags, classes)[CLASS_KEY]
    is_other = name in classes and name != _CROSSING
    return [f"{name} that is part of a crosswalk"] if is_other else []


class _Parser:
    """Parser of the nodes, ways and relations of an OSM file, which expat reads in blocks.

    Errors quote at most 40 characters of a value (``:.40``), because the file may be untrusted.

    Args:
        path: File.

    Attributes:
        nodes: Nodes by their IDs.
        ways: Line strings by their IDs.
        relations: Relations by their IDs.
        num_deleted: Number of elements that an editor has marked as deleted, by the reason
            ``deleted node``, ``deleted way`` or ``deleted relation``.
    """

    def __init__(self, path: Path) -> None:
        self.nodes: dict[str, _Node] = {}
        self.ways: dict[str, _Way] = {}
        self.relations: dict[str, _Relation] = {}
        self.num_deleted: dict[str, int] = {}
        self._path = path
        self._depth = 0
        self._num_parts = 0
        self._num_ring_nodes = 0
        self._attributes: dict[str, str] = {}
        self._tags: dict[str, str] = {}
        self._references: list[str] = []
        self._ways_of_role: dict[str, list[str]] = {}

    def read(self) -> None:
        """Read the file.

        Raises:
            ValueError: If the file is malformed.
        """
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = self._refuse_document_type
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        with self._path.open("rb") as file:
            start = file.read(_BLOCK)
            block = start
            try:
                while block:
                    parser.Parse(block, False)
                    block = file.read(_BLOCK)
                parser.Parse(b"", True)  # the end: raises an error if the document is incomplete
            except (expat.ExpatError, ValueError, LookupError) as error:
                # A LookupError is raised for an unknown encoding.
                if isinstance(error, InputError):  # from `_error`, which gives the reason
                    raise
                # The advice differs if the file is a Git LFS pointer or a web page.
                advice = fetch_advice(start[:200], otherwise="give a Lanelet2 map in OSM XML")
                raise InputError(f"{self._path} is no valid XML ({error}): {advice}.") from error

    def _refuse_document_type(self, *_: object) -> None:
        raise self._error("it has a document type, which OSM files lack")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        """Read the start of an XML element."""
        self._depth += 1
        if self._depth > _DEEPEST:
            raise self._error(f"its elements are nested deeper than {_DEEPEST}")
        if self._depth == 1:
            if name != "osm":
                raise self._error(f"its root is {name!r:.40} and not 'osm'")
            return
        if name in (*_KINDS, "nd", "member"):
            self._num_parts += 1
            if self._num_parts > _MOST_PARTS:
                raise self._error(f"it has more than {_MOST_PARTS:,} nodes and references")
        if self._depth == 2:  # a node, a way or a relation; the elements inside of it follow
            self._attributes = attributes
            self._tags = {}
            self._references = []
            self._ways_of_role = {}
        elif name == "tag":
            key = self._required(attributes, "k", owner=name)
            self._tags[key] = self._required(attributes, "v", owner=name)
        elif name == "nd":
            self._references.append(self._required(attributes, "ref", owner=name))
        elif name == "member" and attributes.get("type") == "way":
            role = attributes.get("role", "")
            way_id = self._required(attributes, "ref", owner=name)
            self._ways_of_role.setdefault(role, []).append(way_id)

    def _end(self, name: str) -> None:
        """Store a node, a way or a relation at the end of its XML element."""
        self._depth -= 1
        if self._depth != 1 or name not in _KINDS:
            return
        attributes = self._attributes
        if attributes.get("action") == "delete" or attributes.get("visible") == "false":
            key = f"deleted {name}"
            self.num_deleted[key] = self.num_deleted.get(key, 0) + 1
            return
        element_id = self._required(attributes, "id", owner=name)
        table: dict[str, _Node] | dict[str, _Way] | dict[str, _Relation]
        if name == "node":
            table = self.nodes
            is_new = element_id not in table
            self.nodes[element_id] = self._node(element_id, attributes)
        elif name == "way":
            table = self.ways
            is_new = element_id not in table
            self.ways[element_id] = _Way(self._references, tags=self._tags)
        else:
            table = self.relations
            is_new = element_id not in table
            self.relations[element_id] = _Relation(self._ways_of_role, tags=self._tags)
        if not is_new:
            raise self._error(f"it has {name} {element_id!r:.40} twice")

    def _node(self, node_id: str, attributes: Mapping[str, str]) -> _Node:
        """Check the position of a node."""
        degrees = None
        if attributes.get("lat") or attributes.get("lon"):  # empty in maps with local positions
            latitude = self._number(attributes.get("lat", ""), node_id)
            longitude = self._number(attributes.get("lon", ""), node_id)
            if abs(latitude) > 90 or abs(longitude) > 180:
                raise self._error(f"node {node_id!r:.40} has no latitude and longitude in degrees")
            degrees = longitude, latitude
        local = None
        if "local_x" in self._tags and "local_y" in self._tags:
            x = self._number(self._tags["local_x"], node_id)
            y = self._number(self._tags["local_y"], node_id)
            local = x, y
        return _Node(degrees, local=local)

    def _number(self, text: str, node: str) -> float:
        """Convert a coordinate of a node."""
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self._error(f"node {node!r:.40} has the coordinate {text!r:.40}")
        return number

    def _required(self, attributes: Mapping[str, str], name: str, owner: str) -> str:
        """Return an attribute that must exist; ``owner`` is the name of the XML element."""
        if name not in attributes:
            raise self._error(f"an element {owner!r} has no {name!r}")
        return attributes[name]

    def _error(self, fault: str) -> InputError:
        return InputError(f"{self._path} is no Lanelet2 map: {fault}; write it again.")

    def _nodes(self, references: Sequence[str]) -> list[_Node]:
        """Find nodes by their IDs."""
        nodes = []
        for node_id in references:
            if node_id not in self.nodes:
                raise self._error(f"a line needs node {node_id!r:.40}, which is missing")
            nodes.append(self.nodes[node_id])
        return nodes

    def have_local_positions(self, lines: Sequence[Sequence[str]]) -> bool:
        """Whether all nodes of lines, given by their IDs, have positions in the global frame."""
        for references in lines:
            for node in self._nodes(references):
                if node.local is None:
                    return False
        return True

    def contradictions(
        self, origin: MapOrigin | MapGrid | None, lines: Sequence[Sequence[str]]
    ) -> list[str]:
        """Compare the local position of a node with its longitude and latitude.

        The first node with degrees is compared. Nodes of Autoware have positions in a square of the
        military grid, which is another frame.

        Args:
            origin: Position of the global frame on the Earth; None if it is not known.
            lines: IDs of the nodes of each line. All nodes have local positions.

        Returns:
            A description if the degrees lie farther than 10 m from the local position.
        """
        if origin is None:
            return []
        for references in lines:
            for node in self._nodes(references):
                has_place = node.degrees not in (None, (0.0, 0.0))  # zeros stand for no place
                if not has_place or node.local is None:
                    continue
                try:
                    (point,) = origin.points_of(np.array([node.degrees]), where=str(self._path))
                    is_near = float(np.linalg.norm(point - node.local)) <= _MOST_APART_M
                except InputError:  # farther from the origin than a place reaches
                    is_near = False
                return [] if is_near else ["longitude and latitude far from local_x and local_y"]
        return []

    def positions(self, references: Sequence[str], is_local: bool) -> FloatArray:
        """Return the positions of nodes.

        Args:
            references: IDs of the nodes. (n,)
            is_local: Whether to return metres of the global frame in place of degrees.

        Returns:
            x and y in metres, or longitude and latitude in degrees. (n, 2)

        Raises:
            ValueError: If a node is missing or has no such position.
        """
        points = []
        for node in self._nodes(references):
            point = node.local if is_local else node.degrees
            if point is None:
                raise self._error("a node has no lat and lon")
            points.append(point)
        return np.array(points, dtype=np.float64).reshape(-1, 2)

    def crosswalks(self) -> dict[str, _Relation]:
        """Lanelets of the subtype ``crosswalk``, by their IDs."""
        crosswalks = {}
        for relation_id, relation in self.relations.items():
            tags = relation.tags
            # Autoware adds a regulatory element of this subtype to each crosswalk.
            is_lanelet = tags.get("type", "lanelet") == "lanelet"
            if is_lanelet and tags.get("subtype") == "crosswalk":
                crosswalks[relation_id] = relation
        return crosswalks

    def ring_of(self, lanelet_id: str, crosswalk: _Relation) -> list[str]:
        """Join both bounds of a crosswalk to a ring.

        Args:
            lanelet_id: ID of the lanelet.
            crosswalk: The lanelet.

        Returns:
            IDs of the nodes, the first one also at the end.

        Raises:
            ValueError: If a bound or a node is missing, a side has several bounds, or crosswalks
                share their bounds too often.
        """
        bounds = []
        for role in ("left", "right"):
            way_ids = crosswalk.ways_of_role.get(role, [])
            if len(way_ids) > 1:
                raise self._error(f"crosswalk {lanelet_id!r:.40} has several {role} bounds")
            way = self.ways.get(way_ids[0]) if way_ids else None
            if way is None or not way.nodes:
                raise self._error(f"crosswalk {lanelet_id!r:.40} has no {role} bound")
            bounds.append(way.nodes)
        left, right = bounds
        # Without local positions, the distances of the ends are compared in degrees.
        ends = [left[-1], right[0], right[-1]]
        is_local = all(node.local is not None for node in self._nodes(ends))
        left_end, right_start, right_end = self.positions(ends, is_local=is_local)
        # The ring goes along the left bound and on to the nearer end of the right bound.
        if np.linalg.norm(right_end - left_end) <= np.linalg.norm(right_start - left_end):
            right = right[::-1]
        ring = [*left, *right, left[0]]
        self._num_ring_nodes += len(ring)
        if self._num_ring_nodes > _MOST_USES * self._num_parts:
            raise self._error("its crosswalks share their bounds too often")
        return ring
