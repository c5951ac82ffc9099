"""Every kind of input becomes the samples that its annotation file has, or names its trouble."""

import json
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.source import change_frame, ground_from_frame
from gsmap.structures.frames import FRAME_VIEWS
from gsmap.structures.rigid import invert_rigid
from mapdata.argoverse2.log import Argoverse2Log
from mapdata.inputs import open_input
from mapdata.options import InputOptions

LOG = Path("av2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede")


@pytest.fixture(scope="module")
def town(minicity_root, minicity_annotations):
    """The root and the samples of its annotation files, by token."""
    return {s.token: s for path in minicity_annotations.values() for s in AnnotationFile(path)}


def same_cameras(sample, other):
    for a, b in zip(sample.cameras, other.cameras, strict=True):
        assert (a.name, a.width, a.height) == (b.name, b.width, b.height)
        np.testing.assert_allclose(a.intrinsics, b.intrinsics)
        np.testing.assert_allclose(a.cam_from_frame, b.cam_from_frame, atol=1e-6)


def test_a_nuscenes_root_gives_the_samples_of_its_annotation_files(minicity_root, town):
    source = open_input(minicity_root)
    assert source.frame == "lidar"
    assert source.data_root == minicity_root
    assert {sample.token for sample in source.samples} == set(town)
    for sample in source.samples:
        other = town[sample.token]
        same_cameras(sample, other)
        assert [c.path for c in sample.cameras] == [c.path for c in other.cameras]
        np.testing.assert_array_equal(sample.global_from_frame, other.global_from_frame)
        np.testing.assert_array_equal(sample.can_bus, other.can_bus)
        assert sample.lidar.path == other.lidar.path
        assert sample.instances is None
    with pytest.raises(ValueError, match=r"no version 'v9', but \['v1.0-trainval'\]"):
        open_input(minicity_root, InputOptions(version="v9"))


def test_another_frame_sees_the_same_cameras_and_ground(town):
    sample = next(iter(town.values()))
    ego = change_frame(sample, "lidar", "ego")
    back = change_frame(ego, "ego", "lidar")
    assert ego.instances is None
    spot = np.array([7.0, 2.0, 0.0, 1.0])  # on the ground, ahead and to the left
    for frame, seen in (("lidar", sample), ("ego", ego), ("lidar", back)):
        at = invert_rigid(ground_from_frame(seen, frame)) @ spot
        a, b, c = FRAME_VIEWS[frame].with_mounting(seen.ego_from_frame).ground
        assert at[2] == pytest.approx(a * at[0] + b * at[1] + c)
        world = seen.global_from_frame @ at
        np.testing.assert_allclose(
            world,
            sample.global_from_frame @ invert_rigid(ground_from_frame(sample, "lidar")) @ spot,
        )
        in_cameras = [camera.cam_from_frame @ at for camera in seen.cameras]
        expected = invert_rigid(ground_from_frame(sample, "lidar")) @ spot
        np.testing.assert_allclose(
            in_cameras, [camera.cam_from_frame @ expected for camera in sample.cameras], atol=1e-9
        )


def test_an_argoverse_2_log_needs_no_map(tmp_path, shared_dir):
    """A real log's calibration and poses; images at three times of its poses, 0.6 s apart."""
    log_dir, real = tmp_path / "sensor/val" / LOG.name, Argoverse2Log(shared_dir / LOG)
    log_dir.mkdir(parents=True)
    for name in ("calibration", "city_SE3_egovehicle.feather"):
        (log_dir / name).symlink_to(real.log_dir / name)
    with pytest.raises(ValueError, match=r"no sample can be read from .* no images of ring_front"):
        open_input(tmp_path)
    poses = np.array(list(real.poses))
    times = [int(poses[np.searchsorted(poses, poses[0] + i * 600_000_000)]) for i in range(3)]
    for name in real.calibration:
        (log_dir / "sensors/cameras" / name).mkdir(parents=True)
        for time_ns in times:
            (log_dir / f"sensors/cameras/{name}/{time_ns}.jpg").touch()
    for path in (tmp_path, log_dir):
        source = open_input(path)
        assert source.frame == "ego"
        assert [s.timestamp_ns for s in source.samples] == times
        sample = source.samples[1]
        np.testing.assert_array_equal(sample.global_from_frame, real.poses[times[1]])
        assert {c.name for c in sample.cameras} == set(real.calibration)
        for camera in sample.cameras:
            assert (source.data_root / camera.path).is_file()
            expected = real.calibration[camera.name].ego_SE3_cam.inverse().transform_matrix
            np.testing.assert_allclose(camera.cam_from_frame, expected, atol=1e-9)
    assert len(open_input(tmp_path, InputOptions(rate_hz=1.0)).samples) == 2


