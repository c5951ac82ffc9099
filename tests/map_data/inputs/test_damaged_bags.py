"""Damaged bags, messages, images and calibrations are named, and what is whole goes on."""

import re
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from bag_cases import Recorder, options, record, starting_at_0

from mapdata.inputs import open_input


def test_a_damaged_bag_and_a_missing_extra_are_named(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"no bag at all")
    with pytest.raises(ValueError, match=r"a.mcap cannot be used"):
        open_input(path)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(RuntimeError, match=r"`pip install -e .\[bags\]`"):
        open_input(path)


@pytest.mark.parametrize("distortion", [(), (-0.3, 0.1, 0, 0, 0)])
def test_a_bad_image_is_noted_and_left_out_and_the_others_go_on(
    drive, minicity_root, tmp_path, distortion
):
    good = (minicity_root / drive[0].cameras[0].path).read_bytes()
    small = cv2.imencode(".jpg", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    bad = {1: b"", 2: b"no image", 3: good[: len(good) // 2], 4: small}
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, [replace(drive[0], cameras=drive[0].cameras[:1])], minicity_root,
           distortion=distortion, more=bad)  # fmt: skip
    source = open_input(recorder.path, options(tmp_path))
    assert len(source.samples) == 5
    assert len(source.notes) == 4
    for seconds, note in zip(bad, sorted(source.notes), strict=True):
        assert f"camera 'CAM_FRONT', image at {seconds}000000000 ns" in note
    there = [(source.data_root / s.cameras[0].path).is_file() for s in source.samples]
    assert sorted(there) == [False] * 4 + [True]


def test_a_raw_image_with_a_wrong_encoding_size_or_step_is_noted(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "drive", "sqlite")
    sample = replace(drive[0], cameras=drive[0].cameras[:1])
    record(recorder, [sample], minicity_root, raw="bgr8", more={
        1: {"encoding": "32FC1"}, 2: {"width": 0, "height": 0, "step": 0}, 3: {"step": 7},
        4: {"data": np.zeros(0, np.uint8)}, 5: {"encoding": "bayer_rggb8", "step": 0},
    })  # fmt: skip
    source = open_input(recorder.path, options(tmp_path))
    assert len(source.samples) == 6
    texts = "its frame is left out|encoding '32FC1'|its camera info says"
    assert len([note for note in source.notes if re.search(texts, note)]) == 5


def test_a_damaged_message_is_noted_and_left_out(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "drive", "mcap")
    record(recorder, drive[:1], minicity_root, damaged=("/tf", "/CAM_FRONT/camera_info"))
    source = open_input(recorder.path, options(tmp_path))
    assert source.has_poses
    tf, info = source.notes
    assert tf.startswith("1 messages of '/tf' cannot be read and are left out: the message at 1 ns")
    assert info.startswith("1 messages of '/CAM_FRONT/camera_info' cannot be read")


@pytest.mark.parametrize(
    ("distortion", "message"),
    [
        ((0.1,), "takes 4 or 5 or 8"),
        ((0.1, 0.1, 0.1), "takes 4 or 5 or 8"),
        ((0.1,) * 7, "takes 4 or 5 or 8"),
        ((np.nan, 0, 0, 0, 0), "all finite"),
        ((-300.0, 0.1, 0, 0, 0), "sees next to nothing"),
    ],
)
def test_a_distortion_that_cannot_be_is_named(drive, minicity_root, tmp_path, distortion, message):
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, drive[:1], minicity_root, distortion=distortion)
    with pytest.raises(ValueError, match=f"drive cannot be used: camera 'CAM_.*{message}"):
        open_input(recorder.path, options(tmp_path))
    assert not (tmp_path / "frames").exists()


def test_a_camera_info_without_a_size_is_named(drive, minicity_root, tmp_path):
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, [starting_at_0(drive, width=0, height=0)], minicity_root)
    with pytest.raises(ValueError, match=r"camera 'CAM_.*has images of \(0, 0\) pixels"):
        open_input(recorder.path, options(tmp_path))


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_bag_that_is_cut_or_overwritten_is_named(drive, minicity_root, tmp_path, kind):
    recorder = Recorder(tmp_path / "drive", kind)
    record(recorder, drive[:1], minicity_root)
    suffix = {"ros1": "bag", "sqlite": "db3", "mcap": "mcap"}[kind]
    (path,) = tmp_path.rglob(f"*.{suffix}")
    content, options_ = path.read_bytes(), options(tmp_path)
    middle = len(content) // 2
    overwritten = content[:middle] + b"\xff" * 9000 + content[middle + 9000 :]
    for damaged in (content[:middle], content[:99], b"", overwritten):
        path.write_bytes(damaged)
        said = trouble(path, options_)
        assert path.name in said or "ns: its message is truncated or damaged" in said


def trouble(path, options):
    """Return what a reader says of a damaged bag."""
    try:
        return " ".join(open_input(path, options).notes)
    except ValueError as error:
        return str(error)
