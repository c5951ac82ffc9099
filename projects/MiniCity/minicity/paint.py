"""Layout of the surfaces, kerbs and paint of a town, as input of the renderer.

Arc lengths run along the centre line of a road. Offsets from it are positive to the left, so
forward lanes have negative offsets. ``road.section`` has the offsets of the built road. The edges
in ``road.forward_edges`` and ``road.backward_edges``, from the centre to the kerb, also include the
shift of the painted lines (``road.shift_m``).
"""

from itertools import pairwise

import numpy as np
from shapely.geometry import Polygon, box

from minicity.curves import Array, unit
from minicity.roads import Road
from minicity.scene_map import (
    Marking,
    SceneMap,
    Surface,
    dashed_line,
    double_line,
    solid_line,
    zebra,
)
from minicity.town import Carpark, Town, road_surface

ASPHALT_GREY = 82  # grey level of asphalt of tone 1; a tone is a factor of the brightness
EDGE_LINE_M = 0.12  # width of edge lines and of the lines between parking bays


def make_scene_map(town: Town, bounds: tuple[float, float, float, float]) -> SceneMap:
    """Lay out the ground of a part of a town.

    Args:
        town: The town.
        bounds: xmin, ymin, xmax, ymax of the part in metres; objects that touch it are included.

    Returns:
        Flat ground with surfaces, kerbs and paint.
    """
    window = box(*bounds)
    scene = SceneMap()
    for walkway in town.walkways:
        if walkway.intersects(window):
            scene.surfaces.append(Surface(walkway, "walkway"))
    for road in town.roads:
        outline = Polygon(road.band(road.section.right_m, road.section.left_m))
        # The outline may cross itself in a sharp bend, which `buffer(0)` repairs.
        if outline.buffer(0).intersects(window):
            _add_road(scene, road)
    for junction in town.junctions:
        outline = Polygon(junction.outline)
        if outline.intersects(window):
            # `arms` are pairs: index of a road, and whether it starts here.
            grey = np.mean([town.roads[r].style.asphalt for r, _ in junction.arms])
            tone = float(grey / ASPHALT_GREY)
            scene.surfaces.append(Surface(outline, "asphalt", tone=tone))
            scene.kerbs += junction.corners
    for park in town.carparks:
        if Polygon(park.outline).intersects(window):
            _add_carpark(scene, park)
    return scene


def _add_carpark(scene: SceneMap, park: Carpark) -> None:
    """Add the surfaces and bay lines of a car park, in place."""
    scene.surfaces.append(Surface(Polygon(park.outline), "carpark"))
    scene.surfaces.append(Surface(Polygon(park.driveway), "carpark"))
    lines = []
    for bay in park.bays:
        lines += solid_line(bay, EDGE_LINE_M)
    scene.markings.append(Marking(lines, paint="white", wear=0.25))


def _add_road(scene: SceneMap, road: Road) -> None:
    """Add the surfaces, kerbs and paint of a road, in place."""
    section = road.section
    tone = road.style.asphalt / ASPHALT_GREY
    for polygon in road_surface(road):
        scene.surfaces.append(Surface(polygon, "asphalt", tone=tone))
    scene.kerbs.append(road.line(section.right_m))
    scene.kerbs.append(road.line(section.left_m))
    if section.median_m > 0:
        ring = road.band(section.forward_edges[0], section.backward_edges[0])
        scene.surfaces.append(Surface(Polygon(ring), "median"))
        # The outline does not repeat its first point, but the kerb is a closed line.
        scene.kerbs.append(np.concatenate([ring, ring[:1]]))
    scene.markings += road_markings(road)


def divider_pieces(road: Road) -> list[tuple[float, float]]:
    """Arc lengths (start, end) of the pieces of divider paint, in metres.

    Crossings within the painted part of the road interrupt the paint, from 0.4 m before to 0.4 m
    after the crossing.
    """
    pieces = []
    start = road.clear_start_m
    for crossing_start, crossing_end in sorted(road.crossings):
        if crossing_start > road.clear_start_m and crossing_end < road.clear_end_m:
            pieces.append((start, crossing_start - 0.4))
            start = crossing_end + 0.4
    pieces.append((start, road.clear_end_m))
    return pieces


def lane_divider_offsets(road: Road) -> list[float]:
    """Offsets in metres of the lines between lanes of equal direction, without the outer edges."""
    return [*road.forward_edges[1:-1], *road.backward_edges[1:-1]]


def divider_offsets(road: Road) -> list[float]:
    """Offsets in metres of all lines of divider paint, the centre line first."""
    # The centre line has the offset 0, to which the shift of painted lines is added.
    center_offsets = [road.shift_m] if road.has_center_line else []
    return [*center_offsets, *lane_divider_offsets(road)]


