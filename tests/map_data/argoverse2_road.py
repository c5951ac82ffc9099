"""A straight road of two lanes as an Argoverse 2 log, small enough to know every answer by hand.

Seen from above, city frame, around (1000, 500), z = 20; both lanes lead to +x:

    y = +5   ------------------------------- edge of the drivable area
    y = +4   - - - - no paint - - - - - - -
                 lanes 11 -> 12
    y =  0   = = = dashed white = = = = = =   x = 10 .. 13: a crossing from y = -5 to y = 5
                 lanes 21 -> 22
    y = -4   ======= solid white ==========
    y = -5   ------------------------------- edge of the drivable area

Every lane piece is 50 m long; they meet at x = 0. The vehicle drives along y = 0 at 10 m/s.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.feather as feather

from mapdata.argoverse2.log import RING_CAMERAS

ORIGIN = np.array([1000.0, 500.0, 20.0])
SPEED_M_S = 10.0
START_NS = 315_966_000_000_000_000
SWEEP_EVERY_NS = 100_000_000
IMAGE_EVERY_NS = 50_000_000
IMAGE_DELAY_NS = 10_000_000
CAMERA_IN_EGO_M = (1.6, 0.0, 1.4)


def _points(*xy: tuple[float, float]) -> list[dict[str, float]]:
    return [dict(zip("xyz", (ORIGIN + np.array([*p, 0.0])).tolist(), strict=True)) for p in xy]


def lane(
    lane_id: int,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    left: int | None = None,
    right: int | None = None,
    marks: tuple[str, str] = ("NONE", "NONE"),
    predecessors: tuple[int, ...] = (),
    successors: tuple[int, ...] = (),
    is_intersection: bool = False,
) -> dict:
    """A lane piece along +x between y = (right, left)."""
    return {
        "id": lane_id,
        "is_intersection": is_intersection,
        "lane_type": "VEHICLE",
        "left_lane_boundary": _points((x[0], y[1]), (x[1], y[1])),
        "right_lane_boundary": _points((x[0], y[0]), (x[1], y[0])),
        "left_lane_mark_type": marks[0],
        "right_lane_mark_type": marks[1],
        "left_neighbor_id": left,
        "right_neighbor_id": right,
        "predecessors": list(predecessors),
        "successors": list(successors),
    }


def crossing(crossing_id: int, x: tuple[float, float], y: tuple[float, float]) -> dict:
    """A crossing whose two edges run along y."""
    return {
        "id": crossing_id,
        "edge1": _points((x[0], y[0]), (x[0], y[1])),
        "edge2": _points((x[1], y[0]), (x[1], y[1])),
    }


def bow_tie(crossing_id: int) -> dict:
    """A crossing whose edges run against each other: an invalid polygon."""
    record = crossing(crossing_id, (-8.0, -5.0), (-4.0, 4.0))
    record["edge2"].reverse()
    return record


def road_map(*crossings: dict) -> dict:
    """The map of the road in the format of ``log_map_archive_*.json``."""
    upper, lower = ("NONE", "DASHED_WHITE"), ("DASHED_WHITE", "SOLID_WHITE")
    lanes = [
        lane(11, (-50, 0), (0, 4), right=21, marks=upper, successors=(12,)),
        lane(12, (0, 50), (0, 4), right=22, marks=upper, predecessors=(11,)),
        lane(21, (-50, 0), (-4, 0), left=11, marks=lower, successors=(22,)),
        lane(22, (0, 50), (-4, 0), left=12, marks=lower, predecessors=(21,)),
    ]
    area = {"id": 1, "area_boundary": _points((-60, -5), (60, -5), (60, 5), (-60, 5))}
    crossings = crossings or (crossing(31, (10.0, 13.0), (-5.0, 5.0)),)
    return {
        "lane_segments": {str(record["id"]): record for record in lanes},
        "pedestrian_crossings": {str(record["id"]): record for record in crossings},
        "drivable_areas": {"1": area},
    }


def pose(x: float = 0.0, y: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    """Pose of the vehicle on the road. (4, 4)"""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    matrix = np.eye(4)
    matrix[:2, :2] = [[cos, -sin], [sin, cos]]
    matrix[:3, 3] = ORIGIN + np.array([x, y, 0.0])
    return matrix


def write_map(log_dir: Path, content: dict | None = None) -> None:
    """Write the map of a log."""
    folder = log_dir / "map"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"log_map_archive_{log_dir.name}____PIT_city_1.json"
    path.write_text(json.dumps(content or road_map()))


def write_heights(log_dir: Path, slope: float = 0.0, cell_m: float = 0.5) -> None:
    """Write the ground height of x = -70 .. 70, y = -70 .. 70 around the road's origin."""
    count = round(140 / cell_m)
    along = (np.arange(count) + 0.5) * cell_m - 70.0
    heights = np.tile(ORIGIN[2] + slope * along, (count, 1)).astype(np.float16)
    heights[:10, :10] = np.nan
    folder = log_dir / "map"
    np.save(folder / f"{log_dir.name}_ground_height_surface____PIT.npy", heights)
    corner = [float(v) for v in 70.0 - ORIGIN[:2]]
    similarity = {"R": [1.0, 0.0, 0.0, 1.0], "t": corner, "s": 1 / cell_m}
    (folder / f"{log_dir.name}___img_Sim2_city.json").write_text(json.dumps(similarity))


