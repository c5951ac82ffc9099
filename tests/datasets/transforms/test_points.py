"""Sweep files of nuScenes and Argoverse 2, and the depth maps made from them."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from argoverse2_road import SPEED_M_S, START_NS, SWEEP_EVERY_NS, write_log
from method_cases import cases_of_methods
from mmdet3d.registry import DATASETS
from mmdet3d.structures import LiDARPoints
from mmengine.config import Config
from mmengine.registry import init_default_scope
from pyarrow import feather
from scipy.spatial.transform import Rotation

import gsmap.registered  # noqa: F401
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.transforms.images import CropImages, ScaleImages
from gsmap.datasets.transforms.packing import PackMapInputs
from gsmap.datasets.transforms.points import (
    LoadLidarPoints,
    LoadLidarSweeps,
    MakeDepthMap,
    PointsToFrame,
    read_points,
)
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError
from mapdata.argoverse2.convert import convert_argoverse2
from mapdata.argoverse2.log import RING_CAMERAS
from mapdata.argoverse2.samples import Argoverse2Options
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

REPO = Path(__file__).resolve().parents[3]
CONFIG = next(iter(cases_of_methods("ARGOVERSE2_DEPTH").values()), "")
GROUND_Z_M = -0.25  # exact in float16
LOAD = {"coord_type": "LIDAR", "load_dim": 5, "use_dim": 5}


def write_sweep(path: Path, points: np.ndarray, offset_ns: int = 0) -> None:
    """Write points (n, 3) as Argoverse 2 does, intensity 100 + and laser number their row."""
    table = pd.DataFrame(points.astype(np.float16), columns=["x", "y", "z"])
    rows = np.arange(len(points), dtype=np.uint8)
    table["intensity"], table["laser_number"] = (100 + rows % 100).astype(np.uint8), rows % 64
    table["offset_ns"] = np.full(len(points), offset_ns, np.int32)
    feather.write_feather(table, path, compression="uncompressed")


def ground_points() -> np.ndarray:
    """Return a grid on the ground around the vehicle, 2 m apart. (n, 3)"""
    x, y = np.meshgrid(np.arange(-20, 21, 2), np.arange(-8, 9, 2))
    return np.stack([x, y, np.full(x.shape, GROUND_Z_M)], -1).reshape(-1, 3).astype(np.float64)


@pytest.fixture
def road(tmp_path: Path) -> Path:
    """A data root with the straight road's log, grey images and the same sweep at every time."""
    write_log(tmp_path / "val" / "log-a", seconds=0.3)
    write_files(tmp_path / "val" / "log-a")
    return tmp_path


def write_files(log: Path) -> None:
    for path in (log / "sensors" / "lidar").iterdir():
        write_sweep(path, ground_points())
    grey = cv2.imencode(".jpg", np.full((1200, 1600, 3), 90, np.uint8))[1].tobytes()
    for path in (log / "sensors" / "cameras").rglob("*.jpg"):
        path.write_bytes(grey)


def depth_data(root: Path, **options) -> torch.utils.data.Dataset:
    """Convert a root and open it with the data set of a model with depth."""
    init_default_scope("mmdet3d")
    convert_argoverse2(Argoverse2Options(root, rate_hz=None, **options))
    config = Config.fromfile(REPO / CONFIG).train_dataloader.dataset
    config.update(data_root=str(root), ann_file="gsmap_av2_val.arrow", split="val", rate_hz=None)
    return DATASETS.build(config)


def test_the_columns_of_a_feather_file_are_the_values_of_a_point(tmp_path):
    path = tmp_path / "1.feather"
    write_sweep(path, np.array([[1.5, -2.0, 0.25], [3.0, 4.0, 5.0]]), offset_ns=7_000_000)
    np.testing.assert_array_equal(
        read_points(str(path), 6), [[1.5, -2, 0.25, 100, 0, 7e6], [3, 4, 5, 101, 1, 7e6]]
    )
    assert read_points(str(path), 4).dtype == np.float32
    with pytest.raises(ValueError, match=r"load_dim must be at most 6 .*got 7"):
        read_points(str(path), 7)


def test_both_formats_give_the_same_points(tmp_path):
    write_sweep(tmp_path / "1.feather", ground_points())
    read_points(str(tmp_path / "1.feather"), 5).tofile(tmp_path / "1.pcd.bin")
    load = LoadLidarPoints(**LOAD)
    one, other = (
        load.transform({"token": "a", "lidar_points": {"lidar_path": str(tmp_path / name)}})
        for name in ("1.feather", "1.pcd.bin")
    )
    assert one["points"].shape == (9 * 21, 5)
    torch.testing.assert_close(one["points"].tensor, other["points"].tensor)


