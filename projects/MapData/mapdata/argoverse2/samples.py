"""The samples of one Argoverse 2 log: when they are, what the sensors saw, what the map holds."""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.record import (
    RANGES,
    CameraRecord,
    LidarRecord,
    MapInstance,
    MapSample,
    SweepRecord,
)
from gsmap.datasets.errors import naming
from gsmap.utils.errors import InputError
from mapdata.argoverse2.log import (
    MAX_CAMERA_OFFSET_NS,
    MAX_LIDAR_OFFSET_NS,
    RING_CAMERAS,
    Argoverse2Log,
    closest_ns,
)
from mapdata.argoverse2.map import Argoverse2Map, check_rules, find_map
from mapdata.command_line import FileOptions

THIN_OVER = ("log", "split")
_NEEDS_NONE = "`create_data.py av2 --at poses:10` needs none"


@dataclass(frozen=True)
class Argoverse2Options(FileOptions):
    """What to convert and how: the options of ``tools/create_data.py av2``.

    Of ``rate_hz`` samples per second, None takes all. The default is as published: every LiDAR
    sweep (10 Hz) of ``train``, every fourth of the others. ``poses:N`` of ``at`` needs no sensor
    data. ``thin_over`` says over what samples thin out: each ``log`` alone, or the whole ``split``,
    whose samples are sorted by time (`spread_over_split`).
    """

    _: KW_ONLY
    split: str = "val"
    at: str = "auto"
    rate_hz: float | None = "published"  # type: ignore[assignment]  # a number once it is made
    thin_over: str = "log"
    compat: str = "maptrv2"
    dim: int = 2
    logs: Sequence[str] = ()
    keep_map_changes: bool = False
    x_range: tuple[float, float] = RANGES["ego"][0]
    y_range: tuple[float, float] = RANGES["ego"][1]

    def __post_init__(self) -> None:
        if self.at not in ("auto", "lidar", "cameras") and self.pose_stride is None:
            raise InputError(f"at must be auto, lidar, cameras or poses:N, got {self.at!r}.")
        if self.rate_hz == "published":  # type: ignore[comparison-overlap]
            object.__setattr__(self, "rate_hz", 10.0 if self.split == "train" else 2.5)
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise InputError(f"rate_hz must be > 0, got {self.rate_hz}.")
        if self.thin_over not in THIN_OVER:
            raise InputError(f"thin_over must be one of {THIN_OVER}, got {self.thin_over!r}.")
        if self.thin_over == "split" and (self.rate_hz is None or self.pose_stride is not None):
            raise InputError(
                "thin_over='split' keeps every N-th sample of all logs: give a rate, and times of "
                "sensors (--at)."
            )
        if self.dim not in (2, 3):
            raise InputError(f"dim must be 2 or 3, got {self.dim}.")
        check_rules(self.classes, self.compat)

    @property
    def pose_stride(self) -> int | None:
        """N of ``poses:N``; None for the other choices."""
        match = re.fullmatch(r"poses:([1-9]\d*)", self.at)
        return int(match[1]) if match else None


@dataclass
class LogSamples:
    """A log's samples by time, and what is left out of it.

    Args:
        samples: The samples.
        left_out: Number of samples that are left out, by reason.
        invalid: Number of invalid polygons of the map, by kind.
        elements: Numbers of elements of the map that are left out, by kind and reason.
    """

    samples: list[MapSample] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    invalid: Counter[str] = field(default_factory=Counter)
    elements: dict[str, Sequence[str]] = field(default_factory=dict)


