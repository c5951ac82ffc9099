"""Annotation files of your own data, from plain records: any cameras, ground truth or not."""

import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely

from gsmap.datasets.annotations.file import check_samples, write_annotations
from gsmap.datasets.annotations.record import (
    AnnotationMeta,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
)
from gsmap.datasets.errors import naming
from gsmap.datasets.image_files import image_size, read_image
from gsmap.structures.frames import frame_view
from gsmap.structures.polylines import Points, clip_to_box, is_closed
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name
from gsmap.utils.shards import WHOLE, Shard
from mapdata.calibrated import calibrated_records
from mapdata.folders.rig import RigCamera
from mapdata.local_map import POLYGON, vertices_of

_LOGGER = logging.getLogger(__name__)
_UNMOUNTED = (
    "record %r has no ego_from_frame: pictures will take the road to be level, %.2f m below the "
    "sensor (ground_z_m; nuScenes' height by default), and models that lift images (LSS) "
    "cannot use it."
)
_UNKNOWN_ROAD = (
    "%s does not say how high the road is in the frame 'ego': pictures and inference will take it "
    "to be 0.31 m below the origin (Argoverse 2's axle); AnnotationMeta(ground_z_m=...) says it."
)
_LOST = (
    "%d of %d records lose all of their elements (the first is %r), as none lies in x_range and "
    "y_range: points must be in metres of the frame, not of the world, and not in millimetres."
)
_MEETING_M = 0.1  # ends of lines that are so near are one place
_GLOBAL = "global_instances"
_KEYS = sorted([*(field.name for field in fields(MapSample)), _GLOBAL])
Record = TypeVar("Record")


def from_records(
    path: str | Path,
    records: Iterable[Mapping[str, Any]],
    meta: AnnotationMeta,
    data_root: str | Path,
    shard: Shard = WHOLE,
    join: bool = False,
    calibration: str | Path | None = None,
) -> int:
    """Write an annotation file from plain records.

    A record is a mapping. All but the first two keys may be left out:

    - ``token``: unique name;
    - ``cameras``: mappings with ``name``, ``path`` (relative to ``data_root``), ``intrinsics``
      (3, 3) in pixels, ``cam_from_frame`` (4, 4), and, unless the image is to be asked, ``width``
      and ``height``. With ``distortion`` (OpenCV's coefficients, and ``distortion_model`` as in
      docs/inference.md) the image is rectified into ``rectified/`` of the data root;
    - ``instances`` (absent: no ground truth is known): mappings with ``label`` (name or index) and
      ``points`` (n, 2 or 3) in metres, a ring's last equal to its first. What lies outside the
      range of ``meta`` is cut off; rings stay rings;
    - ``global_instances``: instead, the same in the global frame, such as a whole map. Position and
      yaw of ``global_from_frame`` place them, or with heights all of it;
    - ``lidar``: mapping with ``path``, ``frame_from_lidar`` (4, 4) and ``sweeps``, mappings with
      ``path``, ``timestamp_ns``, ``frame_from_lidar``;
    - ``ego_from_frame`` (4, 4): where the frame ``lidar`` stands on the vehicle, whose z = 0 is the
      road; absent: not known, and one warning says what that means;
    - ``scene``, ``map_name``, ``timestamp_ns``, ``global_from_frame``, ``can_bus``.

    Args:
        path: Annotation file to write.
        records: The records.
        meta: Frame, classes and range of the data.
        data_root: Folder that image and LiDAR paths are relative to.
        shard: Which part of the records to take, such as ``Shard.parse("3/16")``.
        join: Join lines of a class whose ends meet, for maps that come in pieces (`join_lines`).
        calibration: Calibration file of the vehicle as `infer` reads it beside a folder of images.
            It defines intrinsics, distortion, place and, if it names ``poses``,
            ``global_from_frame`` at the record's ``timestamp_ns``. Cameras of records have ``name``
            and ``path`` then, and ``timestamp_ns`` where that of the image differs.

    Returns:
        How many samples were written.

    Raises:
        FileNotFoundError: If an image is missing whose size is not given, or there is no such
            calibration file.
        ValueError: If a record or the calibration file is malformed; the message names the token or
            that file. No annotation file is left then.
    """
    if meta.frame == "ego" and meta.ground_z_m is None:
        _LOGGER.warning(_UNKNOWN_ROAD, path)
    source = ""
    if shard.count:
        records = list(records)
        tokens = "\n".join(str(r.get("token") if isinstance(r, Mapping) else r) for r in records)
        source = hashlib.sha256(tokens.encode()).hexdigest()
        records = shard.part(records)
    if calibration is not None:
        records = calibrated_records(list(records), Path(calibration), meta, Path(data_root))
    samples = _samples(records, meta, Path(data_root), join)
    return write_annotations(path, meta, samples, shard, source)


