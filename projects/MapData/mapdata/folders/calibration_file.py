"""Calibration file of the cameras on a vehicle, in YAML or JSON (docs/inference.md)."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from gsmap.datasets.errors import explain_errors
from gsmap.datasets.image_files import image_size
from gsmap.structures.rigid import invert_rigid, is_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_text
from mapdata.folders.poses import read_poses
from mapdata.folders.rig import PoseTrack, RigCamera, rotation_of
from mapdata.paths import path_below

NAMES = ("calibration.yaml", "calibration.yml", "calibration.json")
# Keys of a file and of each of its cameras, which docs/inference.md describes.
_KEYS = {"cameras", "ground_z_m", "poses", "rate_hz", "max_time_difference_ms"}
_BAG_VALUES = ("poses", "rate_hz", "max_time_difference_ms")  # keys that a bag replaces
_CAMERA_KEYS = {
    "images", "intrinsics", "distortion", "distortion_model", "vehicle_from_camera", "position_m",
    "quaternion_wxyz", "yaw_pitch_roll_deg", "size_px",
}  # fmt: skip
# Rotation of a camera that looks ahead: from camera axes (right, down, ahead) to vehicle axes
# (ahead, left, up).
_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_MOST_BYTES = 300_000  # size limit of a file; parsing YAML takes some milliseconds per 1,000 bytes
_MOST_VALUES = 100_000  # largest number of values in a file


def read_rig(
    file: Path, ground_z_m: float | None
) -> tuple[list[tuple[RigCamera, str]], np.ndarray, list[str]]:
    """Read the cameras of a calibration file for the images of a bag.

    Args:
        file: Calibration file, in which each camera has ``size_px``.
        ground_z_m: Height of the road in the vehicle's frame in metres, for a file without
            ``ground_z_m``; None is 0.

    Returns:
        The cameras, each with the value of its key ``images`` (the topic in a bag, empty without
        the key); the pose of the road in the vehicle's frame (4, 4); and a note if there are keys
        that have no effect.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is malformed, or both it and the argument have the height of the
            road; the message names the camera.
    """
    rig = []
    # Adds the name of the file and the remedy to the message of an error, as a ValueError.
    with explain_errors(file, remedy="see docs/inference.md"):
        content = read_calibration(file)
        if ground_z_m is not None:
            if "ground_z_m" in content:
                raise InputError(
                    "it has ground_z_m, and --vehicle-ground-z is given, too: leave out one"
                )
            content["ground_z_m"] = ground_z_m
        ground = ground_pose(content)
        for name, camera in cameras_of(content):
            with explain_errors(f"{file}, camera {name!r}", remedy="see docs/inference.md"):
                check_camera_keys(camera)
                if "size_px" not in camera:
                    raise InputError("a camera of a bag needs size_px: [width, height]")
                rig_camera = create_camera(name, camera, ground=ground, images=())
                rig.append((rig_camera, str(camera.get("images", ""))))
        unused_keys = [name for name in _BAG_VALUES if name in content]
        notes = []
        if unused_keys:
            names = ", ".join(unused_keys)
            notes.append(f"{file.name}: {names} not used, since poses and times are the bag's")
        return rig, ground, notes


def read_vehicle(
    file: Path, images: Mapping[str, Sequence[Path]], time_of: Mapping[str, int | None]
) -> tuple[list[RigCamera], PoseTrack | None]:
    """Read the cameras and the poses of a calibration file for given images.

    Args:
        file: Calibration file. The path of its ``poses`` is relative to its folder.
        images: Images by the camera's name. Cameras of the file without images are left out.
        time_of: Times of the images in nanoseconds, by their names without suffix. None if images
            of different times have this name.

    Returns:
        The cameras, and the poses of the road below the vehicle, None if the file has no poses.

    Raises:
        FileNotFoundError: If there is no calibration file, or no file of poses.
        ValueError: If the file is malformed; the message names the camera.
    """
    rig = []
    with explain_errors(file, remedy="see docs/inference.md"):
        content = read_calibration(file)
        ground = ground_pose(content)
        for name, camera in cameras_of(content):
            if name not in images:
                continue
            with explain_errors(f"{file}, camera {name!r}", remedy="see docs/inference.md"):
                check_camera_keys(camera)
                rig.append(create_camera(name, camera, ground=ground, images=images[name]))
        poses = read_named_poses(content, folder=file.parent, time_of=time_of, ground=ground)
        return rig, poses


class _Loader(yaml.SafeLoader):
    """YAML loader that refuses merge keys (``<<``), which can expand without a limit."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Do nothing, instead of replacing merge keys by the keys of the mapping that they name.

        PyYAML then raises a ``YAMLError``, as it cannot construct a merge key itself.
        """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; repeated keys raise a ``ValueError``."""
        _refuse_repeats([key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)])
        return super().construct_mapping(node, deep)


