"""Samples of a folder of images with one calibration file (docs/inference.md)."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.errors import BrokenSampleError, naming
from gsmap.datasets.image_files import image_size, read_image
from gsmap.datasets.source import Source
from gsmap.structures.rigid import invert_rigid, is_rigid, rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name, is_hidden, read_text
from gsmap.utils.words import counted
from mapdata.folders.names import natural_sort_key, times_of_names
from mapdata.folders.poses import read_poses
from mapdata.folders.rig import (
    PoseAt,
    PoseTrack,
    RigCamera,
    RigFrame,
    nearest_images,
    rectify_as_trained,
    rig_samples,
    rotation_of,
)
from mapdata.unix_times import span_of

NAMES = ("calibration.yaml", "calibration.yml", "calibration.json")
_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
_KEYS = {"cameras", "ground_z_m", "poses", "rate_hz", "max_time_difference_ms"}
_CAMERA_KEYS = {
    "images", "intrinsics", "distortion", "distortion_model", "vehicle_from_camera", "position_m",
    "quaternion_wxyz", "yaw_pitch_roll_deg", "size_px",
}  # fmt: skip
# A camera's axes (right, down, ahead) in a vehicle's (ahead, left, up).
_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_RATE_HZ = 10.0  # where a calibration file has no rate_hz
_ANY_TWICE = ("**", "**")
_MOST_ANY = 2  # ``**`` of a pattern, each of which takes the time times the depth of folders
_MOST_BYTES = 300_000  # of a calibration file; YAML takes some milliseconds for a thousand
_MOST_VALUES = 100_000  # in a calibration file


def read_image_folder(
    file: Path, frames_dir: Path, trained: Mapping[str, Sequence[float]] | None = None
) -> Source:
    """Read the samples that a calibration file describes, in the frame ``ego``.

    Args:
        file: The calibration file, YAML or JSON. Its paths start from its folder.
        frames_dir: Folder for folders of images without their distortion, made where a camera has
            one; a folder is named by its images' content and the calibration.
        trained: What they are rectified to, as ``InputOptions`` has it.

    Raises:
        FileNotFoundError: If a camera has no image, or there is no file of poses.
        ValueError: If the file is malformed; the message names the camera.
    """
    with naming(file, "see docs/inference.md"):
        content = _calibration(file)
        ground = _ground_of(content)
        rig, images, notes = [], {}, []
        for name, camera in content["cameras"].items():
            with naming(f"{file}, camera {name!r}", "see docs/inference.md"):
                _require_keys(camera, _CAMERA_KEYS, "a camera")
                images[str(name)], others = _images_of(file.parent, str(name), camera)
                notes += others
                rig.append(_camera(str(name), camera, ground, images[str(name)]))
        rate_hz = float(content["rate_hz"]) if "rate_hz" in content else None
        tolerance_ns = round(float(content.get("max_time_difference_ms", 50.0)) * 1e6)
        if not 0 < (_RATE_HZ if rate_hz is None else rate_hz) < np.inf or tolerance_ns < 0:
            raise InputError("rate_hz must be > 0, and max_time_difference_ms >= 0")
        frames, time_of, assumed = _frames(images, rate_hz, tolerance_ns, file)
        notes += [note for note in (assumed, *_notes_on(frames, images, tolerance_ns)) if note]
        poses = _poses_of(content, file.parent, time_of, ground)
        pose_at = None if poses is None else cache(poses.at)  # asked for by frames and by images
        used, missing = _with_poses(frames, poses, pose_at)
        notes += missing
        target = rectify_as_trained(rig, trained or {})
        scene, root = file.parent.resolve().name, file.parent
        samples = rig_samples(scene, rig, used, pose_at)
        if any(camera.is_distorted for camera in rig):
            root = frames_dir / f"{file_name(scene)}-{_digest(file, frames, target)}"
            notes += chain(*(_rectify(sample, rig, file.parent, root) for sample in samples))
        return Source(samples, "ego", root, poses is not None, tuple(notes))


def read_rig(file: Path, ground: np.ndarray) -> tuple[list[tuple[RigCamera, str]], np.ndarray]:
    """Read the cameras of a calibration file whose images lie elsewhere, such as in a bag.

    Args:
        file: The calibration file; each camera needs ``size_px``.
        ground: Pose of the road in the vehicle's frame, unless the file has ``ground_z_m``. (4, 4)

    Returns:
        The cameras, each with its ``images``, and the road's pose.

    Raises:
        ValueError: If the file is malformed; the message names the camera.
    """
    with naming(file, "see docs/inference.md"):
        content, rig = _calibration(file), []
        if "ground_z_m" in content:
            ground = rigid(np.eye(3), (0, 0, float(content["ground_z_m"])))
        for name, camera in content["cameras"].items():
            with naming(f"{file}, camera {name!r}", "see docs/inference.md"):
                _require_keys(camera, _CAMERA_KEYS, "a camera")
                if "size_px" not in camera:
                    raise InputError("beside a bag it needs size_px: [width, height]")
                rig.append((_camera(str(name), camera, ground, ()), str(camera.get("images", ""))))
        return rig, ground


def read_vehicle(
    file: Path, images: Mapping[str, Sequence[Path]], time_of: Mapping[str, int]
) -> tuple[list[RigCamera], PoseTrack | None]:
    """Read the cameras and the poses of a calibration file whose images are given.

    Args:
        file: The calibration file. Its ``poses`` start from its folder.
        images: Images of each camera that is wanted, by the camera's name; other cameras of the
            file are left out.
        time_of: Times of the images in nanoseconds, by their names without suffix.

    Returns:
        The cameras, and the poses of the ground below the vehicle, None where the file has none.

    Raises:
        FileNotFoundError: If there is no calibration file, or no file of poses.
        ValueError: If the file is malformed; the message names the camera.
    """
    rig = []
    with naming(file, "see docs/inference.md"):
        content = _calibration(file)
        ground = _ground_of(content)
        for name, camera in content["cameras"].items():
            if str(name) not in images:
                continue
            with naming(f"{file}, camera {name!r}", "see docs/inference.md"):
                _require_keys(camera, _CAMERA_KEYS, "a camera")
                rig.append(_camera(str(name), camera, ground, images[str(name)]))
        return rig, _poses_of(content, file.parent, time_of, ground)


def _ground_of(content: Mapping[str, Any]) -> np.ndarray:
    """Pose of the road in the vehicle's frame of a calibration file. (4, 4)"""
    return rigid(np.eye(3), (0, 0, float(content.get("ground_z_m", 0.0))))


