"""GeoJSON files of changes of a map: elements that are removed, added or moved."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.structures.elements import FARTHEST_M, FloatArray
from gsmap.structures.polylines import arc_lengths, points_at_steps
from gsmap.utils.errors import InputError
from gsmap.utils.json_items import items_of

KINDS = ("removed", "added", "moved")
"""Kinds of changes."""
STEP_M = 0.5
"""Distance in metres of the points at which changes are compared."""
# Limits of the values of a file, which may be untrusted.
_LONGEST_M = 1e6  # largest sum of the lengths of all changes of a file
_LONGEST_NAME = 80  # letters
# Value of a key that the file does not contain. It cannot be None, which is the value of a present
# key with ``null``.
_ABSENT = "absent"


@dataclass(frozen=True, eq=False)
class MapChange:
    """Change of a map element, or of a part of a line.

    Attributes:
        kind: One of `KINDS`.
        class_name: Class of the element.
        map_name: Name of the map, in whose global frame the points are; empty if unknown.
        points: Vertices in metres, closed for areas: the old place of a removed element, or the new
            place of an added or moved element. (n, 2)
        old_points: Vertices of the old place of a moved element, or None if unknown. (m, 2)
        confidence: Confidence in [0, 1].
        moved_m: Distance in metres by which an element has moved, or None if unknown.
        moved_std_m: Standard error of this distance in metres, or None if unknown.
        passes: Number of drives that confirm the change, and number of drives that had the place in
            view; None if unknown.
    """

    kind: str
    class_name: str
    map_name: str
    points: FloatArray
    old_points: FloatArray | None
    confidence: float
    moved_m: float | None = None
    moved_std_m: float | None = None
    passes: tuple[int, int] | None = None

    def samples(self) -> FloatArray:
        """Points at equal steps along the change. (M, 2)"""
        return points_at_steps(self.points, STEP_M)


def read_changes(path: str | Path) -> list[MapChange]:
    """Read a file of changes, written by ``build_map --changes`` or by MiniCity.

    A feature is a line, or a polygon whose outer ring is used. Its properties are ``change`` (one
    of `KINDS`) and ``class``. Optional properties are ``map``, ``confidence``, ``old`` (vertices of
    the old place), ``moved_m`` and ``moved_std_m``. `MapChange.passes` is read from the optional
    properties ``passes_seen`` (``passes_not_seen`` for a removed element) and ``passes_in_view``.

    Args:
        path: File, which may be untrusted. Coordinates are metres of the global frame
            (``"crs": null``).

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is malformed, or a value is out of range.
    """
    path = Path(path)
    members: dict[str, Any] = {"crs": _ABSENT}  # `items_of` replaces the value by the file's value
    advice = "give a GeoJSON file of changes (build_map.py --changes, or MiniCity's)"
    changes = []
    total_m = 0.0
    # Each item comes with its place in the file, which is not used here. The file is read step by
    # step, so the value of "crs" is only known after the loop.
    for number, (feature, _) in enumerate(
        items_of(path, "features", advice, other_entries=members)
    ):
        try:
            change = _read_feature(feature)
            for points in (change.points, change.old_points):
                if points is not None:
                    total_m += arc_lengths(points)[-1]
            if total_m > _LONGEST_M:
                raise InputError(f"the changes are longer than {_LONGEST_M / 1000:g} km")
        except InputError as error:
            text = str(error).rstrip(".")  # some messages end with a full stop
            raise InputError(f"{path}, feature {number}: {text}.") from error
        changes.append(change)
    if members["crs"] is not None:
        raise InputError(
            f"{path} has no coordinates in metres of the global frame: give the file of changes "
            'with "crs": null.'
        )
    return changes


def _read_feature(feature: Any) -> MapChange:
    """Read a feature of a file of changes. Errors quote at most 60 letters of a wrong value."""
    if not isinstance(feature, dict) or not isinstance(feature.get("properties"), dict):
        raise InputError("it is no object with properties")
    properties = feature["properties"]
    kind = properties.get("change")
    if kind not in KINDS:
        raise InputError(f"`change` must be one of {', '.join(KINDS)}, got {kind!r:.60}")
    confidence = properties.get("confidence", 1.0)
    if not _is_number(confidence) or not 0 <= confidence <= 1:
        raise InputError(f"`confidence` must be a number in [0, 1], got {confidence!r:.60}")
    old_points = None
    if kind == "moved" and "old" in properties:
        old_points = _read_points(properties["old"])
    # A drive that does not detect an element confirms that it is removed.
    count_key = "passes_not_seen" if kind == "removed" else "passes_seen"
    return MapChange(
        kind=kind,
        class_name=_read_name(properties, "class"),
        map_name=_read_name(properties, "map") if "map" in properties else "",
        points=_read_geometry(feature.get("geometry")),
        old_points=old_points,
        confidence=float(confidence),
        moved_m=_read_amount(properties, "moved_m"),
        moved_std_m=_read_amount(properties, "moved_std_m"),
        passes=_read_passes(properties, count_key),
    )


def _read_amount(properties: Mapping[str, Any], key: str) -> float | None:
    """Read a number of at least 0; None if the key is missing."""
    value = properties.get(key)
    if value is None:
        return None
    if not _is_in_range(value) or value < 0:
        raise InputError(f"`{key}` must be a number of at least 0, got {value!r:.60}")
    return float(value)


def _read_passes(properties: Mapping[str, Any], key: str) -> tuple[int, int] | None:
    """Read both numbers of `MapChange.passes`, the first from ``key``; None if one is missing."""
    count = _read_amount(properties, key)
    in_view = _read_amount(properties, "passes_in_view")
    if count is None or in_view is None:
        return None
    return int(count), int(in_view)


def _read_name(properties: Mapping[str, Any], key: str) -> str:
    """Read a printable name of moderate length."""
    name = properties.get(key)
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= _LONGEST_NAME:
        raise InputError(f"`{key}` must be a printable name of at most {_LONGEST_NAME} letters")
    return name


def _read_geometry(geometry: Any) -> FloatArray:
    """Read a line, or the outer ring of a polygon. (n, 2)"""
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind == "LineString":
        return _read_points(geometry.get("coordinates"))
    if kind != "Polygon":
        raise InputError(f"its geometry must be a LineString or a Polygon, got {kind!r:.60}")
    rings = geometry.get("coordinates")
    if not isinstance(rings, list) or not rings:
        raise InputError("its polygon has no ring")
    ring = _read_points(rings[0])
    if len(ring) < 4 or not np.array_equal(ring[0], ring[-1]):
        raise InputError("the ring of its polygon is not closed")
    return ring


def _read_points(positions: Any) -> FloatArray:
    """Read two or more positions without their heights. (n, 2)"""
    if not isinstance(positions, list) or len(positions) < 2:
        raise InputError("its coordinates are no list of two or more positions")
    points = []
    for position in positions:
        if not isinstance(position, list) or len(position) < 2:
            raise InputError("a position has fewer than two coordinates")
        if not _is_in_range(position[0]) or not _is_in_range(position[1]):
            raise InputError(
                f"coordinates must be metres within {FARTHEST_M:g} m, got {position!r:.60}"
            )
        points.append((float(position[0]), float(position[1])))
    return np.array(points, dtype=np.float64)


def _is_number(value: Any) -> bool:
    """Whether a value is a number and not a boolean."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_in_range(value: Any) -> bool:
    """Whether a value is a number within ``FARTHEST_M``, so finite."""
    return _is_number(value) and abs(value) <= FARTHEST_M  # false for NaN