def image_folder(folder, sample, root, number=0):
    """Write a sample's images into one folder a camera; return the calibration that fits."""
    cameras = {}
    for camera in sample.cameras:
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
        image = (root / camera.path).read_bytes()
        (folder / camera.name / f"{number:03d}.jpg").write_bytes(image)
        ground_from_cam = ground_from_frame(sample, "lidar") @ invert_rigid(camera.cam_from_frame)
        x, y, z, w = Rotation.from_matrix(ground_from_cam[:3, :3]).as_quat().tolist()
        k = camera.intrinsics
        cameras[camera.name] = {
            "intrinsics": [float(k[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "position_m": ground_from_cam[:3, 3].tolist(),
            "quaternion_wxyz": [w, x, y, z],
        }
    return {"cameras": cameras}


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration.json"])
def test_a_folder_of_images_gives_the_cameras_that_its_calibration_says(
    tmp_path, minicity_root, town, name
):
    samples = [s for s in town.values() if s.scene == next(iter(town.values())).scene]
    for number, sample in enumerate(samples):
        calibration = image_folder(tmp_path, sample, minicity_root, number)
    dump = json.dumps if name.endswith("json") else partial(yaml.safe_dump, sort_keys=False)
    (tmp_path / name).write_text(dump(calibration))
    source = open_input(tmp_path)
    assert not source.has_poses
    assert [s.timestamp_ns for s in source.samples] == [0, 10**8]
    assert source.samples[1].cameras[0].path == "CAM_FRONT/001.jpg"
    same_cameras(change_frame(source.samples[1], "ego", "lidar"), reframed_nominal(samples[1]))


def reframed_nominal(sample):
    """Return a sample in the nominal LiDAR frame instead of its own."""
    return change_frame(change_frame(sample, "lidar", "ego"), "ego", "lidar")


def test_angles_times_and_poses_of_a_folder(tmp_path):
    """A camera that looks ahead and one to the left; the vehicle drives 10 m/s along y."""
    start = 1_700_000_000_000_000_000
    for name, shift_ns in (("ahead", 0), ("port", 20_000_000)):
        (tmp_path / name).mkdir()
        for i in range(3):
            time_ns = start + i * 10**8 + shift_ns
            cv2.imwrite(f"{tmp_path}/{name}/{name}_{time_ns}.png", np.zeros((90, 160, 3), np.uint8))
    cameras = {
        name: {
            "intrinsics": [[100, 0, 80], [0, 100, 45], [0, 0, 1]],
            "position_m": [1.5, 0.0, 1.4],
            "yaw_pitch_roll_deg": [yaw, 0, 0],
        }
        for name, yaw in (("ahead", 0), ("port", 90))
    }
    rows = [
        f"{1_700_000_000_000_000_000 + i * 10**8},0,{i},0,0.7071068,0,0,0.7071068" for i in (0, 2)
    ]
    (tmp_path / "poses.csv").write_text("timestamp_ns,x,y,z,qw,qx,qy,qz\n" + "\n".join(rows))
    content = {"cameras": cameras, "poses": "poses.csv", "ground_z_m": -0.5}
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump(content))
    source = open_input(tmp_path / "calibration.yaml")
    assert source.has_poses
    assert [s.timestamp_ns - start for s in source.samples] == [0, 10**8, 2 * 10**8]
    middle = source.samples[1]
    at = invert_rigid(ground_from_frame(middle, "ego"))
    np.testing.assert_allclose((middle.global_from_frame @ at)[:3, 3], [0, 1, -0.5], atol=1e-6)
    ahead, port = middle.cameras
    # 5 m ahead of the camera, at its height above the ground: 1.4 m + 0.5 m
    np.testing.assert_allclose(
        ahead.cam_from_frame @ at @ [6.5, 0, 1.9, 1], [0, 0, 5, 1], atol=1e-6
    )
    # 4 m to the left of its place 20 ms later, when the vehicle is 0.2 m further
    np.testing.assert_allclose(port.cam_from_frame @ at @ [1.7, 4, 1.9, 1], [0, 0, 4, 1], atol=1e-6)


def test_distorted_images_are_rectified_into_a_folder_of_their_own(tmp_path):
    drive, frames = tmp_path / "drive", tmp_path / "frames"
    (drive / "front").mkdir(parents=True)
    board = (np.indices((180, 320)).sum(0) // 20 % 2 * 255).astype(np.uint8)
    cv2.imwrite(str(drive / "front/a.png"), cv2.merge([board] * 3))
    (drive / "front/b.png").write_bytes(b"no image")
    cv2.imwrite(str(drive / "front/c.jpg"), cv2.merge([board] * 3))
    camera = {
        "intrinsics": [200, 200, 160, 90], "distortion": [-0.3, 0.1, 0, 0],
        "position_m": [1, 0, 1.5], "yaw_pitch_roll_deg": [0, 0, 0],
    }  # fmt: skip
    (drive / "calibration.yaml").write_text(yaml.safe_dump({"cameras": {"front": camera}}))
    source = open_input(drive, InputOptions(frames_dir=frames))
    assert source.data_root.parent == frames
    names = [sample.cameras[0].path for sample in source.samples]
    assert names == ["front/a.png.jpg", "front/b.png.jpg", "front/c.jpg"]
    matrix = np.array([[200.0, 0, 160], [0, 200, 90], [0, 0, 1]])
    expected = cv2.undistort(cv2.merge([board] * 3), matrix, np.array([-0.3, 0.1, 0, 0]))
    written = cv2.imread(str(source.data_root / "front/a.png.jpg"))
    assert np.abs(written.astype(int) - expected).mean() < 3  # JPEG's loss
    assert not (source.data_root / "front/b.png.jpg").exists()
    _, note = source.notes
    assert "front/b.png is not an image" in note


LEVEL = {"intrinsics": [100, 100, 80, 45], "position_m": [0, 0, 1], "yaw_pitch_roll_deg": [0, 0, 0]}


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"focal": 3}, r"camera 'front' cannot be used: unknown keys \['focal'\]"),
        ({"intrinsics": [1, 2]}, r"intrinsics must be \[fx, fy, cx, cy\] or 3 x 3, got \(2,\)"),
        ({"quaternion_wxyz": [1, 0, 0, 0]}, "say its place by"),
        ({"vehicle_from_camera": np.eye(4).tolist()}, "say its place by"),
        ({"images": "nowhere"}, "camera 'front' has no image at"),
        ({"images": "../secret"}, "must lie below"),
        ({"distortion": [1, 2], "distortion_model": "magic"}, "distortion model 'magic'"),
        ({"yaw_pitch_roll_deg": ["a", 0, 0]}, "camera 'front' cannot be used"),
    ],
)  # fmt: skip
def test_a_wrong_calibration_file_names_the_camera(tmp_path, camera, message):
    (tmp_path / "front").mkdir()
    cv2.imwrite(str(tmp_path / "front/a.png"), np.zeros((90, 160, 3), np.uint8))
    content = {"cameras": {"front": LEVEL | camera}}
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_input(tmp_path)