def _refuse_repeats(names: Sequence[Any]) -> None:
    """Raise a ``ValueError`` if a name repeats, because only its last value would be kept."""
    repeats = sorted(str(name) for name, count in Counter(names).items() if count > 1)
    if repeats:
        raise InputError(f"{', '.join(repeats)} is there twice: remove or rename one")


def _construct_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Construct an object of JSON; repeated keys raise a ``ValueError``."""
    _refuse_repeats([name for name, _ in pairs])
    return dict(pairs)


def _read_values(file: Path) -> Any:
    """Parse a calibration file, within limits of the file size and of the number of values."""
    if file.stat().st_size > _MOST_BYTES:
        raise InputError(f"it has more than {_MOST_BYTES} bytes, which no calibration takes")
    text = read_text(file)
    try:
        if file.suffix == ".json":
            content = json.loads(text, object_pairs_hook=_construct_object)
        else:
            content = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise InputError(f"it is no YAML: {error}") from error
    values = [content]
    # The list grows during the loop by the values inside of each value. YAML aliases can repeat a
    # value many times, so the number is limited.
    for value in values:
        if isinstance(value, dict):
            values += value.values()
        elif isinstance(value, list):
            values += value
        if len(values) > _MOST_VALUES:
            raise InputError(f"it holds more than {_MOST_VALUES} values")
    return content


def read_calibration(file: Path) -> dict[str, Any]:
    """Read the content of a calibration file. The keys of its cameras are not checked.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is malformed or too large, or has unknown keys.
    """
    content = _read_values(file)
    _check_keys(content, known_keys=_KEYS, noun="a calibration file")
    if not isinstance(content.get("cameras"), dict) or not content["cameras"]:
        raise InputError("`cameras` must map names to cameras, at least one")
    return dict(content)


def cameras_of(content: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and entry of each camera of a calibration file."""
    for name, camera in content["cameras"].items():
        yield str(name), camera


def check_camera_keys(camera: Any) -> None:
    """Raise a ``ValueError`` if the entry of a camera is no mapping, or has unknown keys."""
    _check_keys(camera, known_keys=_CAMERA_KEYS, noun="a camera")


def _check_keys(value: Any, known_keys: set[str], noun: str) -> None:
    if not isinstance(value, Mapping):
        raise InputError(f"{noun} must be a mapping, got {value!r:.60}")
    unknown = sorted(map(str, set(value) - known_keys))
    if unknown:
        raise InputError(f"unknown keys {unknown}; {noun} may have {sorted(known_keys)}")


def ground_pose(content: Mapping[str, Any]) -> np.ndarray:
    """Pose of the road in the vehicle's frame, from ``ground_z_m`` of a calibration. (4, 4)"""
    return rigid(rotation=np.eye(3), translation=(0, 0, float(content.get("ground_z_m", 0.0))))


