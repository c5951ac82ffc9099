"""Reader of the vector map of an Argoverse 2 log, which checks each map element separately."""

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

from gsmap.datasets.errors import explain_errors
from gsmap.utils.errors import InputError

# For each layer (kind of map elements), by its key in the file: name of an element in messages,
# constructor of an element, and the least number of points of each of its lines by their keys.
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
    """Read a vector map without its unusable elements.

    Args:
        path: Map file, ``log_map_archive_*.json``.

    Returns:
        The map, and the ids of the unusable elements, by a text with their kind and the reason.

    Raises:
        ValueError: If the file is damaged, lacks a layer, or a layer has no usable element. A file
            may lack pedestrian crossings, and a layer may be empty.
    """
    left_out: dict[str, list[str]] = defaultdict(list)
    with explain_errors(path, "download it again"):
        content = json.loads(path.read_text(encoding="utf-8"))
        layers: dict[str, dict[int, Any]] = {}
        for key, (name, from_dict, min_points) in _LAYERS.items():
            layers[key] = {}
            may_be_absent = key == "pedestrian_crossings"
            records = content.get(key, {}) if may_be_absent else content[key]
            for element_id, record in records.items():
                try:
                    # Any error about the content becomes a ``ValueError``. Its text begins with the
                    # name of the element and ends with the remedy, here "it is left out".
                    with explain_errors(name, "it is left out"):
                        _check_lines(record, min_points)
                        layers[key][record["id"]] = from_dict(record)
                except ValueError as error:
                    reason = str(error)
                    left_out[reason].append(str(element_id))
            if records and not layers[key]:  # `reason` is of the last element of the layer
                raise InputError(f"none of its {len(records)} {key} can be used: {reason}")
    static_map = ArgoverseStaticMap(
        log_id=path.stem.split("log_map_archive_")[1],
        vector_drivable_areas=layers["drivable_areas"],
        vector_lane_segments=layers["lane_segments"],
        vector_pedestrian_crossings=layers["pedestrian_crossings"],
        # Only the vector map is read.
        raster_drivable_area_layer=None,
        raster_roi_layer=None,
        raster_ground_height_layer=None,
    )
    return static_map, dict(left_out)


def _check_lines(record: Any, min_points: dict[str, int]) -> None:
    """Raise a ``ValueError`` if a line has too few points, or a coordinate that is not finite."""
    for key, least in min_points.items():
        points = record[key]
        if len(points) < least:
            raise InputError(f"its {key} has {len(points)} points, and needs {least}")
        # The sum is finite only if all coordinates are. A value that is no number raises an error.
        total = 0
        for point in points:
            total += point["x"]
            total += point["y"]
            total += point["z"]
        if not math.isfinite(total):
            raise InputError(f"its {key} holds NaN or infinity")
