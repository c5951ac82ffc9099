"""A map as GeoJSON (RFC 7946): in longitude and latitude, or in metres of the global frame."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import shapely

from drivemaps.geodetic import MapGrid, MapOrigin
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import MapElements
from gsmap.utils.files import write_text

# longitude, latitude; programs read the member of the first GeoJSON, RFC 7946 has no other system
_CRS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}


def write_geojson(
    path: str | Path,
    elements: MapElements,
    classes: Sequence[str],
    origin: MapOrigin | MapGrid | None,
) -> None:
    """Write a map: areas as polygons, all else as line strings.

    Args:
        path: File to write.
        elements: The map in the global frame.
        classes: Names of the classes.
        origin: Where the global frame lies; without one, coordinates are metres of that frame, and
            the file says that it has no coordinate reference system (``"crs": null``).

    Raises:
        RuntimeError: If an origin is given and ``pyproj`` is missing.
    """
    features = []
    for line, label, score in elements.rows:
        name = classes[label]
        digits = 4 if origin is None else 9  # a tenth of a millimetre
        points = (line if origin is None else origin.lon_lat(line)).round(digits).tolist()
        area = name in AREA_CLASSES and points[0] == points[-1]
        clockwise = area and not shapely.is_ccw(shapely.LineString(line))
        features.append(
            {
                "type": "Feature",
                "properties": {"class": name, "score": round(score, 4)},
                "geometry": {
                    "type": "Polygon" if area else "LineString",
                    "coordinates": [points[:: -1 if clockwise else 1]] if area else points,
                },
            }
        )
    collection: dict[str, Any] = {"type": "FeatureCollection", "crs": _CRS84 if origin else None}
    if origin is None:
        collection["frame"] = "global frame of the poses, metres"
    collection["features"] = features
    write_text(path, json.dumps(collection, indent=1, allow_nan=False) + "\n")
