"""Samples from info files of mmdet3d 1.x (format v2)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import check_samples
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, LidarRecord, MapSample
from gsmap.datasets.errors import explain_errors
from gsmap.datasets.image_files import image_size
from gsmap.utils.errors import InputError
from mapdata.infos.plain_pickle import load_plain_pickle
from mapdata.unix_times import in_nanoseconds

# End of the message if an entry of the file lacks a field or has a wrong value.
_REMEDY = (
    "GSMap needs images (img_path, cam2img, lidar2cam), lidar_points (lidar2ego), ego2global and "
    "timestamp"
)


def read_info_file(
    path: str | Path, data_root: str | Path | None = None, allow_missing_cameras: bool = False
) -> list[MapSample]:
    """Read the samples of an info file: cameras, LiDAR and poses, without map elements.

    Args:
        path: Pickle with ``metainfo`` and ``data_list``. No code from the file is run.
        data_root: Folder that image and LiDAR paths are relative to; the folder of the file by
            default.
        allow_missing_cameras: Whether to leave out cameras whose image is missing.

    Returns:
        Samples in the LIDAR_TOP frame, with paths relative to ``data_root``.

    Raises:
        FileNotFoundError: If the file or one of its images is missing.
        ValueError: If the file is not an info file of this format, a sample has no camera with an
            image and a calibration, or a value of a sample is missing or wrong.
    """
    path = Path(path)
    root = Path(path.parent if data_root is None else data_root)
    content = load_plain_pickle(path)
    if not isinstance(content, Mapping) or not isinstance(content.get("data_list"), list):
        raise InputError(
            f"{path} is not an info file of mmdet3d's format v2 (no data_list): convert an info "
            "file of a published system with tools/create_data.py infos, and an older info file of "
            "mmdet3d with mmdet3d's tools/dataset_converters/update_infos_to_v2.py."
        )
    samples = []
    # Metadata for the checks of samples in the LiDAR frame. No file is written with it.
    meta = AnnotationMeta("mmdet3d", "lidar", split="test")
    for i, info in enumerate(content["data_list"]):
        where = f"{path}, sample {i}"
        # Errors about the content become a ValueError with the name of the sample and the remedy.
        with explain_errors(where, _REMEDY):
            sample = _sample(info, root, where=where, allow_missing=allow_missing_cameras)
            check_samples([sample], meta)
        samples.append(sample)
    return samples


def _matrix(values: Any, size: int, name: str) -> np.ndarray:
    """Convert a field to a square matrix.

    The last row of a transform is added if it is missing; padding of intrinsics is removed.

    Args:
        values: Nested lists or an array. (size, size), (3, 4), or (4, 4) for intrinsics
        size: 3 for intrinsics, 4 for transforms.
        name: Name of the field, for messages.
    """
    matrix = np.asarray(values, dtype=np.float64)
    if size == 4 and matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if size == 3 and matrix.shape in ((3, 4), (4, 4)):
        matrix = matrix[:3, :3]
    if matrix.shape != (size, size):
        raise InputError(f"{name} must be {size} x {size}, got {matrix.shape}.")
    return matrix


def find_file(name: str, root: Path) -> Path | None:
    """Find the longest end of a path that is the path of a file below a folder.

    For ``/data/samples/a.jpg``, the ends are ``data/samples/a.jpg``, ``samples/a.jpg`` and
    ``a.jpg``. Ends with ``..`` may lead out of the folder, and are left out.

    Args:
        name: Path, possibly absolute and from another computer.
        root: Folder.

    Returns:
        The end of the path, relative to ``root``; None if no end is a file.
    """
    parts = [part for part in Path(name.replace("\\", "/")).parts if part != "/"]
    for start in range(len(parts)):
        end = Path(*parts[start:])
        if ".." not in end.parts and (root / end).is_file():
            return end
    return None


def _locate(name: str, folder: str, root: Path, owner: str) -> Path:
    """Find a file by its path (`find_file`), or by its name in a folder of nuScenes.

    Args:
        name: Path of the file.
        folder: Folder of the sensor in nuScenes, below ``samples``. Its name is the sensor's name.
        root: Data root.
        owner: Sample and sensor of the file, for messages.

    Returns:
        Path relative to ``root``.

    Raises:
        FileNotFoundError: If neither path is a file.
    """
    usual = Path("samples", folder, Path(name).name)
    path = find_file(name, root) or find_file(str(usual), root)
    if path is None:
        raise FileNotFoundError(
            f"{owner}: no file {root / name} or {root / usual}; give the folder that the paths "
            "start from with --data-root."
        )
    return path


def _camera(name: str, info: Mapping[str, Any], root: Path, where: str) -> CameraRecord:
    """Read the record of one camera; ``where`` names the sample in messages."""
    owner = f"{where}, camera {name}"
    path = _locate(info["img_path"], name, root=root, owner=owner)
    width, height = image_size(root / path, owner)
    return CameraRecord(
        name=name,
        path=path.as_posix(),
        width=width,
        height=height,
        intrinsics=_matrix(info["cam2img"], size=3, name=f"{owner}: cam2img"),
        cam_from_frame=_matrix(info["lidar2cam"], size=4, name=f"{owner}: lidar2cam"),
    )


def _cameras(
    images: Mapping[str, Any], root: Path, where: str, allow_missing: bool
) -> list[CameraRecord]:
    """Read the cameras with an image and a calibration; ``where`` names the sample in messages."""
    cameras = []
    for name, info in images.items():
        if not info.get("img_path") or info.get("lidar2cam") is None:
            continue  # the info file has no image or no calibration of this camera
        try:
            cameras.append(_camera(name, info, root=root, where=where))
        except FileNotFoundError:
            if not allow_missing:
                raise
    if not cameras:
        raise InputError(f"{where} has no camera with an image and a calibration.")
    return cameras


def _sample(info: Mapping[str, Any], root: Path, where: str, allow_missing: bool) -> MapSample:
    """Make a sample from an entry of ``data_list``; ``where`` names it in messages."""
    lidar = info["lidar_points"]
    cameras = _cameras(info["images"], root, where=where, allow_missing=allow_missing)
    ego_from_lidar = _matrix(lidar["lidar2ego"], size=4, name=f"{where}: lidar2ego")
    global_from_ego = _matrix(info["ego2global"], size=4, name=f"{where}: ego2global")
    # A number that is not recognised as a Unix time is taken as seconds.
    timestamp_ns = in_nanoseconds(info["timestamp"], usual_unit_ns=10**9)
    lidar_record = None
    if lidar.get("lidar_path"):
        path = _locate(lidar["lidar_path"], "LIDAR_TOP", root=root, owner=f"{where}, LiDAR")
        # The annotation frame is the frame of the LiDAR.
        lidar_record = LidarRecord(path.as_posix(), frame_from_lidar=np.eye(4))
    return MapSample(
        token=str(info.get("token", info.get("sample_idx", where))),
        scene=str(info.get("scene_token", "")),
        map_name=str(info.get("map_location") or ""),
        timestamp_ns=timestamp_ns,
        cameras=cameras,
        global_from_frame=global_from_ego @ ego_from_lidar,
        ego_from_frame=ego_from_lidar,
        lidar=lidar_record,
    )