def without_intensity(path: Path) -> None:
    feather.write_feather(feather.read_table(path).drop(["intensity"]), path)


def without_points(path: Path) -> None:
    write_sweep(path, np.empty((0, 3)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:500]), "whole LiDAR sweep .*again"),
        (lambda path: path.write_bytes(b""), "whole LiDAR sweep .*again"),
        (without_intensity, "whole LiDAR sweep .*intensity.*again"),
        (without_points, "holds no point.*again"),
        (Path.unlink, "no LiDAR file at .*data_root"),
    ],
)
def test_a_bad_feather_file_is_named_with_its_sample(tmp_path, damage, message):
    path = tmp_path / "1.feather"
    write_sweep(path, ground_points())
    damage(path)
    results = {"token": "sample-9", "lidar_points": {"lidar_path": str(path)}}
    with pytest.raises(BrokenSampleError, match=f"sample 'sample-9'.*{message}") as raised:
        LoadLidarPoints(**LOAD).transform(results)
    assert str(path) in str(raised.value)


def test_of_returns_at_one_pixel_the_nearest_counts():
    """Column 3, row 2 at 10 m, then 5 m; column 1, row 4 at 6 m, then 8 m."""
    rays = [(3, 2, 10), (3, 2, 5), (1, 4, 6), (1, 4, 8)]
    points = torch.tensor([[x * depth, y * depth, depth] for x, y, depth in rays])
    results = {
        "points": LiDARPoints(points.float(), points_dim=3),
        "img_shape": (32, 32),
        "raw_shapes": [(32, 32)],
        "lidar2img": [np.eye(4)],
        "img_aug_matrix": [np.eye(4)],
    }
    depths = MakeDepthMap().transform(results)["gt_depth"]
    assert depths.shape == (1, 32, 32)
    assert depths[0, 2, 3] == 5
    assert depths[0, 4, 1] == 6
    assert depths.sum() == 11


@pytest.mark.parametrize(
    ("steps", "pixel"),
    [([ScaleImages(size=(8, 4))], (3, 7)), ([ScaleImages(0.5), CropImages(2)], (1, 7))],
)
def test_depths_fill_a_resized_or_cropped_image_and_not_its_padding(steps, pixel):
    """Of a 16 x 8 image, column 14 has a point in row 6, and another one below the image."""
    points = torch.tensor([[14.0 * 5, 6.0 * 5, 5.0], [14.0 * 5, 9.0 * 5, 5.0]])
    results = {
        "img": [np.zeros((8, 16, 3), np.uint8)],
        "raw_shapes": [(8, 16)],
        "points": LiDARPoints(points, points_dim=3),
        "lidar2img": [np.eye(4)],
        "img_aug_matrix": [np.eye(4)],
    }
    for step in steps:
        results = step.transform(results)
    depths = MakeDepthMap().transform(results)["gt_depth"]
    assert depths[0][pixel] == 5
    assert depths.sum() == 5


def in_lidar_frame(frame_from_lidar: np.ndarray) -> dict:
    """Return results with two points in the frame of the LiDAR, and no earlier sweep."""
    points = torch.tensor([[2.0, 9.0, 20.0, 1, 0], [3.0, 9.0, 30.0, 1, 0]])
    return {
        "token": "a",
        "points": LiDARPoints(points, points_dim=5),
        "lidar2frame": frame_from_lidar,
        "lidar_sweeps": [],
        "timestamp": 1.0,
        "img_shape": (32, 32),
        "raw_shapes": [(32, 32)],
        "lidar2img": [np.eye(4)],
    }


QUARTER_TURN = rigid(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0, 0, 0])
NEED_THE_FRAME = [
    MakeDepthMap(),
    LoadLidarSweeps(sweeps_num=1, use_dim=list(range(5))),
    PackMapInputs(),
]


