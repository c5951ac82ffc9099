"""Repainting of streets of a town: crossings are removed or added, or dividers are moved.

Arc lengths are measured along the centre line of a road. Offsets are distances from this line,
positive to the left.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minicity.config import make_rng
from minicity.curves import Array
from minicity.paint import divider_offsets, divider_pieces
from minicity.roads import Road
from minicity.town import Town, connect_lanes

REMOVED = "removed"
ADDED = "added"
MOVED = "moved"
MOVE_M = 1.0  # distance by which dividers are moved sideways
CROSSING_DEPTH_M = 3.2  # extent of an added crossing along the road
CROSSING_CLEARANCE_M = 4.0  # least gap between an added crossing and a crossing or stop line
SHORTEST_PIECE_M = 0.1  # shorter pieces of a divider between crossings are ignored
Spans = list[tuple[float, float]]  # arc lengths (start, end) in metres


@dataclass(frozen=True)
class Change:
    """Map element of a street before and after it is repainted. Coordinates are in metres.

    Attributes:
        street: Index of the road.
        kind: ``removed``, ``added`` or ``moved``.
        class_name: ``ped_crossing`` or ``divider``.
        before: Line, or closed outline of a crossing; None for an added element. (n, 2)
        after: Line or outline; None for a removed element. (n, 2)
    """

    street: int
    kind: str
    class_name: str
    before: Array | None = None
    after: Array | None = None

    def feature(self, map_name: str) -> dict[str, Any]:
        """Create the GeoJSON feature of the change. A moved element has its new position.

        Args:
            map_name: Name of the town, in whose global frame the coordinates are.
        """
        properties: dict[str, Any] = {
            "change": self.kind,
            "class": self.class_name,
            "map": map_name,
            "street": self.street,
        }
        if self.kind == MOVED:
            assert self.before is not None
            properties["moved_m"] = MOVE_M
            properties["old"] = self.before.round(4).tolist()
        points = self.before if self.after is None else self.after
        assert points is not None
        coordinates = points.round(4).tolist()
        if self.class_name == "ped_crossing":
            geometry = {"type": "Polygon", "coordinates": [coordinates]}
        else:
            geometry = {"type": "LineString", "coordinates": coordinates}
        return {"type": "Feature", "properties": properties, "geometry": geometry}


def changes_geojson(changes_by_map: dict[str, list[Change]]) -> dict[str, Any]:
    """Content of a GeoJSON file of changes, in metres in the global frames of the towns.

    Args:
        changes_by_map: Changes by the name of the town.
    """
    features = []
    for map_name, changes in changes_by_map.items():
        features += [change.feature(map_name) for change in changes]
    return {
        "type": "FeatureCollection",
        "crs": None,
        "frame": "global frame of the poses, metres",
        "features": features,
    }


def repaint_town(town: Town, seed: int, share: float) -> tuple[Town, list[Change]]:
    """Repaint a share of the streets of a town. Equal arguments give equal results.

    Args:
        town: The town, which is not changed.
        seed: Seed of the data set.
        share: Share of the streets, in [0, 1]. Fewer streets are repainted if the others offer no
            way to change them.

    Returns:
        The repainted town, in which only roads, lanes and connectors are new, and all changes.
    """
    roads = list(town.roads)
    changes: list[Change] = []
    num_wanted = round(share * len(roads))
    # The state of a generator depends only on these arguments. So the changes of a street do not
    # depend on the share.
    order = make_rng(seed, town.name, "repainted streets").permutation(len(roads))
    num_repainted = 0
    for index in order.tolist():
        if num_repainted == num_wanted:
            break
        rng = make_rng(seed, town.name, "repaint", index)
        repainted = _repaint_road(roads[index], rng)
        if repainted is None:
            continue
        changes += list_changes(roads[index], repainted)
        roads[index] = repainted
        num_repainted += 1
    # Lanes, and their connectors across junctions, follow the shifted lines.
    lanes, connectors = connect_lanes(roads, town.junctions)
    return replace(town, roads=roads, lanes=lanes, connectors=connectors), changes


def _repaint_road(road: Road, rng: np.random.Generator) -> Road | None:
    """Repaint a road in one of the possible ways, chosen at random; None if no way is possible."""
    middle_m = float(rng.uniform(low=0.35, high=0.65)) * road.length_m
    new_crossing = (middle_m - CROSSING_DEPTH_M / 2, middle_m + CROSSING_DEPTH_M / 2)
    kinds = []  # possible ways
    if road.crossings:
        kinds.append(REMOVED)
    if _has_room(road, new_crossing):
        kinds.append(ADDED)
    if divider_offsets(road):  # the road has dividers
        kinds.append(MOVED)
    if not kinds:
        return None
    kind = kinds[int(rng.integers(len(kinds)))]
    if kind == REMOVED:
        crossings = list(road.crossings)
        crossings.pop(int(rng.integers(len(crossings))))
        return replace(road, crossings=crossings)
    if kind == ADDED:
        return replace(road, crossings=[*road.crossings, new_crossing])
    # Lines are shifted towards the wider shoulder, where there is room; a shift > 0 is to the left.
    has_room_left = road.section.left_shoulder_m > road.section.right_shoulder_m
    return replace(road, shift_m=MOVE_M if has_room_left else -MOVE_M)


def _has_room(road: Road, new_crossing: tuple[float, float]) -> bool:
    """Whether a new crossing keeps its clearance from the end of the paint and other crossings.

    Args:
        road: The road.
        new_crossing: Arc lengths in metres between which the new crossing is.
    """
    start = new_crossing[0] - CROSSING_CLEARANCE_M
    end = new_crossing[1] + CROSSING_CLEARANCE_M
    if start < road.clear_start_m or end > road.clear_end_m:
        return False
    return all(other_end < start or other_start > end for other_start, other_end in road.crossings)


def list_changes(before: Road, after: Road) -> list[Change]:
    """List every map element in which two paintings of a road differ.

    Args:
        before: Road with the earlier paint.
        after: Road with the later paint.

    Returns:
        Changes of crossings, one for each carriageway, then changes of dividers.
    """
    changes = []
    for kind, crossings, others in (
        (REMOVED, before.crossings, after.crossings),
        (ADDED, after.crossings, before.crossings),
    ):
        for start, end in crossings:
            if (start, end) in others:
                continue
            # Offsets of both sides of each carriageway; a road with a median has two.
            for right, left in before.carriageways():
                outline = before.band(right, left, start_m=start, end_m=end)
                # The outline is closed by its first point.
                ring = np.concatenate([outline, outline[:1]])
                changes.append(_change(before.index, kind, class_name="ped_crossing", points=ring))
    if before.shift_m != after.shift_m:
        return changes + _moved_dividers(before, after)
    # A new crossing interrupts the dividers, and a removed one no longer does. The pieces are the
    # arc lengths (start, end) of the divider paint between crossings.
    pieces_before = divider_pieces(before)
    pieces_after = divider_pieces(after)
    for kind, pieces in (
        (REMOVED, _subtract(pieces_before, pieces_after)),
        (ADDED, _subtract(pieces_after, pieces_before)),
    ):
        for start, end in pieces:
            for offset in divider_offsets(before):
                line = before.line(offset, start, end_m=end)
                changes.append(_change(before.index, kind, class_name="divider", points=line))
    return changes


def _moved_dividers(before: Road, after: Road) -> list[Change]:
    """Changes of all dividers of a road whose lanes are shifted."""
    changes = []
    offsets = zip(divider_offsets(before), divider_offsets(after), strict=True)
    for offset_before, offset_after in offsets:
        for start, end in divider_pieces(before):
            change = Change(
                street=before.index,
                kind=MOVED,
                class_name="divider",
                before=before.line(offset_before, start, end_m=end),
                after=after.line(offset_after, start, end_m=end),
            )
            changes.append(change)
    return changes


def _change(street: int, kind: str, class_name: str, points: Array) -> Change:
    """Change of an element that is removed or added."""
    if kind == REMOVED:
        return Change(street, kind, class_name, before=points)
    return Change(street, kind, class_name, after=points)


def _subtract(spans: Spans, others: Spans) -> Spans:
    """Parts of spans (start, end) that no span of ``others`` covers."""
    parts = spans
    for other_start, other_end in others:  # each cuts the parts that the previous ones have left
        remaining = []
        for start, end in parts:
            # The parts before and after the other span; they may have a negative length.
            remaining.append((start, min(end, other_start)))
            remaining.append((max(start, other_end), end))
        parts = [(start, end) for start, end in remaining if end - start > SHORTEST_PIECE_M]
    return parts
