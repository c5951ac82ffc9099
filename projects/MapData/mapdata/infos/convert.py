"""Conversion of the info pickles of MapTR and MapTRv2 to annotation files.

MapTR's ``nuscenes_infos_temporal_*.pkl`` contain sensors and poses; their ground truth is made from
the map expansion. MapTRv2's ``nuscenes_map_infos_temporal_*.pkl`` and ``av2_map_infos_*.pkl`` also
contain the ground truth. No code from the pickles is run.

An entry of an info file is a dictionary of one sample. The annotation frame, in which the ground
truth is given, is the frame of the LiDAR for nuScenes, and the frame of the vehicle (ego) for
Argoverse 2. A transform ``b_from_a`` converts coordinates in frame a to frame b.
"""

import argparse
from collections import Counter
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
from gsmap.datasets.errors import explain_errors
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

NUSCENES_SIZE = (1600, 900)  # width and height of the images in pixels
_RING_SIZE = (2048, 1550)  # width and height of the images of Argoverse 2's ring cameras in pixels
_RING_FRONT_SIZE = (1550, 2048)  # for the front camera, which is mounted upright
# Fields that a sample must have, by annotation frame, for messages.
_NEEDED = {
    "lidar": "token, timestamp, lidar_path, lidar2ego_* and ego2global_* (translation, rotation), "
    "and cams with data_path, cam_intrinsic and sensor2lidar_*",
    "ego": "token, log_id, timestamp, lidar_path, e2g_* (translation, rotation), and cams with "
    "img_fpath, intrinsics and extrinsics",
}
_MAPTRV2 = {"timestamp", "log_id", "lidar_path"}  # fields of MapTRv2's samples of Argoverse 2
# Tolerance of the range in metres. Roll and pitch of the vehicle move points at the limits of the
# range by centimetres after they were clipped.
_BEYOND_M = 1.0


def _relative(path: str, root: Path) -> str:
    """Convert a path in an info file to a path relative to the data root.

    The info file may be from another computer, with another data root. If the file exists below the
    data root, its path there is returned. Otherwise the result begins at a folder that is usual in
    the data sets.

    Raises:
        ValueError: If no relative path can be found.
    """
    # The longest end of the path that is a file below the data root, or None
    existing = find_file(path, root)
    if existing is not None:
        return existing.as_posix()
    posix_path = Path(path.replace("\\", "/"))
    parts = posix_path.parts
    for anchor in ("samples", "sweeps", "train", "val", "test"):
        if anchor in parts:  # keep the parts from its last occurrence on
            # Tuples have no search from the end, so the reversed parts are searched.
            last_anchor = len(parts) - 1 - parts[::-1].index(anchor)
            parts = parts[last_anchor:]
            break
    relative_path = Path(*parts)
    if not relative_path.is_absolute() and ".." not in parts:
        return relative_path.as_posix()
    raise InputError(f"path {path!r} does not lie under {root}: give the right --data-root.")


def _instances(info: Mapping[str, Any], meta: AnnotationMeta) -> list[MapInstance] | None:
    """Ground truth of an entry of an info file; None if the entry has none.

    Lines of one point are left out. Further coordinates than the dimension of the annotation file
    are left out as well.
    """
    annotation = info.get("annotation")
    if annotation is None:
        return None
    elements = []
    for label, name in enumerate(meta.classes):
        for points in annotation[name]:
            if len(points) >= 2:
                vertices = np.asarray(points, np.float64)[:, : meta.dim]
                elements.append(MapInstance(label, vertices))
    return elements


class _ImageSizes:
    """Image sizes of an info file, read once per scene and camera.

    Args:
        summary: Summary that counts missing images. The usual size of the data set is assumed for
            them.
    """

    def __init__(self, summary: ConversionSummary) -> None:
        self._summary = summary
        self._sizes: dict[tuple[str, str], tuple[int, int]] = {}

    def __call__(
        self, scene: str, camera: str, file: Path, usual: tuple[int, int]
    ) -> tuple[int, int]:
        """Look up or read the size of a camera's images.

        Args:
            scene: Token of the scene.
            camera: Name of the camera.
            file: Image of the camera in this scene.
            usual: Usual width and height of the camera's images in pixels.

        Returns:
            Width and height in pixels.

        Raises:
            ValueError: If the file is not an image, or has too many pixels.
        """
        if (scene, camera) in self._sizes:
            return self._sizes[scene, camera]
        if not file.is_file():
            width, height = usual
            reason = f"image not there (assumed to have {width} x {height} pixels)"
            self._summary.add_problem(f"{camera}: {reason}", str(file))
            return usual  # not stored, as the next image of the camera may exist
        size = image_size(file, f"camera {camera}")
        self._sizes[scene, camera] = size
        return size


