"""Search for the changes of a place since an old map was made, and a GeoJSON file of them.

The old map is compared with the maps of later drives, which are called passes. A point is in view
of a pass if it is in range in at least five frames of the drive. A pass confirms an element if the
map of its drive has an element of this class there. A change is reported if at least three quarters
of the passes that have it in view agree on it.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivemaps.area_changes import MIN_SHARE_IN_VIEW, area_changes
from drivemaps.change import (
    ADDED,
    KINDS,
    MIN_VIEWS,
    MOVED,
    REMOVED,
    Change,
    Changes,
    Pass,
    on_known_ground,
    views_of_passes,
)
from drivemaps.config import MergeConfig
from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.geojson import write_features
from drivemaps.line_changes import line_changes
from drivemaps.line_matching import sample_line
from drivemaps.truth import polygons_of
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import (
    MAX_TOTAL_LENGTH_M,
    BoolArray,
    FloatArray,
    IntArray,
    MapElements,
)
from gsmap.structures.polylines import arc_lengths
from gsmap.utils.errors import InputError

_MIN_SHARE = 0.75  # share of the passes in view that must agree on a change
# Elements of the old map up to this distance outside of the range of the frames are kept, because
# they show which ground the old map covers.
_MARGIN_M = 60.0


def find_changes(
    old: MapElements, passes: Sequence[Pass], config: MergeConfig | None = None
) -> Changes:
    """Find the elements of a place that were removed, added or moved.

    A change concerns a whole area, a whole line, or a part of a line that is at least 8 m long.

    * Removed: an area or a part of a line of the old map that three quarters
      of the passes in view do not confirm.
    * Added: an area or a part of a line in the map of a pass that the old map does not have. The
      old map has no line of the class within 1.5 m of it, or no area of the class that shares 30
      percent with it. An element of any class of the old map must lie within 30 m, because
      elsewhere the old map may not cover the ground.
    * Moved: a part of a line of the old map beside which the maps of the passes have a line, on one
      side and at a mean distance of at least 0.5 m, or an area of the old map whose centre moved by
      at least 0.75 m, in three or more frames with the whole area in range. The shift must also be
      at least five standard errors.

    Lines of the old map with a score below 0.4 are never reported as removed or moved, but they
    show that a line of a pass is not new. Lines of a pass with a score below 0.6 are never reported
    as added, but they show that a line of the old map is still there.

    The confidence of a removed or moved element is multiplied by its score in the old map, because
    an element that was never there cannot have been removed.

    Args:
        old: Old map in the global frame.
        passes: Drives past the place, one or more, each with its map. All maps must have equal
            classes.
        config: Parameters of merging; ``MergeConfig()`` by default.

    Returns:
        Changes, and the numbers of elements that could not be compared.

    Raises:
        ValueError: If the old map has more than 1,000 km of lines near the drives.
    """
    config = config or MergeConfig()
    passes = list(passes)
    classes = passes[0].drive.classes
    # Changes are searched only near the drives. The whole map is needed to count the elements that
    # no pass has in view.
    whole_map = old
    is_near = _are_near_passes(old, passes)
    old = old.select(is_near)
    changes: list[Change] = []
    for label, name in enumerate(classes):
        find_in_class = area_changes if name in AREA_CLASSES else line_changes
        # Candidates: `num_passes` of the `passes_in_view` passes agree with the change.
        for change in find_in_class(old, passes, label, config):
            if change.num_passes >= _MIN_SHARE * change.passes_in_view:
                changes.append(change)
    # By class, then by kind (removed, added, moved), then the most certain change first.
    changes.sort(key=lambda change: (change.label, KINDS.index(change.kind), -change.confidence))
    num_on_new_ground = _count_on_new_ground(old, passes, classes)
    # Elements of the old map that are far from the passes are not in view.
    is_in_view = np.zeros(len(whole_map), dtype=np.bool_)
    is_in_view[is_near] = _are_in_view(old, passes)
    num_not_in_view = Counter(classes[label] for label in whole_map.labels[~is_in_view])
    num_too_small: Counter[str] = Counter()
    for line, label, _ in whole_map.select(is_in_view).rows:
        name = classes[label]
        if name in AREA_CLASSES and not polygons_of([line[:, :2]]):
            num_too_small[name] += 1
    num_of_absent_classes: Counter[str] = Counter()
    for change in changes:
        if change.kind == ADDED and change.label not in whole_map.labels:
            num_of_absent_classes[classes[change.label]] += 1
    return Changes(
        changes,
        dict(num_on_new_ground),
        num_not_in_view=dict(num_not_in_view),
        num_too_small=dict(num_too_small),
        num_of_absent_classes=dict(num_of_absent_classes),
    )


def _count_on_new_ground(
    old: MapElements, passes: Sequence[Pass], classes: Sequence[str]
) -> Counter[str]:
    """Count the elements of the passes, by class, that lie far from all elements of the old map."""
    counts: Counter[str] = Counter()
    for one_pass in passes:
        elements = one_pass.elements
        points, owners = _sample(elements)
        # Known ground is within 30 m of an element of the old map.
        is_known = np.zeros(len(elements), dtype=np.bool_)
        is_known[owners[on_known_ground(points, old)]] = True
        for label in elements.labels[~is_known]:
            counts[classes[label]] += 1
    return counts


def _sample(elements: MapElements) -> tuple[FloatArray, IntArray]:
    """Sample elements every metre. Returns points (M, 2) and the index of their element (M,)."""
    points = [np.zeros((0, 2))]
    counts = []
    for line in elements.polylines:
        samples = sample_line(line[:, :2])[0] if len(line) else points[0]
        points.append(samples)
        counts.append(len(samples))
    return np.concatenate(points), np.repeat(np.arange(len(elements)), counts)


def _are_in_view(elements: MapElements, passes: list[Pass]) -> BoolArray:
    """Whether any pass has each line in part, or each area to at least 80 percent in view. (N,)"""
    points, owners = _sample(elements)
    num_elements = len(elements)
    num_points = np.bincount(owners, minlength=num_elements)
    share = np.zeros(num_elements)  # part of each element that is in view, in the best pass
    for views in views_of_passes(points, passes):
        num_in_view = np.bincount(owners, views >= MIN_VIEWS, minlength=num_elements)
        share = np.maximum(share, num_in_view / np.maximum(num_points, 1))
    is_area = np.array([name in AREA_CLASSES for name in passes[0].drive.classes])
    return np.where(is_area[elements.labels], share >= MIN_SHARE_IN_VIEW, share > 0.0)


def _are_near_passes(old: MapElements, passes: Sequence[Pass]) -> BoolArray:
    """Whether the bounding box of each element of an old map is near the drives. (N,)

    Raises:
        ValueError: If the total length of their lines is too large. The lines are later sampled
            every metre, so time and memory grow with the length.
    """
    origins = []
    reach_m = 0.0  # largest distance from the vehicle to a point of the range of a frame
    for one_pass in passes:
        origins += [frame.origin for frame in one_pass.drive.frames]
        reach_m = max(reach_m, one_pass.drive.reach_m)
    margin_m = _MARGIN_M + reach_m
    low = np.min(origins, axis=0) - margin_m
    high = np.max(origins, axis=0) + margin_m
    is_near = np.zeros(len(old), dtype=np.bool_)
    total_m = 0.0
    for index, line in enumerate(old.polylines):
        if not len(line):
            continue
        points = line[:, :2]
        # The bounding box of the line overlaps the box of the drives if both are true.
        starts_before = bool((points.min(axis=0) <= high).all())
        ends_after = bool((points.max(axis=0) >= low).all())
        if starts_before and ends_after:
            is_near[index] = True
            total_m += float(arc_lengths(points)[-1])
    if total_m > MAX_TOTAL_LENGTH_M:
        raise InputError(
            f"the old map has {total_m / 1000:.0f} km of lines near the drives: at most "
            f"{MAX_TOTAL_LENGTH_M / 1000:g} km are compared; cut it to the place."
        )
    return is_near


def write_changes(
    path: str | Path,
    changes: Sequence[Change],
    classes: Sequence[str],
    place: str,
    origin: MapOrigin | MapGrid | None = None,
) -> None:
    """Write changes to a GeoJSON file, with one feature per change.

    The properties of a feature are ``class``, ``change`` (``removed``, ``added`` or ``moved``),
    ``map``, ``confidence`` and ``passes_in_view``. A removed element also has ``passes_not_seen``,
    the number of passes in view that do not confirm it. An added or moved element has
    ``passes_seen``, the number of passes in view that confirm the change. Moved elements also have
    ``moved_m``, the distance in metres, and its standard error ``moved_std_m``.

    Args:
        path: File to write.
        changes: Changes in the global frame.
        classes: Class names in label order.
        place: Name of the map, the value of the property ``map``.
        origin: Position of the global frame on the Earth, for coordinates in degrees. Without an
            origin, coordinates are metres in the global frame.

    Raises:
        RuntimeError: If an origin is given and ``pyproj`` is missing.
    """
    features = []
    for change in changes:
        count_key = "passes_not_seen" if change.kind == REMOVED else "passes_seen"
        properties: dict[str, Any] = {
            "class": classes[change.label],
            "change": change.kind,
            "map": place,
            "confidence": round(change.confidence, 4),
            "passes_in_view": change.passes_in_view,
            count_key: change.num_passes,
        }
        if change.kind == MOVED and change.moved_m is not None and change.moved_std_m is not None:
            properties["moved_m"] = round(change.moved_m, 4)
            properties["moved_std_m"] = round(change.moved_std_m, 4)
        features.append((change.line, properties))
    write_features(path, features, origin=origin)


def summarize_changes(found: Changes) -> str:
    """Describe the number of changes of each kind, and the number of elements not compared.

    Args:
        found: Changes of a place.

    Returns:
        One line, such as
        ``2 removed, 0 added, 1 moved (not compared: 3 divider on new ground)``. It names the
        classes of which the old map has no element.
    """
    counts = Counter(change.kind for change in found.changes)
    text = ", ".join(f"{counts[kind]} {kind}" for kind in KINDS)
    not_compared = []
    for count_by_class, reason in (
        (found.num_on_new_ground, "on new ground"),
        (found.num_not_in_view, "of the old map not in view"),
        (found.num_too_small, "of the old map below 1 m2"),
    ):
        if not count_by_class:
            continue
        numbers = []
        for name, count in sorted(count_by_class.items()):
            numbers.append(f"{count} {name}")
        not_compared.append(f"{', '.join(numbers)} {reason}")
    if not_compared:
        text += f" (not compared: {'; '.join(not_compared)})"
    for name, count in sorted(found.num_of_absent_classes.items()):
        text += f"; the old map has no {name} at all, so all of its {count} count as added"
    return text
