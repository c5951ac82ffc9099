"""Info pickles of MapTR and MapTRv2 as annotation files.

MapTR's ``nuscenes_infos_temporal_*.pkl`` hold sensors and poses; their ground truth is made from
the map expansion. MapTRv2's ``nuscenes_map_infos_temporal_*.pkl`` and ``av2_map_infos_*.pkl`` hold
the ground truth too. The pickles are read without running code from them.
"""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationWriter, check_samples
from gsmap.datasets.annotations.record import (
    CLASSES,
    RANGES,
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
)
from gsmap.datasets.errors import naming
from gsmap.datasets.image_files import image_size
from gsmap.structures.vehicle_signals import pose_signals
from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.progress import Progress
from gsmap.utils.shards import WHOLE, Shard, add_shard_options, digest
from mapdata.command_line import add_range_options
from mapdata.infos.plain_pickle import load_plain_pickle
from mapdata.infos.recordings import find_file
from mapdata.nuscenes.map import NuScenesLocalMap, expansion, open_layers
from mapdata.nuscenes.tables import pose_of
from mapdata.summary import ConversionSummary
from mapdata.unix_times import in_nanoseconds

NUSCENES_SIZE = (1600, 900)
_NEEDED = {
    "lidar": "token, timestamp, lidar_path, lidar2ego_* and ego2global_* (translation, rotation), "
    "and cams with data_path, cam_intrinsic and sensor2lidar_*",
    "ego": "token, log_id, timestamp, lidar_path, e2g_* (translation, rotation), and cams with "
    "img_fpath, intrinsics and extrinsics",
}
_MAPTRV2 = {"timestamp", "log_id", "lidar_path"}  # what MapTRv2's samples of Argoverse 2 have
_BEYOND_M = 1.0  # roll and pitch may move what was cut in the plane by some centimetres


def _relative(path: str, root: Path) -> str:
    """Return a path of an info file relative to the data root, wherever it was made."""
    if (found := find_file(path, root)) is not None:
        return found.as_posix()
    parts = Path(path.replace("\\", "/")).parts
    for anchor in ("samples", "sweeps", "train", "val", "test"):
        if anchor in parts:
            first = len(parts) - 1 - parts[::-1].index(anchor)
            return Path(*parts[first:]).as_posix()
    if not Path(path).is_absolute():
        return Path(*parts).as_posix()
    raise InputError(f"path {path!r} does not lie under {root}: give the right --data-root.")


def _instances(info: Mapping[str, Any], meta: AnnotationMeta) -> list[MapInstance] | None:
    """Return the elements of the file's classes, if known; lines of one point are left out."""
    annotation = info.get("annotation")
    if annotation is None:
        return None
    return [
        MapInstance(label, np.asarray(points, np.float64)[:, : meta.dim])
        for label, name in enumerate(meta.classes)
        for points in annotation[name]
        if len(points) >= 2
    ]


class _Sizes:
    """Sizes of a nuScenes info file's images, of which the first of a camera in a scene is read.

    Args:
        summary: Counts the images that are not there, whose size is taken to be nuScenes'.
    """

    def __init__(self, summary: ConversionSummary) -> None:
        self._summary = summary
        self._known: dict[tuple[str, str], tuple[int, int]] = {}

    def __call__(self, scene: str, camera: str, file: Path) -> tuple[int, int]:
        """Return width and height in pixels of a camera's image."""
        if (scene, camera) in self._known:
            return self._known[scene, camera]
        if not file.is_file():
            width, height = NUSCENES_SIZE
            reason = f"image not there (taken to have {width} x {height} pixels)"
            self._summary.add_problem(f"{camera}: {reason}", str(file))
            return NUSCENES_SIZE
        size = image_size(file, f"camera {camera}")
        self._known[scene, camera] = size
        return size


