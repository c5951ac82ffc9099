"""Annotation files of custom data, from plain records with any cameras."""

import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import chain, islice
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
from gsmap.datasets.annotations.schema import whole_number
from gsmap.datasets.errors import explain_errors
from gsmap.datasets.image_files import image_size, read_image
from gsmap.datasets.pose_plausibility import FAR_M, float32_step_m
from gsmap.datasets.scene_places import place_warnings
from gsmap.structures.classes import AREA_CLASSES, DIRECTED_CLASSES, LINE_CLASSES
from gsmap.structures.frames import frame_view
from gsmap.structures.polylines import Points, clip_to_box, is_closed
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name
from gsmap.utils.shards import WHOLE, Shard, digest
from mapdata.calibrated import calibrated_records, digest_of_calibration
from mapdata.folders.rig import RigCamera
from mapdata.joining import join_lines, without_copies
from mapdata.local_map import POLYGON, lift_corners, vertices_of
from mapdata.paths import path_below
from mapdata.record_digest import digest_of_records

_LOGGER = logging.getLogger(__name__)
# Placeholders: token of the record, and height of the sensor above the road in metres.
_UNMOUNTED = (
    "record %r has no ego_from_frame: pictures will take the road to be level, %.2f m below the "
    "sensor (ground_z_m; nuScenes' height by default), and models that lift images (LSS) "
    "cannot use it."
)
# Placeholder: path of the annotation file.
_UNKNOWN_ROAD = (
    "%s does not contain the height of the road in the frame 'ego': pictures and inference will "
    "take the road to be 0.31 m below the origin (Argoverse 2's axle); set the height with "
    "AnnotationMeta(ground_z_m=...)."
)
# Placeholders: number of records without elements after clipping, number of records, first token.
_ALL_ELEMENTS_LOST = (
    "%d of %d records lose all of their elements (the first is %r), as none lies in x_range and "
    "y_range: points must be in metres of the frame, not of the world, and not in millimetres."
)
# Placeholders: number of records with open areas, number of records, first token.
_OPEN_AREAS = (
    "%d of %d records have crossings or other areas that are open lines (the first is %r): close "
    "a ring by repeating its first point at the end."
)
# Placeholders: number of records with copies, number of records, first token.
_COPIES = (
    "%d of %d records have elements that are copies of others (the first is %r), as some maps "
    "store the line between two lanes with each of them: give each element once, or join=True."
)
# Placeholders: number of records with such rings, number of records, first token.
_CUT_RINGS = (
    "%d of %d records have rings of your own classes that leave the range (the first is %r). They "
    "are cut as areas, so that the border of the range becomes a part of them: give a ring that is "
    "a line in two open parts."
)
# Placeholders: number of records with such positions, number of records, first token.
_COARSE_POSES = (
    "%d of %d records have positions in global_from_frame that are rounded to float32 (the first "
    "is %r), which at such large coordinates has steps of 1 cm to 1 m or more: keep them in "
    "float64, or subtract an origin before they are rounded."
)
# Placeholders: number of records with such elements, number of records, first token.
_COARSE_POINTS = (
    "%d of %d records have points of global_instances that are rounded to float32 (the first is "
    "%r), which at such large coordinates has steps of 1 cm to 1 m or more: keep them in float64, "
    "or subtract an origin before they are rounded."
)
_GLOBAL = "global_instances"
_POSE = "global_from_frame"
_KEYS = [*(field.name for field in fields(MapSample)), _GLOBAL]
_CAMERA_KEYS = [*(field.name for field in fields(CameraRecord)), "distortion", "distortion_model"]
_LIDAR_KEYS = [field.name for field in fields(LidarRecord)]
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

    A record is a mapping. All keys but the first two are optional:

    - ``token``: unique name;
    - ``cameras``: mappings with ``name``, ``path`` (relative to ``data_root``), ``intrinsics``
      (3, 3) in pixels, ``cam_from_frame`` (4, 4), and, to avoid opening the image, ``width`` and
      ``height``. With ``distortion`` (OpenCV's coefficients, and ``distortion_model`` as in
      docs/inference.md) the image is rectified into ``rectified/`` of the data root;
    - ``instances``: mappings with ``label`` (name or index) and ``points`` (n, 2 or 3) in metres.
      The first and the last point of a ring are equal. Elements are clipped to the range of
      ``meta``; rings stay rings, but those of dividers, boundaries and centre lines are cut open.
      Without this key and the next one, the sample has no ground truth;
    - ``global_instances``: elements in the global frame in place of ``instances``, such as a whole
      map. They are transformed to the frame by the position and the yaw of ``global_from_frame``
      or, in annotation files with heights, by the whole pose;
    - ``lidar``: mapping with ``path``, ``frame_from_lidar`` (4, 4) and ``sweeps``, mappings with
      ``path``, ``timestamp_ns``, ``frame_from_lidar``;
    - ``ego_from_frame`` (4, 4): pose of the frame ``lidar`` in the frame of the vehicle, in which
      the road is at z = 0. Without it, a warning describes the consequences;
    - ``scene``, ``map_name``, ``timestamp_ns``, ``can_bus``;
    - ``global_from_frame`` (4, 4): pose of the frame, for all records or for none. Without it, a
      model has no memory of earlier frames, and there are no maps of drives.

    Args:
        path: Annotation file to write.
        records: The records.
        meta: Frame, classes and range of the data.
        data_root: Folder that image and LiDAR paths are relative to.
        shard: Part of the records to take, such as ``Shard.parse("3/16")``.
        join: Whether to join lines of a class whose ends meet, for maps in pieces (`join_lines`).
        calibration: Calibration file of the vehicle, in the format that ``tools/infer.py`` reads in
            a folder of images. It defines intrinsics, distortion, mounting and, if it names
            ``poses``, ``global_from_frame`` at the record's ``timestamp_ns``. Cameras of records
            then have ``name`` and ``path``, and ``timestamp_ns`` if the image has another time.

    Returns:
        Number of samples.

    Raises:
        FileNotFoundError: If the calibration file is missing, or an image whose size is not given.
        ValueError: If a record or the calibration file is malformed. The message names the token of
            the record or the calibration file. In this case, no annotation file remains.
    """
    if meta.frame == "ego" and meta.ground_z_m is None:
        _LOGGER.warning(_UNKNOWN_ROAD, path)
    source = ""
    if shard.count:
        # Shards can be joined only if they are parts of one list. `source` identifies the list by
        # all values of all records, by `join`, and by their calibration.
        records = list(records)
        lines = ["join"] if join else []
        lines.append(digest_of_records(records))
        if calibration is not None:
            lines.append(digest_of_calibration(Path(calibration)))
        text = "\n".join(lines)
        source = hashlib.sha256(text.encode()).hexdigest()
    if calibration is not None:
        records = calibrated_records(
            list(records), Path(calibration), meta=meta, root=Path(data_root), shard=shard
        )
    elif shard.count:
        records = shard.part(list(records))
    # The metadata, which says whether poses are known, is written before the samples. So the first
    # record decides, and `create_samples` refuses others that differ.
    records = iter(records)
    first = list(islice(records, 1))
    if any(isinstance(record, Mapping) and record.get(_POSE) is None for record in first):
        meta = replace(meta, options={**meta.options, "poses": False})
    records = chain(first, records)
    # A generator: samples are checked and written one by one.
    samples = create_samples(records, meta, root=Path(data_root), join=join)
    return write_annotations(path, meta, samples, shard=shard, source=source)


def create_samples(
    records: Iterable[Mapping[str, Any]], meta: AnnotationMeta, root: Path, join: bool
) -> Iterator[MapSample]:
    """Yield the samples of records, clipped to the range, and warn of implausible records.

    Args:
        records: Records as `from_records` takes them.
        meta: Frame, classes and range of the data.
        root: Folder that image and LiDAR paths are relative to.
        join: Whether to join lines of a class whose ends meet.

    Raises:
        FileNotFoundError: If an image without a given size is missing.
        ValueError: If a record is malformed.
    """
    has_warned = False
    tokens_of: dict[str, list[str]] = {}  # tokens of the records that a warning is about
    places: set[tuple[str, str]] = set()  # scene and map_name of the records
    coarse_positions: set[tuple[float, ...]] = set()  # x and y of poses that a warning is about
    count = 0
    for number, record in enumerate(records):
        name = record.get("token", number) if isinstance(record, Mapping) else number
        with explain_errors(f"record {name!r}", "correct it"):
            _require_keys(record, known=_KEYS)
            if (record.get(_POSE) is not None) != meta.has_poses:
                text = "has no" if meta.has_poses else "has a"
                raise InputError(f"it {text} {_POSE}, unlike the first: give all a pose, or none.")
            sample = _create_sample(record, meta=meta, root=root)
            check_samples([sample], meta)  # raises an error for a wrong shape or value
            count += 1
            for warning in _coarse_coordinates(record):
                tokens_of.setdefault(warning, []).append(sample.token)
                position = np.asarray(record[_POSE], np.float64)[:2, 3]
                coarse_positions.add(tuple(position.tolist()))
            places.add((sample.scene, sample.map_name))
            if sample.instances is not None:
                whole = join_lines(sample.instances, meta.classes) if join else sample.instances
                sample.instances = _clip_elements(whole, meta=meta)
                for warning in _doubts(whole, clipped=sample.instances, meta=meta):
                    tokens_of.setdefault(warning, []).append(sample.token)
        if sample.ego_from_frame is None and meta.frame == "lidar" and not has_warned:
            has_warned = True
            _, _, road_z_m = frame_view(meta.frame, meta.ground_z_m).ground  # z = a x + b y + c
            height_m = -road_z_m
            _LOGGER.warning(_UNMOUNTED, sample.token, height_m)
        yield sample
    # A few positions are float32 numbers by chance, and an origin of single frames may be round.
    if 2 * len(tokens_of.get(_COARSE_POSES, [])) <= count or len(coarse_positions) == 1:
        tokens_of.pop(_COARSE_POSES, None)
    for warning, tokens in tokens_of.items():
        _LOGGER.warning(warning, len(tokens), count, tokens[0])
    for line in place_warnings(places):
        _LOGGER.warning("%s.", line)


def _coarse_coordinates(record: Mapping[str, Any]) -> Iterator[str]:
    """Yield the warnings about global coordinates of a record that are rounded to float32."""
    if record.get(_POSE) is None:
        return
    position = np.asarray(record[_POSE], np.float64)[:3, 3]
    # Elements near the vehicle have coordinates of the size of its position.
    if np.abs(position).max() < FAR_M:
        return
    if float32_step_m(position):
        yield _COARSE_POSES
    elements = record.get(_GLOBAL) or []
    # `all` ends at the first element that is not rounded.
    if elements and all(float32_step_m(element["points"]) for element in elements):
        yield _COARSE_POINTS


def _doubts(
    whole: Sequence[MapInstance], clipped: Sequence[MapInstance], meta: AnnotationMeta
) -> Iterator[str]:
    """Yield the warnings about the elements of a record.

    Args:
        whole: Elements before they are clipped.
        clipped: Elements in the range.
        meta: Classes and range of the data.
    """
    if whole and not clipped:
        yield _ALL_ELEMENTS_LOST
    if any(_is_open_area(element, meta) for element in clipped):
        yield _OPEN_AREAS
    if _has_copies(clipped, meta):
        yield _COPIES
    if any(_is_cut_ring(element, meta) for element in whole):
        yield _CUT_RINGS


def _is_cut_ring(element: MapInstance, meta: AnnotationMeta) -> bool:
    """Whether an element is a ring of a class of the user that is partly in the range."""
    points = np.asarray(element.points, np.float64)
    if meta.classes[element.label] in (*AREA_CLASSES, *LINE_CLASSES) or not is_closed(points):
        return False
    return not _is_inside(points, meta) and bool(_clip(points, label=element.label, meta=meta))


def _is_inside(points: Points, meta: AnnotationMeta) -> bool:
    """Whether all points (n, dim) are in the range of an annotation file."""
    low, high = np.array([meta.x_range, meta.y_range]).T
    return bool(((points[:, :2] >= low) & (points[:, :2] <= high)).all())


def _is_open_area(element: MapInstance, meta: AnnotationMeta) -> bool:
    """Whether an element of a class of areas is no closed ring."""
    is_area = meta.classes[element.label] in AREA_CLASSES
    return is_area and not is_closed(element.points)


def _has_copies(elements: Sequence[MapInstance], meta: AnnotationMeta) -> bool:
    """Whether two elements of a class are the same line or ring."""
    lines_of: dict[int, list[Points]] = {}  # by label
    for element in elements:
        lines_of.setdefault(element.label, []).append(element.points)
    for label, lines in lines_of.items():
        is_directed = meta.classes[label] in DIRECTED_CLASSES
        if len(without_copies(lines, is_directed=is_directed)) < len(lines):
            return True
    return False


def _clip_elements(elements: Sequence[MapInstance], meta: AnnotationMeta) -> list[MapInstance]:
    """Clip elements to the range of an annotation file."""
    pieces = []
    for element in elements:
        points = np.asarray(element.points, np.float64)
        for piece in _clip(points, label=element.label, meta=meta):
            pieces.append(MapInstance(label=element.label, points=piece))
    return pieces


def _require_keys(values: Any, known: Sequence[str], where: str = "") -> None:
    """Raise a ``ValueError`` if a value is no mapping, or has keys that would have no effect."""
    if not isinstance(values, Mapping):
        raise InputError(f"{where}expected a mapping with {sorted(known)}, got {values!r:.80}.")
    unknown = set(values) - set(known)
    if unknown:
        raise InputError(
            f"{where}unknown keys {sorted(map(str, unknown))}; known are {sorted(known)}."
        )


def _create_sample(record: Mapping[str, Any], meta: AnnotationMeta, root: Path) -> MapSample:
    """Create the sample of a record. The caller checks its values (`check_samples`)."""
    token = record["token"]
    if record.get(_GLOBAL) is not None:
        record = _transform_elements(record, meta)
    values: dict[str, Any] = {
        "scene": "",
        "map_name": "",
        "timestamp_ns": 0,
        "global_from_frame": np.eye(4),
    }
    for name, value in record.items():
        if value is not None:
            values[name] = value
    cameras = []
    for camera in record["cameras"]:
        cameras.append(_create_camera(camera, token=token, root=root))
    values["cameras"] = cameras
    if "lidar" in values:
        values["lidar"] = _create_lidar(values["lidar"])
    if "instances" in values:
        elements = []
        for instance in values["instances"]:
            label = _class_index(instance["label"], meta)
            elements.append(MapInstance(label=label, points=instance["points"]))
        values["instances"] = elements
    return MapSample(**values)


def _transform_elements(record: Mapping[str, Any], meta: AnnotationMeta) -> dict[str, Any]:
    """Replace the global elements of a record by elements in its frame."""
    if record.get("instances") is not None:
        raise InputError(f"give instances, in the frame, or {_GLOBAL}, not both.")
    if record.get("global_from_frame") is None:
        raise InputError(f"{_GLOBAL} need global_from_frame, the pose of the frame. (4, 4)")
    pose = np.array(record["global_from_frame"], np.float64)
    if meta.dim == 2:  # as in published data sets: roll, pitch and height have no effect
        yaw = np.arctan2(pose[1, 0], pose[0, 0])
        cos = np.cos(yaw)
        sin = np.sin(yaw)
        rotation = np.array([[cos, -sin], [sin, cos]])
    else:
        rotation = pose[:3, :3]
    instances = []
    for item in record[_GLOBAL]:
        points = np.array(item["points"], np.float64)
        if points.ndim != 2 or points.shape[1] < meta.dim:
            raise InputError(
                f"points of {_GLOBAL} must be (n >= 2, {meta.dim}), as dim of the annotation file "
                f"is {meta.dim}, got shape {points.shape}"
            )
        points = points[:, : meta.dim]
        offsets = points - pose[: points.shape[1], 3]
        local_points = offsets @ rotation  # points are rows, so this is the inverse rotation
        instances.append({**item, "points": local_points})
    local_record = dict(record)
    del local_record[_GLOBAL]
    local_record["instances"] = instances
    return local_record


def _create_record(kind: type[Record], values: Mapping[str, Any]) -> Record:
    """Create an object of a dataclass, such as `SweepRecord`, from a mapping.

    Keys of the mapping that are not fields of the dataclass are ignored.
    """
    arguments = {}
    for field in fields(kind):  # type: ignore[arg-type]
        arguments[field.name] = values[field.name]
    return kind(**arguments)


def _create_lidar(lidar: Mapping[str, Any]) -> LidarRecord:
    """Create the record of a LiDAR scan; its pose is by default the frame's."""
    _require_keys(lidar, known=_LIDAR_KEYS, where="lidar: ")
    frame_from_lidar = lidar.get("frame_from_lidar")
    if frame_from_lidar is None:
        frame_from_lidar = np.eye(4)
    path = lidar["path"]
    sweeps = []
    for sweep in lidar.get("sweeps", []):
        sweeps.append(_create_record(SweepRecord, sweep))
    return LidarRecord(path=path, frame_from_lidar=frame_from_lidar, sweeps=sweeps)