def road_markings(road: Road) -> list[Marking]:
    """Paint of a road: the white markings, then the yellow ones if there are any."""
    style = road.style
    dash_m, gap_m = style.dash_m  # painted and bare length of a dashed line
    white: list[Array] = []
    yellow: list[Array] = []
    for start, end in divider_pieces(road):
        for offset in lane_divider_offsets(road):
            line = road.line(offset, start, end_m=end)
            white += dashed_line(line, style.line_m, dash_m=dash_m, gap_m=gap_m)
        if road.has_center_line:
            paint = _center_paint(road.line(road.shift_m, start, end_m=end), road)
            if style.divider.endswith("white"):
                white += paint
            else:
                yellow += paint
        if style.edge_line:
            white += _edge_lines(road, start, end)
    for start, end in road.crossings:
        white += _crossing_paint(road, start, end)
    white += _stop_paint(road)
    white += _arrows(road)
    markings = [Marking(white, paint="white", wear=style.wear)]
    if yellow:
        markings.append(Marking(yellow, paint="yellow", wear=style.wear))
    return markings


def _center_paint(center: Array, road: Road) -> list[Array]:
    """Painted areas of a centre line (n, 2) in the style of a road. Each (m, 2)

    The styles are ``double_yellow``, ``dashed_white``, and ``yellow`` or ``white`` (solid lines).
    """
    style = road.style
    if style.divider == "double_yellow":
        return double_line(center, style.line_m * 0.8, gap_m=0.12)
    if style.divider == "dashed_white":
        dash_m, gap_m = style.dash_m
        return dashed_line(center, style.line_m, dash_m=dash_m, gap_m=gap_m)
    return solid_line(center, style.line_m)


def _edge_lines(road: Road, start: float, end: float) -> list[Array]:
    """Painted areas of the lines beside wide shoulders, between two arc lengths. Each (n, 2)"""
    section = road.section
    outlines = []
    if section.right_shoulder_m > 0.5:
        right = road.line(section.forward_edges[-1], start, end_m=end)
        outlines += solid_line(right, EDGE_LINE_M)
    if section.left_shoulder_m > 0.5:
        left = road.line(section.backward_edges[-1], start, end_m=end)
        outlines += solid_line(left, EDGE_LINE_M)
    return outlines


def _crossing_paint(road: Road, start: float, end: float) -> list[Array]:
    """Painted areas of a crossing between two arc lengths. Each (n, 2)

    The paint is a row of stripes (``zebra``), or a line along each side (``ladder``).
    """
    outlines = []
    # Offsets of the right and the left edge of each surface: two surfaces beside a median.
    for right, left in road.carriageways():
        # The paint ends 0.15 m before these edges.
        offsets = np.linspace(right + 0.15, left - 0.15, num=6).tolist()
        near_side = np.stack([road.point(start, offset) for offset in offsets])
        far_side = np.stack([road.point(end, offset) for offset in offsets])
        if road.style.crossing == "zebra":
            outlines += zebra(near_side, far_side)
        else:
            outlines += solid_line(near_side, 0.3)
            outlines += solid_line(far_side, 0.3)
    return outlines


def _stop_paint(road: Road) -> list[Array]:
    """Painted areas of the stop lines of a road. Each (n, 2)

    A stop line covers the lanes of its direction up to 0.1 m from the centre.
    """
    outlines = []
    if road.stop_forward:
        start, end = road.stop_forward
        right = road.forward_edges[-1]
        left = road.forward_edges[0] - 0.1
        outlines.append(road.band(right, left, start_m=start, end_m=end))
    if road.stop_backward:
        start, end = road.stop_backward
        right = road.backward_edges[0] + 0.1
        left = road.backward_edges[-1]
        outlines.append(road.band(right, left, start_m=start, end_m=end))
    return outlines


# Outline of an arrow: metres forward, metres to the left.
_ARROW = np.array(
    [[0, -0.1], [1.6, -0.1], [1.6, -0.35], [2.8, 0], [1.6, 0.35], [1.6, 0.1], [0, 0.1]]
)


def _arrows(road: Road) -> list[Array]:
    """Arrows in the lanes, 7 m before a stop line. Each (7, 2)

    A direction with one lane, and a road shorter than 40 m, have no arrows.
    """
    arrows = []
    for stop, edges, sign in (
        (road.stop_forward, road.forward_edges, 1),
        (road.stop_backward, road.backward_edges, -1),
    ):
        has_several_lanes = len(edges) > 2  # n lanes have n + 1 edges
        if stop is None or not has_several_lanes or road.length_m < 40:
            continue
        # Vehicles reach the start of a forward stop line first, and the end of a backward one.
        arc_m = stop[0] - 7.0 if sign > 0 else stop[1] + 7.0
        forward = unit(road.direction(arc_m)) * sign  # unit vector in the direction of travel
        side = np.array([-forward[1], forward[0]])
        for inner, outer in pairwise(edges):
            base = road.point(arc_m, 0.5 * (inner + outer))
            arrows.append(base + _ARROW[:, :1] * forward + _ARROW[:, 1:] * side)
    return arrows
