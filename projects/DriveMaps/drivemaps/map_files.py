"""Reading of map files, in the format that belongs to their suffix."""

from collections.abc import Sequence
from pathlib import Path

from drivemaps.geodetic import MapGrid, MapOrigin
from drivemaps.geojson_reading import read_geojson
from drivemaps.lanelet2_reading import read_lanelet2
from drivemaps.map_reading import ClassRule, MapFile
from gsmap.utils.errors import InputError

# Reader of each suffix. All readers have the arguments of `read_map`.
_READERS = {
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".osm": read_lanelet2,
    ".xml": read_lanelet2,
}


def read_map(
    path: str | Path,
    classes: Sequence[str],
    origin: MapOrigin | MapGrid | None = None,
    rule: ClassRule | None = None,
) -> MapFile:
    """Read a GeoJSON or Lanelet2 map that this or another program has written.

    Args:
        path: File, which may be untrusted: ``.geojson``, ``.json``, ``.osm`` or ``.xml``.
        classes: Class names in label order.
        origin: Position of the global frame on the Earth, for maps in degrees.
        rule: Property or tag that gives an element its class. The default is described in
            `read_geojson` and `read_lanelet2`.

    Returns:
        Elements in metres in the global frame, and the number of elements that are not used, by
        the reason.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the suffix is not one of the four above, or the file cannot be used.
        RuntimeError: If the map is in degrees and ``pyproj`` is missing.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is no map: its name must end in one of {sorted(_READERS)}.")
    return reader(path, classes, origin=origin, rule=rule)
