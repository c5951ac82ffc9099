"""Cameras on a vehicle, its poses over time, and the samples of a drive.

A rig is the set of cameras on a vehicle. Rectification removes the distortion of an image, so that
it becomes an image of a pinhole camera.
"""

from collections import Counter
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
from gsmap.utils.words import format_count
from mapdata.argoverse2.log import closest_ns

PoseAt = Callable[[int], np.ndarray | None]
"""Function from a time in nanoseconds to the pose (4, 4) of the ground below the vehicle.

It returns None if no pose is known near this time.
"""
# Names of distortion models in ROS. OpenCV has separate functions for the two groups.
FISHEYE_MODELS = ("equidistant", "fisheye")
PLAIN_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "")
# Valid numbers of distortion coefficients, by distortion model.
_COUNTS = dict.fromkeys(PLAIN_MODELS, (4, 5, 8, 12, 14)) | dict.fromkeys(FISHEYE_MODELS, (4,))
_LEAST_SHARE = 0.1  # smallest share of a rectified image that the original image covers
_SAME_TIME_NS = 1_000_000  # the motion in a shorter time is negligible
_GRID = 64  # width and height in pixels of the small image on which this share is measured


@dataclass
class RigCamera:
    """A camera on a vehicle.

    Args:
        name: Name of the camera.
        intrinsics: Pinhole matrix in pixels. (3, 3)
        cam_from_ground: Transform from the ground below the vehicle (x ahead, y left, z up) to the
            camera (x right, y down, z ahead), in metres. (4, 4)
        size_px: Width and height of the images.
        distortion: Distortion coefficients in OpenCV's order; empty for a pinhole camera. (n,)
        model: Distortion model, as ROS names it.
        trained: Width, height, fx, fy, cx and cy of the camera that a model was trained on. Images
            of a distorted camera are rectified to these intrinsics, scaled to the width of the
            images. None rectifies them to ``intrinsics``.

    Raises:
        ValueError: If the size is not positive, or images cannot be rectified with the given
            distortion: its model is unknown, its coefficients are invalid, or they leave almost no
            image.
    """

    name: str
    intrinsics: np.ndarray
    cam_from_ground: np.ndarray
    size_px: tuple[int, int]
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    model: str = ""
    trained: Sequence[float] | None = None

    @property
    def rectified_intrinsics(self) -> np.ndarray:
        """Pinhole matrix of the images without distortion, in pixels. (3, 3)"""
        if self.trained is None or not self.is_distorted:
            return self.intrinsics
        width, height, fx, fy, cx, cy = self.trained
        scale = self.size_px[0] / width  # one for both axes: another ratio would squeeze the image
        # The distance of the principal point from the centre of the image is scaled.
        centre_y = self.size_px[1] / 2 + (cy - height / 2) * scale
        return np.array([[fx * scale, 0, cx * scale], [0, fy * scale, centre_y], [0, 0, 1.0]])

    def __post_init__(self) -> None:
        if min(self.size_px) < 1:
            raise InputError(f"camera {self.name!r} has images of {self.size_px} pixels, not > 0.")
        if self.model in FISHEYE_MODELS and self.distortion.size == 0:
            raise InputError(
                f"camera {self.name!r} has the distortion model {self.model!r}, but no distortion: "
                "give its four coefficients, which are zeros for an ideal fisheye lens."
            )
        if self.is_distorted:
            self._check_distortion()

    def _check_distortion(self) -> None:
        """Raise a ValueError if images cannot be rectified; drop zeros behind the coefficients."""
        where = f"camera {self.name!r}"
        if self.model not in _COUNTS:
            raise InputError(
                f"{where} has the distortion model {self.model!r}; known are "
                f"{list(filter(None, _COUNTS))}: rectify its images first."
            )  # `filter` leaves the empty name of plumb_bob out
        if self.model in FISHEYE_MODELS and not np.any(self.distortion[4:]):
            self.distortion = self.distortion[:4]  # some drivers append zeros
        numbers = self.distortion
        counts = _COUNTS[self.model]
        is_valid = numbers.ndim == 1 and len(numbers) in counts and np.isfinite(numbers).all()
        if not is_valid:
            raise InputError(
                f"{where} has the distortion {numbers.tolist()!r:.80}; the model "
                f"{self.model or 'plumb_bob'} takes {' or '.join(map(str, counts))} numbers, all "
                "finite."
            )
        if not self.covered_share() > _LEAST_SHARE:
            raise InputError(
                f"{where} sees next to nothing without its distortion {numbers.tolist()!r:.80}: "
                "intrinsics must be in pixels of these images, and the distortion of the model "
                f"{self.model or 'plumb_bob'}."
            )

    @property
    def is_distorted(self) -> bool:
        """Whether images must be rectified before they are given to a model.

        Coefficients of a fisheye lens that are all zero are an ideal one, r = f theta, which is no
        pinhole camera. Those of the other models stand for a camera without distortion.
        """
        is_fisheye = self.model in FISHEYE_MODELS and self.distortion.size > 0
        return is_fisheye or bool(np.any(self.distortion))

    def covered_share(self) -> float:
        """Approximate share of a rectified image that the original image covers, in [0, 1]."""
        # Both modules have a function of this name, each for its distortion models.
        lens = cv2.fisheye if self.model in FISHEYE_MODELS else cv2
        width, height = self.size_px
        # The pinhole matrix of the image, scaled down to the small image.
        small_intrinsics = np.diag([_GRID / width, _GRID / height, 1.0]) @ self.rectified_intrinsics
        # x and y are the position of each pixel of a small rectified image in the original image.
        x, y = lens.initUndistortRectifyMap(
            self.intrinsics,
            self.distortion,
            np.eye(3),
            small_intrinsics,
            size=(_GRID, _GRID),
            m1type=cv2.CV_32FC1,
        )
        return float(((x >= 0) & (x < width) & (y >= 0) & (y < height)).mean())

    def rectify(self, image: np.ndarray) -> np.ndarray:
        """Remove the distortion of an image. (H, W, 3) -> (H, W, 3)"""
        if self.model in FISHEYE_MODELS:
            return cv2.fisheye.undistortImage(
                image, self.intrinsics, self.distortion, Knew=self.rectified_intrinsics
            )
        return cv2.undistort(
            image, self.intrinsics, self.distortion, newCameraMatrix=self.rectified_intrinsics
        )

    def write_image(self, path: Path, image: np.ndarray) -> None:
        """Rectify an image if the camera is distorted, and write it as JPEG.

        Args:
            path: File to write.
            image: Image of the camera in BGR. (H, W, 3)
        """
        if self.is_distorted:
            image = self.rectify(image)
        write_bytes(path, encode_jpeg(image, quality=95))


