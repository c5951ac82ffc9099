"""Logs (recorded drives) of py123d: times, poses of the vehicle, and cameras.

A log is a folder of Arrow tables: one with the times of the frames, one with the poses of the
vehicle, and one for each sensor. The metadata of a table is a dictionary.
"""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from gsmap.datasets.errors import explain_errors
from gsmap.datasets.image_files import decode_image
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name, write_bytes
from mapdata.arrow_tables import read_table
from mapdata.folders.rig import PoseTrack, rotation_of
from mapdata.paths import path_below
from mapdata.py123d.packed import metadata_of

SYNC = "sync.arrow"  # table with the time of each frame, and its row in the table of each sensor
_MAP = Path("map.arrow")  # in the folder of a log
_EGO = "ego_state_se3"  # table with the poses of the IMU; its metadata describe the vehicle
REMEDY = "convert the log again with py123d"  # `explain_errors` adds it to errors about a table
_CAMERA_PREFIX = "camera."
_PNG_START = b"\x89PNG"


def pose_of(values: Any) -> np.ndarray:
    """Transform of a pose of py123d: x, y, z in metres and the quaternion w, x, y, z. (4, 4)

    Raises:
        ValueError: If there are not 7 numbers, one is not finite, or the quaternion is not a unit
            quaternion.
    """
    numbers = np.array(values, dtype=np.float64)
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        raise InputError(f"a pose must be 7 finite numbers, got {values!r:.80}")
    return rigid(rotation_of(numbers[3:]), translation=numbers[:3])