def _nuscenes_sample(
    info: Mapping[str, Any], meta: AnnotationMeta, root: Path, image_sizes: _ImageSizes
) -> MapSample:
    """Make a sample in the LIDAR_TOP frame from an entry of a nuScenes info file."""
    # `pose_of` makes a matrix (4, 4) from the entries ``<prefix>translation`` and
    # ``<prefix>rotation``.
    ego_from_frame = pose_of(info, "lidar2ego_")
    global_from_ego = pose_of(info, "ego2global_")
    scene = str(info.get("scene_token", ""))
    cameras = []
    for name, camera in info["cams"].items():
        path = _relative(camera["data_path"], root)
        intrinsics = np.asarray(camera["cam_intrinsic"], np.float64)[:3, :3]
        cam_from_frame = np.linalg.inv(pose_of(camera, "sensor2lidar_"))
        width, height = image_sizes(scene, name, file=root / path, usual=NUSCENES_SIZE)
        record = CameraRecord(
            name=name,
            path=path,
            width=width,
            height=height,
            intrinsics=intrinsics,
            cam_from_frame=cam_from_frame,
        )
        cameras.append(record)
    sweeps = []
    for sweep in info.get("sweeps", []):
        sweep_record = SweepRecord(
            path=_relative(sweep["data_path"], root),
            # nuScenes has times in microseconds.
            timestamp_ns=in_nanoseconds(sweep["timestamp"], usual_unit_ns=1000),
            frame_from_lidar=pose_of(sweep, "sensor2lidar_"),
        )
        sweeps.append(sweep_record)
    can_bus = info.get("can_bus")
    if can_bus is not None:
        # The signals are position (3), quaternion (4), measurements (9) and yaw (2). Only the
        # measurements are taken from the file. The others are computed from the pose of the
        # vehicle, as MapTR does when it loads the file.
        measurements = np.asarray(can_bus, np.float64)[7:16]
        can_bus = pose_signals(global_from_ego)
        quaternion = np.asarray(info["ego2global_rotation"], np.float64)
        if quaternion.shape == (4,):  # otherwise a matrix; the file's quaternion keeps its sign
            can_bus[3:7] = quaternion
        can_bus[7 : 7 + len(measurements)] = measurements
    return MapSample(
        token=info["token"],
        scene=info.get("scene_token", ""),
        map_name=info.get("map_location", ""),
        timestamp_ns=in_nanoseconds(info["timestamp"], usual_unit_ns=1000),
        cameras=cameras,
        global_from_frame=global_from_ego @ ego_from_frame,
        ego_from_frame=ego_from_frame,
        # The frame of the LiDAR is the annotation frame, hence the identity.
        lidar=LidarRecord(_relative(info["lidar_path"], root), np.eye(4), sweeps=sweeps),
        can_bus=can_bus,
        instances=_instances(info, meta),
    )


def _argoverse_sample(
    info: Mapping[str, Any], meta: AnnotationMeta, root: Path, image_sizes: _ImageSizes
) -> MapSample:
    """Make a sample in the ego frame from an entry of an Argoverse 2 info file."""
    global_from_ego = pose_of(info, "e2g_")
    cameras = []
    for name, camera in info["cams"].items():
        # The vehicle moves between the time of the sample and the time of the image. Without a pose
        # at the time of the image, the pose of the sample is taken.
        global_from_ego_at_image = global_from_ego
        if "e2g_translation" in camera:
            global_from_ego_at_image = pose_of(camera, "e2g_")
        path = _relative(camera["img_fpath"], root)
        usual = _RING_FRONT_SIZE if name == "ring_front_center" else _RING_SIZE
        width, height = image_sizes(info["log_id"], name, file=root / path, usual=usual)
        intrinsics = np.asarray(camera["intrinsics"], np.float64)[:3, :3]
        cam_from_ego = np.asarray(camera["extrinsics"], np.float64)
        ego_at_image_from_global = np.linalg.inv(global_from_ego_at_image)
        record = CameraRecord(
            name=name,
            path=path,
            width=width,
            height=height,
            intrinsics=intrinsics,
            # From the vehicle at the sample, through the global frame, to the vehicle at the image.
            cam_from_frame=cam_from_ego @ ego_at_image_from_global @ global_from_ego,
        )
        cameras.append(record)
    return MapSample(
        token=str(info["token"]),
        scene=info["log_id"],
        map_name=info["log_id"],
        timestamp_ns=in_nanoseconds(info["timestamp"], usual_unit_ns=1),
        cameras=cameras,
        global_from_frame=global_from_ego,
        # Sweeps of Argoverse 2 are given in the frame of the vehicle, hence the identity.
        lidar=LidarRecord(_relative(info["lidar_path"], root), np.eye(4)),
        instances=_instances(info, meta),
    )


