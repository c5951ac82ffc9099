"""From Argoverse 2 logs to an annotation file: times, sensors, and what is left out."""

import argparse
import errno
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.feather as feather
import pytest
from argoverse2_road import (
    IMAGE_EVERY_NS,
    SPEED_M_S,
    START_NS,
    SWEEP_EVERY_NS,
    bow_tie,
    crossing,
    road_map,
    write_log,
    write_map,
    write_poses,
)
from processes import run_tool

from benchmarks.argoverse2 import measure_extraction
from gsmap.datasets.annotations.file import AnnotationFile, AnnotationWriter
from mapdata.argoverse2.convert import add_arguments, convert_argoverse2, run
from mapdata.argoverse2.log import (
    BROKEN_LOGS,
    MAP_CHANGE_LOGS,
    RING_CAMERAS,
    Argoverse2Log,
    closest_ns,
)
from mapdata.argoverse2.map import DEFAULT_RULES
from mapdata.argoverse2.samples import Argoverse2Options, sample_times, thin_out
from mapdata.command_line import parse_rate
from mapdata.vectors_json import write_vectors

REPO = Path(__file__).resolve().parents[2]


def convert(root: Path, **options) -> tuple[str, AnnotationFile]:
    """Convert, at 2 Hz unless told, and return the summary's text with the file."""
    wanted = Argoverse2Options(root, **{"rate_hz": 2.0, **options})
    summary = convert_argoverse2(wanted)
    return summary.text(), AnnotationFile(wanted.path_of("av2", wanted.split))


def test_samples_at_two_hertz_hold_map_cameras_and_sweep(tmp_path):
    write_log(tmp_path / "val" / "log-a")
    summary, file = convert(tmp_path)
    assert [s.timestamp_ns - START_NS for s in file] == [0, 500_000_000]
    assert file.meta.dataset == "av2"
    assert file.meta.frame == "ego"
    assert (file.meta.x_range, file.meta.y_range) == ((-30.0, 30.0), (-15.0, 15.0))
    sample = file[1]
    assert sample.token == f"log-a_{START_NS + 500_000_000}"
    assert (sample.scene, sample.map_name) == ("log-a", "PIT")
    np.testing.assert_allclose(sample.global_from_frame[:3, 3], [1000 + 0.5 * SPEED_M_S, 500, 20])
    assert sample.lidar.path == f"val/log-a/sensors/lidar/{START_NS + 500_000_000}.feather"
    np.testing.assert_allclose(sample.lidar.frame_from_lidar, np.eye(4), atol=1e-12)
    assert [camera.name for camera in sample.cameras] == list(RING_CAMERAS)
    assert sorted(i.label for i in sample.instances) == [0, 1, 2, 2]
    assert {i.points.shape[1] for i in sample.instances} == {2}
    assert "samples: val 2" in summary


def test_cameras_account_for_the_vehicles_motion(tmp_path):
    """The image follows the sample by 10 ms, in which the vehicle drives 0.1 m."""
    write_log(tmp_path / "val" / "log-a")
    camera = convert(tmp_path)[1][0].cameras[0]
    assert camera.path.endswith(f"/{RING_CAMERAS[0]}/{START_NS + 10_000_000}.jpg")
    in_camera = camera.cam_from_frame @ np.array([10.0, 2.0, 0.4, 1.0])
    # Camera: 1.6 m ahead of and 1.4 m above the vehicle's origin, x right, y down, z forward.
    np.testing.assert_allclose(in_camera[:3], [-2.0, 1.0, 10.0 - 1.6 - 0.1], atol=1e-9)
    np.testing.assert_array_equal(camera.intrinsics, [[1000, 0, 800], [0, 1000, 600], [0, 0, 1]])


def test_earlier_sweeps_are_placed_by_their_own_pose(tmp_path):
    write_log(tmp_path / "val" / "log-a")
    lidar = convert(tmp_path, max_sweeps=2)[1][1].lidar
    ages = [START_NS + 500_000_000 - s.timestamp_ns for s in lidar.sweeps]
    assert ages == [SWEEP_EVERY_NS, 2 * SWEEP_EVERY_NS]
    shift = [s.frame_from_lidar[0, 3] for s in lidar.sweeps]
    np.testing.assert_allclose(shift, [-1.0, -2.0])  # 0.1 s and 0.2 s at 10 m/s


