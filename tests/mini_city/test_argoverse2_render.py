"""Rendered Argoverse 2 logs: the ground as the map has it, and pictures that fit the labels."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from argoverse2_road import (
    ORIGIN,
    START_NS,
    crossing,
    road_map,
    write_heights,
    write_log,
    write_map,
)
from av2.datasets.sensor.av2_sensor_dataloader import AV2SensorDataLoader
from av2.map.map_api import ArgoverseStaticMap, GroundHeightLayer

from gsmap.datasets.annotations.file import AnnotationFile
from mapdata.argoverse2.convert import convert_argoverse2
from mapdata.argoverse2.log import RING_CAMERAS, Argoverse2Log
from mapdata.argoverse2.map import find_map
from mapdata.argoverse2.samples import Argoverse2Options
from minicity.argoverse2 import height_grid, lane_paint, make_scene
from minicity.argoverse2_render import (
    RenderOptions,
    render_log,
    render_logs,
    scaled_camera,
)
from minicity.terrain import sample_height

X, Y = ORIGIN[:2]
AROUND = (X - 30, Y - 20, X + 30, Y + 20)


def read_map(log_dir) -> ArgoverseStaticMap:
    return ArgoverseStaticMap.from_json(find_map(log_dir))


def test_the_ground_is_road_kerb_and_paint(tmp_path):
    write_map(tmp_path)
    write_heights(tmp_path)
    scene = make_scene(read_map(tmp_path), GroundHeightLayer.from_file(tmp_path / "map"), AROUND)
    assert [s.material for s in scene.surfaces] == ["walkway", "asphalt"]
    np.testing.assert_allclose(scene.surfaces[1].polygon.bounds, (X - 60, Y - 5, X + 60, Y + 5))
    np.testing.assert_allclose(scene.surfaces[0].polygon.bounds, (X - 63, Y - 8, X + 63, Y + 8))
    (kerb,) = scene.kerbs
    assert shapely.LinearRing(kerb).length == pytest.approx(260.0)
    (white,) = scene.markings
    assert white.paint == "white"
    painted = shapely.union_all([shapely.Polygon(outline) for outline in white.outlines])
    assert painted.contains(shapely.Point(X + 20, Y - 4))  # the solid line
    assert painted.contains(shapely.Point(X + 1, Y))  # the first dash
    assert not painted.intersects(shapely.box(X + 3.5, Y - 1, X + 5.5, Y + 1))  # the gap after it
    assert not painted.intersects(shapely.box(X - 30, Y + 3, X + 5, Y + 4.5))  # no paint there
    stripes = painted.intersection(shapely.box(X + 10, Y - 3.5, X + 13, Y - 0.5))
    assert 3.0 < stripes.area < 6.0  # the crossing: about half of 9 square metres


def test_a_line_that_two_lanes_share_is_painted_once(tmp_path):
    write_map(tmp_path)
    paint = lane_paint(read_map(tmp_path), shapely.box(X - 45, Y - 9, X - 5, Y + 2))
    area = sum(shapely.Polygon(outline).area for outline in paint["white"])
    # 50 m solid; 50 m dashed as 3 m of every 9 m, the last dash cut short; 0.15 m wide.
    dashes = sum(min(3.0, 50.0 - start) for start in np.arange(0.0, 49.7, 9.0))
    assert area == pytest.approx(0.15 * (50.0 + dashes), rel=1e-6)
    assert paint["yellow"] == []


@pytest.mark.parametrize(
    ("mark", "colour", "at", "bare"),
    [
        ("SOLID_YELLOW", "yellow", [(4.0, 0.0), (7.0, 0.0)], [(4.0, 0.3)]),
        ("DASHED_YELLOW", "yellow", [(2.0, 0.0)], [(5.0, 0.0)]),
        ("DOUBLE_SOLID_WHITE", "white", [(5.0, 0.13), (5.0, -0.13)], [(5.0, 0.0)]),
        ("SOLID_DASH_WHITE", "white", [(5.0, 0.12), (2.0, -0.12)], [(5.0, -0.12)]),
        ("DASH_SOLID_WHITE", "white", [(5.0, -0.12), (2.0, 0.12)], [(5.0, 0.12)]),
    ],
)
def test_every_kind_of_paint_lies_where_it_should(tmp_path, mark, colour, at, bare):
    content = road_map()
    for record in content["lane_segments"].values():
        record["left_lane_mark_type"] = record["right_lane_mark_type"] = "NONE"
    content["lane_segments"]["22"]["left_lane_mark_type"] = mark
    write_map(tmp_path, content)
    paint = lane_paint(read_map(tmp_path), shapely.box(*AROUND))
    painted = shapely.union_all([shapely.Polygon(outline) for outline in paint.pop(colour)])
    assert all(painted.contains(shapely.Point(X + x, Y + y)) for x, y in at)
    assert not any(painted.contains(shapely.Point(X + x, Y + y)) for x, y in bare)
    assert list(paint.values()) == [[]]


def test_height_follows_the_slope_and_fills_holes(tmp_path):
    write_map(tmp_path)
    write_heights(tmp_path, slope=0.1)
    heights = GroundHeightLayer.from_file(tmp_path / "map")
    points = np.array([[X, Y], [X + 20, Y - 10]])
    everywhere = shapely.box(X - 70, Y - 70, X + 70, Y + 70)
    grid = height_grid(heights, AROUND, everywhere)
    # float16 keeps heights near 20 m to 1/64 m.
    np.testing.assert_allclose(sample_height(grid, points), [20.0, 22.0], atol=1 / 64)
    corner = height_grid(heights, (X - 70, Y - 70, X, Y), everywhere)
    assert np.isfinite(corner.height_m).all()
    assert sample_height(corner, np.array([[X - 69, Y - 69]]))[0] == pytest.approx(13.5, abs=0.3)
    with pytest.raises(ValueError, match="no ground height is known on the road"):
        height_grid(heights, (X - 70, Y - 70, X - 69, Y - 69), everywhere)


def test_away_from_the_road_the_height_at_its_edge_goes_on(tmp_path):
    """What is stored beyond x = 5 m is a slope that nothing visible stands on."""
    write_map(tmp_path)
    write_heights(tmp_path, slope=0.5)
    heights = GroundHeightLayer.from_file(tmp_path / "map")
    grid = height_grid(heights, AROUND, shapely.box(X - 30, Y - 20, X + 5, Y + 20))
    height = sample_height(grid, np.array([[X - 10, Y], [X + 12, Y], [X + 25, Y]]))
    np.testing.assert_allclose(height, [15.0, 22.4, 22.4], atol=0.2)


def test_scaled_pictures_keep_their_corners(tmp_path):
    write_log(tmp_path / "log-a")
    camera = Argoverse2Log(tmp_path / "log-a").calibration[RING_CAMERAS[0]]
    intrinsics, width, height = scaled_camera(camera, 0.25)
    assert (width, height) == (400, 300)
    ray = np.linalg.inv(camera.intrinsics.K) @ [-0.5, -0.5, 1.0]
    np.testing.assert_allclose(intrinsics @ ray, [-0.5, -0.5, 1.0], atol=1e-9)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A rendered log and its annotations with height."""
    root = tmp_path_factory.mktemp("logs")
    write_log(
        root / "real" / "val" / "log-a", content=road_map(crossing(31, (20.0, 23.0), (-5.0, 5.0)))
    )
    out = root / "rendered"
    count = render_log(root / "real" / "val" / "log-a", out / "val" / "log-a", RenderOptions())
    convert_argoverse2(Argoverse2Options(out, dim=3))
    return count, out, AnnotationFile(out / "gsmap_av2_val.arrow")


