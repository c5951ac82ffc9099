"""Samples of any origin, also seen from another annotation frame: another vehicle's data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.frames import frame_view
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class Source:
    """Samples of one origin.

    Args:
        samples: The samples.
        frame: Their annotation frame, ``lidar`` or ``ego``.
        data_root: Folder that image and LiDAR paths start from; None leaves it to the config.
        has_poses: Whether the vehicle's pose is known.
        notes: What the reader has to say.
        ground_z_m: Height of the road in the frame, as in ``AnnotationMeta``.
    """

    samples: Sequence[MapSample]
    frame: str
    data_root: Path | None
    has_poses: bool = True
    notes: tuple[str, ...] = ()
    ground_z_m: float | None = None


def annotated(path: str | Path, data_root: Path | None = None) -> Source:
    """Open an annotation file as a source.

    Args:
        path: The file.
        data_root: Folder that its paths start from; by default its own where its first image is
            found from there.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no annotation file, or damaged.
    """
    if Path(path).suffix != ".arrow":
        raise InputError(
            f"{path} is no annotation file (.arrow): open other recordings with "
            "mapdata.inputs.open_input and give what it returns."
        )
    annotations = AnnotationFile(path)
    cameras = annotations[0].cameras if len(annotations) else []
    if data_root is None and cameras and (annotations.path.parent / cameras[0].path).is_file():
        data_root = annotations.path.parent
    meta = annotations.meta
    return Source(annotations, meta.frame, data_root, ground_z_m=meta.ground_z_m)


_SAME_M = 1e-3  # heights of the road that differ by less are one


def _raised(height_m: float) -> np.ndarray:
    """Return the transform that adds a height. (4, 4)"""
    return rigid(np.eye(3), (0, 0, height_m))


# From the annotation frame to the ground below the rear axle (x ahead, y left, z up), but for its
# height, as data sets have it: nuScenes' roof LiDAR, and Argoverse 2's vehicle frame.
_NOMINAL = {
    "lidar": np.array([[0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    "ego": np.eye(4),
}


def usual_mount(frame: str, ground_z_m: float | None = None) -> np.ndarray:
    """Return the transform from an annotation frame to the ground, of a level sensor.

    Args:
        frame: ``lidar``, whose sensor stands over the rear axle as nuScenes' does, or ``ego``.
        ground_z_m: Height of the road in the frame, as in ``AnnotationMeta``.

    Returns:
        To a frame with x ahead, y left, z up from the ground, in metres. (4, 4)
    """
    return _raised(-frame_view(frame, ground_z_m).ground[2]) @ _NOMINAL[frame]


def ground_from_frame(sample: MapSample, frame: str, ground_z_m: float | None = None) -> np.ndarray:
    """Return the transform from a sample's annotation frame to the ground below the rear axle.

    Args:
        sample: The sample.
        frame: Its annotation frame, ``lidar`` or ``ego``.
        ground_z_m: Height of the road in the frame, as in ``AnnotationMeta``.

    Returns:
        To a frame with x ahead, y left, z up from the ground, in metres. (4, 4)
    """
    if sample.ego_from_frame is None:
        return usual_mount(frame, ground_z_m)
    return _raised(-frame_view(frame, ground_z_m).ego_ground_z_m) @ sample.ego_from_frame


@dataclass(frozen=True)
class Mount:
    """Where a model's annotation frame lies in the vehicle that it was trained on.

    Args:
        frame: The frame, ``lidar`` or ``ego``.
        ground_z_m: Height of the road in it, as in ``AnnotationMeta``.
        ground_from_frame: From the frame to the ground below the rear axle (x ahead, y left, z up),
            in metres; None is the usual one. (4, 4)
    """

    frame: str
    ground_z_m: float | None = None
    ground_from_frame: np.ndarray | None = None

    @property
    def matrix(self) -> np.ndarray:
        """The transform from the frame to the ground. (4, 4)"""
        if self.ground_from_frame is None:
            return usual_mount(self.frame, self.ground_z_m)
        return self.ground_from_frame

    @property
    def ego_from_frame(self) -> np.ndarray:
        """The transform from the frame to the vehicle, as records have it. (4, 4)"""
        return _raised(frame_view(self.frame, self.ground_z_m).ego_ground_z_m) @ self.matrix

    def suits(self, frame: str, ground_z_m: float | None) -> bool:
        """Whether samples of a frame, with the road at a height in it, are as the model's are.

        Two roof LiDARs are taken for one, and a height that is not known for the usual one.
        """
        if frame != self.frame:
            return False
        heights = [frame_view(frame, z).ground[2] for z in (ground_z_m, self.ground_z_m)]
        return frame == "lidar" or abs(heights[0] - heights[1]) < _SAME_M


def reframed(
    sample: MapSample, frame: str, wanted: str | Mount, ground_z_m: float | None = None
) -> MapSample:
    """Return a sample as it is seen from another annotation frame, without ground truth.

    The new frame lies in the vehicle as in the data that a model was trained on, so that cameras
    and ground are where it expects them. A sample in a LiDAR's frame stays as it is where that kind
    is wanted: two roof LiDARs are taken for one.

    Args:
        sample: The sample.
        frame: Its annotation frame.
        wanted: The frame that the result has, with its place in the vehicle unless that is usual.
        ground_z_m: Height of the road in the sample's frame, as in ``AnnotationMeta``.
    """
    mount = Mount(wanted) if isinstance(wanted, str) else wanted
    if mount.suits(frame, ground_z_m):
        return sample
    here = ground_from_frame(sample, frame, ground_z_m)
    frame_from_new = invert_rigid(here) @ mount.matrix
    cameras = [replace(c, cam_from_frame=c.cam_from_frame @ frame_from_new) for c in sample.cameras]
    new_from_frame, lidar = invert_rigid(frame_from_new), sample.lidar
    if lidar is not None:
        sweeps = [
            replace(s, frame_from_lidar=new_from_frame @ s.frame_from_lidar) for s in lidar.sweeps
        ]
        pose = new_from_frame @ lidar.frame_from_lidar
        lidar = replace(lidar, frame_from_lidar=pose, sweeps=sweeps)
    return replace(
        sample,
        cameras=cameras,
        lidar=lidar,
        global_from_frame=sample.global_from_frame @ frame_from_new,
        ego_from_frame=mount.ego_from_frame,
        instances=None,
    )


def sample_in_vehicle(
    token: str,
    scene: str,
    timestamp_ns: int,
    cameras: list,
    global_from_ground: np.ndarray | None,
) -> MapSample:
    """Make a sample from cameras on a vehicle, in the frame ``ego``.

    Args:
        token: Unique name.
        scene: Name of the drive.
        timestamp_ns: Time in nanoseconds.
        cameras: Cameras whose ``cam_from_frame`` starts from the ground below the vehicle (x
            ahead, y left, z up), in metres.
        global_from_ground: Pose of that frame, or None. (4, 4)
    """
    ground_from_ego = usual_mount("ego")
    pose = np.eye(4) if global_from_ground is None else global_from_ground
    cameras = [replace(c, cam_from_frame=c.cam_from_frame @ ground_from_ego) for c in cameras]
    return MapSample(
        token, scene, "", timestamp_ns, cameras, pose @ ground_from_ego, ego_from_frame=np.eye(4)
    )
