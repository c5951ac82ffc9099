"""Records of samples and metadata in an annotation file.

Records with arrays are compared by identity (``eq=False``), because arrays have no single truth
value.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.utils.errors import InputError
from gsmap.utils.split_lists import SPLIT_LIST, checked_identity

FORMAT_VERSION = 1
UNITED = "united"  # default rule for pedestrian crossings: they are joined where they overlap
_MAX_GROUND_Z_M = 10.0  # largest absolute height of the road
_MAX_CLASSES = 1000
CLASSES = ("divider", "ped_crossing", "boundary")  # the usual classes, in label order
RANGES = {"lidar": ((-15.0, 15.0), (-30.0, 30.0)), "ego": ((-30.0, 30.0), (-15.0, 15.0))}
"""Usual range of each annotation frame: smallest and largest x, then smallest and largest y, in
metres. The larger range is along the direction of travel, y of ``lidar`` and x of ``ego``."""


@dataclass(eq=False)
class CameraRecord:
    """Image and calibration of a camera.

    Args:
        name: Channel name, such as ``CAM_FRONT``.
        path: Image file, relative to the data root, with forward slashes.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        intrinsics: Pinhole matrix in pixels. (3, 3)
        cam_from_frame: Transform in metres from the annotation frame at the time of the sample to
            the camera (z forward) at the time of the image. It includes the motion of the vehicle
            between the two times. (4, 4)
    """

    name: str
    path: str
    width: int
    height: int
    intrinsics: np.ndarray
    cam_from_frame: np.ndarray

    @property
    def img_from_frame(self) -> np.ndarray:
        """Projection from the annotation frame in metres to the image in pixels.

        It maps (x, y, z, 1) to (u * d, v * d, d, 1), with the pixel (u, v) and the depth d in
        metres. (4, 4)
        """
        projection = np.eye(4)
        projection[:3] = self.intrinsics @ self.cam_from_frame[:3]
        return projection


@dataclass(eq=False)
class SweepRecord:
    """LiDAR sweep before the time of a sample.

    Args:
        path: Point file, relative to the data root.
        timestamp_ns: Time of the sweep in nanoseconds.
        frame_from_lidar: Transform in metres from the LiDAR at the time of the sweep to the
            annotation frame at the time of the sample. (4, 4)
    """

    path: str
    timestamp_ns: int
    frame_from_lidar: np.ndarray


@dataclass(eq=False)
class LidarRecord:
    """LiDAR sweep at the time of a sample, with earlier sweeps.

    Args:
        path: Point file, relative to the data root.
        frame_from_lidar: Transform in metres from the LiDAR to the annotation frame. (4, 4)
        sweeps: Earlier sweeps, latest first.
    """

    path: str
    frame_from_lidar: np.ndarray
    sweeps: list[SweepRecord] = field(default_factory=list)


@dataclass(eq=False)
class MapInstance:
    """Map element.

    Args:
        label: Index of the class in the metadata of the file.
        points: Vertices at full resolution in metres in the annotation frame. The last vertex of a
            ring equals the first. (n, 2 or 3)
    """

    label: int
    points: np.ndarray


@dataclass(eq=False)
class MapSample:
    """Sample with sensor data, poses and map elements.

    Args:
        token: Unique name of the sample.
        scene: Name of the drive of the sample.
        map_name: Name of the town or map; may be empty.
        timestamp_ns: Time in nanoseconds.
        cameras: Cameras with an image.
        global_from_frame: Pose of the annotation frame in the global frame of the map, in metres.
            (4, 4)
        lidar: LiDAR sweep; None for a sample without LiDAR.
        can_bus: Vehicle signals in the layout of MapTR; None if they are unknown. (18,)
        instances: Map elements. The list may be empty; None means that ground truth is unknown.
        ego_from_frame: Transform in metres from the annotation frame to the vehicle. None means the
            identity in the annotation frame ``ego``, and unknown in other frames. (4, 4)
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
    ego_from_frame: np.ndarray | None = None


