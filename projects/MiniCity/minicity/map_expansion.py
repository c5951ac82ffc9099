"""Map of a town in the format of the nuScenes map expansion.

The file has a list of records for each layer. A record is a dict with a token, by which other
records refer to it. Shapes are records, too: a polygon or a line refers to its nodes. Fields that
this town has no values for are empty.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from minicity.config import make_token
from minicity.curves import Array, arc_lengths, strip
from minicity.junctions import CONNECTOR_M, Connector
from minicity.paint import divider_pieces, lane_divider_offsets
from minicity.roads import Lane, Road
from minicity.town import Town, road_surface

# All layers of the format. The file also has the layers without records.
LAYERS = [
    "polygon",
    "line",
    "node",
    "drivable_area",
    "road_segment",
    "road_block",
    "lane",
    "ped_crossing",
    "walkway",
    "stop_line",
    "carpark_area",
    "road_divider",
    "lane_divider",
    "traffic_light",
    "lane_connector",
]
MASK_RESOLUTION_M = 0.1  # edge of a pixel of the drivable-area picture
PIECE_M = 4.0  # approximate length of the pieces of a centre line


def _rings(polygon: Polygon) -> list[Array]:
    """Rings of a polygon in metres, the exterior first, each closed. Each (n, 2)"""
    return [np.array(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]


class MapWriter:
    """Writer that collects the records of one map.

    Args:
        town: The town.
        seed: Seed of the data set, part of every token.
    """

    def __init__(self, town: Town, seed: int) -> None:
        self.town = town
        # A token has 32 hexadecimal digits: 24 of this prefix and 8 of a running number.
        self._prefixes = {layer: make_token(seed, town.name, layer)[:24] for layer in LAYERS}
        self.tables: dict[str, list[dict[str, Any]]] = {layer: [] for layer in LAYERS}
        self.arclines: dict[str, list[dict[str, Any]]] = {}
        self.connectivity: dict[str, dict[str, list[str]]] = {}

    def _token(self, layer: str) -> str:
        """Next token of a layer: the layer's prefix, then a running number."""
        return f"{self._prefixes[layer]}{len(self.tables[layer]):08x}"

    def _nodes(self, points: Array) -> list[str]:
        """Add a node per point (n, 2) in metres and return the n tokens."""
        tokens = []
        for x, y in np.round(points, 4).tolist():
            token = self._token("node")
            self.tables["node"].append({"token": token, "x": x, "y": y})
            tokens.append(token)
        return tokens

    def polygon(self, polygon: Polygon) -> str:
        """Add a polygon in metres and return its token."""
        token = self._token("polygon")
        # The format does not repeat the first node of a ring.
        exterior, *holes = [self._nodes(ring[:-1]) for ring in _rings(polygon)]
        self.tables["polygon"].append(
            {
                "token": token,
                "exterior_node_tokens": exterior,
                "holes": [{"node_tokens": hole} for hole in holes],
            }
        )
        return token

    def line(self, points: Array) -> str:
        """Add a line (n, 2) in metres and return its token."""
        token = self._token("line")
        self.tables["line"].append({"token": token, "node_tokens": self._nodes(points)})
        return token

    def add(self, layer: str, **fields: Any) -> str:
        """Add a record to a layer and return its token."""
        token = self._token(layer)
        self.tables[layer].append({"token": token, **fields})
        return token

    def as_dict(self) -> dict[str, Any]:
        """Whole map as a dictionary that can be written as JSON."""
        return {
            "version": "1.3",
            "canvas_edge": [self.town.size_m, self.town.size_m],
            **self.tables,
            "arcline_path_3": self.arclines,
            "connectivity": self.connectivity,
        }

    def add_road(self, road: Road) -> None:
        """Add the surface, blocks, dividers, crossings and stop lines of a road."""
        # A road with a median has two surfaces, each of which is a segment. The following records
        # can refer to one segment only, and refer to the last one.
        for surface in road_surface(road):
            segment = self.add(
                "road_segment",
                polygon_token=self.polygon(surface),
                is_intersection=False,
                drivable_area_token="",
            )
        self._add_block(road, road.forward_edges, segment=segment, direction="forward")
        self._add_block(road, road.backward_edges, segment=segment, direction="backward")
        for start, end in divider_pieces(road):
            if road.has_center_line:
                # The centre line has the offset 0 plus the shift of all painted lines.
                center = self.line(road.line(road.shift_m, start, end_m=end))
                self.add("road_divider", line_token=center, road_segment_token=segment)
            for offset in lane_divider_offsets(road):
                divider = self.line(road.line(offset, start, end_m=end))
                self.add("lane_divider", line_token=divider, lane_divider_segments=[])
        for start, end in road.crossings:
            # A median interrupts a crossing.
            for right, left in road.carriageways():
                crossing = Polygon(road.band(right, left, start_m=start, end_m=end))
                self.add(
                    "ped_crossing",
                    polygon_token=self.polygon(crossing),
                    road_segment_token=segment,
                )
        self._add_stop_line(road, road.stop_forward, road.forward_edges)
        self._add_stop_line(road, road.stop_backward, road.backward_edges)

    def _add_block(self, road: Road, edges: list[float], segment: str, direction: str) -> None:
        """Add the block of the lanes of one direction.

        Args:
            road: Road of the lanes.
            edges: Offsets of the edges of the lanes from the centre line in metres.
            segment: Token of the road segment.
            direction: ``forward`` or ``backward``.
        """
        if len(edges) < 2:  # no lane in this direction
            return
        band = Polygon(road.band(min(edges), max(edges)))
        self.add(
            "road_block",
            polygon_token=self.polygon(band),
            road_segment_token=segment,
            from_edge_line_token="",
            to_edge_line_token="",
            direction=direction,
        )

    def _add_stop_line(
        self, road: Road, stop: tuple[float, float] | None, edges: list[float]
    ) -> None:
        """Add the stop line of one direction, if any.

        Args:
            road: Road of the stop line.
            stop: Arc lengths in metres between which the stop line is; None for no stop line.
            edges: Offsets of the edges of the lanes from the centre line in metres.
        """
        if stop is None:
            return
        start, end = stop
        area = Polygon(road.band(min(edges), max(edges), start_m=start, end_m=end))
        self.add(
            "stop_line",
            polygon_token=self.polygon(area),
            stop_line_type="TURN_STOP",
            ped_crossing_tokens=[],
            traffic_light_tokens=[],
            road_block_token="",
        )

    def add_lane(self, lane: Lane) -> str:
        """Add a lane with its outline and centre line, and return its token."""
        road = self.town.roads[lane.road]
        edges = road.forward_edges if lane.forward else road.backward_edges
        # Edges run from the centre of the road to its kerb. Offsets are positive to the left, so
        # the outer edge is the smaller one for forward lanes and the larger one for backward lanes.
        inner = edges[lane.index]
        outer = edges[lane.index + 1]
        outline = road.band(min(inner, outer), max(inner, outer))
        token = self.add(
            "lane",
            polygon_token=self.polygon(Polygon(outline)),
            lane_type="CAR",
            from_edge_line_token="",
            to_edge_line_token="",
            left_lane_divider_segments=[],
            right_lane_divider_segments=[],
        )
        self._add_center(token, lane.center)
        return token

    def add_connector(self, connector: Connector, source: str, target: str) -> None:
        """Add the path across a junction and connect it to its lanes.

        The lanes must have been added before.

        Args:
            connector: The path.
            source: Token of the lane that leads to the junction.
            target: Token of the lane that leaves the junction.
        """
        area = self.polygon(Polygon(strip(connector.center, CONNECTOR_M / 2)))
        token = self.add("lane_connector", polygon_token=area, lane_type="CAR")
        self._add_center(token, connector.center)
        self.connectivity[token] = {"incoming": [source], "outgoing": [target]}
        self.connectivity[source]["outgoing"].append(token)
        self.connectivity[target]["incoming"].append(token)

    def _add_center(self, token: str, center: Array) -> None:
        """Add the centre line (n, 2) of a lane or connector as an arc-line path of straight pieces.

        The connectivity gets an entry without neighbours, to which `add_connector` adds them.
        """
        lengths = arc_lengths(center)  # from the first point to each point (n,)
        count = max(1, round(lengths[-1] / PIECE_M))
        arc_m = np.linspace(0.0, lengths[-1], num=count + 1)
        x = np.interp(arc_m, lengths, center[:, 0])
        y = np.interp(arc_m, lengths, center[:, 1])
        points = np.stack([x, y], axis=1)
        pieces = []
        for start, end in pairwise(points):
            yaw = float(np.arctan2(end[1] - start[1], end[0] - start[0]))
            length = float(np.linalg.norm(end - start))
            pieces.append(
                {
                    "start_pose": [float(start[0]), float(start[1]), yaw],
                    "end_pose": [float(end[0]), float(end[1]), yaw],
                    # A Dubins path: left turn, straight, right turn. Both turns have no length, so
                    # their radius has no effect.
                    "shape": "LSR",
                    "radius": 999.999,
                    "segment_length": [0.0, length, 0.0],
                }
            )
        self.arclines[token] = pieces
        self.connectivity[token] = {"incoming": [], "outgoing": []}


