"""Conversion of py123d logs to an annotation file with pinhole cameras and the frame ``ego``.

The origin of ``ego`` is the centre of the rear axle, with x ahead, y left and z up. A record is the
dictionary of one frame from which `mapdata.custom.create_samples` makes a sample.
"""

import argparse
import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import CLASSES, RANGES
from gsmap.datasets.errors import explain_errors
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.files import file_name
from gsmap.utils.progress import Progress
from gsmap.utils.shards import add_shard_options
from mapdata.argoverse2.samples import thin_out
from mapdata.command_line import (
    FileOptions,
    add_range_options,
    fingerprint,
    options_from,
    parse_rate,
)
from mapdata.custom import create_samples
from mapdata.py123d.log import REMEDY, SYNC, Log
from mapdata.py123d.map import Map
from mapdata.summary import ConversionSummary

_GROUND_TOLERANCE_M = 0.05  # largest difference of the heights of the road in the logs of one file


@dataclass(frozen=True)
class Py123dOptions(FileOptions):
    """Options of a conversion of logs of py123d (``tools/create_data.py py123d``).

    Args:
        split: Folder of the logs below ``root/logs``, such as ``nuscenes_val``.
        data_root: Folder that the image paths in logs are relative to; None for ``root``. Images
            whose content is stored in the logs are written to files in this folder.
        rate_hz: Samples per second; None for all frames.
        logs: Names, or first characters of names, of the logs to convert; empty for all logs.
        ground_z_m: Height of the road in the frame of the rear axle, in metres; None for the bottom
            of the vehicle's box.
        x_range: Smallest and largest x (forward) of the ground truth, in metres.
        y_range: Smallest and largest y (left) of the ground truth, in metres.
    """

    _: KW_ONLY  # the fields below are keyword-only, so `split` may follow fields with defaults
    split: str
    data_root: Path | None = None
    rate_hz: float | None = 2.0
    logs: Sequence[str] = ()
    ground_z_m: float | None = None
    x_range: tuple[float, float] = RANGES["ego"][0]
    y_range: tuple[float, float] = RANGES["ego"][1]


def convert_py123d(options: Py123dOptions) -> ConversionSummary:
    """Convert logs of py123d to one annotation file.

    The file appears only once it is complete. A log that cannot be read is left out, and the
    summary names the reason.

    Args:
        options: Options of the conversion.

    Returns:
        Counts of the samples and map elements in the file, and of the problems.

    Raises:
        FileNotFoundError: If there is no such split or log.
        RuntimeError: If no sample is left (allowed for a shard). In this case, no file is written.
        ValueError: If logs differ in the height of the road, or an image is damaged.
    """
    summary = ConversionSummary(options.classes)
    logs = []
    for folder in _find_logs(options):
        try:
            log = Log(folder)
            # This access reads the table of poses, so a log without a valid table is left out here.
            log.ground_z_m  # noqa: B018
            logs.append(log)
        except (FileNotFoundError, ValueError) as error:
            summary.add_problem(f"log left out: {error}", folder.name)
    if not logs:
        raise WorkError(f"no log is left of {options.split}:\n{summary.text()}")
    data_root = options.data_root or options.root
    target = options.path_of("py123d", options.split)
    # This call converts one shard of the logs: all of them if `shard.count` is 0.
    shard_logs = options.shard.part(logs)
    meta = options.meta(
        dataset=file_name(f"py123d_{logs[0].metadata.get('dataset')}"),
        frame="ego",
        split=options.split,
        ground_z_m=_ground_z_m(logs, options.ground_z_m),
        source_fingerprint=_fingerprint(logs, options.root),
        options={"rate_hz": options.rate_hz},
    )
    with Progress(shard_logs, desc=f"py123d {options.split}", unit="logs") as progress:
        records = _all_records(progress, options, summary=summary)
        # The first record is read before the file is opened: without one, no file is written.
        first = next(records, None)
        if first is None and not options.shard.count:
            raise WorkError(f"no sample is left of {options.split}:\n{summary.text()}")
        all_records = records if first is None else itertools.chain([first], records)
        # `join`: lines of a class whose ends meet become one line.
        samples = create_samples(all_records, meta, root=data_root, join=True)
        write_annotations(target, meta, samples, shard=options.shard)
    path = options.shard.path_of(target)
    for sample in AnnotationFile(path):
        summary.add_sample(options.split, sample)
    tables: set[str] = set()
    for log in shard_logs:
        tables.update(log.unused_tables)
    if tables:
        names = ", ".join(sorted(tables))
        summary.notes.append(f"only cameras, poses and maps are read, but not the tables {names}")
    summary.notes.append(f"written to {path}")
    return summary