def _poses_of(
    content: Mapping[str, Any], folder: Path, time_of: Mapping[str, int], ground: np.ndarray
) -> PoseTrack | None:
    """Read the poses that a calibration file names; None where it names none."""
    if not content.get("poses"):
        return None
    place = _below(folder, str(content["poses"]), "poses")
    return read_poses(place, time_of, ground)


class _Loader(yaml.SafeLoader):
    """Reads YAML without merge keys (``<<``), which can stand for any number of entries."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Leave merge keys, to which an error is raised."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Make a mapping; a key that comes twice, such as a camera's name, is an error."""
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        _require_once(names)
        return super().construct_mapping(node, deep)


def _require_once(names: Sequence[Any]) -> None:
    """Refuse names that come twice: the first one's values would be lost."""
    twice = sorted(str(name) for name, count in Counter(names).items() if count > 1)
    if twice:
        raise InputError(f"{', '.join(twice)} is there twice: remove or rename one")


def _mapping_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a mapping of JSON; a key that comes twice is an error."""
    _require_once([name for name, _ in pairs])
    return dict(pairs)


def _content(file: Path) -> Any:
    """Read a calibration file's values."""
    if file.stat().st_size > _MOST_BYTES:
        raise InputError(f"it has more than {_MOST_BYTES} bytes, which no calibration takes")
    text = read_text(file)
    try:
        if file.suffix == ".json":
            content = json.loads(text, object_pairs_hook=_mapping_once)
        else:
            content = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise InputError(f"it is no YAML: {error}") from error
    values = [content]
    for value in values:  # aliases of YAML stand for any number of them
        values += value.values() if isinstance(value, dict) else ()
        values += value if isinstance(value, list) else ()
        if len(values) > _MOST_VALUES:
            raise InputError(f"it holds more than {_MOST_VALUES} values")
    return content


def _calibration(file: Path) -> dict[str, Any]:
    """Read a calibration file, whose keys are known."""
    content = _content(file)
    _require_keys(content, _KEYS, "a calibration file")
    if not isinstance(content.get("cameras"), dict) or not content["cameras"]:
        raise InputError("`cameras` must map names to cameras, at least one")
    return dict(content)


def _digest(file: Path, frames: Sequence[RigFrame], target: bytes) -> str:
    """Return a digest of a calibration file, all images of frames, and what they become."""
    total = hashlib.sha256(file.read_bytes() + target)
    for frame in frames:
        for path, _ in frame.images.values():
            total.update(f"{path}\n".encode() + (file.parent / path).read_bytes())
    return total.hexdigest()[:16]


def _require_keys(value: Any, known: set[str], what: str) -> None:
    if not isinstance(value, Mapping):
        raise InputError(f"{what} must be a mapping, got {value!r:.60}")
    if set(value) - known:
        unknown = sorted(map(str, set(value) - known))
        raise InputError(f"unknown keys {unknown}; {what} may have {sorted(known)}")


