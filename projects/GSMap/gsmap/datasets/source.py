"""Samples of any origin, and their transformation to another annotation frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CameraRecord, LidarRecord, MapSample
from gsmap.structures.frames import frame_view
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class Source:
    """Samples of one origin.

    Args:
        samples: Samples. An `AnnotationFile` reads each sample when it is accessed.
        frame: Annotation frame of the samples, ``lidar`` (x right, y ahead) or ``ego`` (x ahead, y
            left).
        data_root: Folder that image and LiDAR paths are relative to; None for the folder in the
            config.
        has_poses: Whether the pose of the vehicle is known.
        notes: Messages for the user from the code that has read the samples.
        ground_z_m: Height of the road in the frame in metres; None for the usual height.
    """

    samples: Sequence[MapSample]
    frame: str
    data_root: Path | None
    has_poses: bool = True
    notes: tuple[str, ...] = ()
    ground_z_m: float | None = None


def open_annotations(path: str | Path, data_root: Path | None = None) -> Source:
    """Open an annotation file as a source.

    Args:
        path: Annotation file.
        data_root: Folder that image and LiDAR paths are relative to. By default the folder of the
            file if the first image exists there, else the folder in the config.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not an annotation file, or is damaged.
    """
    if Path(path).suffix != ".arrow":
        raise InputError(
            f"{path} is no annotation file (.arrow): open other recordings with "
            "mapdata.inputs.open_input and pass its result."
        )
    annotations = AnnotationFile(path)
    cameras = annotations[0].cameras if len(annotations) else []
    if data_root is None and cameras:
        folder = annotations.path.parent
        if (folder / cameras[0].path).is_file():
            data_root = folder
    meta = annotations.meta
    return Source(
        annotations,
        frame=meta.frame,
        data_root=data_root,
        has_poses=meta.has_poses,
        ground_z_m=meta.ground_z_m,
    )


_HEIGHT_TOLERANCE_M = 1e-3  # smaller differences of the height of the road are ignored


def _shift_up(height_m: float) -> np.ndarray:
    """Return the transform that adds a height to z. (4, 4)"""
    return rigid(np.eye(3), translation=(0, 0, height_m))


# Transform from each annotation frame to axes (x ahead, y left, z up) with their origin above the
# rear axle, at the height of the frame. ``lidar`` is the roof LiDAR of nuScenes, and ``ego`` is the
# vehicle frame of Argoverse 2. (4, 4)
_NOMINAL = {
    "lidar": np.array([[0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    "ego": np.eye(4),
}


def usual_mount(frame: str, ground_z_m: float | None = None) -> np.ndarray:
    """Return the transform from an annotation frame at its usual place to the ground.

    The sensor is assumed to be level.

    Args:
        frame: ``lidar``, a roof LiDAR mounted like in nuScenes, or ``ego``.
        ground_z_m: Height of the road in the frame in metres; None for the usual height.

    Returns:
        Transform in metres to the ground below the rear axle (x ahead, y left, z up). (4, 4)
    """
    # The view of a frame contains its ground plane z = a x + b y + c as (a, b, c). The plane is
    # level here, so c is z of the road in the annotation frame.
    road_z_m = frame_view(frame, ground_z_m).ground[2]
    return _shift_up(-road_z_m) @ _NOMINAL[frame]


def ground_from_frame(sample: MapSample, frame: str, ground_z_m: float | None = None) -> np.ndarray:
    """Return the transform from the annotation frame of a sample to the ground.

    Args:
        sample: Sample, whose ``ego_from_frame`` is the mounting of the sensor if it is known.
        frame: Annotation frame of the sample, ``lidar`` or ``ego``.
        ground_z_m: Height of the road in the frame in metres; None for the usual height.

    Returns:
        Transform in metres to the ground below the rear axle (x ahead, y left, z up). (4, 4)
    """
    if sample.ego_from_frame is None:
        return usual_mount(frame, ground_z_m)
    road_in_ego_m = frame_view(frame, ground_z_m).ego_ground_z_m  # z of the road in the ego frame
    return _shift_up(-road_in_ego_m) @ sample.ego_from_frame


@dataclass(frozen=True)
class Mount:
    """Place of the annotation frame of a model in the vehicle that recorded the training data.

    Args:
        frame: Annotation frame, ``lidar`` or ``ego``.
        ground_z_m: Height of the road in the frame in metres; None for the usual height.
        ground_from_frame: Transform in metres from the frame to the ground below the rear axle (x
            ahead, y left, z up); None for the usual transform. (4, 4)
    """

    frame: str
    ground_z_m: float | None = None
    ground_from_frame: np.ndarray | None = None

    @property
    def matrix(self) -> np.ndarray:
        """Transform from the frame to the ground in metres. (4, 4)"""
        if self.ground_from_frame is None:
            return usual_mount(self.frame, self.ground_z_m)
        return self.ground_from_frame

    @property
    def ego_from_frame(self) -> np.ndarray:
        """Transform from the frame to the vehicle in metres. (4, 4)"""
        # `matrix` leads to the ground, whose height in the frame of the vehicle is then added.
        road_in_ego_m = frame_view(self.frame, self.ground_z_m).ego_ground_z_m
        return _shift_up(road_in_ego_m) @ self.matrix

    def suits(self, frame: str, ground_z_m: float | None) -> bool:
        """Test whether samples need no transformation for the model.

        All ``lidar`` frames suit each other. An unknown height of the road counts as the usual one.

        Args:
            frame: Annotation frame of the samples, ``lidar`` or ``ego``.
            ground_z_m: Height of the road in the frame in metres; None for the usual height.
        """
        if frame != self.frame:
            return False
        if frame == "lidar":
            return True
        sample_road_z_m = frame_view(frame, ground_z_m).ground[2]
        model_road_z_m = frame_view(frame, self.ground_z_m).ground[2]
        return abs(sample_road_z_m - model_road_z_m) < _HEIGHT_TOLERANCE_M


def frame_from_mount(
    sample: MapSample, frame: str, mount: Mount, ground_z_m: float | None = None
) -> np.ndarray:
    """Return the transform from the annotation frame of a model to that of a sample.

    Args:
        sample: Sample.
        frame: Annotation frame of the sample, ``lidar`` or ``ego``.
        mount: Annotation frame of the model, and its place in the vehicle.
        ground_z_m: Height of the road in ``frame`` in metres; None for the usual height.

    Returns:
        Transform in metres. (4, 4)
    """
    ground_from_sample = ground_from_frame(sample, frame=frame, ground_z_m=ground_z_m)
    return invert_rigid(ground_from_sample) @ mount.matrix


def change_frame(
    sample: MapSample, frame: str, wanted: str | Mount, ground_z_m: float | None = None
) -> MapSample:
    """Transform the calibration of a sample to another annotation frame.

    The new frame has the place in the vehicle that it had in the training data of a model. If both
    frames are ``lidar`` frames, the sample does not change: all roof LiDARs are treated as equal.

    Args:
        sample: Sample.
        frame: Annotation frame of the sample, ``lidar`` or ``ego``.
        wanted: Annotation frame of the result: the `Mount` of a model, or a name, ``lidar`` or
            ``ego``, for the frame at its usual place in the vehicle.
        ground_z_m: Height of the road in ``frame`` in metres; None for the usual height.

    Returns:
        Sample in the new frame, without ground truth, which is not transformed. If no
        transformation is needed, ``sample`` itself with its ground truth.
    """
    mount = Mount(wanted) if isinstance(wanted, str) else wanted
    if mount.suits(frame, ground_z_m):
        return sample
    frame_from_new = frame_from_mount(sample, frame=frame, mount=mount, ground_z_m=ground_z_m)
    lidar = sample.lidar
    if lidar is not None:
        lidar = _transform_lidar(lidar, new_from_frame=invert_rigid(frame_from_new))
    return replace(
        sample,
        cameras=_transform_cameras(sample.cameras, frame_from_new),
        lidar=lidar,
        global_from_frame=sample.global_from_frame @ frame_from_new,
        ego_from_frame=mount.ego_from_frame,
        instances=None,
    )


def _transform_cameras(
    cameras: Sequence[CameraRecord], frame_from_new: np.ndarray
) -> list[CameraRecord]:
    """Return cameras whose extrinsics start from a new frame.

    ``frame_from_new`` is the transform from the new frame to the present one. (4, 4)
    """
    new_cameras = []
    for camera in cameras:
        cam_from_new = camera.cam_from_frame @ frame_from_new
        new_cameras.append(replace(camera, cam_from_frame=cam_from_new))
    return new_cameras


def _transform_lidar(lidar: LidarRecord, new_from_frame: np.ndarray) -> LidarRecord:
    """Return a LiDAR sweep whose transforms, and those in its list of sweeps, end in a new frame.

    ``new_from_frame`` is the transform from the present frame to the new one. (4, 4)
    """
    sweeps = []
    for sweep in lidar.sweeps:
        new_from_lidar = new_from_frame @ sweep.frame_from_lidar
        sweeps.append(replace(sweep, frame_from_lidar=new_from_lidar))
    new_from_lidar = new_from_frame @ lidar.frame_from_lidar
    return replace(lidar, frame_from_lidar=new_from_lidar, sweeps=sweeps)


def sample_in_vehicle(
    token: str,
    scene: str,
    timestamp_ns: int,
    cameras: list,
    global_from_ground: np.ndarray | None,
) -> MapSample:
    """Create a sample in the frame ``ego`` from cameras on a vehicle.

    Args:
        token: Unique name of the sample.
        scene: Name of the drive.
        timestamp_ns: Time in nanoseconds.
        cameras: Cameras whose ``cam_from_frame`` starts from the ground below the rear axle (x
            ahead, y left, z up), in metres.
        global_from_ground: Pose of the ground frame in metres; None if it is not known. (4, 4)
    """
    # The origin of the frame ``ego`` is at its usual height above the ground.
    ground_from_ego = usual_mount("ego")
    global_from_ground = np.eye(4) if global_from_ground is None else global_from_ground
    return MapSample(
        token,
        scene=scene,
        map_name="",
        timestamp_ns=timestamp_ns,
        cameras=_transform_cameras(cameras, ground_from_ego),
        global_from_frame=global_from_ground @ ground_from_ego,
        ego_from_frame=np.eye(4),
    )