def set_rectification_targets(
    rig: Sequence[RigCamera], trained: Mapping[str, Sequence[float]]
) -> tuple[bytes, list[str]]:
    """Set the cameras of a model as the targets of rectification, by name.

    Args:
        rig: Cameras; ``trained`` of distorted cameras is set in place.
        trained: Width, height, fx, fy, cx and cy of the model's cameras, by name.

    Returns:
        Names and intrinsics of the cameras with a target, as bytes, and notes. Callers add the
        bytes to the digest that names the rectified images. They are empty if no camera has a
        target.
    """
    text = ""  # a line for each camera with a target
    notes = []
    for camera in rig:
        if not camera.is_distorted or camera.name not in trained:
            continue
        camera.trained = tuple(trained[camera.name])
        share = camera.covered_share()
        focal_px = camera.rectified_intrinsics[0, 0]
        if share > _LEAST_SHARE:
            text += f"{camera.name} {camera.rectified_intrinsics.tolist()}\n"
            notes.append(
                f"camera {camera.name!r} is rectified to the focal length of the model, "
                f"{focal_px:.0f} in place of {camera.intrinsics[0, 0]:.0f} pixels; "
                f"{share:.0%} of its images are covered"
            )
        else:
            camera.trained = None
            notes.append(
                f"camera {camera.name!r} keeps its focal length: with that of the model only "
                f"{share:.0%} of its images would be covered"
            )
    return text.encode(), notes


