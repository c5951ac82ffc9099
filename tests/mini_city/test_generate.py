import fcntl
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from nuscenes import NuScenes
from nuscenes.utils.splits import create_splits_scenes
from processes import run_python

from gsmap.utils.files import SUFFIX
from minicity import generate as generate_module
from minicity.config import TRAIN_LOCATIONS, VAL_LOCATIONS, MiniCityConfig
from minicity.generate import MARKER, _partial_folder, generate, plan_scenes
from minicity.scene import SceneMaker

TINY = {"image_size": (128, 72), "samples_per_scene": 1, "sweeps_per_sample": 0, "progress": False}


def digests(root: Path) -> dict[str, str]:
    files = sorted(p for p in root.rglob("*") if p.is_file())
    return {str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_devkit_finds_every_sensor_file_of_every_sample(nusc: NuScenes) -> None:
    assert len(nusc.sample) == 6
    for sample in nusc.sample:
        assert len(sample["data"]) == 7
        for channel, token in sample["data"].items():
            record = nusc.get("sample_data", token)
            path = Path(nusc.get_sample_data_path(token))
            if channel == "LIDAR_TOP":
                points = np.fromfile(path, np.float32).reshape(-1, 5)
                assert 10_000 < len(points) < 24_000
                assert record["timestamp"] == sample["timestamp"]
            else:
                assert cv2.imread(str(path)).shape == (record["height"], record["width"], 3)


def test_scene_names_put_each_scene_into_the_split_of_its_town(nusc: NuScenes) -> None:
    splits = create_splits_scenes()
    places = {"train": set(), "val": set()}
    for scene in nusc.scene:
        split = "train" if scene["name"] in splits["train"] else "val"
        assert scene["name"] in splits[split]
        places[split].add(nusc.get("log", scene["log_token"])["location"])
    assert places["train"] <= set(TRAIN_LOCATIONS)
    assert places["val"] == set(VAL_LOCATIONS)


def test_lidar_sweeps_between_key_frames_are_chained_in_time(nusc: NuScenes) -> None:
    scene = nusc.scene[0]
    first = nusc.get("sample", scene["first_sample_token"])
    token, seen = first["data"]["LIDAR_TOP"], []
    while token:
        record = nusc.get("sample_data", token)
        seen.append((record["timestamp"], record["is_key_frame"]))
        token = record["next"]
    start = seen[0][0]
    assert [(t - start, key) for t, key in seen] == [
        (0, True),
        (166667, False),
        (333333, False),
        (500000, True),
    ]


def test_can_bus_messages_follow_the_ego_poses(nusc: NuScenes, small_root: Path) -> None:
    from nuscenes.can_bus.can_bus_api import NuScenesCanBus

    scene = nusc.scene[0]
    messages = NuScenesCanBus(dataroot=str(small_root)).get_messages(scene["name"], "pose")
    times = np.array([m["utime"] for m in messages])
    np.testing.assert_array_equal(np.diff(times), 20_000)
    first, last = (nusc.get("sample", scene[f"{end}_sample_token"]) for end in ("first", "last"))
    places = []
    for sample in (first, last):
        data = nusc.get("sample_data", sample["data"]["LIDAR_TOP"])
        pose = nusc.get("ego_pose", data["ego_pose_token"])
        message = messages[int(np.argmin(np.abs(times - sample["timestamp"])))]
        np.testing.assert_allclose(message["pos"], pose["translation"], atol=1e-5)
        np.testing.assert_allclose(message["orientation"], pose["rotation"], atol=1e-5)
        places.append(pose["translation"])
    between = [m for m in messages if first["timestamp"] <= m["utime"] <= last["timestamp"]]
    travelled = np.mean([m["vel"][0] for m in between]) * 0.5
    assert travelled == pytest.approx(np.linalg.norm(np.subtract(*places)), rel=0.03)


def test_annotated_boxes_hold_the_lidar_points_that_they_claim(nusc: NuScenes) -> None:
    from nuscenes.utils.data_classes import LidarPointCloud
    from nuscenes.utils.geometry_utils import points_in_box

    checked = 0
    for sample in nusc.sample:
        path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
        points = LidarPointCloud.from_file(path).points[:3]
        for box in boxes:
            claimed = nusc.get("sample_annotation", box.token)["num_lidar_pts"]
            # The devkit's box has no slack for the range noise of 1.5 cm; ours has 5 cm.
            assert claimed > 0
            box.wlh = box.wlh + 0.1
            found = int(points_in_box(box, points).sum())
            assert abs(found - claimed) <= max(2, 0.05 * claimed)
            checked += 1
    assert checked > 20


@pytest.mark.faults
def test_same_bytes_in_one_process_and_in_two(tmp_path: Path) -> None:
    generate(tmp_path / "a", 3, seed=4, workers=0, **TINY)
    generate(tmp_path / "b", 3, seed=4, workers=2, **TINY)
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_another_seed_gives_other_maps_and_pictures(tmp_path: Path, small_root: Path) -> None:
    generate(tmp_path / "a", 2, seed=12, workers=0, **TINY)
    name = f"maps/expansion/{VAL_LOCATIONS[0]}.json"
    first, second = (json.loads((r / name).read_text()) for r in (tmp_path / "a", small_root))
    assert first["node"][0] != second["node"][0]
    tokens = [{node["token"] for node in m["node"]} for m in (first, second)]
    assert not tokens[0] & tokens[1]


def test_running_again_changes_nothing_and_other_arguments_are_refused(small_root: Path) -> None:
    before = (small_root / MARKER).stat().st_mtime_ns
    arguments = {"seed": 28, "image_size": (320, 180), "samples_per_scene": 2}
    assert generate(small_root, 3, workers=0, progress=False, **arguments) is False
    assert (small_root / MARKER).stat().st_mtime_ns == before
    with pytest.raises(ValueError, match="seed is 28, asked for 12"):
        generate(small_root, 3, workers=0, progress=False, **{**arguments, "seed": 12})


def test_a_folder_with_other_files_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="not a complete MiniCity data set"):
        generate(tmp_path, 2, workers=0, **TINY)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_no_link_is_followed_where_leftovers_are_removed(tmp_path: Path) -> None:
    elsewhere, root = tmp_path / "elsewhere", tmp_path / "root"
    partial = tmp_path / f"root{SUFFIX}"
    elsewhere.mkdir()
    (elsewhere / "mine").write_text("mine")
    partial.symlink_to(elsewhere)
    with pytest.raises(ValueError, match="is a link, and what is written there would go elsewhere"):
        generate(root, scenes=2, workers=1, **TINY)
    partial.unlink()
    partial.mkdir()
    (partial / "link").symlink_to(elsewhere)
    with _partial_folder(root) as folder:
        assert not list(folder.iterdir())
    assert (elsewhere / "mine").read_text() == "mine"


