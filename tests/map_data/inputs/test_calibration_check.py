"""Corrupted calibrations are noticed, right ones pass without a word."""

import re
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CameraRecord
from gsmap.datasets.source import Source, ground_from_frame, sample_in_vehicle
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.visualization.figure import figure_to_rgb
from mapdata.argoverse2.log import Argoverse2Log
from mapdata.calibration_check import (
    calibration_figure,
    calibration_warnings,
    first_samples,
    image_warnings,
)
from mapdata.infos.recordings import read_info_file
from tools import infer

LOG = "av2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


@pytest.fixture(scope="module")
def town(minicity_annotations):
    return list(AnnotationFile(minicity_annotations["val"]))


def changed(sample, name, change):
    """Change one camera's (or each one's, by None) pose on the ground and its record."""
    ground = ground_from_frame(sample, "lidar")
    cameras = []
    for camera in sample.cameras:
        if name in (None, camera.name):
            pose, camera = change(ground @ invert_rigid(camera.cam_from_frame), camera)
            camera = replace(camera, cam_from_frame=invert_rigid(pose) @ ground)
        cameras.append(camera)
    return replace(sample, cameras=cameras)


def turned(axis, degrees):
    """Return a change: the camera is turned about one of the vehicle's axes, in its place."""

    def change(pose, camera):
        pose = pose.copy()
        pose[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix() @ pose[:3, :3]
        return pose, camera

    return change


def rolled(degrees):
    def change(pose, camera):
        pose = pose.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        return pose, camera

    return change


def scaled(factor):
    def change(pose, camera):
        pose = pose.copy()
        pose[:3, 3] *= factor
        return pose, camera

    return change


def mirrored(pose, camera):
    """Left and right are swapped: y has the wrong sign, in position and in rotation."""
    mirror = np.diag([1.0, -1, 1, 1])
    image = np.diag([-1.0, 1, 1, 1])  # keeps the rotation proper
    return mirror @ pose @ image, camera


def sunk(pose, camera):
    pose = pose.copy()
    pose[2, 3] -= 2.5
    return pose, camera


def wrong_side(pose, camera):
    """Only the position has the wrong sign."""
    pose = pose.copy()
    pose[1, 3] *= -1
    return pose, camera


def resized(factor):
    """The image is smaller or larger than its intrinsics say."""

    def change(pose, camera):
        size = round(camera.width * factor), round(camera.height * factor)
        return pose, replace(camera, width=size[0], height=size[1])

    return change


def with_intrinsics(matrix):
    return lambda pose, camera: (pose, replace(camera, intrinsics=np.array(matrix, float)))


def optical_as_body(pose, camera):
    """The camera's frame has x ahead and z up, as ROS bodies have."""
    pose = pose.copy()
    pose[:3, :3] = pose[:3, :3] @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    return pose, camera


def inverted(pose, camera):
    """The inverse is taken for the transform."""
    return invert_rigid(pose), camera


FRONT, LEFT = "CAM_FRONT", "CAM_FRONT_LEFT"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (None, scaled(1000), "are positions in millimetres"),
        (None, scaled(100), "are positions in centimetres"),
        (None, scaled(0), "all cameras stand in one point"),
        (FRONT, scaled(0.05), "m above the road: is the unit metres?"),
        (FRONT, sunk, "m below the road"),
        (FRONT, turned("y", -60), r"looks 60 degrees up at the sky"),
        (FRONT, optical_as_body, "up at the sky"),
        (None, inverted, "at the sky|upside down|below the road|on its side|at the road"),
        (FRONT, turned("y", 90), "down at the road"),
        (FRONT, rolled(180), "is upside down: up and down are swapped"),
        (FRONT, rolled(90), "lies on its side"),
        (
            LEFT,
            mirrored,
            r"'CAM_FRONT_LEFT' has 'left' in its name, but looks 5\d degrees",
        ),
        (FRONT, turned("z", 180), "has 'front' in its name, but looks 180 degrees"),
        (LEFT, wrong_side, "stands on the right and looks to the left: are axes mirrored"),
        (FRONT, resized(0.5), "the intrinsics seem to be of images of about 403 x 239"),
        (FRONT, resized(2), "the intrinsics seem to be of images of about 403 x 239"),
        (FRONT, with_intrinsics([[1, 0, 200], [0, 1, 112], [0, 0, 1]]), "is fx in pixels?"),
        (FRONT, with_intrinsics([[300, 0, 200], [0, 200, 112], [0, 0, 1]]), "image squeezed?"),
    ],
)
def test_a_corrupted_calibration_is_noticed(town, name, change, message):
    found = calibration_warnings([changed(town[0], name, change)], "lidar")
    assert any(re.search(message, line) for line in found), found
    if name is not None and name != "CAM_FRONT_LEFT":
        assert all(name in line for line in found)  # and no other camera