def _entries(content: Any, path: Path) -> tuple[list[Mapping[str, Any]], str]:
    """List the entries of an info file.

    Args:
        content: Content of the pickle.
        path: Path of the info file, for messages.

    Returns:
        The entries, and the annotation frame: ``lidar`` (nuScenes) or ``ego`` (Argoverse 2).

    Raises:
        ValueError: If the content has another form, or no entry.
    """
    # Samples of StreamMapNet and MapTracker also have the key ``e2g_translation``, but lack other
    # keys of MapTRv2. They are listed under ``samples``, or the whole content is the list.
    entries = content.get("samples", ()) if isinstance(content, Mapping) else content
    first = entries[0] if isinstance(entries, list) and entries else None
    # ``>=`` between sets of keys: whether the sample has all keys of MapTRv2
    if isinstance(first, Mapping) and "e2g_translation" in first and not first.keys() >= _MAPTRV2:
        missing = ", ".join(sorted(_MAPTRV2 - first.keys()))
        raise InputError(
            f"{path} is an info file of StreamMapNet or MapTracker, or its format is not the one "
            f"of MapTRv2: its samples lack {missing}. Convert the data set itself with "
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
    """Yield the samples of an info file.

    Ground truth is read from the info file. If the file has none, the ground truth of nuScenes is
    extracted from the map expansion, and samples of Argoverse 2 remain without ground truth.

    Args:
        entries: Entries of the info file with their position in it.
        meta: Metadata of the annotation file.
        infos: Path of the info file, for messages.
        root: Data root.
        summary: Summary that counts the samples and problems.

    Raises:
        ValueError: If an entry lacks a field or has a wrong value, or ground truth lies outside of
            the range.
    """

    @cache  # each map is read once
    def open_map(name: str) -> NuScenesLocalMap | None:
        if not name or not expansion(root, name).is_file():
            return None
        layers = open_layers(root, name, classes=meta.classes)
        for reason, count in layers.skipped.items():
            summary.add_problem(f"{reason} left out", name, count=count)
        return NuScenesLocalMap(layers, meta.classes, x_range=meta.x_range, y_range=meta.y_range)

    image_sizes = _ImageSizes(summary)
    remedy = f"a sample of such a file has {_NEEDED[meta.frame]}"
    for number, info in entries:
        # Errors about the content of the entry get its position and the remedy.
        with explain_errors(f"{infos}, sample {number}", remedy):
            if meta.frame == "ego":
                sample = _argoverse_sample(info, meta, root=root, image_sizes=image_sizes)
            else:
                sample = _nuscenes_sample(info, meta, root=root, image_sizes=image_sizes)
            check_samples([sample], meta)
            numbers = _numbers_left_out(info, meta)
        # Ground truth from a map is clipped to the range, so only ground truth of the file is
        # checked.
        if sample.instances is not None:
            for reason, number in numbers.items():
                summary.add_problem(reason, sample.token, count=number)
            _check_range(sample, meta)
        elif meta.frame == "lidar":
            local_map = open_map(sample.map_name)
            if local_map is not None:
                sample.instances = local_map.instances(sample.global_from_frame)
            else:
                reason = f"no ground truth: maps/expansion has no map {sample.map_name!r}"
                summary.add_problem(f"{reason} (sample kept without it)", sample.token)
        else:
            reason = "no ground truth in the info file (sample kept without it)"
            summary.add_problem(reason, sample.token)
        summary.add_sample(meta.split, sample)
        yield sample


def _numbers_left_out(info: Mapping[str, Any], meta: AnnotationMeta) -> Counter[str]:
    """Count the lines and heights of an entry that its sample lacks, by reason."""
    numbers: Counter[str] = Counter()
    for name, lines in (info.get("annotation") or {}).items():
        if name not in meta.classes:
            numbers[f"class {name!r:.80} left out, which --classes does not list"] = len(lines)
            continue
        for points in lines:
            if len(points) < 2:
                numbers["line of fewer than two points left out"] += 1
            elif np.shape(points)[-1] > meta.dim:
                numbers[f"line of {np.shape(points)[-1]} coordinates cut to {meta.dim}"] += 1
    return +numbers  # without reasons that hold for no line


def _check_range(sample: MapSample, meta: AnnotationMeta) -> None:
    """Raise a ``ValueError`` if ground truth lies outside the range of the annotation file."""
    low, high = np.array([meta.x_range, meta.y_range]).T  # (x, y) each
    lines = [np.empty((0, 2))]  # an array to concatenate even if there is no instance
    for instance in sample.instances or []:
        lines.append(instance.points[:, :2])
    points = np.concatenate(lines)
    is_outside = ((points < low - _BEYOND_M) | (points > high + _BEYOND_M)).any(axis=1)
    if is_outside.any():
        x, y = points[is_outside][0]
        raise InputError(
            f"sample {sample.token!r} has a vertex at ({x:.1f}, {y:.1f}), outside x "
            f"{meta.x_range} and y {meta.y_range}: give the range that the info file was made "
            "for with --x-range and --y-range."
        )


def _dim(entries: Sequence[Mapping[str, Any]], classes: Sequence[str]) -> int:
    """Number of coordinates per point of the first map element, at most 3; 2 without elements.

    All elements of a file are assumed to have equal numbers of coordinates. Lines of fewer than two
    points do not count, since they are left out.
    """
    for info in entries:
        annotation = info.get("annotation")
        if annotation is None:
            continue
        for name in classes:
            for points in annotation[name]:
                if len(points) >= 2:
                    return min(np.shape(points)[-1], 3)
    return 2


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
    """Convert one info file to an annotation file.

    Args:
        infos: Info file (pickle).
        target: Annotation file to write.
        data_root: Folder that image and LiDAR paths become relative to. The map expansion is read
            from it.
        split: Name of the split.
        classes: Class names in label order.
        x_range: Smallest and largest x of the ground truth in metres in the annotation frame; None
            for the usual range of the frame.
        y_range: Smallest and largest y of the ground truth in metres in the annotation frame; None
            for the usual range of the frame.
        command: Command line that creates the file. It is stored in the file, for messages of
            programs that read the file.
        shard: Part of the samples to convert.

    Returns:
        Counts of the samples and map elements in the file, and of the problems.

    Raises:
        FileNotFoundError: If the info file is missing.
        ValueError: If the info file contains more than plain data, has an unknown form, or has
            ground truth outside the range.
    """
    entries, frame = _entries(load_plain_pickle(infos), infos)
    with explain_errors(infos, "make it again"):
        # Ground truth of nuScenes is two-dimensional.
        dim = _dim(entries, classes) if frame == "ego" else 2
    usual_x_range, usual_y_range = RANGES[frame]
    meta = AnnotationMeta(
        dataset="nuscenes" if frame == "lidar" else "av2",
        frame=frame,
        split=split,
        classes=classes,
        x_range=x_range or usual_x_range,
        y_range=y_range or usual_y_range,
        dim=dim,
        source_fingerprint=digest(infos)[:16],
        options={"infos": infos.name},
        command=command,
    )
    summary = ConversionSummary(classes)
    progress = Progress(shard.part(list(enumerate(entries))), unit="samples")
    with progress as numbered, AnnotationWriter(target, meta, shard=shard) as writer:
        for sample in _samples(numbered, meta, infos=infos, root=data_root, summary=summary):
            writer.write(sample)
    return summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py infos`` to a parser."""
    add = parser.add_argument
    add("infos", type=Path, help="info file of MapTR or MapTRv2 (.pkl)")
    add("target", type=output_file, help="annotation file to write (.arrow)")
    add("--data-root", type=Path, required=True, help="folder that paths become relative to")
    add("--split", help="name of the split (default: the end of the file's name)")
    add("--classes", nargs="+", default=list(CLASSES), metavar="CLASS")
    add_range_options(parser, None)
    add_shard_options(parser)


def run(arguments: argparse.Namespace) -> str:
    """Convert with the options of a command line and return the summary as text."""
    # The name of an info file ends with the split, as in nuscenes_infos_temporal_val.pkl.
    split = arguments.split or arguments.infos.stem.rsplit("_", 1)[-1]
    summary = convert_infos(
        arguments.infos,
        arguments.target,
        data_root=arguments.data_root,
        split=split,
        classes=tuple(arguments.classes),
        x_range=arguments.x_range,
        y_range=arguments.y_range,
        command=arguments.command,
        shard=arguments.shard,
    )
    return summary.text()