def _nuscenes_sample(
    info: Mapping[str, Any], meta: AnnotationMeta, root: Path, size_of: _Sizes
) -> MapSample:
    """Read one entry of a nuScenes info file, in the LIDAR_TOP frame."""
    ego_from_frame = pose_of(info, "lidar2ego_")
    global_from_ego = pose_of(info, "ego2global_")
    cameras = []
    for name, camera in info["cams"].items():
        path = _relative(camera["data_path"], root)
        intrinsics = np.asarray(camera["cam_intrinsic"], np.float64)[:3, :3]
        cam_from_frame = np.linalg.inv(pose_of(camera, "sensor2lidar_"))
        size = size_of(str(info.get("scene_token", "")), name, root / path)
        cameras.append(CameraRecord(name, path, *size, intrinsics, cam_from_frame))
    sweeps = []
    for sweep in info.get("sweeps", []):
        path, time_ns = (
            _relative(sweep["data_path"], root),
            in_nanoseconds(sweep["timestamp"], 1000),
        )
        sweeps.append(SweepRecord(path, time_ns, pose_of(sweep, "sensor2lidar_")))
    can_bus = info.get("can_bus")
    if can_bus is not None:  # the pose belongs into it, as MapTR puts it there on loading
        measured = np.asarray(can_bus, np.float64)[7:16]
        can_bus = pose_signals(global_from_ego)
        can_bus[3:7] = np.asarray(info["ego2global_rotation"])
        can_bus[7 : 7 + len(measured)] = measured
    return MapSample(
        token=info["token"],
        scene=info.get("scene_token", ""),
        map_name=info.get("map_location", ""),
        timestamp_ns=in_nanoseconds(info["timestamp"], 1000),
        cameras=cameras,
        global_from_frame=global_from_ego @ ego_from_frame,
        ego_from_frame=ego_from_frame,
        lidar=LidarRecord(_relative(info["lidar_path"], root), np.eye(4), sweeps),
        can_bus=can_bus,
        instances=_instances(info, meta),
    )


def _argoverse_sample(
    info: Mapping[str, Any], meta: AnnotationMeta, root: Path, _: _Sizes
) -> MapSample:
    """Read one entry of an Argoverse 2 info file, in the vehicle's frame."""
    pose = pose_of(info, "e2g_")
    cameras = []
    for name, camera in info["cams"].items():
        then = pose_of(camera, "e2g_") if "e2g_translation" in camera else pose
        path = _relative(camera["img_fpath"], root)
        size = (1550, 2048) if name == "ring_front_center" else (2048, 1550)
        if (root / path).is_file():
            size = image_size(root / path, f"camera {name}")
        intrinsics = np.asarray(camera["intrinsics"], np.float64)[:3, :3]
        cam_from_frame = np.asarray(camera["extrinsics"], np.float64) @ np.linalg.inv(then) @ pose
        cameras.append(CameraRecord(name, path, *size, intrinsics, cam_from_frame))
    return MapSample(
        token=str(info["token"]),
        scene=info["log_id"],
        map_name=info["log_id"],
        timestamp_ns=in_nanoseconds(info["timestamp"], 1),
        cameras=cameras,
        global_from_frame=pose,
        lidar=LidarRecord(_relative(info["lidar_path"], root), np.eye(4)),
        instances=_instances(info, meta),
    )


def _entries(content: Any, path: Path) -> tuple[list[Mapping[str, Any]], str]:
    """Return the samples of an info file and the frame of its data set."""
    entries = content.get("samples", ()) if isinstance(content, Mapping) else content
    first = entries[0] if isinstance(entries, list) and entries else None
    if isinstance(first, Mapping) and "e2g_translation" in first and not first.keys() >= _MAPTRV2:
        missing = ", ".join(sorted(_MAPTRV2 - first.keys()))
        raise InputError(
            f"{path} is an info file of StreamMapNet or MapTracker, or of another form than "
            f"MapTRv2's: its samples lack {missing}. Convert the data set itself with "
            "tools/create_data.py nuscenes or av2."
        )
    for key, frame in (("infos", "lidar"), ("samples", "ego")):
        entries = content.get(key) if isinstance(content, Mapping) else None
        if isinstance(entries, list):
            if not entries:
                raise InputError(f"{path} holds no sample.")
            return entries, frame
    raise InputError(
        f"{path} is no info file of MapTR or MapTRv2: it holds neither a list `infos` (nuScenes) "
        "nor a list `samples` (Argoverse 2)."
    )


