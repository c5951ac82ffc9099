"""Poses of a bag: which transforms and odometry count, and how many samples have one."""

import json

import numpy as np
import pytest
from bag_cases import START_NS, STEP_NS, Recorder, Straight, at, jpeg, options

from mapdata.inputs import open_input


@pytest.fixture
def straight(tmp_path):
    """A drive to record, its bag in the test's folder."""
    return Straight(Recorder(tmp_path / "drive", "sqlite"))


def read(path, tmp_path, **more):
    """Return the source, and the places of its samples in the plane. (n, 2)"""
    source = open_input(path, options(tmp_path, **more))
    return source, np.array([sample.global_from_frame[:2, 3] for sample in source.samples])


def drive_x(count=11):
    return 0.5 * np.arange(count)


def send(straight, topic, parent, child, i, pose):
    straight.recorder.transform(topic, START_NS + i * STEP_NS, parent, child, pose)


@pytest.mark.parametrize(
    ("topic", "parent", "used"),
    [("/tf", "map", "/tf"), ("/other/tf", "odom", "/other/tf"), ("/tf_static", "odom", "/tf")],
)
def test_of_two_sources_of_a_frame_one_is_used_and_both_are_named(
    straight, tmp_path, topic, parent, used
):
    def poses(i, time_ns):
        straight.recorder.transform("/tf", time_ns, "odom", "base_link", at(0.5 * i))
        straight.recorder.transform(topic, time_ns + 9, parent, "base_link", at(1000.0, 300.0))

    source, places = read(straight.write(poses=poses), tmp_path)
    (note,) = source.notes
    assert note.startswith("'base_link' has 2 sources of transforms: the one to ")
    assert f"messages on {topic})" in note
    assert f"'{parent}' (11" in note
    if used == "/tf":
        np.testing.assert_allclose(places[:, 0], drive_x(), atol=1e-6)
    else:  # as many messages: the first topic by name
        np.testing.assert_allclose(places, [[1000.0, 300.0]] * 11, atol=1e-6)


def test_of_two_parents_of_a_camera_that_on_the_vehicle_is_used(straight, tmp_path):
    def before():
        send(straight, "/tf_static", "mast", "front_optical", 0, at(0, 0, 9))
        send(straight, "/tf_static", "mast", "front_optical", 0, at(0, 0, 9))

    source, _ = read(straight.write(before=before), tmp_path)
    assert {len(sample.cameras) for sample in source.samples} == {2}
    (note,) = source.notes
    assert "the one to 'base_link' (1 messages on /tf_static) is used, the one to 'mast' (2" in note


def test_a_footprint_without_poses_gives_way_to_a_base_link_with_some(straight, tmp_path):
    def before():
        send(straight, "/tf_static", "base_footprint", "base_link", 0, at(0, 0, 0.3))

    source, places = read(straight.write(before=before), tmp_path)
    np.testing.assert_allclose(places[:, 0], drive_x(), atol=1e-6)
    assert any("frame is 'base_link', since 'base_footprint'" in note for note in source.notes)


