"""Local vector maps from the map of one Argoverse 2 log, by the rules of MapTRv2 or of MapTR.

Geometry that does not depend on the pose of the vehicle is prepared once per log; each frame then
takes a few vectorised geometry calls. ``docs/data.md`` lists both sets of rules.

The position of a lane is its index in the list of the lanes of the map. The patch is the rectangle
around the vehicle to which the map is cut.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import shapely
from av2.map.lane_segment import LaneMarkType, LaneSegment
from av2.map.map_api import ArgoverseStaticMap

from gsmap.datasets.annotations.record import RANGES
from gsmap.datasets.errors import explain_errors
from gsmap.utils.errors import InputError
from mapdata.argoverse2.map_file import read_map_file
from mapdata.argoverse2.rules import (
    clip_lines,
    clip_polygons,
    drop_duplicates,
    merge_until_stable,
)
from mapdata.crossings import EDGE_MARGIN_M, cut_rings, open_outlines
from mapdata.lane_graph import ROUND_DECIMALS, LaneLinks, LanePaths, link_lanes
from mapdata.local_map import GeometryLayer, LocalPatch, rings_of, vertices_of

COMPAT_MODES = ("maptrv2", "maptr")
DEFAULT_RULES = COMPAT_MODES[0]
MAP_CLASSES = ("divider", "ped_crossing", "boundary", "centerline")
# Values in place of the position of a lane's neighbour.
NO_LANE = -2  # the lane has no neighbour on this side
OUTSIDE = -1  # the neighbour is not in the map


def check_rules(classes: Collection[str], compat: str) -> None:
    """Check the names of the classes and of the rules.

    Args:
        classes: Class names from ``MAP_CLASSES``.
        compat: Name of the rules, one of ``COMPAT_MODES``.

    Raises:
        ValueError: If a class or the rules are unknown.
    """
    if compat not in COMPAT_MODES:
        raise InputError(f"compat must be one of {COMPAT_MODES}, got {compat!r}.")
    unknown = set(classes) - set(MAP_CLASSES)
    if unknown:
        raise InputError(f"classes must be among {MAP_CLASSES}, got {sorted(unknown)}.")


def find_map(log_dir: Path) -> Path:
    """Find the file of a log's vector map.

    Raises:
        FileNotFoundError: If the log has no map.
        ValueError: If the log has several maps.
    """
    paths = sorted((log_dir / "map").glob("log_map_archive_*.json"))
    if not paths:
        raise FileNotFoundError(f"no map/log_map_archive_*.json in {log_dir}: download it again.")
    if len(paths) > 1:
        raise InputError(f"{len(paths)} maps in {log_dir / 'map'}, expected one: {paths}.")
    return paths[0]


class Argoverse2Map:
    """Map of one log, prepared for extracting the elements around the vehicle at many poses.

    Args:
        static_map: Map of the official API.
        left_out: Ids of the unusable elements of the map's file, by a text with their kind and the
            reason.
    """

    def __init__(
        self, static_map: ArgoverseStaticMap, left_out: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        self.left_out = dict(left_out or {})
        lanes = static_map.get_scenario_lane_segments()
        # For each lane, pairs of positions: a lane and the lane that follows it.
        links = link_lanes([(lane.id, lane.predecessors, lane.successors) for lane in lanes])
        self._add_neighbours(lanes, links)
        lane_polygons = []
        centrelines = []
        painted_lines = []
        for lane in lanes:
            lane_polygons.append(shapely.Polygon(lane.polygon_boundary))
            centreline = static_map.get_lane_segment_centerline(lane.id)
            centrelines.append(centreline.round(ROUND_DECIMALS))
            for marking in (lane.left_lane_marking, lane.right_lane_marking):
                if marking.mark_type is not LaneMarkType.NONE:  # an unknown mark counts as paint
                    painted_lines.append(shapely.LineString(marking.polyline))
        # A `GeometryLayer` finds its valid geometries that touch a patch. `LanePaths` joins the
        # lines of consecutive lanes to paths.
        self._lanes = GeometryLayer(lane_polygons)
        self._is_intersection = np.array([lane.is_intersection for lane in lanes], dtype=bool)
        self._centre_paths = LanePaths(centrelines, links)
        self._painted = GeometryLayer(painted_lines)
        crossing_polygons = []
        for crossing in static_map.get_scenario_ped_crossings():
            # Both edges run in one direction, so the ring returns along the second one.
            ring = np.vstack([crossing.edge1.xyz, crossing.edge2.xyz[::-1]])
            crossing_polygons.append(shapely.Polygon(ring))
        self._crossings = GeometryLayer(crossing_polygons)
        areas = static_map.get_scenario_vector_drivable_areas()
        self._drivable = GeometryLayer([shapely.Polygon(area.xyz) for area in areas])

    def _add_neighbours(self, lanes: Sequence[LaneSegment], links: LaneLinks) -> None:
        """Prepare the left and the right lines of the lanes, and the lanes beyond these lines."""
        position = {lane.id: i for i, lane in enumerate(lanes)}
        # Both lists have two entries, for the left and for the right side.
        self._side_paths = []
        # Position of each lane's neighbour, NO_LANE or OUTSIDE. (lanes,) each
        self._neighbours = []
        for side in ("left", "right"):
            lines = []
            neighbours = []
            for lane in lanes:
                lines.append(getattr(lane, f"{side}_lane_boundary").xyz)
                neighbour_id = getattr(lane, f"{side}_neighbor_id")
                if neighbour_id is None:
                    neighbours.append(NO_LANE)
                else:
                    neighbours.append(position.get(neighbour_id, OUTSIDE))
            self._side_paths.append(LanePaths(lines, links))
            self._neighbours.append(np.array(neighbours, dtype=np.int64))

    @classmethod
    def from_log(cls, log_dir: Path) -> "Argoverse2Map":
        """Read the map of a log.

        Args:
            log_dir: Folder of the log.

        Raises:
            FileNotFoundError: If the map is missing.
            ValueError: If the log has several maps, or the map is damaged.
        """
        path = find_map(log_dir)
        with explain_errors(path, "download it again"):  # adds the path and this advice to errors
            static_map, left_out = read_map_file(path)
            return cls(static_map, left_out)

    @property
    def invalid_counts(self) -> dict[str, int]:
        """Number of invalid polygons of the map by kind; `extract` ignores them."""
        return {
            "lane segments": self._lanes.invalid_count,
            "crossings": self._crossings.invalid_count,
            "drivable areas": self._drivable.invalid_count,
        }

    def extract(
        self,
        city_from_ego: np.ndarray,
        classes: Collection[str] = MAP_CLASSES[:3],
        compat: str = DEFAULT_RULES,
        x_range: tuple[float, float] = RANGES["ego"][0],
        y_range: tuple[float, float] = RANGES["ego"][1],
    ) -> dict[str, list[np.ndarray]]:
        """Extract the map elements around the vehicle.

        Args:
            city_from_ego: Transform from the vehicle to the city in metres. (4, 4)
            classes: Classes to extract, from ``MAP_CLASSES``.
            compat: Rules of the ground truth, one of ``COMPAT_MODES``.
            x_range: Smallest and largest x (forward) in metres, ego frame.
            y_range: Smallest and largest y (left) in metres, ego frame.

        Returns:
            Vertices of each element in metres, ego frame, by class. Each (n, 3).

        Raises:
            ValueError: If a class or the rules are unknown, the pose is malformed, or there are too
                many paths through the lanes.
        """
        check_rules(classes, compat)
        pose = np.asarray(city_from_ego, dtype=np.float64)
        patch = LocalPatch(pose, x_range=x_range, y_range=y_range)
        lanes = self._lanes.touching(patch)
        elements = {}
        for name in classes:
            lines = self._lines_of_class(name, compat, patch=patch, lanes=lanes)
            elements[name] = vertices_of(lines, dim=3)
        return elements

    def _lines_of_class(
        self, name: str, compat: str, patch: LocalPatch, lanes: np.ndarray
    ) -> np.ndarray:
        """Lines of one class inside the patch, in metres, ego frame. (lines,)

        Args:
            name: Class, one of ``MAP_CLASSES``.
            compat: Rules, one of ``COMPAT_MODES``.
            patch: Patch around the vehicle.
            lanes: Positions of the lanes that touch the patch, ascending. (n,)
        """
        if name == "boundary":
            return self._boundaries(patch)
        if name == "centerline":
            return self._centerlines(patch, lanes)
        if name == "divider":
            if compat == "maptr":
                return self._painted_lines(patch)
            return self._dividers(patch, lanes)
        if compat == "maptr":  # the class is "ped_crossing"
            return self._crossing_rings(patch)
        return self._merged_crossings(patch)

    def _dividers(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Lines between neighbouring lanes outside intersections (MapTRv2)."""
        lanes = lanes[~self._is_intersection[lanes]]
        left_neighbours, right_neighbours = self._neighbours
        with_left_line = lanes[left_neighbours[lanes] != NO_LANE]
        with_right_line = lanes[right_neighbours[lanes] != NO_LANE]
        # Two neighbouring lanes share a line: the right line of lane A is the left line of lane B.
        # It is taken once, from B if B is among these lanes, else from A.
        # First, drop the right line of each lane A that is the left neighbour of a lane B.
        is_shared = np.isin(with_right_line, left_neighbours[with_left_line])
        with_right_line = with_right_line[~is_shared]
        # Two lanes may disagree: A names B as its right neighbour, but B names another lane as its
        # left neighbour. Then the right line of A is kept, and the left line of B is dropped.
        is_shared = np.isin(with_left_line, right_neighbours[with_right_line])
        with_left_line = with_left_line[~is_shared]
        left_paths, right_paths = self._side_paths
        left_lines = left_paths.simplify_paths(with_left_line.tolist())
        right_lines = right_paths.simplify_paths(with_right_line.tolist())
        lines = np.concatenate([left_lines, right_lines])
        return drop_duplicates(clip_lines(lines, patch))

    def _centerlines(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Paths along the middle of the lanes (MapTRv2)."""
        paths = self._centre_paths.simplify_paths(lanes.tolist())
        return drop_duplicates(clip_lines(paths, patch))

    def _painted_lines(self, patch: LocalPatch) -> np.ndarray:
        """Painted lane boundaries, joined where the lines meet (MapTR)."""
        # `clip_lines` returns the parts inside the patch, in the ego frame.
        return merge_until_stable(clip_lines(self._painted.near(patch), patch))

    def _merged_crossings(self, patch: LocalPatch) -> np.ndarray:
        """Outlines of crossings, united if parallel, open at the edge of the patch (MapTRv2)."""
        pieces, crossing_of_piece = clip_polygons(self._crossings.near(patch), patch)
        return open_outlines(pieces, crossing_of_piece, patch=patch)

    def _crossing_rings(self, patch: LocalPatch) -> np.ndarray:
        """Ring of each crossing, closed along the edge of the patch (MapTR)."""
        pieces, _ = clip_polygons(self._crossings.near(patch), patch)
        # The pieces lie inside of the patch, so a larger box cuts nothing, and rings stay closed.
        lines, _ = cut_rings(rings_of(pieces), patch.box(EDGE_MARGIN_M))
        return lines

    def _boundaries(self, patch: LocalPatch) -> np.ndarray:
        """Outline of the drivable area without the edge of the patch (MapTR and MapTRv2)."""
        pieces, _ = clip_polygons(self._drivable.near(patch), patch)
        area = shapely.get_parts(shapely.union_all(pieces))
        # The smaller box cuts off the parts of the outline along the edge of the patch.
        lines, _ = cut_rings(rings_of(area), patch.box(-EDGE_MARGIN_M))
        return lines
