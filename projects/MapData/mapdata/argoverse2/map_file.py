"""The file of a log's vector map, each of its elements checked by itself."""

import json
import math
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from av2.map.drivable_area import DrivableArea
from av2.map.lane_segment import LaneSegment
from av2.map.map_api import ArgoverseStaticMap
from av2.map.pedestrian_crossing import PedestrianCrossing

from gsmap.datasets.errors import naming
from gsmap.utils.errors import InputError

# by key of the file: how messages name an element, its class, and the least points of its lines
_LAYERS: dict[str, tuple[str, Callable[[Any], Any], dict[str, int]]] = {
    "lane_segments": (
        "lane segment",
        LaneSegment.from_dict,
        {"left_lane_boundary": 2, "right_lane_boundary": 2},
    ),
    "pedestrian_crossings": (
        "crossing",
        PedestrianCrossing.from_dict,
        {"edge1": 2, "edge2": 2},
    ),
    "drivable_areas": ("drivable area", DrivableArea.from_dict, {"area_boundary": 3}),
}


def read_map_file(path: Path) -> tuple[ArgoverseStaticMap, dict[str, list[str]]]:
    """Read a map, without the elements that cannot be used.

    Args:
        path: The file, ``log_map_archive_*.json``.

    Returns:
        The map, and the numbers of the elements that are left out, by kind and reason.

    Raises:
        ValueError: If the file is damaged, lacks a layer or has nothing usable in one.
    """
    left_out: dict[str, list[str]] = defaultdict(list)
    with naming(path, "download it again"):
        content = json.loads(path.read_text(encoding="utf-8"))
        layers: dict[str, dict[int, Any]] = {}
        for key, (name, make, lines) in _LAYERS.items():
            layers[key] = {}
            records = content[key] if key != "pedestrian_crossings" else content.get(key, {})
            for number, record in records.items():
                try:
                    with naming(name, "it is left out"):
                        _check_lines(record, lines)
                        layers[key][record["id"]] = make(record)
                except ValueError as error:
                    reason = str(error)
                    left_out[reason].append(str(number))
            if records and not layers[key]:
                raise InputError(f"none of its {len(records)} {key} can be used: {reason}")
    static_map = ArgoverseStaticMap(
        log_id=path.stem.split("log_map_archive_")[1],
        vector_drivable_areas=layers["drivable_areas"],
        vector_lane_segments=layers["lane_segments"],
        vector_pedestrian_crossings=layers["pedestrian_crossings"],
        raster_drivable_area_layer=None,
        raster_roi_layer=None,
        raster_ground_height_layer=None,
    )
    return static_map, dict(left_out)


def _check_lines(record: Any, lines: dict[str, int]) -> None:
    """Raise a ``ValueError`` unless an element's lines have points enough, all finite."""
    for key, least in lines.items():
        points = record[key]
        if len(points) < least:
            raise InputError(f"its {key} has {len(points)} points, and needs {least}")
        if not math.isfinite(sum([point[axis] for point in points for axis in "xyz"])):
            raise InputError(f"its {key} holds NaN or infinity")