def test_three_dimensions_and_centerlines(tmp_path):
    write_log(tmp_path / "val" / "log-a")
    classes = ("divider", "ped_crossing", "boundary", "centerline")
    _, file = convert(tmp_path, dim=3, classes=classes)
    assert (file.meta.dim, file.meta.classes) == (3, classes)
    assert {i.points.shape[1] for i in file[0].instances} == {3}
    assert sorted(i.label for i in file[0].instances) == [0, 1, 2, 2, 3, 3]


@pytest.mark.parametrize(
    ("step_ns", "rate_hz", "kept"),
    [
        (SWEEP_EVERY_NS, 2.0, [0, 5, 10, 15]),
        (SWEEP_EVERY_NS, 2.5, [0, 4, 8, 12, 16]),
        (SWEEP_EVERY_NS, 20.0, list(range(20))),
        (IMAGE_EVERY_NS, 2.0, [0, 10]),
        (500_000_000, 2.0, list(range(20))),
    ],
)
def test_times_thin_out_to_the_rate_in_spite_of_jitter(step_ns, rate_hz, kept):
    jitter = np.random.default_rng(1).integers(-(10**6), 10**6, 20)
    times = START_NS + step_ns * np.arange(20) + jitter
    np.testing.assert_array_equal(thin_out(times, rate_hz), times[kept])


@pytest.mark.parametrize(("split", "every"), [("train", 1), ("val", 4), ("test", 4)])
def test_training_takes_every_sweep_and_tests_take_every_fourth(split, every, tmp_path):
    """As the published systems do: 10 Hz and 2.5 Hz."""
    write_log(tmp_path / split / "log-a")
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    run(parser.parse_args(["--root", str(tmp_path), "--split", split, "--workers", "1"]))
    file = AnnotationFile(tmp_path / f"gsmap_av2_{split}.arrow")
    sweeps = Argoverse2Log(tmp_path / split / "log-a").lidar_timestamps_ns
    assert [s.timestamp_ns for s in file] == sweeps[::every].tolist()
    assert file.meta.options["rate_hz"] == 10 / every


def test_samples_of_a_whole_split_thin_out_by_time_over_all_logs(tmp_path):
    """Three logs of n samples each: every fourth of 3 n, wherever a log begins."""
    names = ("log-a", "log-b", "log-c")
    for name in names:
        write_log(tmp_path / "val" / name)
    for image in (tmp_path / "val/log-b/sensors/cameras/ring_side_left").iterdir():
        if int(image.stem) < START_NS + 100_000_000:
            image.unlink()  # its first sample cannot be made, and does not count
    sweeps = Argoverse2Log(tmp_path / "val/log-a").lidar_timestamps_ns.tolist()
    usable = [(t, n) for t in sweeps for n in names if (t, n) != (sweeps[0], "log-b")]
    wanted = {f"{name}_{time}" for time, name in sorted(usable)[::4]}
    summary, file = convert(tmp_path, rate_hz=2.5, thin_over="split")
    assert {s.token for s in file} == wanted
    assert "1 x sample left out: no image of ring_side_left" in summary
    assert file.meta.options["thin_over"] == "split"
    _, each = convert(tmp_path, rate_hz=2.5, tag="_each")
    assert {s.token for s in each} != wanted
    assert "thin_over" not in each.meta.options


def test_a_log_that_cannot_be_read_leaves_the_others_their_turn(tmp_path):
    for name in ("log-a", "log-b"):
        write_log(tmp_path / "val" / name)
    (tmp_path / "val/log-a/city_SE3_egovehicle.feather").unlink()
    summary, file = convert(tmp_path, rate_hz=2.5, thin_over="split")
    sweeps = Argoverse2Log(tmp_path / "val/log-b").lidar_timestamps_ns
    assert [s.timestamp_ns for s in file] == sweeps[::4].tolist()
    assert "no poses at" in summary


