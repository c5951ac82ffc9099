"""Conversion of nuScenes-format data (nuScenes, MiniCity) to annotation files.

A split list divides scenes into parts such as ``train`` and ``val``. An annotation file has the
samples of one part. Where one file is meant, its part is called the split.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass
from functools import partial
from importlib.metadata import version
from itertools import groupby, tee
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from gsmap.datasets.annotations.file import AnnotationWriter
from gsmap.datasets.annotations.record import CLASSES, UNITED, MapInstance, MapSample
from gsmap.datasets.errors import explain_errors
from gsmap.utils.cli import EachOnce
from gsmap.utils.errors import InputError
from gsmap.utils.files import is_hidden
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.split_lists import SPLIT_LIST, list_identity
from gsmap.utils.words import format_count
from mapdata.command_line import (
    FileOptions,
    add_file_options,
    add_split_options,
    fingerprint,
    options_from,
)
from mapdata.crossings import CROSSINGS
from mapdata.nuscenes.map import (
    MAP_CLASSES,
    NuScenesLocalMap,
    check_classes,
    expansion,
    maps_in,
    open_layers,
)
from mapdata.nuscenes.tables import CAMERAS, NuScenesTables, check_scene_names, versions_in
from mapdata.overlap import Positions, overlap_notes
from mapdata.splits import (
    OFFICIAL,
    SplitList,
    read_split_file,
    requested_split,
    resolve_scenes,
    split_names,
)
from mapdata.summary import ConversionSummary

# Parts of nuScenes' official split list, by version.
_OFFICIAL_SPLITS = {
    "v1.0-trainval": ("train", "val"), "v1.0-mini": ("mini_train", "mini_val"),
    "v1.0-test": ("test",),
}  # fmt: skip
# Smallest number of frames for which a worker is started. Their conversion takes about as long as
# the start of a process.
_FRAMES_PER_WORKER = 500
_Scene = tuple[dict[str, Any], NuScenesTables]  # record of a scene, and the tables of its version


@dataclass(frozen=True)
class NuScenesOptions(FileOptions):
    """Options of a conversion of nuScenes-format data (``tools/create_data.py nuscenes``).

    Without ``split_name`` and ``split_file`` the splits of each version are read from
    ``<root>/<version>/splits.json`` or, if this file is missing, are the official ones.

    Args:
        version: Folder of the tables, or several folders to join, as some published splits need.
        dataset: Name of the data set in the annotation files.
        max_sweeps: Number of earlier LiDAR sweeps per sample.
        frame: Annotation frame, ``lidar`` or ``ego``.
        crossings: Rule of the crossings (`NuScenesLocalMap`).
    """

    version: str | tuple[str, ...]
    _: KW_ONLY
    dataset: str = "nuscenes"
    max_sweeps: int = 10
    frame: str = "lidar"
    crossings: str = UNITED

    @property
    def versions(self) -> tuple[str, ...]:
        """Names of the folders of the tables."""
        return (self.version,) if isinstance(self.version, str) else self.version


def _check_root(root: Path, version: str) -> None:
    """Raise a ``FileNotFoundError`` if the data root, the version or all maps are missing."""
    if not root.is_dir():
        raise FileNotFoundError(
            f"no data set at {root}: give the folder that holds `maps`, `samples` and `v1.0-...`; "
            "nuScenes is at https://www.nuscenes.org/download, and `python tools/create_data.py "
            f"minicity --root {root}` makes MiniCity."
        )
    if not (root / version / "scene.json").is_file():
        versions = ", ".join(versions_in(root)) or "no version at all"
        raise FileNotFoundError(
            f"no version {version!r} in {root}: it has {versions}. Name one with --version."
        )
    if not maps_in(root):
        raise FileNotFoundError(
            f"no map expansion in {root / 'maps/expansion'}: download `Map expansion pack "
            f"(v1.3)` from https://www.nuscenes.org/download and unpack it into {root / 'maps'}."
        )


def _select_splits(options: NuScenesOptions) -> tuple[SplitList, str]:
    """Select the list of splits to convert.

    Returns:
        The list, and its identity for the annotation files (empty for ``splits.json``).
    """
    from nuscenes.utils.splits import create_splits_scenes

    # The list that an option names, or None: a published list by its name, or the list in a file.
    published_or_file = requested_split(options, "nuscenes")
    if published_or_file is not None:
        return published_or_file, published_or_file.identity
    official = create_splits_scenes()
    # Scenes by part. A splits.json may list scenes of all versions, also in another part than the
    # official list.
    scenes: dict[str, list[str]] = {}
    listed: set[str] = set()
    versions_without_list = []
    for version_name in options.versions:
        splits_path = options.root / version_name / "splits.json"
        if not splits_path.is_file():
            versions_without_list.append(version_name)
            continue
        for part, names in read_split_file(splits_path).scenes.items():
            scenes.setdefault(part, []).extend(names)
            listed.update(names)
    has_own_list = bool(scenes)
    for version_name in versions_without_list:
        if version_name not in _OFFICIAL_SPLITS:
            raise InputError(
                f"version {version_name!r} has no official splits: give --split-file, or write "
                f"{options.root / version_name / 'splits.json'} (docs/data.md says how)."
            )
        for part in _OFFICIAL_SPLITS[version_name]:
            names = [name for name in official[part] if name not in listed]
            scenes.setdefault(part, []).extend(names)
    if has_own_list:
        return SplitList("splits", scenes), ""
    # For every version, the identity is computed from these three splits. The splits of the mini
    # version are subsets of them.
    all_scenes = {part: official[part] for part in ("train", "val", "test")}
    return SplitList(OFFICIAL, scenes), list_identity(OFFICIAL, all_scenes)


def _resolve_splits(
    split_list: SplitList, options: NuScenesOptions, scenes: list[_Scene]
) -> tuple[dict[str, str], list[str]]:
    """Find the part of the split list, such as ``train``, to which each scene belongs.

    Returns:
        Part by name of the scene, and notes if scenes of the list are missing in the data set, or
        scenes of the data set in the list.

    Raises:
        ValueError: If a scene is in several parts, if no scene of the list is in the data set, or
            if a scene is missing and must not be.
    """
    names = {}  # names of the scenes by token: a list may give either
    for scene, _ in scenes:
        names[scene["token"]] = scene["name"]
    where = " and ".join(str(options.root / version) for version in options.versions)
    source = options.split_file or f"split {split_list.name!r} of {where}"
    with explain_errors(source, "list each scene in one split"):
        split_of, missing = resolve_scenes(split_list.scenes, names)
    if not split_of:
        raise InputError(
            f"none of the split's scenes is in {where}, which has {sorted(names.values())[:5]}: "
            "give --split-file."
        )
    notes = []
    if missing:
        total = len(missing) + len(split_of)
        note = split_list.missing_note(missing, total, where=where, allowed=options.allow_missing)
        notes.append(note)
    unlisted = sorted(set(names.values()) - split_of.keys())
    if unlisted:
        number = format_count(len(unlisted), "scene")
        notes.append(f"{number} of {where} in no part of the splits, such as {unlisted[0]!r}")
    return split_of, notes


def _extract_instances(
    local_map: NuScenesLocalMap, poses: np.ndarray
) -> list[list[MapInstance] | str]:
    """Extract the map elements at each pose; the result is a text if the extraction fails.

    Args:
        local_map: Prepared map.
        poses: Transforms from the annotation frame to the map in metres. (n, 4, 4)
    """
    results: list[list[MapInstance] | str] = []
    for pose in poses:
        try:
            results.append(local_map.instances(pose))
        except (shapely.errors.ShapelyError, ValueError) as error:
            results.append(f"ground truth failed ({type(error).__name__}: {error})")
    return results


def _map_names(scene_of_version: _Scene) -> tuple[str, str]:
    """Location of a scene, and name of its map file, which may be an earlier map of the place."""
    scene, tables = scene_of_version
    return tables.location_of(scene), tables.expansion_of(scene)


def _count_samples(scenes: list[_Scene]) -> int:
    """Number of samples of all scenes, as given in the records of the scenes."""
    return sum(scene["nbr_samples"] for scene, _ in scenes)


def _stack_poses(samples: list[MapSample]) -> np.ndarray:
    """Poses of the annotation frame of the samples. (n, 4, 4)"""
    return np.array([sample.global_from_frame for sample in samples])


class _Conversion:
    """Conversion of all scenes of the selected splits.

    Args:
        options: Options of the conversion.
    """

    def __init__(self, options: NuScenesOptions) -> None:
        self.options = options
        self.summary = ConversionSummary(options.classes)
        self.scenes: list[_Scene] = []
        for version_name in options.versions:
            tables = NuScenesTables(
                version_name, options.root, max_sweeps=options.max_sweeps, frame=options.frame
            )
            for scene in tables.scene:
                self.scenes.append((scene, tables))
        check_scene_names(self.scenes)
        split_list, self.identity = _select_splits(options)
        self.split_of, notes = _resolve_splits(split_list, options, scenes=self.scenes)
        self.summary.notes += notes
        self.positions: Positions = {}
        for split in self.split_of.values():
            self.positions[split] = defaultdict(list)

    def run(self, writers: dict[str, AnnotationWriter]) -> None:
        """Convert map by map, so that one map at a time is in memory.

        Args:
            writers: Writer of each split.
        """
        selected = []
        for scene, tables in self.scenes:
            if scene["name"] in self.split_of:
                selected.append((scene, tables))
        # `shard.part` takes the scenes that this process converts; without shards, all.
        # They are sorted since `groupby` below joins only neighbours.
        scenes = self.options.shard.part(sorted(selected, key=_map_names))
        progress = Progress(
            desc=f"{self.options.dataset} {'+'.join(self.options.versions)}",
            unit="samples",
            smoothing=0.05,  # small, so that the speed is averaged over many samples
            total=_count_samples(scenes),
        )
        with progress as bar:
            for (_, expansion_name), scenes_of_map in groupby(scenes, key=_map_names):
                for sample, instances in self._with_instances(expansion_name, list(scenes_of_map)):
                    bar.update()
                    if isinstance(instances, str):
                        self.summary.add_problem(f"sample left out: {instances}", sample.token)
                        continue
                    sample.instances = instances
                    split = self.split_of[sample.scene]
                    writers[split].write(sample)
                    self.summary.add_sample(split, sample)
                    # Positions are compared at the end: training and validation may overlap.
                    position = sample.global_from_frame[:2, 3]
                    self.positions[split][sample.map_name].append(position)

    def _with_instances(
        self, expansion_name: str, scenes: list[_Scene]
    ) -> Iterator[tuple[MapSample, list[MapInstance] | str]]:
        """Yield the samples of one map with their map elements, or the reason of a failure.

        Args:
            expansion_name: Name of the map file.
            scenes: Scenes on this map.
        """
        options = self.options
        layers = open_layers(options.root, expansion_name, classes=options.classes)
        for reason, count in layers.skipped.items():
            self.summary.add_problem(f"{reason} left out", expansion_name, count=count)
        for scene, tables in scenes:
            if tables.has_rejected_signals(scene):
                rejected = "scene without vehicle signals: the nuScenes devkit rejects its CAN bus"
                self.summary.add_problem(rejected, scene["name"])
        local_map = NuScenesLocalMap(
            layers,
            options.classes,
            x_range=options.x_range,
            y_range=options.y_range,
            crossings=options.crossings,
        )
        # With one worker, the elements are extracted in this process.
        useful_workers = _count_samples(scenes) // _FRAMES_PER_WORKER
        workers = max(1, min(options.workers, len(scenes), useful_workers))
        # Each scene is read once. Its samples are used twice: the workers take their poses, and the
        # loop below joins them to the map elements that the workers return. ``tee`` keeps them
        # until then.
        samples, samples_for_workers = tee(map(self._scene_samples, scenes))
        poses = map(_stack_poses, samples_for_workers)
        results = ordered_map(partial(_extract_instances, local_map), poses, workers=workers)
        # Results are in the order of the scenes, one entry per sample.
        for scene_samples, instances in zip(samples, results, strict=True):
            yield from zip(scene_samples, instances, strict=True)

    def _scene_samples(self, scene_of_version: _Scene) -> list[MapSample]:
        """Read the samples of a scene without ground truth, and count missing files."""
        samples = []
        lidar_paths = set()
        sweep_paths: dict[str, None] = {}  # each path once: neighbouring samples share sweeps
        scene, tables = scene_of_version
        expected_cameras = set(tables.cameras)
        if expected_cameras.intersection(CAMERAS):  # a rig with cameras of nuScenes has all six
            expected_cameras.update(CAMERAS)
        for record in tables.samples_of(scene):
            # `data` of a record has the key frames of the sample by the name of the sensor.
            token = record["token"]
            if tables.lidar not in record["data"]:  # the pose of the sample is unknown
                self.summary.add_problem(f"sample left out: no {tables.lidar} key frame", token)
                continue
            for name in sorted(expected_cameras):
                if name not in record["data"]:
                    self.summary.add_problem(f"{name} absent (sample kept without it)", token)
            sample = tables.read(record, scene)
            for camera in sample.cameras:
                self._check_file(f"{camera.name} image", camera.path)
            if sample.lidar is not None:
                self._check_file(tables.lidar, sample.lidar.path)
                lidar_paths.add(sample.lidar.path)
                sweep_paths.update(dict.fromkeys(sweep.path for sweep in sample.lidar.sweeps))
            samples.append(sample)
        for path in sweep_paths:
            if path not in lidar_paths:  # an earlier key frame is counted above
                self._check_file(f"{tables.lidar} sweep", path)
        return samples

    def _check_file(self, name: str, path: str) -> None:
        """Count a file of a sample if it is missing."""
        if not (self.options.root / path).is_file():
            self.summary.add_problem(f"{name} file missing", path)


def convert_nuscenes(options: NuScenesOptions) -> ConversionSummary:
    """Convert a data set to one annotation file per split.

    The files appear together, once all are complete.

    Args:
        options: Options of the conversion.

    Returns:
        Counts of the samples and map elements in the files, and of the problems.

    Raises:
        FileNotFoundError: If the data set, its version, a table or a map is missing.
        ValueError: If splits or classes do not fit the data set, or a table or a map is damaged.
    """
    check_classes(options.classes)
    for version_name in options.versions:
        _check_root(options.root, version_name)
    conversion = _Conversion(options)
    source_fingerprint = _source_fingerprint(options)
    package_versions = {name: version(name) for name in ("nuscenes-devkit", "shapely", "pyarrow")}
    choices: dict[str, Any] = {  # options that are recorded in the files
        "version": "+".join(options.versions),
        "max_sweeps": options.max_sweeps,
    }
    if options.crossings != UNITED:  # the default is not recorded
        choices["crossings"] = options.crossings
    if conversion.identity:
        choices[SPLIT_LIST] = conversion.identity
    with ExitStack() as stack:
        writers = {}
        for split in conversion.positions:  # splits with scenes in the data set
            meta = options.meta(
                options.dataset,
                options.frame,
                split,
                source_fingerprint=source_fingerprint,
                versions=package_versions,
                options=choices,
                # The origin of the vehicle is on the road, unlike in Argoverse 2.
                ground_z_m=0.0 if options.frame == "ego" else None,
            )
            target = options.path_of(options.dataset, split)
            writer = AnnotationWriter(target, meta, shard=options.shard)
            writers[split] = stack.enter_context(writer)
        conversion.run(writers)
        for writer in writers.values():  # fails on a full disk, before any file appears
            writer.finish()
    notes = conversion.summary.notes
    cameras: set[str] = set()
    for _, tables in conversion.scenes:
        cameras.update(tables.cameras)
    other_cameras = sorted(cameras - set(CAMERAS))
    if other_cameras:
        names = ", ".join(other_cameras)
        notes.append(f"cameras {names}: name them in `cameras` of a config's data sets.")
    if not (options.root / "can_bus").is_dir():
        notes.append("no CAN bus expansion: acceleration, rotation rate and velocity are 0.")
    # A warning if validation samples are near training samples. A shard has only a part of the
    # positions, and its `count` is not 0.
    if not options.shard.count:
        notes += overlap_notes(conversion.positions)
    return conversion.summary


def _source_fingerprint(options: NuScenesOptions) -> str:
    """Digest of the sizes of all tables and the content of the scene tables and maps.

    The content of the other tables, some of which are large, is not read.
    """
    sizes = {}
    contents = []
    for version_name in options.versions:
        folder = options.root / version_name
        contents.append(folder / "scene.json")
        for path in sorted(folder.glob("*.json")):
            if not is_hidden(path):
                # Several versions have tables of equal names. The tables of the first version have
                # no prefix, so that the digest of a single version does not depend on its folder.
                is_first = version_name == options.versions[0]
                name = path.name if is_first else f"{folder.name}/{path.name}"
                sizes[name] = path.stat().st_size
    contents += [expansion(options.root, name) for name in maps_in(options.root)]
    return fingerprint(sizes, contents)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py nuscenes``."""
    add = parser.add_argument
    add("--root", type=Path, required=True, help="data root with maps, samples, v1.0-...")
    add(
        "--version", nargs="+", action=EachOnce, default=["v1.0-trainval"], metavar="VERSION",
        help="version folder, or several to join (default: v1.0-trainval)",
    )  # fmt: skip
    add("--dataset", help="name in the files (default: minicity or nuscenes)")
    add_split_options(parser, split_names("nuscenes"))
    add(
        "--classes", nargs="+", default=list(CLASSES), choices=MAP_CLASSES, metavar="CLASS",
        help=f"classes in label order, of {', '.join(MAP_CLASSES)} (default: the first three)",
    )  # fmt: skip
    add(
        "--frame", choices=("lidar", "ego"), default="lidar",
        help="annotation frame: the roof LiDAR or the vehicle (default: %(default)s)",
    )  # fmt: skip
    add(
        "--crossings", choices=CROSSINGS, default=UNITED,
        help="rule of the crossings: rings, joined where they overlap (united); the two longest "
        "edges of each (edges); or outlines of parallel neighbours, which are open where the "
        "patch cuts them (parallel; default: %(default)s)",
    )  # fmt: skip
    add_file_options(parser, "lidar", max_sweeps=10)


def run(arguments: argparse.Namespace) -> str:
    """Convert with the options of a command line and return the summary as text."""
    is_minicity = (arguments.root / "minicity.json").is_file()
    dataset = arguments.dataset or ("minicity" if is_minicity else "nuscenes")
    options = options_from(NuScenesOptions, arguments, dataset=dataset)
    return convert_nuscenes(options).text()