def test_a_link_to_an_empty_folder_is_filled_and_a_mount_point_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, link = tmp_path / "disk", tmp_path / "link"
    disk.mkdir()
    link.symlink_to(disk)
    monkeypatch.setattr("minicity.generate._fill", lambda folder, *_, **__: None)
    assert generate(link, 2, workers=0, **TINY)
    assert [path.name for path in disk.iterdir()] == [MARKER]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "link"]
    monkeypatch.setattr("os.path.ismount", lambda path: True)
    assert not generate(link, 2, workers=0, **TINY)  # complete already
    with pytest.raises(ValueError, match="is a mount point: give a folder below it"):
        generate(tmp_path / "mounted", 2, workers=0, **TINY)


def test_a_failing_scene_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: SceneMaker) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(SceneMaker, "make", fail)
    with pytest.raises(OSError, match="disk full"):
        generate(tmp_path / "root", 2, workers=0, **TINY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.faults
def test_an_error_in_a_worker_reaches_the_caller(tmp_path: Path) -> None:
    config = MiniCityConfig(2, 0, 128, 72, 1, 0)
    with pytest.raises(KeyError, match="singapore-onenorth"):
        generate_module._run_scenes(tmp_path, config, plan_scenes(config), {}, 2, False)


@pytest.mark.faults
def test_workers_that_cannot_start_end_the_run(tmp_path: Path) -> None:
    """A program read from standard input cannot be imported by a new process, which dies."""
    root = tmp_path / "root"
    program = f"""
from pathlib import Path
from minicity.generate import generate
generate(root=Path({str(root)!r}), scenes=2, seed=0, image_size=(64, 36), samples_per_scene=1)
"""
    done = run_python("-", input=program)
    assert done.returncode == 1
    assert "WorkError: a worker process died" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.faults
def test_a_second_run_into_the_same_root_is_refused(tmp_path: Path) -> None:
    partial = tmp_path / "root.gsmap-partial"
    partial.mkdir()
    handle = os.open(partial, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        with pytest.raises(RuntimeError, match="another process"):
            generate(tmp_path / "root", 2, workers=0, **TINY)
    finally:
        os.close(handle)


@pytest.mark.faults
def test_a_killed_run_leaves_no_root_and_the_next_one_completes(tmp_path: Path) -> None:
    root, partial = tmp_path / "root", tmp_path / "root.gsmap-partial"
    script = (
        "import os, signal\n"
        "from minicity.generate import generate\n"
        "os.replace = lambda *_: signal.pause()  # it does not end before it is killed\n"
        f"generate({str(root)!r}, 2, 4, (128, 72), samples_per_scene=40, workers=2)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        while not list(partial.glob("samples/CAM_FRONT/*.jpg")):
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.stdout.read()  # its workers hold it open: it ends when the last of them has
    assert not root.exists()
    assert not (partial / MARKER).exists()
    assert generate(root, 2, seed=4, workers=0, **TINY)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["root"]
    assert len(list(root.glob("samples/CAM_FRONT/*.jpg"))) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": 1}, "scenes must be at least 2"),
        ({"scenes": 4, "seed": -1}, "seed must be >= 0"),
        ({"scenes": 4, "image_size": (10, 10)}, "image size must lie between"),
        ({"scenes": 4, "samples_per_scene": 0}, r"samples_per_scene must be in 1\.\.40"),
        ({"scenes": 4, "sweeps_per_sample": 10}, r"sweeps_per_sample must be in 0\.\.9"),
        ({"scenes": 4, "val_scenes": 4}, r"val_scenes must be in 1\.\.3"),
        ({"scenes": 900}, "at most 700 training and 150"),
        ({"scenes": 4, "workers": -1}, "workers must be >= 0"),
    ],
)
def test_bad_arguments_are_named(tmp_path: Path, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generate(tmp_path / "root", **arguments)
    assert list(tmp_path.iterdir()) == []