def test_two_images_of_a_camera_with_one_name_are_refused(tmp_path):
    """Frames are told apart by names; one of the two was shown twice."""
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "0.png"), np.zeros((90, 160, 3), np.uint8))
    content = {"cameras": {"front": LEVEL | {"images": "*/0.png"}}}
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=r"'front' .*two of its images .* have equal names"):
        open_input(tmp_path)


def test_a_mirrored_mounting_is_named(tmp_path):
    (tmp_path / "front").mkdir()
    cv2.imwrite(str(tmp_path / "front/a.png"), np.zeros((90, 160, 3), np.uint8))
    mirror = np.diag([1.0, -1, 1, 1]).tolist()
    camera = {"intrinsics": [100, 100, 80, 45], "vehicle_from_camera": mirror}
    (tmp_path / "calibration.yaml").write_text(yaml.safe_dump({"cameras": {"front": camera}}))
    with pytest.raises(ValueError, match=r"'front'.* mirrors .*two axes are swapped"):
        open_input(tmp_path)


def test_a_position_beside_a_whole_pose_is_refused(tmp_path):
    (tmp_path / "front").mkdir()
    cv2.imwrite(str(tmp_path / "front/a.png"), np.zeros((90, 160, 3), np.uint8))
    pose = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.2], [0, 0, 0, 1]]
    camera = {"intrinsics": [100, 100, 80, 45], "vehicle_from_camera": pose}
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump({"cameras": {"front": camera}}))
    open_input(tmp_path)
    path.write_text(yaml.safe_dump({"cameras": {"front": camera | {"position_m": [1.7, 0, 0]}}}))
    with pytest.raises(ValueError, match="contains the position: leave position_m out"):
        open_input(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras: [", "it is no YAML"),
        ("cameras:\n\tfront: 1", "it is no YAML"),
        ("cameras: *nobody", "it is no YAML"),
        ("a: 'open", "it is no YAML"),
        ("!!python/object/apply:os.system [ls]", "it is no YAML"),
        ("a: &a {x: 1}\nb: {<<: *a}", "it is no YAML"),
        ("[" * 3000, "Recursion"),
        ("a: &a [0]\n" + "".join(
            f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghijk")
        ), "more than 100000 values"),
        ("cameras: {}\nrate_hz: 0", "at least one"),
        ("", "must be a mapping"),
    ],
)  # fmt: skip
def test_what_is_no_calibration_in_yaml_is_named(tmp_path, text, message):
    (tmp_path / "calibration.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"calibration\.yaml cannot be used: .*{message}"):
        open_input(tmp_path)


def folder_of(drive, camera=None, value=99, **more):
    """Write a folder with one distorted camera and its grey image."""
    (drive / "front").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(drive / "front/0.png"), np.full((90, 160, 3), value, np.uint8))
    content = {"cameras": {"front": LEVEL | {"distortion": [-0.2, 0.05, 0, 0]} | (camera or {})}}
    (drive / "calibration.yaml").write_text(yaml.safe_dump(content | more))
    return drive