@pytest.mark.parametrize("step", NEED_THE_FRAME, ids=lambda step: type(step).__name__)
@pytest.mark.parametrize(
    "frame_from_lidar",
    [
        QUARTER_TURN,
        rigid(np.eye(3), [0.94, 0, 1.84]),
        rigid(Rotation.from_euler("x", 0.1, degrees=True).as_matrix(), [0, 0, 0]),
        rigid(np.eye(3), [0, 0, 1e-3]),
    ],
)
def test_points_of_another_frame_are_refused(step, frame_from_lidar):
    message = rf"sample 'a': {type(step).__name__} needs points in the annotation .*PointsToFrame"
    with pytest.raises(InputError, match=message):
        step.transform(in_lidar_frame(frame_from_lidar))
    step.transform(PointsToFrame().transform(in_lidar_frame(frame_from_lidar)))
    step.transform(in_lidar_frame(np.eye(4) + 1e-9))  # rounded


def test_points_that_the_model_does_not_receive_are_not_checked():
    packed = PackMapInputs(with_points=False).transform(in_lidar_frame(QUARTER_TURN))
    assert "points" not in packed["inputs"]


def test_points_are_transformed_to_the_frame_once():
    results = PointsToFrame().transform(in_lidar_frame(QUARTER_TURN))
    expected = torch.tensor([[-9.0, 2, 20], [-9, 3, 30]])
    for _ in range(2):
        torch.testing.assert_close(results["points"].tensor[:, :3], expected)
        results = PointsToFrame().transform(results)


@pytest.mark.parametrize("base", ["nuscenes", "minicity"])
def test_depths_do_not_depend_on_the_annotation_frame(base, minicity_root, tmp_path):
    """The pipelines of the base configs, with files in the frames of LiDAR and vehicle."""
    init_default_scope("mmdet3d")
    config = Config.fromfile(REPO / f"configs/_base_/datasets/{base}.py")
    steps = [step for step in config._depth_seg if "Mask" not in step.type]
    steps = [step for step in steps if step.type not in ("DistortImages", "FormatMapTargets")]
    depths = {}
    for frame in ("lidar", "ego"):
        options = NuScenesOptions(
            minicity_root, "v1.0-trainval", dataset="own", frame=frame, out_dir=tmp_path / frame
        )
        convert_nuscenes(options)
        dataset = {
            "type": "VectorizedMapDataset",
            "data_root": str(minicity_root),
            "ann_file": str(options.path_of("own", "train")),
            "frame": frame,
            "test_mode": True,
            "pipeline": steps,
        }
        depths[frame] = DATASETS.build(dataset)[0]["data_samples"].gt_depth
    # Points at the border of two pixels may be rounded to either.
    differs = (depths["lidar"] - depths["ego"]).abs() > 1e-3
    assert (depths["lidar"] > 0).sum() > 1000
    assert differs.sum() < 0.01 * (depths["lidar"] > 0).sum()


def test_a_sample_without_lidar_is_named():
    with pytest.raises(BrokenSampleError, match=r"'a' has no LiDAR sweep: make the annotation"):
        LoadLidarPoints(**LOAD).transform({"token": "a"})


def test_earlier_sweeps_are_moved_aged_and_named_when_missing(road):
    info = depth_data(road, max_sweeps=2).get_data_info(2)
    results = LoadLidarPoints(**LOAD).transform(info)
    points = LoadLidarSweeps(sweeps_num=2, use_dim=list(range(5))).transform(results)["points"]
    age = points.tensor[:, 4]
    step = SWEEP_EVERY_NS * 1e-9
    # nuScenes' time stamps in seconds are float64, the points' ages float32
    torch.testing.assert_close(age.unique(), torch.tensor([0.0, step, 2 * step]), atol=1e-5, rtol=0)
    for number in range(3):  # all sweeps are the same, seen from a vehicle that has moved on
        x = points.tensor[(age - number * step).abs() < 1e-3, 0]
        assert float(x.mean()) == pytest.approx(-number * step * SPEED_M_S, abs=1e-4)
    before = road / "val/log-a/sensors/lidar" / f"{START_NS + SWEEP_EVERY_NS}.feather"
    before.unlink()
    results = LoadLidarPoints(**LOAD).transform(info)
    message = rf"sample '{info['token']}': no earlier LiDAR sweep at {before}.*--max-sweeps 0"
    with pytest.raises(BrokenSampleError, match=message):
        LoadLidarSweeps(sweeps_num=2, use_dim=list(range(5))).transform(results)