def test_two_publishers_of_one_transform_are_seen_and_their_poses_not_used(straight, tmp_path):
    def poses(i, time_ns):
        for shift, y in ((0, 0.0), (STEP_NS // 3, 30.0)):
            straight.recorder.transform("/tf", time_ns + shift, "odom", "base_link", at(0.5 * i, y))

    source, _ = read(straight.write(poses=poses), tmp_path)
    assert not source.has_poses
    assert "jump back and forth by 30.0 m, as if two publishers" in source.notes[0]


def test_odometry_of_another_body_is_moved_to_the_vehicle(straight, tmp_path):
    backwards = np.diag([-1.0, -1.0, 1.0])

    def before():
        send(straight, "/tf_static", "base_link", "imu_link", 0, at(2.0, 0.0, 0.0, backwards))

    def poses(i, time_ns):
        straight.recorder.odometry("/imu/odom", time_ns, "odom", "imu_link", at(0.5 * i))

    source, places = read(straight.write(before=before, poses=poses), tmp_path)
    np.testing.assert_allclose(places[:, 0], drive_x() + 2.0, atol=1e-6)
    first = source.samples[0].global_from_frame
    np.testing.assert_allclose(first[:3, 0], [-1.0, 0.0, 0.0], atol=1e-6)


def test_odometry_of_a_body_that_is_nowhere_on_the_vehicle_is_not_used(straight, tmp_path):
    def poses(i, time_ns):
        straight.recorder.odometry("/vio", time_ns, "odom", "imu_link", at(0.5 * i))

    source, _ = read(straight.write(poses=poses), tmp_path)
    assert not source.has_poses
    (note,) = source.notes
    assert "/vio (11 poses of 'imu_link' in 'odom') is not used: no transform leads" in note


def test_of_two_odometries_the_one_with_more_poses_is_used(straight, tmp_path):
    def poses(i, time_ns):
        straight.recorder.odometry("/odom", time_ns - 9, "odom", "base_link", at(0.5 * i))
        if i % 5 == 0:
            straight.recorder.odometry("/gps", time_ns, "utm", "base_link", at(1000.0, 300.0))

    source, places = read(straight.write(poses=poses), tmp_path)
    np.testing.assert_allclose(places[:, 0], drive_x(), atol=1e-5)
    (note,) = source.notes
    assert "of several odometries /odom (11 poses" in note
    assert "and /gps (3 poses of 'base_link' in 'utm') is not" in note


def test_without_transforms_the_odometry_of_the_named_frame_is_used(straight, tmp_path):
    def poses(i, time_ns):
        straight.recorder.odometry("/gps", time_ns, "utm", "antenna", at(1000.0, 300.0))
        if i % 5 == 0:
            straight.recorder.odometry("/odom", time_ns, "odom", "car", at(0.5 * i))

    path = straight.write(poses=poses, mount=lambda camera: None)
    camera = {"intrinsics": [300, 300, 160, 90], "size_px": [320, 180], "position_m": [1, 0, 1]}
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps({"cameras": {"front": camera | {"yaw_pitch_roll_deg": [0, 0, 0]}}}))
    _, places = read(path, tmp_path, calibration=file, vehicle_frame="car")
    np.testing.assert_allclose(places[:, 0], drive_x(), atol=1e-5)
    _, places = read(path, tmp_path, calibration=file)
    np.testing.assert_allclose(places[:, 0], 1000.0)


def test_a_seldom_transform_holds_until_the_next_one(straight, tmp_path):
    """SLAM sends map to odom once at 0 s and once at 0.6 s, as it corrects itself by 100 m."""
    straight.times_ns = [START_NS + 4 * i * STEP_NS for i in range(11)]  # 4 s, poses at 2.5 Hz

    def before():
        send(straight, "/tf", "map", "odom", 0, at(100.0))
        send(straight, "/tf", "map", "odom", 22, at(200.0))

    source, places = read(straight.write(before=before), tmp_path)
    expected = drive_x() + np.where(np.arange(11) < 6, 100.0, 200.0)
    np.testing.assert_allclose(places[:, 0], expected, atol=1e-6)
    assert source.notes == ()


def test_samples_without_a_pose_are_counted(straight, tmp_path):
    def poses(i, time_ns):
        if i >= 6:
            straight.recorder.transform("/tf", time_ns, "odom", "base_link", at(0.5 * i))

    source, places = read(straight.write(poses=poses), tmp_path)
    np.testing.assert_allclose(places[:, 0], [2.5 + 0.5, *drive_x()[6:]], atol=1e-6)
    (note,) = source.notes
    assert note.startswith("6 of 11 samples used: the others have no pose near them: the images of")
    assert "are from 1700000000.000 to 1700000001.000 s, the poses from 1700000000.600 to" in note


def test_images_and_poses_of_two_clocks_are_refused_with_the_times_of_both(straight, tmp_path):
    def image(camera, time_ns):
        boot_ns = time_ns - START_NS + 653_000_000_000
        header = straight.recorder.header(boot_ns, f"{camera.name}_optical")
        straight.recorder.image(camera, time_ns, jpeg(), header=header)

    path = straight.write(image=image)
    with pytest.raises(
        ValueError,
        match=r"no image has a pose near its time: the images of 'front' are from 653\.000 to "
        r"654\.000 s, the poses from 1700000000\.000 to 1700000001\.000 s; .*need one clock",
    ):
        open_input(path, options(tmp_path))


def test_one_camera_with_another_clock_is_named(straight, tmp_path):
    def image(camera, time_ns):
        stamp_ns = time_ns - (START_NS if camera.name == "rear" else 0)
        header = straight.recorder.header(stamp_ns + 1, f"{camera.name}_optical")
        straight.recorder.image(camera, time_ns, jpeg(), header=header)

    source, _ = read(straight.write(image=image), tmp_path)
    (note,) = source.notes
    assert "'rear' has no image within 50 ms at 11 of 11 samples: its images are from 0.000" in note


def test_stamps_of_0_are_replaced_by_the_time_of_recording(straight, tmp_path):
    def image(camera, time_ns):
        header = straight.recorder.header(0, f"{camera.name}_optical")
        straight.recorder.image(camera, time_ns, jpeg(), header=header)

    source, _ = read(straight.write(image=image), tmp_path)
    assert [sample.timestamp_ns for sample in source.samples] == straight.times_ns
    assert all((source.data_root / s.cameras[0].path).is_file() for s in source.samples)
    assert "11 of 11 images of '/front/image_raw/compressed' have the stamp 0" in source.notes[0]


def test_stamps_that_repeat_are_counted(straight, tmp_path):
    def image(camera, time_ns):
        header = straight.recorder.header(START_NS, f"{camera.name}_optical")
        straight.recorder.image(camera, time_ns, jpeg(), header=header)

    source, _ = read(straight.write(image=image), tmp_path)
    assert len(source.samples) == 1
    assert "10 of 11 images of '/front/image_raw/compressed' are left out" in source.notes[0]