def _check_classes(classes: Any) -> tuple[str, ...]:
    """Check that the names of classes are different, non-empty texts, and return them."""
    names = classes if isinstance(classes, (list, tuple)) else ()
    are_texts = all(isinstance(name, str) and name for name in names)
    if not names or not are_texts or len(set(names)) < len(names):
        raise InputError(f"classes must be different names, got {classes!r}.")
    if len(names) > _MAX_CLASSES:
        raise InputError(f"there are at most {_MAX_CLASSES} classes, not {len(names)}.")
    return tuple(names)


@dataclass(frozen=True)
class AnnotationMeta:
    """Metadata of an annotation file, which are stored in the schema of the file.

    Args:
        dataset: Data set, such as ``nuscenes``, ``minicity``, ``av2`` or a user-defined name.
        frame: Annotation frame, the frame of all coordinates: ``lidar`` (x right, y forward) or
            ``ego`` (x forward, y left).
        split: Split of the data set, such as ``train`` or ``val``.
        classes: Class names in label order.
        x_range: Smallest and largest x of the ground truth in metres; None for the usual range of
            the frame.
        y_range: Smallest and largest y of the ground truth in metres; None for the usual range of
            the frame.
        dim: Number of coordinates per point, 2 or 3.
        source_fingerprint: Digest of the source data; empty if unknown.
        versions: Versions of the libraries that were used for the conversion.
        options: Options of the conversion that change the content, by name.
        command: Command that creates the file, for messages.
        format_version: Version of the file format.
        ground_z_m: Height of the road in the frame in metres, for samples without
            ``ego_from_frame``. None for the usual height: -1.84 for ``lidar``, as in nuScenes, and
            -0.31 for ``ego``, as in Argoverse 2.

    Raises:
        ValueError: If a value is out of its domain.
    """

    dataset: str
    frame: str
    split: str
    classes: tuple[str, ...] = CLASSES
    x_range: tuple[float, float] = None  # type: ignore[assignment]  # never None after init
    y_range: tuple[float, float] = None  # type: ignore[assignment]
    dim: int = 2
    source_fingerprint: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    command: str = ""
    format_version: int = FORMAT_VERSION
    ground_z_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("dataset", "split", "source_fingerprint", "command"):
            if not isinstance(getattr(self, name), str):
                raise InputError(f"{name} must be a text, got {getattr(self, name)!r}.")
        if not isinstance(self.options, dict):
            raise InputError(f"options must be a dictionary, got {self.options!r:.60}.")
        checked_identity(self.split_list)  # raises an error if it is not a name with a digest
        if self.ground_z_m is not None and not abs(float(self.ground_z_m)) < _MAX_GROUND_Z_M:
            raise InputError(
                f"ground_z_m must be metres, between -{_MAX_GROUND_Z_M:g} and "
                f"{_MAX_GROUND_Z_M:g}, got {self.ground_z_m!r}."
            )
        if self.frame not in RANGES:
            raise InputError(f"frame must be one of {tuple(RANGES)}, got {self.frame!r}.")
        is_integer = type(self.dim) is int  # not a bool or a float
        if not is_integer or self.dim not in (2, 3):
            raise InputError(f"dim must be 2 or 3, got {self.dim!r}.")
        object.__setattr__(self, "classes", _check_classes(self.classes))
        for name, usual_range in zip(("x_range", "y_range"), RANGES[self.frame], strict=True):
            value = getattr(self, name)
            if value is None:
                value = usual_range
            low, high = (float(limit) for limit in value)
            if not -np.inf < low < high < np.inf:  # also refuses NaN
                raise InputError(f"{name} must be (low, high) with low < high, got {(low, high)}.")
            object.__setattr__(self, name, (low, high))  # the class is frozen

    @property
    def split_list(self) -> str:
        """Name and digest of the list of scenes that defines the splits; empty if unknown."""
        return self.options.get(SPLIT_LIST, "")

    @property
    def has_poses(self) -> bool:
        """Whether the poses of the vehicle are known."""
        return bool(self.options.get("poses", True))

    @property
    def crossings(self) -> str:
        """Rule by which pedestrian crossings become elements, by default ``united``.

        The rules are listed in ``tools/create_data.py nuscenes --help``.
        """
        return self.options.get("crossings", UNITED)
