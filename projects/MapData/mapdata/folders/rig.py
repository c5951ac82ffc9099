"""Cameras on a vehicle, its poses, and the samples that they make together."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from gsmap.datasets.annotations.file import check_samples
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord, MapSample
from gsmap.datasets.image_files import encode_jpeg
from gsmap.datasets.source import sample_in_vehicle
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_bytes
from mapdata.argoverse2.log import closest_ns

PoseAt = Callable[[int], np.ndarray | None]
FISHEYE_MODELS = ("equidistant", "fisheye")
PLAIN_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "")
_COUNTS = dict.fromkeys(PLAIN_MODELS, (4, 5, 8, 12, 14)) | dict.fromkeys(FISHEYE_MODELS, (4,))
_LEAST_SEEN, _GRID = 0.1, 16  # share of a rectified image, looked at on so many pixels squared


@dataclass
class RigCamera:
    """A camera on a vehicle.

    Args:
        name: Any name.
        intrinsics: Pinhole matrix in pixels. (3, 3)
        cam_from_ground: From the ground below the vehicle (x ahead, y left, z up) to the camera (x
            right, y down, z ahead), in metres. (4, 4)
        size_px: Width and height of its images.
        distortion: OpenCV's coefficients; none for a pinhole camera. (n,)
        model: Their model, as ROS names it.
        trained: Width, height, fx, fy, cx and cy of a camera without distortion that images are
            rectified to, at any size; None keeps ``intrinsics``.

    Raises:
        ValueError: If its size is not positive, or images cannot be rectified with such
            coefficients.
    """

    name: str
    intrinsics: np.ndarray
    cam_from_ground: np.ndarray
    size_px: tuple[int, int]
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    model: str = ""
    trained: Sequence[float] | None = None

    @property
    def seen_intrinsics(self) -> np.ndarray:
        """Pinhole matrix of the images as a model sees them, in pixels. (3, 3)"""
        if self.trained is None or not self.is_distorted:
            return self.intrinsics
        width, height, fx, fy, cx, cy = self.trained
        by_x, by_y = self.size_px[0] / width, self.size_px[1] / height
        return np.array([[fx * by_x, 0, cx * by_x], [0, fy * by_y, cy * by_y], [0, 0, 1.0]])

    def __post_init__(self) -> None:
        if min(self.size_px) < 1:
            raise InputError(f"camera {self.name!r} has images of {self.size_px} pixels, not > 0.")
        if self.is_distorted:
            self._check_distortion()

    def _check_distortion(self) -> None:
        where = f"camera {self.name!r}"
        if self.model not in _COUNTS:
            raise InputError(
                f"{where} has the distortion model {self.model!r}; known are "
                f"{list(filter(None, _COUNTS))}: rectify its images first."
            )
        numbers, counts = self.distortion, _COUNTS[self.model]
        if self.model in FISHEYE_MODELS and not np.any(numbers[4:]):
            self.distortion = numbers = numbers[:4]  # some drivers add zeros
        if numbers.shape not in [(count,) for count in counts] or not np.isfinite(numbers).all():
            raise InputError(
                f"{where} has the distortion {numbers.tolist()!r:.80}; the model "
                f"{self.model or 'plumb_bob'} takes {' or '.join(map(str, counts))} numbers, all "
                "finite."
            )
        if not self._share_seen() > _LEAST_SEEN:
            raise InputError(
                f"{where} sees next to nothing without its distortion {numbers.tolist()!r:.80}: "
                "intrinsics must be in pixels of these images, and the distortion of the model "
                f"{self.model or 'plumb_bob'}."
            )

    @property
    def is_distorted(self) -> bool:
        """Whether its images must be rectified before a model sees them."""
        return bool(np.any(self.distortion))

    def _share_seen(self) -> float:
        """Return which share of a rectified image lies in the original, about."""
        lens = cv2.fisheye if self.model in FISHEYE_MODELS else cv2
        width, height = self.size_px
        small = np.diag([_GRID / width, _GRID / height, 1.0]) @ self.intrinsics
        x, y = lens.initUndistortRectifyMap(
            self.intrinsics, self.distortion, np.eye(3), small, (_GRID, _GRID), cv2.CV_32FC1
        )
        return float(((x >= 0) & (x < width) & (y >= 0) & (y < height)).mean())

    def rectified(self, image: np.ndarray) -> np.ndarray:
        """Return an image as the camera without distortion would have seen it. (H, W, 3)"""
        if self.model in FISHEYE_MODELS:
            return cv2.fisheye.undistortImage(
                image, self.intrinsics, self.distortion, Knew=self.seen_intrinsics
            )
        return cv2.undistort(
            image, self.intrinsics, self.distortion, newCameraMatrix=self.seen_intrinsics
        )

    def write_image(self, path: Path, image: np.ndarray) -> None:
        """Write an image, BGR, as JPEG, without its distortion. (H, W, 3)"""
        image = self.rectified(image) if self.is_distorted else image
        write_bytes(path, encode_jpeg(image, 95))


def rectify_as_trained(rig: Sequence[RigCamera], trained: Mapping[str, Sequence[float]]) -> bytes:
    """Let images of distorted cameras be rectified to what a model was trained on, by name.

    Args:
        rig: The cameras; they are changed.
        trained: Width, height, fx, fy, cx and cy of the model's cameras.

    Returns:
        What tells the images that are made from others; nothing where no camera is concerned.
    """
    concerned = [camera for camera in rig if camera.is_distorted and camera.name in trained]
    for camera in concerned:
        camera.trained = tuple(trained[camera.name])
    return "".join(f"{camera.name} {camera.trained}\n" for camera in concerned).encode()


def rotation_of(wxyz: Iterable[Any]) -> np.ndarray:
    """Return the rotation of a quaternion, which must have length 1. (3, 3)"""
    w, x, y, z = (float(value) for value in wxyz)
    if not abs(np.linalg.norm([w, x, y, z]) - 1) < 1e-2:
        raise InputError(f"a quaternion must have length 1, got {[w, x, y, z]}")
    return Rotation.from_quat([x, y, z, w]).as_matrix()


class PoseTrack:
    """A vehicle's poses over time.

    Args:
        times_ns: In any order; of equal times one counts. (n,)
        poses: Global from vehicle. (n, 4, 4)
        gap_ns: Longest gap that is bridged; the ends reach a tenth of it.
        holds: Whether each pose holds until the next one where the gap is longer.

    Raises:
        ValueError: If there is no pose, or one is not finite.
    """

    def __init__(
        self,
        times_ns: Iterable[int],
        poses: Iterable[np.ndarray],
        gap_ns: int = 1_000_000_000,
        holds: bool = False,
    ) -> None:
        times, matrices = np.array(list(times_ns), np.int64), np.array(list(poses), np.float64)
        if not len(times) or not np.isfinite(matrices).all():
            raise InputError("poses must be finite, at least one.")
        self.times_ns, first = np.unique(times, return_index=True)
        self.poses, self.gap_ns, self.holds = matrices[first], gap_ns, holds

    def at(self, time_ns: int) -> np.ndarray | None:
        """Return the pose at a time, interpolated; None where none is near. (4, 4)"""
        after = int(np.searchsorted(self.times_ns, time_ns))
        if after < len(self.times_ns) and self.times_ns[after] == time_ns:
            return self.poses[after]
        if self.holds and after == len(self.times_ns):
            return self.poses[-1]
        if after in (0, len(self.times_ns)):
            nearest = max(after - 1, 0)
            near = abs(int(self.times_ns[nearest]) - time_ns) <= self.gap_ns // 10
            return self.poses[nearest] if near else None
        t0, t1 = self.times_ns[after - 1 : after + 1].tolist()
        if t1 - t0 > self.gap_ns:
            return self.poses[after - 1] if self.holds else None
        share, (a, b) = (time_ns - t0) / (t1 - t0), self.poses[after - 1 : after + 1]
        pose = (1 - share) * a + share * b
        turns = Rotation.from_matrix([a[:3, :3], b[:3, :3]])
        pose[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix()
        return pose


@dataclass(frozen=True)
class RigFrame:
    """What the cameras saw at one time: by camera, the image's path and its time.

    Args:
        token: Unique name.
        time_ns: Time of the frame.
        images: Path relative to the data root, and time in nanoseconds, by camera.
    """

    token: str
    time_ns: int
    images: Mapping[str, tuple[str, int]]


def nearest_images(
    times_ns: Mapping[str, np.ndarray], wanted_ns: Sequence[int], tolerance_ns: int
) -> list[dict[str, int]]:
    """Find each camera's image that is nearest to each time, within a tolerance.

    Args:
        times_ns: Times of each camera's images, ascending. each (n,)
        wanted_ns: The times. (m,)
        tolerance_ns: Largest difference.

    Returns:
        For each time, the images' times by camera. (m,)
    """
    found = []
    for wanted in wanted_ns:
        nearest = {n: closest_ns(times, wanted, tolerance_ns) for n, times in times_ns.items()}
        found.append({name: time for name, time in nearest.items() if time is not None})
    return found


def rig_samples(
    scene: str, rig: Sequence[RigCamera], frames: Sequence[RigFrame], pose_at: PoseAt | None
) -> list[MapSample]:
    """Make the samples of a drive, in the frame ``ego``.

    Args:
        scene: Name of the drive.
        rig: The cameras.
        frames: What they saw.
        pose_at: Pose of the ground below the vehicle at a time; frames for which it has none are
            left out. None where no pose is known.

    Raises:
        ValueError: If a value cannot be, such as a name that leads out of a folder.
    """
    samples = []
    for frame in frames:
        pose = None if pose_at is None else pose_at(frame.time_ns)
        if pose_at is not None and pose is None:
            continue
        cameras = []
        for camera in rig:
            if camera.name not in frame.images:
                continue
            path, time_ns = frame.images[camera.name]
            then = None if pose_at is None else pose_at(time_ns)
            cam_from_ground = camera.cam_from_ground
            if then is not None and pose is not None:  # the vehicle moves between the two
                cam_from_ground = cam_from_ground @ invert_rigid(then) @ pose
            cameras.append(
                CameraRecord(
                    camera.name, path, *camera.size_px, camera.seen_intrinsics, cam_from_ground
                )
            )
        samples.append(sample_in_vehicle(frame.token, scene, frame.time_ns, cameras, pose))
    check_samples(samples, AnnotationMeta("recording", "ego", "test"))
    return samples
