"""From nuScenes-format data (nuScenes, MiniCity) to annotation files, with the official devkit."""

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
from gsmap.datasets.errors import naming
from gsmap.utils.errors import InputError
from gsmap.utils.files import is_hidden
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.split_lists import SPLIT_LIST, list_identity
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
from mapdata.nuscenes.tables import CAMERAS, NuScenesTables, versions_in
from mapdata.overlap import Positions, overlap_notes
from mapdata.splits import (
    OFFICIAL,
    SplitList,
    asked_split,
    read_split_file,
    resolve_scenes,
    split_names,
)
from mapdata.summary import ConversionSummary

_OFFICIAL_SPLITS = {
    "v1.0-trainval": ("train", "val"), "v1.0-mini": ("mini_train", "mini_val"),
    "v1.0-test": ("test",),
}  # fmt: skip
_FRAMES_PER_WORKER = 500  # a process takes about as long to start as these take
_Scene = tuple[dict[str, Any], NuScenesTables]  # its record, and the tables that it is of


@dataclass(frozen=True)
class NuScenesOptions(FileOptions):
    """What to convert and how: the options of ``tools/create_data.py nuscenes``.

    Without ``split_name`` and ``split_file``, ``<root>/<version>/splits.json`` counts if it is
    there, else the official splits. Several versions may be joined, as published splits need it.
    """

    version: str | tuple[str, ...]
    _: KW_ONLY
    dataset: str = "nuscenes"
    max_sweeps: int = 10
    frame: str = "lidar"
    crossings: str = UNITED

    @property
    def versions(self) -> tuple[str, ...]:
        """The folders with tables."""
        return (self.version,) if isinstance(self.version, str) else self.version


def _check_root(root: Path, version: str) -> None:
    """Raise a ``FileNotFoundError`` if the data root, the version or the maps are not there."""
    if not root.is_dir():
        raise FileNotFoundError(
            f"no data set at {root}: give the folder that holds `maps`, `samples` and `v1.0-...`; "
            "nuScenes is at https://www.nuscenes.org/download, and `python tools/create_data.py "
            f"minicity --root {root}` makes MiniCity."
        )
    if not (root / version / "scene.json").is_file():
        found = versions_in(root)
        raise FileNotFoundError(
            f"no version {version!r} in {root}: it has {', '.join(found) or 'no version at all'}. "
            "Name one with --version."
        )
    if not maps_in(root):
        raise FileNotFoundError(
            f"no map expansion in {root / 'maps/expansion'}: download `Map expansion pack "
            f"(v1.3)` from https://www.nuscenes.org/download and unpack it into {root / 'maps'}."
        )


def _wanted(options: NuScenesOptions) -> tuple[SplitList, str]:
    """Return the splits to make, and what files say of them: nothing of a data set's own splits."""
    from nuscenes.utils.splits import create_splits_scenes

    if (asked := asked_split(options, "nuscenes")) is not None:
        return asked, asked.identity
    own = options.root / options.versions[0] / "splits.json"
    if own.is_file():
        return read_split_file(own), ""
    official = create_splits_scenes()
    for each in options.versions:
        if each not in _OFFICIAL_SPLITS:
            raise InputError(
                f"version {each!r} has no official splits: give --split-file, or write {own} "
                "(docs/data.md says how)."
            )
    parts = [part for each in options.versions for part in _OFFICIAL_SPLITS[each]]
    everything = {part: official[part] for part in ("train", "val", "test")}  # mini is of these
    wanted = SplitList(OFFICIAL, {part: official[part] for part in parts})
    return wanted, list_identity(OFFICIAL, everything)


