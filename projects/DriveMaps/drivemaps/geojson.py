"""A map as GeoJSON (RFC 7946): in longitude and latitude, or in metres of the global frame."""

import json
from collections.abc import Sequence
from pathlib import Path

import shapely

from drivemaps.geodetic import MapOrigin
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import MapElements
from gsmap.utils.files import write_text


def write_geojson(
    path: str | Path, elements: MapElements, classes: Sequence[str], origin: MapOrigin | None
) -> None:
    """Write a map: areas as polygons, all else as line strings.

    Args:
        path: File to write.
        elements: The map in the global frame.
        classes: Names of the classes.
        origin: Where the global frame lies; without one, coordinates are metres of that frame,
            which programs other than this one take for degrees unless they are told.

    Raises:
        RuntimeError: If an origin is given and ``pyproj`` is missing.
    """
    features = []
    rows = zip(elements.polylines, elements.labels.tolist(), elements.confidence, strict=True)
    for line, label, score in rows:
        name = classes[label]
        digits = 4 if origin is None else 9  # a tenth of a millimetre
        points = (line if origin is None else origin.lon_lat(line)).round(digits).tolist()
        area = name in AREA_CLASSES and points[0] == points[-1]
        clockwise = area and not shapely.is_ccw(shapely.LineString(line))
        features.append(
            {
                "type": "Feature",
                "properties": {"class": name, "score": round(float(score), 4)},
                "geometry": {
                    "type": "Polygon" if area else "LineString",
                    "coordinates": [points[:: -1 if clockwise else 1]] if area else points,
                },
            }
        )
    collection = {"type": "FeatureCollection", "features": features}
    if origin is None:
        collection["frame"] = "global frame of the poses, metres"
    write_text(path, json.dumps(collection, indent=1) + "\n")
