"""Local vector maps from a nuScenes map expansion, by the rules of MapTR.

Whatever does not depend on the pose is done once per map; a frame then takes a few vectorised
geometry calls on what lies near.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from gsmap.datasets.annotations.record import RANGES, MapInstance
from gsmap.datasets.errors import naming
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.polylines import Points
from gsmap.utils.errors import InputError
from gsmap.utils.files import is_hidden
from mapdata.crossings import (
    CROSSINGS,
    EDGES,
    UNITED,
    long_edges,
    open_outlines,
)
from mapdata.lane_graph import LaneLinks, LanePaths, link_lanes
from mapdata.local_map import (
    POLYGON,
    GeometryLayer,
    LocalPatch,
    OutlineIndex,
    rings_of,
    vertices_of,
)

if TYPE_CHECKING:
    from nuscenes.map_expansion.map_api import NuScenesMap

LINE_LAYERS = ("road_divider", "lane_divider")
SURFACE_LAYERS = ("road_segment", "lane")
MAP_CLASSES = ("divider", "ped_crossing", "boundary", *AREA_CLASSES[1:4], "centerline")
CROSSING = "ped_crossing"
OUTLINE_MARGIN_M = 0.2
CENTERLINE_STEP_M = 0.5


@dataclass
class MapLayers:
    """The geometries of one map in its global frame; plain enough to hand to another process."""

    lines: list[shapely.LineString]  # the dividers
    polygons: dict[str, np.ndarray]  # valid ones by layer or class, each (n,) of Polygon
    skipped: Counter[str]  # how many elements were left out, by reason
    centerlines: list[np.ndarray] = field(default_factory=list)  # of lanes and connectors, (n, 3)
    links: LaneLinks = ()  # which of these lead into which


def _read_lines(
    nusc_map: "NuScenesMap", layer: str, skipped: Counter[str]
) -> Iterator[shapely.LineString]:
    """Yield the lines of a layer; those without two nodes are counted."""
    for record in getattr(nusc_map, layer):
        tokens = nusc_map.get("line", record["line_token"])["node_tokens"]
        if len(tokens) < 2:
            skipped[f"{layer} without two nodes"] += 1
        else:
            yield nusc_map.extract_line(record["line_token"])


def _read_polygons(nusc_map: "NuScenesMap", name: str, skipped: Counter[str]) -> np.ndarray:
    """Return the polygons of a layer or class; invalid ones are counted. (n,) of Polygon."""
    records = getattr(nusc_map, "road_segment" if name == "intersection" else name)
    if name == "intersection":
        records = [record for record in records if record.get("is_intersection", False)]
    polygons = [nusc_map.extract_polygon(record["polygon_token"]) for record in records]
    valid = [polygon for polygon in polygons if polygon.is_valid and not polygon.is_empty]
    if len(valid) < len(polygons):
        skipped[f"invalid {name} polygon"] += len(polygons) - len(valid)
    return np.array(valid, dtype=object)


def check_classes(classes: Collection[str]) -> None:
    """Raise a ``ValueError`` unless the classes are known."""
    unknown = [name for name in classes if name not in MAP_CLASSES]
    if unknown:
        raise InputError(f"classes must be among {MAP_CLASSES}, got {unknown}.")


def expansion(root: Path, name: str) -> Path:
    """Return the file of a map below a data root."""
    return root / f"maps/expansion/{name}.json"


def open_layers(root: Path, name: str, classes: Collection[str]) -> MapLayers:
    """Collect the geometries that the classes need from a map, in metres of the map.

    Lines without two nodes and invalid polygons are left out and counted.

    Args:
        root: Data root.
        name: Name of the map, such as ``boston-seaport``.
        classes: Wanted classes, of ``MAP_CLASSES``.

    Raises:
        FileNotFoundError: If the map is missing.
        ValueError: If it is damaged, or its name is none of a file.
    """
    path = expansion(root, name)
    if Path(name).name != name:
        raise InputError(f"the location {name!r:.80} cannot be the name of a map: rename it.")
    if not path.is_file():
        raise FileNotFoundError(
            f"no map expansion for {name!r} in {path.parent}, which has "
            f"{', '.join(maps_in(root)) or 'none'}. Unpack nuScenes' map expansion pack (v1.3) "
            f"there, or put {path.name} there in its form; for other maps write the annotation "
            "file with mapdata.custom.from_records (docs/custom_data.md)."
        )
    skipped: Counter[str] = Counter()
    names = set(AREA_CLASSES) & set(classes)
    if "boundary" in classes:
        names |= set(SURFACE_LAYERS)
    marked = LINE_LAYERS if "divider" in classes else ()
    with naming(path, "unpack the map expansion pack (v1.3) again"):
        nusc_map = _open_map(root, name)
        areas = {area: _read_polygons(nusc_map, area, skipped) for area in sorted(names)}
        lines = [line for layer in marked for line in _read_lines(nusc_map, layer, skipped)]
        layers = MapLayers(lines, areas, skipped)
        if "centerline" in classes:
            _read_centerlines(nusc_map, layers)
        for geometries in (layers.lines, *layers.polygons.values()):
            if not np.isfinite(shapely.get_coordinates(geometries)).all():
                raise InputError("a point is not finite")
    return layers


def maps_in(root: Path) -> list[str]:
    """Return the names of the maps below a data root."""
    files = (root / "maps/expansion").glob("*.json")
    return sorted(path.stem for path in files if not is_hidden(path))


def _open_map(root: Path, name: str) -> "NuScenesMap":
    """Open a map with the devkit, which knows nuScenes' four towns alone by itself."""
    from nuscenes.map_expansion.map_api import NuScenesMap, locations

    own = name not in locations
    if own:
        locations.append(name)
    try:
        return NuScenesMap(str(root), name)
    finally:
        if own:
            locations.remove(name)


