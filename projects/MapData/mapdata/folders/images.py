"""Samples of a folder of images with one calibration file (docs/inference.md)."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.errors import BrokenSampleError, explain_errors
from gsmap.datasets.image_files import read_image
from gsmap.datasets.source import Source
from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name, is_hidden
from gsmap.utils.words import format_count
from mapdata.folders.calibration_file import (
    cameras_of,
    check_camera_keys,
    create_camera,
    ground_pose,
    read_calibration,
    read_named_poses,
)
from mapdata.folders.names import natural_sort_key, times_of_names
from mapdata.folders.rig import (
    PoseAt,
    PoseTrack,
    RigCamera,
    RigFrame,
    motion_notes,
    nearest_images,
    rig_samples,
    set_rectification_targets,
)
from mapdata.paths import path_below
from mapdata.unix_times import span_of

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
_RATE_HZ = 10.0  # assumed rate of the images if a calibration file has no rate_hz
# Largest number of ``**`` in a pattern. Each multiplies the time of the search by the depth of the
# folders.
_MOST_ANY = 2
_MOST_SUFFIXES = 5  # number of suffixes that a message names


def read_image_folder(
    file: Path, frames_dir: Path, trained: Mapping[str, Sequence[float]] | None = None
) -> Source:
    """Read the samples that a calibration file describes, in the frame ``ego``.

    Args:
        file: Calibration file, YAML or JSON. Its paths are relative to its folder.
        frames_dir: Folder for rectified images, which are written if a camera has distortion. They
            are in a subfolder, whose name has a digest of the images and the calibration.
        trained: Width, height, fx, fy, cx and cy of the cameras to which images are rectified, by
            name (``InputOptions``).

    Returns:
        The samples, with notes on assumptions and omissions.

    Raises:
        FileNotFoundError: If a camera has no image, or the file names a file of poses that does not
            exist.
        ValueError: If the file is malformed; the message names the camera.
    """
    folder = file.parent
    with explain_errors(file, remedy="see docs/inference.md"):
        content = read_calibration(file)
        # Pose of the road in the vehicle's frame. Cameras and poses are given for the vehicle, and
        # are converted to the road below it.
        ground = ground_pose(content)
        rig = []
        images = {}
        notes = []
        for name, camera in cameras_of(content):
            with explain_errors(f"{file}, camera {name!r}", remedy="see docs/inference.md"):
                check_camera_keys(camera)
                images[name], image_notes = _find_images(folder, name=name, camera=camera)
                notes += image_notes
                rig.append(create_camera(name, camera, ground=ground, images=images[name]))
        rate_hz, tolerance_ns = _read_timing(content)
        frames, time_of, frame_notes = _group_images(
            images, rate_hz, tolerance_ns=tolerance_ns, folder=folder
        )
        notes += frame_notes
        notes += _usage_notes(frames, images=images, tolerance_ns=tolerance_ns)
        poses = read_named_poses(content, folder=folder, time_of=time_of, ground=ground)
        # `pose_at` returns the pose at a time, or None if no pose is near. Images of one time share
        # the cached result.
        pose_at = None if poses is None else cache(poses.at)
        if poses is not None and pose_at is not None:
            frames, pose_notes = _frames_with_poses(frames, poses=poses, pose_at=pose_at)
            notes += pose_notes
            notes += motion_notes(frames, pose_at=pose_at)
        # The folder of the rectified images is named by a digest, which depends on this key.
        target_key, target_notes = set_rectification_targets(rig, trained or {})
        notes += target_notes
        scene = folder.resolve().name
        samples = rig_samples(scene, rig, frames=frames, pose_at=pose_at)
        root = folder  # folder of the image paths
        if any(camera.is_distorted for camera in rig):
            digest = _digest(file, frames=frames, target_key=target_key)
            root = frames_dir / f"{file_name(scene)}-{digest}"
            for sample in samples:
                notes += _rectify_images(sample, rig=rig, root=folder, target=root)
        return Source(
            samples=samples,
            frame="ego",
            data_root=root,
            has_poses=poses is not None,
            notes=tuple(notes),
        )


def _read_timing(content: Mapping[str, Any]) -> tuple[float | None, int]:
    """Read the rate of the images and the tolerance of their times from a calibration file.

    Returns:
        Rate in Hz, None if the file has none, and tolerance in nanoseconds.
    """
    rate_hz = float(content["rate_hz"]) if "rate_hz" in content else None
    tolerance_ns = round(float(content.get("max_time_difference_ms", 50.0)) * 1e6)
    is_rate_valid = rate_hz is None or 0 < rate_hz < np.inf
    if not is_rate_valid or tolerance_ns < 0:
        raise InputError("rate_hz must be > 0, and max_time_difference_ms >= 0")
    return rate_hz, tolerance_ns


def _digest(file: Path, frames: Sequence[RigFrame], target_key: bytes) -> str:
    """Digest of a calibration file, of the images of frames and of ``target_key``.

    If one of them changes, images are rectified again, into another folder.

    ``target_key`` is the result of `set_rectification_targets`. It depends on the cameras to which
    images are rectified.
    """
    digest = hashlib.sha256(file.read_bytes() + target_key)
    for frame in frames:
        for path, _ in frame.images.values():
            digest.update(f"{path}\n".encode())
            digest.update((file.parent / path).read_bytes())
    return digest.hexdigest()[:16]


def _find_images(
    folder: Path, name: str, camera: Mapping[str, Any]
) -> tuple[list[Path], list[str]]:
    """Find the images of a camera, in natural order of their names (2 before 10).

    Hidden files are ignored.

    Returns:
        The images, and a note if there are files of other types.

    Raises:
        FileNotFoundError: If there is no image.
        ValueError: If two images have equal names, or the pattern is not allowed.
    """
    pattern = str(camera.get("images", name))
    # A path that leads out of the folder is an error.
    place = path_below(folder, pattern, noun="images")
    candidates: Iterable[Path]
    if place.is_dir():
        candidates = place.iterdir()
    elif place.is_file():  # its name may have brackets, which mean something in a pattern
        candidates = [place]
    else:
        candidates = folder.glob(_simplify_pattern(pattern))
    images = []
    other_suffixes = set()
    other_count = 0
    for path in candidates:
        if not path.is_file() or is_hidden(path):
            continue
        if path.suffix.lower() in _SUFFIXES:
            images.append(path)
        else:
            other_suffixes.add(path.suffix)
            other_count += 1
    suffixes = sorted(other_suffixes)[:_MOST_SUFFIXES]
    if not images:
        hint = f" It holds files with {suffixes}, and {list(_SUFFIXES)} are read."
        raise FileNotFoundError(
            f"camera {name!r} has no image at {place}: `images` names a file, a folder or a "
            "pattern, from the calibration file's folder (by default the camera's name)."
            f"{hint if suffixes else ''}"
        )
    # Names without suffix identify the images of one time in all cameras.
    stems = {path.stem for path in images}
    if len(stems) < len(images):
        raise InputError(
            f"two of its images at {place} have equal names (apart from folder and suffix): rename "
            "one"
        )
    notes = []
    if suffixes:
        notes.append(
            f"camera {name!r}: {format_count(other_count, 'file')} with {suffixes} not read"
        )
    return sorted(images, key=natural_sort_key), notes


def _simplify_pattern(pattern: str) -> str:
    """Reduce successive ``**`` of a pattern to one; more than `_MOST_ANY` in all are an error."""
    parts: list[str] = []
    for part in Path(pattern).parts:
        is_repeat = part == "**" and parts[-1:] == ["**"]  # the slice may be empty
        if not is_repeat:
            parts.append(part)
    if parts.count("**") > _MOST_ANY:
        raise InputError(f"`images` has more than {_MOST_ANY} `**`: name the folders")
    return Path(*parts).as_posix()


def _group_images(
    images: Mapping[str, Sequence[Path]], rate_hz: float | None, tolerance_ns: int, folder: Path
) -> tuple[list[RigFrame], dict[str, int], list[str]]:
    """Group the images of all cameras by the times in their names, or by equal names.

    If every camera has a single image without a time, these images form one frame.

    Args:
        images: Images of each camera, in natural order of their names.
        rate_hz: Rate of the images, if the file has one.
        tolerance_ns: Largest difference of times in one frame, in nanoseconds.
        folder: Folder of the calibration file, to which the paths of the frames are relative.

    Returns:
        The frames, the time in nanoseconds of each file name without suffix that has one, and notes
        on assumptions.
    """
    scene = folder.resolve().name
    stems: set[str] = set()
    for paths in images.values():
        stems.update(path.stem for path in paths)
    time_of = times_of_names(stems)  # in nanoseconds; None unless all names have a Unix time
    if time_of is not None:
        return _group_by_times(
            images, rate_hz, tolerance_ns=tolerance_ns, time_of=time_of, folder=folder
        )
    has_single_images = all(len(paths) == 1 for paths in images.values())
    if has_single_images:
        single_images = {}
        time_of = {}
        for name, paths in images.items():
            path = paths[0]
            single_images[name] = (path.relative_to(folder).as_posix(), 0)  # at time 0
            time_of[path.stem] = 0
        frame = RigFrame(token=f"{scene}_0", time_ns=0, images=single_images)
        return [frame], time_of, []

    # Images with equal names form a frame. Frames follow each other in the order of the first
    # camera's images, at a fixed rate.
    rate = rate_hz or _RATE_HZ
    first_images = next(iter(images.values()))
    time_of = {}
    # Path and time in nanoseconds of the image of each camera, by the name of the camera. The outer
    # key is the common name of these images without suffix.
    images_by_stem: dict[str, dict[str, tuple[str, int]]] = {}
    for i, path in enumerate(first_images):
        time_of[path.stem] = round(i * 1e9 / rate)
        images_by_stem[path.stem] = {}
    for name, paths in images.items():
        for path in paths:
            if path.stem in time_of:
                relative_path = path.relative_to(folder).as_posix()
                images_by_stem[path.stem][name] = (relative_path, time_of[path.stem])
    frames = []
    for stem, time_ns in time_of.items():
        frames.append(
            RigFrame(token=f"{scene}_{stem}", time_ns=time_ns, images=images_by_stem[stem])
        )
    origin = "rate_hz" if rate_hz else "assumed, as there is no rate_hz"
    note = f"the names of the images hold no Unix times: {rate:g} a second ({origin})"
    return frames, time_of, [note]


def _group_by_times(
    images: Mapping[str, Sequence[Path]],
    rate_hz: float | None,
    tolerance_ns: int,
    time_of: dict[str, int],
    folder: Path,
) -> tuple[list[RigFrame], dict[str, int], list[str]]:
    """Group the images of all cameras around the times of the first camera.

    ``time_of`` has the time of each file name. Other arguments and results: see `_group_images`.
    """
    scene = folder.resolve().name
    path_at: dict[str, dict[int, str]] = {}  # path of the image of a camera at a time
    times_ns = {}
    for name, paths in images.items():
        camera_paths = {}
        for path in paths:
            camera_paths[time_of[path.stem]] = path.relative_to(folder).as_posix()
        path_at[name] = camera_paths
        times_ns[name] = np.array(sorted(camera_paths), dtype=np.int64)
    first_camera = next(iter(times_ns))
    frame_times = times_ns[first_camera].tolist()
    _check_rate(frame_times, rate_hz=rate_hz)
    frames = []
    # For each frame, the time of the nearest image of each camera with an image in the tolerance.
    nearest = nearest_images(times_ns, frame_times, tolerance_ns=tolerance_ns)
    for frame_ns, image_times in zip(frame_times, nearest, strict=True):
        frame_images = {}
        for name, time_ns in image_times.items():
            frame_images[name] = (path_at[name][time_ns], time_ns)
        frames.append(RigFrame(token=f"{scene}_{frame_ns}", time_ns=frame_ns, images=frame_images))
    note = f"the names of the images are taken as Unix times, {span_of(frame_times)}"
    return frames, time_of, [note]


def _check_rate(times_ns: Sequence[int], rate_hz: float | None) -> None:
    """Raise a ``ValueError`` if the rate contradicts the times in the names of the images."""
    if rate_hz is None or len(times_ns) < 2:
        return
    # A factor of 2 in either direction is allowed, since images may be missing.
    step_s = float(np.median(np.diff(times_ns))) / 1e9
    if not 0.5 < step_s * rate_hz < 2:
        raise InputError(
            f"the names of the images can be read as Unix times ({span_of(times_ns)}), one every "
            f"{step_s:g} s, but rate_hz is {rate_hz:g}: leave rate_hz out if the names are times, "
            "or else rename the images (0001.jpg, 0002.jpg, ...)"
        )


def _usage_notes(
    frames: Sequence[RigFrame], images: Mapping[str, Sequence[Path]], tolerance_ns: int
) -> list[str]:
    """Notes on cameras with unused images, or without an image in some samples."""
    first = next(iter(images))
    counts: Counter[str] = Counter()  # samples with an image of the camera
    used: dict[str, set[str]] = {}  # paths by camera; an image may be in two samples
    for name in images:
        used[name] = set()
    for frame in frames:
        counts.update(frame.images.keys())
        for name, (path, _) in frame.images.items():
            used[name].add(path)
    notes = []
    for name, paths in images.items():
        all_are_used = len(used[name]) == len(paths)
        all_have_one = counts[name] == len(frames)
        if not (all_are_used and all_have_one):
            notes.append(
                f"camera {name!r}: {len(used[name])} of {format_count(len(paths), 'image')} used, "
                f"in {counts[name]} of {format_count(len(frames), 'sample')}; a sample has the "
                f"image with the name of that of {first!r}, or the nearest one within "
                f"{tolerance_ns / 1e6:g} ms"
            )
    return notes


def _frames_with_poses(
    frames: Sequence[RigFrame], poses: PoseTrack, pose_at: PoseAt
) -> tuple[list[RigFrame], list[str]]:
    """Select the frames with a pose, and make a note on the others.

    Raises:
        ValueError: If no frame has a pose.
    """
    selected = [frame for frame in frames if pose_at(frame.time_ns) is not None]
    missing = len(frames) - len(selected)
    if not missing:
        return selected, []
    image_times = [frame.time_ns for frame in frames]
    pose_times = poses.times_ns.tolist()
    spans = f"images are from {span_of(image_times)}, poses from {span_of(pose_times)}"
    if not selected:
        raise InputError(f"no image has a pose near its time: {spans}")
    note = (
        f"{len(selected)} of {format_count(len(frames), 'sample')} used: {missing} have no pose "
        f"within 0.1 s, nor poses around them less than 1 s apart ({spans})"
    )
    return selected, [note]


def _rectify_images(
    sample: MapSample, rig: Sequence[RigCamera], root: Path, target: Path
) -> list[str]:
    """Rectify the images of a sample, write them, and set the paths of its cameras to them.

    Images that cannot be read are not written, so that reading the sample fails. Images that an
    earlier call has written are kept.

    Args:
        sample: The sample, whose camera records are changed in place.
        rig: Cameras of the vehicle.
        root: Folder of the paths of the given images.
        target: Folder of the rectified images.

    Returns:
        Notes on the images that cannot be read.
    """
    notes = []
    camera_of = {camera.name: camera for camera in rig}
    for record in sample.cameras:
        camera = camera_of[record.name]
        source = root / record.path
        # Names come from the user. `file_name` makes them safe for the file system.
        suffix = "" if source.suffix.lower() == ".jpg" else ".jpg"  # all are written as JPEG
        record.path = f"{file_name(record.name)}/{file_name(source.name)}{suffix}"
        if (target / record.path).is_file():
            continue
        try:
            image = read_image(str(source), where=f"camera {record.name!r}", size=camera.size_px)
            camera.write_image(target / record.path, image)
        except BrokenSampleError as error:
            notes.append(str(error))
    return notes
