"""What is known about one sample, as plain values: the rows of an annotation file."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

FORMAT_VERSION = 1
CLASSES = ("divider", "ped_crossing", "boundary")
CAN_BUS_SIZE = 18
RANGES = {"lidar": ((-15.0, 15.0), (-30.0, 30.0)), "ego": ((-30.0, 30.0), (-15.0, 15.0))}
"""The usual range of each annotation frame: smallest and largest x, and y, in metres."""


@dataclass(eq=False)
class CameraRecord:
    """One camera's image and calibration.

    Args:
        name: Channel name, such as ``CAM_FRONT``.
        path: Image file, relative to the data root, with forward slashes.
        width: Image width in pixels.
        height: Image height in pixels.
        intrinsics: Pinhole matrix in pixels. (3, 3)
        cam_from_frame: Transform from the annotation frame at the sample's time to the camera (z
            forward) at the time of the image: the vehicle's motion between the two is included. (4,
            4)
    """

    name: str
    path: str
    width: int
    height: int
    intrinsics: np.ndarray
    cam_from_frame: np.ndarray


@dataclass(eq=False)
class SweepRecord:
    """An earlier LiDAR sweep.

    Args:
        path: Point file, relative to the data root.
        timestamp_ns: Time of the sweep in nanoseconds.
        frame_from_lidar: Transform from the sweep's sensor to the annotation frame at the sample's
            time. (4, 4)
    """

    path: str
    timestamp_ns: int
    frame_from_lidar: np.ndarray


@dataclass(eq=False)
class LidarRecord:
    """The LiDAR sweep at the sample's time, with earlier ones.

    Args:
        path: Point file, relative to the data root.
        frame_from_lidar: Transform from the sensor to the annotation frame. (4, 4)
        sweeps: Earlier sweeps, the latest first.
    """

    path: str
    frame_from_lidar: np.ndarray
    sweeps: list[SweepRecord] = field(default_factory=list)


@dataclass(eq=False)
class MapInstance:
    """One map element.

    Args:
        label: Index into the file's class list.
        points: Vertices at full resolution, in metres, in the annotation frame; a ring's last
            vertex equals its first. (n, 2) or (n, 3)
    """

    label: int
    points: np.ndarray


@dataclass(eq=False)
class MapSample:
    """One sample: sensors, poses and, where known, the map around it.

    Args:
        token: Unique name of the sample.
        scene: Name of the drive that it belongs to.
        map_name: Name of the town or map; may be empty.
        timestamp_ns: Time in nanoseconds.
        cameras: The cameras that have an image at this sample.
        global_from_frame: Pose of the annotation frame in the map's global frame. (4, 4)
        lidar: LiDAR sweep, or None.
        can_bus: Vehicle signals in MapTR's layout, or None. (18,)
        instances: Map elements; None where no ground truth is known (an empty list says that
            nothing is there).
        ego_from_frame: Transform from the annotation frame to the vehicle; identity where the frame
            is the vehicle. (4, 4)
    """

    token: str
    scene: str
    map_name: str
    timestamp_ns: int
    cameras: list[CameraRecord]
    global_from_frame: np.ndarray
    lidar: LidarRecord | None = None
    can_bus: np.ndarray | None = None
    instances: list[MapInstance] | None = None
    ego_from_frame: np.ndarray = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class AnnotationMeta:
    """What holds for a whole annotation file; stored in its schema.

    Args:
        dataset: Data set, such as ``nuscenes``, ``minicity``, ``av2`` or a name of your own.
        frame: ``lidar`` (x right, y forward) or ``ego`` (x forward, y left): the frame of all
            coordinates.
        split: Split that the file holds, such as ``train`` or ``val``.
        classes: Class names in label order.
        x_range: Smallest and largest x of the ground truth in metres; the frame's usual if None.
        y_range: Smallest and largest y of the ground truth in metres; the frame's usual if None.
        dim: Coordinates per point: 2 or 3.
        source_fingerprint: Digest of what the file was made from; empty if unknown.
        versions: Versions of the libraries that took part.
        options: Conversion options that change the content.
        command: The command that makes the file again, for messages.
        format_version: Version of the file format.

    Raises:
        ValueError: If a value is out of its domain.
    """

    dataset: str
    frame: str
    split: str
    classes: tuple[str, ...] = CLASSES
    x_range: tuple[float, float] = None  # type: ignore[assignment]  # a pair once it is made
    y_range: tuple[float, float] = None  # type: ignore[assignment]
    dim: int = 2
    source_fingerprint: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    command: str = ""
    format_version: int = FORMAT_VERSION

    def __post_init__(self) -> None:
        if self.frame not in RANGES:
            raise ValueError(f"frame must be one of {tuple(RANGES)}, got {self.frame!r}.")
        if self.dim not in (2, 3):
            raise ValueError(f"dim must be 2 or 3, got {self.dim!r}.")
        if not self.classes or len(set(self.classes)) != len(self.classes):
            raise ValueError(
                f"classes must be different names, at least one, got {self.classes!r}."
            )
        object.__setattr__(self, "classes", tuple(self.classes))
        for name, usual in zip(("x_range", "y_range"), RANGES[self.frame], strict=True):
            given = getattr(self, name)
            low, high = (float(v) for v in (usual if given is None else given))
            if not low < high:
                raise ValueError(f"{name} must be (low, high) with low < high, got {(low, high)}.")
            object.__setattr__(self, name, (low, high))


def _check_array(value: Any, shape: tuple[int, ...], name: str, token: str) -> None:
    array = np.asarray(value)
    if array.shape != shape or not np.issubdtype(array.dtype, np.number):
        raise ValueError(
            f"sample {token!r}: {name} must be numbers of shape {shape}, got {array.dtype} "
            f"{array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"sample {token!r}: {name} holds NaN or infinity.")


def _check_relative(path: str, name: str, token: str) -> None:
    if (
        not isinstance(path, str)
        or not path
        or path.startswith("/")
        or "\\" in path
        or ".." in path.split("/")
    ):
        raise ValueError(
            f"sample {token!r}: {name} must be relative to the data root, with forward slashes and "
            f"without '..', got {path!r}."
        )


def _check_cameras(cameras: Sequence[CameraRecord], token: str) -> None:
    names = [camera.name for camera in cameras]
    if len(set(names)) != len(names):
        raise ValueError(f"sample {token!r}: a camera appears twice in {names}.")
    for camera in cameras:
        _check_relative(camera.path, f"path of camera {camera.name}", token)
        _check_array(camera.intrinsics, (3, 3), f"intrinsics of camera {camera.name}", token)
        _check_array(
            camera.cam_from_frame, (4, 4), f"cam_from_frame of camera {camera.name}", token
        )
        if camera.width < 1 or camera.height < 1:
            raise ValueError(
                f"sample {token!r}: camera {camera.name} has size {camera.width} x {camera.height}."
            )


def _check_instances(instances: Sequence[MapInstance], meta: AnnotationMeta, token: str) -> None:
    for index, instance in enumerate(instances):
        if not 0 <= instance.label < len(meta.classes):
            raise ValueError(
                f"sample {token!r}: instance {index} has label {instance.label}, but the classes "
                f"are {meta.classes}."
            )
        points = np.asarray(instance.points)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != meta.dim:
            raise ValueError(
                f"sample {token!r}: points of instance {index} must be (n >= 2, {meta.dim}), got "
                f"{points.shape}."
            )
        if not np.isfinite(points).all():
            raise ValueError(f"sample {token!r}: points of instance {index} hold NaN or infinity.")


def validate_sample(sample: MapSample, meta: AnnotationMeta) -> None:
    """Check one sample's shapes and values.

    Args:
        sample: The sample.
        meta: Metadata of the file that it is meant for.

    Raises:
        ValueError: If a shape, label or path is wrong, or a number is not finite; the message names
            the sample.
    """
    token = sample.token
    if not isinstance(token, str) or not token:
        raise ValueError(f"token must be a non-empty string, got {token!r}.")
    _check_cameras(sample.cameras, token)
    _check_array(sample.global_from_frame, (4, 4), "global_from_frame", token)
    _check_array(sample.ego_from_frame, (4, 4), "ego_from_frame", token)
    if sample.can_bus is not None:
        _check_array(sample.can_bus, (CAN_BUS_SIZE,), "can_bus", token)
    if sample.lidar is not None:
        records: list[LidarRecord | SweepRecord] = [sample.lidar, *sample.lidar.sweeps]
        for record in records:
            _check_relative(record.path, "LiDAR path", token)
            _check_array(record.frame_from_lidar, (4, 4), "frame_from_lidar", token)
    if sample.instances is not None:
        _check_instances(sample.instances, meta, token)