def _images_of(folder: Path, name: str, camera: Mapping[str, Any]) -> tuple[list[Path], list[str]]:
    """Return a camera's images in the order of their names, and a note on other files.

    Hidden files are neither.
    """
    pattern = str(camera.get("images", name))
    place = _below(folder, pattern, "images")
    found = place.iterdir() if place.is_dir() else folder.glob(_moderate(pattern))
    files = [path for path in found if path.is_file() and not is_hidden(path)]
    paths = sorted((p for p in files if p.suffix.lower() in _SUFFIXES), key=natural_sort_key)
    others = sorted({path.suffix for path in files if path.suffix.lower() not in _SUFFIXES})[:5]
    if not paths:
        holds = f" It holds files with {others}, and {list(_SUFFIXES)} are read." * bool(others)
        raise FileNotFoundError(
            f"camera {name!r} has no image at {place}: `images` names a file, a folder or a "
            f"pattern, from the calibration file's folder (by default the camera's name).{holds}"
        )
    if len({path.stem for path in paths}) < len(paths):
        raise InputError(f"two of its images at {place} have one name: rename one")
    unread = counted(len(files) - len(paths), "file")
    return paths, [f"camera {name!r}: {unread} with {others} not read"] if others else []


def _moderate(pattern: str) -> str:
    """Return a pattern of files without ``**`` that say nothing; many others take for ever."""
    parts = Path(pattern).parts
    kept = [p for p, after in zip(parts, (*parts[1:], ""), strict=True) if (p, after) != _ANY_TWICE]
    if kept.count("**") > _MOST_ANY:
        raise InputError(f"`images` has more than {_MOST_ANY} `**`: name the folders")
    return str(Path(*kept))


def _below(folder: Path, name: str, what: str) -> Path:
    """Return a file or folder that a calibration file names."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"{what} must lie below the calibration file's folder, got {name!r}")
    return folder / name


def _camera(
    name: str, camera: Mapping[str, Any], ground: np.ndarray, images: Sequence[Path]
) -> RigCamera:
    """Read a camera's calibration."""
    given = np.array(camera["intrinsics"], np.float64)
    if given.shape == (4,):
        fx, fy, cx, cy = given
        given = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if given.shape != (3, 3):
        raise InputError(f"intrinsics must be [fx, fy, cx, cy] or 3 x 3, got {given.shape}")
    width, height = camera.get("size_px") or _size_of(images, f"camera {name!r}")
    return RigCamera(
        name,
        given,
        invert_rigid(_mounting(camera)) @ ground,
        (int(width), int(height)),
        np.array(camera.get("distortion", ()), np.float64),
        str(camera.get("distortion_model", "")),
    )


def _size_of(images: Sequence[Path], where: str) -> tuple[int, int]:
    """Return the size of the first image that is whole enough to tell it."""
    for path in images[:-1]:
        with suppress(ValueError):
            return image_size(path, where)
    return image_size(images[-1], where)


def _mounting(camera: Mapping[str, Any]) -> np.ndarray:
    """Return where a camera stands and looks in the vehicle. (4, 4)"""
    ways = {"vehicle_from_camera", "quaternion_wxyz", "yaw_pitch_roll_deg"} & set(camera)
    if len(ways) != 1:
        raise InputError(
            "say its place by vehicle_from_camera (4 x 4), or by position_m with either "
            f"quaternion_wxyz or yaw_pitch_roll_deg; got {sorted(ways) or 'none of them'}"
        )
    if "vehicle_from_camera" in camera:
        pose = np.array(camera["vehicle_from_camera"], np.float64)
        if pose.shape == (4, 4) and np.linalg.det(pose[:3, :3]) < 0:
            raise InputError(
                "vehicle_from_camera mirrors (its rotation's determinant is below 0): two axes are "
                "swapped, or one has the wrong sign"
            )
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError("vehicle_from_camera must be a rotation with a translation, 4 x 4")
        return pose
    if "quaternion_wxyz" in camera:
        rotation = rotation_of(camera["quaternion_wxyz"])
    else:
        turn = Rotation.from_euler("ZYX", camera["yaw_pitch_roll_deg"], degrees=True)
        rotation = turn.as_matrix() @ _AHEAD
    return rigid(rotation, camera["position_m"])


