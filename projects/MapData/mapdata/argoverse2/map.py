"""Local vector maps from the map of one Argoverse 2 log, by the rules of MapTRv2 or of MapTR.

Whatever does not depend on the vehicle's pose is done once per log; a frame then takes a few
vectorised geometry calls. ``docs/data.md`` states both sets of rules.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import shapely
from av2.map.lane_segment import LaneMarkType
from av2.map.map_api import ArgoverseStaticMap

from gsmap.datasets.annotations.record import RANGES
from gsmap.datasets.errors import naming
from gsmap.utils.errors import InputError
from mapdata.argoverse2.map_file import read_map_file
from mapdata.argoverse2.rules import (
    clip_lines,
    clip_polygons,
    drop_duplicates,
    merge_until_stable,
)
from mapdata.crossings import EDGE_MARGIN_M, cut_rings, open_outlines
from mapdata.lane_graph import ROUND_DECIMALS, LanePaths, link_lanes
from mapdata.local_map import GeometryLayer, LocalPatch, rings_of, vertices_of

COMPAT_MODES = ("maptrv2", "maptr")
MAP_CLASSES = ("divider", "ped_crossing", "boundary", "centerline")
NO_LANE, OUTSIDE = -2, -1  # no neighbour; one that is not in the map


def check_rules(classes: Collection[str], compat: str) -> None:
    """Raise a ``ValueError`` unless the classes and the rules are known."""
    if compat not in COMPAT_MODES:
        raise InputError(f"compat must be one of {COMPAT_MODES}, got {compat!r}.")
    unknown = set(classes) - set(MAP_CLASSES)
    if unknown:
        raise InputError(f"classes must be among {MAP_CLASSES}, got {sorted(unknown)}.")


def find_map(log_dir: Path) -> Path:
    """Return the file of a log's vector map; an error if there is none, or several."""
    found = sorted((log_dir / "map").glob("log_map_archive_*.json"))
    if not found:
        raise FileNotFoundError(f"no map/log_map_archive_*.json in {log_dir}: download it again.")
    if len(found) > 1:
        raise InputError(f"{len(found)} maps in {log_dir / 'map'}, expected one: {found}.")
    return found[0]