def read_named_poses(
    content: Mapping[str, Any], folder: Path, time_of: Mapping[str, int | None], ground: np.ndarray
) -> PoseTrack | None:
    """Read the poses that a calibration file names.

    Args:
        content: Content of the calibration file.
        folder: Folder of the calibration file.
        time_of: Times of the images in nanoseconds, by their names without suffix. None if images
            of different times have this name.
        ground: Pose of the road in the vehicle's frame, in metres. (4, 4)

    Returns:
        Poses of the road below the vehicle; None if the file names no poses.

    Raises:
        FileNotFoundError: If there is no file of poses.
        ValueError: If the path leads out of the folder, or the file of poses is malformed.
    """
    if not content.get("poses"):
        return None
    path = path_below(folder, str(content["poses"]), noun="poses")
    return read_poses(path, time_of=time_of, ground=ground)


def create_camera(
    name: str, camera: Mapping[str, Any], ground: np.ndarray, images: Sequence[Path]
) -> RigCamera:
    """Create a camera from its entry in a calibration file.

    Args:
        name: Name of the camera.
        camera: Entry of the camera, with known keys.
        ground: Pose of the road in the vehicle's frame, in metres. (4, 4)
        images: Images of the camera, for its size if the entry has no ``size_px``.

    Returns:
        The camera.

    Raises:
        ValueError: If a value is malformed. Missing keys and values of a wrong type raise the
            errors of Python, such as a KeyError, which the callers convert by `explain_errors`.
    """
    intrinsics = np.array(camera["intrinsics"], dtype=np.float64)
    if intrinsics.shape == (4,):
        fx, fy, cx, cy = intrinsics
        intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if intrinsics.shape != (3, 3):
        raise InputError(f"intrinsics must be [fx, fy, cx, cy] or 3 x 3, got {intrinsics.shape}")
    width, height = camera.get("size_px") or _size_of(images, where=f"camera {name!r}")
    return RigCamera(
        name=name,
        intrinsics=intrinsics,
        cam_from_ground=invert_rigid(_vehicle_from_camera(camera)) @ ground,  # through the vehicle
        size_px=(int(width), int(height)),
        distortion=np.array(camera.get("distortion", ()), dtype=np.float64),
        model=str(camera.get("distortion_model", "")),
    )


def _size_of(images: Sequence[Path], where: str) -> tuple[int, int]:
    """Size of the first readable image. If there is none, the error of the last image is raised."""
    for path in images[:-1]:
        with suppress(ValueError):
            return image_size(path, where)
    return image_size(images[-1], where)


def _vehicle_from_camera(camera: Mapping[str, Any]) -> np.ndarray:
    """Transform from a camera (right, down, ahead) to the vehicle (ahead, left, up). (4, 4)"""
    # Each of these keys gives the rotation, so exactly one of them is needed.
    rotation_keys = {"vehicle_from_camera", "quaternion_wxyz", "yaw_pitch_roll_deg"} & set(camera)
    if len(rotation_keys) != 1:
        raise InputError(
            "say its place by vehicle_from_camera (4 x 4), or by position_m with either "
            f"quaternion_wxyz or yaw_pitch_roll_deg; got {sorted(rotation_keys) or 'none of them'}"
        )
    if "vehicle_from_camera" in camera:
        if "position_m" in camera:
            raise InputError("vehicle_from_camera contains the position: leave position_m out")
        pose = np.array(camera["vehicle_from_camera"], dtype=np.float64)
        # `is_rigid` also refuses a mirroring matrix. The first test gives it a message of its kind.
        if pose.shape == (4, 4) and np.linalg.det(pose[:3, :3]) < 0:
            raise InputError(
                "vehicle_from_camera mirrors (its rotation's determinant is below 0): two axes are "
                "swapped, or one has the wrong sign"
            )
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError("vehicle_from_camera must be a rotation with a translation, 4 x 4")
        return pose
    if "quaternion_wxyz" in camera:
        rotation = rotation_of(camera["quaternion_wxyz"])  # from camera axes to vehicle axes
    else:
        # The angles turn a camera that looks ahead: yaw about z, then pitch about the new y, then
        # roll about the new x.
        turn = Rotation.from_euler("ZYX", camera["yaw_pitch_roll_deg"], degrees=True)
        rotation = turn.as_matrix() @ _AHEAD
    return rigid(rotation, translation=camera["position_m"])