def rotation_of(wxyz: Iterable[Any]) -> np.ndarray:
    """Rotation matrix of a quaternion. (3, 3)

    Args:
        wxyz: Four numbers, w first, or texts of numbers.

    Raises:
        ValueError: If the length of the quaternion is not 1.
    """
    w, x, y, z = (float(value) for value in wxyz)
    if not abs(np.linalg.norm([w, x, y, z]) - 1) < 1e-2:
        raise InputError(f"a quaternion must have length 1, got {[w, x, y, z]}")
    return Rotation.from_quat([x, y, z, w]).as_matrix()


class PoseTrack:
    """Poses of a vehicle over time.

    Args:
        times_ns: Times of the poses, in any order. Among poses of equal times, the first is used.
            (n,)
        poses: Transforms from the vehicle to the global frame, in metres. (n, 4, 4)
        gap_ns: Longest gap between two poses in which poses are interpolated. In longer gaps,
            before the first pose and after the last one, the nearest pose is used up to a tenth of
            this time from it.
        holds: Whether poses are kept. If True, the pose before a gap longer than ``gap_ns`` is used
            in the whole gap, and the last pose is used at all later times.

    Raises:
        ValueError: If there is no pose, or a pose is not finite.
    """

    def __init__(
        self,
        times_ns: Iterable[int],
        poses: Iterable[np.ndarray],
        gap_ns: int = 1_000_000_000,
        holds: bool = False,
    ) -> None:
        times = np.array(list(times_ns), dtype=np.int64)
        matrices = np.array(list(poses), dtype=np.float64)
        if not len(times) or not np.isfinite(matrices).all():
            raise InputError("poses must be finite, at least one.")
        # Times become distinct and ascending. If a time has several poses, the first one is kept.
        self.times_ns, first = np.unique(times, return_index=True)
        self.poses = matrices[first]
        self.gap_ns = gap_ns
        self.holds = holds

    def at(self, time_ns: int) -> np.ndarray | None:
        """Interpolate the pose at a time; None if no pose is near. (4, 4)"""
        count = len(self.times_ns)
        after = int(np.searchsorted(self.times_ns, time_ns))  # first pose at or after the time
        if after < count and self.times_ns[after] == time_ns:
            return self.poses[after]
        if after in (0, count) or self.times_ns[after] - self.times_ns[after - 1] > self.gap_ns:
            if self.holds and after > 0:
                return self.poses[after - 1]
            return self._nearest_pose(time_ns)
        start_ns = int(self.times_ns[after - 1])
        end_ns = int(self.times_ns[after])
        start_pose = self.poses[after - 1]
        end_pose = self.poses[after]
        share = (time_ns - start_ns) / (end_ns - start_ns)
        # Positions are interpolated linearly. The rotation is then replaced, because the weighted
        # mean of two rotation matrices is no rotation.
        pose = (1 - share) * start_pose + share * end_pose
        rotations = Rotation.from_matrix([start_pose[:3, :3], end_pose[:3, :3]])
        pose[:3, :3] = Slerp([0.0, 1.0], rotations)(share).as_matrix()
        return pose

    def _nearest_pose(self, time_ns: int) -> np.ndarray | None:
        """Pose at most a tenth of ``gap_ns`` from a time; None if there is none. (4, 4)"""
        distances_ns = np.abs(self.times_ns - time_ns)
        nearest = int(distances_ns.argmin())
        return self.poses[nearest] if distances_ns[nearest] <= self.gap_ns // 10 else None


@dataclass(frozen=True)
class RigFrame:
    """Images of the cameras at one time.

    Args:
        token: Unique name.
        time_ns: Time of the frame in nanoseconds.
        images: Path relative to the data root, and time in nanoseconds, of the image of each
            camera, by its name. Cameras without an image are left out.
    """

    token: str
    time_ns: int
    images: Mapping[str, tuple[str, int]]