def read_log(
    log_dir: Path,
    options: Argoverse2Options,
    with_map: bool = True,
    passed_ns: Collection[int] = (),
) -> LogSamples:
    """Make the samples of one log.

    Args:
        log_dir: Folder of the log.
        options: What a sample is: rate, frame, range, classes.
        with_map: Whether to add the ground truth.
        passed_ns: Times that are passed over, as `spread_over_split` says.

    Raises:
        FileNotFoundError: If the map or the poses are missing.
        ValueError: If a file is damaged, or sensor data that ``options.at`` needs are missing.
    """
    log, result = Argoverse2Log(log_dir), LogSamples()
    times = [time for time in sample_times(log, options).tolist() if time not in passed_ns]
    log_map = Argoverse2Map.from_log(log_dir) if with_map else None
    if log_map is not None:
        result.invalid = +Counter(log_map.invalid_counts)  # those that are not zero
        result.elements = log_map.left_out
    for timestamp_ns in times:
        try:
            with naming(log_dir, "download the log again"):
                result.samples.append(_sample(log, log_map, timestamp_ns, options))
        except _LeftOut as reason:
            result.left_out[str(reason)] += 1
    return result


def usable_times(log_dir: Path, options: Argoverse2Options) -> list[int]:
    """Return when a log has a sample, in nanoseconds, ascending; nothing if it cannot be read."""
    log = Argoverse2Log(log_dir)
    times = []
    try:
        for timestamp_ns in sample_times(log, options).tolist():
            with suppress(_LeftOut):
                _sample(log, None, timestamp_ns, options)
                times.append(timestamp_ns)
    except (OSError, ValueError):  # the conversion itself says so
        return []
    return times


def spread_over_split(times: Mapping[str, Sequence[int]], rate_hz: float) -> dict[str, set[int]]:
    """Choose every N-th of all logs' samples, sorted by time, as MapTR and MapTRv2 do.

    Args:
        times: When each log has samples, ascending, in nanoseconds.
        rate_hz: Samples per second that stay; N is how often the usual step goes into its period.

    Returns:
        The times that are passed over, by log.
    """
    steps = np.concatenate([np.zeros(0), *(np.diff(own) for own in times.values())])
    every = max(round(1e9 / (rate_hz * np.median(steps))), 1) if len(steps) else 1
    ordered = sorted((time, name) for name, own in times.items() for time in own)
    passed: dict[str, set[int]] = {name: set() for name in times}
    for number, (time, name) in enumerate(ordered):
        if number % every:
            passed[name].add(time)
    return passed


def read_logs(
    log_dirs: list[Path], root: Path, rate_hz: float | None = 2.0
) -> tuple[list[MapSample], Counter[str]]:
    """Read the samples of logs, in the frame ``ego``.

    Args:
        log_dirs: The logs' folders.
        root: Folder that paths are relative to.
        rate_hz: Samples per second; None takes every sweep's or image's time.

    Returns:
        The samples, and how many were left out, by reason.

    Raises:
        ValueError: If no log has a sample; the message says why.
    """
    options = Argoverse2Options(root, rate_hz=rate_hz)
    samples, left_out = [], Counter[str]()
    for log_dir in log_dirs:
        try:
            result = read_log(log_dir, options, with_map=False)
        except (OSError, ValueError) as error:
            left_out[f"{log_dir.name}: {error}"] += 1
            continue
        samples += result.samples
        left_out.update({f"{log_dir.name}: {why}": n for why, n in result.left_out.items()})
    if not samples:
        raise InputError(f"no sample can be read from {root}: {'; '.join(left_out) or 'no log'}.")
    return samples, left_out


def sample_times(log: Argoverse2Log, options: Argoverse2Options) -> np.ndarray:
    """Return when samples are, in nanoseconds, ascending; ValueError if sensor data lack. (n,)"""
    if options.pose_stride is not None:
        return np.array(list(log.poses))[:: options.pose_stride]
    missing = [name for name in RING_CAMERAS if name not in log.calibration]
    if missing:
        which = ", ".join(missing) if log.calibration else "the ring cameras"
        raise InputError(f"no calibration of {which} ({_NEEDS_NONE})")
    times, kind = log.lidar_timestamps_ns, "LiDAR sweeps"
    if options.at == "cameras" or (options.at == "auto" and len(times) == 0):
        times, kind = log.image_timestamps_ns[RING_CAMERAS[0]], f"images of {RING_CAMERAS[0]}"
    if len(times) == 0:
        raise InputError(f"no {kind} ({_NEEDS_NONE})")
    return times if options.thin_over == "split" else thin_out(times, options.rate_hz)


