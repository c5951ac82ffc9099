"""A town in the format of the nuScenes map expansion."""

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
from minicity.junctions import CONNECTOR_M
from minicity.paint import divider_pieces, has_center_line, lane_divider_offsets
from minicity.roads import Lane, Road
from minicity.town import Town, road_surface

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
MASK_RESOLUTION_M = 0.1
PIECE_M = 4.0


class MapWriter:
    """Collects the records of one map.

    Args:
        town: The town to write.
        seed: Seed of the data set, part of every token.
    """

    def __init__(self, town: Town, seed: int) -> None:
        self.town = town
        self._prefixes = {layer: make_token(seed, town.name, layer)[:24] for layer in LAYERS}
        self.tables: dict[str, list[dict[str, Any]]] = {layer: [] for layer in LAYERS}
        self.arclines: dict[str, list[dict[str, Any]]] = {}
        self.connectivity: dict[str, dict[str, list[str]]] = {}

    def _token(self, layer: str) -> str:
        """The next token of a layer: a prefix of its own, then a running number."""
        return f"{self._prefixes[layer]}{len(self.tables[layer]):08x}"

    def _nodes(self, points: Array) -> list[str]:
        tokens = []
        for x, y in np.round(points, 4).tolist():
            tokens.append(self._token("node"))
            self.tables["node"].append({"token": tokens[-1], "x": x, "y": y})
        return tokens

    def polygon(self, polygon: Polygon) -> str:
        """Add a polygon and return its token."""
        token = self._token("polygon")
        rings = [np.array(r.coords)[:-1] for r in (polygon.exterior, *polygon.interiors)]
        exterior, *holes = (self._nodes(ring) for ring in rings)
        self.tables["polygon"].append(
            {
                "token": token,
                "exterior_node_tokens": exterior,
                "holes": [{"node_tokens": hole} for hole in holes],
            }
        )
        return token

    def line(self, points: Array) -> str:
        """Add a line and return its token."""
        token = self._token("line")
        self.tables["line"].append({"token": token, "node_tokens": self._nodes(points)})
        return token

    def add(self, layer: str, **fields: Any) -> str:
        """Add a record to a layer and return its token."""
        token = self._token(layer)
        self.tables[layer].append({"token": token, **fields})
        return token

    def as_dict(self) -> dict[str, Any]:
        """The whole map, ready for JSON."""
        return {
            "version": "1.3",
            "canvas_edge": [self.town.size_m, self.town.size_m],
            **self.tables,
            "arcline_path_3": self.arclines,
            "connectivity": self.connectivity,
        }

    def add_road(self, road: Road) -> None:
        """Add a road's surface, blocks, dividers, crossings and stop lines."""
        for surface in road_surface(road):
            segment = self.add(
                "road_segment",
                polygon_token=self.polygon(surface),
                is_intersection=False,
                drivable_area_token="",
            )
        section = road.section
        for edges, name in (
            (section.forward_edges, "forward"),
            (section.backward_edges, "backward"),
        ):
            if len(edges) > 1:
                band = Polygon(road.band(min(edges), max(edges)))
                self.add(
                    "road_block",
                    polygon_token=self.polygon(band),
                    road_segment_token=segment,
                    from_edge_line_token="",
                    to_edge_line_token="",
                    direction=name,
                )
        for start, end in divider_pieces(road):
            if has_center_line(road):
                self._divider("road_divider", road.line(0.0, start, end), segment)
            for offset in lane_divider_offsets(road):
                self._divider("lane_divider", road.line(offset, start, end), segment)
        for start, end in road.crossings:
            for right, left in road.carriageways():
                crossing = Polygon(road.band(right, left, start, end))
                self.add(
                    "ped_crossing",
                    polygon_token=self.polygon(crossing),
                    road_segment_token=segment,
                )
        self._stop_lines(road, segment)

    def _divider(self, layer: str, points: Array, segment: str) -> None:
        line = self.line(points)
        extra: dict[str, Any] = (
            {"road_segment_token": segment}
            if layer == "road_divider"
            else {"lane_divider_segments": []}
        )
        self.add(layer, line_token=line, **extra)

    def _stop_lines(self, road: Road, segment: str) -> None:
        for stop, edges in (
            (road.stop_forward, road.section.forward_edges),
            (road.stop_backward, road.section.backward_edges),
        ):
            if stop is not None:
                area = Polygon(road.band(min(edges), max(edges), *stop))
                self.add(
                    "stop_line",
                    polygon_token=self.polygon(area),
                    stop_line_type="TURN_STOP",
                    ped_crossing_tokens=[],
                    traffic_light_tokens=[],
                    road_block_token="",
                )

    def add_lane(self, lane: Lane) -> str:
        """Add a lane, its neighbours' lines and its centre."""
        road = self.town.roads[lane.road]
        edges = road.section.forward_edges if lane.forward else road.section.backward_edges
        inner, outer = edges[lane.index], edges[lane.index + 1]
        token = self.add(
            "lane",
            polygon_token=self.polygon(Polygon(road.band(min(inner, outer), max(inner, outer)))),
            lane_type="CAR",
            from_edge_line_token="",
            to_edge_line_token="",
            left_lane_divider_segments=[],
            right_lane_divider_segments=[],
        )
        self._center(token, lane.center)
        return token

    def _center(self, token: str, center: Array) -> None:
        """A centre line as an arc-line path of straight pieces."""
        lengths = arc_lengths(center)
        count = max(1, round(lengths[-1] / PIECE_M))
        at = np.linspace(0.0, lengths[-1], count + 1)
        points = np.stack([np.interp(at, lengths, column) for column in center.T], axis=1)
        pieces = []
        for a, b in pairwise(points):
            yaw = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
            length = float(np.linalg.norm(b - a))
            pieces.append(
                {
                    "start_pose": [float(a[0]), float(a[1]), yaw],
                    "end_pose": [float(b[0]), float(b[1]), yaw],
                    "shape": "LSR",
                    "radius": 999.999,
                    "segment_length": [0.0, length, 0.0],
                }
            )
        self.arclines[token] = pieces
        self.connectivity[token] = {"incoming": [], "outgoing": []}