def test_a_rendered_log_reads_like_a_real_one(rendered):
    count, out, annotations = rendered
    assert count == 2 * 7
    assert [s.timestamp_ns - START_NS for s in annotations] == [0, 500_000_000]
    for camera in annotations[0].cameras:
        image = cv2.imread(str(out / camera.path))
        assert image.shape == (camera.height, camera.width, 3) == (300, 400, 3)
        ego_from_cam = np.linalg.inv(camera.cam_from_frame)  # taken at the sample's time
        np.testing.assert_allclose(ego_from_cam[:3, 3], [1.6, 0.0, 1.4], atol=1e-9)
    assert not list((out / "val").glob(".*"))


def test_the_official_api_reads_a_rendered_log(rendered):
    _, out, annotations = rendered
    loader = AV2SensorDataLoader(data_dir=out / "val", labels_dir=out / "val")
    assert list(loader.get_log_ids()) == ["log-a"]
    sample = annotations[1]
    for camera in sample.cameras:
        path = loader.get_closest_img_fpath("log-a", camera.name, sample.timestamp_ns)
        assert path == out / camera.path
        official = loader.get_log_pinhole_camera("log-a", camera.name)
        assert (official.width_px, official.height_px) == (camera.width, camera.height)
        np.testing.assert_allclose(official.intrinsics.K, camera.intrinsics)
    pose = loader.get_city_SE3_ego("log-a", sample.timestamp_ns).transform_matrix
    np.testing.assert_allclose(pose, sample.global_from_frame)


