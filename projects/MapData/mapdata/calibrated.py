"""Records of samples whose cameras and poses come from a calibration file (docs/custom_data.md).

The rig is the set of cameras on a vehicle. The calibration file describes it.
"""

import logging
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
from gsmap.utils.shards import WHOLE, Shard, digest
from mapdata.folders.calibration_file import read_calibration, read_vehicle
from mapdata.folders.rig import RigCamera, RigFrame, motion_notes, rig_samples
from mapdata.paths import path_below

_LOGGER = logging.getLogger(__name__)
_KEYS = {"name", "path", "timestamp_ns"}  # keys that a camera of a record may have
_POSE = "global_from_frame"


def calibrated_records(
    records: Sequence[Mapping[str, Any]],
    file: Path,
    meta: AnnotationMeta,
    root: Path,
    shard: Shard = WHOLE,
) -> Iterator[dict[str, Any]]:
    """Add the cameras and the poses of a calibration file to records, the dictionaries of samples.

    The cameras of a record have ``name`` and ``path``. A camera has a ``timestamp_ns`` if its image
    was taken at another time than the ``timestamp_ns`` of the record. If the calibration file names
    a file of ``poses``, ``cam_from_frame`` of such a camera includes the vehicle's motion between
    the two times. A warning counts the images without a pose, for which the motion is neglected.

    Args:
        records: Records, as `mapdata.custom.from_records` takes them.
        file: Calibration file, YAML or JSON.
        meta: Metadata of the annotation file, with the annotation frame and the height of the road
            in it.
        root: Folder that image paths are relative to.
        shard: Part of the records to yield. The cameras and the poses are those of all records, so
            that all shards have the same ones.

    Yields:
        Records with intrinsics, distortion, ``cam_from_frame``, ``ego_from_frame`` and, if the file
        names poses, ``global_from_frame``.

    Raises:
        FileNotFoundError: If the calibration file, or its file of poses, does not exist.
        ValueError: If the file is malformed, if a camera is not in it or has a key that the file
            defines, if a record has no pose near its time, or if a record has a pose and the file
            names poses, too. Also if a record in the frame ``ego`` has a mounting.
    """
    # Images of each camera. Their size is used if the calibration file has no ``size_px``.
    images: dict[str, list[Path]] = {}
    # Time of each image, by its file name without the suffix. A file of poses may refer to images
    # by these names. None: images of different times have this name.
    image_times: dict[str, int | None] = {}
    for number, record in enumerate(records):
        # Errors in this context get the name of the record, and the advice.
        with explain_errors(f"record {_name_of(record, number)!r}", "correct it"):
            for camera in record["cameras"]:
                _require_keys(camera, file)
                images.setdefault(str(camera["name"]), []).append(root / camera["path"])
                stem = Path(camera["path"]).stem
                time_ns = _image_time_ns(camera, record)
                unique = image_times.setdefault(stem, time_ns) == time_ns
                image_times[stem] = time_ns if unique else None
    # The cameras that have images, and the poses of the road below the vehicle. Without a file of
    # poses, `poses` is None.
    rig, poses = read_vehicle(file, images=images, time_of=image_times)
    camera_of = {camera.name: camera for camera in rig}
    # Function from a time in nanoseconds to the pose of the vehicle: the transform to the global
    # frame from the frame on the road below the vehicle. It returns None if no pose is near the
    # time. Cached, since cameras often share their times.
    pose_at = None if poses is None else cache(poses.at)
    rig_frames = []
    for number, record in shard.part(list(enumerate(records))):
        with explain_errors(f"record {_name_of(record, number)!r}", "correct it"):
            rig_frame = _rig_frame(record, camera_of=camera_of, file=file)
            if pose_at is not None and record.get(_POSE) is not None:
                raise InputError(f"{_POSE} is given, and {file} has poses, too: leave out one.")
            if pose_at is not None and record.get("timestamp_ns") is None:
                raise InputError(f"{file} names poses: give timestamp_ns.")
            scene = str(record.get("scene") or "")
            samples = rig_samples(scene, rig, frames=[rig_frame], pose_at=pose_at)
            if not samples:  # `rig_samples` leaves out a `RigFrame` without a pose
                raise InputError(f"{file} has no pose near timestamp_ns {rig_frame.time_ns}.")
            rig_frames.append(rig_frame)
            # `rig_samples` returns samples in the frame `ego`.
            sample = _in_frame(samples[0], record=record, meta=meta)
            completed = {**record, "ego_from_frame": sample.ego_from_frame}
            if pose_at is not None:
                completed[_POSE] = sample.global_from_frame
            cameras = []
            for camera in sample.cameras:
                rig_camera = camera_of[camera.name]
                # The fields of the sample's camera, to which the distortion is added. They are
                # copied, so that the camera does not change.
                entry = dict(vars(camera))
                entry["distortion"] = rig_camera.distortion
                entry["distortion_model"] = rig_camera.model
                cameras.append(entry)
            completed["cameras"] = cameras
        yield completed
    for note in motion_notes(rig_frames, pose_at=pose_at):
        _LOGGER.warning(note)