def polygon_parts(area: Polygon | MultiPolygon) -> list[Polygon]:
    """The polygons that an area consists of."""
    return [part for part in shapely.get_parts(area) if not part.is_empty]


def town_to_map(town: Town, seed: int) -> dict[str, Any]:
    """A town as the content of a map expansion file."""
    writer = MapWriter(town, seed)
    for road in town.roads:
        writer.add_road(road)
    lanes = {key: writer.add_lane(lane) for key, lane in town.lanes.items()}
    for junction in town.junctions:
        outline = writer.polygon(Polygon(junction.outline))
        writer.add(
            "road_segment", polygon_token=outline, is_intersection=True, drivable_area_token=""
        )
    for connector in (c for group in town.connectors.values() for c in group):
        area = writer.polygon(Polygon(strip(connector.center, CONNECTOR_M / 2)))
        token = writer.add("lane_connector", polygon_token=area, lane_type="CAR")
        writer._center(token, connector.center)
        source, target = lanes[connector.source.key], lanes[connector.target.key]
        writer.connectivity[token] = {"incoming": [source], "outgoing": [target]}
        writer.connectivity[source]["outgoing"].append(token)
        writer.connectivity[target]["incoming"].append(token)
    parts = polygon_parts(town.drivable)
    writer.add("drivable_area", polygon_tokens=[writer.polygon(p) for p in parts])
    for walkway in town.walkways:
        writer.add("walkway", polygon_token=writer.polygon(walkway))
    for park in town.carparks:
        writer.add(
            "carpark_area", polygon_token=writer.polygon(Polygon(park.outline)), orientation=0.0
        )
    return writer.as_dict()


def write_map(root: Path, town: Town, seed: int) -> str:
    """Write a town's expansion file and its drivable-area picture.

    Args:
        root: Data root.
        town: The town.
        seed: Number that tokens are made of.

    Returns:
        The picture's path relative to ``root``.
    """
    expansion = root / "maps" / "expansion"
    expansion.mkdir(parents=True, exist_ok=True)
    (expansion / f"{town.name}.json").write_text(json.dumps(town_to_map(town, seed)))
    size = round(town.size_m / MASK_RESOLUTION_M)
    mask = np.zeros((size, size), np.uint8)
    for polygon in polygon_parts(town.drivable):
        rings = [
            np.array(r.coords) / MASK_RESOLUTION_M for r in (polygon.exterior, *polygon.interiors)
        ]
        flipped = [
            np.round(np.column_stack([r[:, 0], size - r[:, 1]])).astype(np.int32) for r in rings
        ]
        cv2.fillPoly(mask, flipped, (255.0,))
    name = f"maps/{make_token(seed, town.name, 'mask')}.png"
    if not cv2.imwrite(str(root / name), mask):
        raise OSError(f"could not write {root / name}.")
    return name
