"""From nuScenes-format data (nuScenes, MiniCity) to annotation files, with the official devkit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.metadata import version as package_version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from gsmap.converters.nuscenes.map import (
    MAP_CLASSES,
    MapLayers,
    NuScenesLocalMap,
    read_layers,
)
from gsmap.converters.splits import overlap_share, read_split_file, resolve_scenes
from gsmap.converters.summary import ConversionSummary
from gsmap.datasets.annotations.file import AnnotationWriter
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta, MapInstance, MapSample
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.parallel import ordered_map

if TYPE_CHECKING:
    from gsmap.converters.nuscenes.tables import NuScenesTables

LOCATIONS = (
    "singapore-onenorth",
    "singapore-hollandvillage",
    "singapore-queenstown",
    "boston-seaport",
)
_OFFICIAL_SPLITS = {
    "v1.0-trainval": ("train", "val"),
    "v1.0-mini": ("mini_train", "mini_val"),
    "v1.0-test": ("test",),
}
_FRAMES_PER_WORKER = 500  # a process takes about as long to start as these take


@dataclass(frozen=True)
class NuScenesOptions:
    """What to convert and how.

    Args:
        root: Data root with the version folder, ``maps`` and ``samples``.
        version: Version folder, such as ``v1.0-trainval``.
        out_dir: Folder of the annotation files; the data root if None.
        dataset: Name of the data set in the files.
        split_file: Own split file; else ``<root>/<version>/splits.json`` if it is there, else the
            official splits.
        classes: Names out of ``MAP_CLASSES`` in label order.
        x_range: Smallest and largest x of the ground truth in metres.
        y_range: Smallest and largest y of the ground truth in metres.
        max_sweeps: How many earlier LiDAR sweeps each sample lists at most.
        workers: Number of processes.
        tag: Appended to the file names.
        command: The command line, for messages of readers.
    """

    root: Path
    version: str
    out_dir: Path | None = None
    dataset: str = "nuscenes"
    split_file: Path | None = None
    classes: tuple[str, ...] = CLASSES
    x_range: tuple[float, float] = (-15.0, 15.0)
    y_range: tuple[float, float] = (-30.0, 30.0)
    max_sweeps: int = 10
    workers: int = 1
    tag: str = ""
    command: str = ""


def check_root(root: Path, version: str) -> None:
    """Say what is missing before anything is read.

    Args:
        root: Data root.
        version: Version folder.

    Raises:
        FileNotFoundError: If the data root, the version or the map expansion is not there.
    """
    if not root.is_dir():
        raise FileNotFoundError(
            f"no data set at {root}: give the folder that holds `maps`, `samples` and `v1.0-...`; "
            "nuScenes is at https://www.nuscenes.org/download, and `python tools/create_data.py "
            f"minicity --root {root}` makes MiniCity."
        )
    if not (root / version / "scene.json").is_file():
        found = sorted(p.parent.name for p in root.glob("*/scene.json"))
        raise FileNotFoundError(
            f"no version {version!r} in {root}: it has {', '.join(found) or 'no version at all'}. "
            f"Name one with --version."
        )
    if not any((root / "maps" / "expansion").glob("*.json")):
        raise FileNotFoundError(
            f"no map expansion in {root / 'maps' / 'expansion'}: download `Map expansion pack "
            f"(v1.3)` from https://www.nuscenes.org/download and unpack it into {root / 'maps'}."
        )


def fingerprint(root: Path, version: str) -> str:
    """Return a digest of the maps, the scene list and the sizes of all tables."""
    digest = hashlib.sha256()
    for path in sorted((root / version).glob("*.json")):
        digest.update(f"{path.name} {path.stat().st_size}\n".encode())
    for path in [
        root / version / "scene.json",
        *sorted((root / "maps" / "expansion").glob("*.json")),
    ]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _splits(
    options: NuScenesOptions, tables: NuScenesTables, summary: ConversionSummary
) -> dict[str, list[str]]:
    """Return the scenes of each split that the data set has."""
    from nuscenes.utils.splits import create_splits_scenes

    own = options.split_file or options.root / options.version / "splits.json"
    if options.split_file is not None or own.is_file():
        wanted: dict[str, list[str]] = read_split_file(own)
    elif options.version in _OFFICIAL_SPLITS:
        official = create_splits_scenes()
        wanted = {name: official[name] for name in _OFFICIAL_SPLITS[options.version]}
    else:
        raise ValueError(
            f"version {options.version!r} has no official splits: give --split-file, or write "
            f"{own} (docs/data.md says how)."
        )
    names = {scene["token"]: scene["name"] for scene in tables.scene}
    resolved, missing = resolve_scenes(wanted, names)
    if missing:
        total = len(missing) + sum(len(scenes) for scenes in resolved.values())
        summary.notes.append(f"{len(missing)} of the splits' {total} scenes are not in the tables.")
    if not any(resolved.values()):
        raise ValueError(
            f"none of the split's scenes is in {options.root / options.version}: it has "
            f"{sorted(names.values())[:5]}; give --split-file."
        )
    return resolved


_local_map: NuScenesLocalMap | None = None


def _prepare(
    layers: MapLayers,
    classes: Sequence[str],
    x_range: tuple[float, float],
    y_range: tuple[float, float],
) -> None:
    """Prepare the map once per process."""
    global _local_map
    _local_map = NuScenesLocalMap(layers, classes, x_range, y_range)


def _instances_of(poses: np.ndarray) -> list[list[MapInstance] | str]:
    """Return the instances at each pose (n, 4, 4), or why there are none."""
    assert _local_map is not None
    results: list[list[MapInstance] | str] = []
    for pose in poses:
        try:
            results.append(_local_map.instances(pose))
        except (shapely.errors.ShapelyError, ValueError) as error:
            results.append(f"ground truth failed ({type(error).__name__}: {error})")
    return results


class _Conversion:
    """One run over all scenes; holds what its steps share."""

    def __init__(self, options: NuScenesOptions, progress: Callable[[str, int], None]) -> None:
        from gsmap.converters.nuscenes.can_bus import CanBusReader
        from gsmap.converters.nuscenes.tables import NuScenesTables, SampleReader

        self.options = options
        self.progress = progress
        self.summary = ConversionSummary(options.classes)
        self.tables = NuScenesTables(options.version, options.root, options.max_sweeps > 0)
        self.reader = SampleReader(self.tables, options.max_sweeps)
        self.can_bus = CanBusReader(options.root)
        self.splits = _splits(options, self.tables, self.summary)
        self.split_of = {scene: split for split, scenes in self.splits.items() for scene in scenes}
        self.positions: dict[str, dict[str, list[np.ndarray]]] = {
            split: {} for split in self.splits
        }

    def scene_samples(self, scene: dict[str, Any]) -> list[MapSample]:
        """Read a scene's samples without ground truth, counting what is missing."""
        samples = []
        for record in self.tables.samples_of(scene):
            try:
                sample = self.reader.read(record, scene)
            except (ValueError, KeyError) as error:
                self.summary.add_problem(f"sample left out: {error}", record["token"])
                continue
            self._count_missing(sample)
            pose = sample.global_from_frame @ invert_rigid(sample.ego_from_frame)
            can_bus = self.can_bus.signals(sample.scene, sample.timestamp_ns, pose)
            samples.append(replace(sample, can_bus=can_bus))
        return samples

    def _count_missing(self, sample: MapSample) -> None:
        from gsmap.converters.nuscenes.tables import CAMERAS

        present = {camera.name for camera in sample.cameras}
        for name in CAMERAS:
            if name not in present:
                self.summary.add_problem(f"{name} absent (sample kept without it)", sample.token)
        for camera in sample.cameras:
            if not (self.options.root / camera.path).is_file():
                self.summary.add_problem(f"{camera.name} image file missing", camera.path)
        if sample.lidar is not None and not (self.options.root / sample.lidar.path).is_file():
            self.summary.add_problem("LIDAR_TOP file missing", sample.lidar.path)

    def layers(self, location: str) -> MapLayers:
        """Read one map with the devkit and count its unusable elements."""
        from nuscenes.map_expansion.map_api import NuScenesMap

        if (
            location not in LOCATIONS
            or not (self.options.root / f"maps/expansion/{location}.json").is_file()
        ):
            raise FileNotFoundError(
                f"no map expansion for {location!r} in {self.options.root}/maps/expansion; the "
                f"devkit knows {', '.join(LOCATIONS)}. Unpack the map expansion pack (v1.3) there."
            )
        layers = read_layers(NuScenesMap(str(self.options.root), location), self.options.classes)
        for reason, count in layers.skipped.items():
            self.summary.add_problem(f"{reason} left out", location, count)
        return layers

    def run(self, writers: dict[str, AnnotationWriter]) -> None:
        """Convert map by map, so that one map at a time is in memory."""
        scenes = [scene for scene in self.tables.scene if scene["name"] in self.split_of]
        total = sum(scene["nbr_samples"] for scene in scenes)
        self.progress("samples", total)
        for location in sorted({self.tables.location_of(scene) for scene in scenes}):
            local = [scene for scene in scenes if self.tables.location_of(scene) == location]
            for samples, results in self._with_instances(location, local):
                self._write(writers, samples, results)

    def _with_instances(
        self, location: str, scenes: list[dict[str, Any]]
    ) -> Iterator[tuple[list[MapSample], list[list[MapInstance] | str]]]:
        options, waiting = self.options, []

        def poses() -> Iterator[np.ndarray]:
            for scene in scenes:
                waiting.append(self.scene_samples(scene))
                yield np.array([s.global_from_frame for s in waiting[-1]]).reshape(-1, 4, 4)

        arguments = (self.layers(location), options.classes, options.x_range, options.y_range)
        frames = sum(scene["nbr_samples"] for scene in scenes)
        workers = max(1, min(options.workers, len(scenes), frames // _FRAMES_PER_WORKER))
        for results in ordered_map(_instances_of, poses(), workers, _prepare, arguments):
            yield waiting.pop(0), results

    def _write(
        self,
        writers: dict[str, AnnotationWriter],
        samples: list[MapSample],
        results: list[list[MapInstance] | str],
    ) -> None:
        for sample, instances in zip(samples, results, strict=True):
            self.progress("", 1)
            if isinstance(instances, str):
                self.summary.add_problem(f"sample left out: {instances}", sample.token)
                continue
            split = self.split_of[sample.scene]
            complete = replace(sample, instances=instances)
            writers[split].write(complete)
            self.summary.add_sample(split, complete)
            places = self.positions[split].setdefault(sample.map_name, [])
            places.append(sample.global_from_frame[:2, 3])

    def _stacked(self, split: str) -> dict[str, np.ndarray]:
        return {name: np.array(places) for name, places in self.positions[split].items()}

    def note_overlap(self) -> None:
        """Note how many validation samples lie near a training sample."""
        train = next((s for s in self.splits if s.endswith("train")), None)
        val = next((s for s in self.splits if s.endswith("val")), None)
        if train is None or val is None:
            return
        share = overlap_share(self._stacked(train), self._stacked(val))
        if share > 0:
            self.summary.notes.append(
                f"warning: {share:.1%} of the {val} samples lie within 5 m of a {train} sample: "
                f"scores on them say little about new places. docs/data.md names disjoint splits."
            )


def _meta(options: NuScenesOptions, split: str) -> AnnotationMeta:
    return AnnotationMeta(
        dataset=options.dataset,
        frame="lidar",
        split=split,
        classes=options.classes,
        x_range=options.x_range,
        y_range=options.y_range,
        source_fingerprint=fingerprint(options.root, options.version),
        versions={
            name: package_version(name) for name in ("nuscenes-devkit", "shapely", "pyarrow")
        },
        options={"version": options.version, "max_sweeps": options.max_sweeps},
        command=options.command,
    )


def annotation_path(options: NuScenesOptions, split: str) -> Path:
    """Return where a split's annotation file goes: ``gsmap_<dataset>_<split><tag>.arrow``."""
    name = f"gsmap_{options.dataset}_{split}{options.tag}.arrow"
    return (options.out_dir or options.root) / name


def convert_nuscenes(
    options: NuScenesOptions, progress: Callable[[str, int], None] = lambda _kind, _count: None
) -> ConversionSummary:
    """Write one annotation file per split; all appear together, when all are whole.

    Args:
        options: What to convert and how.
        progress: Called with ("samples", total) once, then with ("", 1) for each sample.

    Returns:
        What was written and what was left out.

    Raises:
        FileNotFoundError: If the data set, its version or a map is missing.
        ValueError: If splits or classes do not fit the data set.
    """
    unknown = [name for name in options.classes if name not in MAP_CLASSES]
    if unknown:
        raise ValueError(f"classes must be among {MAP_CLASSES}, got {unknown}.")
    check_root(options.root, options.version)
    conversion = _Conversion(options, progress)
    with ExitStack() as stack:
        writers = {
            split: stack.enter_context(
                AnnotationWriter(annotation_path(options, split), _meta(options, split))
            )
            for split, scenes in conversion.splits.items()
            if scenes
        }
        conversion.run(writers)
    if not conversion.can_bus.available:
        conversion.summary.notes.append(
            "no CAN bus expansion: acceleration, rotation rate and velocity are 0."
        )
    conversion.note_overlap()
    return conversion.summary