def digest_of_calibration(file: Path) -> str:
    """Digest of the content of a calibration file, and of the file of poses that it names.

    A missing file does not count, because `calibrated_records` raises an error for it.

    Raises:
        ValueError: If the calibration file is malformed.
    """
    if not file.is_file():
        return ""
    content = digest(file)
    with explain_errors(file, remedy="see docs/inference.md"):
        poses = read_calibration(file).get("poses")
        if poses:
            path = path_below(file.parent, str(poses), noun="poses")
            content += digest(path) if path.is_file() else ""
    return content


def _name_of(record: Any, number: int) -> Any:
    """Return the token of a record, or its number if it has no token."""
    return record.get("token", number) if isinstance(record, Mapping) else number


def _require_keys(camera: Mapping[str, Any], file: Path) -> None:
    """Raise a ``ValueError`` if a camera has keys that the calibration file defines."""
    other_keys = sorted(set(camera) - _KEYS)
    if other_keys:
        raise InputError(
            f"camera {camera.get('name')!r} has {other_keys}, which {file} defines: leave them "
            f"out. Beside a calibration file, cameras have only {sorted(_KEYS)}."
        )


def _image_time_ns(camera: Mapping[str, Any], record: Mapping[str, Any]) -> int:
    """Return the time of a camera's image in nanoseconds; 0 if no time is given."""
    time_ns = camera.get("timestamp_ns")
    if time_ns is None:
        time_ns = record.get("timestamp_ns") or 0
    return int(time_ns)


def _rig_frame(
    record: Mapping[str, Any], camera_of: Mapping[str, RigCamera], file: Path
) -> RigFrame:
    """Collect the images of a record by camera, as the input of `rig_samples`.

    Args:
        record: Record of a sample.
        camera_of: Cameras of the calibration file by name.
        file: Calibration file, for the error.

    Returns:
        Token and time of the record, and the path and time in nanoseconds of each camera's image.

    Raises:
        ValueError: If the calibration file lacks a camera, or the record has a camera twice.
    """
    images: dict[str, tuple[str, int]] = {}
    for camera in record["cameras"]:
        name = str(camera["name"])
        if name not in camera_of:
            raise InputError(f"camera {name!r} is not in {file}, which has {sorted(camera_of)}.")
        if name in images:
            raise InputError(f"camera {name!r} appears twice.")
        images[name] = (str(camera["path"]), _image_time_ns(camera, record))
    time_ns = int(record.get("timestamp_ns") or 0)
    return RigFrame(str(record["token"]), time_ns=time_ns, images=images)


def _in_frame(sample: MapSample, record: Mapping[str, Any], meta: AnnotationMeta) -> MapSample:
    """Transform a sample from the frame ``ego`` to the annotation frame.

    Args:
        sample: Sample of `rig_samples`.
        record: Record of the sample, with ``ego_from_frame`` (4, 4) if the mounting is known.
        meta: Annotation frame, and height of the road in it.
    """
    ground_z_m = meta.ground_z_m
    # `ego_from_frame` of a record is the mounting of the sensor that defines the annotation frame.
    # Without it, the usual mounting is assumed.
    ego_from_frame = record.get("ego_from_frame")
    if ego_from_frame is None:
        mount = Mount(meta.frame, ground_z_m=ground_z_m)
    else:
        if meta.frame == "ego" and not np.allclose(ego_from_frame, np.eye(4), atol=1e-4):
            raise InputError(
                "ego_from_frame is the mounting of the frame 'lidar': leave it out in the frame "
                "'ego', which is the vehicle."
            )
        # `ground_from_frame` takes a sample, of which it uses only the mounting. So the mounting of
        # the record is set in a copy of the sample.
        sample_with_mount = replace(sample, ego_from_frame=np.asarray(ego_from_frame, np.float64))
        ground = ground_from_frame(sample_with_mount, meta.frame, ground_z_m=ground_z_m)
        mount = Mount(meta.frame, ground_z_m=ground_z_m, ground_from_frame=ground)
    # The given sample is in the frame "ego"; `mount` defines the annotation frame.
    return change_frame(sample, "ego", mount)
