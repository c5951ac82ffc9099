"""Samples of a folder of images with one calibration file (docs/inference.md)."""

import csv
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.errors import BrokenSampleError, naming
from gsmap.datasets.image_files import image_size, read_image
from gsmap.inputs.rig import PoseTrack, RigCamera, RigFrame, nearest_images, rig_samples
from gsmap.structures.rigid import invert_rigid, is_rigid, rigid
from gsmap.utils.files import write_bytes

NAMES = ("calibration.yaml", "calibration.yml", "calibration.json")
_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
_KEYS = {"cameras", "ground_z_m", "poses", "rate_hz", "max_time_difference_ms"}
_CAMERA_KEYS = {
    "images", "intrinsics", "distortion", "distortion_model", "vehicle_from_camera", "position_m",
    "quaternion_wxyz", "yaw_pitch_roll_deg", "size_px",
}  # fmt: skip
# A camera's axes (right, down, ahead) in a vehicle's (ahead, left, up).
_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_TIME = re.compile(r"(?:^|\D)(\d{10}(?:\d{3}|\d{6}|\d{9})?)(?:\.(\d{1,9}))?$")


def read_image_folder(file: Path, frames_dir: Path) -> tuple[list[MapSample], bool, Path]:
    """Read the samples that a calibration file describes, in the frame ``ego``.

    Args:
        file: The calibration file, YAML or JSON. Its paths start from its folder.
        frames_dir: Folder for images without their distortion, made where a camera has one.

    Returns:
        The samples, whether they have poses, and the folder that their paths start from.

    Raises:
        FileNotFoundError: If a camera has no image, or there is no file of poses.
        ValueError: If the file is malformed; the message names the camera.
    """
    with naming(file, "see docs/inference.md"):
        text = file.read_text(encoding="utf-8")
        content = json.loads(text) if file.suffix == ".json" else yaml.safe_load(text)
        _require_keys(content, _KEYS, "a calibration file")
        if not isinstance(content.get("cameras"), dict) or not content["cameras"]:
            raise ValueError("`cameras` must map names to cameras, at least one")
        ground = rigid(np.eye(3), (0, 0, float(content.get("ground_z_m", 0.0))))
        rig, images = [], {}
        for name, camera in content["cameras"].items():
            with naming(f"{file}, camera {name!r}", "see docs/inference.md"):
                _require_keys(camera, _CAMERA_KEYS, "a camera")
                images[str(name)] = _images_of(file.parent, str(name), camera)
                rig.append(_camera(str(name), camera, ground, images[str(name)]))
        rate_hz = float(content.get("rate_hz", 10.0))
        tolerance_ns = round(float(content.get("max_time_difference_ms", 50.0)) * 1e6)
        frames, time_of = _frames(images, rate_hz, tolerance_ns, file)
        pose_at = None
        if content.get("poses"):
            pose_at = _read_poses(file.parent / content["poses"], time_of, ground).at
        root = file.parent
        if any(camera.is_distorted for camera in rig):
            root = frames_dir
            frames = [_rectified(frame, rig, file.parent, root) for frame in frames]
        return (
            rig_samples(file.parent.resolve().name, rig, frames, pose_at),
            pose_at is not None,
            root,
        )


def _require_keys(value: Any, known: set[str], what: str) -> None:
    if not isinstance(value, Mapping):
        raise ValueError(f"{what} must be a mapping, got {value!r:.60}")
    if set(value) - known:
        unknown = sorted(map(str, set(value) - known))
        raise ValueError(f"unknown keys {unknown}; {what} may have {sorted(known)}")


def _images_of(folder: Path, name: str, camera: Mapping[str, Any]) -> list[Path]:
    """Return a camera's images in the order of their names."""
    pattern = str(camera.get("images", name))
    place = folder / pattern
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise ValueError(f"images must lie below the calibration file's folder, got {pattern!r}")
    found = place.iterdir() if place.is_dir() else folder.glob(pattern)
    paths = sorted(path for path in found if path.suffix.lower() in _SUFFIXES)
    if not paths:
        raise FileNotFoundError(
            f"camera {name!r} has no image at {place}: `images` names a file, a folder or a "
            "pattern, from the calibration file's folder (by default the camera's name)."
        )
    return paths


def _camera(
    name: str, camera: Mapping[str, Any], ground: np.ndarray, images: Sequence[Path]
) -> RigCamera:
    """Read a camera's calibration."""
    given = np.array(camera["intrinsics"], np.float64)
    if given.shape == (4,):
        fx, fy, cx, cy = given
        given = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if given.shape != (3, 3):
        raise ValueError(f"intrinsics must be [fx, fy, cx, cy] or 3 x 3, got {given.shape}")
    width, height = camera.get("size_px") or image_size(images[0], f"camera {name!r}")
    return RigCamera(
        name,
        given,
        invert_rigid(_mounting(camera)) @ ground,
        (int(width), int(height)),
        np.array(camera.get("distortion", ()), np.float64),
        str(camera.get("distortion_model", "")),
    )