def _create_camera(camera: Mapping[str, Any], token: str, root: Path) -> CameraRecord:
    """Create the record of a camera; the size comes from the image if it is not given."""
    if not isinstance(camera, Mapping):
        raise InputError(f"cameras: expected a mapping for each camera, got {camera!r:.80}.")
    name = f"camera {camera['name']!r}"
    if "timestamp_ns" in camera:
        raise InputError(
            f"{name}: timestamp_ns is for records with a calibration file (calibration=): leave it "
            "out, and include the motion since the time of the sample in cam_from_frame."
        )
    _require_keys(camera, known=_CAMERA_KEYS, where=f"{name}: ")
    values = dict(camera)
    if camera.get("width") is None or camera.get("height") is None:
        where = f"sample {token!r}, {name}"
        path = path_below(root, name=camera["path"], noun=f"{where}: the path")
        values["width"], values["height"] = image_size(path, where)
    distortion = values.pop("distortion", None)
    model = values.pop("distortion_model", None)
    if distortion is not None or model is not None:
        rig_camera = RigCamera(
            name=str(camera["name"]),
            intrinsics=np.array(camera["intrinsics"], dtype=np.float64),
            cam_from_ground=np.eye(4),  # the mounting does not matter for rectification
            size_px=(int(values["width"]), int(values["height"])),
            distortion=np.array(() if distortion is None else distortion, dtype=np.float64),
            model=str(model or ""),
        )
        if rig_camera.is_distorted:
            values["path"] = _rectify_image(rig_camera, camera["path"], root=root)
    return _create_record(CameraRecord, values)


