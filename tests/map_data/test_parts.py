"""Parts of converters: splits, table reading, CAN bus."""

import json
from pathlib import Path

import numpy as np
import pytest

from mapdata.overlap import overlap_share
from mapdata.splits import read_split_file, resolve_scenes


def test_split_files_are_checked(tmp_path: Path):
    path = tmp_path / "s.json"
    with pytest.raises(FileNotFoundError, match="no split file"):
        read_split_file(path)
    for text, message in [
        ("[", "cannot be read"),
        ('["a"]', "must look like"),
        ('{"train": "a"}', "must look like"),
    ]:
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_split_file(path)
    path.write_text('{"train": ["a"], "val": []}')
    assert read_split_file(path).scenes == {"train": ["a"], "val": []}


def test_scenes_resolve_by_name_or_token():
    names = {"t1": "one", "t2": "two", "t3": "three"}
    split_of, missing = resolve_scenes({"train": ["two", "t1"], "val": ["three", "x"]}, names)
    assert split_of == {"one": "train", "two": "train", "three": "val"}
    assert missing == ["x"]
    for first, second in (("one", "one"), ("one", "t1")):
        with pytest.raises(ValueError, match="scene one is in both train and val"):
            resolve_scenes({"train": [first], "val": [second]}, names)


def test_overlap_counts_validation_positions_near_training_on_the_same_map():
    train = {"a": np.array([[0.0, 0]]), "b": np.array([[100.0, 0]])}
    val = {"a": np.array([[5.0, 0], [5.1, 0], [100, 0]]), "c": np.array([[0.0, 0]])}
    assert overlap_share(train, val) == pytest.approx(1 / 4)
    assert overlap_share(train, {}) == 0


def test_can_bus_takes_the_latest_message(tmp_path: Path):
    from mapdata.nuscenes.can_bus import read_messages, signals_at

    def signals(scene: str, timestamp_ns: int) -> np.ndarray:
        return signals_at(timestamp_ns, quarter_turn, read_messages(tmp_path, scene))

    quarter_turn = np.eye(4)
    quarter_turn[:2, :2] = [[0, -1], [1, 0]]
    quarter_turn[:3, 3] = 7, 8, 9
    without = signals("scene-0001", 5_000)
    np.testing.assert_allclose(without[:3], [7, 8, 9])
    np.testing.assert_allclose(without[3:7], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-9)
    assert (without[7:16] == 0).all()
    np.testing.assert_allclose(without[16:], [np.pi / 2, 90])
    messages = [
        {"utime": t, "accel": [t] * 3, "rotation_rate": [0, 0, t], "vel": [1, 2, 3]} for t in (4, 6)
    ]
    (tmp_path / "can_bus").mkdir()
    (tmp_path / "can_bus/scene-0001_pose.json").write_text(json.dumps(messages))
    latest = signals("scene-0001", 5_999)[7:16]
    np.testing.assert_allclose(latest, [4, 4, 4, 0, 0, 4, 1, 2, 3])
    assert (signals("scene-0001", 3_000)[7:16] == 0).all()
    assert (signals("scene-0002", 5_000)[7:16] == 0).all()