def test_a_camera_that_the_first_sample_lacks_is_checked(town):
    """The first sample lacks a camera, which is upside down in the second."""
    first = replace(town[0], cameras=[c for c in town[0].cameras if c.name != FRONT])
    samples = [first, replace(changed(town[0], FRONT, rolled(180)), token="second")]
    (warning,) = calibration_warnings(samples, "lidar")
    assert warning.startswith(f"camera {FRONT!r} is upside down")
    (sample,) = first_samples(samples)
    assert sample.token == first.token
    assert len(sample.cameras) == len(town[0].cameras)


def test_right_calibrations_pass(town, shared_dir):
    assert calibration_warnings(town, "lidar") == []
    assert (
        calibration_warnings(
            read_info_file(next(shared_dir.glob("nuscenes_sample/*.pkl"))), "lidar"
        )
        == []
    )
    cameras = [
        CameraRecord(
            name, "none.jpg", camera.width_px, camera.height_px, camera.intrinsics.K,
            camera.ego_SE3_cam.inverse().transform_matrix,
        )
        for name, camera in Argoverse2Log(shared_dir / LOG).calibration.items()
    ]  # fmt: skip
    assert len(cameras) == 7
    sample = replace(sample_in_vehicle("a", "b", 0, [], None), cameras=cameras)
    assert calibration_warnings([sample], "ego") == []


def test_images_of_another_size_are_noticed(town, minicity_root, tmp_path):
    sample = town[0]
    assert image_warnings(sample, minicity_root) == []
    camera = sample.cameras[0]
    (tmp_path / camera.path).parent.mkdir(parents=True)
    Image.new("RGB", (800, 450)).save(tmp_path / camera.path)
    (line,) = image_warnings(sample, tmp_path)
    assert "has images of 800 x 450 pixels, but is calibrated for 400 x 225" in line
    other = replace(sample, scene="other", cameras=[replace(camera, path="none.jpg")])
    for order in ([sample, other], [other, sample]):  # of two drives, in either order
        source = Source(order, "lidar", data_root=tmp_path)
        found = infer.check_calibration(Namespace(check_calibration=None), source)
        assert [text for text in found if "has images of" in text] == [line]


def test_poses_are_checked_beside_the_calibration(town, tmp_path, capsys):
    poses = [rigid(np.eye(3), [0.0, 3.0 * number, 0.0]) for number in range(5)]  # y is ahead
    for is_wrong in (False, True):
        samples = []
        for number, pose in enumerate(poses):
            wrong = rigid(pose[:3, :3], pose[[1, 0, 2], 3])  # exchanged
            pose = wrong if is_wrong else pose
            time_ns = number * 10**9
            sample = replace(town[0], token=str(number), timestamp_ns=time_ns)
            samples.append(replace(sample, global_from_frame=pose))
        source = Source(samples, "lidar", data_root=tmp_path)
        assert infer.check_calibration(Namespace(check_calibration=None), source) == []
        printed = capsys.readouterr().out
        assert ("poses: the vehicle moves 90 degrees sideways" in printed) == is_wrong
        without = replace(source, has_poses=False)
        infer.check_calibration(Namespace(check_calibration=None), without)
        assert capsys.readouterr().out == ""


def test_the_ground_is_drawn_where_the_cameras_see_it(town, minicity_root):
    """A camera below the road sees none of it, and the picture changes."""
    sample = town[0]
    right = figure_to_rgb(calibration_figure(sample, "lidar", minicity_root)).astype(int)
    wrong = figure_to_rgb(calibration_figure(changed(sample, FRONT, sunk), "lidar", minicity_root))
    assert (np.abs(right - wrong).max(-1) > 50).sum() > 500
    assert right.shape[1] == 3200  # six cameras large enough to judge


def test_the_command_warns_draws_and_says_so_by_its_exit_code(tmp_path, capsys):
    (tmp_path / "left").mkdir()
    Image.new("RGB", (160, 90)).save(tmp_path / "left/a.png")
    camera = {"intrinsics": [100, 100, 80, 45], "position_m": [0, 0.5, 1.5]}
    path, picture = tmp_path / "calibration.yaml", tmp_path / "ground.png"
    words = [str(tmp_path), "--check-calibration", str(picture)]
    for yaw, warned in ((90, False), (-90, True)):
        calibrated = {"cameras": {"left": camera | {"yaw_pitch_roll_deg": [yaw, 0, 0]}}}
        path.write_text(yaml.safe_dump(calibrated))
        with pytest.raises(SystemExit) as end:
            infer.main(words)
        assert end.value.code == (infer.IMPLAUSIBLE if warned else 0)
        printed = capsys.readouterr().out
        assert ("calibration: camera 'left' has 'left' in its name" in printed) == warned
        assert picture.stat().st_size > 10_000
        picture.unlink()
