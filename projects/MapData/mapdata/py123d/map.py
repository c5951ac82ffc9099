"""Maps of py123d, and search for the elements near a point."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from gsmap.datasets.errors import explain_errors
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.polylines import is_closed
from gsmap.utils.errors import InputError
from mapdata.arrow_tables import read_table
from mapdata.local_map import LINE, POLYGON
from mapdata.py123d.log import REMEDY
from mapdata.py123d.packed import unpack

CLASSES = ("divider", "ped_crossing", "boundary", "centerline")
# Numbers of layers in py123d. A layer contains the objects of one kind.
_LANE = 0
_CROSSWALK = 3
_ROAD_EDGE = 8
_ROAD_LINE = 9
_NO_PAINT = 0  # kind of road lines that are not painted
_LAYERS = {
    "divider": _ROAD_LINE,
    "ped_crossing": _CROSSWALK,
    "boundary": _ROAD_EDGE,
    "centerline": _LANE,
}


class Map:
    """Lines of a map with a spatial index.

    Dividers are the road lines with paint, boundaries are the road edges, crossings are the
    outlines of crosswalks, and centre lines are taken from the lanes.

    Args:
        path: Map of py123d.
        classes: Classes of map elements, out of ``CLASSES``.

    Attributes:
        lines: Vertices of the elements in the global frame, in metres. each (n, 3)
        labels: Indices of their classes.
        left_out: Number of elements without a valid geometry.

    Raises:
        ValueError: If the file is damaged.
    """

    def __init__(self, path: Path, classes: tuple[str, ...]) -> None:
        self.lines: list[np.ndarray] = []
        self.labels: list[int] = []
        self.left_out = 0
        # Errors about the content get the name of the file and the remedy.
        with explain_errors(path, REMEDY):
            table = read_table(path, columns=["map_layer", "features", "wkb"])
            layers = table["map_layer"].to_numpy()
            for label, name in enumerate(classes):
                rows = np.flatnonzero(layers == _LAYERS[name])
                for item in table.take(rows).to_pylist():
                    self._add(label, name=name, item=item)
        shapes = [shapely.LineString(line[:, :2]) for line in self.lines]
        self._tree = shapely.STRtree(shapes)

    def _add(self, label: int, name: str, item: Mapping[str, Any]) -> None:
        """Add the line of a map object, unless it is a road line without paint.

        Args:
            label: Index of the class.
            name: Name of the class.
            item: Row of the table: ``wkb``, the geometry as well-known binary, and ``features``, a
                dictionary of attributes packed as MessagePack.
        """
        if name == "divider" and unpack(item["features"])["road_line_type"] == _NO_PAINT:
            return
        if name == "centerline":
            line = np.asarray(unpack(item["features"])["centerline"], dtype=np.float64)
        else:
            line = _vertices(item["wkb"])
        if line.ndim != 2 or line.shape[1] not in (2, 3) or not np.isfinite(line).all():
            self.left_out += 1
            return
        if line.shape[1] == 2:
            line = np.pad(line, ((0, 0), (0, 1)))  # adds the height 0
        if not _is_valid(line, is_area=name in AREA_CLASSES):
            self.left_out += 1
            return
        self.lines.append(line)
        self.labels.append(label)

    def around(self, point: np.ndarray, radius_m: float) -> list[dict[str, Any]]:
        """Find the elements near a point in the plane, as input of `mapdata.custom.from_records`.

        Args:
            point: Position in the global frame, in metres. (2,)
            radius_m: Half the width of the square in which elements are searched.

        Returns:
            Labels and points of the elements, in the order of the map.
        """
        low = point - radius_m
        high = point + radius_m
        square = shapely.box(xmin=low[0], ymin=low[1], xmax=high[0], ymax=high[1])
        # The tree returns indices in no fixed order.
        indices = np.sort(self._tree.query(square, predicate="intersects")).tolist()
        return [{"label": self.labels[i], "points": self.lines[i]} for i in indices]


def _is_valid(line: np.ndarray, is_area: bool) -> bool:
    """Whether a line has two vertices, and does not cross itself if it is the ring of an area."""
    if is_area and is_closed(line):
        return len(line) > 3 and shapely.Polygon(line).is_valid
    return len(line) > 1


def _vertices(wkb: bytes) -> np.ndarray:
    """Vertices of a line, or of the outline of a polygon. (n, 2 or 3)

    Raises:
        ValueError: If the geometry is of another kind.
    """
    geometry = shapely.from_wkb(wkb)
    kind = shapely.get_type_id(geometry)
    if kind == POLYGON:
        geometry = shapely.get_exterior_ring(geometry)
    elif kind != LINE:
        raise InputError(f"a map object must be a line or a polygon, got type {kind}")
    return shapely.get_coordinates(geometry, include_z=shapely.has_z(geometry))
