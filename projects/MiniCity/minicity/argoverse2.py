"""Ground of an Argoverse 2 log (one drive) for MiniCity's renderer."""

from collections.abc import Sequence

import numpy as np
import shapely
from av2.map.lane_segment import LaneMarkType
from av2.map.map_api import ROI_ISOCONTOUR_M, ArgoverseStaticMap, GroundHeightLayer
from scipy import ndimage

from gsmap.utils.errors import InputError
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
DASH_M, GAP_M = 3.0, 6.0  # length of a dash, and of the space between two dashes
SAME_LINE_M = 0.3  # lines closer than this are one line
WEAR = 0.15  # share of the paint that is worn off
# Standard deviation of the Gaussian filter of heights, which are stored in steps of about 5 cm.
HEIGHT_SMOOTHING_M = 1.0

Bounds = tuple[float, float, float, float]


def make_scene(
    static_map: ArgoverseStaticMap, heights: GroundHeightLayer, bounds: Bounds
) -> SceneMap:
    """Create the ground of a log from its map: road, kerbs, paint and height.

    Paint follows the lane markings and crossings of the map. A lane boundary without a marking gets
    no paint.

    Args:
        static_map: Map of the log.
        heights: Ground height of the log.
        bounds: xmin, ymin, xmax, ymax of the part to render, in the city frame, in metres.

    Returns:
        Surfaces, kerbs, paint and height in the city frame.

    Raises:
        ValueError: If no ground height is known inside the bounds.
    """
    window = shapely.box(*bounds)
    areas = []
    for area in static_map.get_scenario_vector_drivable_areas():
        polygon = shapely.Polygon(area.xyz[:, :2])
        if polygon.intersects(window):
            areas.append(shapely.make_valid(polygon))
    road = shapely.union_all(areas)
    # Argoverse 2 measures heights up to this distance from the road (its region of interest).
    trusted = road.buffer(ROI_ISOCONTOUR_M)
    scene = SceneMap(height=height_grid(heights, bounds, trusted=trusted))
    for polygon in _polygons(road.buffer(WALKWAY_WIDTH_M, join_style="mitre")):
        scene.surfaces.append(Surface(polygon, "walkway"))
    for polygon in _polygons(road):
        scene.surfaces.append(Surface(polygon, "asphalt"))
        for ring in (polygon.exterior, *polygon.interiors):
            scene.kerbs.append(np.array(ring.coords))
    paint = lane_paint(static_map, window)
    for crossing in static_map.get_scenario_ped_crossings():
        side_a, side_b = crossing.get_edges_2d()
        paint["white"] += zebra(side_a[:, :2], side_b[:, :2])
    for color, outlines in paint.items():
        if outlines:
            scene.markings.append(Marking(outlines, paint=color, wear=WEAR))
    return scene


def lane_paint(
    static_map: ArgoverseStaticMap, window: shapely.Polygon
) -> dict[str, list[np.ndarray]]:
    """Compute the painted areas of the marked lane boundaries in a window of the city.

    If two lanes share a line, the map has the line twice, but it is painted once.

    Args:
        static_map: Map of the log.
        window: Area in the city frame, in metres; lines that touch it are included.

    Returns:
        Outlines in metres by colour, ``white`` and ``yellow``. Each (n, 2)
    """
    kinds = []
    lines = []
    for lane in static_map.get_scenario_lane_segments():
        for marking in (lane.left_lane_marking, lane.right_lane_marking):
            if marking.mark_type is not LaneMarkType.NONE:
                kinds.append(marking.mark_type.value)  # style and colour, such as DASHED_YELLOW
                lines.append(shapely.LineString(marking.polyline[:, :2]))
    paint: dict[str, list[np.ndarray]] = {"white": [], "yellow": []}
    for i in _unique_lines(np.array(lines, dtype=object), window):
        color = "yellow" if kinds[i].endswith("YELLOW") else "white"
        paint[color] += _line_paint(np.array(lines[i].coords), kinds[i])
    return paint


