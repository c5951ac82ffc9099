"""Generate a MiniCity data set in the nuScenes format.

The folder of the data set appears only when it is complete.
"""

import json
import logging
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

import cv2

from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.files import SUFFIX, read_json, require_no_link, try_lock
from gsmap.utils.parallel import default_workers, ordered_map
from gsmap.utils.progress import Progress
from minicity.config import TRAIN_LOCATIONS, VAL_LOCATIONS, VERSION, MiniCityConfig, make_token
from minicity.map_expansion import write_expansion, write_mask
from minicity.repaint import changes_geojson, repaint_town
from minicity.rig import CAMERAS, ego_from_lidar, quaternion
from minicity.scene import Records, SceneMaker, SceneTask
from minicity.town import Town, make_town

MARKER = "minicity.json"  # file with the configuration, in the folder of a complete data set
BEFORE = ".before"  # suffix of a town's name, for its map before streets are repainted
CHANGES = "changes.geojson"  # file with the changes of the map by the repainting
TABLES = [  # tables of nuScenes, each a JSON file
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
    """Name the scenes after the official split and distribute them among the towns.

    In each pass, every street is driven once. The scenes of a pass come before the scenes of the
    next pass. The names are names of nuScenes' scenes, so that each scene is in the split that its
    name has in nuScenes.
    """
    from nuscenes.utils import splits

    tasks: list[SceneTask] = []
    for names, count, locations in (
        (splits.train, config.num_train, TRAIN_LOCATIONS),
        (splits.val, config.num_val, VAL_LOCATIONS),
    ):
        for i, name in enumerate(names[: count * config.passes]):
            pass_index, street = divmod(i, count)  # `count` is the number of streets
            location = locations[street % len(locations)]
            is_new = pass_index >= config.passes - config.new_passes
            has_old_paint = config.repainted > 0 and not is_new
            # Streets are dealt to the towns in turn.
            task = SceneTask(
                name=name,
                index=len(tasks),
                location=location,
                index_in_town=street // len(locations),
                route=names[street],  # the scene of the first pass of this street
                pass_index=pass_index,
                expansion=f"{location}{BEFORE}" if has_old_paint else location,
            )
            tasks.append(task)
    return tasks


def generate(
    root: str | Path,
    scenes: int,
    seed: int = 0,
    image_size: tuple[int, int] = (800, 450),
    samples_per_scene: int = 10,
    sweeps_per_sample: int = 2,
    val_scenes: int | None = None,
    passes: int = 1,
    repainted: float = 0.0,
    new_passes: int = 1,
    workers: int | None = None,
    progress: bool = True,
) -> bool:
    """Generate a MiniCity data set.

    Equal arguments give equal bytes for any number of workers. Files are written to a folder beside
    ``root``, which is renamed to ``root`` when it is complete.

    Args:
        root: Output folder. A folder that already contains this data set is not changed.
        scenes: Number of scenes, training and validation together, >= 2.
        seed: Seed of every random choice, >= 0.
        image_size: Width and height of the pictures in pixels.
        samples_per_scene: Key frames per scene, half a second apart, in [1, 40].
        sweeps_per_sample: LiDAR sweeps between two key frames, in [0, 9].
        val_scenes: Validation scenes among ``scenes``; None takes a fifth.
        passes: Number of times that every scene is driven, at other hours and in other weather and
            traffic; the data set has ``scenes * passes`` scenes.
        repainted: Share of the streets that are repainted before the new passes, in [0, 1].
        new_passes: Number of passes after the repainting. These are the last passes.
        workers: Number of processes; None takes one per core, 0 or 1 works in this process.
        progress: Whether to show a progress bar.

    Returns:
        True if the data set was generated, False if it was complete already.

    Raises:
        ValueError: If an argument is out of range or ``root`` has other contents.
        RuntimeError: If another process is generating into ``root``.
    """
    width, height = image_size
    config = MiniCityConfig(
        scenes=scenes,
        seed=seed,
        image_width=width,
        image_height=height,
        samples_per_scene=samples_per_scene,
        sweeps_per_sample=sweeps_per_sample,
        val_scenes=val_scenes,
        passes=passes,
        repainted=repainted,
        new_passes=new_passes,
    )
    if workers is not None and workers < 0:
        raise InputError(f"workers must be >= 0, got {workers}.")
    root = Path(os.path.realpath(root))  # a link could not be replaced by a folder at the end
    if is_complete(root, config):
        LOGGER.info("%s is complete already: nothing to do.", root)
        return False
    if os.path.ismount(root):  # cannot be replaced either
        raise InputError(f"{root} is a mount point: give a folder below it.")
    # The folder keeps another name until all files are written.
    with _partial_folder(root) as folder:
        _fill(folder, config, workers=workers, progress=progress)
        (folder / MARKER).write_text(json.dumps(config.as_dict(), indent=2) + "\n")
        os.replace(folder, root)
    return True


def is_complete(root: Path, config: MiniCityConfig) -> bool:
    """Whether ``root`` contains exactly the data set of ``config``.

    Args:
        root: Folder of the data set.
        config: Configuration of the data set.

    Raises:
        ValueError: If the folder has other contents.
    """
    marker = root / MARKER
    if marker.is_file():
        present = read_json(marker)
        requested = config.as_dict()
        if present == requested:
            return True
        if not isinstance(present, dict):
            raise InputError(f"{marker} is another program's file: choose another --root.")
        differences = []
        for key in sorted({*present, *requested}):
            # The marker omits some fields if they have their default value.
            default = getattr(MiniCityConfig, key, None)
            present_value = present.get(key, default)
            requested_value = requested.get(key, default)
            if present_value != requested_value:
                differences.append(f"{key} is {present_value}, asked for {requested_value}")
        raise InputError(
            f"{root} holds another MiniCity data set ({', '.join(differences)}): "
            "choose another --root or remove that folder."
        )
    is_empty_folder = root.is_dir() and not any(root.iterdir())
    if root.exists() and not is_empty_folder:
        raise InputError(
            f"{root} exists and is not a complete MiniCity data set: "
            "choose another --root or remove it."
        )
    return False


@contextmanager
def _partial_folder(root: Path) -> Iterator[Path]:
    """Create and lock a folder beside ``root`` for writing, and delete it if writing fails.

    The lock belongs to the open folder, so it lasts while the caller renames the folder to
    ``root``. Files that a killed process left in the folder are deleted.

    Args:
        root: Folder of the data set.

    Yields:
        The empty folder.

    Raises:
        RuntimeError: If another process uses the folder.
        ValueError: If the folder is a link.
    """
    root.parent.mkdir(parents=True, exist_ok=True)
    folder = root.with_name(f"{root.name}{SUFFIX}")
    require_no_link(folder)
    folder.mkdir(exist_ok=True)
    handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        # True: this process holds the lock now. False: another process holds it. None: the disk has
        # no locks. In this case, a folder with files may be in use by another process.
        locked = try_lock(handle)
        may_be_used = locked is None and any(folder.iterdir())
        if locked is False or may_be_used:
            raise WorkError(
                f"another process is generating into {folder}: wait for its end. If there is no "
                "other process, and this disk has no locks, remove that folder."
            )
        try:
            for leftover in folder.iterdir():
                if leftover.is_dir() and not leftover.is_symlink():
                    shutil.rmtree(leftover)
                else:
                    leftover.unlink()
            yield folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
    finally:
        os.close(handle)


def _fill(root: Path, config: MiniCityConfig, workers: int | None, progress: bool) -> None:
    """Write every file of a data set except its marker, which shows that it is complete."""
    for mount in CAMERAS:
        (root / "samples" / mount.channel).mkdir(parents=True)
    (root / "samples" / "LIDAR_TOP").mkdir()
    (root / "sweeps" / "LIDAR_TOP").mkdir(parents=True)
    (root / "can_bus").mkdir()
    tasks = plan_scenes(config)
    towns, masks = _make_towns(root, config, tasks=tasks)
    # Rows of the nuScenes tables that each scene adds, by scene and then by table.
    records_by_scene = _run_scenes(
        root, config, tasks=tasks, towns=towns, workers=workers, progress=progress
    )
    tables: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for task in tasks:
        for table, rows in records_by_scene[task.name].items():
            tables[table] += rows
    _add_fixed_tables(tables, config)
    for name, filename in masks.items():  # pictures of the drivable area, by town
        log_tokens = [log["token"] for log in tables["log"] if log["location"] == name]
        tables["map"].append(
            {
                "token": make_token(config.seed, "map", name),
                "category": "semantic_prior",
                "filename": filename,
                "log_tokens": log_tokens,
            }
        )
    folder = root / VERSION
    folder.mkdir()
    if config.passes > 1:
        (folder / "passes.json").write_text(json.dumps(_pass_table(config, tasks)))
        (folder / "splits.json").write_text(json.dumps(_splits(config, tasks)))
    for table in TABLES:
        (folder / f"{table}.json").write_text(json.dumps(tables[table]))


def _make_towns(
    root: Path, config: MiniCityConfig, tasks: list[SceneTask]
) -> tuple[dict[str, Town], dict[str, str]]:
    """Make the towns and write their maps and changes.

    Args:
        root: Folder of the data set.
        config: Configuration of the data set.
        tasks: All scenes.

    Returns:
        Towns by the name of their map, and the path of the drivable-area picture of each location.
        A location whose streets are repainted has two towns, before and after.
    """
    (root / "maps" / "expansion").mkdir(parents=True)
    # In the first pass, each scene has another street.
    street_counts = Counter(task.location for task in tasks if task.pass_index == 0)
    towns = {}
    masks = {}
    changes = {}
    for name in (*TRAIN_LOCATIONS, *VAL_LOCATIONS):
        town = make_town(name, config.seed, num_scenes=street_counts[name])
        # One picture is enough, since repainting does not change the drivable area.
        masks[name] = write_mask(root, town, seed=config.seed)
        if config.repainted > 0:
            towns[f"{name}{BEFORE}"] = town
            town, changes[name] = repaint_town(town, config.seed, share=config.repainted)
        towns[name] = town
    for name, town in towns.items():
        write_expansion(root, town, seed=config.seed, name=name)
    if config.repainted > 0:
        content = json.dumps(changes_geojson(changes), indent=1)
        (root / CHANGES).write_text(content + "\n")
    return towns, masks


def _pass_table(config: MiniCityConfig, tasks: list[SceneTask]) -> list[dict[str, Any]]:
    """Rows of the additional table ``passes.json``: street and pass of each scene."""
    records = []
    for task in tasks:
        records.append(
            {
                "token": make_token(config.seed, task.name, "pass"),
                "scene_token": make_token(config.seed, task.name, "scene"),
                "scene": task.name,
                "location": task.location,
                "first_scene": task.route,  # scene of the first pass of this street
                "pass": task.pass_index + 1,
                "passes": config.passes,
                "map_expansion": task.expansion,
            }
        )
    return records


def _splits(config: MiniCityConfig, tasks: list[SceneTask]) -> dict[str, list[str]]:
    """Names of the scenes of each split.

    Validation scenes of all passes before the last ``new_passes`` form the split ``val_earlier``.
    """
    splits: dict[str, list[str]] = {"train": [], "val": [], "val_earlier": []}
    for task in tasks:
        split = "train"
        if task.location in VAL_LOCATIONS:
            is_new = task.pass_index >= config.passes - config.new_passes
            split = "val" if is_new else "val_earlier"
        splits[split].append(task.name)
    return splits


def _add_fixed_tables(tables: dict[str, list[dict[str, Any]]], config: MiniCityConfig) -> None:
    """Add the tables that do not depend on the scenes, in place."""
    for table, names in (("category", CATEGORIES), ("attribute", ATTRIBUTES)):
        for name in names:
            token = make_token(table, name)
            tables[table].append({"token": token, "name": name, "description": ""})
    for level, share in enumerate(("0-40", "40-60", "60-80", "80-100"), start=1):
        tables["visibility"].append({"token": str(level), "level": f"v{share}", "description": ""})
    lidar_pose = ego_from_lidar()
    # Channel, modality, transform from the sensor to the vehicle, and intrinsics (none for LiDAR).
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
    """Make a scene in this process."""
    # Without a parent process, this is the main process, where OpenCV may use all threads.
    if parent_process() is not None:  # this is one of several workers, which use one thread each
        cv2.setNumThreads(1)
    maker = SceneMaker(config, task, town=towns[task.expansion], root=root)
    return maker.make()


def _run_scenes(
    root: Path,
    config: MiniCityConfig,
    tasks: list[SceneTask],
    towns: dict[str, Town],
    workers: int | None,
    progress: bool,
) -> dict[str, Records]:
    """Make all scenes in worker processes.

    Args:
        root: Folder of the data set.
        config: Configuration of the data set.
        tasks: All scenes.
        towns: Towns by the name of their map.
        workers: Number of processes; None takes one per core, 0 or 1 works in this process.
        progress: Whether to show a progress bar.

    Returns:
        Records of each scene, by its name and then by table.
    """
    wanted_workers = default_workers() if workers is None else max(workers, 1)
    workers = min(wanted_workers, len(tasks))
    make = partial(_make_scene, root, config, towns)
    # Results come in the order of the tasks. The time limit is for one scene.
    results = ordered_map(make, tasks, workers, timeout_s=7200.0)
    images_per_scene = len(CAMERAS) * config.samples_per_scene
    num_images = images_per_scene * len(tasks)
    records_by_scene: dict[str, Records] = {}
    with Progress(total=num_images, unit="images", desc="MiniCity", disable=not progress) as bar:
        for task, records in zip(tasks, results, strict=True):
            records_by_scene[task.name] = records
            bar.update(images_per_scene)
    return records_by_scene
