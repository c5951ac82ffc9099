"""A town as the renderer sees it: what its map says, laid out as surfaces, kerbs and paint."""

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
from minicity.town import Town, road_surface


def make_scene_map(town: Town, bounds: tuple[float, float, float, float]) -> SceneMap:
    """The surfaces, kerbs and paint of a town inside ``bounds`` (xmin, ymin, xmax, ymax)."""
    window = box(*bounds)
    scene = SceneMap()
    scene.surfaces += [Surface(p, "walkway") for p in town.walkways if p.intersects(window)]
    for road in town.roads:
        if (
            Polygon(road.band(road.section.right_m, road.section.left_m))
            .buffer(0)
            .intersects(window)
        ):
            _add_road(scene, road)
    for junction in town.junctions:
        outline = Polygon(junction.outline)
        if outline.intersects(window):
            tone = np.mean([town.roads[r].style.asphalt for r, _ in junction.arms]) / 82
            scene.surfaces.append(Surface(outline, "asphalt", float(tone)))
            scene.kerbs += junction.corners
    for park in town.carparks:
        if Polygon(park.outline).intersects(window):
            scene.surfaces += [
                Surface(Polygon(p), "carpark") for p in (park.outline, park.driveway)
            ]
            scene.markings.append(
                Marking([s for bay in park.bays for s in solid_line(bay, 0.12)], "white", 0.25)
            )
    return scene


def _add_road(scene: SceneMap, road: Road) -> None:
    section = road.section
    scene.surfaces += [Surface(p, "asphalt", road.style.asphalt / 82) for p in road_surface(road)]
    scene.kerbs += [road.line(section.right_m), road.line(section.left_m)]
    if section.median_m > 0:
        inner, outer = section.forward_edges[0], section.backward_edges[0]
        scene.surfaces.append(Surface(Polygon(road.band(inner, outer)), "median"))
        ring = road.band(inner, outer)
        scene.kerbs.append(np.concatenate([ring, ring[:1]]))
    scene.markings += road_markings(road)


def divider_pieces(road: Road) -> list[tuple[float, float]]:
    """Arc lengths between which divider paint runs: it breaks at crossings in mid-block."""
    pieces, start = [], road.clear_start_m
    for a, b in sorted(road.crossings):
        if a > road.clear_start_m and b < road.clear_end_m:
            pieces.append((start, a - 0.4))
            start = b + 0.4
    return [*pieces, (start, road.clear_end_m)]


def lane_divider_offsets(road: Road) -> list[float]:
    """Offsets of the lines between lanes of one direction."""
    return [*road.section.forward_edges[1:-1], *road.section.backward_edges[1:-1]]


def has_center_line(road: Road) -> bool:
    """Whether paint, not a median, parts the two directions."""
    return road.section.median_m == 0 and road.section.backward > 0


def road_markings(road: Road) -> list[Marking]:
    """All paint on a road."""
    style = road.style
    white: list[Array] = []
    yellow: list[Array] = []
    for start, end in divider_pieces(road):
        for at in lane_divider_offsets(road):
            white += dashed_line(road.line(at, start, end), style.line_m, *style.dash_m)
        if has_center_line(road):
            center = road.line(0.0, start, end)
            (white if style.divider.endswith("white") else yellow).extend(
                _center_paint(center, road)
            )
        if style.edge_line:
            white += _edge_lines(road, start, end)
    for a, b in road.crossings:
        white += _crossing_paint(road, a, b)
    white += _stop_paint(road)
    white += _arrows(road)
    found = [Marking(white, "white", style.wear)]
    return [*found, Marking(yellow, "yellow", style.wear)] if yellow else found


def _center_paint(center: Array, road: Road) -> list[Array]:
    style = road.style
    if style.divider == "double_yellow":
        return double_line(center, style.line_m * 0.8, 0.12)
    if style.divider == "dashed_white":
        return dashed_line(center, style.line_m, *style.dash_m)
    return solid_line(center, style.line_m)


def _edge_lines(road: Road, start: float, end: float) -> list[Array]:
    section, painted = road.section, []
    if section.right_shoulder_m > 0.5:
        painted += solid_line(road.line(section.forward_edges[-1], start, end), 0.12)
    if section.left_shoulder_m > 0.5:
        painted += solid_line(road.line(section.backward_edges[-1], start, end), 0.12)
    return painted


def _crossing_paint(road: Road, start: float, end: float) -> list[Array]:
    painted = []
    for right, left in road.carriageways():
        offsets = np.linspace(right + 0.15, left - 0.15, 6)
        sides = [np.stack([road.point(at, float(o)) for o in offsets]) for at in (start, end)]
        if road.style.crossing == "zebra":
            painted += zebra(sides[0], sides[1])
        else:
            painted += [piece for side in sides for piece in solid_line(side, 0.3)]
    return painted


def _stop_paint(road: Road) -> list[Array]:
    section, painted = road.section, []
    if road.stop_forward:
        painted.append(
            road.band(section.forward_edges[-1], section.forward_edges[0] - 0.1, *road.stop_forward)
        )
    if road.stop_backward:
        painted.append(
            road.band(
                section.backward_edges[0] + 0.1, section.backward_edges[-1], *road.stop_backward
            )
        )
    return painted


_ARROW = np.array(
    [[0, -0.1], [1.6, -0.1], [1.6, -0.35], [2.8, 0], [1.6, 0.35], [1.6, 0.1], [0, 0.1]]
)


def _arrows(road: Road) -> list[Array]:
    """Arrows in the lanes that lead to a stop line, where there are several."""
    painted = []
    for stop, edges, sign in (
        (road.stop_forward, road.section.forward_edges, 1),
        (road.stop_backward, road.section.backward_edges, -1),
    ):
        if stop is None or len(edges) < 3 or road.length_m < 40:
            continue
        at = stop[0] - 7.0 if sign > 0 else stop[1] + 7.0
        forward = unit(road.direction(at)) * sign
        side = np.array([-forward[1], forward[0]])
        for inner, outer in pairwise(edges):
            base = road.point(at, 0.5 * (inner + outer))
            painted.append(base + _ARROW[:, :1] * forward + _ARROW[:, 1:] * side)
    return painted
