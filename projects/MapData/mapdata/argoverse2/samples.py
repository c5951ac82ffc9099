"""Samples of one Argoverse 2 log: times, sensor records and map elements."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
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
from gsmap.datasets.errors import explain_errors
from gsmap.utils.errors import InputError
from mapdata.argoverse2.log import (
    MAX_CAMERA_OFFSET_NS,
    MAX_LIDAR_OFFSET_NS,
    RING_CAMERAS,
    Argoverse2Log,
    closest_ns,
)
from mapdata.argoverse2.map import DEFAULT_RULES, Argoverse2Map, check_rules, find_map
from mapdata.command_line import FileOptions

THIN_OVER = ("log", "split")  # values of the option ``thin_over``
# Hint on missing sensor data.
_ALTERNATIVE = "`create_data.py av2 --at poses:10` needs neither calibration nor sensor data"


@dataclass(frozen=True)
class Argoverse2Options(FileOptions):
    """Options of a conversion of Argoverse 2 logs (``tools/create_data.py av2``).

    Args:
        split: ``train``, ``val`` or ``test``.
        at: Times of the samples: ``lidar`` (LiDAR sweeps), ``cameras`` (images of the front
            camera), ``auto`` (LiDAR sweeps if there are any, else images) or ``poses:N`` (every
            N-th row of the pose table; needs no sensor data).
        rate_hz: Samples per second; None keeps all. ``"published"`` is 10 Hz (every LiDAR sweep)
            for ``train`` and 2.5 Hz (every fourth sweep) for the other splits.
        thin_over: Samples that are thinned out together: the samples of one ``log``, or of the
            whole ``split`` sorted by time (`thin_out_split`).
        compat: Rules of the ground truth: the published system whose elements the conversion
            reproduces, ``maptrv2`` or ``maptr``.
        dim: Coordinates per point, 2 or 3.
        logs: Ids, or first characters of ids, of the logs to convert; empty converts all.
        keep_map_changes: Whether to keep the logs whose map was changed on purpose.
        x_range: Smallest and largest x (forward) of the ground truth, in metres, ego frame.
        y_range: Smallest and largest y (left) of the ground truth, in metres, ego frame.

    Raises:
        ValueError: If an option is out of its range, or options contradict each other.
    """

    _: KW_ONLY
    split: str = "val"
    at: str = "auto"
    rate_hz: float | None = "published"  # type: ignore[assignment]  # a number after initialisation
    thin_over: str = "log"
    compat: str = DEFAULT_RULES
    dim: int = 2
    logs: Sequence[str] = ()
    keep_map_changes: bool = False
    x_range: tuple[float, float] = RANGES["ego"][0]
    y_range: tuple[float, float] = RANGES["ego"][1]

    def __post_init__(self) -> None:
        super().__post_init__()
        # `pose_stride` is None for a text that is not poses:N, too.
        if self.at not in ("auto", "lidar", "cameras") and self.pose_stride is None:
            raise InputError(f"at must be auto, lidar, cameras or poses:N, got {self.at!r}.")
        if self.rate_hz == "published":  # type: ignore[comparison-overlap]
            # The class is frozen, so a plain assignment would raise an error.
            object.__setattr__(self, "rate_hz", 10.0 if self.split == "train" else 2.5)
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise InputError(f"rate_hz must be > 0, got {self.rate_hz}.")
        if self.thin_over not in THIN_OVER:
            raise InputError(f"thin_over must be one of {THIN_OVER}, got {self.thin_over!r}.")
        can_thin_out = self.rate_hz is not None and self.pose_stride is None
        if self.thin_over == "split" and not can_thin_out:
            raise InputError(
                "thin_over='split' keeps every N-th sample of all logs: give a rate, and a value "
                "of --at other than poses:N."
            )
        if self.dim not in (2, 3):
            raise InputError(f"dim must be 2 or 3, got {self.dim}.")
        check_rules(self.classes, self.compat)  # raises a ValueError for unknown names

    @property
    def pose_stride(self) -> int | None:
        """N of ``at="poses:N"``; None for any other value of ``at``."""
        match = re.fullmatch(r"poses:([1-9]\d*)", self.at)
        return int(match[1]) if match else None


@dataclass
class LogSamples:
    """Samples of one log, with counts of the unusable samples and map elements.

    Args:
        samples: Samples in ascending order of time.
        left_out: Number of unusable samples, by reason.
        invalid: Number of invalid polygons of the map, by kind.
        elements: Ids of the unusable elements of the map, by a text with their kind and the reason.
    """

    samples: list[MapSample] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    invalid: Counter[str] = field(default_factory=Counter)
    elements: dict[str, Sequence[str]] = field(default_factory=dict)


def read_log(
    log_dir: Path,
    options: Argoverse2Options,
    with_map: bool = True,
    excluded_ns: Collection[int] = (),
) -> LogSamples:
    """Read the samples of one log.

    Args:
        log_dir: Folder of the log.
        options: Options of the conversion.
        with_map: Whether to add the ground truth.
        excluded_ns: Times in nanoseconds of samples to leave out (`thin_out_split`).

    Returns:
        Samples by ascending time, with counts of the unusable samples and map elements.

    Raises:
        FileNotFoundError: If the map or the poses are missing.
        ValueError: If a file is damaged, or sensor data that ``options.at`` needs are missing.
    """
    log = Argoverse2Log(log_dir)
    result = LogSamples()
    times_ns = sample_times(log, options)
    log_map = None
    if with_map:
        log_map = Argoverse2Map.from_log(log_dir)
        result.elements = log_map.left_out  # ids of the unusable elements of the map
        for kind, count in log_map.invalid_counts.items():
            if count > 0:
                result.invalid[kind] = count
    for timestamp_ns in times_ns.tolist():
        if timestamp_ns in excluded_ns:
            continue
        try:
            # Errors about damaged content get the folder and this advice. `_UnusableSample` passes
            # unchanged.
            with explain_errors(log_dir, "download the log again"):
                sample = _sample(log, log_map, timestamp_ns=timestamp_ns, options=options)
        except _UnusableSample as reason:
            result.left_out[str(reason)] += 1
        else:
            result.samples.append(sample)
    return result


def usable_times(log_dir: Path, options: Argoverse2Options) -> list[int]:
    """List the times at which a log has a usable sample.

    Args:
        log_dir: Folder of the log.
        options: Options of the conversion.

    Returns:
        Ascending times in nanoseconds; an empty list if the log cannot be read.
    """
    log = Argoverse2Log(log_dir)
    times_ns = []
    try:
        for timestamp_ns in sample_times(log, options).tolist():
            with suppress(_UnusableSample):  # then the time is not added
                _sample(log, None, timestamp_ns=timestamp_ns, options=options)
                times_ns.append(timestamp_ns)
    except (OSError, ValueError):  # the conversion of the log reports this error
        return []
    return times_ns


def thin_out_split(times_ns: Mapping[str, Sequence[int]], rate_hz: float) -> dict[str, set[int]]:
    """Thin out the samples of all logs together.

    The samples of all logs are sorted by time, and every N-th of them is kept. N is the median
    sampling rate divided by ``rate_hz``, rounded, at least 1. The published systems select their
    validation samples by this rule.

    Args:
        times_ns: Ascending times of the samples in nanoseconds, by name of the log.
        rate_hz: Samples per second to keep, > 0.

    Returns:
        Times in nanoseconds of the samples to leave out, by name of the log.
    """
    gaps_ns = [np.zeros(0)]  # concatenate needs an array, also if there is no log
    samples = []
    for name, log_times in times_ns.items():
        gaps_ns.append(np.diff(log_times))
        # Samples of equal times are sorted by the name of the log.
        samples += [(time, name) for time in log_times]
    all_gaps_ns = np.concatenate(gaps_ns)
    step = 1
    if len(all_gaps_ns) > 0:
        step = max(round(1e9 / (rate_hz * np.median(all_gaps_ns))), 1)
    excluded_ns: dict[str, set[int]] = {name: set() for name in times_ns}
    for number, (time, name) in enumerate(sorted(samples)):
        if number % step != 0:
            excluded_ns[name].add(time)
    return excluded_ns


def read_logs(
    log_dirs: list[Path], root: Path, rate_hz: float | None = 2.0
) -> tuple[list[MapSample], Counter[str]]:
    """Read the samples of several logs in the ego frame, without ground truth.

    Args:
        log_dirs: Folders of the logs.
        root: Folder that the paths of the samples are relative to.
        rate_hz: Samples per second; None takes a sample per LiDAR sweep or image.

    Returns:
        The samples, and the number of logs and samples that are left out, by the name of the log
        with the reason.

    Raises:
        ValueError: If no log has a usable sample.
    """
    options = Argoverse2Options(root, rate_hz=rate_hz)
    samples = []
    left_out = Counter[str]()
    for log_dir in log_dirs:
        try:
            result = read_log(log_dir, options, with_map=False)
        except (OSError, ValueError) as error:
            left_out[f"{log_dir.name}: {error}"] += 1
            continue
        samples += result.samples
        for reason, count in result.left_out.items():
            left_out[f"{log_dir.name}: {reason}"] += count
    if not samples:
        raise InputError(f"no sample can be read from {root}: {'; '.join(left_out) or 'no log'}.")
    return samples, left_out


def sample_times(log: Argoverse2Log, options: Argoverse2Options) -> np.ndarray:
    """Compute the times of a log's samples.

    With ``options.thin_over="split"`` the times are not thinned out yet.

    Args:
        log: The log.
        options: Options of the conversion.

    Returns:
        Ascending times in nanoseconds. (n,)

    Raises:
        FileNotFoundError: If the poses are needed and missing.
        ValueError: If the calibration or the sensor data that ``options.at`` needs are missing, or
            a file is damaged.
    """
    if options.pose_stride is not None:
        return np.array(list(log.poses))[:: options.pose_stride]  # the keys are ascending times
    uncalibrated = [name for name in RING_CAMERAS if name not in log.calibration]
    if uncalibrated:
        cameras = ", ".join(uncalibrated) if log.calibration else "the ring cameras"
        raise InputError(f"no calibration of {cameras} ({_ALTERNATIVE})")
    times_ns = log.lidar_timestamps_ns
    kind = "LiDAR sweeps"
    if options.at == "cameras" or (options.at == "auto" and len(times_ns) == 0):
        times_ns = log.image_timestamps_ns[RING_CAMERAS[0]]  # the front camera
        kind = f"images of {RING_CAMERAS[0]}"
    if len(times_ns) == 0:
        raise InputError(f"no {kind} ({_ALTERNATIVE})")
    if options.thin_over == "split":
        return times_ns
    return thin_out(times_ns, options.rate_hz)


def thin_out(times_ns: np.ndarray, rate_hz: float | None) -> np.ndarray:
    """Select times at a lower rate.

    The first time is selected. A later time is selected if its gap to the latest selected one is
    at least a period of ``rate_hz`` minus half the median gap of ``times_ns``. This tolerance has
    two effects: at 2.5 Hz, every fourth time of a 10 Hz sensor with jitter is selected, and all
    times of a sensor slower than ``rate_hz`` are selected.

    Args:
        times_ns: Ascending times in nanoseconds. (n,)
        rate_hz: Times per second to keep; None keeps all.

    Returns:
        The selected times in nanoseconds. (m,)
    """
    if len(times_ns) < 2 or rate_hz is None:
        return times_ns
    min_gap_ns = 1e9 / rate_hz - np.median(np.diff(times_ns)) / 2
    selected_ns = [int(times_ns[0])]
    for time in times_ns[1:].tolist():
        if time - selected_ns[-1] >= min_gap_ns:
            selected_ns.append(time)
    return np.array(selected_ns, dtype=np.int64)


class _UnusableSample(Exception):
    """Error for a sample that cannot be made. Samples are counted by its message, the reason."""


def _sample(
    log: Argoverse2Log, log_map: Argoverse2Map | None, timestamp_ns: int, options: Argoverse2Options
) -> MapSample:
    """Make the sample at a time.

    Raises:
        _UnusableSample: If the pose at this time is missing, or an image that ``options.at`` needs.
        ValueError: If a file is damaged.
    """
    city_from_ego = log.poses.get(timestamp_ns)
    if city_from_ego is None:
        raise _UnusableSample("no pose at the sample's time")
    ego_from_city = np.linalg.inv(city_from_ego)  # ego at the time of the sample
    sample = MapSample(
        token=f"{log.log_id}_{timestamp_ns}",
        scene=log.log_id,
        map_name=log.city,
        timestamp_ns=timestamp_ns,
        cameras=_cameras(log, timestamp_ns, city_from_ego=city_from_ego, options=options),
        global_from_frame=city_from_ego,
        lidar=_lidar(log, timestamp_ns, ego_from_city=ego_from_city, options=options),
    )
    if log_map is not None:
        with explain_errors(find_map(log.log_dir), "download it again"):
            # Vertices in the ego frame, a list of elements by class. (n, 3) each
            elements = log_map.extract(
                city_from_ego,
                options.classes,
                compat=options.compat,
                x_range=options.x_range,
                y_range=options.y_range,
            )
        sample.instances = []
        for label, name in enumerate(options.classes):
            for points in elements[name]:
                sample.instances.append(MapInstance(label, points[:, : options.dim]))
    return sample


def _cameras(
    log: Argoverse2Log, timestamp_ns: int, city_from_ego: np.ndarray, options: Argoverse2Options
) -> list[CameraRecord]:
    """List the images that are closest in time, one for each calibrated camera.

    The transforms to the cameras include the motion of the vehicle from the time of the sample to
    the time of the image. A camera without an image is left out with ``at="poses:N"``. With other
    values of ``at`` it makes the sample unusable.
    """
    needs_all_images = options.pose_stride is None
    folder = (log.log_dir / "sensors/cameras").relative_to(options.root).as_posix()
    records = []
    for name, camera in log.calibration.items():
        camera_times_ns = log.image_timestamps_ns[name]
        # None if no image of the camera is close enough.
        image_ns = closest_ns(camera_times_ns, timestamp_ns, tolerance_ns=MAX_CAMERA_OFFSET_NS)
        city_from_ego_at_image = None if image_ns is None else log.poses.get(image_ns)
        if city_from_ego_at_image is None:
            if needs_all_images:
                limit_ms = MAX_CAMERA_OFFSET_NS / 1e6
                raise _UnusableSample(f"no image of {name} with a pose within {limit_ms:.0f} ms")
            continue
        ego_at_image_from_ego = np.linalg.inv(city_from_ego_at_image) @ city_from_ego
        cam_from_ego_at_image = camera.ego_SE3_cam.inverse().transform_matrix
        record = CameraRecord(
            name=name,
            path=f"{folder}/{name}/{image_ns}.jpg",
            width=camera.width_px,
            height=camera.height_px,
            intrinsics=camera.intrinsics.K,
            cam_from_frame=cam_from_ego_at_image @ ego_at_image_from_ego,
        )
        records.append(record)
    return records


def _lidar(
    log: Argoverse2Log, timestamp_ns: int, ego_from_city: np.ndarray, options: Argoverse2Options
) -> LidarRecord | None:
    """Find the LiDAR sweep closest in time, and the sweeps before it.

    There are at most ``options.max_sweeps`` earlier sweeps, the latest first. Sweeps without a pose
    are left out. The result is None if no sweep is close enough, or if the closest sweep has no
    pose. Argoverse 2 stores the points of a sweep in the ego frame at the time of the sweep.
    """
    times_ns = log.lidar_timestamps_ns
    sweep_ns = closest_ns(times_ns, timestamp_ns, tolerance_ns=MAX_LIDAR_OFFSET_NS)
    if sweep_ns is None or sweep_ns not in log.poses:
        return None
    folder = log.log_dir.relative_to(options.root).as_posix()
    last = int(np.searchsorted(times_ns, sweep_ns))  # index of this sweep
    first = max(last - options.max_sweeps, 0)
    sweeps = []
    for time in reversed(times_ns[first : last + 1].tolist()):
        if time in log.poses:
            path = f"{folder}/sensors/lidar/{time}.feather"
            sweeps.append(SweepRecord(path, time, frame_from_lidar=ego_from_city @ log.poses[time]))
    closest = sweeps[0]  # the sweep at `sweep_ns`: it has a pose, and it is the latest one
    return LidarRecord(closest.path, closest.frame_from_lidar, sweeps=sweeps[1:])
