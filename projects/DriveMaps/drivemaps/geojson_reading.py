"""Reading of GeoJSON maps, written by `write_geojson` or by other programs."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.map_reading import (
    CLASS_KEY,
    ClassRule,
    ElementCollector,
    MapFile,
    finite_number,
    score_of,
)
from gsmap.structures.elements import FloatArray
from gsmap.utils.errors import InputError
from gsmap.utils.json_items import items_of

_ADVICE = "give a GeoJSON FeatureCollection"
_KINDS = ("LineString", "MultiLineString", "Polygon", "MultiPolygon")
# Marks a file without the member `crs` (coordinate reference system). None cannot mark it, because
# it is the value of a member that is null.
_NO_CRS = "no crs"
# Names of the system of longitude and latitude on the WGS 84 ellipsoid end in one of these.
_DEGREES = ("CRS84", "EPSG:4326", "EPSG::4326")


def read_geojson(
    path: str | Path,
    classes: Sequence[str],
    origin: MapOrigin | MapGrid | None = None,
    rule: ClassRule | None = None,
) -> MapFile:
    """Read a FeatureCollection of lines and polygons.

    A feature is a geometry with properties. Coordinates are longitude and latitude (RFC 7946). With
    ``"crs": null`` they are metres of the global frame. Lines and the outer rings of polygons
    become map elements. A feature can have several lines or polygons. Heights are dropped. Features
    of other kinds are only counted.

    Args:
        path: File, which may be untrusted.
        classes: Class names in label order.
        origin: Position of the global frame on the Earth, for coordinates in degrees.
        rule: Property that gives a feature its class. By default this is ``class``, whose values
            are names of classes.

    Returns:
        Elements in the global frame, and the number of features that are not used.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is malformed or has too many vertices, a number is not finite or out
            of range, coordinates are in another system, degrees have no origin, or the file has
            features but none of them can be used.
        RuntimeError: If coordinates are degrees and ``pyproj`` is missing.
    """
    path = Path(path)
    collector = ElementCollector(path, classes, rule=rule or ClassRule(CLASS_KEY))
    members: dict[str, Any] = {"crs": _NO_CRS}
    # `items_of` reads the features one by one, each with its place in the file. It also sets the
    # members of the file that are keys of `members`. They may follow the features, so `crs` is
    # known only after the loop.
    features = items_of(path, "features", _ADVICE, other_entries=members)
    for number, (feature, _) in enumerate(features):
        try:
            _add_feature(feature, collector)
        except InputError as error:
            text = str(error).rstrip(".")
            raise InputError(f"{path}, feature {number}: {text}.") from error
    collector.unused += Counter()  # drops counts of zero
    crs = members["crs"]
    if crs is None:
        return collector.finish(origin=None)
    _require_degrees(crs, path)
    if origin is None:
        raise InputError(
            f"{path} has longitude and latitude, and the origin of the global frame is not known: "
            'give --origin or --crs; coordinates in metres need the member "crs": null.'
        )
    return collector.finish(origin)


def _require_degrees(crs: Any, path: Path) -> None:
    """Require that the coordinate system of a file is longitude and latitude, if it names one.

    Raises:
        ValueError: If the file names another system.
    """
    if crs == _NO_CRS:
        return
    name = None
    # The member has the form {"type": "name", "properties": {"name": ...}}.
    if isinstance(crs, dict) and isinstance(crs.get("properties"), dict):
        name = crs["properties"].get("name")
    if not isinstance(name, str) or not name.upper().endswith(_DEGREES):
        raise InputError(
            f"{path} has coordinates of {name!r:.60}: convert them to longitude and latitude, or "
            'to metres of the global frame with "crs": null.'
        )


def _add_feature(feature: Any, collector: ElementCollector) -> None:
    """Add the lines of a feature to the collector, or count the feature as unused.

    Raises:
        ValueError: If the feature is malformed. The message is a clause without file and feature,
            which `read_geojson` adds.
    """
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise InputError("it is no object of type Feature")
    geometry = feature.get("geometry")
    if geometry is None:
        collector.unused["without geometry"] += 1
        return
    if not isinstance(geometry, dict) or not isinstance(geometry.get("type"), str):
        raise InputError("its geometry is no object with a type")
    properties = feature.get("properties")
    if properties is not None and not isinstance(properties, dict):
        raise InputError("its properties are no object")
    kind = geometry["type"]
    if kind not in _KINDS:
        collector.unused[f"geometry {kind[:40]!r}"] += 1
        return
    name = collector.class_of(properties or {})
    if name is None:  # `class_of` has counted the feature as unused
        return
    score = score_of(properties or {})
    coordinates = geometry.get("coordinates")
    shapes = _list_of(coordinates) if kind.startswith("Multi") else [coordinates]
    for shape in shapes:  # coordinates of one line, or of one polygon
        if kind.endswith("Polygon"):
            rings = _list_of(shape)  # the outer ring, then the holes
            collector.add(name, _outer_ring(rings), score=score)
            collector.unused["holes of polygons"] += len(rings) - 1
        else:
            collector.add(name, _line_of(shape), score=score)


def _outer_ring(rings: list[Any]) -> FloatArray:
    """Convert the first ring of a polygon, its outline, to an array. (n, 2)"""
    if not rings:
        raise InputError("its polygon has no ring")
    outer = _line_of(rings[0])
    # A closed triangle has four positions.
    if len(outer) < 4 or not np.array_equal(outer[0], outer[-1]):
        raise InputError("the ring of its polygon is not closed")
    return outer


def _list_of(value: Any) -> list[Any]:
    """Return the value, which must be a list."""
    if not isinstance(value, list):
        raise InputError("its coordinates are nested differently from its type")
    return value


def _line_of(positions: Any) -> FloatArray:
    """Convert positions, lists of two or more coordinates, to an array without heights. (n, 2)"""
    points = []
    for position in _list_of(positions):
        coordinates = _list_of(position)
        if len(coordinates) < 2:
            raise InputError("a position has fewer than two coordinates")
        x = finite_number(coordinates[0])
        y = finite_number(coordinates[1])
        points.append((x, y))
    return np.array(points, dtype=np.float64).reshape(-1, 2)  # the shape (0, 2) without positions