def _samples(
    entries: Iterable[tuple[int, Mapping[str, Any]]],
    meta: AnnotationMeta,
    infos: Path,
    root: Path,
    summary: ConversionSummary,
) -> Iterator[MapSample]:
    """Yield the samples of an info file, with ground truth where it is known."""

    @cache
    def map_of(name: str) -> NuScenesLocalMap | None:
        if not name or not expansion(root, name).is_file():
            return None
        layers = open_layers(root, name, meta.classes)
        return NuScenesLocalMap(layers, meta.classes, meta.x_range, meta.y_range)

    read = _argoverse_sample if meta.frame == "ego" else _nuscenes_sample
    size_of, needs = _Sizes(summary), _NEEDED[meta.frame]
    for number, info in entries:
        with naming(f"{infos}, sample {number}", f"a sample of such a file has {needs}"):
            sample = read(info, meta, root, size_of)
            check_samples([sample], meta)
        if sample.instances is not None:
            _check_range(sample, meta)
        elif meta.frame == "lidar" and (town := map_of(sample.map_name)) is not None:
            sample.instances = town.instances(sample.global_from_frame)
        elif meta.frame == "lidar":
            reason = f"no ground truth: maps/expansion has no map {sample.map_name!r}"
            summary.add_problem(f"{reason} (sample kept without)", sample.token)
        summary.add_sample(meta.split, sample)
        yield sample


def _check_range(sample: MapSample, meta: AnnotationMeta) -> None:
    """Raise a ``ValueError`` if ground truth lies outside the range that the file will name."""
    low, high = np.array([meta.x_range, meta.y_range]).T
    points = np.concatenate([np.empty((0, 2)), *(i.points[:, :2] for i in sample.instances or [])])
    outside = ((points < low - _BEYOND_M) | (points > high + _BEYOND_M)).any(1)
    if outside.any():
        x, y = points[outside][0]
        raise InputError(
            f"sample {sample.token!r} has a vertex at ({x:.1f}, {y:.1f}), outside x "
            f"{meta.x_range} and y {meta.y_range}: give the range that the info file was made "
            "for with --x-range and --y-range."
        )


def _dim(entries: Sequence[Mapping[str, Any]], classes: Sequence[str]) -> int:
    """Return how many coordinates the points of the first element have."""
    known = (info["annotation"] for info in entries if "annotation" in info)
    lines = (line for annotation in known for name in classes for line in annotation[name])
    return min(np.shape(next(lines, np.empty((0, 2))))[-1], 3)


def convert_infos(
    infos: Path,
    target: Path,
    data_root: Path,
    split: str,
    classes: tuple[str, ...] = CLASSES,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    command: str = "",
    shard: Shard = WHOLE,
) -> ConversionSummary:
    """Convert one info file.

    Args:
        infos: The pickle.
        target: Annotation file to write.
        data_root: Folder that image and LiDAR paths shall be relative to; maps are read from it.
        split: Name of the split.
        classes: Class names in label order.
        x_range: Smallest and largest x of the ground truth in metres; the frame's usual if None.
        y_range: Smallest and largest y of the ground truth in metres; the frame's usual if None.
        command: The command line, for messages of readers.
        shard: Which part of the samples to convert.

    Raises:
        FileNotFoundError: If the pickle does not exist.
        ValueError: If it holds more than plain data, is of no known form, or holds ground truth
            outside the range.
    """
    entries, frame = _entries(load_plain_pickle(infos), infos)
    with naming(infos, "make it anew"):
        dim = _dim(entries, classes) if frame == "ego" else 2
    meta = AnnotationMeta(
        "nuscenes" if frame == "lidar" else "av2",
        frame,
        split,
        classes,
        x_range or RANGES[frame][0],
        y_range or RANGES[frame][1],
        dim,
        digest(infos)[:16],
        options={"infos": infos.name},
        command=command,
    )
    summary = ConversionSummary(classes)
    bar = Progress(shard.part(list(enumerate(entries))), unit="samples")
    with bar as numbered, AnnotationWriter(target, meta, shard) as writer:
        for sample in _samples(numbered, meta, infos, data_root, summary):
            writer.write(sample)
    return summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py infos``."""
    add = parser.add_argument
    add("infos", type=Path, help="info file of MapTR or MapTRv2 (.pkl)")
    add("target", type=output_file, help="annotation file to write (.arrow)")
    add("--data-root", type=Path, required=True, help="folder that paths become relative to")
    add("--split", help="name of the split (default: the end of the file's name)")
    add("--classes", nargs="+", default=list(CLASSES), metavar="CLASS")
    add_range_options(parser, None)
    add_shard_options(parser)


def run(arguments: argparse.Namespace) -> str:
    """Convert as the command line asks and return the summary."""
    split = arguments.split or arguments.infos.stem.rsplit("_", 1)[-1]
    more = {"split": split, "classes": tuple(arguments.classes)}
    names = ("infos", "target", "data_root", "x_range", "y_range", "command", "shard")
    return convert_infos(**{name: getattr(arguments, name) for name in names} | more).text()