def test_every_nth_pose_needs_neither_sensors_nor_calibration(tmp_path):
    times = START_NS + 5_000_000 * np.arange(25)
    write_map(tmp_path / "val" / "log-a")
    write_poses(tmp_path / "val" / "log-a", times[::-1].copy())  # rows count in the order of time
    _, file = convert(tmp_path, at="poses:10")
    assert [s.timestamp_ns for s in file] == times[::10].tolist()
    assert file[0].cameras == []
    assert file[0].lidar is None
    write_vectors([file.path], tmp_path / "out.json")
    frames = json.loads((tmp_path / "out.json").read_text())["GTs"]
    assert [(f["log"], f["row"]) for f in frames] == [("log-a", 0), ("log-a", 10), ("log-a", 20)]
    assert sorted(v["label"] for v in frames[0]["vectors"]) == [0, 1, 2, 2]


def test_auto_takes_images_where_there_are_no_sweeps(tmp_path):
    write_log(tmp_path / "log-a")
    log = Argoverse2Log(tmp_path / "log-a")
    all_times = Argoverse2Options(tmp_path, rate_hz=None)
    assert sample_times(log, all_times).tolist() == log.lidar_timestamps_ns.tolist()
    log.lidar_timestamps_ns = np.empty(0, dtype=np.int64)
    images = log.image_timestamps_ns[RING_CAMERAS[0]].tolist()
    assert sample_times(log, all_times).tolist() == images
    with pytest.raises(ValueError, match=r"no LiDAR sweeps .*--at poses:10"):
        sample_times(log, Argoverse2Options(tmp_path, at="lidar"))


def test_a_sample_with_a_missing_image_is_left_out_and_counted(tmp_path):
    folder = tmp_path / "val" / "log-a"
    write_log(folder)
    for image in (folder / "sensors" / "cameras" / "ring_side_left").iterdir():
        if int(image.stem) < START_NS + 100_000_000:
            image.unlink()
    summary, file = convert(tmp_path)
    assert [s.timestamp_ns - START_NS for s in file] == [500_000_000]
    assert "1 x sample left out: no image of ring_side_left" in summary


def test_bad_logs_are_left_out_with_their_reason_and_the_rest_goes_on(tmp_path):
    split = tmp_path / "val"
    write_log(split / "log-good")
    bad = (
        "log-no-map", "log-bad-json", "log-no-poses", "log-bad-poses", "log-two-poses",
        "log-no-calib",
    )  # fmt: skip
    for name in bad:
        write_log(split / name)
    for path in (split / "log-no-map" / "map").iterdir():
        path.unlink()
    next((split / "log-bad-json" / "map").iterdir()).write_text("{")
    (split / "log-no-poses" / "city_SE3_egovehicle.feather").unlink()
    (split / "log-bad-poses" / "city_SE3_egovehicle.feather").write_bytes(b"nothing")
    (split / "log-no-calib" / "calibration" / "intrinsics.feather").unlink()
    poses = feather.read_feather(split / "log-good/city_SE3_egovehicle.feather")
    poses = pd.concat([poses, poses])
    feather.write_feather(poses, split / "log-good/city_SE3_egovehicle.feather")  # rows repeated
    poses.iloc[0, poses.columns.get_loc("tx_m")] += 1.0
    feather.write_feather(poses, split / "log-two-poses/city_SE3_egovehicle.feather")
    summary, file = convert(tmp_path)
    assert {s.scene for s in file} == {"log-good"}
    for reason in (
        "no map/log_map_archive_*.json",
        "no poses at",
        "cannot be used",
        f"it has several poses for the time {poses.timestamp_ns.iloc[0]} ns",
        "no calibration of the ring cameras",
    ):
        assert reason in summary
    for name in bad:
        assert name in summary


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("intrinsics", "fx_px", np.nan),
        ("intrinsics", "fy_px", -1000.0),
        ("intrinsics", "width_px", 0),
        ("egovehicle_SE3_sensor", "tx_m", np.inf),
    ],
)
def test_an_impossible_calibration_leaves_its_log_out(tmp_path, table, column, value):
    for name in ("log-bad", "log-good"):
        write_log(tmp_path / "val" / name)
    path = tmp_path / f"val/log-bad/calibration/{table}.feather"
    values = feather.read_feather(path)
    values.loc[values["sensor_name"] == "ring_side_left", column] = value
    feather.write_feather(values, path)
    summary, file = convert(tmp_path)
    assert {s.scene for s in file} == {"log-good"}
    assert "log-bad/calibration cannot be used: the calibration of ring_side_left" in summary