def test_two_folders_of_one_name_and_a_corrected_calibration_have_their_own_pictures(tmp_path):
    options = InputOptions(frames_dir=tmp_path / "frames")

    def picture(**given):
        source = open_input(folder_of(tmp_path / "drive", **given), options)
        image = cv2.imread(str(source.data_root / source.samples[0].cameras[0].path))
        return source.data_root, int(image[45, 80, 0]), image.tobytes()

    first = picture()
    assert picture() == first
    assert picture(value=9)[1] == pytest.approx(9, abs=2)
    bent = picture(camera={"distortion": [0.3, 0, 0, 0]})
    assert bent[0] != first[0]
    assert bent[2] != first[2]


@pytest.mark.parametrize(
    ("camera", "more", "message"),
    [
        ({"distortion": [0.1]}, {}, "takes 4 or 5 or 8"),
        ({"distortion": [0.1] * 3}, {}, "takes 4 or 5 or 8"),
        ({"distortion": [0.1] * 7}, {}, "takes 4 or 5 or 8"),
        ({"distortion": [float("nan"), 0, 0, 0]}, {}, "all finite"),
        ({"distortion": [1e9, 0, 0, 0]}, {}, "sees next to nothing"),
        ({"distortion": [0.1] * 5, "distortion_model": "fisheye"}, {}, "takes 4 numbers"),
        ({"size_px": [0, 0]}, {}, r"images of \(0, 0\) pixels"),
        ({}, {"rate_hz": 0}, "rate_hz must be > 0"),
        ({}, {"max_time_difference_ms": -1}, "max_time_difference_ms >= 0"),
        ({}, {"poses": "../poses.csv"}, "poses must lie below"),
    ],
)
def test_values_that_cannot_be_are_named_and_no_picture_is_made(tmp_path, camera, more, message):
    folder_of(tmp_path / "drive", camera, **more)
    with pytest.raises(ValueError, match=rf"calibration\.yaml.* cannot be used: .*{message}"):
        open_input(tmp_path / "drive", InputOptions(frames_dir=tmp_path / "frames"))
    assert not (tmp_path / "frames").exists()


def test_a_bad_first_image_does_not_end_the_run(tmp_path):
    drive = folder_of(tmp_path / "drive")
    (drive / "front/-.png").write_bytes(b"")
    source = open_input(drive, InputOptions(frames_dir=tmp_path / "frames"))
    assert [camera.width for s in source.samples for camera in s.cameras] == [160, 160]
    _, note = source.notes
    assert "front/-.png is not an image" in note