def _unique_lines(lines: np.ndarray, window: shapely.Polygon) -> list[int]:
    """Return the indices of the lines in a window, without lines that repeat an earlier line."""
    tree = shapely.STRtree(lines)
    unique: set[int] = set()
    for i in sorted(tree.query(window, predicate="intersects").tolist()):  # in the order of the map
        # A line that only crosses line i or continues it is close, too. It has a large Hausdorff
        # distance, the largest distance of a point of one line from the other line.
        close = tree.query(lines[i], predicate="dwithin", distance=SAME_LINE_M).tolist()
        earlier = unique.intersection(close)
        is_repeated = any(
            shapely.hausdorff_distance(lines[i], lines[j]) < SAME_LINE_M for j in earlier
        )
        if not is_repeated:
            unique.add(i)
    return sorted(unique)


def _line_paint(line: np.ndarray, kind: str) -> list[np.ndarray]:
    """Compute the painted areas of a line (n, 2) of an Argoverse mark type. (m, 2) each"""
    if kind.startswith("DOUBLE"):
        return double_line(line, LINE_WIDTH_M, gap_m=DOUBLE_GAP_M)
    if kind.startswith("DASHED"):
        return dashed_line(line, LINE_WIDTH_M, dash_m=DASH_M, gap_m=GAP_M)
    if kind.startswith(("DASH_SOLID", "SOLID_DASH")):  # one solid, one dashed line side by side
        curve = shapely.LineString(line)
        # The offsets are from the curve to the middles of both lines.
        left = np.array(curve.offset_curve(DOUBLE_GAP_M).coords)
        right = np.array(curve.offset_curve(-DOUBLE_GAP_M).coords)
        is_left_solid = kind.startswith("SOLID")  # a kind names the left line first
        solid = left if is_left_solid else right
        dashed = right if is_left_solid else left
        dashes = dashed_line(dashed, LINE_WIDTH_M, dash_m=DASH_M, gap_m=GAP_M)
        return dashes + solid_line(solid, LINE_WIDTH_M)
    return solid_line(line, LINE_WIDTH_M)


def height_grid(
    heights: GroundHeightLayer, bounds: Bounds, trusted: shapely.Geometry
) -> HeightGrid:
    """Compute the smoothed ground height inside bounds.

    Away from the road, the stored heights include trees, buildings and tall spikes. Therefore only
    heights inside ``trusted`` are used. Every other cell gets the height of the nearest such cell.

    Args:
        heights: Ground height of a log.
        bounds: xmin, ymin, xmax, ymax in the city frame, in metres.
        trusted: Area of usable heights in the city frame, in metres.

    Returns:
        Height of each cell inside the bounds, in the city frame.

    Raises:
        ValueError: If no height is known inside the bounds, or the grid is rotated.
    """
    # Transform p -> s (R p + t) from the city to columns and rows of the grid: rotation R,
    # translation t in metres, and scale s in cells per metre.
    grid_from_city = heights.array_Sim2_city
    if not np.allclose(grid_from_city.R, np.eye(2)):
        raise InputError("the ground height grid is turned against the city frame.")
    cell_m = 1.0 / grid_from_city.s
    corners = grid_from_city.transform_from(np.array(bounds).reshape(2, 2))
    rows, columns = heights.array.shape
    # First and last cell (column, row) inside the bounds; the range has at least one cell.
    low = np.clip(np.floor(corners[0]).astype(int), 0, (columns - 1, rows - 1))
    high = np.clip(np.ceil(corners[1]).astype(int), low + 1, (columns, rows))
    part = heights.array[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    # As R is the identity, a point p has the grid coordinates s (p + t). The centre of cell i is at
    # i + 0.5.
    origin = (low + 0.5) * cell_m - grid_from_city.t
    x = origin[0] + np.arange(part.shape[1]) * cell_m
    y = origin[1] + np.arange(part.shape[0]) * cell_m
    grid_x, grid_y = np.meshgrid(x, y)
    shapely.prepare(trusted)  # makes the test of many points fast
    known = np.isfinite(part) & shapely.contains_xy(trusted, grid_x, y=grid_y)
    if not known.any():
        raise InputError(f"no ground height is known on the road inside {bounds}.")
    # Indices (row, column) of the nearest known cell of each cell. (2, rows, columns)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = ndimage.gaussian_filter(part[tuple(nearest)], sigma=HEIGHT_SMOOTHING_M / cell_m)
    return HeightGrid(origin, cell_m, height_m=filled)


def _polygons(geometry: shapely.Geometry) -> Sequence[shapely.Polygon]:
    """Return the polygons among the parts of a geometry."""
    parts = shapely.get_parts(geometry).tolist()
    return [part for part in parts if part.geom_type == "Polygon"]
