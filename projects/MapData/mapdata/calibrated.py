"""Records whose cameras and poses stand in a calibration file (docs/custom_data.md)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.record import AnnotationMeta, MapSample
from gsmap.datasets.errors import naming
from gsmap.datasets.source import Mount, change_frame, ground_from_frame
from gsmap.utils.errors import InputError
from mapdata.folders.calibration_file import read_vehicle
from mapdata.folders.rig import RigCamera, RigFrame, rig_samples

_KEYS = {"name", "path", "timestamp_ns"}
_POSE = "global_from_frame"


def calibrated_records(
    records: Sequence[Mapping[str, Any]], file: Path, meta: AnnotationMeta, root: Path
) -> Iterator[dict[str, Any]]:
    """Complete records by the cameras and the poses of a calibration file.

    A record's cameras have ``name``, ``path`` and, where an image was taken at another time than
    the record's ``timestamp_ns``, their own ``timestamp_ns``. The vehicle's motion between the two
    times is part of ``cam_from_frame`` then, if the file names ``poses``.

    Args:
        records: The records, as `from_records` takes them.
        file: Calibration file, YAML or JSON.
        meta: Frame, and height of the road in it.
        root: Folder that image paths are relative to.

    Yields:
        Records with intrinsics, distortion, ``cam_from_frame``, ``ego_from_frame`` and, if the file
        names poses, ``global_from_frame``.

    Raises:
        ValueError: If the file is malformed, a camera is not in it, a camera has a key that the
            file defines, or a record has no pose near its time.
    """
    images: dict[str, list[Path]] = {}
    time_of: dict[str, int] = {}
    for number, record in enumerate(records):
        with naming(f"record {_name_of(record, number)!r}", "correct it"):
            for camera in record["cameras"]:
                _require_keys(camera, file)
                images.setdefault(str(camera["name"]), []).append(root / camera["path"])
                time_of[Path(camera["path"]).stem] = _time_of(camera, record)
    rig, poses = read_vehicle(file, images, time_of)
    by_name = {camera.name: camera for camera in rig}
    pose_at = None if poses is None else cache(poses.at)
    for number, record in enumerate(records):
        with naming(f"record {_name_of(record, number)!r}", "correct it"):
            frame = _rig_frame(record, by_name, file)
            given_pose = record.get(_POSE)
            if pose_at is not None and given_pose is not None:
                raise InputError(f"{_POSE} is given, and {file} has poses, too: leave out one.")
            samples = rig_samples(str(record.get("scene") or ""), rig, [frame], pose_at)
            if not samples:
                raise InputError(f"{file} has no pose near timestamp_ns {frame.time_ns}.")
            sample = _in_frame(samples[0], record, meta)
            completed = {**record, "ego_from_frame": sample.ego_from_frame}
            if pose_at is not None:
                completed[_POSE] = sample.global_from_frame
            completed["cameras"] = [
                {**vars(camera), **_distortion(by_name[camera.name])} for camera in sample.cameras
            ]
        yield completed


def _name_of(record: Any, number: int) -> Any:
    """Token of a record, or its number where it has none."""
    return record.get("token", number) if isinstance(record, Mapping) else number


def _require_keys(camera: Mapping[str, Any], file: Path) -> None:
    """Refuse keys of a camera that the calibration file defines."""
    others = sorted(set(camera) - _KEYS)
    if others:
        raise InputError(
            f"camera {camera.get('name')!r} has {others}: beside a calibration file it may have "
            f"{sorted(_KEYS)}, and the others come from {file}."
        )


def _time_of(camera: Mapping[str, Any], record: Mapping[str, Any]) -> int:
    """Time of a camera's image in nanoseconds."""
    time_ns = camera.get("timestamp_ns")
    if time_ns is None:
        time_ns = record.get("timestamp_ns") or 0
    return int(time_ns)


def _rig_frame(record: Mapping[str, Any], by_name: Mapping[str, RigCamera], file: Path) -> RigFrame:
    """Images of a record by camera; an error names cameras that the file does not have."""
    images: dict[str, tuple[str, int]] = {}
    for camera in record["cameras"]:
        name = str(camera["name"])
        if name not in by_name:
            raise InputError(f"camera {name!r} is not in {file}, which has {sorted(by_name)}.")
        images[name] = (str(camera["path"]), _time_of(camera, record))
    time_ns = int(record.get("timestamp_ns") or 0)
    return RigFrame(str(record["token"]), time_ns, images)


def _in_frame(sample: MapSample, record: Mapping[str, Any], meta: AnnotationMeta) -> MapSample:
    """Move a sample from the frame ``ego`` of Argoverse 2 to the frame of the annotation file."""
    ground_z_m = meta.ground_z_m
    mounting = record.get("ego_from_frame")
    if mounting is None:
        mount = Mount(meta.frame, ground_z_m)
    else:
        mounted = replace(sample, ego_from_frame=np.asarray(mounting, np.float64))
        mount = Mount(meta.frame, ground_z_m, ground_from_frame(mounted, meta.frame, ground_z_m))
    return change_frame(sample, "ego", mount)


def _distortion(camera: RigCamera) -> dict[str, Any]:
    """Distortion of a camera, with the keys of a record."""
    return {"distortion": camera.distortion, "distortion_model": camera.model}
