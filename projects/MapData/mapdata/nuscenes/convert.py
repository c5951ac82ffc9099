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
from gsmap.datasets.annotations.record import CLASSES, MapInstance, MapSample
from gsmap.datasets.errors import naming
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from mapdata.command_line import FileOptions, add_file_options, fingerprint, options_from
from mapdata.nuscenes.map import MAP_CLASSES, NuScenesLocalMap, check_classes, open_layers
from mapdata.nuscenes.tables import CAMERAS, LIDAR, NuScenesTables
from mapdata.splits import Positions, overlap_notes, read_split_file, resolve_scenes
from mapdata.summary import ConversionSummary

_OFFICIAL_SPLITS = {
    "v1.0-trainval": ("train", "val"), "v1.0-mini": ("mini_train", "mini_val"),
    "v1.0-test": ("test",),
}  # fmt: skip
_FRAMES_PER_WORKER = 500  # a process takes about as long to start as these take


@dataclass(frozen=True)
class NuScenesOptions(FileOptions):
    """What to convert and how: the options of ``tools/create_data.py nuscenes``.

    Without ``split_file``, ``<root>/<version>/splits.json`` counts if it is there, else the
    official splits.
    """

    version: str
    _: KW_ONLY
    dataset: str = "nuscenes"
    split_file: Path | None = None
    max_sweeps: int = 10
    frame: str = "lidar"


def _check_root(root: Path, version: str) -> None:
    """Raise a ``FileNotFoundError`` if the data root, the version or the maps are not there."""
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
            "Name one with --version."
        )
    if not any((root / "maps/expansion").glob("*.json")):
        raise FileNotFoundError(
            f"no map expansion in {root / 'maps/expansion'}: download `Map expansion pack "
            f"(v1.3)` from https://www.nuscenes.org/download and unpack it into {root / 'maps'}."
        )


def _splits(
    options: NuScenesOptions, tables: NuScenesTables, summary: ConversionSummary
) -> dict[str, str]:
    """Return the split of each scene, by name; scenes that the data set lacks are noted."""
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
    with naming(own, "list each scene in one split"):
        split_of, missing = resolve_scenes(wanted, names)
    if missing:
        total = len(missing) + len(split_of)
        summary.notes.append(f"{len(missing)} of the splits' {total} scenes are not in the tables.")
    if not split_of:
        raise ValueError(
            f"none of the split's scenes is in {options.root / options.version}: it has "
            f"{sorted(names.values())[:5]}; give --split-file."
        )
    return split_of


def _instances_of(local_map: NuScenesLocalMap, poses: np.ndarray) -> list[list[MapInstance] | str]:
    """Return the instances at each pose (n, 4, 4), or why there are none."""
    results: list[list[MapInstance] | str] = []
    for pose in poses:
        try:
            results.append(local_map.instances(pose))
        except (shapely.errors.ShapelyError, ValueError) as error:
            results.append(f"ground truth failed ({type(error).__name__}: {error})")
    return results


