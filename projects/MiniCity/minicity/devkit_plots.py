"""Draw a sample and the map around it with the nuScenes devkit.

The devkit draws polygons with the package ``descartes``, whose last release is older than shapely 2
and expects rings as arrays. `repair_descartes` therefore replaces its conversion of polygons.
"""

import argparse
from pathlib import Path

import descartes
import matplotlib as mpl
import numpy as np
from matplotlib.path import Path as Outline
from shapely import get_parts
from shapely.geometry import MultiPolygon, Polygon

from gsmap.utils.errors import InputError
from mapdata.nuscenes.map import open_map
from minicity.config import VERSION

LAYERS = ["drivable_area", "road_segment", "lane", "ped_crossing", "walkway"]
RADIUS_M = 75.0  # half the side of the square of the map that is drawn around the vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``python -m minicity draw`` to a parser."""
    parser.add_argument("root", help="folder of the data set")
    parser.add_argument(
        "--out", type=Path, default=Path("work_dirs/minicity"), help="folder of the pictures"
    )
    parser.add_argument("--sample", type=int, default=0, help="number of the key frame, from 0")


def run(arguments: argparse.Namespace) -> str:
    """Draw the sensors of a key frame, its LiDAR in the front camera, and the map around it.

    Args:
        arguments: Parsed options of ``add_arguments``.

    Returns:
        Names and folder of the pictures, for the user.

    Raises:
        FileNotFoundError: If there is no data set.
        ValueError: If the number of the key frame is out of range.
    """
    if not Path(arguments.root, VERSION).is_dir():
        raise FileNotFoundError(
            f"no MiniCity at {arguments.root}: make it with python -m minicity generate --root "
            f"{arguments.root} --scenes 10"
        )
    # Imported after the check above, since the devkit is slow to import.
    from nuscenes import NuScenes

    mpl.use("Agg")  # writes files and opens no window
    repair_descartes()
    nusc = NuScenes(VERSION, arguments.root, verbose=False)
    if not 0 <= arguments.sample < len(nusc.sample):
        raise InputError(f"--sample must lie in 0..{len(nusc.sample) - 1}, got {arguments.sample}.")
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    sample = nusc.sample[arguments.sample]
    nusc.render_sample(sample["token"], out_path=str(out / "sample.png"), verbose=False)
    nusc.render_pointcloud_in_image(sample["token"], out_path=str(out / "lidar.png"), verbose=False)
    scene = nusc.get("scene", sample["scene_token"])
    log = nusc.get("log", scene["log_token"])
    lidar = nusc.get("sample_data", sample["data"]["LIDAR_TOP"])
    # Position of the vehicle in the town, in metres, at the time of the LiDAR sweep.
    x, y, _ = nusc.get("ego_pose", lidar["ego_pose_token"])["translation"]
    patch = (x - RADIUS_M, y - RADIUS_M, x + RADIUS_M, y + RADIUS_M)
    # Logs of the time before streets are repainted name the map of that time.
    town = open_map(Path(arguments.root), log.get("map_expansion", log["location"]))
    figure, _ = town.render_map_patch(patch, LAYERS, figsize=(10, 10))
    figure.savefig(out / "map.png")
    return f"sample.png, lidar.png, map.png: {out}"


def polygon_path(polygon: Polygon | MultiPolygon) -> Outline:
    """Convert a polygon with holes to a matplotlib path."""
    rings = []  # coordinates of the outlines and the holes, (n, 2) each
    for part in get_parts(polygon):
        if not part.is_empty:
            for ring in (part.exterior, *part.interiors):
                rings.append(np.asarray(ring.coords)[:, :2])
    if not rings:
        return Outline(np.zeros((0, 2)))
    codes = []  # for each vertex: start of a ring (MOVETO), or end of a straight line (LINETO)
    for ring in rings:
        ring_codes = np.full(len(ring), Outline.LINETO, dtype=Outline.code_type)
        ring_codes[0] = Outline.MOVETO
        codes.append(ring_codes)
    return Outline(np.concatenate(rings), codes=np.concatenate(codes))


def repair_descartes() -> None:
    """Make ``descartes.PolygonPatch`` accept shapely 2 polygons, in this process.

    ``PolygonPatch`` calls ``PolygonPath``, which `polygon_path` replaces.
    """
    descartes.patch.PolygonPath = polygon_path