def _rectify_image(rig_camera: RigCamera, image_path: str, root: Path) -> str:
    """Write a camera's image without its distortion, and return its path below the data root."""
    calibration = (
        rig_camera.intrinsics.tolist(),
        rig_camera.distortion.tolist(),
        rig_camera.model,
    )
    where = f"camera {rig_camera.name!r}"
    source = path_below(root, name=image_path, noun=f"{where}: the path")
    # The digest keeps images apart that have another calibration, or whose source was replaced.
    content = digest(source) if source.is_file() else ""  # a missing one raises an error below
    version = hashlib.sha256(f"{calibration} {content}".encode()).hexdigest()[:12]
    name = f"{file_name(image_path)}-{version}.jpg"
    path = f"rectified/{file_name(rig_camera.name)}/{name}"
    target = root / path
    if not target.is_file():
        image = read_image(str(source), where, size=rig_camera.size_px)
        target.parent.mkdir(parents=True, exist_ok=True)
        rig_camera.write_image(target, image)
    return path


def _class_index(label: Any, meta: AnnotationMeta) -> int:
    """Index of a class that is given by its name or its index."""
    if not isinstance(label, str):
        return whole_number(label, name="label")
    if label not in meta.classes:
        raise InputError(f"label {label!r} is not among {meta.classes}.")
    return meta.classes.index(label)