def polygon_parts(area: Polygon | MultiPolygon) -> list[Polygon]:
    """Polygons of an area, without empty ones."""
    return [part for part in shapely.get_parts(area) if not part.is_empty]


def town_to_map(town: Town, seed: int) -> dict[str, Any]:
    """Convert a town to the content of a map expansion file.

    Args:
        town: The town.
        seed: Seed of the data set, part of every token.

    Returns:
        JSON-ready dictionary.
    """
    writer = MapWriter(town, seed)
    for road in town.roads:
        writer.add_road(road)
    # Token of each lane, by the key of the lane.
    lane_tokens = {key: writer.add_lane(lane) for key, lane in town.lanes.items()}
    for junction in town.junctions:
        outline = writer.polygon(Polygon(junction.outline))
        writer.add(
            "road_segment", polygon_token=outline, is_intersection=True, drivable_area_token=""
        )
    for connectors in town.connectors.values():
        for connector in connectors:
            source = lane_tokens[connector.source.key]
            target = lane_tokens[connector.target.key]
            writer.add_connector(connector, source, target=target)
    drivable = [writer.polygon(part) for part in polygon_parts(town.drivable)]
    writer.add("drivable_area", polygon_tokens=drivable)
    for walkway in town.walkways:
        writer.add("walkway", polygon_token=writer.polygon(walkway))
    for park in town.carparks:
        outline = writer.polygon(Polygon(park.outline))
        writer.add("carpark_area", polygon_token=outline, orientation=0.0)
    return writer.as_dict()


