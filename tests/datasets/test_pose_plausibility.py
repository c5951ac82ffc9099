"""Implausible motions of vehicles are noticed, those of real and generated drives pass."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.pose_plausibility import MotionCheck, pose_warnings
from gsmap.datasets.source import sample_in_vehicle
from gsmap.structures.rigid import invert_rigid, rigid
from mapdata.argoverse2.log import Argoverse2Log

LOGS = "av2/sensor/val"


def circle(drive: str = "drive", num: int = 20) -> list[MapSample]:
    """Samples along a left curve of 40 m radius, 4 m apart, each half a second."""
    samples = []
    for number in range(num):
        angle = 0.3 + number * 0.1
        position = [500 + 40 * np.sin(angle), 900 - 40 * np.cos(angle), 12.0]
        pose = rigid(Rotation.from_euler("z", angle).as_matrix(), position)
        sample = sample_in_vehicle(f"{drive}{number}", drive, number * 500_000_000, [], None)
        samples.append(replace(sample, global_from_frame=pose))
    return samples


def with_poses(samples, change):
    """Samples with changed poses."""
    return [replace(s, global_from_frame=change(s.global_from_frame)) for s in samples]


def turned(pose, rotation):
    """A pose with another rotation (3, 3)."""
    return rigid(rotation, pose[:3, 3])


def other_order(pose):
    """A pose whose quaternion x, y, z, w is read as w, x, y, z."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return turned(pose, Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix())


def exchanged(pose):
    """A pose whose position has the northing first, as in EPSG:2180."""
    return rigid(pose[:3, :3], pose[[1, 0, 2], 3])


