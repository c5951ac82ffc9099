"""A map as Lanelet2's OSM file: line strings, polygons and lanelets."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.lanelets import LaneGraph
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.utils.files import write_bytes

SPEED_LIMIT_KMH = 50.0
# Lanelet2's tags of line strings; a class that has none keeps its own name.
TYPES = {
    "divider": "line_thin",
    "boundary": "road_border",
    "ped_crossing": "zebra_marking",
    "stop_line": "stop_line",
    "centerline": "virtual",
}


def write_lanelet2(
    path: str | Path,
    elements: MapElements,
    classes: Sequence[str],
    origin: MapOrigin | MapGrid,
    lanes: LaneGraph | None = None,
    speed_limit_kmh: float = SPEED_LIMIT_KMH,
) -> None:
    """Write a map that the ``lanelet2`` package loads.

    Areas become polygons, other rings end at the node that they start at. Each node also carries
    ``local_x`` and ``local_y``, the metres of the global frame.

    Args:
        path: File to write.
        elements: The map in the global frame.
        classes: Names of the classes.
        origin: Where the global frame lies.
        lanes: Lanelets of the map, one-way roads.
        speed_limit_kmh: Speed limit of the lanelets, in km/h.

    Raises:
        RuntimeError: If ``pyproj`` is missing.
    """
    file = _OSMFile(origin)
    for line, label, _ in elements.rows:
        ring = len(line) > 3 and bool((line[0] == line[-1]).all())
        nodes = file.add_nodes(line[:-1] if ring else line)
        name = classes[label]
        tags = {"type": TYPES.get(name, name), "class": name}
        if ring and name in AREA_CLASSES:
            tags["area"] = "yes"  # Lanelet2's polygons do not repeat their first node
        elif ring:
            nodes.append(nodes[0])
        file.add_way(nodes, tags)
    if lanes is not None:
        _add_lanelets(file, lanes, speed_limit_kmh)
    file.write(path)


def _add_lanelets(file: "_OSMFile", lanes: LaneGraph, speed_limit_kmh: float) -> None:
    """Add lanelets; those that follow one another share the end nodes of their bounds."""
    tags = {
        "type": "lanelet",
        "subtype": "road",
        "location": "urban",
        "one_way": "yes",
        "speed_limit": f"{speed_limit_kmh:g} km/h",
    }
    left_ends = file.add_nodes(lanes.left)
    right_ends = file.add_nodes(lanes.right)
    for lane in lanes.lanelets:
        left = [left_ends[lane.entry], *file.add_nodes(lane.left), left_ends[lane.exit]]
        right = [right_ends[lane.entry], *file.add_nodes(lane.right), right_ends[lane.exit]]
        members = {
            "left": file.add_way(left, {"type": "virtual"}),
            "right": file.add_way(right, {"type": "virtual"}),
        }
        file.add_relation(members, tags)


class _OSMFile:
    """Nodes, ways and relations of an OSM file, numbered from 1 in the order of their coming.

    Args:
        origin: Where the global frame lies.
    """

    def __init__(self, origin: MapOrigin | MapGrid) -> None:
        self._origin = origin
        self._parts: dict[str, list[ElementTree.Element]] = {"node": [], "way": [], "relation": []}

    def add_nodes(self, points: FloatArray) -> list[str]:
        """Add points of the global frame, in metres, and return their ids. (n, 2) -> (n,)"""
        identities = []
        degrees = self._origin.lon_lat(points).tolist()
        for (x, y), (lon, lat) in zip(points.tolist(), degrees, strict=True):
            tags = {"local_x": f"{x:.4f}", "local_y": f"{y:.4f}"}
            node = self._add("node", tags)
            node.set("lat", f"{lat:.11f}")
            node.set("lon", f"{lon:.11f}")
            identities.append(node.get("id", ""))
        return identities

    def add_way(self, nodes: Sequence[str], tags: dict[str, str]) -> str:
        """Add a line through nodes and return its id."""
        way = self._add("way", tags)
        for place, reference in enumerate(nodes):
            way.insert(place, ElementTree.Element("nd", ref=reference))
        return way.get("id", "")

    def add_relation(self, members: dict[str, str], tags: dict[str, str]) -> None:
        """Add a relation of ways, by their roles."""
        relation = self._add("relation", tags)
        for place, (role, reference) in enumerate(members.items()):
            member = ElementTree.Element("member", type="way", ref=reference, role=role)
            relation.insert(place, member)

    def _add(self, kind: str, tags: dict[str, str]) -> ElementTree.Element:
        """Add an element with the next free id of all kinds."""
        identity = 1 + sum(map(len, self._parts.values()))
        element = ElementTree.Element(kind, id=str(identity), version="1")
        for key, value in tags.items():
            ElementTree.SubElement(element, "tag", k=key, v=value)
        self._parts[kind].append(element)
        return element

    def write(self, path: str | Path) -> None:
        """Write the file: nodes first, then ways, then relations."""
        root = ElementTree.Element("osm", version="0.6", generator="gsmap")
        for elements in self._parts.values():
            root.extend(elements)
        ElementTree.indent(root, " ")
        text = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
        write_bytes(path, text + b"\n")
