"""Bags of ROS 1 and ROS 2 become the samples of the drive that was recorded."""

import json
import re
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from bag_cases import Recorder, Straight, options, record, starting_at_0

from gsmap.datasets.source import change_frame, ground_from_frame
from gsmap.structures.elements import MapElements
from gsmap.structures.rigid import invert_rigid
from mapdata.bag_topics import camera_topics, parse_topics
from mapdata.inputs import open_input
from mapdata.options import InputOptions


def assert_recorded(source, drive, root):
    """Compare what is read of a bag with the drive that was recorded into it."""
    assert source.has_poses
    assert [s.timestamp_ns for s in source.samples] == [s.timestamp_ns for s in drive]
    # in ROS' static transforms a camera stands where it stood first, the vehicle's motion apart
    nominal = change_frame(change_frame(drive[0], "lidar", "ego"), "ego", "lidar")
    found = {
        camera.name: camera for camera in change_frame(source.samples[0], "ego", "lidar").cameras
    }
    assert set(found) == {camera.name for camera in drive[0].cameras}
    for camera in nominal.cameras:
        other = found[camera.name]
        assert (other.width, other.height) == (camera.width, camera.height)
        np.testing.assert_allclose(other.intrinsics, camera.intrinsics)
        np.testing.assert_allclose(other.cam_from_frame, camera.cam_from_frame, atol=1e-6)
        original = (root / camera.path).read_bytes()
        assert (source.data_root / other.path).read_bytes() == original
    for sample, other in zip(source.samples, drive, strict=True):
        at = sample.global_from_frame @ invert_rigid(ground_from_frame(sample, "ego"))
        expected = other.global_from_frame @ invert_rigid(ground_from_frame(other, "lidar"))
        np.testing.assert_allclose(at, expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap", "mcap file"])
def test_a_bag_gives_the_samples_that_were_recorded(drive, minicity_root, tmp_path, kind):
    recorder = Recorder(tmp_path / "drive", kind.split()[0])
    record(recorder, drive, minicity_root)
    path = next(recorder.path.glob("*.mcap")) if kind == "mcap file" else recorder.path
    source = open_input(path, options(tmp_path))
    assert_recorded(source, drive, minicity_root)


def test_other_topics_of_a_camera_give_its_own_images(tmp_path):
    """A second try with corrected topics must not take the images of the first one."""
    recorder = Recorder(tmp_path / "drive.bag", "mcap")  # a folder of ROS 2 with a name of ROS 1

    def paint(camera, time_ns):
        grey = 40 if camera.name == "cam0" else 220
        picture = np.full((180, 320, 3), grey, np.uint8)
        recorder.image(camera, time_ns, cv2.imencode(".jpg", picture)[1].tobytes())

    path = Straight(recorder, names=("cam0", "cam1"), count=2).write(image=paint)
    names = [(f"/{name}/image_raw/compressed", f"/{name}/camera_info") for name in ("cam0", "cam1")]
    for topic, grey in zip(names, (40, 220), strict=True):
        source = open_input(path, options(tmp_path, topics={"left": topic}))
        (camera,) = source.samples[0].cameras
        image = cv2.imread(str(source.data_root / camera.path))
        np.testing.assert_allclose(image, grey, atol=2)
    both = {"left": names[0], "right": (names[0][0], names[1][1])}
    with pytest.raises(
        ValueError, match="cameras 'left' and 'right' have one topic of images, /cam0"
    ):
        open_input(path, options(tmp_path, topics=both))


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
    with pytest.raises(
        ValueError, match=r"no frame car: .*--vehicle-frame, .*; there are .*'odom'"
    ):
        open_input(recorder.path, options(tmp_path, vehicle_frame="car"))


def test_cameras_of_one_name_are_told_apart_or_refused(drive, minicity_root, tmp_path):
    def bag(name, *spaces):
        recorder = Recorder(tmp_path / name, "sqlite")
        cameras = [replace(drive[0].cameras[i], name=space) for i, space in enumerate(spaces)]
        record(recorder, [replace(drive[0], cameras=cameras)], minicity_root)
        return recorder.path

    source = open_input(bag("apart", "left/cam", "right/cam"), options(tmp_path))
    assert {camera.name for camera in source.samples[0].cameras} == {"left_cam", "right_cam"}
    with pytest.raises(ValueError, match=r"cameras \['/a/b/cam', '/a_b/cam'\] get one name"):
        open_input(bag("mixed", "a/b/cam", "a_b/cam"), options(tmp_path))


def of_other_lenses(drive):
    """Return the first sample, each camera with a focal length of its own."""
    cameras = [
        replace(camera, intrinsics=np.diag([100.0 + i, 100.0 + i, 1.0]))
        for i, camera in enumerate(drive[0].cameras)
    ]
    return replace(drive[0], cameras=cameras)


def focal_lengths(source):
    return {camera.name: camera.intrinsics[0, 0] for camera in source.samples[0].cameras}


def test_flat_topics_are_paired_by_camera(drive, minicity_root, tmp_path):
    sample = of_other_lenses(drive)
    recorder = Recorder(tmp_path / "flat", "sqlite")
    recorder.info_topic, recorder.image_topic = "/{}_info", "/{}"
    record(recorder, [sample], minicity_root)
    found = focal_lengths(open_input(recorder.path, options(tmp_path)))
    assert found == {camera.name: camera.intrinsics[0, 0] for camera in sample.cameras}


def test_topics_can_be_paired_by_hand(drive, minicity_root, tmp_path):
    sample = of_other_lenses(drive)
    recorder = Recorder(tmp_path / "odd", "sqlite")
    recorder.info_topic, recorder.image_topic = "/lens_of_{}_x", "/{}"
    record(recorder, [sample], minicity_root)
    with pytest.raises(ValueError, match=r"which CameraInfo belongs to /CAM_.*--topics NAME="):
        open_input(recorder.path, options(tmp_path))
    names = [camera.name for camera in sample.cameras]
    words = [f"my_{n}=/{n}/compressed,/lens_of_{n}_x" for n in names]
    source = open_input(recorder.path, options(tmp_path, topics=parse_topics(words)))
    expected = {f"my_{camera.name}": camera.intrinsics[0, 0] for camera in sample.cameras}
    assert focal_lengths(source) == expected
    for word, message in (
        ("a=/nowhere,/lens_of_CAM_BACK_x", r"/nowhere is not there, and must be sensor_msgs"),
        ("a=/CAM_BACK/compressed,/tf", r"/tf is tf2_msgs/msg/TFMessage, and must be .*CameraInfo"),
        ("a=/CAM_BACK/compressed", r"names no camera info of a: .*--calibration"),
    ):
        with pytest.raises(ValueError, match=message):
            open_input(recorder.path, options(tmp_path, topics=parse_topics([word])))
    for words in (["a"], ["=/a"], ["a=b"], ["a=/b", "a=/c"], ["a=/b,/c,/d"], ["a/../b=/c"]):
        with pytest.raises(ValueError, match="--topics takes NAME="):
            parse_topics(words)
    with pytest.raises(ValueError, match=r"belong to a bag, and .* is none"):
        open_input(minicity_root, options(tmp_path, topics=parse_topics(["a=/b"])))


IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
OF_FLAT = "cam_front=/cam_front_info cam_rear=/cam_rear_info"


@pytest.mark.parametrize(
    ("images", "infos", "expected"),
    [
        ("/front/image_raw", "/front/camera_info", "front=/front/camera_info"),
        ("/image_raw", "/camera_info", "image_raw=/camera_info"),
        ("/a/c /b/c", "/a/camera_info /b/camera_info", "a_c=/a/camera_info b_c=/b/camera_info"),
        ("/cam_front /cam_rear", "/cam_front_info /cam_rear_info", OF_FLAT),
        ("/v/front_image", "/v/front_info /v/rear_info", "front_image=/v/front_info"),
        ("/front/image /debug", "/front/camera_info", "front=/front/camera_info"),
        ("/front/image /front/seen/image", "/front/camera_info", "front=/front/camera_info"),
        ("/left/image /right/image", "/camera_info", "does /camera_info belong to left or right?"),
        ("/s/left /s/right", "/s/camera_info", "does /s/camera_info belong to left or right?"),
        ("/left/image /right/image", "/right/camera_info /x_info", "does /x_info belong to left?"),
        ("/front", "/one_info /two_info", "which CameraInfo belongs to /front"),
        ("/debug", "/front/camera_info", "no camera with images"),
    ],
)
def test_images_are_paired_with_camera_info_or_it_is_asked_for(images, infos, expected):
    kinds = dict.fromkeys(images.split(), IMAGE) | dict.fromkeys(infos.split(), INFO)
    if "=" in expected:
        found = camera_topics(kinds, "")
        assert [f"{name}={info}" for name, (_, info) in found.items()] == expected.split()
    else:
        with pytest.raises(ValueError, match=rf"{re.escape(expected)}.*--topics"):
            camera_topics(kinds, "")


def test_a_calibration_file_stands_for_infos_and_transforms(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "plain", "mcap")
    with recorder:
        for camera in drive[0].cameras:
            recorder.image(camera, 10**9, (minicity_root / camera.path).read_bytes())
    with pytest.raises(ValueError, match=r"give --calibration calibration\.yaml, or --topics"):
        open_input(recorder.path, options(tmp_path))
    ground = ground_from_frame(drive[0], "lidar")
    cameras = {
        camera.name: {
            "intrinsics": camera.intrinsics.tolist(),
            "size_px": [camera.width, camera.height],
            "vehicle_from_camera": (ground @ invert_rigid(camera.cam_from_frame)).tolist(),
        }
        for camera in drive[0].cameras
    }
    cameras["rear"] = cameras.pop("CAM_BACK") | {"images": "/CAM_BACK/image_raw/compressed"}
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps({"cameras": cameras, "ground_z_m": 0.0}))
    with pytest.raises(ValueError, match=r"it has ground_z_m, and --vehicle-ground-z is given"):
        open_input(recorder.path, options(tmp_path, calibration=file))
    alone = options(tmp_path, calibration=file, vehicle_ground_z_m=None)
    source = open_input(recorder.path, alone)
    assert not source.has_poses
    (sample,) = source.samples
    assert {camera.name for camera in sample.cameras} == set(cameras)
    found = {camera.name: camera for camera in change_frame(sample, "ego", "lidar").cameras}
    for camera in change_frame(change_frame(drive[0], "lidar", "ego"), "ego", "lidar").cameras:
        other = found["rear" if camera.name == "CAM_BACK" else camera.name]
        np.testing.assert_allclose(other.intrinsics, camera.intrinsics)
        np.testing.assert_allclose(other.cam_from_frame, camera.cam_from_frame, atol=1e-6)
    cameras["other"] = cameras["rear"] | {"images": "front"}
    file.write_text(json.dumps({"cameras": cameras}))
    with pytest.raises(ValueError, match=r"'other' of the calibration has no images: the bag's"):
        open_input(recorder.path, options(tmp_path, calibration=file))
    del cameras["other"]["size_px"]
    file.write_text(json.dumps({"cameras": cameras}))
    with pytest.raises(ValueError, match=r"'other'.*a camera of a bag needs size_px"):
        open_input(recorder.path, options(tmp_path, calibration=file))