class _Conversion:
    """One run over all scenes."""

    def __init__(self, options: NuScenesOptions) -> None:
        self.options = options
        self.summary = ConversionSummary(options.classes)
        self.tables = NuScenesTables(
            options.version, options.root, options.max_sweeps, options.frame
        )
        self.split_of = _splits(options, self.tables, self.summary)
        self.positions: Positions = {split: defaultdict(list) for split in self.split_of.values()}

    def run(self, writers: dict[str, AnnotationWriter]) -> None:
        """Convert map by map, so that one map at a time is in memory."""
        scenes = [scene for scene in self.tables.scene if scene["name"] in self.split_of]
        scenes = self.options.shard.part(sorted(scenes, key=self.tables.location_of))
        with Progress(
            desc=f"{self.options.dataset} {self.options.version}", unit="samples", smoothing=0.05,
            total=sum(scene["nbr_samples"] for scene in scenes),
        ) as bar:  # fmt: skip
            for location, local in groupby(scenes, key=self.tables.location_of):
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
        self, location: str, scenes: list[dict[str, Any]]
    ) -> Iterator[tuple[MapSample, list[MapInstance] | str]]:
        """Yield the samples of one map with their instances, or why there are none."""
        options = self.options
        layers = open_layers(options.root, location, options.classes)
        for reason, count in layers.skipped.items():
            self.summary.add_problem(f"{reason} left out", location, count)
        local_map = NuScenesLocalMap(layers, options.classes, options.x_range, options.y_range)
        frames = sum(scene["nbr_samples"] for scene in scenes)
        workers = max(1, min(options.workers, len(scenes), frames // _FRAMES_PER_WORKER))
        samples, ahead = tee(map(self._scene_samples, scenes))
        poses = (np.array([s.global_from_frame for s in scene]) for scene in ahead)
        results = ordered_map(partial(_instances_of, local_map), poses, workers)
        for of_scene, instances in zip(samples, results, strict=True):
            yield from zip(of_scene, instances, strict=True)

    def _scene_samples(self, scene: dict[str, Any]) -> list[MapSample]:
        """Read a scene's samples without ground truth, counting what is missing."""
        samples = []
        for record in self.tables.samples_of(scene):
            token = record["token"]
            if LIDAR not in record["data"]:  # its frame is not known
                self.summary.add_problem(f"sample left out: no {LIDAR} key frame", token)
                continue
            for name in CAMERAS:
                if name not in record["data"]:
                    self.summary.add_problem(f"{name} absent (sample kept without it)", token)
            sample = self.tables.read(record, scene)
            files = {f"{camera.name} image": camera.path for camera in sample.cameras}
            for name, path in {**files, LIDAR: sample.lidar.path}.items():  # type: ignore[union-attr]
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
    _check_root(options.root, options.version)
    conversion = _Conversion(options)
    tables = options.root / options.version
    maps = sorted((options.root / "maps/expansion").glob("*.json"))
    sizes = {path.name: path.stat().st_size for path in sorted(tables.glob("*.json"))}
    made_from = {
        "source_fingerprint": fingerprint(sizes, [tables / "scene.json", *maps]),
        "versions": {name: version(name) for name in ("nuscenes-devkit", "shapely", "pyarrow")},
        "options": {"version": options.version, "max_sweeps": options.max_sweeps},
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
    if not (options.root / "can_bus").is_dir():
        notes.append("no CAN bus expansion: acceleration, rotation rate and velocity are 0.")
    if not options.shard.count:
        notes += overlap_notes(conversion.positions)
    return conversion.summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py nuscenes``."""
    add = parser.add_argument
    add("--root", type=Path, required=True, help="data root with maps, samples, v1.0-...")
    add("--version", default="v1.0-trainval", help="version folder (default: %(default)s)")
    add("--dataset", help="name in the files (default: minicity or nuscenes)")
    add("--split-file", type=Path, help="own splits as JSON (docs/data.md)")
    add(
        "--classes", nargs="+", default=list(CLASSES), choices=MAP_CLASSES, metavar="CLASS",
        help=f"classes in label order, of {', '.join(MAP_CLASSES)} (default: the first three)",
    )  # fmt: skip
    add(
        "--frame", choices=("lidar", "ego"), default="lidar",
        help="annotation frame: the roof LiDAR or the vehicle (default: %(default)s)",
    )  # fmt: skip
    add_file_options(parser, "lidar", max_sweeps=10)


def run(arguments: argparse.Namespace) -> str:
    """Convert as the command line asks and return the summary."""
    is_minicity = (arguments.root / "minicity.json").is_file()  # it says so in its root
    dataset = arguments.dataset or ("minicity" if is_minicity else "nuscenes")
    options = options_from(NuScenesOptions, arguments, dataset=dataset)
    return convert_nuscenes(options).text()
