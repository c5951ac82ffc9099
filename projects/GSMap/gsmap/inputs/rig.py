"""Cameras on a vehicle, its poses, and the samples that they make together."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from gsmap.converters.argoverse2.log import closest_ns
from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.inputs.frames import sample_in_vehicle
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.files import write_bytes

PoseAt = Callable[[int], np.ndarray | None]
FISHEYE_MODELS = ("equidistant", "fisheye")
PLAIN_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "")


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
    """

    name: str
    intrinsics: np.ndarray
    cam_from_ground: np.ndarray
    size_px: tuple[int, int]
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    model: str = ""

    def __post_init__(self) -> None:
        if self.is_distorted and self.model not in (*FISHEYE_MODELS, *PLAIN_MODELS):
            known = [name for name in (*PLAIN_MODELS, *FISHEYE_MODELS) if name]
            raise ValueError(
                f"camera {self.name!r} has the distortion model {self.model!r}; known are {known}: "
                "rectify its images first."
            )

    @property
    def is_distorted(self) -> bool:
        """Whether its images must be rectified before a model sees them."""
        return bool(np.any(self.distortion))

    def rectified(self, image: np.ndarray) -> np.ndarray:
        """Return an image as the camera without distortion would have seen it. (H, W, 3)"""
        if self.model in FISHEYE_MODELS:
            coefficients = np.asarray(self.distortion[:4], np.float64)
            return cv2.fisheye.undistortImage(
                image, self.intrinsics, coefficients, Knew=self.intrinsics
            )
        return cv2.undistort(image, self.intrinsics, np.asarray(self.distortion, np.float64))

    def write_image(self, path: Path, image: np.ndarray) -> None:
        """Write an image, BGR, as JPEG, without its distortion. (H, W, 3)"""
        image = self.rectified(image) if self.is_distorted else image
        write_bytes(path, cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


class PoseTrack:
    """A vehicle's poses over time.

    Args:
        times_ns: In any order; of equal times one counts. (n,)
        poses: Global from vehicle. (n, 4, 4)
        gap_ns: Longest gap that is bridged, and how far the ends reach.

    Raises:
        ValueError: If there is no pose, or one is not finite.
    """

    def __init__(
        self, times_ns: Iterable[int], poses: Iterable[np.ndarray], gap_ns: int = 1_000_000_000
    ) -> None:
        times, matrices = np.array(list(times_ns), np.int64), np.array(list(poses), np.float64)
        if not len(times) or not np.isfinite(matrices).all():
            raise ValueError("poses must be finite, at least one.")
        self.times_ns, first = np.unique(times, return_index=True)
        self.poses, self.gap_ns = matrices[first], gap_ns

    def at(self, time_ns: int) -> np.ndarray | None:
        """Return the pose at a time, interpolated; None where none is near. (4, 4)"""
        after = int(np.searchsorted(self.times_ns, time_ns))
        if after < len(self.times_ns) and self.times_ns[after] == time_ns:
            return self.poses[after]
        if after in (0, len(self.times_ns)):
            nearest = max(after - 1, 0)
            near = abs(int(self.times_ns[nearest]) - time_ns) <= self.gap_ns // 10
            return self.poses[nearest] if near else None
        t0, t1 = self.times_ns[after - 1 : after + 1].tolist()
        if t1 - t0 > self.gap_ns:
            return None
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
                CameraRecord(camera.name, path, *camera.size_px, camera.intrinsics, cam_from_ground)
            )
        samples.append(sample_in_vehicle(frame.token, scene, frame.time_ns, cameras, pose))
    return samples