def _samples(
    records: Iterable[Mapping[str, Any]], meta: AnnotationMeta, root: Path, join: bool
) -> Iterator[MapSample]:
    warned, lost, samples = False, [], 0
    for number, record in enumerate(records):
        name = record.get("token", number) if isinstance(record, Mapping) else number
        with naming(f"record {name!r}", "correct it"):
            unknown = set(record) - set(_KEYS)
            if unknown:
                raise InputError(f"unknown keys {sorted(unknown)}; known are {_KEYS}.")
            sample = _sample(record, meta, root)
            check_samples([sample], meta)
            samples += 1
            given = len(sample.instances or ())
            if sample.instances is not None:
                whole = join_lines(sample.instances) if join else sample.instances
                sample.instances = [
                    MapInstance(item.label, piece)
                    for item in whole
                    for piece in _clipped(np.asarray(item.points, np.float64), meta)
                ]
        if given and not sample.instances:
            lost.append(sample.token)
        if sample.ego_from_frame is None and meta.frame == "lidar" and not warned:
            warned = True
            height_m = -frame_view(meta.frame, meta.ground_z_m).ground[2]
            _LOGGER.warning(_UNMOUNTED, sample.token, height_m)
        yield sample
    if lost:
        _LOGGER.warning(_LOST, len(lost), samples, lost[0])


def join_lines(instances: Sequence[MapInstance]) -> list[MapInstance]:
    """Join lines of one class whose ends meet, as where a map is cut into tiles.

    Ends within 0.1 m of each other in the plane meet. Lines are joined where two of them do; where
    three or more meet, as at a fork, they stay apart. A line may be turned round. Rings stay.

    Args:
        instances: Elements in metres.

    Returns:
        The rings as they are, then the joined lines of each class.
    """
    rings = [item for item in instances if is_closed(np.asarray(item.points))]
    joined = list(rings)
    for label in sorted({item.label for item in instances}):
        lines = [
            np.array(item.points, np.float64)
            for item in instances
            if item.label == label and not is_closed(np.asarray(item.points))
        ]
        _let_ends_meet(lines)
        if lines:
            parts = shapely.get_parts(shapely.line_merge(shapely.MultiLineString(lines)))
            pieces = vertices_of(parts, lines[0].shape[1])
            joined += [MapInstance(label, piece) for piece in pieces]
    return joined


def _let_ends_meet(lines: Sequence[Points]) -> None:
    """Move ends of lines that are near each other to one place, in place. each (n, dim)"""
    places: list[np.ndarray] = []
    for line in lines:
        for end in (0, -1):
            near = (p for p in places if np.linalg.norm(p[:2] - line[end, :2]) <= _MEETING_M)
            place = next(near, None)
            if place is None:
                places.append(line[end].copy())
            elif not (line[-1 - end] == place).all():  # a line as short as that stays one
                line[end] = place


def _sample(record: Mapping[str, Any], meta: AnnotationMeta, root: Path) -> MapSample:
    """Return a record as a sample; what it holds is still to be checked."""
    token = record["token"]
    if record.get(_GLOBAL) is not None:
        record = _in_frame(record, meta)
    given = {name: value for name, value in record.items() if value is not None}
    given["cameras"] = [_camera(camera, token, root) for camera in record["cameras"]]
    if "lidar" in given:
        lidar = given["lidar"]
        sweeps = [_record(SweepRecord, sweep) for sweep in lidar.get("sweeps", [])]
        matrix = lidar.get("frame_from_lidar")
        matrix = np.eye(4) if matrix is None else matrix
        given["lidar"] = LidarRecord(lidar["path"], matrix, sweeps)
    if "instances" in given:
        given["instances"] = [
            MapInstance(_label(instance["label"], meta), instance["points"])
            for instance in given["instances"]
        ]
    absent = {"scene": "", "map_name": "", "timestamp_ns": 0, "global_from_frame": np.eye(4)}
    return MapSample(**{**absent, **given})