def _read_centerlines(nusc_map: "NuScenesMap", layers: MapLayers) -> None:
    """Add the centre lines of lanes and lane connectors, and how they follow one another."""
    tokens = []
    for record in (*nusc_map.lane, *nusc_map.lane_connector):
        poses = nusc_map.discretize_lanes([record["token"]], CENTERLINE_STEP_M)[record["token"]]
        if len(poses) < 2:
            layers.skipped["lane without a centre line"] += 1
            continue
        layers.centerlines.append(np.pad(np.array(poses)[:, :2], ((0, 0), (0, 1))))
        tokens.append(record["token"])
    ways = {token: nusc_map.connectivity.get(token, {}) for token in tokens}
    links = [(t, ways[t].get("incoming", []), ways[t].get("outgoing", [])) for t in tokens]
    layers.links = link_lanes(links)


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
        crossings: Rule of the crossings, one of ``CROSSINGS``: ``united`` as above, ``edges``
            (`long_edges`) or ``parallel`` (`open_outlines`).

    Raises:
        ValueError: If a class or the rule is unknown.
    """

    def __init__(
        self,
        layers: MapLayers,
        classes: Sequence[str],
        x_range: tuple[float, float] = RANGES["lidar"][0],
        y_range: tuple[float, float] = RANGES["lidar"][1],
        crossings: str = UNITED,
    ) -> None:
        check_classes(classes)
        if crossings not in CROSSINGS:
            raise InputError(f"crossings must be one of {CROSSINGS}, got {crossings!r}.")
        self.classes = tuple(classes)
        self._crossings = crossings
        self.x_range, self.y_range = x_range, y_range
        self._lines = GeometryLayer(layers.lines)
        areas = set(AREA_CLASSES) & set(classes)
        self._areas = {name: GeometryLayer(layers.polygons[name]) for name in areas}
        surface = [layers.polygons[name] for name in SURFACE_LAYERS if name in layers.polygons]
        outlines = shapely.get_parts(shapely.union_all([shapely.union_all(p) for p in surface]))
        self._outlines = OutlineIndex(rings_of(outlines))
        self._lane_paths = LanePaths(layers.centerlines, layers.links)
        lanes = [shapely.LineString(line[:, :2]) for line in layers.centerlines]
        self._lane_tree = shapely.STRtree(lanes)

    def instances(self, global_from_frame: np.ndarray) -> list[MapInstance]:
        """Return the map elements around a pose (4, 4) of the annotation frame, in that frame.

        They come class by class in label order; points are (n, 2) in metres.
        """
        patch = LocalPatch(global_from_frame, self.x_range, self.y_range)
        return [
            MapInstance(label, points)
            for label, name in enumerate(self.classes)
            for points in self._polylines(name, patch)
        ]

    def _polylines(self, name: str, patch: LocalPatch) -> list[Points]:
        if name == "boundary":
            return self._outlines.cut(patch, OUTLINE_MARGIN_M)
        if name == CROSSING and self._crossings != UNITED:
            return self._open_crossings(patch)
        if name in self._areas:
            pieces = shapely.intersection(self._areas[name].near(patch), patch.polygon)
            merged = shapely.get_parts(shapely.union_all(patch.to_local(pieces)))
            return vertices_of(rings_of(merged[shapely.get_type_id(merged) == POLYGON]), 2)
        if name == "divider":
            lines = self._lines.near(patch)
        else:
            near = np.sort(self._lane_tree.query(patch.polygon, predicate="intersects"))
            lines = shapely.force_2d(self._lane_paths.simplified(near.tolist()))
        return vertices_of(patch.to_local(patch.lines_inside(lines)), 2)

    def _open_crossings(self, patch: LocalPatch) -> list[Points]:
        """Return the lines of the crossings around a patch, in its frame. each (n, 2)"""
        near = self._areas[CROSSING].near(patch)
        if self._crossings == EDGES:
            lines = patch.lines_inside(long_edges(near))
            return vertices_of(patch.to_local(lines), 2)
        pieces, owner = shapely.get_parts(
            shapely.intersection(near, patch.polygon), return_index=True
        )
        keep = shapely.get_type_id(pieces) == POLYGON
        local = patch.to_local(pieces[keep])
        return vertices_of(open_outlines(local, owner[keep], patch), 2)