def test_logs_known_to_be_unfit_are_left_out(tmp_path):
    broken, changed = next(iter(BROKEN_LOGS)), next(iter(MAP_CHANGE_LOGS))
    for name in ("log-a", broken, changed):
        write_log(tmp_path / "val" / name)
    summary, file = convert(tmp_path)
    assert {s.scene for s in file} == {"log-a"}
    assert broken in summary
    assert "its map was changed on purpose" in summary
    summary, file = convert(tmp_path, keep_map_changes=True)
    assert {s.scene for s in file} == {"log-a", changed}
    assert "log kept, but its map was changed on purpose" in summary


def test_invalid_polygons_are_counted(tmp_path):
    content = road_map(bow_tie(30), crossing(31, (10.0, 13.0), (-5.0, 5.0)))
    write_log(tmp_path / "val" / "log-a", content=content)
    assert "1 x invalid polygon among the crossings" in convert(tmp_path)[0]


def test_logs_can_be_chosen_by_how_they_begin(tmp_path):
    for name in ("aa-1", "ab-2", "b-3"):
        write_log(tmp_path / "sensor" / "val" / name)
    _, file = convert(tmp_path, logs=("a",))
    assert sorted({s.scene for s in file}) == ["aa-1", "ab-2"]
    assert file[0].cameras[0].path.startswith("sensor/val/aa-1/")
    own = tmp_path / "own.json"
    own.write_text(json.dumps({"val": ["aa-1", "ab-2"]}))
    for split_file in (None, own):
        with pytest.raises(FileNotFoundError, match="begins with 'zz'"):
            convert(tmp_path, logs=("aa", "zz"), split_file=split_file)
    _, file = convert(tmp_path, logs=("aa",), split_file=own)
    assert {s.scene for s in file} == {"aa-1"}
    with pytest.raises(ValueError, match="max_sweeps must be >= 0, got -1"):
        convert(tmp_path, max_sweeps=-1)
    with pytest.raises(FileNotFoundError, match="--root must name the folder"):
        convert(tmp_path, split="train")


def test_workers_give_the_same_file_as_one_process(tmp_path):
    for name in ("log-a", "log-b", "log-c"):
        write_log(tmp_path / "val" / name)
    (tmp_path / "val" / "log-b" / "city_SE3_egovehicle.feather").unlink()
    one, alone = convert(tmp_path, tag="_1")
    two, spread = convert(tmp_path, tag="_2", workers=2)
    assert [s.token for s in spread] == [s.token for s in alone]
    for a, b in zip(alone[0].instances, spread[0].instances, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
    assert one.replace("_1.arrow", "") == two.replace("_2.arrow", "")


@pytest.mark.parametrize(
    "stop", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
def test_a_full_disk_or_an_interruption_leaves_nothing_behind(tmp_path, monkeypatch, stop):
    write_log(tmp_path / "val" / "log-a")
    written = []

    def write(self: AnnotationWriter, sample: object) -> None:
        if written:
            raise stop
        written.append(sample)

    monkeypatch.setattr(AnnotationWriter, "write", write)
    with pytest.raises(type(stop)):
        convert(tmp_path, out_dir=tmp_path / "out")
    assert written
    assert list((tmp_path / "out").iterdir()) == []


def test_nothing_left_to_write_is_an_error_that_says_why(tmp_path):
    write_map(tmp_path / "val" / "log-a")
    with pytest.raises(RuntimeError, match=r"no sample is left.*\n(.*\n)*.*no calibration"):
        convert(tmp_path)
    assert not list(tmp_path.glob("*.arrow*"))


def test_the_tool_converts_and_names_its_command(tmp_path):
    write_log(tmp_path / "val" / "log-a")
    words = "--split", "val", "--rate", "2hz", "--dim", 3, "--workers", 1
    done = run_tool("tools/create_data.py", "av2", "--root", tmp_path, *words)
    assert done.returncode == 0, done.stderr
    assert "samples: val 2" in done.stdout
    meta = AnnotationFile(tmp_path / "gsmap_av2_val.arrow").meta
    assert "av2 --root" in meta.command
    assert meta.options == {
        "at": "auto", "rate_hz": 2.0, "compat": DEFAULT_RULES, "num_sweeps": 0,
        "split_list": "official",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "rate"), [("2hz", 2.0), ("2.5", 2.5), ("10Hz", 10.0), ("all", None)]
)
def test_rates_are_read(text, rate):
    assert parse_rate(text) == rate


@pytest.mark.parametrize("text", ["0hz", "-1", "fast", "nan"])
def test_bad_rates_are_refused(text):
    with pytest.raises(ValueError, match=r"rate must be|could not convert"):
        parse_rate(text)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"at": "poses:0"}, "at must be"),
        ({"at": "radar"}, "at must be"),
        ({"rate_hz": 0.0}, "rate_hz must be > 0"),
        ({"compat": "v3"}, "compat must be one of"),
        ({"classes": ("lamp",)}, "classes must be among"),
        ({"dim": 4}, "dim must be 2 or 3"),
        ({"thin_over": "year"}, "thin_over must be one of"),
        ({"thin_over": "split", "rate_hz": None}, "give a rate"),
        ({"thin_over": "split", "at": "poses:5"}, "give a rate"),
    ],
)
def test_bad_options_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Argoverse2Options(Path(), **wrong)


