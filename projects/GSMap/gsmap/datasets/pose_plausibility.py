"""Plausibility checks of the poses of drives.

A wrong pose raises no error: memory over frames, priors and maps of drives are only in the wrong
place. A vehicle mostly moves where it looks. This shows inverted poses, quaternions in another
order, and exchanged axes of the world.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.words import format_count

_MIN_STEP_M = 0.5  # the direction of shorter steps is noise
_MIN_STEPS = 3  # fewer steps of a drive say nothing about its direction
_MAX_SIDEWAYS_DEG = 30.0  # median angle between a step and the direction in which the vehicle looks
_MAX_TILT_DEG = 30.0  # median angle between the vertical axes of the vehicle and the world
_MAX_SPEED_M_S = 100.0
_MIN_JUMP_M = 10.0  # shorter jumps are corrections of a localisation
_MAX_GAP_S = 600.0  # between samples of a drive; scenes of published data sets are far shorter
FAR_M = 2.0**17
"""Size in metres of coordinates from which on steps of float32 numbers are larger than 1 cm."""

_Fault = tuple[str, str]  # description, and the likely cause
_BACKWARDS: _Fault = (
    "the vehicle moves backwards",
    "unless it drives in reverse: does x of the ground point ahead, and does time go forward?",
)


@dataclass
class _Drive:
    """Poses of a drive, in the order in which they were added.

    Attributes:
        place: Position of the last pose that is at least 0.5 m from the one before it. (3,)
    """

    times_ns: list[int] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)
    global_from_frame: list[np.ndarray] = field(default_factory=list)  # (4, 4) each
    frame_from_ground: list[np.ndarray] = field(default_factory=list)  # (4, 4) each
    place: np.ndarray | None = None


class MotionCheck:
    """Collects poses of drives, and describes motions that no vehicle makes.

    Attributes:
        num_poses: Number of added poses.
        num_steps: Number of steps of at least 0.5 m.
    """

    def __init__(self) -> None:
        self.num_poses = 0
        self.num_steps = 0
        self._drives: dict[str, _Drive] = {}  # by name

    def add(
        self,
        drive: str,
        timestamp_ns: int,
        token: str,
        global_from_frame: np.ndarray,
        ground_from_frame: np.ndarray,
    ) -> None:
        """Add a pose of a drive. The order does not matter.

        Args:
            drive: Name of the drive; if it is empty, the order of its poses is not known, and the
                motion is not checked.
            timestamp_ns: Time of the pose in nanoseconds.
            token: Name of the sample, for a warning.
            global_from_frame: Transform in metres from the annotation frame to the world. (4, 4)
            ground_from_frame: Transform in metres from the annotation frame to the ground below the
                vehicle (x ahead, y left, z up). (4, 4)
        """
        poses = self._drives.setdefault(drive, _Drive())
        position = global_from_frame[:3, 3]
        if poses.place is None:
            poses.place = position
        elif np.linalg.norm(position - poses.place) >= _MIN_STEP_M:
            poses.place = position
            self.num_steps += 1
        self.num_poses += 1
        poses.times_ns.append(timestamp_ns)
        poses.tokens.append(token)
        poses.global_from_frame.append(global_from_frame)
        poses.frame_from_ground.append(invert_rigid(ground_from_frame))

    def warnings(self) -> list[str]:
        """Describe each kind of implausible motion in one line."""
        texts_of: dict[str, list[str]] = {}  # descriptions, by the likely cause
        for name, drive in self._drives.items():
            for text, cause in _faults_of(name, drive):
                texts_of.setdefault(cause, []).append(f"{text} in drive {name!r}")
        lines = []
        for cause, texts in texts_of.items():
            others = f" and in {len(texts) - 1} more" if len(texts) > 1 else ""
            number = format_count(len(self._drives), "drive")
            lines.append(f"{texts[0]}{others} of {number}: {cause}")
        return lines


def pose_warnings(samples: Iterable[MapSample], frame: str) -> list[str]:
    """Find implausible motions of the vehicles of samples.

    Args:
        samples: Samples of one or more drives, with poses.
        frame: Annotation frame of the samples, ``lidar`` or ``ego``.

    Returns:
        Warnings, one line for each kind of fault.
    """
    check = MotionCheck()
    for sample in samples:
        check.add(
            sample.scene,
            sample.timestamp_ns,
            token=sample.token,
            global_from_frame=sample.global_from_frame,
            ground_from_frame=ground_from_frame(sample, frame=frame),
        )
    return check.warnings()


def float32_step_m(coordinates: npt.ArrayLike) -> float:
    """Return the precision of coordinates that were rounded to float32.

    At a northing of 5,300 km, for example, neighbouring float32 numbers are 0.5 m apart.

    Args:
        coordinates: Coordinates in metres. (...)

    Returns:
        Largest distance of neighbouring float32 numbers at the coordinates, in metres. It is 0 if
        no coordinate is as large as ``FAR_M``, or if one of these is no float32 number.
    """
    values = np.asarray(coordinates, dtype=np.float64)
    far_values = values[np.abs(values) >= FAR_M]
    rounded = far_values.astype(np.float32)
    if not len(rounded) or (rounded != far_values).any():
        return 0.0
    return float(np.spacing(np.abs(rounded)).max())


def _faults_of(name: str, drive: _Drive) -> list[_Fault]:
    """Faults of a drive."""
    order = np.argsort(drive.times_ns, kind="stable")
    times_ns = np.array(drive.times_ns)[order]
    times_s = (times_ns - times_ns[0]) / 1e9
    tokens = [drive.tokens[index] for index in order]
    global_from_frame = np.stack(drive.global_from_frame)[order]
    frame_from_ground = np.stack(drive.frame_from_ground)[order]
    poses = global_from_frame @ frame_from_ground
    precision_faults = list(_precision_faults(global_from_frame[:, :3, 3]))
    faults = list(_tilt_faults(poses)) + list(_identity_faults(global_from_frame))
    # Without names or times of drives, the order of the poses is not known.
    if faults or not name or times_s[-1] == 0:
        return precision_faults + faults
    motion_faults = list(_motion_faults(times_s, tokens, poses))
    inverse = invert_rigid(global_from_frame) @ frame_from_ground
    has_moved = np.ptp(poses[:, :3, 3], axis=0).max() >= _MIN_STEPS * _MIN_STEP_M
    # A vehicle that moves backwards may drive in reverse, with right poses.
    may_be_inverted = bool(motion_faults) and motion_faults != [_BACKWARDS] and has_moved
    if may_be_inverted and not list(_motion_faults(times_s, tokens, inverse)):
        text = "a vehicle moves like this only if the poses are inverted,"
        motion_faults = [(text, "they must map points of the frame to the world")]
    return [*precision_faults, *_gap_faults(times_s, tokens), *motion_faults]


def _gap_faults(times_s: np.ndarray, tokens: list[str]) -> Iterator[_Fault]:
    """Yield a fault if a drive is interrupted for long.

    Args:
        times_s: Ascending times in seconds. (n,)
        tokens: Names of the samples.
    """
    gaps_s = np.diff(times_s)
    num_gaps = int((gaps_s > _MAX_GAP_S).sum())
    if num_gaps:
        longest = int(gaps_s.argmax())
        yield (
            f"{format_count(num_gaps, 'gap')} of more than {_MAX_GAP_S / 60:.0f} "
            f"minutes, up to {gaps_s[longest] / 3600:.1f} h from sample {tokens[longest]!r} to "
            f"{tokens[longest + 1]!r},",
            "is it one drive? Drives need different scenes, and times must be nanoseconds that do "
            "not start again at midnight",
        )


def _precision_faults(positions: np.ndarray) -> Iterator[_Fault]:
    """Yield a fault if positions of a moving vehicle were rounded to float32. (n, 3)"""
    is_varying = (positions != positions[0]).any(axis=0)  # a constant coordinate may be round
    step_m = float32_step_m(positions[:, is_varying])
    if step_m:
        yield (
            f"positions are rounded to steps of up to {step_m:.2g} m",
            "were they float32, which is too coarse for such large coordinates? Keep them float64",
        )


def _tilt_faults(poses: np.ndarray) -> Iterator[_Fault]:
    """Yield a fault if the vehicle does not stand upright.

    Args:
        poses: Transforms from the ground below the vehicle to the world. (n, 4, 4)
    """
    cosines = np.clip(poses[:, 2, 2], -1.0, 1.0)  # of the angle between both vertical axes
    tilt_deg = np.degrees(np.median(np.arccos(cosines)))
    if tilt_deg > _MAX_TILT_DEG:
        yield (
            f"the vehicle is tilted by {tilt_deg:.0f} degrees",
            "does z of the world point up, and is the quaternion in the right order?",
        )


def _identity_faults(poses: np.ndarray) -> Iterator[_Fault]:
    """Yield a fault if the poses of several samples are the identity. (n, 4, 4)"""
    if len(poses) > 1 and (poses == np.eye(4)).all():
        yield (
            f"the poses of all {len(poses)} samples are the identity",
            "are poses (global_from_frame) missing? Memory, priors and maps of drives need them",
        )


def _motion_faults(times_s: np.ndarray, tokens: list[str], poses: np.ndarray) -> Iterator[_Fault]:
    """Yield the faults in the motion of a drive.

    Args:
        times_s: Ascending times in seconds. (n,)
        tokens: Names of the samples.
        poses: Transforms in metres from the ground below the vehicle to the world. (n, 4, 4)
    """
    steps = np.diff(poses[:, :3, 3], axis=0)  # in the world (n - 1, 3)
    lengths_m = np.linalg.norm(steps, axis=1)
    is_step = lengths_m >= _MIN_STEP_M
    with np.errstate(divide="ignore", invalid="ignore"):  # samples of one time
        speeds_m_s = lengths_m / np.diff(times_s)
    is_fast = is_step & (speeds_m_s > _MAX_SPEED_M_S)
    is_jump = is_fast & (lengths_m > _MIN_JUMP_M)
    if 2 * is_fast.sum() > is_step.sum():
        yield (
            f"{is_fast.sum()} of {format_count(int(is_step.sum()), 'step')} are faster than "
            f"{_MAX_SPEED_M_S:.0f} m/s",
            "are times in nanoseconds and positions in metres?",
        )
    elif is_jump.any():
        first = int(is_jump.argmax())
        yield (
            f"the vehicle jumps {format_count(int(is_jump.sum()), 'time')}, such as by "
            f"{lengths_m[first]:.0f} m from sample {tokens[first]!r} to {tokens[first + 1]!r},",
            "is it one drive, and does each sample have the pose of its time?",
        )
    yield from _direction_faults(poses)


def _direction_faults(poses: np.ndarray) -> Iterator[_Fault]:
    """Yield a fault if the vehicle does not move where it looks.

    Args:
        poses: Transforms in metres from the ground below the vehicle to the world. (n, 4, 4)
    """
    kept = [0]  # poses at least 0.5 m from the one before them
    positions = poses[:, :3, 3]
    for index, position in enumerate(positions):
        if np.linalg.norm(position - positions[kept[-1]]) >= _MIN_STEP_M:
            kept.append(index)
    steps = np.diff(positions[kept], axis=0)
    if len(steps) < _MIN_STEPS:
        return
    # The vehicle turns during a step: halfway it looks between the directions at both ends.
    rotations = poses[kept][:, :3, :3]
    halfway = rotations[:-1] + rotations[1:]
    ahead_m = (steps * halfway[:, :, 0]).sum(axis=1)
    left_m = (steps * halfway[:, :, 1]).sum(axis=1)
    angle_deg = np.degrees(np.median(np.abs(np.arctan2(left_m, ahead_m))))
    if angle_deg > 180.0 - _MAX_SIDEWAYS_DEG:
        yield _BACKWARDS
    elif angle_deg > _MAX_SIDEWAYS_DEG:
        yield (
            f"the vehicle moves {angle_deg:.0f} degrees sideways (median of {len(steps)} steps)",
            "are axes exchanged, or is a quaternion in another order?",
        )