def _find_logs(options: Py123dOptions) -> list[Path]:
    """Find the folders of the logs of a split.

    Raises:
        FileNotFoundError: If the split has no requested log.
    """
    parent = options.root / "logs" / options.split
    folders = []
    for path in sorted(parent.glob(f"*/{SYNC}")):
        if not options.logs or path.parent.name.startswith(tuple(options.logs)):
            folders.append(path.parent)
    if not folders:
        # The table of a log is at logs/SPLIT/LOG/sync.arrow.
        splits = sorted({path.parts[-3] for path in options.root.glob(f"logs/*/*/{SYNC}")})
        known = f"; there are {', '.join(splits)}" if splits else ""
        raise FileNotFoundError(f"no log of py123d with the given names in {parent}{known}.")
    return folders


def _ground_z_m(logs: Sequence[Log], given_m: float | None) -> float:
    """Height of the road in the frame of the rear axle, which all logs must share.

    Raises:
        ValueError: If the heights of two logs differ.
    """
    if given_m is not None:
        return given_m
    first = logs[0]
    for log in logs[1:]:
        if abs(log.ground_z_m - first.ground_z_m) > _GROUND_TOLERANCE_M:
            raise InputError(
                f"the road lies {first.ground_z_m:.2f} m above the axle in {first.name} and "
                f"{log.ground_z_m:.2f} m in {log.name}: convert each vehicle alone (--logs), or "
                "give --ground-z."
            )
    return first.ground_z_m


def _fingerprint(logs: Sequence[Log], root: Path) -> str:
    """Digest of the names and sizes of the tables and maps of logs below ``root``."""
    sizes = {}
    for log in logs:
        paths = sorted(log.folder.glob("*.arrow"))
        with suppress(ValueError):  # `_all_records` leaves out this log, with the reason
            path = log.map_file(root)  # None for a log without a map
            if path is not None and path.is_file():
                paths.append(path)
        for path in paths:
            sizes[f"{log.name}/{path.name}"] = path.stat().st_size
    return fingerprint(sizes)


def _all_records(
    logs: Progress, options: Py123dOptions, summary: ConversionSummary
) -> Iterator[dict[str, Any]]:
    """Yield the records of all logs; a log that cannot be read is left out."""
    # Only the latest map is kept, because the logs of a town are consecutive.
    maps: dict[Path, Map] = {}
    for log in logs:
        try:
            path = log.map_file(options.root)
            if path is not None and path not in maps:  # None for a log without a map
                if not path.is_file():
                    raise FileNotFoundError(f"no map at {path}: {REMEDY}.")
                maps = {path: Map(path, options.classes)}
                if maps[path].left_out:
                    reason = "map element without a valid geometry left out"
                    summary.add_problem(reason, path.name, count=maps[path].left_out)
            for name, reason in log.unused_cameras.items():
                summary.add_problem(f"camera left out: {reason}", f"{name} of {log.name}")
            records = _records(log, maps.get(path) if path else None, options, summary=summary)
            yield from records
        except (FileNotFoundError, ValueError) as error:
            summary.add_problem(f"log left out: {error}", log.name)


