"""One's own drives in nuScenes' format: names of towns, cameras, LiDARs, scenes and split lists."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.utils.errors import InputError
from mapdata.inputs import open_input
from mapdata.nuscenes.can_bus import read_messages
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from mapdata.nuscenes.tables import CAMERAS
from mapdata.splits import read_split_file


def edit(root: Path, table: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Change each record of a table."""
    path = root / f"v1.0-trainval/{table}.json"
    records = [{**record, **change(record)} for record in json.loads(path.read_text())]
    path.write_text(json.dumps(records))


def channels(names: dict[str, str]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda sensor: {"channel": names.get(sensor["channel"], sensor["channel"])}


def converted(options: NuScenesOptions, root: Path) -> tuple[list, str]:
    """The samples that a conversion writes, and its summary."""
    summary = convert_nuscenes(replace(options, root=root)).text()
    files = sorted(options.out_dir.glob("*.arrow"))
    return [sample for file in files for sample in AnnotationFile(file)], summary


def test_a_map_of_any_town_is_read_from_its_file(options, damaged_root):
    expected, _ = converted(options, damaged_root)
    town = expected[0].map_name
    maps = damaged_root / "maps/expansion"
    (maps / f"{town}.json").rename(maps / "my town.json")
    (maps / "._my town.json").write_bytes(b"\0\5\x16\7 of macOS")
    edit(damaged_root, "log", lambda log: {"location": log["location"].replace(town, "my town")})
    found, _ = converted(options, damaged_root)
    assert {s.map_name for s in found} == {s.map_name.replace(town, "my town") for s in expected}
    elements = {s.token: s.instances for s in expected}
    for sample in found:
        for one, other in zip(sample.instances, elements[sample.token], strict=True):
            np.testing.assert_array_equal(one.points, other.points)


@pytest.mark.parametrize(
    ("town", "message"),
    [
        ("delft", "no map expansion for 'delft' in .*, which has boston-.*from_records"),
        ("../delft", r"the location '\.\./delft' cannot be the name of a map"),
    ],
)
def test_a_town_without_a_map_is_named(town, message, options, damaged_root):
    edit(damaged_root, "log", lambda _: {"location": town})
    with pytest.raises((FileNotFoundError, ValueError), match=message):
        convert_nuscenes(replace(options, root=damaged_root))


def test_cameras_of_any_channel_are_read_after_those_of_nuscenes(options, damaged_root):
    edit(damaged_root, "sensor", channels({"CAM_BACK": "ZOOM", "CAM_FRONT": "AHEAD"}))
    expected = [name for name in CAMERAS if name not in ("CAM_BACK", "CAM_FRONT")]
    samples, summary = converted(options, damaged_root)
    for sample in (*samples, *open_input(damaged_root).samples):
        assert [camera.name for camera in sample.cameras] == [*expected, "AHEAD", "ZOOM"]
    assert "cameras AHEAD, ZOOM: name them in `cameras`" in summary
    assert "x CAM_BACK absent (sample kept without it)" in summary


def test_a_lidar_of_another_name_is_taken_in_the_frame_of_the_vehicle(options, damaged_root):
    edit(damaged_root, "sensor", channels({"LIDAR_TOP": "LIDAR_ROOF"}))
    message = r"has no LIDAR_TOP, .*but the channels \['CAM_BACK', .*'LIDAR_ROOF'\].*--frame ego"
    for read in (open_input, lambda root: convert_nuscenes(replace(options, root=root))):
        with pytest.raises(ValueError, match=message):
            read(damaged_root)
    samples, _ = converted(replace(options, frame="ego"), damaged_root)
    assert all("LIDAR" in sample.lidar.path for sample in samples)


def test_signals_are_dropped_of_drives_of_nuscenes_alone_and_counted(options, damaged_root):
    (first, second) = json.loads((damaged_root / "v1.0-trainval/scene.json").read_text())
    names = {first["name"]: "scene-0161", second["name"]: "scene-0314"}
    edit(damaged_root, "scene", lambda scene: {"name": names[scene["name"]]})
    for old, new in names.items():
        folder = damaged_root / "can_bus"
        (folder / f"{old}_pose.json").rename(folder / f"{new}_pose.json")
    split = damaged_root / "v1.0-trainval/splits.json"
    split.write_text(json.dumps({"train": list(names.values())}))

    def signals(samples: list) -> list[bool]:
        return [bool(sample.can_bus[7:16].any()) for sample in samples]

    samples, summary = converted(options, damaged_root)
    assert all(signals(samples))
    assert all(signals(open_input(damaged_root).samples))
    assert "without vehicle signals" not in summary
    edit(damaged_root, "log", lambda _: {"logfile": "n008-2018-08-01-15-16-36-0400"})
    samples, summary = converted(options, damaged_root)
    assert not any(signals(samples))
    assert not any(signals(open_input(damaged_root).samples))
    assert "2 x scene without vehicle signals: the nuScenes devkit rejects its CAN" in summary
    assert all(name in summary for name in names.values())


def refuse_names(options: NuScenesOptions, root: Path, message: str) -> None:
    with pytest.raises(InputError, match=message):
        convert_nuscenes(replace(options, root=root))
    assert not list(options.out_dir.glob("*.arrow"))


@pytest.mark.parametrize("name", ["drive", "scene-0001", ""])
def test_two_drives_of_one_name_are_refused(name, options, damaged_root):
    scenes = json.loads((damaged_root / "v1.0-trainval/scene.json").read_text())
    one, other = (scene["token"] for scene in scenes)
    edit(damaged_root, "scene", lambda _: {"name": name})
    message = f"two scenes have the name {name!r}: {one!r} in .*{other!r} in .*rename one of them"
    refuse_names(options, damaged_root, message)
    with pytest.raises(InputError, match=message):
        open_input(damaged_root)


@pytest.mark.parametrize("listed", ["name", "token"])
def test_drives_of_one_name_in_two_versions_are_refused(listed, options, damaged_root, tmp_path):
    """The versions have a drive each; a list may name one of them by its token."""
    versions = ("v1.0-trainval", "day2")
    shutil.copytree(damaged_root / versions[0], damaged_root / versions[1])
    for version, keep in zip(versions, (0, 1), strict=True):
        path = damaged_root / version / "scene.json"
        scene = json.loads(path.read_text())[keep]
        path.write_text(json.dumps([{**scene, "name": "scene-0001"}]))
        (damaged_root / version / "splits.json").write_text(
            json.dumps({"train": [scene["token"] if listed == "token" else "scene-0001"]})
        )
    joined = replace(options, version=versions)
    message = r"'scene-0001': .*v1\.0-trainval/scene\.json.*day2/scene\.json; .*each version with"
    refuse_names(joined, damaged_root, message)
    path = damaged_root / "day2/scene.json"
    path.write_text(path.read_text().replace('"scene-0001"', '"scene-0002"'))
    if listed == "name":
        split = damaged_root / "day2/splits.json"
        split.write_text(json.dumps({"val": ["scene-0002"]}))
    samples, _ = converted(joined, damaged_root)
    assert {sample.scene for sample in samples} == {"scene-0001", "scene-0002"}


def test_samples_of_an_input_without_the_lidar_are_counted(damaged_root):
    total = len(open_input(damaged_root).samples)
    first = json.loads((damaged_root / "v1.0-trainval/sample.json").read_text())[0]["token"]
    is_lidar = lambda r: r["sample_token"] == first and "LIDAR_TOP" in r["filename"]  # noqa: E731
    edit(damaged_root, "sample_data", lambda r: {"is_key_frame": False} if is_lidar(r) else {})
    source = open_input(damaged_root)
    assert len(source.samples) == total - 1
    expected = f"{total - 1} of {total} samples used: the others have no key frame of LIDAR_TOP"
    assert source.notes == (expected,)
    edit(damaged_root, "sample_data", lambda _: {"is_key_frame": False})
    with pytest.raises(ValueError, match=f"0 of {total} samples used"):
        open_input(damaged_root)


def test_signals_of_scenes_of_any_name_are_read_in_the_order_of_time(tmp_path):
    def message(time_us: int, speed: float) -> dict[str, Any]:
        return {"utime": time_us, "accel": [0] * 3, "rotation_rate": [0] * 3, "vel": [speed, 0, 0]}

    (tmp_path / "can_bus").mkdir()
    for scene in ("drive 1", "scene-161", "my-scene-0161"):
        path = tmp_path / f"can_bus/{scene}_pose.json"
        path.write_text(json.dumps([message(20, 2.0), message(10, 1.0)]), encoding="utf-8-sig")
        times_us, measured = read_messages(tmp_path, scene)
        assert times_us.tolist() == [10, 20]
        assert measured[:, 6].tolist() == [1, 2]
    path.write_text('[{"utime": 1}]')
    with pytest.raises(ValueError, match=r"has no 'accel'; .*utime, accel, rotation_rate, vel"):
        read_messages(tmp_path, "my-scene-0161")


def test_split_lists_as_text_have_the_splits_name_in_their_own(tmp_path):
    path = tmp_path / "av2_val_split.txt"
    path.write_bytes(b"\xef\xbb\xbfone\r\n\r\n two \r\n")
    assert read_split_file(path).scenes == {"val": ["one", "two"]}
    for name in ("scenes.txt", "train_or_val.txt"):
        (tmp_path / name).write_text("one\n")
        with pytest.raises(
            ValueError, match=f"the name of .*{name} must have one of the words train"
        ):
            read_split_file(tmp_path / name)
    (tmp_path / "own.json").write_text("one\ntwo\n")
    with pytest.raises(
        ValueError, match=r"own\.json cannot be read: .*is JSON like .*or a text file"
    ):
        read_split_file(tmp_path / "own.json")