def _clip(points: Points, label: int, meta: AnnotationMeta) -> list[Points]:
    """Clip an element to the range of an annotation file. (n, dim) each

    Rings stay rings, such as areas of the user's classes. Rings of lines that leave the range are
    cut into open lines, so that the border of the range is not part of the ground truth.
    """
    if _is_inside(points, meta):
        return [points]
    if meta.classes[label] in LINE_CLASSES or not is_closed(points):
        return list(clip_to_box(points, x_range=meta.x_range, y_range=meta.y_range))
    polygon = shapely.Polygon(points)
    if not polygon.is_valid:
        raise InputError(
            "a ring crosses itself, so it cannot be cut at the border of the range: correct it."
        )
    (x_min, x_max), (y_min, y_max) = meta.x_range, meta.y_range
    box = shapely.box(xmin=x_min, ymin=y_min, xmax=x_max, ymax=y_max)
    parts = shapely.get_parts(shapely.intersection(polygon, box))
    # The ring may touch the box in points or lines, which are left out. The cut adds no holes.
    is_area = (shapely.get_type_id(parts) == POLYGON) & ~shapely.is_empty(parts)
    areas = parts[is_area]
    areas = lift_corners(areas, polygons=np.full(len(areas), polygon), rectangle=box)
    return vertices_of(shapely.get_exterior_ring(areas), dim=meta.dim)