def _mounting(camera: Mapping[str, Any]) -> np.ndarray:
    """Return where a camera stands and looks in the vehicle. (4, 4)"""
    ways = {"vehicle_from_camera", "quaternion_wxyz", "yaw_pitch_roll_deg"} & set(camera)
    if len(ways) != 1:
        raise ValueError(
            "say its place by vehicle_from_camera (4 x 4), or by position_m with either "
            f"quaternion_wxyz or yaw_pitch_roll_deg; got {sorted(ways) or 'none of them'}"
        )
    if "vehicle_from_camera" in camera:
        pose = np.array(camera["vehicle_from_camera"], np.float64)
        if pose.shape == (4, 4) and np.linalg.det(pose[:3, :3]) < 0:
            raise ValueError(
                "vehicle_from_camera mirrors (its rotation's determinant is below 0): two axes are "
                "swapped, or one has the wrong sign"
            )
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise ValueError("vehicle_from_camera must be a rotation with a translation, 4 x 4")
        return pose
    if "quaternion_wxyz" in camera:
        rotation = _turn(camera["quaternion_wxyz"])
    else:
        turn = Rotation.from_euler("ZYX", camera["yaw_pitch_roll_deg"], degrees=True)
        rotation = turn.as_matrix() @ _AHEAD
    return rigid(rotation, camera["position_m"])


def _turn(wxyz: Sequence[Any]) -> np.ndarray:
    """Return the rotation of a quaternion, which must have length 1. (3, 3)"""
    w, x, y, z = (float(value) for value in wxyz)
    if not abs(np.linalg.norm([w, x, y, z]) - 1) < 1e-2:
        raise ValueError(f"a quaternion must have length 1, got {[w, x, y, z]}")
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def _time_ns(stem: str) -> int | None:
    """Read the Unix time at the end of a file's name: s, ms, us, ns, or s with a fraction."""
    found = _TIME.search(stem)
    if found is None:
        return None
    whole, fraction = found[1], found[2]
    if fraction is not None and len(whole) > 10:
        return None
    return int(whole) * 10 ** (19 - len(whole)) + int((fraction or "0").ljust(9, "0"))


def _frames(
    images: Mapping[str, list[Path]], rate_hz: float, tolerance_ns: int, file: Path
) -> tuple[list[RigFrame], dict[str, int]]:
    """Put images of one time together: by the times in their names, or by equal names.

    Returns:
        The frames, and the time of each file name that has one.
    """
    root, scene = file.parent, file.parent.resolve().name
    time_of = {path.stem: _time_ns(path.stem) for paths in images.values() for path in paths}
    known = {stem: time_ns for stem, time_ns in time_of.items() if time_ns is not None}
    if len(known) == len(time_of):
        at = {name: {known[path.stem]: path for path in paths} for name, paths in images.items()}
        times = {name: np.array(sorted(found), np.int64) for name, found in at.items()}
        wanted = next(iter(times.values())).tolist()
        groups = [
            (str(time_ns), time_ns, {name: (at[name][t], t) for name, t in nearest.items()})
            for time_ns, nearest in zip(
                wanted, nearest_images(times, wanted, tolerance_ns), strict=True
            )
        ]
    elif all(len(paths) == 1 for paths in images.values()):
        known = {paths[0].stem: 0 for paths in images.values()}
        groups = [("0", 0, {name: (paths[0], 0) for name, paths in images.items()})]
    else:
        stems = [path.stem for path in next(iter(images.values()))]
        known = {stem: round(i * 1e9 / rate_hz) for i, stem in enumerate(stems)}
        named = {name: {path.stem: path for path in paths} for name, paths in images.items()}
        groups = [
            (stem, known[stem], {n: (p[stem], known[stem]) for n, p in named.items() if stem in p})
            for stem in stems
        ]
    frames = [
        RigFrame(
            f"{scene}_{label}",
            time_ns,
            {name: (path.relative_to(root).as_posix(), t) for name, (path, t) in found.items()},
        )
        for label, time_ns, found in groups
    ]
    return frames, known


def _read_poses(path: Path, time_of: Mapping[str, int], ground: np.ndarray) -> PoseTrack:
    """Read a CSV file with x, y, z, qw, qx, qy, qz, and timestamp_ns or frame (a file's name)."""
    if not path.is_file():
        raise FileNotFoundError(f"There is no file of poses {path}.")
    times, poses = [], []
    with naming(path, "see docs/inference.md"), path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if "frame" in row and row["frame"] not in time_of:
                continue
            times.append(time_of[row["frame"]] if "frame" in row else int(row["timestamp_ns"]))
            turn = _turn([row[f"q{axis}"] for axis in "wxyz"])
            poses.append(rigid(turn, [float(row[axis]) for axis in "xyz"]) @ ground)
        return PoseTrack(times, poses)


def _rectified(frame: RigFrame, rig: Sequence[RigCamera], root: Path, target: Path) -> RigFrame:
    """Write a frame's images without distortion; a damaged one goes along, to be named later."""
    images = {}
    for camera in (camera for camera in rig if camera.name in frame.images):
        path, time_ns = frame.images[camera.name]
        images[camera.name] = f"{camera.name}/{Path(path).stem}.jpg", time_ns
        written = target / images[camera.name][0]
        if written.is_file():
            continue
        try:
            image = read_image(str(root / path), f"camera {camera.name}", camera.size_px)
            camera.write_image(written, image)
        except BrokenSampleError:
            write_bytes(written, (root / path).read_bytes())
    return RigFrame(frame.token, frame.time_ns, images)
