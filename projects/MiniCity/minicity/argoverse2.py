"""The ground of an Argoverse 2 log for MiniCity's renderer: road, kerbs, paint and height."""

from collections.abc import Sequence

import numpy as np
import shapely
from av2.map.lane_segment import LaneMarkType
from av2.map.map_api import ROI_ISOCONTOUR_M, ArgoverseStaticMap, GroundHeightLayer
from scipy import ndimage

from minicity.scene_map import (
    HeightGrid,
    Marking,
    SceneMap,
    Surface,
    dashed_line,
    double_line,
    solid_line,
    zebra,
)

WALKWAY_WIDTH_M = 3.0
LINE_WIDTH_M = 0.15
DOUBLE_GAP_M = 0.12
DASH_M, GAP_M = 3.0, 6.0
SAME_LINE_M = 0.3
WEAR = 0.15
HEIGHT_SMOOTHING_M = 1.0  # heights are stored in steps of about 5 cm

Bounds = tuple[float, float, float, float]


def make_scene(
    static_map: ArgoverseStaticMap, heights: GroundHeightLayer, bounds: Bounds
) -> SceneMap:
    """Lay out what the map of a log says about the ground.

    Paint is where the map says that there is some; lane boundaries without paint stay invisible.

    Args:
        static_map: The map of the log.
        heights: Height of its ground.
        bounds: xmin, ymin, xmax, ymax of the part that will be seen, city frame, in metres.

    Raises:
        ValueError: If no ground height is known inside the bounds.
    """
    window = shapely.box(*bounds)
    areas = [shapely.Polygon(a.xyz[:, :2]) for a in static_map.get_scenario_vector_drivable_areas()]
    road = shapely.union_all([shapely.make_valid(a) for a in areas if a.intersects(window)])
    scene = SceneMap(height=height_grid(heights, bounds, road.buffer(ROI_ISOCONTOUR_M)))
    walkway = _polygons(road.buffer(WALKWAY_WIDTH_M, join_style="mitre"))
    scene.surfaces += [Surface(polygon, "walkway") for polygon in walkway]
    for polygon in _polygons(road):
        scene.surfaces.append(Surface(polygon, "asphalt"))
        scene.kerbs += [np.array(r.coords) for r in (polygon.exterior, *polygon.interiors)]
    paint = lane_paint(static_map, window)
    for crossing in static_map.get_scenario_ped_crossings():
        paint["white"] += zebra(*(edge[:, :2] for edge in crossing.get_edges_2d()))
    scene.markings += [Marking(areas, colour, WEAR) for colour, areas in paint.items() if areas]
    return scene


def lane_paint(
    static_map: ArgoverseStaticMap, window: shapely.Polygon
) -> dict[str, list[np.ndarray]]:
    """Return the painted areas of all marked lane boundaries in a window of the city, by colour.

    Two lanes that share a line describe it twice; it is painted once. each (n, 2)
    """
    markings = [
        marking
        for lane in static_map.get_scenario_lane_segments()
        for marking in (lane.left_lane_marking, lane.right_lane_marking)
        if marking.mark_type is not LaneMarkType.NONE
    ]
    lines = np.array([shapely.LineString(m.polyline[:, :2]) for m in markings], dtype=object)
    painted: dict[str, list[np.ndarray]] = {"white": [], "yellow": []}
    for i in _different(lines, window):
        kind = markings[i].mark_type.value
        colour = "yellow" if kind.endswith("YELLOW") else "white"
        painted[colour] += _stroke(np.array(lines[i].coords), kind)
    return painted


def _different(lines: np.ndarray, window: shapely.Polygon) -> list[int]:
    """Return the positions of the lines in the window without those that repeat an earlier one."""
    tree = shapely.STRtree(lines)
    kept: set[int] = set()
    for i in sorted(tree.query(window, predicate="intersects").tolist()):
        near = [j for j in tree.query(lines[i], "dwithin", SAME_LINE_M).tolist() if j in kept]
        if not any(shapely.hausdorff_distance(lines[i], lines[j]) < SAME_LINE_M for j in near):
            kept.add(i)
    return sorted(kept)


def _stroke(line: np.ndarray, kind: str) -> list[np.ndarray]:
    """Return the painted areas of one line of an Argoverse mark type. each (n, 2)"""
    if kind.startswith("DOUBLE"):
        return double_line(line, LINE_WIDTH_M, DOUBLE_GAP_M)
    if kind.startswith("DASHED"):
        return dashed_line(line, LINE_WIDTH_M, DASH_M, GAP_M)
    if kind.startswith(("DASH_SOLID", "SOLID_DASH")):  # one solid, one dashed line side by side
        curves = (shapely.LineString(line).offset_curve(d) for d in (DOUBLE_GAP_M, -DOUBLE_GAP_M))
        left, right = (np.array(curve.coords) for curve in curves)
        dashed, solid = (left, right) if kind.startswith("DASH") else (right, left)
        return dashed_line(dashed, LINE_WIDTH_M, DASH_M, GAP_M) + solid_line(solid, LINE_WIDTH_M)
    return solid_line(line, LINE_WIDTH_M)


def height_grid(
    heights: GroundHeightLayer, bounds: Bounds, trusted: shapely.Geometry
) -> HeightGrid:
    """Return the ground height inside bounds, smoothed, and outwards as it is at the edge.

    Stored heights count in the area ``trusted`` of the city: away from the road they include what
    stands there, up to tall spikes. ``bounds`` are xmin, ymin, xmax, ymax in the city, in metres.

    Raises:
        ValueError: If no height is known inside the bounds, or the grid is turned.
    """
    to_grid = heights.array_Sim2_city
    if not np.allclose(to_grid.R, np.eye(2)):
        raise ValueError("the ground height grid is turned against the city frame.")
    cell_m = 1.0 / to_grid.s
    corners = to_grid.transform_from(np.array(bounds).reshape(2, 2))
    rows, columns = heights.array.shape
    low = np.clip(np.floor(corners[0]).astype(int), 0, (columns - 1, rows - 1))
    high = np.clip(np.ceil(corners[1]).astype(int), low + 1, (columns, rows))
    part = heights.array[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    origin = (low + 0.5) * cell_m - to_grid.t  # p_grid = s (p_city + t), cells centred at + 0.5
    x, y = (origin[i] + np.arange(n) * cell_m for i, n in enumerate(part.shape[::-1]))
    shapely.prepare(trusted)
    known = np.isfinite(part) & shapely.contains_xy(trusted, *np.meshgrid(x, y))
    if not known.any():
        raise ValueError(f"no ground height is known on the road inside {bounds}.")
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = ndimage.gaussian_filter(part[tuple(nearest)], HEIGHT_SMOOTHING_M / cell_m)
    return HeightGrid(origin, cell_m, filled)


def _polygons(geometry: shapely.Geometry) -> Sequence[shapely.Polygon]:
    return [p for p in shapely.get_parts(geometry).tolist() if p.geom_type == "Polygon"]
