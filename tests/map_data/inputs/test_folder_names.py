"""Times, order and partners of a folder's images, as the names of their files tell them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmap.datasets.source import Source
from mapdata.folders.names import natural_sort_key, times_of_names
from mapdata.inputs import open_input
from mapdata.unix_times import span_of, unix_time_ns

LEVEL = {"intrinsics": [100, 100, 80, 45], "position_m": [0, 0, 1], "yaw_pitch_roll_deg": [0, 0, 0]}
START_NS = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC
HEAD = "timestamp_ns,x,y,z,qw,qx,qy,qz"


def folder_of(root: Path, names: dict[str, list[str]], **more: object) -> Path:
    """Write grey images by camera, and the calibration file for them."""
    for camera, files in names.items():
        (root / camera).mkdir(parents=True)
        for file in files:
            cv2.imwrite(str(root / camera / file), np.full((90, 160, 3), 99, np.uint8))
    content = {"cameras": dict.fromkeys(names, LEVEL)} | more
    (root / "calibration.json").write_text(json.dumps(content))
    return root


def seconds_of(source: Source) -> list[float]:
    return [
        (sample.timestamp_ns - source.samples[0].timestamp_ns) / 1e9 for sample in source.samples
    ]


@pytest.mark.parametrize(
    ("stem", "time_ns"),
    [
        ("1700000000", START_NS),
        ("front_1700000000100", START_NS + 10**8),
        ("1700000000000100", START_NS + 10**5),
        ("1700000000000000100", START_NS + 100),
        ("1700000000.25", START_NS + 10**9 // 4),
        ("0000000042", None),  # a frame's number, as KITTI has them
        ("0001700000000", None),  # a frame's number of 13 digits
        ("4200000000", None),  # the year 2103
        ("0000000042.5", None),
        ("2023100512", None),  # dates with the hour, with parts of seconds
        ("2023100512304512", None),
        ("a", None),
    ],
)
def test_a_name_holds_a_unix_time_only_if_it_can_be_one(stem, time_ns):
    assert times_of_names([stem]) == (None if time_ns is None else {stem: time_ns})


def test_times_count_only_where_all_names_have_one():
    assert times_of_names(["1700000000", "b"]) is None
    mixed = ["2023100512", "2023109999"]  # not all of them read as dates
    assert times_of_names(mixed) == {name: int(name) * 10**9 for name in mixed}


def test_a_unix_time_has_the_unit_that_puts_it_into_this_century():
    for unit in (1, 10**3, 10**6, 10**9):
        assert unix_time_ns(START_NS // unit) == START_NS
    assert unix_time_ns(1_700_000_000.5) == START_NS + 5 * 10**8
    for foreign in (0, -1, 0.1, 42, 1e300, float(1 << 70)):
        assert unix_time_ns(foreign) is None
    assert span_of([START_NS, 10**9]) == "1.000 s to 2023-11-14 22:13:20.000 UTC"


def test_numbers_in_names_count_as_numbers():
    names = ["a/10.jpg", "a/9.jpg", "a/b2.jpg", "a/b10.jpg", "a/007.jpg"]
    ordered = [path.as_posix() for path in sorted(map(Path, names), key=natural_sort_key)]
    assert ordered == ["a/007.jpg", "a/9.jpg", "a/10.jpg", "a/b2.jpg", "a/b10.jpg"]


def test_frame_numbers_follow_rate_hz_in_their_order(tmp_path):
    padded = folder_of(tmp_path / "a", {"front": [f"{i:010d}.png" for i in range(3)]}, rate_hz=5)
    source = open_input(padded)
    assert seconds_of(source) == [0, 0.2, 0.4]
    assert source.notes == ("the names of the images hold no Unix times: 5 a second (rate_hz)",)
    plain = folder_of(tmp_path / "b", {"front": [f"{i}.png" for i in range(11)]})
    source = open_input(plain)
    assert [s.cameras[0].path for s in source.samples] == [f"front/{i}.png" for i in range(11)]
    assert "10 a second (assumed, as there is no rate_hz)" in source.notes[0]


def test_times_that_rate_hz_contradicts_are_refused(tmp_path):
    names = [f"{1_500_000_042 + i}.png" for i in range(3)]
    with pytest.raises(
        ValueError, match=r"read as Unix times \(2017-.*every 1 s, but rate_hz is 10"
    ):
        open_input(folder_of(tmp_path / "a", {"front": names}, rate_hz=10))
    for number, more in enumerate(({"rate_hz": 1}, {})):
        source = open_input(folder_of(tmp_path / f"b{number}", {"front": names}, **more))
        assert seconds_of(source) == [0, 1, 2]
        assert source.notes[0].startswith("the names of the images are taken as Unix times, 2017-")


def test_hidden_files_beside_images_and_annotations_are_left(tmp_path, minicity_annotations):
    drive = folder_of(tmp_path / "drive", {"front": ["0.png", "1.png"]})
    for place in (drive / "front/._0.png", drive / "front/.DS_Store", drive / "._calibration.json"):
        place.write_bytes(b"\0\5\x16\7 of macOS")
    assert len(open_input(drive).samples) == 2
    annotations = next(iter(minicity_annotations.values()))
    (tmp_path / "one").mkdir()
    (tmp_path / "one/a.arrow").write_bytes(Path(annotations).read_bytes())
    (tmp_path / "one/._a.arrow").write_bytes(b"\0\5\x16\7")
    assert len(open_input(tmp_path / "one").samples) > 0


def test_a_folder_of_other_files_names_their_suffixes(tmp_path):
    drive = folder_of(tmp_path / "drive", {"front": ["0.tif"]})
    with pytest.raises(
        FileNotFoundError, match=r"no image at .*\['.tif'\], and \['.jpg', .* are read"
    ):
        open_input(drive)


def test_files_that_are_no_images_are_counted(tmp_path):
    drive = folder_of(tmp_path / "drive", {"front": ["0.png", "1.png", "1.tif"]})
    (drive / "front/0.txt").write_text("x")
    source = open_input(drive)
    assert len(source.samples) == 2
    assert source.notes[0] == "camera 'front': 2 files with ['.tif', '.txt'] not read"


@pytest.mark.parametrize("name", ["front[1].png", "[a].png", "a[!b].png", "1.png"])
def test_brackets_in_the_name_of_one_image_are_letters(name, tmp_path):
    drive = folder_of(tmp_path / "drive", {"front": [name, "f.png"]})
    camera = LEVEL | {"images": f"front/{name}"}
    (drive / "calibration.json").write_text(json.dumps({"cameras": {"front": camera}}))
    (sample,) = open_input(drive).samples
    assert sample.cameras[0].path == f"front/{name}"


def test_images_without_a_partner_are_counted(tmp_path):
    names = {"front": ["0.png", "1.png", "2.png"], "left": ["1.png", "2.png", "x.png", "y.png"]}
    source = open_input(folder_of(tmp_path / "drive", names))
    assert [len(sample.cameras) for sample in source.samples] == [1, 2, 2]
    assert "camera 'left': 2 of 4 images used, in 2 of 3 samples; a sample has" in source.notes[1]


def test_an_image_of_two_samples_is_counted_once(tmp_path):
    """The only image of the slow camera is within 50 ms of the first two of three samples."""
    front = [f"{1_700_000_000_000 + late_ms}.png" for late_ms in (0, 40, 200)]
    names = {"front": front, "slow": ["1700000000020.png"]}
    source = open_input(folder_of(tmp_path / "drive", names))
    assert "camera 'slow': 1 of 1 image used, in 2 of 3 samples" in source.notes[1]


def test_a_neglected_motion_is_counted(tmp_path):
    """The last pose is used for 0.1 s: for the front image after 80 ms, not for the left one."""
    names = {"front": ["1700000000080.png"], "left": ["1700000000120.png"]}
    drive = folder_of(tmp_path / "drive", names, poses="poses.csv")
    (drive / "poses.csv").write_text(f"{HEAD}\n{START_NS},0,0,0,1,0,0,0\n")
    expected = "camera 'left': no pose is near the time of its image at 1 of 1 sample: the motion"
    assert expected in open_input(drive).notes[1]


def test_samples_without_a_pose_are_counted_and_none_is_an_error(tmp_path):
    names = {"front": [f"{1_700_000_000_000 + 500 * i}.png" for i in range(5)]}
    drive = folder_of(tmp_path / "drive", names, poses="poses.csv")
    (drive / "poses.csv").write_text(f"{HEAD}\n{START_NS},0,0,0,1,0,0,0\n")
    source = open_input(drive)
    assert len(source.samples) == 1
    assert source.notes[1].startswith("1 of 5 samples used: 4 have no pose within 0.1 s")
    (drive / "poses.csv").write_text(f"{HEAD}\n5000000000,0,0,0,1,0,0,0\n")
    spans = "images are from 2023-11-14 22:13:20.000 UTC to .*, poses from 5.000 s to 5.000 s"
    with pytest.raises(ValueError, match=f"no image has a pose near its time: {spans}"):
        open_input(drive)
