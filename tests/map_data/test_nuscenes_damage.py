"""Damaged nuScenes roots: each ends in an error that names the file, the record and the field."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes


def change(root: Path, table: str, number: int, **fields: Any) -> list[dict]:
    """Change a record of a table; the table as it was before."""
    path = root / f"v1.0-trainval/{table}.json"
    records = json.loads(path.read_text())
    changed = [dict(r, **fields) if i == number else r for i, r in enumerate(records)]
    path.write_text(json.dumps(changed))
    return records


@pytest.mark.parametrize(
    ("table", "fields", "message"),
    [
        ("sample", {"next": "gone"}, "sample.json has no record 'gone', to which"),
        ("sample", {"next": ""}, "scene.json, .*links lead to 1 of its 2 samples"),
        ("scene", {"log_token": "gone"}, "scene.json, record .*log_token 'gone' leads nowhere"),
        ("scene", {"first_sample_token": "x"}, "first_sample_token 'x' leads nowhere"),
        ("sample_data", {"ego_pose_token": "x"}, "sample_data.json, .*ego_pose_token 'x' leads"),
        ("sample_data", {"calibrated_sensor_token": "x"}, "calibrated_sensor_token 'x' leads"),
        ("calibrated_sensor", {"sensor_token": "x"}, "sensor_token 'x' leads nowhere"),
        ("calibrated_sensor", {"translation": [1, "2", 3]}, "translation must be 3 finite numbers"),
        ("calibrated_sensor", {"rotation": [0, 0, 0, 0]}, "rotation must be 4 finite numbers"),
        ("ego_pose", {"translation": [1, 2]}, "ego_pose.json, .*translation must be 3 finite"),
        (
            "ego_pose",
            {"rotation": [float("nan"), 0, 0, 1]},
            r"ego_pose.json, record .* must be 4 finite numbers, got \[nan",
        ),
        ("sample", {"timestamp": "now"}, "sample.json, .*timestamp must be a int, got 'now'"),
        ("sample_data", {"timestamp": 10**18}, "sample_data.json, .*timestamp must be a int"),
        ("log", {"token": "other"}, "scene.json, record .*log_token .* leads nowhere"),
    ],
)
def test_a_broken_record_is_named(
    options: NuScenesOptions, damaged_root: Path, table: str, fields: dict, message: str
):
    change(damaged_root, table, 0, **fields)
    with pytest.raises(ValueError, match=message):
        convert_nuscenes(replace(options, root=damaged_root))


def test_a_link_to_another_scene_is_named(options: NuScenesOptions, damaged_root: Path):
    records = change(damaged_root, "sample", 0)
    number = next(i for i, record in enumerate(records) if not record["next"])
    other = next(r for r in records if r["scene_token"] != records[number]["scene_token"])
    change(damaged_root, "sample", number, next=other["token"])
    message = f"links lead to sample '{other['token']}' of another scene"
    with pytest.raises(ValueError, match=message):
        convert_nuscenes(replace(options, root=damaged_root))


def test_a_record_that_stands_twice_is_named(options: NuScenesOptions, damaged_root: Path):
    first = change(damaged_root, "scene", 0)[0]
    change(damaged_root, "scene", 1, token=first["token"])
    with pytest.raises(ValueError, match=f"scene.json has record '{first['token']}' twice"):
        convert_nuscenes(replace(options, root=damaged_root))


def test_a_second_key_frame_of_a_sensor_is_named(options: NuScenesOptions, damaged_root: Path):
    records = change(damaged_root, "sample_data", 0)
    first = next(number for number, record in enumerate(records) if record["is_key_frame"])
    records.append(dict(records[first], token="copy"))
    (damaged_root / "v1.0-trainval/sample_data.json").write_text(json.dumps(records))
    with pytest.raises(ValueError, match=r"sample_data.json has two key frames of .* for sample"):
        convert_nuscenes(replace(options, root=damaged_root))


def test_a_circle_of_samples_ends_and_is_named(options: NuScenesOptions, damaged_root: Path):
    records = change(damaged_root, "sample", 0)
    first = next(r for r in records if not r["prev"])
    second = records.index(next(r for r in records if r["token"] == first["next"]))
    change(damaged_root, "sample", second, next=first["token"])
    with pytest.raises(ValueError, match=f"next leads back to '{first['token']}'"):
        convert_nuscenes(replace(options, root=damaged_root))


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text + "[]",
        lambda text: text[:-1],
        lambda text: text.replace("},", "},,", 1),
        lambda text: text.replace("},", "}", 1),
        lambda text: text.replace("{", "", 1),
        lambda text: text.lstrip("["),
        lambda text: "{}",
        lambda text: "[" * 100_000,
        lambda text: "",
    ],
)
def test_tables_are_read_whole(options: NuScenesOptions, damaged_root: Path, damage):
    table = damaged_root / "v1.0-trainval/log.json"
    table.write_text(damage(table.read_text()))
    with pytest.raises(ValueError, match=r"log.json(, record None:| (is empty or )?holds)"):
        convert_nuscenes(replace(options, root=damaged_root))


def test_damaged_maps_and_signals_are_named(options: NuScenesOptions, damaged_root: Path):
    (damaged_root / "v1.0-trainval/map.json").unlink()  # not needed
    signals = next((damaged_root / "can_bus").glob("*_pose.json"))
    whole = signals.read_text()
    signals.write_text(whole.replace('"accel": [', '"accel": [1, ', 1))
    with pytest.raises(ValueError, match=f"{signals} cannot be used"):
        convert_nuscenes(replace(options, root=damaged_root))
    signals.write_text(whole)
    for expansion in (damaged_root / "maps/expansion").glob("*.json"):
        expansion.write_text(expansion.read_text()[:-9])
    with pytest.raises(ValueError, match=r"maps/expansion/.*.json cannot be used: .*unpack"):
        convert_nuscenes(replace(options, root=damaged_root))
    (damaged_root / "v1.0-trainval/sensor.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"no table at .*/sensor.json: download"):
        convert_nuscenes(replace(options, root=damaged_root))
