"""What is known about one sample, as plain values: the rows of an annotation file."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.utils.errors import InputError
from gsmap.utils.split_lists import SPLIT_LIST, checked_identity

FORMAT_VERSION = 1
UNITED = "united"  # rule of the crossings in files that name none
_HIGHEST_GROUND_M = 10.0
_MOST_CLASSES = 1000
CLASSES = ("divider", "ped_crossing", "boundary")
RANGES = {"lidar": ((-15.0, 15.0), (-30.0, 30.0)), "ego": ((-30.0, 30.0), (-15.0, 15.0))}
"""The usual range of each annotation frame: smallest and largest x, and y, in metres."""


@dataclass(eq=False)
class CameraRecord:
    """One camera's image and calibration.

    Args:
        name: Channel name, such as ``CAM_FRONT``.
        path: Image file, relative to the data root, with forward slashes.
        width: Width in pixels.
        height: Height in pixels.
        intrinsics: Pinhole matrix in pixels. (3, 3)
        cam_from_frame: Transform from the annotation frame at the sample's time to the camera (z
            forward) at the image's time, with the vehicle's motion in between. (4, 4)
    """

    name: str
    path: str
    width: int
    height: int
    intrinsics: np.ndarray
    cam_from_frame: np.ndarray

    @property
    def img_from_frame(self) -> np.ndarray:
        """Projection from the annotation frame to the image's pixels. (4, 4)"""
        projection = np.eye(4)
        projection[:3] = self.intrinsics @ self.cam_from_frame[:3]
        return projection


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
        ego_from_frame: Transform from the annotation frame to the vehicle; None where it is not
            known, which in the frame ``ego`` means the identity. (4, 4)
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


def _names(classes: Any) -> tuple[str, ...]:
    """Return the names of classes; ValueError if they are none."""
    names = classes if isinstance(classes, (list, tuple)) else ()
    named = all(isinstance(name, str) and name for name in names)
    if not (named and 0 < len(names) == len(set(names))):
        raise InputError(f"classes must be names, different ones, got {classes!r}.")
    if len(names) > _MOST_CLASSES:
        raise InputError(f"there are at most {_MOST_CLASSES} classes, not {len(names)}.")
    return tuple(names)


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
        ground_z_m: Height of the road in the frame, where a record's ``ego_from_frame`` does not
            tell it, in metres; None is the frame's usual: -1.84 below nuScenes' LiDAR, -0.31 below
            the axle of Argoverse 2.

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
    ground_z_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("dataset", "split", "source_fingerprint", "command"):
            if not isinstance(getattr(self, name), str):
                raise InputError(f"{name} must be a text, got {getattr(self, name)!r}.")
        if not isinstance(self.options, dict):
            raise InputError(f"options must be a dictionary, got {self.options!r:.60}.")
        checked_identity(self.split_list)
        if self.ground_z_m is not None and not abs(float(self.ground_z_m)) < _HIGHEST_GROUND_M:
            raise InputError(
                f"ground_z_m must be metres, between -{_HIGHEST_GROUND_M:g} and "
                f"{_HIGHEST_GROUND_M:g}, got {self.ground_z_m!r}."
            )
        if self.frame not in RANGES:
            raise InputError(f"frame must be one of {tuple(RANGES)}, got {self.frame!r}.")
        if type(self.dim) is not int or self.dim not in (2, 3):
            raise InputError(f"dim must be 2 or 3, got {self.dim!r}.")
        object.__setattr__(self, "classes", _names(self.classes))
        for name, usual in zip(("x_range", "y_range"), RANGES[self.frame], strict=True):
            given = getattr(self, name)
            low, high = (float(v) for v in (usual if given is None else given))
            if not -np.inf < low < high < np.inf:
                raise InputError(f"{name} must be (low, high) with low < high, got {(low, high)}.")
            object.__setattr__(self, name, (low, high))

    @property
    def split_list(self) -> str:
        """Name and digest of the list of scenes that splits were made by; empty if unknown."""
        return self.options.get(SPLIT_LIST, "")

    @property
    def crossings(self) -> str:
        """Rule that the crossings follow, see ``tools/create_data.py nuscenes --help``."""
        return self.options.get("crossings", UNITED)
