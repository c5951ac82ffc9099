"""Records of samples whose cameras and poses come from a calibration file (docs/custom_data.md)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.record import AnnotationMeta, MapSample
from gsmap.datasets.errors import explain_errors
from gsmap.datasets.source import Mount, change_frame, ground_from_frame
from gsmap.utils.errors import InputError
from mapdata.folders.calibration_file import read_vehicle
from mapdata.folders.rig import RigCamera, RigFrame, rig_samples

_KEYS = {"name", "path", "timestamp_ns"}  # keys that a camera of a record may have
_POSE = "global_from_frame"


def calibrated_records(
    records: Sequence[Mapping[str, Any]], file: Path, meta: AnnotationMeta, root: Path
) -> Iterator[dict[str, Any]]:
    """Add the cameras and the poses of a calibration file to records, the dictionaries of samples.

    The cameras of a record have ``name`` and ``path``. A camera whose image was taken at another
    time than ``timestamp_ns`` of the record also has a ``timestamp_ns``. If the file names
    ``poses``, ``cam_from_frame`` of such a camera includes the vehicle's motion between the two
    times.

    Args:
        records: Records, as `mapdata.custom.from_records` takes them.
        file: Calibration file, YAML or JSON.
        meta: Annotation frame, and height of the road in it.
        root: Folder that image paths are relative to.

    Yields:
        Records with intrinsics, distortion, ``cam_from_frame``, ``ego_from_frame`` and, if the file
        names poses, ``global_from_frame``.

    Raises:
        FileNotFoundError: If the calibration file, or its file of poses, does not exist.
        ValueError: If the file is malformed, if a camera is not in it or has a key that the file
            defines, if a record has no pose near its time, or if a record has a pose and the file
            names poses, too.
    """
    # Images of each camera. Their size is used if the calibration file has no ``size_px``.
    images: dict[str, list[Path]] = {}
    # Time of each image, by its file name without the suffix. A file of poses may refer to images
    # by these names. If several images have one name, the time of the last image is used.
    time_of: dict[str, int] = {}
    for number, record in enumerate(records):
        # Errors in this context get the name of the record, and the advice.
        with explain_errors(f"record {_name_of(record, number)!r}", "correct it"):
            for camera in record["cameras"]:
                _require_keys(camera, file)
                images.setdefault(str(camera["name"]), []).append(root / camera["path"])
                time_of[Path(camera["path"]).stem] = _time_of(camera, record)
    rig, poses = read_vehicle(file, images=images, time_of=time_of)
    camera_of = {camera.name: camera for camera in rig}
    # Pose of the road below the vehicle at a time. Cached, since cameras often share their times.
    pose_at = None if poses is None else cache(poses.at)
    for number, record in enumerate(records):
        with explain_errors(f"record {_name_of(record, number)!r}", "correct it"):
            frame = _rig_frame(record, camera_of=camera_of, file=file)
            if pose_at is not None and record.get(_POSE) is not None:
                raise InputError(f"{_POSE} is given, and {file} has poses, too: leave out one.")
            scene = str(record.get("scene") or "")
            samples = rig_samples(scene, rig, frames=[frame], pose_at=pose_at)
            if not samples:  # `rig_samples` leaves out a frame without a pose
                raise InputError(f"{file} has no pose near timestamp_ns {frame.time_ns}.")
            sample = _in_frame(samples[0], record=record, meta=meta)
            completed = {**record, "ego_from_frame": sample.ego_from_frame}
            if pose_at is not None:
                completed[_POSE] = sample.global_from_frame
            cameras = []
            for camera in sample.cameras:
                rig_camera = camera_of[camera.name]
                entry = dict(vars(camera))  # a copy of the fields of the sample's camera
                entry["distortion"] = rig_camera.distortion
                entry["distortion_model"] = rig_camera.model
                cameras.append(entry)
            completed["cameras"] = cameras
        yield completed


def _name_of(record: Any, number: int) -> Any:
    """Return the token of a record, or its number if it has no token."""
    return record.get("token", number) if isinstance(record, Mapping) else number


def _require_keys(camera: Mapping[str, Any], file: Path) -> None:
    """Raise a ``ValueError`` if a camera has keys that the calibration file defines."""
    others = sorted(set(camera) - _KEYS)
    if others:
        raise InputError(
            f"camera {camera.get('name')!r} has {others}, which {file} defines: leave them out. "
            f"Beside a calibration file, cameras have only {sorted(_KEYS)}."
        )


def _time_of(camera: Mapping[str, Any], record: Mapping[str, Any]) -> int:
    """Return the time of a camera's image in nanoseconds."""
    time_ns = camera.get("timestamp_ns")
    if time_ns is None:
        time_ns = record.get("timestamp_ns") or 0
    return int(time_ns)


def _rig_frame(
    record: Mapping[str, Any], camera_of: Mapping[str, RigCamera], file: Path
) -> RigFrame:
    """Collect the images of a record by camera, as the input of `rig_samples`.

    Raises:
        ValueError: If the calibration file lacks a camera.
    """
    images: dict[str, tuple[str, int]] = {}
    for camera in record["cameras"]:
        name = str(camera["name"])
        if name not in camera_of:
            raise InputError(f"camera {name!r} is not in {file}, which has {sorted(camera_of)}.")
        images[name] = (str(camera["path"]), _time_of(camera, record))
    time_ns = int(record.get("timestamp_ns") or 0)
    return RigFrame(str(record["token"]), time_ns=time_ns, images=images)


def _in_frame(sample: MapSample, record: Mapping[str, Any], meta: AnnotationMeta) -> MapSample:
    """Transform a sample from the frame ``ego`` to the frame of the annotation file."""
    ground_z_m = meta.ground_z_m
    # `ego_from_frame` of a record is the mounting of the sensor that defines the annotation frame.
    # Without it, the usual mounting is assumed.
    ego_from_frame = record.get("ego_from_frame")
    if ego_from_frame is None:
        mount = Mount(meta.frame, ground_z_m=ground_z_m)
    else:
        # `ground_from_frame` reads the mounting from a sample. So the mounting is set in a copy,
        # which has no other use.
        sample_with_mount = replace(sample, ego_from_frame=np.asarray(ego_from_frame, np.float64))
        ground = ground_from_frame(sample_with_mount, meta.frame, ground_z_m=ground_z_m)
        mount = Mount(meta.frame, ground_z_m=ground_z_m, ground_from_frame=ground)
    # The given sample is in the frame "ego"; `mount` defines the annotation frame.
    return change_frame(sample, "ego", mount)