def _frames(
    images: Mapping[str, list[Path]], rate_hz: float | None, tolerance_ns: int, file: Path
) -> tuple[list[RigFrame], dict[str, int], str]:
    """Put images of one time together: by the times in their names, or by equal names.

    Returns:
        The frames, the time of each file name that has one, and what was assumed.
    """
    root, scene = file.parent, file.parent.resolve().name
    known = times_of_names({path.stem for paths in images.values() for path in paths})
    assumed = ""
    if known is not None:
        at = {name: {known[path.stem]: path for path in paths} for name, paths in images.items()}
        times = {name: np.array(sorted(found), np.int64) for name, found in at.items()}
        wanted = next(iter(times.values())).tolist()
        _require_rate(wanted, rate_hz)
        groups = [
            (str(time_ns), time_ns, {name: (at[name][t], t) for name, t in nearest.items()})
            for time_ns, nearest in zip(
                wanted, nearest_images(times, wanted, tolerance_ns), strict=True
            )
        ]
        assumed = f"the names of the images are taken as Unix times, {span_of(wanted)}"
    elif all(len(paths) == 1 for paths in images.values()):
        known = {paths[0].stem: 0 for paths in images.values()}
        groups = [("0", 0, {name: (paths[0], 0) for name, paths in images.items()})]
    else:
        stems, rate = [path.stem for path in next(iter(images.values()))], rate_hz or _RATE_HZ
        known = {stem: round(i * 1e9 / rate) for i, stem in enumerate(stems)}
        named = {name: {path.stem: path for path in paths} for name, paths in images.items()}
        groups = [
            (stem, known[stem], {n: (p[stem], known[stem]) for n, p in named.items() if stem in p})
            for stem in stems
        ]
        by_whom = "rate_hz" if rate_hz else "assumed, as there is no rate_hz"
        assumed = f"the names of the images hold no Unix times: {rate:g} a second ({by_whom})"
    frames = [
        RigFrame(
            f"{scene}_{label}",
            time_ns,
            {name: (path.relative_to(root).as_posix(), t) for name, (path, t) in found.items()},
        )
        for label, time_ns, found in groups
    ]
    return frames, known, assumed


def _require_rate(times_ns: Sequence[int], rate_hz: float | None) -> None:
    """Refuse a rate that the times in the names of images contradict: one of the two is wrong."""
    if rate_hz is None or len(times_ns) < 2:
        return
    step_s = float(np.median(np.diff(times_ns))) / 1e9
    if not 0.5 < step_s * rate_hz < 2:
        raise InputError(
            f"the names of the images read as Unix times ({span_of(times_ns)}), one every "
            f"{step_s:g} s, and rate_hz says {rate_hz:g} a second: leave rate_hz out if they are "
            "times, else rename the images (0001.jpg, 0002.jpg, ...)"
        )


def _notes_on(
    frames: Sequence[RigFrame], images: Mapping[str, Sequence[Path]], tolerance_ns: int
) -> list[str]:
    """Say how many images of each camera are used, where it is not one a sample."""
    first = next(iter(images))
    used = Counter(name for frame in frames for name in frame.images)
    return [
        f"camera {name!r}: {used[name]} of {counted(len(paths), 'image')} used, for "
        f"{counted(len(frames), 'sample')}; the others have no partner among those of {first!r}, "
        f"by equal names or by times within {tolerance_ns / 1e6:g} ms"
        for name, paths in images.items()
        if not used[name] == len(paths) == len(frames)
    ]


def _with_poses(
    frames: Sequence[RigFrame], poses: PoseTrack | None, pose_at: PoseAt | None
) -> tuple[list[RigFrame], list[str]]:
    """Return the frames with a pose, and say how many have none.

    Raises:
        ValueError: If none has one.
    """
    if poses is None or pose_at is None:
        return list(frames), []
    used = [frame for frame in frames if pose_at(frame.time_ns) is not None]
    missing = len(frames) - len(used)
    spans = (
        f"images are from {span_of(frame.time_ns for frame in frames)}, poses from "
        f"{span_of(poses.times_ns.tolist())}"
    )
    if not used:
        raise InputError(f"no image has a pose near its time: {spans}")
    note = (
        f"{len(used)} of {counted(len(frames), 'sample')} used: {missing} have no pose within "
        f"0.1 s, nor poses around them less than 1 s apart ({spans})"
    )
    return used, [note] if missing else []


def _rectify(sample: MapSample, rig: Sequence[RigCamera], root: Path, target: Path) -> list[str]:
    """Write a sample's images without distortion, and make it point to them.

    Returns which cannot be used, and why; they are not written, so that the sample is known to be
    broken.
    """
    unusable, by_name = [], {camera.name: camera for camera in rig}
    for record in sample.cameras:
        camera, source = by_name[record.name], root / record.path
        ending = "" if source.suffix.lower() == ".jpg" else ".jpg"
        record.path = f"{file_name(record.name)}/{file_name(source.name)}{ending}"
        if (target / record.path).is_file():
            continue
        try:
            image = read_image(str(source), f"camera {record.name!r}", camera.size_px)
            camera.write_image(target / record.path, image)
        except BrokenSampleError as error:
            unusable.append(str(error))
    return unusable