def _records(
    log: Log, log_map: Map | None, options: Py123dOptions, summary: ConversionSummary
) -> Iterator[dict[str, Any]]:
    """Yield the records of a log; frames that cannot be used are counted and left out.

    Raises:
        ValueError: If the log has no usable camera, or one of its tables is damaged.
    """
    # For each time in nanoseconds, the row of the image in the table of each camera.
    frames = {}
    for time_ns, rows in log.frames():  # the row is None for a camera without an image
        if not rows:
            raise InputError("it has no camera that can be used")
        known_rows = {name: row for name, row in rows.items() if row is not None}
        missing = sorted(rows.keys() - known_rows)
        if missing:
            reason = f"frame left out: no image of {missing[0]}"
            summary.add_problem(reason, f"{log.name}_{time_ns // 1000}")
        else:
            frames[time_ns] = known_rows
    # Elements are taken as far from the vehicle as the farthest corner of the range, so that the
    # range is covered at any yaw. `create_samples` clips them to the range.
    largest_x_m, largest_y_m = np.abs([options.x_range, options.y_range]).max(axis=1)
    radius_m = float(np.hypot(largest_x_m, largest_y_m))
    root = options.data_root or options.root
    for time_ns in thin_out(np.array(sorted(frames), np.int64), options.rate_hz).tolist():
        token = f"{log.name}_{time_ns // 1000}"
        global_from_imu = log.track.at(time_ns)  # None if no pose is near this time
        if global_from_imu is None:
            summary.add_problem("frame left out: no pose near its time", token)
            continue
        pose = global_from_imu @ log.imu_from_axle
        try:
            cameras = _cameras(log, rows=frames[time_ns], global_from_axle=pose, root=root)
        except ValueError as error:
            summary.add_problem(f"frame left out: {error}", token)
            continue
        record = {
            "token": token,
            "scene": log.name,
            "map_name": log.location,
            "timestamp_ns": time_ns,
            "global_from_frame": pose,
            "cameras": cameras,
        }
        if log_map is not None:
            record["global_instances"] = log_map.around(pose[:2, 3], radius_m=radius_m)
        yield record


def _cameras(
    log: Log, rows: Mapping[str, int], global_from_axle: np.ndarray, root: Path
) -> list[dict[str, Any]]:
    """List the cameras of a frame in the form that `mapdata.custom.from_records` reads.

    The transforms to the cameras include the motion of the vehicle between the time of the frame
    and the time of each image.

    Args:
        log: The log.
        rows: Row of the image in the camera's table, by the name of the camera.
        global_from_axle: Pose of the frame ``ego`` at the time of the frame. (4, 4)
        root: Data root of the images.

    Raises:
        ValueError: If an image, a pose or a calibration cannot be used.
    """
    cameras = []
    for camera in log.cameras:
        row = rows[camera.name]
        with explain_errors(f"camera {camera.name!r}", REMEDY):
            global_from_camera = camera.global_from_camera(row, track=log.track)
            record = camera.calibration  # a new dictionary at each access
            record["path"] = camera.image_path(row, root=root, scene=log.name)
            record["cam_from_frame"] = invert_rigid(global_from_camera) @ global_from_axle
        cameras.append(record)
    return cameras


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py py123d`` to a parser."""
    add = parser.add_argument
    add("--root", type=Path, required=True, help="folder of py123d with logs and maps")
    add("--split", required=True, help="folder below logs, such as nuscenes_val")
    add("--data-root", type=Path, help="folder of the images that logs name (default: --root)")
    add("--logs", nargs="+", default=(), metavar="LOG", help="only logs that begin with LOG")
    add(
        "--rate", type=parse_rate, default=2.0, dest="rate_hz", metavar="RATE",
        help="samples per second, such as 2hz, or all (default: 2hz)",
    )  # fmt: skip
    add(
        "--ground-z", type=float, dest="ground_z_m", metavar="M",
        help="height of the road above the rear axle (default: bottom of the vehicle's box)",
    )  # fmt: skip
    add("--centerline", action="store_true", help="add the class centerline")
    add("--out-dir", type=Path, help="folder of the annotation file (default: the data root)")
    add("--tag", default="", help="suffix of the file's name, such as _extended")
    add_range_options(parser, RANGES["ego"])
    add_shard_options(parser)


def run(arguments: argparse.Namespace) -> str:
    """Convert with the options of a command line and return the summary as text."""
    classes: tuple[str, ...] = CLASSES
    if arguments.centerline:
        classes = (*CLASSES, "centerline")
    options = options_from(Py123dOptions, arguments, classes=classes)
    return convert_py123d(options).text()