class Camera:
    """Images of a camera of a log.

    Args:
        path: Table of the camera in the folder of the log.

    Attributes:
        key: Prefix of the columns of the camera's table, and name of its column in ``sync.arrow``.
        name: Name of the camera.
        metadata: Metadata of the table, with the size and the calibration of the camera.
        image_rows: Number of images.

    Raises:
        ValueError: If the table is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.key = path.stem
        self.name = self.key.removeprefix(_CAMERA_PREFIX)
        with explain_errors(path, REMEDY):
            columns = map(self._column, ("timestamp_us", "data", "camera_to_global_se3"))
            # Images stay on the disk until they are used.
            self._table = read_table(path, columns=list(columns), memory_map=True)
            self.metadata = metadata_of(self._table)
            self.image_rows = self._table.num_rows

    def _column(self, name: str) -> str:
        return f"{self.key}.{name}"

    def _value(self, name: str, row: int) -> Any:
        if not 0 <= row < self.image_rows:
            raise InputError(
                f"camera {self.name!r} has {self.image_rows} images, so no row {row} (from 0 on)"
            )
        return self._table[self._column(name)][row].as_py()

    @property
    def fault(self) -> str:
        """Reason why the camera cannot be used; empty for a pinhole camera with images."""
        model = self.metadata.get("camera_model")
        if model != "pinhole":
            return f"its model is {model!r:.40}, not 'pinhole'"
        if self.metadata.get("intrinsics") is None:
            return "it has no intrinsics"
        # If the column has integers instead of paths or images, they are frame numbers of a video.
        if pa.types.is_integer(self._table.schema.field(self._column("data")).type):
            return "its images are in a film; py123d must store them as JPEG or PNG"
        return ""

    def time_us(self, row: int) -> int:
        """Time of an image in microseconds."""
        return int(self._value("timestamp_us", row))

    def global_from_camera(self, row: int, track: PoseTrack) -> np.ndarray:
        """Pose of the camera at the time of an image. (4, 4)

        Args:
            row: Row of the image.
            track: Poses of the IMU, from which the pose is computed if the table has none.

        Returns:
            Transform from the camera to the global frame, in metres.

        Raises:
            ValueError: If there is no pose, or it is not valid.
            KeyError: If the pose is computed and the table has no extrinsics.
        """
        values = self._value("camera_to_global_se3", row)
        if values is not None:
            return pose_of(values)
        global_from_imu = track.at(1000 * self.time_us(row))
        if global_from_imu is None:
            raise InputError(f"camera {self.name!r} has no pose near {self.time_us(row)} us")
        return global_from_imu @ pose_of(self.metadata["camera_to_imu_se3"])

    def image_path(self, row: int, root: Path, scene: str) -> str:
        """Path of an image, relative to the data root.

        The table has either the path or the encoded image. An encoded image is written to a file.

        Args:
            row: Row of the image.
            root: Data root.
            scene: Name of the log.

        Raises:
            ValueError: If the table has neither a path nor a valid image in this row, or if the
                path leads out of the data root.
            KeyError: If the metadata lack the size of an encoded image.
        """
        data = self._value("data", row)
        where = f"camera {self.name!r}"
        if isinstance(data, str):
            path_below(root, name=data, noun=f"{where}: the path")  # only to check the path
            return data
        if not isinstance(data, bytes):
            raise InputError(f"{where} has no image in row {row}")
        size = (int(self.metadata["width"]), int(self.metadata["height"]))
        decode_image(data, path=f"row {row}", where=where, size=size)  # only to check the image
        suffix = "png" if data.startswith(_PNG_START) else "jpg"
        folder = f"images/{file_name(scene)}/{file_name(self.name)}"
        path = f"{folder}/{self.time_us(row)}.{suffix}"
        target = root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target, data)
        return path

    @property
    def calibration(self) -> dict[str, Any]:
        """Name, size, intrinsics and distortion of the camera.

        They have the keys of a camera record of `mapdata.custom.from_records`.

        Raises:
            KeyError: If a value is missing.
            ValueError: If there are not five intrinsics.
        """
        fx, fy, cx, cy, skew = self.metadata["intrinsics"]
        distortion = self.metadata.get("distortion")
        if distortion is None or self.metadata.get("is_undistorted"):
            distortion = []  # the images have none
        return {
            "name": self.name,
            "width": self.metadata["width"],
            "height": self.metadata["height"],
            "intrinsics": [[fx, skew, cx], [0, fy, cy], [0, 0, 1]],
            "distortion": list(distortion),  # k1, k2, p1, p2, k3, as in OpenCV
        }


class Log:
    """Log of py123d. Tables are read on first use.

    Args:
        folder: Folder of the log, with ``sync.arrow`` and a table for each sensor.

    Attributes:
        folder: Folder of the log.
        name: Name of the folder, which is the scene of the samples.
        metadata: Metadata of ``sync.arrow``, with the location and the map of the log.

    Raises:
        FileNotFoundError: If a table is missing.
        ValueError: If a table is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = folder.name
        self._sync = self._read(SYNC)  # time of each frame, and rows in the tables of its sensors
        self.metadata = metadata_of(self._sync)

    def _read(self, name: str, columns: list[str] | None = None) -> pa.Table:
        path = self.folder / name
        if not path.is_file():
            raise FileNotFoundError(f"no table at {path}: {REMEDY}.")
        with explain_errors(path, REMEDY):
            return read_table(path, columns=columns)

    @property
    def location(self) -> str:
        """Name of the town or map; empty if unknown."""
        return str(self.metadata.get("location") or "")

    def map_file(self, root: Path) -> Path | None:
        """Path of the map; None if the log has no map.

        Args:
            root: Folder of py123d's data, with ``logs`` and ``maps``.

        Raises:
            ValueError: If neither the map nor the log has a data set or a location, or if the path
                leads out of the folder of maps.
        """
        metadata = self.metadata.get("map_metadata")
        if not isinstance(metadata, dict):
            return None
        if metadata.get("map_is_per_log"):
            return self.folder / _MAP
        dataset = metadata.get("dataset") or self.metadata.get("dataset")
        location = metadata.get("location") or self.location
        if not dataset or not location:
            raise InputError(
                f"its map cannot be found, since {self.folder / SYNC} has no "
                f"{'location' if dataset else 'dataset'}: {REMEDY}"
            )
        file = f"{dataset}/{dataset}_{location}.arrow"
        return path_below(root / "maps", name=file, noun="the map's file")

    @cached_property
    def _ego(self) -> pa.Table:
        return self._read(f"{_EGO}.arrow", columns=[f"{_EGO}.timestamp_us", f"{_EGO}.imu_se3"])

    @cached_property
    def track(self) -> PoseTrack:
        """Poses of the IMU in the global frame by time in nanoseconds, interpolated in between."""
        with explain_errors(self.folder / f"{_EGO}.arrow", REMEDY):
            times_ns = [1000 * time for time in self._ego[f"{_EGO}.timestamp_us"].to_pylist()]
            poses = map(pose_of, self._ego[f"{_EGO}.imu_se3"].to_pylist())
            return PoseTrack(times_ns, poses)

    @cached_property
    def imu_from_axle(self) -> np.ndarray:
        """Transform from the frame ``ego`` to the frame of the IMU. (4, 4)

        The origin of ``ego`` is the centre of the rear axle, with x ahead, y left and z up.
        """
        with explain_errors(self.folder / f"{_EGO}.arrow", REMEDY):
            return pose_of(metadata_of(self._ego)["rear_axle_to_imu_se3"])

    @cached_property
    def ground_z_m(self) -> float:
        """Height of the road in the frame ``ego`` in metres: the bottom of the vehicle's box."""
        with explain_errors(self.folder / f"{_EGO}.arrow", REMEDY):
            metadata = metadata_of(self._ego)
            imu_from_center = pose_of(metadata["center_to_imu_se3"])
            axle_from_center = invert_rigid(self.imu_from_axle) @ imu_from_center
            # The bottom is half the height of the box below its centre.
            return float(axle_from_center[2, 3]) - float(metadata["height"]) / 2

    @cached_property
    def cameras(self) -> list[Camera]:
        """Usable cameras, in the order of their names."""
        return [camera for camera in self._all_cameras if camera.name not in self.unused_cameras]

    @cached_property
    def _all_cameras(self) -> list[Camera]:
        return [Camera(path) for path in sorted(self.folder.glob(f"{_CAMERA_PREFIX}*.arrow"))]

    @cached_property
    def unused_cameras(self) -> dict[str, str]:
        """Faults of the cameras that are left out, by the names of the cameras."""
        reasons = {}
        for camera in self._all_cameras:
            reason = camera.fault
            if not reason and camera.key not in self._sync.column_names:
                reason = f"{SYNC} has no column for it"
            if reason:
                reasons[camera.name] = reason
        return reasons

    @property
    def unused_tables(self) -> list[str]:
        """Names of the tables that are not read, such as LiDAR."""
        names = {path.stem for path in self.folder.glob("*.arrow")}
        cameras = {camera.key for camera in self._all_cameras}
        return sorted(names - cameras - {Path(SYNC).stem, _MAP.stem, _EGO})

    def frames(self) -> Iterator[tuple[int, dict[str, int | None]]]:
        """Yield the time of each frame in nanoseconds, and the row of its image by camera.

        The row is None for a camera without an image in the frame.
        """
        with explain_errors(self.folder / SYNC, REMEDY):
            times_ns = [1000 * int(time) for time in self._sync["sync.timestamp_us"].to_pylist()]
            rows = {}
            for camera in self.cameras:
                rows[camera.name] = self._sync[camera.key].to_pylist()
        for frame_index, time_ns in enumerate(times_ns):
            row_of_camera = {}
            for name, column in rows.items():
                row_of_camera[name] = column[frame_index]
            yield time_ns, row_of_camera
