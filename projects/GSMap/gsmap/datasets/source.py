"""Samples of any origin, also seen from another annotation frame: another vehicle's data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.frames import FRAME_VIEWS
from gsmap.structures.rigid import invert_rigid, rigid


@dataclass(frozen=True)
class Source:
    """Samples of one origin.

    Args:
        samples: The samples.
        frame: Their annotation frame, ``lidar`` or ``ego``.
        data_root: Folder that image and LiDAR paths start from; None leaves it to the config.
        has_poses: Whether the vehicle's pose is known.
        notes: What the reader has to say.
    """

    samples: Sequence[MapSample]
    frame: str
    data_root: Path | None
    has_poses: bool = True
    notes: tuple[str, ...] = ()


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
        raise ValueError(
            f"{path} is no annotation file (.arrow): open other recordings with "
            "mapdata.inputs.open_input and give what it returns."
        )
    annotations = AnnotationFile(path)
    cameras = annotations[0].cameras if len(annotations) else []
    if data_root is None and cameras and (annotations.path.parent / cameras[0].path).is_file():
        data_root = annotations.path.parent
    return Source(annotations, annotations.meta.frame, data_root)


def _raised(height_m: float) -> np.ndarray:
    """Return the transform that adds a height. (4, 4)"""
    return rigid(np.eye(3), (0, 0, height_m))


# From the annotation frame to the ground below the rear axle (x ahead, y left, z up), as data sets
# have it: nuScenes' roof LiDAR, and Argoverse 2's vehicle frame.
_NOMINAL = {
    "lidar": np.array([[0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 1.84], [0, 0, 0, 1.0]]),
    "ego": _raised(-FRAME_VIEWS["ego"].ego_ground_z_m),
}


def ground_from_frame(sample: MapSample, frame: str) -> np.ndarray:
    """Return the transform from a sample's annotation frame to the ground below the rear axle.

    Args:
        sample: The sample.
        frame: Its annotation frame, ``lidar`` or ``ego``.

    Returns:
        To a frame with x ahead, y left, z up from the ground, in metres. (4, 4)
    """
    if sample.ego_from_frame is None:
        return _NOMINAL[frame]
    return _raised(-FRAME_VIEWS[frame].ego_ground_z_m) @ sample.ego_from_frame


def reframed(sample: MapSample, frame: str, wanted: str) -> MapSample:
    """Return a sample as it is seen from another annotation frame, without ground truth.

    The new frame lies in the vehicle as in the data set that has it, so that cameras and ground
    are where a model trained there expects them.

    Args:
        sample: The sample.
        frame: Its annotation frame.
        wanted: The frame that the result has; its own leaves the sample as it is.
    """
    if frame == wanted:
        return sample
    frame_from_new = invert_rigid(ground_from_frame(sample, frame)) @ _NOMINAL[wanted]
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
        ego_from_frame=_raised(FRAME_VIEWS[wanted].ego_ground_z_m) @ _NOMINAL[wanted],
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
    ground_from_ego = _NOMINAL["ego"]
    pose = np.eye(4) if global_from_ground is None else global_from_ground
    cameras = [replace(c, cam_from_frame=c.cam_from_frame @ ground_from_ego) for c in cameras]
    return MapSample(
        token, scene, "", timestamp_ns, cameras, pose @ ground_from_ego, ego_from_frame=np.eye(4)
    )