def _resolved(
    wanted: SplitList, options: NuScenesOptions, scenes: list[dict[str, Any]]
) -> tuple[dict[str, str], list[str]]:
    """Return the split of each scene, by name, and notes of scenes that the data set lacks."""
    names = {scene["token"]: scene["name"] for scene in scenes}
    where = " and ".join(str(options.root / version) for version in options.versions)
    with naming(
        options.split_file or f"split {wanted.name!r} of {where}", "list each scene in one split"
    ):
        split_of, missing = resolve_scenes(wanted.scenes, names)
    if not split_of:
        raise InputError(
            f"none of the split's scenes is in {where}: it has {sorted(names.values())[:5]}; give "
            "--split-file."
        )
    total = len(missing) + len(split_of)
    note = missing and wanted.missing_note(missing, total, where, options.allow_missing)
    return split_of, [note] if note else []


def _instances_of(local_map: NuScenesLocalMap, poses: np.ndarray) -> list[list[MapInstance] | str]:
    """Return the instances at each pose (n, 4, 4), or why there are none."""
    results: list[list[MapInstance] | str] = []
    for pose in poses:
        try:
            results.append(local_map.instances(pose))
        except (shapely.errors.ShapelyError, ValueError) as error:
            results.append(f"ground truth failed ({type(error).__name__}: {error})")
    return results


def _location(of_version: _Scene) -> str:
    """Return the name of a scene's map."""
    scene, tables = of_version
    return tables.location_of(scene)


