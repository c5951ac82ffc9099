"""Samples from info files of mmdet3d (format v2, as mmdet3d 1.x writes them)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import check_samples
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, LidarRecord, MapSample
from gsmap.datasets.errors import naming
from gsmap.datasets.image_files import image_size
from gsmap.utils.errors import InputError
from mapdata.infos.plain_pickle import load_plain_pickle
from mapdata.unix_times import in_nanoseconds

_REMEDY = (
    "GSMap needs images (img_path, cam2img, lidar2cam), lidar_points (lidar2ego), ego2global and "
    "timestamp"
)


def read_info_file(
    path: str | Path, data_root: str | Path | None = None, allow_missing_cameras: bool = False
) -> list[MapSample]:
    """Read the samples of an info file: cameras, LiDAR and poses, without map elements.

    Args:
        path: A pickle with ``metainfo`` and ``data_list``. It is read without running code from it.
        data_root: Folder that image and LiDAR paths start from; that of the file by default.
        allow_missing_cameras: Whether to leave out a camera whose image does not exist.

    Returns:
        The samples, in the LIDAR_TOP frame, with paths relative to ``data_root``.

    Raises:
        FileNotFoundError: If the file, or an image that it names, does not exist.
        ValueError: If it is not an info file of this format.
    """
    path = Path(path)
    root = Path(path.parent if data_root is None else data_root)
    content = load_plain_pickle(path)
    if not isinstance(content, Mapping) or not isinstance(content.get("data_list"), list):
        raise InputError(
            f"{path} is not an info file of mmdet3d's format v2 (no data_list); those of MapTR and "
            "MapTRv2 convert with tools/create_data.py infos, older ones of mmdet3d with its "
            "tools/dataset_converters/update_infos_to_v2.py."
        )
    samples = []
    for i, info in enumerate(content["data_list"]):
        where = f"{path}, sample {i}"
        with naming(where, _REMEDY):
            samples.append(_sample(info, root, where, allow_missing_cameras))
            check_samples(samples[-1:], AnnotationMeta("mmdet3d", "lidar", "test"))
    return samples


def _matrix(values: Any, size: int, what: str) -> np.ndarray:
    """Return a square matrix; a 4 x 4 one given as its upper 3 x 4 part is completed."""
    matrix = np.asarray(values, dtype=np.float64)
    if size == 4 and matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if size == 3 and matrix.shape in ((3, 4), (4, 4)):
        matrix = matrix[:3, :3]
    if matrix.shape != (size, size):
        raise InputError(f"{what} must be {size} x {size}, got {matrix.shape}.")
    return matrix


def find_file(name: str, root: Path) -> Path | None:
    """Return the longest end of a path that is a file below ``root``, relative to it, or None."""
    parts = [part for part in Path(name.replace("\\", "/")).parts if part != "/"]
    ends = (Path(*parts[start:]) for start in range(len(parts)))
    return next((end for end in ends if (root / end).is_file()), None)


def _locate(name: str, folder: str, root: Path, what: str) -> Path:
    """Find a file, as named or in nuScenes' folders; the result is relative to ``root``."""
    usual = Path("samples", folder, Path(name).name)
    found = find_file(name, root) or find_file(str(usual), root)
    if found is None:
        raise FileNotFoundError(
            f"{what}: no file {root / name} or {root / usual}; give the folder that the paths "
            "start from with --data-root."
        )
    return found


def _camera(name: str, info: Mapping[str, Any], root: Path, where: str) -> CameraRecord:
    """Read one camera's record."""
    what = f"{where}, camera {name}"
    path = _locate(info["img_path"], name, root, what)
    width, height = image_size(root / path, what)
    return CameraRecord(
        name=name,
        path=path.as_posix(),
        width=width,
        height=height,
        intrinsics=_matrix(info["cam2img"], 3, f"{what}: cam2img"),
        cam_from_frame=_matrix(info["lidar2cam"], 4, f"{what}: lidar2cam"),
    )


def _cameras(
    images: Mapping[str, Any], root: Path, where: str, allow_missing: bool
) -> list[CameraRecord]:
    """Read the cameras that have an image and a calibration."""
    cameras = []
    for name, info in images.items():
        if not info.get("img_path") or info.get("lidar2cam") is None:
            continue
        try:
            cameras.append(_camera(name, info, root, where))
        except FileNotFoundError:
            if not allow_missing:
                raise
    if not cameras:
        raise InputError(f"{where} has no camera with an image and a calibration.")
    return cameras


def _sample(info: Mapping[str, Any], root: Path, where: str, allow_missing: bool) -> MapSample:
    """Turn one entry of ``data_list`` into a sample."""
    lidar = info["lidar_points"]
    cameras = _cameras(info["images"], root, where, allow_missing)
    ego_from_lidar = _matrix(lidar["lidar2ego"], 4, f"{where}: lidar2ego")
    global_from_ego = _matrix(info["ego2global"], 4, f"{where}: ego2global")
    timestamp_ns = in_nanoseconds(info["timestamp"], 10**9)
    record = None
    if lidar.get("lidar_path"):
        path = _locate(lidar["lidar_path"], "LIDAR_TOP", root, f"{where}, LiDAR")
        record = LidarRecord(path.as_posix(), np.eye(4))
    return MapSample(
        token=str(info.get("token", info.get("sample_idx", where))),
        scene=str(info.get("scene_token", "")),
        map_name=str(info.get("map_location") or ""),
        timestamp_ns=timestamp_ns,
        cameras=cameras,
        global_from_frame=global_from_ego @ ego_from_lidar,
        ego_from_frame=ego_from_lidar,
        lidar=record,
    )