def test_labels_project_onto_what_is_painted(rendered):
    """The solid line at y = -4 and the edge at y = -5 are where the labels say."""
    _, out, annotations = rendered
    camera = annotations[0].cameras[0]
    image = cv2.imread(str(out / camera.path)).mean(-1)

    def brightness(y: float) -> float:
        ground = np.stack([np.linspace(12, 18, 50), np.full(50, y), np.zeros(50), np.ones(50)])
        seen = camera.intrinsics @ (camera.cam_from_frame @ ground)[:3]
        u, v = np.round(seen[:2] / seen[2]).astype(int)
        return float(image[v, u].mean())

    across = np.arange(-7.0, -2.9, 0.05)
    profile = np.array([brightness(y) for y in across])
    assert across[profile.argmax()] == pytest.approx(-4.0, abs=0.1)
    (edge,) = [i.points for i in annotations[0].instances if i.label == 2 and i.points[0, 1] < 0]
    np.testing.assert_allclose(edge[:, 1], -5.0, atol=1e-6)
    kerb = (across > -5.3) & (across < -4.7)  # a dark gutter between two light strips
    assert across[kerb][profile[kerb].argmin()] == pytest.approx(-5.0, abs=0.1)
    assert profile[across < -5.8].mean() > profile[across > -3.5].mean() + 25  # walkway and road


def test_what_cannot_be_rendered_is_said_and_the_rest_goes_on(tmp_path):
    real = tmp_path / "real" / "val"
    for name in ("log-a", "log-b", "log-c"):
        write_log(real / name, seconds=0.1)
    (real / "log-b" / "calibration" / "intrinsics.feather").unlink()
    next((real / "log-c" / "map").glob("*.npy")).unlink()
    out, logs = tmp_path / "out", sorted(real.iterdir())
    text = render_logs(logs, out, RenderOptions(scale=0.1))
    assert "7 pictures of 1 logs" in text
    assert "log-b left out: no calibration of the ring cameras" in text
    assert "log-c left out: Raster ground height layer file is missing" in text
    assert [path.name for path in out.iterdir()] == ["log-a"]
    text = render_logs(logs[:2], out, RenderOptions(scale=0.1, calibration=logs[0]))
    assert "7 pictures of 1 logs" in text
    assert "exists and is not replaced" in text
    assert set(Argoverse2Log(out / "log-b").calibration) == set(RING_CAMERAS)


def test_a_full_disk_leaves_no_half_log(tmp_path, monkeypatch):
    write_log(tmp_path / "log-a", seconds=0.1)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space left"):
        render_logs([tmp_path / "log-a"], tmp_path / "out", RenderOptions(scale=0.1))
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scale": 0.0}, "scale must be"),
        ({"rate_hz": -1.0}, "rate_hz must be"),
        ({"max_frames": 0}, "max_frames"),
    ],
)
def test_bad_options_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        RenderOptions(**wrong)