def write_poses(log_dir: Path, times_ns: np.ndarray) -> None:
    """Write poses along y = 0, from x = 0 at ``START_NS``."""
    x = (times_ns - START_NS) * 1e-9 * SPEED_M_S
    table = pd.DataFrame({"timestamp_ns": times_ns, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0})
    table["tx_m"], table["ty_m"], table["tz_m"] = ORIGIN[0] + x, ORIGIN[1], ORIGIN[2]
    log_dir.mkdir(parents=True, exist_ok=True)
    feather.write_feather(table, log_dir / "city_SE3_egovehicle.feather")


def write_calibration(log_dir: Path) -> None:
    """Write seven equal cameras that look along the vehicle's x."""
    names = pd.DataFrame({"sensor_name": RING_CAMERAS})
    intrinsics = names.assign(
        fx_px=1000.0, fy_px=1000.0, cx_px=800.0, cy_px=600.0, k1=0.0, k2=0.0, k3=0.0,
        height_px=1200, width_px=1600,
    )  # fmt: skip
    x, y, z = CAMERA_IN_EGO_M
    extrinsics = names.assign(qw=0.5, qx=-0.5, qy=0.5, qz=-0.5, tx_m=x, ty_m=y, tz_m=z)
    folder = log_dir / "calibration"
    folder.mkdir(parents=True, exist_ok=True)
    feather.write_feather(intrinsics, folder / "intrinsics.feather")
    feather.write_feather(extrinsics, folder / "egovehicle_SE3_sensor.feather")


def write_log(log_dir: Path, seconds: float = 1.0, content: dict | None = None) -> None:
    """Write a whole log: map, poses, calibration, and empty files for sweeps and images."""
    sweeps = START_NS + np.arange(0, int(seconds * 1e9), SWEEP_EVERY_NS)
    images = START_NS + np.arange(0, int(seconds * 1e9), IMAGE_EVERY_NS) + IMAGE_DELAY_NS
    write_map(log_dir, content)
    write_heights(log_dir)
    write_poses(log_dir, np.sort(np.concatenate([sweeps, images])))
    write_calibration(log_dir)
    folders = {log_dir / "sensors" / "lidar": (sweeps, ".feather")}
    for name in RING_CAMERAS:
        folders[log_dir / "sensors" / "cameras" / name] = (images, ".jpg")
    for folder, (times, suffix) in folders.items():
        folder.mkdir(parents=True)
        for time in times:
            (folder / f"{time}{suffix}").touch()