def test_depth_of_a_sweep_between_two_images(road):
    """At the images the closest sweep is 10 or 40 ms away: the vehicle's motion is taken off.

    A point of the ground 1.4 + 0.25 m below a level camera of focal length 1000 px that looks along
    x appears at v = 600 + 1650 / depth; images are scaled by 0.3.
    """
    dataset = depth_data(road, at="cameras")
    summary = convert_argoverse2(Argoverse2Options(road, at="cameras", rate_hz=None))
    note = "5 of 6 samples have a LiDAR sweep, at most 40 ms before or after the sample"
    assert note in summary.notes
    for idx, shift_m in ((0, 0.1), (1, -0.4)):  # 10 ms after a sweep, 40 ms before the next
        data = dataset[idx]["data_samples"]
        assert data.gt_depth.shape == (7, 384, 480)
        rows, cols = torch.nonzero(data.gt_depth[0]).T
        depth = data.gt_depth[0][rows, cols]
        assert len(depth) > 30
        on_ground = 0.3 * (600 + 1650 / depth)
        assert (rows - on_ground).abs().max() <= 0.51  # rounded to a pixel
        nearest_grid = (depth + 1.6 + shift_m) / 2  # the grid is 2 m wide, the camera 1.6 m ahead
        assert (nearest_grid - nearest_grid.round()).abs().max() < 1e-3


def test_no_depth_is_set_in_padding(road):
    """Camera 1 has images of 900 rows, 270 when scaled: ground nearer than 5.5 m lies below them.

    Of the points 4.3 m and 6.3 m ahead of the cameras, at rows 180 + 0.3 * 1650 / depth, the nearer
    is at row 295, in the padding of camera 1.
    """
    low = cv2.imencode(".jpg", np.full((900, 1600, 3), 90, np.uint8))[1].tobytes()
    for path in (road / "val/log-a/sensors/cameras" / RING_CAMERAS[1]).iterdir():
        path.write_bytes(low)
    intrinsics = road / "val/log-a/calibration/intrinsics.feather"
    table = feather.read_feather(intrinsics)
    table.loc[table["sensor_name"] == RING_CAMERAS[1], "height_px"] = 900
    feather.write_feather(table, intrinsics)
    depth = depth_data(road, at="cameras")[0]["data_samples"].gt_depth
    assert [int(torch.nonzero(view)[:, 0].max()) for view in depth[:2]] == [295, 259]


def test_depth_of_a_real_log(shared_dir: Path, tmp_path: Path):
    """The real sweeps with grey images: most returns are on the ground, and near pixels are low."""
    source = shared_dir / "av2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    sweeps = sorted((source / "sensors/lidar").glob("*.feather"))
    if not sweeps:
        pytest.skip(f"no LiDAR sweep in {source}")
    log = tmp_path / "val" / source.name
    log.mkdir(parents=True)
    for name in ("map", "calibration", "city_SE3_egovehicle.feather"):
        (log / name).symlink_to(source / name)
    (log / "sensors").mkdir()
    (log / "sensors/lidar").symlink_to(source / "sensors/lidar")
    for name in RING_CAMERAS:
        size = (2048, 1550) if name == "ring_front_center" else (1550, 2048)
        folder = log / "sensors/cameras" / name
        folder.mkdir(parents=True)
        cv2.imwrite(str(folder / f"{sweeps[0].stem}.jpg"), np.full((*size, 3), 90, np.uint8))
    for sweep in sweeps[1:]:
        for name in RING_CAMERAS:
            folder = log / "sensors/cameras" / name
            shutil.copy(folder / f"{sweeps[0].stem}.jpg", folder / f"{sweep.stem}.jpg")

    dataset = depth_data(tmp_path, max_sweeps=1)
    assert len(dataset) == len(sweeps)
    info = dataset.get_data_info(len(sweeps) - 1)
    points = LoadLidarPoints(**LOAD).transform(info)["points"].tensor
    assert len(points) == feather.read_table(sweeps[-1]).num_rows
    ahead = points[(points[:, 0] > 5) & (points[:, 0] < 15) & (points[:, 1].abs() < 1.5)]
    assert -0.6 < float(ahead[:, 2].median()) < 0.0  # the road; the origin is the rear axle
    data = dataset[0]["data_samples"]
    assert data.gt_depth.shape == (7, 640, 640)
    for view in range(7):
        rows, _ = torch.nonzero(data.gt_depth[view]).T
        depth = data.gt_depth[view][data.gt_depth[view] > 0]
        assert len(depth) > 1000
        assert 1 <= float(depth.min()) < float(depth.max()) < 60
        last_row = 0.3 * (2048 if view == 0 else 1550)
        assert int(rows.max()) <= last_row
        low = rows > 0.8 * last_row
        assert depth[low].median() < depth[~low].median()
