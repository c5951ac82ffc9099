"""What the map says, what the cameras show and what the devkit draws agree."""

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from nuscenes import NuScenes
from nuscenes.map_expansion.map_api import NuScenesMap
from pyquaternion import Quaternion
from shapely.geometry import Polygon

from minicity import devkit_plots

LOCATIONS = (
    "singapore-onenorth",
    "singapore-hollandvillage",
    "singapore-queenstown",
    "boston-seaport",
)


@pytest.fixture(scope="module")
def maps(small_root: Path) -> dict[str, NuScenesMap]:
    return {name: NuScenesMap(str(small_root), name) for name in LOCATIONS}


def pixels_of(nusc: NuScenes, token: str, ground: np.ndarray) -> np.ndarray:
    """World points on the ground in a camera's pixels, by the tables alone. (n, 2) -> (m, 2)"""
    data = nusc.get("sample_data", token)
    pose = nusc.get("ego_pose", data["ego_pose_token"])
    sensor = nusc.get("calibrated_sensor", data["calibrated_sensor_token"])
    points = np.column_stack([ground, np.zeros(len(ground))])
    for record in (pose, sensor):
        turn = Quaternion(record["rotation"]).rotation_matrix
        points = (points - np.array(record["translation"])) @ turn
    ahead = (points[:, 2] > 3.0) & (points[:, 2] < 22.0)
    image = points[ahead] @ np.array(sensor["camera_intrinsic"]).T
    px = image[:, :2] / image[:, 2:]
    inside = (px >= 3).all(1) & (px[:, 0] < data["width"] - 3) & (px[:, 1] < data["height"] - 3)
    return np.round(px[inside]).astype(int)


def inner_points(town: NuScenesMap, records: list[dict]) -> np.ndarray:
    """Points on the way from the centroid to the vertices of each polygon. (n, 2)"""
    found = []
    for record in records:
        polygon = town.extract_polygon(record["polygon_token"])
        vertices, middle = np.array(polygon.exterior.coords)[:-1], np.array(polygon.centroid.coords)
        for share in (0.15, 0.3, 0.45, 0.6):
            inner = middle + share * (vertices - middle)
            found.append(inner[shapely.contains_xy(polygon, inner)])
    return np.concatenate(found)


def lane_centers(town: NuScenesMap) -> np.ndarray:
    """Points along the centre lines of all lanes. (n, 2)"""
    lines = town.discretize_lanes([record["token"] for record in town.lane], 2.0)
    return np.concatenate([np.array(line)[:, :2] for line in lines.values()])


def test_stop_lines_and_crossings_of_the_map_are_bright_in_the_pictures(
    nusc: NuScenes, maps: dict[str, NuScenesMap]
) -> None:
    paint, road = [], []
    for sample in nusc.sample:
        scene = nusc.get("scene", sample["scene_token"])
        town = maps[nusc.get("log", scene["log_token"])["location"]]
        stripes, lanes = inner_points(town, town.stop_line), lane_centers(town)
        for channel, token in sample["data"].items():
            if not channel.startswith("CAM"):
                continue
            image = cv2.imread(nusc.get_sample_data_path(token)).max(-1)
            for points, found in ((stripes, paint), (lanes, road)):
                for u, v in pixels_of(nusc, token, points):
                    found.append(float(image[v - 1 : v + 2, u - 1 : u + 2].max()))
    assert len(paint) >= 5
    assert np.median(paint) > 150
    assert np.median(road) < 125


def test_lane_dividers_of_the_map_are_brighter_than_the_lanes_beside_them(
    nusc: NuScenes, maps: dict[str, NuScenesMap]
) -> None:
    """A dashed line is bare on half its length: a third of its points must stand out."""
    contrast = []
    for sample in nusc.sample:
        scene = nusc.get("scene", sample["scene_token"])
        town = maps[nusc.get("log", scene["log_token"])["location"]]
        lines = [
            town.extract_line(record["line_token"])
            for record in (*town.lane_divider, *town.road_divider)
        ]
        points = [line.interpolate(d) for line in lines for d in np.arange(0, line.length, 0.5)]
        ground = np.array([(point.x, point.y) for point in points])
        for channel in ("CAM_FRONT", "CAM_BACK", "CAM_FRONT_LEFT", "CAM_BACK_LEFT"):
            token = sample["data"][channel]
            image = cv2.imread(nusc.get_sample_data_path(token)).max(-1).astype(float)
            for u, v in pixels_of(nusc, token, ground):
                around = image[v, max(0, u - 14) : u + 15]
                contrast.append(image[v, u - 2 : u + 3].max() - np.median(around))
    assert len(contrast) > 30
    assert np.mean(np.array(contrast) > 25) > 0.33


def test_drivable_area_mask_of_the_map_picture_agrees_with_the_roads(
    nusc: NuScenes, maps: dict[str, NuScenesMap]
) -> None:
    for sample in nusc.sample:
        scene = nusc.get("scene", sample["scene_token"])
        location = nusc.get("log", scene["log_token"])["location"]
        record = next(m for m in nusc.map if scene["log_token"] in m["log_tokens"])
        pose = nusc.get(
            "ego_pose", nusc.get("sample_data", sample["data"]["LIDAR_TOP"])["ego_pose_token"]
        )
        x, y = pose["translation"][:2]
        assert record["mask"].is_on_mask(np.array([x]), np.array([y]))[0]
        assert maps[location].layers_on_point(x, y)["drivable_area"]


@pytest.mark.skipif(
    np.lib.NumpyVersion(np.__version__) >= "2.4.0",
    reason="nuscenes-devkit 1.2.0 draws maps with numpy < 2.4 alone (docs/install.md)",
)
def test_the_devkit_draws_a_sample_and_a_map_patch(nusc: NuScenes, tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    devkit_plots.add_arguments(parser)
    arguments = [nusc.dataroot, "--out", str(tmp_path / "pictures")]
    assert "map.png" in devkit_plots.run(parser.parse_args(arguments))
    for name in ("sample", "lidar", "map"):
        picture = cv2.imread(str(tmp_path / "pictures" / f"{name}.png"))
        assert picture.std() > 10, f"{name} is blank"
    with pytest.raises(ValueError, match=r"--sample must lie in 0\.\.\d+, got 99"):
        devkit_plots.run(parser.parse_args([*arguments, "--sample", "99"]))


def test_polygon_path_keeps_holes() -> None:
    square = Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(1, 1), (3, 1), (3, 3), (1, 3)]])
    path = devkit_plots.polygon_path(square)
    assert path.contains_point((0.5, 2))
    assert len(path.to_polygons()) == 2
    assert len(devkit_plots.polygon_path(Polygon())) == 0


def test_centre_lines_run_inside_their_lanes(maps: dict[str, NuScenesMap]) -> None:
    town = maps["boston-seaport"]
    lanes = {record["token"]: record for record in town.lane}
    for token, path in town.discretize_lanes(list(lanes)[:20], 1.0).items():
        area = town.extract_polygon(lanes[token]["polygon_token"]).buffer(0.3)
        assert all(area.contains(Polygon([p[:2]] * 3).centroid) for p in path[1:-1])
        assert town.get_outgoing_lane_ids(token) is not None