def _in_frame(record: Mapping[str, Any], meta: AnnotationMeta) -> dict[str, Any]:
    """Return a record whose elements are moved from the global frame to its own."""
    if record.get("instances") is not None:
        raise InputError(f"give instances, in the frame, or {_GLOBAL}, not both.")
    if record.get("global_from_frame") is None:
        raise InputError(f"{_GLOBAL} need global_from_frame, the pose of the frame. (4, 4)")
    pose = np.array(record["global_from_frame"], np.float64)
    if meta.dim == 2:  # as of published data sets: roll, pitch and height have no effect
        yaw = np.arctan2(pose[1, 0], pose[0, 0])
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    else:
        turn = pose[:3, :3]
    instances = []
    for item in record[_GLOBAL]:
        points = np.array(item["points"], np.float64)[:, : meta.dim]
        apart = points - pose[: points.shape[1], 3]
        instances.append({**item, "points": apart @ turn})
    moved = {name: value for name, value in record.items() if name != _GLOBAL}
    return {**moved, "instances": instances}


def _record(kind: type[Record], values: Mapping[str, Any]) -> Record:
    """Return a mapping as a record of its kind; other keys are left alone."""
    return kind(**{field.name: values[field.name] for field in fields(kind)})  # type: ignore[arg-type]


def _camera(camera: Mapping[str, Any], token: str, root: Path) -> CameraRecord:
    if camera.get("width") is None or camera.get("height") is None:
        where = f"sample {token!r}, camera {camera['name']!r}"
        width, height = image_size(root / camera["path"], where)
        camera = {**camera, "width": width, "height": height}
    if np.any(camera.get("distortion", ())):
        camera = {**camera, "path": _rectified(camera, root)}
    return _record(CameraRecord, camera)


def _rectified(camera: Mapping[str, Any], root: Path) -> str:
    """Write a camera's image without its distortion and return its path below the data root."""
    rig = RigCamera(
        str(camera["name"]),
        np.array(camera["intrinsics"], np.float64),
        np.eye(4),
        (int(camera["width"]), int(camera["height"])),
        np.array(camera["distortion"], np.float64),
        str(camera.get("distortion_model", "")),
    )
    calibration = repr((rig.intrinsics.tolist(), rig.distortion.tolist(), rig.model))
    digest = hashlib.sha256(calibration.encode()).hexdigest()[:12]
    path = f"rectified/{file_name(rig.name)}-{digest}/{file_name(camera['path'])}.jpg"
    if not (root / path).is_file():
        image = read_image(str(root / camera["path"]), f"camera {rig.name!r}", rig.size_px)
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        rig.write_image(root / path, image)
    return path


def _label(label: Any, meta: AnnotationMeta) -> int:
    """Return a class's index, given by its name or itself."""
    if not isinstance(label, str):
        return int(label)
    if label not in meta.classes:
        raise InputError(f"label {label!r} is not among {meta.classes}.")
    return meta.classes.index(label)


def _clipped(points: Points, meta: AnnotationMeta) -> list[Points]:
    """Return what of an element lies in the range; rings stay rings. each (n, dim)."""
    low, high = np.array([meta.x_range, meta.y_range]).T
    if ((points[:, :2] >= low) & (points[:, :2] <= high)).all():
        return [points]
    if not is_closed(points):
        return list(clip_to_box(points, meta.x_range, meta.y_range))
    polygon = shapely.Polygon(points)
    if not polygon.is_valid:
        raise InputError("a ring that leaves the range crosses itself and cannot be cut: mend it.")
    parts = shapely.get_parts(shapely.intersection(polygon, shapely.box(*low, *high)))
    areas = parts[(shapely.get_type_id(parts) == POLYGON) & ~shapely.is_empty(parts)]
    return vertices_of(shapely.get_exterior_ring(areas), meta.dim)