def test_the_closest_time_within_the_tolerance():
    times = np.array([100, 200, 300])
    assert closest_ns(times, 240, 50) == 200
    assert closest_ns(times, 251, 50) == 300
    assert closest_ns(times, 40, 50) is None
    assert closest_ns(times[:0], 40, 50) is None


def test_the_benchmark_times_every_set_of_classes(tmp_path):
    write_log(tmp_path / "val" / "log-a")
    result = measure_extraction(tmp_path, stride=10)
    assert result["frames"] == 3  # 30 poses
    assert all(value > 0 for value in result.values())


def cut_lane(content):
    content["lane_segments"]["12"]["left_lane_boundary"] = []


def point_of_a_lane(content):
    del content["lane_segments"]["12"]["left_lane_boundary"][1:]


def nan_in_a_lane(content):
    content["lane_segments"]["12"]["right_lane_boundary"][0]["x"] = float("nan")


def lane_without_a_side(content):
    del content["lane_segments"]["12"]["right_lane_boundary"]


def lane_of_unknown_paint(content):
    content["lane_segments"]["12"]["left_lane_mark_type"] = "PINK"


def short_crossing(content):
    content["pedestrian_crossings"]["12"] = {**crossing(12, (1, 2), (0, 1)), "edge1": []}


def short_area(content):
    content["drivable_areas"]["12"] = {"id": 12, "area_boundary": []}


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (cut_lane, "lane segment cannot be used: its left_lane_boundary has 0 points, and needs 2"),
        (point_of_a_lane, "lane segment cannot be used: its left_lane_boundary has 1 points"),
        (nan_in_a_lane, "lane segment cannot be used: its right_lane_boundary holds NaN"),
        (lane_without_a_side, "lane segment cannot be used: it has no 'right_lane_boundary'"),
        (lane_of_unknown_paint, "lane segment cannot be used: 'PINK' is not a valid LaneMarkType"),
        (short_crossing, "crossing cannot be used: its edge1 has 0 points, and needs 2"),
        (short_area, "drivable area cannot be used: its area_boundary has 0 points, and needs 3"),
    ],
)
def test_a_bad_element_of_a_map_costs_itself_and_is_named(tmp_path, spoil, reason):
    content = road_map()
    spoil(content)
    write_log(tmp_path / "val" / "log", content=content)
    summary = convert_argoverse2(Argoverse2Options(tmp_path, split="val", rate_hz=None, workers=1))
    assert summary.samples["val"] == 10
    assert f"1 x {reason}" in summary.text()
    assert "for example 12 of log" in summary.text()


def test_a_map_without_any_good_lane_costs_its_log(tmp_path):
    content = road_map()
    for lane in content["lane_segments"].values():
        lane["left_lane_boundary"] = []
    write_log(tmp_path / "val" / "log", content=content)
    with pytest.raises(RuntimeError, match="none of its 4 lane_segments can be used: lane segment"):
        convert_argoverse2(Argoverse2Options(tmp_path, split="val", rate_hz=None, workers=1))