class Argoverse2Map:
    """A log's map, as the official API reads it, prepared for cutting out what the vehicle sees.

    Args:
        static_map: The map.
        left_out: Numbers of the elements that its file holds and that cannot be used, by kind and
            reason.
    """

    def __init__(
        self, static_map: ArgoverseStaticMap, left_out: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        self.left_out = dict(left_out or {})
        lanes = static_map.get_scenario_lane_segments()
        links = link_lanes([(s.id, s.predecessors, s.successors) for s in lanes])
        self._lanes = GeometryLayer([shapely.Polygon(s.polygon_boundary) for s in lanes])
        self._is_intersection = np.array([s.is_intersection for s in lanes], dtype=bool)
        position = {s.id: i for i, s in enumerate(lanes)}
        self._sides, self._beyond = [], []  # lines on the left and on the right, lanes beyond these
        for side in ("left", "right"):
            lines = [getattr(s, f"{side}_lane_boundary").xyz for s in lanes]
            self._sides.append(LanePaths(lines, links))
            ids = [getattr(s, f"{side}_neighbor_id") for s in lanes]
            beyond = [NO_LANE if i is None else position.get(i, OUTSIDE) for i in ids]
            self._beyond.append(np.array(beyond, dtype=np.int64))
        centres = [static_map.get_lane_segment_centerline(s.id) for s in lanes]
        self._centre = LanePaths([line.round(ROUND_DECIMALS) for line in centres], links)
        markings = [m for s in lanes for m in (s.left_lane_marking, s.right_lane_marking)]
        # an unknown mark counts as paint
        painted = [m.polyline for m in markings if m.mark_type is not LaneMarkType.NONE]
        self._marked = GeometryLayer([shapely.LineString(line) for line in painted])
        crossings = static_map.get_scenario_ped_crossings()
        rings = [np.vstack([c.edge1.xyz, c.edge2.xyz[::-1]]) for c in crossings]
        self._crossings = GeometryLayer([shapely.Polygon(ring) for ring in rings])
        areas = static_map.get_scenario_vector_drivable_areas()
        self._drivable = GeometryLayer([shapely.Polygon(area.xyz) for area in areas])

    @classmethod
    def from_log(cls, log_dir: Path) -> "Argoverse2Map":
        """Read the map in a log's folder.

        Raises:
            FileNotFoundError: If the map is missing.
            ValueError: If there are several, or it is damaged.
        """
        path = find_map(log_dir)
        with naming(path, "download it again"):
            return cls(*read_map_file(path))

    @property
    def invalid_counts(self) -> dict[str, int]:
        """How many invalid polygons of each kind the map holds; they take no part."""
        return {
            "lane segments": self._lanes.invalid_count,
            "crossings": self._crossings.invalid_count,
            "drivable areas": self._drivable.invalid_count,
        }

    def extract(
        self,
        city_from_ego: np.ndarray,
        classes: Collection[str] = MAP_CLASSES[:3],
        compat: str = "maptrv2",
        x_range: tuple[float, float] = RANGES["ego"][0],
        y_range: tuple[float, float] = RANGES["ego"][1],
    ) -> dict[str, list[np.ndarray]]:
        """Return the vertices of the map elements around the vehicle, by class. each (n, 3)

        Args:
            city_from_ego: Pose of the vehicle. (4, 4)
            classes: Which of ``MAP_CLASSES`` to extract.
            compat: ``maptrv2`` or ``maptr``: whose rules.
            x_range: Smallest and largest x (forward) in the vehicle's frame, in metres.
            y_range: Smallest and largest y (left) in the vehicle's frame, in metres.

        Raises:
            ValueError: If a class or the rules are unknown, or the pose is malformed.
        """
        check_rules(classes, compat)
        patch = LocalPatch(np.asarray(city_from_ego, dtype=np.float64), x_range, y_range)
        lanes = self._lanes.touching(patch)
        maptr = compat == "maptr"
        rules = {
            "divider": self._painted_lines if maptr else self._dividers,
            "ped_crossing": self._crossing_rings if maptr else self._merged_crossings,
            "boundary": self._boundaries,
            "centerline": self._centerlines,
        }
        return {name: vertices_of(rules[name](patch, lanes), 3) for name in classes}

    def _dividers(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Lines between neighbouring lanes outside intersections (MapTRv2)."""
        lanes = lanes[~self._is_intersection[lanes]]
        left, right = (lanes[beyond[lanes] != NO_LANE] for beyond in self._beyond)
        # two lanes share each line: it is taken once, from the lane on its right if that is in view
        right = right[~np.isin(right, self._beyond[0][left])]
        left = left[~np.isin(left, self._beyond[1][right])]
        sides = zip(self._sides, (left, right), strict=True)
        paths = [side.simplified(lanes.tolist()) for side, lanes in sides]
        return drop_duplicates(clip_lines(np.concatenate(paths), patch))

    def _centerlines(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Paths along the middle of the lanes (MapTRv2)."""
        return drop_duplicates(clip_lines(self._centre.simplified(lanes.tolist()), patch))

    def _painted_lines(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Every lane boundary that carries paint, joined where the lines meet (MapTR)."""
        return merge_until_stable(clip_lines(self._marked.near(patch), patch))

    def _merged_crossings(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Crossings, parallel neighbours united, open where the patch cuts them (MapTRv2)."""
        pieces, owner = clip_polygons(self._crossings.near(patch), patch)
        return open_outlines(pieces, owner, patch)

    def _crossing_rings(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Each crossing by itself, closed along the patch's edge (MapTR)."""
        pieces, _ = clip_polygons(self._crossings.near(patch), patch)
        return cut_rings(rings_of(pieces), patch.box(EDGE_MARGIN_M))[0]

    def _boundaries(self, patch: LocalPatch, lanes: np.ndarray) -> np.ndarray:
        """Outline of the drivable area, without the patch's edge (MapTR and MapTRv2)."""
        pieces, _ = clip_polygons(self._drivable.near(patch), patch)
        area = shapely.get_parts(shapely.union_all(pieces))
        return cut_rings(rings_of(area), patch.box(-EDGE_MARGIN_M))[0]