def test_what_is_no_input_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="There is no input"):
        open_input(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match="holds no input: it must be an annotation file"):
        open_input(tmp_path)
    (tmp_path / "a.arrow").touch()
    (tmp_path / "b.pkl").touch()
    with pytest.raises(ValueError, match=r"several files \(a.arrow, b.pkl\)"):
        open_input(tmp_path)
    (tmp_path / "c.txt").touch()
    with pytest.raises(ValueError, match=r"c.txt is no input"):
        open_input(tmp_path / "c.txt")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("calibration.yaml", "cameras:\n  front: {images: a}\n  front: {images: b}\n"),
        ("calibration.json", '{"cameras": {"front": {}, "front": {}}}'),
        ("calibration.yaml", "ground_z_m: 0\nground_z_m: 1\ncameras: {front: {}}\n"),
    ],
)
def test_what_a_calibration_names_twice_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    twice = "ground_z_m" if "ground" in text else "front"
    with pytest.raises(ValueError, match=f"{twice} is there twice"):
        open_input(tmp_path / name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vehicle_ground_z_m": 0.0}, "--vehicle-ground-z belongs to a bag"),
        ({"vehicle_frame": "car"}, "--vehicle-frame belong to a bag"),
        ({"topics": {"front": ("/front", "")}}, "--topics, .* belong to a bag"),
        ({"calibration": Path("calibration.yaml")}, "--calibration .* belong to a bag"),
    ],
)
def test_an_option_for_a_bag_is_refused_for_another_input(
    tmp_path, minicity_root, minicity_annotations, options, message
):
    """Also if files of bags lie beside the input, which comes first."""
    for name in ("maps", "v1.0-trainval"):
        (tmp_path / name).symlink_to(minicity_root / name)
    (tmp_path / "drive_0.mcap").touch()
    for path in (minicity_annotations["val"], tmp_path):
        with pytest.raises(ValueError, match=message):
            open_input(path, InputOptions(**options))


def test_a_distorted_camera_is_rectified_to_the_focal_length_of_the_training(tmp_path):
    """A bright spot of the distorted image lies where OpenCV puts it for the trained camera."""
    intrinsics = np.array([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
    distortion, spot = [-0.25, 0.06, 0.001, -0.002], (450.0, 120.0)
    columns, rows = np.meshgrid(np.arange(640), np.arange(360))
    blob = 255 * np.exp(-((columns - spot[0]) ** 2 + (rows - spot[1]) ** 2) / 50)
    (tmp_path / "front").mkdir()
    cv2.imwrite(str(tmp_path / "front/0.png"), np.repeat(blob[..., None], 3, 2).astype(np.uint8))
    camera = {
        "intrinsics": [500.0, 500.0, 320.0, 180.0],
        "distortion": distortion,
        "position_m": [1.0, 0.0, 1.5],
        "yaw_pitch_roll_deg": [0, 0, 0],
    }
    (tmp_path / "calibration.json").write_text(json.dumps({"cameras": {"front": camera}}))
    wanted = np.array([[400.0, 0, 330], [0, 410, 170], [0, 0, 1]])
    trained = {"front": (320, 180, 200.0, 205.0, 165.0, 85.0)}  # of images half as large
    seen = {}
    for name, target in (("own", {}), ("trained", trained), ("other", {"rear": trained["front"]})):
        source = open_input(tmp_path, InputOptions(frames_dir=tmp_path / "made", trained=target))
        (record,) = source.samples[0].cameras
        image = cv2.imread(str(source.data_root / record.path))[..., 0].astype(float)
        centre = [(image * at).sum() / image.sum() for at in (columns, rows)]
        (expected,) = cv2.undistortPoints(
            np.array([[spot]]), intrinsics, np.array(distortion), P=record.intrinsics
        )[0]
        np.testing.assert_allclose(centre, expected, atol=1.0)
        seen[name] = record.intrinsics, source.data_root
    np.testing.assert_allclose(seen["trained"][0], wanted)
    np.testing.assert_allclose(seen["own"][0], intrinsics)
    np.testing.assert_allclose(seen["other"][0], intrinsics)
    assert seen["own"][1] == seen["other"][1] != seen["trained"][1]  # pictures of their own