def test_topics_beside_a_calibration_file_are_used_or_refused(tmp_path):
    recorder = Recorder(tmp_path / "drive", "mcap")
    greys = {"one": 40, "two": 220}

    def paint(camera, time_ns):
        picture = np.full((180, 320, 3), greys[camera.name], np.uint8)
        recorder.image(camera, time_ns, cv2.imencode(".jpg", picture)[1].tobytes())

    path = Straight(recorder, names=tuple(greys), count=2).write(image=paint)
    topics = {name: f"/{name}/image_raw/compressed" for name in greys}
    camera = {"intrinsics": [300, 300, 160, 90], "size_px": [320, 180], "position_m": [1, 0, 1]}
    camera |= {"yaw_pitch_roll_deg": [0, 0, 0], "images": topics["one"]}
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps({"cameras": {"one": camera}}))

    def read(topics):
        return open_input(path, options(tmp_path, calibration=file, topics=topics))

    for given, grey in (({}, 40), ({"one": (topics["two"], "")}, 220)):
        source = read(given)
        (seen,) = source.samples[0].cameras
        np.testing.assert_allclose(cv2.imread(str(source.data_root / seen.path)), grey, atol=2)
    for given, message in (
        ({"two": (topics["two"], "")}, r"--topics names 'two', and the calibration has \['one'\]"),
        ({"one": (topics["one"], "/one/camera_info")}, r"give one=/one/image_raw/compressed"),
    ):
        with pytest.raises(ValueError, match=message):
            read(given)
    by_name = camera | {"images": "front"}  # the topic of the camera's name
    content = {"cameras": {"one": camera, "two": by_name}, "rate_hz": 5, "poses": "poses.csv"}
    file.write_text(json.dumps(content))
    source = read({"one": (topics["one"], "")})
    assert {camera.name for camera in source.samples[0].cameras} == set(greys)
    assert "calibration.json: poses, rate_hz not used, since" in "; ".join(source.notes)
    for topic, message in (("/nowhere", "not there"), ("/one/camera_info", ".*CameraInfo")):
        file.write_text(json.dumps({"cameras": {"one": camera | {"images": topic}}}))
        with pytest.raises(ValueError, match=f"'one' .*is {topic}, which is {message}, and must"):
            read({})


