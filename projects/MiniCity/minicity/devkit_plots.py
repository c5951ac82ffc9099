"""Makes the devkit's map pictures work beside shapely 2.

``descartes``, with which nuscenes-devkit draws polygons, was last released before shapely 2 and
reads rings as arrays.
"""

import descartes
import numpy as np
from matplotlib.path import Path
from shapely import get_parts
from shapely.geometry import MultiPolygon, Polygon


def polygon_path(polygon: Polygon | MultiPolygon) -> Path:
    """A polygon, holes included, as a matplotlib path."""
    rings = [
        np.asarray(ring.coords)[:, :2]
        for part in get_parts(polygon)
        if not part.is_empty
        for ring in (part.exterior, *part.interiors)
    ]
    if not rings:
        return Path(np.zeros((0, 2)))
    codes = []
    for ring in rings:
        code = np.full(len(ring), Path.LINETO, dtype=Path.code_type)
        code[0] = Path.MOVETO
        codes.append(code)
    return Path(np.concatenate(rings), np.concatenate(codes))


def repair_descartes() -> None:
    """Let ``descartes.PolygonPatch`` take shapely 2 polygons, for this process."""
    descartes.patch.PolygonPath = polygon_path
