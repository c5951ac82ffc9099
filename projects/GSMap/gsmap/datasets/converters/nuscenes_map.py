"""Local vector maps from a nuScenes map expansion, by the rules of MapTR.

Whatever does not depend on the pose is done once per map: geometries, spatial indices, the union of
all road surface and its outline. A frame then takes a few vectorised geometry calls on what lies
near.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from gsmap.datasets.annotation_record import MapInstance
from gsmap.datasets.converters.argoverse2_rules import rings_of
from gsmap.datasets.converters.local_map import LocalPatch, OutlineIndex
from gsmap.geometry.polylines import Points

if TYPE_CHECKING:
    from nuscenes.map_expansion.map_api import NuScenesMap

LINE_LAYERS = ("road_divider", "lane_divider")
SURFACE_LAYERS = ("road_segment", "lane")
AREA_CLASSES = ("ped_crossing", "stop_line", "intersection", "carpark_area")
MAP_CLASSES = ("divider", "ped_crossing", "boundary", *AREA_CLASSES[1:])
OUTLINE_MARGIN_M = 0.2
_POLYGON, _LINE = 3, 1  # shapely type ids


@dataclass
class MapLayers:
    """The geometries of one map in its global frame; plain enough to hand to another process.

    Args:
        name: Location.
        lines: Lines by layer. each (n,) of LineString
        polygons: Valid polygons by layer or class. each (n,) of Polygon
        skipped: How many elements were left out, by reason.
    """

    name: str
    lines: dict[str, np.ndarray]
    polygons: dict[str, np.ndarray]
    skipped: Counter[str]


def _is_intersection(record: dict[str, Any]) -> bool:
    return bool(record.get("is_intersection", False))


def read_layers(nusc_map: "NuScenesMap", classes: Collection[str]) -> MapLayers:
    """Collect the geometries that the classes need from a map of the official devkit.

    Args:
        nusc_map: The opened map.
        classes: Names out of ``MAP_CLASSES``.

    Returns:
        The layers; lines without two nodes and invalid polygons are left out and counted.
    """
    nodes = {node["token"]: (node["x"], node["y"]) for node in nusc_map.node}
    skipped: Counter[str] = Counter()

    def lines(layer: str) -> np.ndarray:
        found = []
        for record in getattr(nusc_map, layer):
            points = [
                nodes[token] for token in nusc_map.get("line", record["line_token"])["node_tokens"]
            ]
            if len(points) < 2:
                skipped[f"{layer} without two nodes"] += 1
            else:
                found.append(shapely.LineString(points))
        return np.array(found, dtype=object)

    def polygons(layer: str, keep: Callable[[dict[str, Any]], bool] | None = None) -> np.ndarray:
        found = []
        for record in getattr(nusc_map, layer):
            if keep is not None and not keep(record):
                continue
            polygon = nusc_map.extract_polygon(record["polygon_token"])
            if polygon.is_valid and not polygon.is_empty:
                found.append(polygon)
            else:
                skipped[f"invalid {layer} polygon"] += 1
        return np.array(found, dtype=object)

    areas: dict[str, np.ndarray] = {}
    if "boundary" in classes:
        areas |= {layer: polygons(layer) for layer in SURFACE_LAYERS}
    for name in set(AREA_CLASSES) & set(classes):
        areas[name] = (
            polygons("road_segment", _is_intersection) if name == "intersection" else polygons(name)
        )
    marks = {layer: lines(layer) for layer in LINE_LAYERS} if "divider" in classes else {}
    return MapLayers(nusc_map.map_name, marks, areas, skipped)


class NuScenesLocalMap:
    """One map, prepared for cutting out what the vehicle sees at many poses.

    Dividers are the lines of ``road_divider`` and ``lane_divider``, cut with the patch. Crossings
    (and the extended classes) are areas cut with the patch and united where they overlap: closed
    rings. Boundaries are the outlines of the union of ``road_segment`` and ``lane``, cut 0.2 m
    inside the patch.

    Args:
        layers: The map's geometries.
        classes: Names out of ``MAP_CLASSES``, in label order.
        x_range: Smallest and largest x of the patch in metres.
        y_range: Smallest and largest y of the patch in metres.

    Raises:
        ValueError: If a class is unknown.
    """

    def __init__(
        self,
        layers: MapLayers,
        classes: Sequence[str],
        x_range: tuple[float, float] = (-15.0, 15.0),
        y_range: tuple[float, float] = (-30.0, 30.0),
    ) -> None:
        unknown = [name for name in classes if name not in MAP_CLASSES]
        if unknown:
            raise ValueError(f"classes must be among {MAP_CLASSES}, got {unknown}.")
        self.classes = tuple(classes)
        self.x_range, self.y_range = x_range, y_range
        marks = [layers.lines[layer] for layer in LINE_LAYERS if layer in layers.lines]
        self._lines = np.concatenate(marks) if marks else np.empty(0, object)
        self._line_tree = shapely.STRtree(self._lines)
        self._areas = {name: layers.polygons[name] for name in AREA_CLASSES if name in self.classes}
        self._area_trees = {name: shapely.STRtree(areas) for name, areas in self._areas.items()}
        surface = [layers.polygons[name] for name in SURFACE_LAYERS if name in layers.polygons]
        outlines = shapely.get_parts(shapely.union_all([shapely.union_all(p) for p in surface]))
        self._outlines = OutlineIndex(rings_of(outlines, exterior_ccw=False))

    def instances(self, global_from_frame: np.ndarray) -> list[MapInstance]:
        """Return the map elements around a pose.

        Args:
            global_from_frame: Pose of the annotation frame in the map. (4, 4)

        Returns:
            Elements in the frame, class by class in label order; points are (n, 2) in metres.
        """
        patch = LocalPatch.from_pose(global_from_frame, self.x_range, self.y_range)
        found = []
        for label, name in enumerate(self.classes):
            found += [MapInstance(label, points) for points in self._polylines(name, patch)]
        return found

    def _polylines(self, name: str, patch: LocalPatch) -> list[Points]:
        if name == "divider":
            return self._dividers(patch)
        if name == "boundary":
            return self._outlines.cut(patch, OUTLINE_MARGIN_M)
        return self._area_outlines(name, patch)

    def _dividers(self, patch: LocalPatch) -> list[Points]:
        near = np.sort(self._line_tree.query(patch.polygon, predicate="intersects"))
        pieces = shapely.get_parts(shapely.intersection(self._lines[near], patch.polygon))
        pieces = pieces[(shapely.get_type_id(pieces) == _LINE) & (shapely.length(pieces) > 0)]
        return _vertices(patch.to_local(pieces))

    def _area_outlines(self, name: str, patch: LocalPatch) -> list[Points]:
        near = self._area_trees[name].query(patch.polygon, predicate="intersects")
        if not len(near):
            return []
        pieces = shapely.intersection(self._areas[name][np.sort(near)], patch.polygon)
        merged = shapely.get_parts(shapely.union_all(patch.to_local(pieces)))
        polygons = merged[shapely.get_type_id(merged) == _POLYGON]
        return _vertices(rings_of(polygons, exterior_ccw=False))


def _vertices(lines: np.ndarray) -> list[Points]:
    """Return the vertices of each line. each (n, 2)."""
    points, owner = shapely.get_coordinates(lines, return_index=True)
    return np.split(points, np.flatnonzero(np.diff(owner)) + 1) if len(points) else []
