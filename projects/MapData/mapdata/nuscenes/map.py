"""Local vector maps from a nuScenes map expansion, by the rules of MapTR.

Geometry that does not depend on the pose of the vehicle is prepared once per map. Each frame then
needs only a few vectorised geometry calls on the elements near the vehicle.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from gsmap.datasets.annotations.record import RANGES, MapInstance
from gsmap.datasets.errors import explain_errors
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

LINE_LAYERS = ("road_divider", "lane_divider")  # layers of the map that make dividers
SURFACE_LAYERS = ("road_segment", "lane")  # layers whose union has the boundaries as outlines
# The slice of AREA_CLASSES is stop_line, intersection and carpark_area.
MAP_CLASSES = ("divider", "ped_crossing", "boundary", *AREA_CLASSES[1:4], "centerline")
CROSSING = "ped_crossing"
OUTLINE_MARGIN_M = 0.2  # distance from the edge of the patch at which outlines are cut
CENTERLINE_STEP_M = 0.5  # distance between the points of a centre line


@dataclass
class MapLayers:
    """Geometries of one map in metres, global frame. They can be pickled for another process.

    Args:
        lines: Dividers.
        polygons: Valid polygons, by the name of a surface layer or of an area class. Each (n,).
        skipped: Number of unusable elements, by reason.
        centerlines: Vertices of the centre lines of lanes and lane connectors. Each (n, 3).
        links: For each centre line, its pairs of predecessor and successor, as indices into
            ``centerlines`` (`link_lanes`).
    """

    lines: list[shapely.LineString]
    polygons: dict[str, np.ndarray]
    skipped: Counter[str]
    centerlines: list[np.ndarray] = field(default_factory=list)
    links: LaneLinks = ()


def _read_lines(
    nusc_map: "NuScenesMap", layer: str, skipped: Counter[str]
) -> Iterator[shapely.LineString]:
    """Yield the lines of a layer; lines with fewer than two nodes are counted in ``skipped``."""
    for record in getattr(nusc_map, layer):
        tokens = nusc_map.get("line", record["line_token"])["node_tokens"]
        if len(tokens) < 2:
            skipped[f"{layer} without two nodes"] += 1
        else:
            yield nusc_map.extract_line(record["line_token"])


def _read_polygons(nusc_map: "NuScenesMap", name: str, skipped: Counter[str]) -> np.ndarray:
    """Polygons of a layer or class; invalid polygons are counted in ``skipped``. (n,)

    The class ``intersection`` has no layer. It consists of the road segments that are marked so.
    """
    layer = "road_segment" if name == "intersection" else name
    polygons = []
    for record in getattr(nusc_map, layer):
        if name == "intersection" and not record.get("is_intersection", False):
            continue
        polygon = nusc_map.extract_polygon(record["polygon_token"])
        if polygon.is_valid and not polygon.is_empty:
            polygons.append(polygon)
        else:
            skipped[f"invalid {name} polygon"] += 1
    return np.array(polygons, dtype=object)


def check_classes(classes: Collection[str]) -> None:
    """Raise a ``ValueError`` if a class is not in ``MAP_CLASSES``."""
    unknown = [name for name in classes if name not in MAP_CLASSES]
    if unknown:
        raise InputError(f"classes must be among {MAP_CLASSES}, got {unknown}.")


def expansion(root: Path, name: str) -> Path:
    """Path of the expansion file of a map, below a data root."""
    return root / f"maps/expansion/{name}.json"


def open_layers(root: Path, name: str, classes: Collection[str]) -> MapLayers:
    """Read the geometries of a map for the given classes.

    Lines with fewer than two nodes and invalid polygons are left out and counted.

    Args:
        root: Data root.
        name: Name of the map, such as ``boston-seaport``.
        classes: Classes of the ground truth, out of ``MAP_CLASSES``.

    Returns:
        The geometries that the classes need, and the counts of omissions.

    Raises:
        FileNotFoundError: If the map is missing.
        ValueError: If the map is damaged, or its name cannot be the name of a file.
    """
    path = expansion(root, name)
    if Path(name).name != name:
        raise InputError(f"the location {name!r:.80} cannot be the name of a map: rename it.")
    if not path.is_file():
        raise FileNotFoundError(
            f"no map expansion for {name!r} in {path.parent}, which has "
            f"{', '.join(maps_in(root)) or 'no map'}. Unpack nuScenes' map expansion pack (v1.3) "
            f"there, or put a file {path.name} of the same format there; for maps of another "
            "format, write the annotation file with from_records (docs/custom_data.md)."
        )
    skipped: Counter[str] = Counter()
    area_names = set(AREA_CLASSES) & set(classes)
    if "boundary" in classes:
        area_names |= set(SURFACE_LAYERS)
    # Errors about the content get the name of the file and this advice.
    with explain_errors(path, "unpack the map expansion pack (v1.3) again"):
        nusc_map = open_map(root, name)
        polygons = {}
        for area in sorted(area_names):
            polygons[area] = _read_polygons(nusc_map, area, skipped=skipped)
        lines: list[shapely.LineString] = []
        if "divider" in classes:
            for layer in LINE_LAYERS:
                lines += _read_lines(nusc_map, layer, skipped=skipped)
        layers = MapLayers(lines, polygons, skipped=skipped)
        if "centerline" in classes:
            _read_centerlines(nusc_map, layers)
        for geometries in (layers.lines, *layers.polygons.values()):
            if not np.isfinite(shapely.get_coordinates(geometries)).all():
                raise InputError("a point is not finite")
    return layers


def maps_in(root: Path) -> list[str]:
    """Sorted names of the maps below a data root."""
    files = (root / "maps/expansion").glob("*.json")
    return sorted(path.stem for path in files if not is_hidden(path))


def open_map(root: Path, name: str) -> "NuScenesMap":
    """Open a map with the devkit.

    The devkit only accepts the locations in its list, so the name is in the list while it opens.

    Args:
        root: Folder of the data set.
        name: Name of the map's file below ``maps/expansion``, without its suffix.
    """
    from nuscenes.map_expansion.map_api import NuScenesMap, locations

    is_unlisted = name not in locations
    if is_unlisted:
        locations.append(name)
    try:
        return NuScenesMap(str(root), name)
    finally:
        if is_unlisted:
            locations.remove(name)


def _read_centerlines(nusc_map: "NuScenesMap", layers: MapLayers) -> None:
    """Add the centre lines of lanes and lane connectors, and their links, to ``layers``."""
    lanes = []
    for record in (*nusc_map.lane, *nusc_map.lane_connector):
        token = record["token"]
        # The devkit returns the poses (x, y, yaw) of points on the centre line, by token.
        poses = nusc_map.discretize_lanes([token], CENTERLINE_STEP_M)[token]
        if len(poses) < 2:
            layers.skipped["lane without a centre line"] += 1
            continue
        points = np.array(poses)[:, :2]
        layers.centerlines.append(np.pad(points, ((0, 0), (0, 1))))  # height 0
        # Tokens of the lanes and lane connectors that lead into this one, and out of it.
        connections = nusc_map.connectivity.get(token, {})
        incoming = connections.get("incoming", [])
        outgoing = connections.get("outgoing", [])
        lanes.append((token, incoming, outgoing))
    # Lanes without a centre line are not in `lanes`, so `link_lanes` ignores links to them.
    layers.links = link_lanes(lanes)


class NuScenesLocalMap:
    """One map, prepared for extracting the elements around the vehicle at many poses.

    The patch is the rectangle of ``x_range`` and ``y_range`` around the vehicle. Dividers are the
    lines of ``road_divider`` and ``lane_divider``, clipped to the patch. Crossings, stop lines,
    intersections and car parks are areas, clipped to the patch and united where they overlap; their
    outlines are closed rings. Boundaries are the outlines of the union of ``road_segment`` and
    ``lane``, clipped to the patch shrunk by 0.2 m on each side.

    Args:
        layers: Geometries of the map.
        classes: Class names in label order, out of ``MAP_CLASSES``.
        x_range: Smallest and largest x of the patch in metres, annotation frame.
        y_range: Smallest and largest y of the patch in metres, annotation frame.
        crossings: Rule of the crossings, one of ``CROSSINGS``: ``united`` (closed rings, see
            above), ``edges`` (the two longest edges of each crossing, see `long_edges`) or
            ``parallel`` (outlines that are open where the patch cuts them, with parallel
            neighbours united, see `open_outlines`).

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
        self.x_range = x_range
        self.y_range = y_range
        # A `GeometryLayer` finds the geometries near a patch by a spatial index.
        self._lines = GeometryLayer(layers.lines)
        areas = set(AREA_CLASSES) & set(classes)
        self._areas = {name: GeometryLayer(layers.polygons[name]) for name in areas}
        surfaces = []
        for name in SURFACE_LAYERS:
            if name in layers.polygons:
                surfaces.append(shapely.union_all(layers.polygons[name]))
        surface_parts = shapely.get_parts(shapely.union_all(surfaces))
        # Rings of exteriors and holes, cut into short chunks for a fast search.
        self._outlines = OutlineIndex(rings_of(surface_parts))
        self._lane_paths = LanePaths(layers.centerlines, layers.links)
        # The tree finds the lanes near a patch, and the paths lead through these lanes. Both use
        # the indices of the centre lines.
        lanes = [shapely.LineString(line[:, :2]) for line in layers.centerlines]
        self._lane_tree = shapely.STRtree(lanes)

    def instances(self, global_from_frame: np.ndarray) -> list[MapInstance]:
        """Extract the map elements around a pose.

        Args:
            global_from_frame: Transform from the annotation frame to the map in metres. (4, 4)

        Returns:
            Map elements in label order. Their points are in metres, annotation frame. Each (n, 2).
        """
        patch = LocalPatch(global_from_frame, x_range=self.x_range, y_range=self.y_range)
        elements = []
        for label, name in enumerate(self.classes):
            for points in self._polylines(name, patch):
                elements.append(MapInstance(label, points))
        return elements

    def _polylines(self, name: str, patch: LocalPatch) -> list[Points]:
        """Vertices of one class inside the patch, in metres, annotation frame. Each (n, 2)."""
        if name == "boundary":
            return self._outlines.clip(patch, OUTLINE_MARGIN_M)
        if name == CROSSING and self._crossings != UNITED:
            return self._open_crossings(patch)
        if name in self._areas:
            pieces = shapely.intersection(self._areas[name].near(patch), patch.polygon)
            parts = shapely.get_parts(shapely.union_all(patch.to_local(pieces)))
            # Areas that only touch the patch leave points and lines, which are dropped.
            polygons = parts[shapely.get_type_id(parts) == POLYGON]
            return vertices_of(rings_of(polygons), dim=2)
        if name == "divider":
            lines = self._lines.near(patch)
        else:  # "centerline"
            # A tree returns indices in any order. They are sorted for a fixed order of the paths.
            near = np.sort(self._lane_tree.query(patch.polygon, predicate="intersects"))
            lines = shapely.force_2d(self._lane_paths.simplify_paths(near.tolist()))
        return vertices_of(patch.to_local(patch.lines_inside(lines)), dim=2)

    def _open_crossings(self, patch: LocalPatch) -> list[Points]:
        """Vertices of crossings by the rule ``edges`` or ``parallel``. Each (n, 2)."""
        near = self._areas[CROSSING].near(patch)
        if self._crossings == EDGES:
            # The edges are chosen before they are cut at the patch.
            lines = patch.lines_inside(long_edges(near))
            return vertices_of(patch.to_local(lines), dim=2)
        clipped = shapely.intersection(near, patch.polygon)
        # `owner` is the index of the crossing of each piece. A crossing may be cut into several.
        pieces, owner = shapely.get_parts(clipped, return_index=True)
        is_polygon = shapely.get_type_id(pieces) == POLYGON
        polygons = patch.to_local(pieces[is_polygon])
        outlines = open_outlines(polygons, owner[is_polygon], patch=patch)
        return vertices_of(outlines, dim=2)