QUARTER = Rotation.from_euler("z", 90, degrees=True).as_matrix()
WRONG = {
    "inverted": (invert_rigid, "only if the poses are inverted"),
    "quaternion": (other_order, "is tilted by"),
    "axes": (exchanged, "degrees sideways"),
    "no rotation": (lambda pose: turned(pose, np.eye(3)), "degrees sideways"),
    "lidar axes": (lambda pose: turned(pose, pose[:3, :3] @ QUARTER), "90 degrees sideways"),
    "north east down": (
        lambda pose: rigid(np.diag([1, -1, -1]), np.zeros(3)) @ pose,
        "180 degrees",
    ),
    "millimetres": (lambda pose: rigid(pose[:3, :3], 1000 * pose[:3, 3]), "faster than 100 m/s"),
    "missing": (lambda pose: np.eye(4), "poses of all 20 samples are the identity"),
    "turned round": (lambda pose: turned(pose, pose[:3, :3] @ QUARTER @ QUARTER), "backwards"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_poses_are_noticed(name):
    change, text = WRONG[name]
    samples = circle()
    assert pose_warnings(samples, "ego") == []
    lines = pose_warnings(with_poses(samples, change), "ego")
    assert text in lines[0]
    assert "in drive 'drive' of 1 drive: " in lines[0]


def test_wrong_times_and_jumps_are_noticed():
    samples = circle()
    too_fast = [replace(s, timestamp_ns=s.timestamp_ns // 1_000_000) for s in samples]
    (line,) = pose_warnings(too_fast, "ego")
    assert line.startswith("19 of 19 steps are faster than 100 m/s")
    (line,) = pose_warnings([replace(s, timestamp_ns=-s.timestamp_ns) for s in samples], "ego")
    assert line.startswith("the vehicle moves backwards in drive 'drive' of 1 drive: unless it")
    # Two drives under one name, one after the other.
    second = with_poses(circle(), lambda pose: rigid(np.eye(3), [700.0, 0.0, 0.0]) @ pose)
    later = [
        replace(s, token=f"{s.token}b", timestamp_ns=s.timestamp_ns + 10_000_000_000)
        for s in second
    ]
    (line,) = pose_warnings(samples + later, "ego")
    assert line.startswith("the vehicle jumps 1 time, such as by 6")
    assert "from sample 'drive19' to 'drive0b', in drive 'drive' of 1 drive: is it one" in line


def later(samples, seconds, suffix=""):
    """Samples that are taken later, with other tokens."""
    shift_ns = int(seconds * 1e9)
    return [
        replace(s, token=s.token + suffix, timestamp_ns=s.timestamp_ns + shift_ns) for s in samples
    ]


def test_long_gaps_in_a_drive_are_noticed():
    samples = circle()
    for second in (circle(), with_poses(circle(), lambda pose: rigid(QUARTER, [900, 0, 0]) @ pose)):
        (line,) = pose_warnings(samples + later(second, 86_400, "b"), "ego")
        assert line.startswith(
            "1 gap of more than 10 minutes, up to 24.0 h from sample 'drive19' to "
            "'drive0b', in drive 'drive' of 1 drive: is it one drive?"
        )
    # The drive of 9.5 s starts 5 s before midnight, on a clock of the time of day.
    start = later(samples, 86_395)
    day_ns = 86_400 * 10**9
    wrapped = [replace(s, timestamp_ns=s.timestamp_ns % day_ns) for s in start]
    line = pose_warnings(wrapped, "ego")[0]
    assert "up to 24.0 h from sample 'drive19' to 'drive0'" in line
    # Inverted poses are recognised beside a gap.
    inverted = with_poses(samples + later(circle(), 4000, "b"), invert_rigid)
    lines = pose_warnings(inverted, "ego")
    assert "gap of more than 10 minutes" in lines[0]
    assert "only if the poses are inverted" in lines[1]
    # Pauses, such as those at a level crossing, and drives of their own are no faults.
    assert pose_warnings(samples + later(circle(), 500, "b"), "ego") == []
    assert pose_warnings(samples + later(circle("other"), 86_400), "ego") == []


@pytest.mark.parametrize(
    ("origin", "step"),
    [
        ([691_000.3, 5_336_000.7, 520], "0.5"),
        ([131_100, -40, 0], "0.016"),
        ([-40, -6e6, 6e6], "0.5"),
    ],
)
def test_positions_rounded_to_float32_are_noticed(origin, step):
    """A float32 translation, also if the poses are float64 afterwards."""
    away = rigid(np.eye(3), np.array(origin, dtype=np.float64))
    samples = with_poses(circle(), lambda pose: away @ pose)
    assert pose_warnings(samples, "ego") == []
    rounded = with_poses(samples, lambda pose: rigid(pose[:3, :3], np.float32(pose[:3, 3])))
    line = pose_warnings(rounded, "ego")[0]
    assert line.startswith(f"positions are rounded to steps of up to {step} m in drive 'drive'")
    assert line.endswith("Keep them float64")
    parked = with_poses(rounded, lambda pose: rounded[0].global_from_frame)
    partly = rounded[:10] + samples[10:]
    near = with_poses(circle(), lambda pose: rigid(pose[:3, :3], np.float32(pose[:3, 3])))
    for right in (parked, partly, near):
        assert not any("rounded" in text for text in pose_warnings(right, "ego"))


def test_a_drive_in_reverse_is_not_called_inverted():
    """Odometry that starts at the origin, where inverted poses look like a drive in reverse."""
    samples = []
    for number, sample in enumerate(circle()):
        pose = rigid(np.eye(3), [-2.0 * number, 0.0, 0.0])
        samples.append(replace(sample, global_from_frame=pose))
    (line,) = pose_warnings(samples, "ego")
    assert "backwards" in line
    assert "inverted" not in line


def test_short_steps_of_a_fast_camera_add_up():
    """30 frames a second at 10 m/s, 0.33 m each."""
    check = MotionCheck()
    for number in range(300):
        pose = rigid(np.eye(3), [0.0, number / 3, 0.0])  # x is ahead
        check.add("drive", number * 33_333_333, str(number), pose, ground_from_frame=np.eye(4))
    assert check.num_steps == 149
    (line,) = check.warnings()
    assert "90 degrees sideways (median of 149 steps)" in line


def test_a_file_has_one_line_for_each_kind_of_fault():
    samples = circle("a") + with_poses(circle("b"), invert_rigid)
    samples += with_poses(circle("c"), invert_rigid) + circle("d")
    (line,) = [text for text in pose_warnings(samples, "ego") if "inverted" in text]
    assert " in drive 'b' and in 1 more of 4 drives: they must map" in line


def test_what_says_nothing_about_the_motion_is_no_fault():
    samples = circle()
    single_scene = [replace(s, scene="") for s in with_poses(samples, invert_rigid)]
    at_one_time = [replace(s, timestamp_ns=0) for s in with_poses(samples, invert_rigid)]
    standing = []
    for number, sample in enumerate(samples):
        pose = sample.global_from_frame.copy()
        pose[:2, 3] = 0.01 * number, -0.01 * number  # noise of a localisation
        standing.append(replace(sample, global_from_frame=pose))
    corrected = list(samples)
    shift = rigid(np.eye(3), [8.0, 0.0, 0.0])  # the localisation corrects its position by 8 m
    corrected[10:] = with_poses(samples[10:], lambda pose: shift @ pose)
    parked = with_poses(samples, lambda pose: samples[0].global_from_frame)  # not a missing pose
    for found in (single_scene, at_one_time, standing, parked, corrected, samples[:1], []):
        assert pose_warnings(found, "ego") == []
    # The order of the samples does not count.
    assert pose_warnings(samples[::-1], "ego") == []


def test_right_drives_pass(minicity_annotations, shared_dir):
    for path in minicity_annotations.values():
        file = AnnotationFile(path)
        assert pose_warnings(file, file.meta.frame) == []
    num_steps = 0
    for folder in sorted((shared_dir / LOGS).iterdir()):
        check = MotionCheck()
        for time_ns, pose in sorted(Argoverse2Log(folder).poses.items())[::50]:
            check.add(folder.name, time_ns, str(time_ns), pose, ground_from_frame=np.eye(4))
        assert check.warnings() == []
        num_steps += check.num_steps
    assert num_steps > 20
