"""OSM files of maps for Lanelet2: line strings, polygons and lanelets."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.lanelets import LaneGraph
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.utils.files import write_bytes

SPEED_LIMIT_KMH = 50.0
"""Default speed limit of lanelets in km/h."""
# Lanelet2 types of line strings by class. The type of any other class is its name.
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
    """Write a map for the ``lanelet2`` package.

    Areas become polygons, which do not repeat their first node. Other closed lines repeat it at
    the end. The tags ``local_x`` and ``local_y`` of a node are its position in the global frame in
    metres. The tag ``score`` of a line is the confidence of the element, as in `write_geojson`.

    Args:
        path: File to write.
        elements: Map in the global frame, with x and y in metres and without heights. The score of
            an element without a score is 1.
        classes: Class names in label order.
        origin: Position of the global frame on the Earth, given as a point or as a map grid.
        lanes: Lanelets of the map, written as one-way roads.
        speed_limit_kmh: Speed limit of the lanelets, in km/h.

    Raises:
        RuntimeError: If ``pyproj`` is missing.
    """
    file = _OSMFile(origin)
    for line, label, score in elements.rows:  # vertices (P, 2), label and score
        # A ring has at least three different vertices, and repeats the first one at its end.
        is_ring = len(line) > 3 and bool((line[0] == line[-1]).all())
        vertices = line[:-1] if is_ring else line
        nodes = file.add_nodes(vertices)
        name = classes[label]
        tags = {"type": TYPES.get(name, name), "class": name, "score": f"{score:.4f}"}
        if is_ring and name in AREA_CLASSES:
            tags["area"] = "yes"  # polygons of Lanelet2 do not repeat their first node
        elif is_ring:
            nodes.append(nodes[0])  # the id of the first node closes the line
        file.add_way(nodes, tags)
    if lanes is not None:
        _add_lanelets(file, lanes, speed_limit_kmh)
    file.write(path)


def _add_lanelets(file: "_OSMFile", lanes: LaneGraph, speed_limit_kmh: float) -> None:
    """Add lanelets. The bounds of successive lanelets share their end nodes.

    Lanelet2 recognises successive lanelets by these shared nodes.
    """
    tags = {
        "type": "lanelet",
        "subtype": "road",
        "location": "urban",
        "one_way": "yes",
        "speed_limit": f"{speed_limit_kmh:g} km/h",
    }
    # End nodes of the left and the right bounds at each node of the lane graph. `entry` and `exit`
    # of a lanelet are indices into both lists.
    left_ends = file.add_nodes(lanes.left)
    right_ends = file.add_nodes(lanes.right)
    for lane in lanes.lanelets:
        left = [left_ends[lane.entry], *file.add_nodes(lane.left), left_ends[lane.exit]]
        right = [right_ends[lane.entry], *file.add_nodes(lane.right), right_ends[lane.exit]]
        way_of_role = {
            "left": file.add_way(left, {"type": "virtual"}),
            "right": file.add_way(right, {"type": "virtual"}),
        }
        file.add_relation(way_of_role, tags)


class _OSMFile:
    """Nodes, ways and relations of an OSM file, with ids from 1 in the order of their creation.

    Args:
        origin: Position of the global frame on the Earth.
    """

    def __init__(self, origin: MapOrigin | MapGrid) -> None:
        self._origin = origin
        # The elements of a file are sorted by kind, in the order of these keys. So an element only
        # refers to elements before it.
        self._elements_of_kind: dict[str, list[ElementTree.Element]] = {
            "node": [],
            "way": [],
            "relation": [],
        }

    def add_nodes(self, points: FloatArray) -> list[str]:
        """Add points in metres in the global frame and return their ids. (n, 2) -> list of n"""
        ids = []
        degrees = self._origin.lon_lat(points).tolist()
        for (x, y), (lon, lat) in zip(points.tolist(), degrees, strict=True):
            tags = {"local_x": f"{x:.4f}", "local_y": f"{y:.4f}"}
            node = self._add("node", tags)
            node.set("lat", f"{lat:.11f}")
            node.set("lon", f"{lon:.11f}")
            ids.append(node.get("id", ""))
        return ids

    def add_way(self, nodes: Sequence[str], tags: dict[str, str]) -> str:
        """Add a line through nodes, given by their ids, and return its id."""
        way = self._add("way", tags)
        for index, node in enumerate(nodes):  # nodes go before the tags
            way.insert(index, ElementTree.Element("nd", ref=node))
        return way.get("id", "")

    def add_relation(self, way_of_role: dict[str, str], tags: dict[str, str]) -> None:
        """Add a relation of ways, given by their ids under their roles, such as ``left``."""
        relation = self._add("relation", tags)
        for index, (role, way) in enumerate(way_of_role.items()):  # members go before the tags
            member = ElementTree.Element("member", type="way", ref=way, role=role)
            relation.insert(index, member)

    def _add(self, kind: str, tags: dict[str, str]) -> ElementTree.Element:
        """Add an element with the next id. The ids of all kinds are numbered together."""
        num_elements = sum(len(elements) for elements in self._elements_of_kind.values())
        element = ElementTree.Element(kind, id=str(num_elements + 1), version="1")
        for key, value in tags.items():
            ElementTree.SubElement(element, "tag", k=key, v=value)
        self._elements_of_kind[kind].append(element)
        return element

    def write(self, path: str | Path) -> None:
        """Write the file: nodes first, then ways, then relations."""
        root = ElementTree.Element("osm", version="0.6", generator="gsmap")
        for elements in self._elements_of_kind.values():
            root.extend(elements)
        ElementTree.indent(root, " ")
        text = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
        write_bytes(path, text + b"\n")