def foxglove_file(path, drive, root):
    pytest.importorskip("foxglove", reason="pip install -e .[viz]")
    from drivemaps.drive import Drive, DriveFrame
    from drivemaps.mcap import write_mcap
    from drivemaps.replay import Replay

    frames = [DriveFrame(sample, MapElements.from_polylines()) for sample in drive]
    whole = Drive("a", ("divider",), (-15.0, 15.0), (-30.0, 30.0), frames)
    replay = Replay(whole, MapElements.from_polylines(), "lidar", ["#ff0000"], root)
    write_mcap(path, replay)
    return path


def test_an_mcap_of_foxgloves_messages_gives_the_samples_that_it_was_written_of(
    drive, minicity_root, tmp_path
):
    path = foxglove_file(tmp_path / "a.mcap", drive, minicity_root)
    settings = InputOptions(frames_dir=tmp_path / "frames", rate_hz=None)
    source = open_input(path, settings)
    assert_recorded(source, drive, minicity_root)
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], content.replace(b"CameraCalib", b"CameraKalib")):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.mcap cannot be used"):
            open_input(path, settings)


def pictures(source):
    cameras = source.samples[0].cameras
    return {c.name: (source.data_root / c.path).read_bytes() for c in cameras}


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_two_bags_that_start_at_0_and_a_corrected_calibration_have_their_own_pictures(
    drive, minicity_root, tmp_path, kind
):
    found = []
    bent = {"distortion": (-0.3, 0.1, 0, 0, 0)}
    for name, turn, more in (("a", 0, {}), ("b", 1, {}), ("c", 0, bent)):
        recorder = Recorder(tmp_path / name / "drive", kind)
        recorder.path.parent.mkdir()
        record(recorder, [starting_at_0(drive, turn)], minicity_root, **more)
        found.append(pictures(open_input(recorder.path, options(tmp_path))))
    names = [camera.name for camera in drive[0].cameras]
    for name, after in pairwise([*names, names[0]]):
        assert found[1][name] == found[0][after] != found[0][name]
        assert found[2][name] not in found[0].values()


def test_frames_that_are_there_are_kept(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, drive[:1], minicity_root)
    source = open_input(recorder.path, options(tmp_path))
    first = source.data_root / source.samples[0].cameras[0].path
    first.write_bytes(b"kept")
    assert open_input(recorder.path, options(tmp_path)).data_root == source.data_root
    assert first.read_bytes() == b"kept"
