"""GeoJSON files of maps (RFC 7946), in longitude and latitude or in metres of the global frame."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import shapely

from drivemaps.geodetic import MapGrid, MapOrigin
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.utils.files import write_text

# Coordinate reference system of longitude and latitude. RFC 7946 allows no other system and has
# therefore dropped the member ``crs``, but programs still read it.
_CRS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}


def write_geojson(
    path: str | Path,
    elements: MapElements,
    classes: Sequence[str],
    origin: MapOrigin | MapGrid | None,
) -> None:
    """Write a map as GeoJSON: areas as polygons, other elements as line strings.

    Args:
        path: File to write.
        elements: Map in the global frame, in metres. The property ``score`` of an element without a
            score is 1.
        classes: Class names in label order.
        origin: Position of the global frame on the Earth: the latitude and longitude of its origin
            (`MapOrigin`), or the grid, such as UTM, of its coordinates (`MapGrid`). With None,
            coordinates are metres of the global frame, and the file has no coordinate reference
            system (``"crs": null``).

    Raises:
        RuntimeError: If an origin is given and ``pyproj`` is missing.
    """
    features = []
    for line, label, score in elements.rows:
        features.append((line, {"class": classes[label], "score": round(score, 4)}))
    write_features(path, features, origin=origin)


def write_features(
    path: str | Path,
    features: Sequence[tuple[FloatArray, dict[str, Any]]],
    origin: MapOrigin | MapGrid | None,
) -> None:
    """Write lines and rings with properties as GeoJSON.

    Args:
        path: File to write.
        features: Vertices in metres in the global frame, (n, >= 2), and properties of each element.
            The property ``class`` is required. Closed elements of area classes become polygons.
        origin: Position of the global frame on the Earth, or None for metres, as in
            `write_geojson`.

    Raises:
        RuntimeError: If an origin is given and ``pyproj`` is missing.
    """
    entries = []
    for line, properties in features:
        if origin is None:
            points = line.round(4).tolist()  # a tenth of a millimetre
        else:
            # Longitude and latitude in degrees; 1e-9 degrees are a tenth of a millimetre.
            points = origin.lon_lat(line).round(9).tolist()
        is_area = properties["class"] in AREA_CLASSES and points[0] == points[-1]
        if is_area and not shapely.is_ccw(shapely.LineString(line)):
            points.reverse()  # RFC 7946 asks for anticlockwise outer rings
        # GeoJSON stores a polygon as a list of rings: the outer ring, then its holes.
        geometry = {
            "type": "Polygon" if is_area else "LineString",
            "coordinates": [points] if is_area else points,
        }
        entries.append({"type": "Feature", "properties": properties, "geometry": geometry})
    crs = None if origin is None else _CRS84
    # `tools/build_map.py` recognises its files by the word "gsmap" near their beginning.
    collection: dict[str, Any] = {"type": "FeatureCollection", "generator": "gsmap", "crs": crs}
    if origin is None:
        collection["frame"] = "global frame of the poses, metres"
    collection["features"] = entries
    write_text(path, json.dumps(collection, indent=1, allow_nan=False) + "\n")
