"""Generates a MiniCity data set in the nuScenes format, whole or not at all."""

import json
import logging
import os
import shutil
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

import cv2

from gsmap.utils.files import SUFFIX, require_no_link, try_lock
from gsmap.utils.parallel import default_workers, ordered_map
from gsmap.utils.progress import Progress
from minicity.config import TRAIN_LOCATIONS, VAL_LOCATIONS, VERSION, MiniCityConfig, make_token
from minicity.map_expansion import write_map
from minicity.rig import CAMERAS, ego_from_lidar, quaternion
from minicity.scene import Records, SceneMaker, SceneTask
from minicity.town import Town, make_town

MARKER = "minicity.json"
TABLES = [
    "category",
    "attribute",
    "visibility",
    "instance",
    "sensor",
    "calibrated_sensor",
    "ego_pose",
    "log",
    "scene",
    "sample",
    "sample_data",
    "sample_annotation",
    "map",
]
CATEGORIES = ("vehicle.car", "vehicle.truck", "vehicle.bus.rigid", "human.pedestrian.adult")
ATTRIBUTES = ("vehicle.moving", "vehicle.parked", "pedestrian.standing")
LOGGER = logging.getLogger(__name__)


def plan_scenes(config: MiniCityConfig) -> list[SceneTask]:
    """Name the scenes as the official split does and share them out among the towns."""
    from nuscenes.utils import splits

    tasks: list[SceneTask] = []
    for names, count, locations in (
        (splits.train, config.num_train, TRAIN_LOCATIONS),
        (splits.val, config.num_val, VAL_LOCATIONS),
    ):
        for i, name in enumerate(names[:count]):
            location = locations[i % len(locations)]
            tasks.append(SceneTask(name, len(tasks), location, i // len(locations)))
    return tasks


def generate(
    root: str | Path,
    scenes: int,
    seed: int = 0,
    image_size: tuple[int, int] = (800, 450),
    samples_per_scene: int = 10,
    sweeps_per_sample: int = 2,
    val_scenes: int | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> bool:
    """Generate a MiniCity data set.

    The same arguments give the same bytes whatever the number of workers. Files are written beside
    ``root`` and moved there when all are complete.

    Args:
        root: Folder to make. If it holds the same data set already, nothing is done.
        scenes: Number of scenes, training and validation together.
        seed: Seed of every random choice.
        image_size: Width and height of the pictures in pixels.
        samples_per_scene: Key frames per scene.
        sweeps_per_sample: LiDAR sweeps between two key frames.
        val_scenes: Validation scenes among ``scenes``; None takes a fifth.
        workers: Processes; None takes one per core, 0 or 1 works in this process.
        progress: Whether to show a progress bar.

    Returns:
        Whether anything was generated: False if it was there already.

    Raises:
        ValueError: If an argument is out of range or ``root`` holds anything else.
        RuntimeError: If another process is generating into ``root``.
    """
    config = MiniCityConfig(
        scenes, seed, *image_size, samples_per_scene, sweeps_per_sample, val_scenes
    )
    if workers is not None and workers < 0:
        raise ValueError(f"workers must be >= 0, got {workers}.")
    root = Path(os.path.abspath(root))
    if is_complete(root, config):
        LOGGER.info("%s is complete already: nothing to do.", root)
        return False
    with _partial_folder(root) as folder:
        _fill(folder, config, workers, progress)
        (folder / MARKER).write_text(json.dumps(config.as_dict(), indent=2) + "\n")
        os.replace(folder, root)
    return True


def is_complete(root: Path, config: MiniCityConfig) -> bool:
    """Whether ``root`` holds exactly this data set.

    Raises:
        ValueError: If it holds something else.
    """
    marker = root / MARKER
    if marker.is_file():
        found = json.loads(marker.read_text())
        wanted = config.as_dict()
        if found == wanted:
            return True
        keys = sorted(k for k in {*found, *wanted} if found.get(k) != wanted.get(k))
        differences = ", ".join(f"{k} is {found.get(k)}, asked for {wanted.get(k)}" for k in keys)
        raise ValueError(
            f"{root} holds another MiniCity data set ({differences}): "
            "choose another --root or remove that folder."
        )
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(
            f"{root} exists and is not a complete MiniCity data set: "
            "choose another --root or remove it."
        )
    return False


@contextmanager
def _partial_folder(root: Path) -> Iterator[Path]:
    """A locked folder beside ``root`` to write into, gone afterwards unless it was renamed."""
    root.parent.mkdir(parents=True, exist_ok=True)
    partial = root.with_name(f"{root.name}{SUFFIX}")
    require_no_link(partial)
    partial.mkdir(exist_ok=True)
    handle = os.open(partial, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        locked = try_lock(handle)
        if not locked and (locked is False or any(partial.iterdir())):
            raise RuntimeError(
                f"another process is generating into {partial}: wait for its end, or, if there is "
                "none and this disk has no locks, remove that folder."
            )
        try:
            for leftover in partial.iterdir():
                folder = leftover.is_dir() and not leftover.is_symlink()
                shutil.rmtree(leftover) if folder else leftover.unlink()
            yield partial
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    finally:
        os.close(handle)


def _fill(root: Path, config: MiniCityConfig, workers: int | None, progress: bool) -> None:
    """Write every file of a data set but its marker."""
    for channel in (*(m.channel for m in CAMERAS), "LIDAR_TOP"):
        (root / "samples" / channel).mkdir(parents=True)
    (root / "sweeps" / "LIDAR_TOP").mkdir(parents=True)
    (root / "can_bus").mkdir()
    tasks = plan_scenes(config)
    towns = {
        name: make_town(name, config.seed, sum(t.location == name for t in tasks))
        for name in (*TRAIN_LOCATIONS, *VAL_LOCATIONS)
    }
    masks = {name: write_map(root, town, config.seed) for name, town in towns.items()}
    by_scene = _run_scenes(root, config, tasks, towns, workers, progress)
    tables: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for task in tasks:
        for table, rows in by_scene[task.name].items():
            tables[table] += rows
    _add_fixed_tables(tables, config)
    places = {log["token"]: log["location"] for log in tables["log"]}
    for name, filename in masks.items():
        tables["map"].append(
            {
                "token": make_token(config.seed, "map", name),
                "category": "semantic_prior",
                "filename": filename,
                "log_tokens": [token for token, place in places.items() if place == name],
            }
        )
    folder = root / VERSION
    folder.mkdir()
    for table in TABLES:
        (folder / f"{table}.json").write_text(json.dumps(tables[table]))


def _add_fixed_tables(tables: dict[str, list[dict[str, Any]]], config: MiniCityConfig) -> None:
    """The tables that are the same for all scenes."""
    for table, names in (("category", CATEGORIES), ("attribute", ATTRIBUTES)):
        for name in names:
            token = make_token(table, name)
            tables[table].append({"token": token, "name": name, "description": ""})
    for level, share in enumerate(("0-40", "40-60", "60-80", "80-100"), start=1):
        tables["visibility"].append({"token": str(level), "level": f"v{share}", "description": ""})
    lidar_pose = ego_from_lidar()
    sensors: list[tuple[str, str, Any, list]] = [("LIDAR_TOP", "lidar", lidar_pose, [])]
    for mount in CAMERAS:
        intrinsics = mount.intrinsics(config.image_width, config.image_height).tolist()
        sensors.append((mount.channel, "camera", mount.ego_from_cam, intrinsics))
    for channel, modality, pose, intrinsics in sensors:
        sensor = make_token("sensor", channel)
        tables["sensor"].append({"token": sensor, "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append(
            {
                "token": make_token(config.seed, "calibration", channel),
                "sensor_token": sensor,
                "translation": pose[:3, 3].tolist(),
                "rotation": quaternion(pose),
                "camera_intrinsic": intrinsics,
            }
        )


def _make_scene(
    root: Path, config: MiniCityConfig, towns: dict[str, Town], task: SceneTask
) -> Records:
    """Make a scene in one process."""
    if parent_process() is not None:  # one of many processes, each of one thread
        cv2.setNumThreads(1)
    return SceneMaker(config, task, towns[task.location], root).make()


def _run_scenes(
    root: Path,
    config: MiniCityConfig,
    tasks: list[SceneTask],
    towns: dict[str, Town],
    workers: int | None,
    progress: bool,
) -> dict[str, Records]:
    """Make all scenes, each in one process, and return their records by scene name."""
    workers = min(default_workers() if workers is None else max(workers, 1), len(tasks))
    make = partial(_make_scene, root, config, towns)
    results = ordered_map(make, tasks, workers, timeout_s=7200.0)
    per_scene = len(CAMERAS) * config.samples_per_scene
    done: dict[str, Records] = {}
    with Progress(
        total=per_scene * len(tasks), unit="images", desc="MiniCity", disable=not progress
    ) as bar:
        for task, records in zip(tasks, results, strict=True):
            done[task.name] = records
            bar.update(per_scene)
    return done
