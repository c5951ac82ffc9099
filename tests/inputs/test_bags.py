"""Bags of ROS 1 and ROS 2 become the samples of the drive that was recorded."""

import sys

import cv2
import numpy as np
import pytest
from bag_cases import AXLE_M, Recorder, record

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.inputs.frames import ground_from_frame, reframed
from gsmap.inputs.source import InputOptions, open_input
from gsmap.structures.rigid import invert_rigid


@pytest.fixture(scope="module")
def drive(minicity_root, minicity_annotations):
    return list(AnnotationFile(minicity_annotations["val"]))


def options(tmp_path, **more):
    return InputOptions(
        frames_dir=tmp_path / "frames", rate_hz=None, vehicle_ground_z_m=-AXLE_M, **more
    )


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap", "mcap file"])
def test_a_bag_gives_the_samples_that_were_recorded(drive, minicity_root, tmp_path, kind):
    recorder = Recorder(tmp_path / "drive", kind.split()[0])
    record(recorder, drive, minicity_root)
    path = next(recorder.path.glob("*.mcap")) if kind == "mcap file" else recorder.path
    source = open_input(path, options(tmp_path))
    assert source.has_poses
    assert [s.timestamp_ns for s in source.samples] == [s.timestamp_ns for s in drive]
    # in ROS' static transforms a camera stands where it stood first, the vehicle's motion apart
    nominal = reframed(reframed(drive[0], "lidar", "ego"), "ego", "lidar")
    found = {camera.name: camera for camera in reframed(source.samples[0], "ego", "lidar").cameras}
    assert set(found) == {camera.name for camera in drive[0].cameras}
    for camera in nominal.cameras:
        other = found[camera.name]
        assert (other.width, other.height) == (camera.width, camera.height)
        np.testing.assert_allclose(other.intrinsics, camera.intrinsics)
        np.testing.assert_allclose(other.cam_from_frame, camera.cam_from_frame, atol=1e-6)
        original = (minicity_root / camera.path).read_bytes()
        assert (source.data_root / other.path).read_bytes() == original
    for sample, other in zip(source.samples, drive, strict=True):
        at = sample.global_from_frame @ invert_rigid(ground_from_frame(sample, "ego"))
        expected = other.global_from_frame @ invert_rigid(ground_from_frame(other, "lidar"))
        np.testing.assert_allclose(at, expected, atol=1e-6)


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8"])
def test_raw_images_and_no_pose(drive, minicity_root, tmp_path, encoding):
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, drive[:1], minicity_root, poses=None, raw=encoding)
    source = open_input(recorder.path, options(tmp_path))
    assert not source.has_poses
    (sample,) = source.samples
    for camera in sample.cameras:
        original = next(c for c in drive[0].cameras if c.name == camera.name)
        image = cv2.imread(str(minicity_root / original.path)).astype(int)
        written = cv2.imread(str(source.data_root / camera.path))
        assert np.abs(written - image).mean() < 3  # JPEG's loss


def test_distorted_images_are_rectified(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, drive[:1], minicity_root, distortion=(-0.3, 0.1, 0, 0, 0))
    source = open_input(recorder.path, options(tmp_path))
    camera = source.samples[0].cameras[0]
    original = next(c for c in drive[0].cameras if c.name == camera.name)
    image = cv2.imread(str(minicity_root / original.path))
    expected = cv2.undistort(image, camera.intrinsics, np.array([-0.3, 0.1, 0, 0, 0]))
    written = cv2.imread(str(source.data_root / camera.path)).astype(int)
    assert np.abs(written - expected).mean() < 3


def test_what_a_bag_lacks_is_said_with_what_it_holds(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "no_images", "sqlite")
    with recorder:
        recorder.transform("/tf", 1, "odom", "base_link", np.eye(4))
        recorder.info(drive[0].cameras[0], 1)
    with pytest.raises(
        ValueError,
        match=r"no camera with images .*it holds: /CAM_FRONT/camera_info \(.*CameraInfo, 1\); /tf ",
    ):
        open_input(recorder.path, options(tmp_path))
    recorder = Recorder(tmp_path / "good", "sqlite")
    record(recorder, drive[:1], minicity_root)
    with pytest.raises(ValueError, match=r"no frame car: .*--vehicle-frame; there are .*'odom'"):
        open_input(recorder.path, options(tmp_path, vehicle_frame="car"))


def test_a_damaged_bag_and_a_missing_extra_are_named(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"no bag at all")
    with pytest.raises(ValueError, match=r"a.mcap cannot be used"):
        open_input(path)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(RuntimeError, match=r"`pip install -e .\[bags\]`"):
        open_input(path)