class _Conversion:
    """One run over all scenes."""

    def __init__(self, options: NuScenesOptions) -> None:
        self.options = options
        self.summary = ConversionSummary(options.classes)
        of_each = [
            NuScenesTables(version, options.root, options.max_sweeps, options.frame)
            for version in options.versions
        ]
        self.scenes = [(scene, tables) for tables in of_each for scene in tables.scene]
        wanted, self.identity = _wanted(options)
        self.split_of, notes = _resolved(wanted, options, [scene for scene, _ in self.scenes])
        self.summary.notes += notes
        self.positions: Positions = {split: defaultdict(list) for split in self.split_of.values()}

    def run(self, writers: dict[str, AnnotationWriter]) -> None:
        """Convert map by map, so that one map at a time is in memory."""
        scenes = [each for each in self.scenes if each[0]["name"] in self.split_of]
        scenes = self.options.shard.part(sorted(scenes, key=_location))
        with Progress(
            desc=f"{self.options.dataset} {'+'.join(self.options.versions)}",
            unit="samples", smoothing=0.05,
            total=sum(scene["nbr_samples"] for scene, _ in scenes),
        ) as bar:  # fmt: skip
            for location, local in groupby(scenes, key=_location):
                for sample, instances in self._with_instances(location, list(local)):
                    bar.update()
                    if isinstance(instances, str):
                        self.summary.add_problem(f"sample left out: {instances}", sample.token)
                        continue
                    sample.instances = instances
                    split = self.split_of[sample.scene]
                    writers[split].write(sample)
                    self.summary.add_sample(split, sample)
                    place = sample.global_from_frame[:2, 3]
                    self.positions[split][sample.map_name].append(place)

    def _with_instances(
        self, location: str, scenes: list[_Scene]
    ) -> Iterator[tuple[MapSample, list[MapInstance] | str]]:
        """Yield the samples of one map with their instances, or why there are none."""
        options = self.options
        layers = open_layers(options.root, location, options.classes)
        for reason, count in layers.skipped.items():
            self.summary.add_problem(f"{reason} left out", location, count)
        local_map = NuScenesLocalMap(
            layers, options.classes, options.x_range, options.y_range, options.crossings
        )
        frames = sum(scene["nbr_samples"] for scene, _ in scenes)
        workers = max(1, min(options.workers, len(scenes), frames // _FRAMES_PER_WORKER))
        samples, ahead = tee(map(self._scene_samples, scenes))
        poses = (np.array([s.global_from_frame for s in scene]) for scene in ahead)
        results = ordered_map(partial(_instances_of, local_map), poses, workers)
        for of_scene, instances in zip(samples, results, strict=True):
            yield from zip(of_scene, instances, strict=True)

    def _scene_samples(self, of_version: _Scene) -> list[MapSample]:
        """Read a scene's samples without ground truth, counting what is missing."""
        samples = []
        scene, tables = of_version
        nuscenes_names = set(CAMERAS) if set(CAMERAS) & set(tables.cameras) else set()
        expected = sorted(nuscenes_names | set(tables.cameras))
        for record in tables.samples_of(scene):
            token = record["token"]
            if tables.lidar not in record["data"]:  # its frame is not known
                self.summary.add_problem(f"sample left out: no {tables.lidar} key frame", token)
                continue
            for name in expected:
                if name not in record["data"]:
                    self.summary.add_problem(f"{name} absent (sample kept without it)", token)
            sample = tables.read(record, scene)
            files = {f"{camera.name} image": camera.path for camera in sample.cameras}
            for name, path in {**files, tables.lidar: sample.lidar.path}.items():  # type: ignore[union-attr]
                if not (self.options.root / path).is_file():
                    self.summary.add_problem(f"{name} file missing", path)
            samples.append(sample)
        return samples


def convert_nuscenes(options: NuScenesOptions) -> ConversionSummary:
    """Write one annotation file per split; all appear together, when all are whole.

    Returns what was written and what was left out.

    Raises:
        FileNotFoundError: If the data set, its version or a map is missing.
        ValueError: If splits or classes do not fit the data set.
    """
    check_classes(options.classes)
    for each in options.versions:
        _check_root(options.root, each)
    conversion = _Conversion(options)
    folders = [options.root / each for each in options.versions]
    maps = [expansion(options.root, name) for name in maps_in(options.root)]
    sizes = {
        path.name if folder == folders[0] else f"{folder.name}/{path.name}": path.stat().st_size
        for folder in folders
        for path in sorted(folder.glob("*.json"))
        if not is_hidden(path)
    }
    made_from = {
        "source_fingerprint": fingerprint(sizes, [*(f / "scene.json" for f in folders), *maps]),
        "versions": {name: version(name) for name in ("nuscenes-devkit", "shapely", "pyarrow")},
        "options": {
            "version": "+".join(options.versions),
            "max_sweeps": options.max_sweeps,
            **({} if options.crossings == UNITED else {"crossings": options.crossings}),
            **({SPLIT_LIST: conversion.identity} if conversion.identity else {}),
        },
    }
    with ExitStack() as stack:
        writers = {}
        for split in conversion.positions:
            meta = options.meta(options.dataset, options.frame, split, **made_from)
            writer = AnnotationWriter(options.path_of(options.dataset, split), meta, options.shard)
            writers[split] = stack.enter_context(writer)
        conversion.run(writers)
        for writer in writers.values():  # a full disk shows here, before any file appears
            writer.finish()
    notes = conversion.summary.notes
    foreign = sorted({c for _, tables in conversion.scenes for c in tables.cameras} - set(CAMERAS))
    if foreign:
        notes.append(
            f"cameras {', '.join(foreign)}: name them in `cameras` of a config's data sets."
        )
    if not (options.root / "can_bus").is_dir():
        notes.append("no CAN bus expansion: acceleration, rotation rate and velocity are 0.")
    if not options.shard.count:
        notes += overlap_notes(conversion.positions)
    return conversion.summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py nuscenes``."""
    add = parser.add_argument
    add("--root", type=Path, required=True, help="data root with maps, samples, v1.0-...")
    add(
        "--version", nargs="+", default=["v1.0-trainval"], metavar="VERSION",
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
        help="rule of the crossings: rings that are united where they overlap, the two longest "
        "edges of each, or outlines of parallel neighbours, open where the patch cuts them "
        "(default: %(default)s)",
    )  # fmt: skip
    add_file_options(parser, "lidar", max_sweeps=10)


def run(arguments: argparse.Namespace) -> str:
    """Convert as the command line asks and return the summary."""
    is_minicity = (arguments.root / "minicity.json").is_file()  # it says so in its root
    dataset = arguments.dataset or ("minicity" if is_minicity else "nuscenes")
    options = options_from(NuScenesOptions, arguments, dataset=dataset)
    return convert_nuscenes(options).text()