def nearest_images(
    times_ns: Mapping[str, np.ndarray], wanted_ns: Sequence[int], tolerance_ns: int
) -> list[dict[str, int]]:
    """Find the image of each camera that is nearest to each wanted time, within a tolerance.

    Args:
        times_ns: Times of the images in nanoseconds by camera, ascending. each (n,)
        wanted_ns: Wanted times in nanoseconds. (m,)
        tolerance_ns: Largest difference of the times in nanoseconds.

    Returns:
        For each wanted time, the times of the images by camera. Cameras without an image within the
        tolerance are left out. (m,)
    """
    frames = []
    for wanted in wanted_ns:
        nearest = {}
        for name, times in times_ns.items():
            time = closest_ns(times, wanted, tolerance_ns=tolerance_ns)
            if time is not None:
                nearest[name] = time
        frames.append(nearest)
    return frames


def motion_notes(frames: Sequence[RigFrame], pose_at: PoseAt | None) -> list[str]:
    """Notes on cameras whose motion between image and frame is unknown, so that it is neglected.

    Args:
        frames: Images of the cameras at each time. If there are poses, each frame has one.
        pose_at: Pose of the vehicle at a time in nanoseconds; None if poses are not known.

    Returns:
        A line for each camera with images without a pose.
    """
    counts: Counter[str] = Counter()
    for frame in frames:
        for name, (_, time_ns) in frame.images.items():
            if abs(time_ns - frame.time_ns) > _SAME_TIME_NS:
                counts[name] += pose_at is None or pose_at(time_ns) is None
    notes = []
    for name, count in counts.items():
        if count:
            notes.append(
                f"camera {name!r}: no pose is near the time of its image at {count} of "
                f"{format_count(len(frames), 'sample')}: the motion in between is neglected"
            )
    return notes


def rig_samples(
    scene: str, rig: Sequence[RigCamera], frames: Sequence[RigFrame], pose_at: PoseAt | None
) -> list[MapSample]:
    """Create the samples of a drive, in the annotation frame ``ego``.

    Args:
        scene: Name of the drive.
        rig: Cameras of the vehicle.
        frames: Images of the cameras at each time.
        pose_at: Pose of the ground below the vehicle at a time in nanoseconds; frames for which it
            returns None are left out. None if poses are not known.

    Returns:
        The samples.

    Raises:
        ValueError: If a value is invalid, such as a name that leads out of a folder.
    """
    samples = []
    for frame in frames:
        pose = None
        if pose_at is not None:
            pose = pose_at(frame.time_ns)
            if pose is None:
                continue
        cameras = []
        for camera in rig:
            if camera.name not in frame.images:
                continue
            path, time_ns = frame.images[camera.name]
            image_pose = None if pose_at is None else pose_at(time_ns)
            cam_from_ground = camera.cam_from_ground
            # The vehicle moves between the time of the frame and the time of the image.
            # If the pose at either time is unknown, this motion is neglected (`motion_notes`).
            if image_pose is not None and pose is not None:
                cam_from_ground = cam_from_ground @ invert_rigid(image_pose) @ pose
            width, height = camera.size_px
            record = CameraRecord(
                name=camera.name,
                path=path,
                width=width,
                height=height,
                intrinsics=camera.rectified_intrinsics,
                cam_from_frame=cam_from_ground,
            )
            cameras.append(record)
        # Converts the transforms from the ground to the frame ``ego``.
        sample = sample_in_vehicle(
            token=frame.token,
            scene=scene,
            timestamp_ns=frame.time_ns,
            cameras=cameras,
            global_from_ground=pose,
        )
        samples.append(sample)
    # The samples must meet the rules for annotation files, although no file is written here.
    check_samples(samples, AnnotationMeta(dataset="recording", frame="ego", split="test"))
    return samples