def write_expansion(root: Path, town: Town, seed: int, name: str) -> None:
    """Write the expansion file of a town.

    Args:
        root: Root folder of the data set, in which the folder ``maps/expansion`` exists.
        town: The town.
        seed: Seed of the data set, part of every token.
        name: Name of the file, without the suffix.

    Raises:
        OSError: If the file cannot be written.
    """
    path = root / "maps" / "expansion" / f"{name}.json"
    path.write_text(json.dumps(town_to_map(town, seed)))


def write_mask(root: Path, town: Town, seed: int) -> str:
    """Write the drivable-area picture of a town, 255 on the drivable area and 0 elsewhere.

    Args:
        root: Root folder of the data set, in which the folder ``maps`` exists.
        town: The town.
        seed: Seed of the data set, part of every token.

    Returns:
        Path of the picture relative to ``root``.

    Raises:
        OSError: If the file cannot be written.
    """
    size = round(town.size_m / MASK_RESOLUTION_M)
    mask = np.zeros((size, size), dtype=np.uint8)
    for polygon in polygon_parts(town.drivable):
        rings_px = []
        for ring in _rings(polygon):
            x, y = (ring / MASK_RESOLUTION_M).T
            # Row 0 of the picture is at the largest y.
            rings_px.append(np.round(np.column_stack([x, size - y])).astype(np.int32))
        # Holes stay empty, because `fillPoly` fills points inside an odd number of rings.
        cv2.fillPoly(mask, rings_px, color=(255.0,))
    name = f"maps/{make_token(seed, town.name, 'mask')}.png"
    if not cv2.imwrite(str(root / name), mask):
        raise OSError(f"could not write {root / name}.")
    return name
