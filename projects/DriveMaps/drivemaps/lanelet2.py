"""A map as Lanelet2's OSM file: line strings and polygons, without lanelets."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from drivemaps.geodetic import MapGrid, MapOrigin
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import MapElements
from gsmap.utils.files import write_bytes

# Lanelet2's tags of line strings; a class that has none keeps its own name.
TYPES = {
    "divider": "line_thin",
    "boundary": "road_border",
    "ped_crossing": "zebra_marking",
    "stop_line": "stop_line",
    "centerline": "virtual",
}


def write_lanelet2(
    path: str | Path, elements: MapElements, classes: Sequence[str], origin: MapOrigin | MapGrid
) -> None:
    """Write a map that the ``lanelet2`` package loads.

    Areas become polygons, other rings end at the node that they start at. Each node also carries
    ``local_x`` and ``local_y``, the metres of the global frame.

    Args:
        path: File to write.
        elements: The map in the global frame.
        classes: Names of the classes.
        origin: Where the global frame lies.

    Raises:
        RuntimeError: If ``pyproj`` is missing.
    """
    root = ElementTree.Element("osm", version="0.6", generator="gsmap")
    ways, identity = [], 0
    for line, label, _ in elements.rows:
        ring = len(line) > 3 and bool((line[0] == line[-1]).all())
        nodes = []
        vertices = line[:-1] if ring else line
        degrees = origin.lon_lat(vertices).tolist()
        for (x, y), (lon, lat) in zip(vertices.tolist(), degrees, strict=True):
            identity += 1
            nodes.append(str(identity))
            node = ElementTree.SubElement(
                root, "node", id=nodes[-1], version="1", lat=f"{lat:.11f}", lon=f"{lon:.11f}"
            )
            _tag(node, {"local_x": f"{x:.4f}", "local_y": f"{y:.4f}"})
        name = classes[label]
        tags = {"type": TYPES.get(name, name), "class": name}
        if ring and name in AREA_CLASSES:
            tags["area"] = "yes"  # Lanelet2's polygons do not repeat their first node
        elif ring:
            nodes.append(nodes[0])
        ways.append((nodes, tags))
    for nodes, tags in ways:
        identity += 1
        way = ElementTree.SubElement(root, "way", id=str(identity), version="1")
        for reference in nodes:
            ElementTree.SubElement(way, "nd", ref=reference)
        _tag(way, tags)
    ElementTree.indent(root, " ")
    write_bytes(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _tag(element: ElementTree.Element, tags: dict[str, str]) -> None:
    for key, value in tags.items():
        ElementTree.SubElement(element, "tag", k=key, v=value)