def thin_out(times_ns: np.ndarray, rate_hz: float | None) -> np.ndarray:
    """Keep the first of ascending times, then each that follows the latest kept after a period.

    Half the sensor's own period is tolerated, so that 10 Hz with jitter thins out to every fourth
    at 2.5 Hz, and what is already slower stays whole. Without a rate all stay. (n,) -> (m,)
    """
    if len(times_ns) < 2 or rate_hz is None:
        return times_ns
    least_gap = 1e9 / rate_hz - np.median(np.diff(times_ns)) / 2
    kept = [int(times_ns[0])]
    for time in times_ns[1:].tolist():
        if time - kept[-1] >= least_gap:
            kept.append(time)
    return np.array(kept, dtype=np.int64)


class _LeftOut(Exception):
    """A sample that cannot be made; the message is the reason, the same for all of its kind."""


def _sample(
    log: Argoverse2Log, log_map: Argoverse2Map | None, timestamp_ns: int, options: Argoverse2Options
) -> MapSample:
    """Make the sample at a time, or raise ``_LeftOut``."""
    city_from_ego = log.poses.get(timestamp_ns)
    if city_from_ego is None:
        raise _LeftOut("no pose at the sample's time")
    sample = MapSample(
        token=f"{log.log_id}_{timestamp_ns}",
        scene=log.log_id,
        map_name=log.city,
        timestamp_ns=timestamp_ns,
        cameras=list(_cameras(log, timestamp_ns, city_from_ego, options)),
        global_from_frame=city_from_ego,
        lidar=_lidar(log, timestamp_ns, np.linalg.inv(city_from_ego), options),
    )
    if log_map is not None:
        with naming(find_map(log.log_dir), "download it again"):
            found = log_map.extract(
                city_from_ego, options.classes, options.compat, options.x_range, options.y_range
            )
        sample.instances = [
            MapInstance(label, points[:, : options.dim])
            for label, name in enumerate(options.classes)
            for points in found[name]
        ]
    return sample


def _cameras(
    log: Argoverse2Log, timestamp_ns: int, city_from_ego: np.ndarray, options: Argoverse2Options
) -> Iterator[CameraRecord]:
    """Yield the image of each calibrated camera closest in time."""
    folder = (log.log_dir / "sensors/cameras").relative_to(options.root).as_posix()
    for name, camera in log.calibration.items():
        image_ns = closest_ns(log.image_timestamps_ns[name], timestamp_ns, MAX_CAMERA_OFFSET_NS)
        city_from_ego_then = None if image_ns is None else log.poses.get(image_ns)
        if city_from_ego_then is None:
            if options.pose_stride is None:
                limit = MAX_CAMERA_OFFSET_NS / 1e6
                raise _LeftOut(f"no image of {name} with a pose within {limit:.0f} ms")
            continue
        path = f"{folder}/{name}/{image_ns}.jpg"
        motion = np.linalg.inv(city_from_ego_then) @ city_from_ego
        cam_from_frame = camera.ego_SE3_cam.inverse().transform_matrix @ motion
        width, height, intrinsics = camera.width_px, camera.height_px, camera.intrinsics.K
        yield CameraRecord(name, path, width, height, intrinsics, cam_from_frame)


def _lidar(
    log: Argoverse2Log, timestamp_ns: int, ego_from_city: np.ndarray, options: Argoverse2Options
) -> LidarRecord | None:
    """Return the closest sweep and the ones before it; sweeps are stored in the ego frame."""
    times = log.lidar_timestamps_ns
    sweep_ns = closest_ns(times, timestamp_ns, MAX_LIDAR_OFFSET_NS)
    if sweep_ns is None or sweep_ns not in log.poses:
        return None
    folder = log.log_dir.relative_to(options.root).as_posix()
    last = int(np.searchsorted(times, sweep_ns))
    sweep, *earlier = (
        SweepRecord(f"{folder}/sensors/lidar/{time}.feather", time, ego_from_city @ log.poses[time])
        for time in times[max(last - options.max_sweeps, 0) : last + 1][::-1].tolist()
        if time in log.poses
    )
    return LidarRecord(sweep.path, sweep.frame_from_lidar, earlier)
