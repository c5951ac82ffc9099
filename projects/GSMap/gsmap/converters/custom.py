"""Annotation files of your own data, from plain records: any cameras, ground truth or not."""

import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from PIL import Image, UnidentifiedImageError

from gsmap.converters.local_map import POLYGON
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
from gsmap.structures.polylines import Points, clip_to_box, is_closed
from gsmap.utils.shards import WHOLE, Shard

_LOGGER = logging.getLogger(__name__)
_UNMOUNTED = (
    "record %r has no ego_from_frame: pictures will take the road to be level, 1.84 m below the "
    "sensor (nuScenes' height), and models that lift images (MapTRv2) cannot use it."
)
_RECORD_KEYS = {
    "token", "cameras", "instances", "global_from_frame", "ego_from_frame", "timestamp_ns", "scene",
    "map_name", "lidar", "can_bus",
}  # fmt: skip


def from_records(
    path: str | Path,
    records: Iterable[Mapping[str, Any]],
    meta: AnnotationMeta,
    data_root: str | Path,
    shard: Shard = WHOLE,
) -> int:
    """Write an annotation file from plain records.

    A record is a mapping. All but the first two keys may be left out:

    - ``token``: unique name;
    - ``cameras``: mappings with ``name``, ``path`` (relative to ``data_root``), ``intrinsics``
      (3, 3) in pixels, ``cam_from_frame`` (4, 4), and, unless the image is to be asked, ``width``
      and ``height``;
    - ``instances`` (absent: no ground truth is known): mappings with ``label`` (name or index) and
      ``points`` (n, 2 or 3) in metres, a ring's last equal to its first. What lies outside the
      range of ``meta`` is cut off; rings stay rings;
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

    Returns:
        How many samples were written.

    Raises:
        FileNotFoundError: If an image is missing whose size is not given.
        ValueError: If a record is malformed; the message names its token. No file is left then.
    """
    source = ""
    if shard.count:
        records = list(records)
        tokens = "\n".join(str(r.get("token") if isinstance(r, Mapping) else r) for r in records)
        source = hashlib.sha256(tokens.encode()).hexdigest()
        records = shard.part(records)
    samples = _samples(records, meta, Path(data_root))
    return write_annotations(path, meta, samples, shard, source)


def _samples(
    records: Iterable[Mapping[str, Any]], meta: AnnotationMeta, root: Path
) -> Iterator[MapSample]:
    warned = False
    for number, record in enumerate(records):
        name = record.get("token", number) if isinstance(record, Mapping) else number
        with naming(f"record {name!r}", "correct it"):
            unknown = set(record) - _RECORD_KEYS
            if unknown:
                raise ValueError(
                    f"unknown keys {sorted(unknown)}; known are {sorted(_RECORD_KEYS)}."
                )
            sample = _sample(record, meta, root)
            check_samples([sample], meta)
        if sample.ego_from_frame is None and meta.frame == "lidar" and not warned:
            warned = True
            _LOGGER.warning(_UNMOUNTED, sample.token)
        yield sample


def _sample(record: Mapping[str, Any], meta: AnnotationMeta, root: Path) -> MapSample:
    token = record["token"]
    can_bus, instances, lidar, mounting = (
        record.get(key) for key in ("can_bus", "instances", "lidar", "ego_from_frame")
    )
    return MapSample(
        token=token,
        scene=record.get("scene", ""),
        map_name=record.get("map_name", ""),
        timestamp_ns=int(record.get("timestamp_ns", 0)),
        cameras=[_camera(camera, token, root) for camera in record["cameras"]],
        global_from_frame=_matrix(record.get("global_from_frame")),
        ego_from_frame=None if mounting is None else _matrix(mounting),
        lidar=None if lidar is None else _lidar(lidar),
        can_bus=None if can_bus is None else np.asarray(can_bus, np.float64),
        instances=None if instances is None else _instances(instances, meta, token),
    )


def _matrix(values: Any) -> np.ndarray:
    """Return a transform; the identity if none is given. (4, 4)."""
    return np.eye(4) if values is None else np.asarray(values, np.float64)


def _camera(camera: Mapping[str, Any], token: str, root: Path) -> CameraRecord:
    width, height = camera.get("width"), camera.get("height")
    if width is None or height is None:
        file = root / camera["path"]
        if not file.is_file():
            raise FileNotFoundError(
                f"sample {token!r}, camera {camera['name']!r}: no image at {file}; paths are "
                "relative to data_root."
            )
        try:
            with Image.open(file) as image:
                width, height = image.size
        except UnidentifiedImageError as error:
            raise ValueError(
                f"sample {token!r}: {file} is not an image; fetch it again."
            ) from error
    return CameraRecord(
        camera["name"],
        camera["path"],
        int(width),
        int(height),
        np.asarray(camera["intrinsics"], np.float64),
        np.asarray(camera["cam_from_frame"], np.float64),
    )


def _lidar(lidar: Mapping[str, Any]) -> LidarRecord:
    sweeps = [
        SweepRecord(sweep["path"], int(sweep["timestamp_ns"]), _matrix(sweep["frame_from_lidar"]))
        for sweep in lidar.get("sweeps", [])
    ]
    return LidarRecord(lidar["path"], _matrix(lidar.get("frame_from_lidar")), sweeps)


def _instances(
    instances: Sequence[Mapping[str, Any]], meta: AnnotationMeta, token: str
) -> list[MapInstance]:
    found = []
    for instance in instances:
        label, points = instance["label"], np.asarray(instance["points"], np.float64)
        if isinstance(label, str):
            if label not in meta.classes:
                raise ValueError(f"sample {token!r}: label {label!r} is not among {meta.classes}.")
            label = meta.classes.index(label)
        if points.ndim != 2 or len(points) < 2 or points.shape[1] != meta.dim:
            raise ValueError(
                f"sample {token!r}: points must be (n >= 2, {meta.dim}), got {points.shape}."
            )
        if not np.isfinite(points).all():
            raise ValueError(f"sample {token!r}: points hold NaN or infinity.")
        found += [MapInstance(int(label), piece) for piece in _clipped(points, meta, token)]
    return found


def _clipped(points: Points, meta: AnnotationMeta, token: str) -> list[Points]:
    """Return what of an element lies in the range; rings stay rings. each (n, dim)."""
    (x0, x1), (y0, y1) = meta.x_range, meta.y_range
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    if (low >= (x0, y0)).all() and (high <= (x1, y1)).all():
        return [points]
    if not is_closed(points):
        return list(clip_to_box(points, meta.x_range, meta.y_range))
    polygon = shapely.Polygon(points)
    if not polygon.is_valid:
        raise ValueError(
            f"sample {token!r}: a ring that leaves the range crosses itself, so it cannot be cut: "
            "mend it."
        )
    parts = shapely.get_parts(shapely.intersection(polygon, shapely.box(x0, y0, x1, y1)))
    return [
        shapely.get_coordinates(part.exterior, include_z=meta.dim == 3)
        for part in parts
        if shapely.get_type_id(part) == POLYGON
    ]
