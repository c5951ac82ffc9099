"""Poses of a vehicle in a text file with columns (docs/inference.md)."""

import csv
import math
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gsmap.datasets.errors import explain_errors
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_text
from mapdata.folders.rig import PoseTrack

_VALUES = ("x", "y", "z", "qw", "qx", "qy", "qz")
_TIME = "timestamp_ns"
_FRAME = "frame"
_SEPARATORS = ",;\t"
_NUMBER = re.compile(r"(-?\d+)(\.0*)?")  # a whole number, also with zeros as decimals
_LENGTH_TOLERANCE = 1e-2  # largest difference of a quaternion's length from 1
_MOST_COLUMNS = 12  # largest number of columns that a message names


def read_poses(path: Path, time_of: Mapping[str, int | None], ground: np.ndarray) -> PoseTrack:
    """Read poses from the columns x, y, z, qw, qx, qy, qz, and timestamp_ns or frame.

    The column ``frame`` has the names of images, whose times are the times of the poses. It has
    precedence over ``timestamp_ns``. Rows with the name of no image are skipped. Columns are
    separated by commas, semicolons or tabs, and blanks around values are ignored. In files with
    semicolons or tabs, numbers may have decimal commas.

    Args:
        path: Text file, whose first line that is not blank names the columns.
        time_of: Times of the images in nanoseconds, by their names without suffix. None if images
            of different times have this name.
        ground: Transform from the road below the vehicle to the vehicle's frame, in metres. (4, 4)

    Returns:
        Poses of the road below the vehicle in the global frame of the file, by time.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is malformed, or has no pose of an image. The message names the file
            and, for an invalid value, the line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no file of poses {path}.")
    times_ns = []
    pose_values = []  # 7 numbers of each pose
    unknown_frames = []
    # The context adds the path and the remedy to the messages below.
    with explain_errors(path, remedy="see docs/inference.md"):
        for number, row in _rows(read_text(path)):
            try:
                time_ns = _time_of(row, time_of=time_of)
                if time_ns is None:
                    unknown_frames.append(row[_FRAME])
                    continue
                pose_values.append(_pose_of(row))
            except ValueError as error:
                raise InputError(f"line {number}: {error}") from error
            times_ns.append(time_ns)
        if not times_ns and unknown_frames:
            raise InputError(
                f"none of its {len(unknown_frames)} frames is the name of an image: it has "
                f"{unknown_frames[0]!r:.60}, images are {next(iter(time_of), '')!r:.60}"
            )
        if not times_ns:
            raise InputError("it holds no pose")
        table = np.array(pose_values, dtype=np.float64)
        positions = table[:, :3]
        quaternions_xyzw = table[:, [4, 5, 6, 3]]  # SciPy's order; the file begins with w
        rotations = Rotation.from_quat(quaternions_xyzw).as_matrix()
        poses = []
        for rotation, position in zip(rotations, positions, strict=True):
            poses.append(rigid(rotation, translation=position) @ ground)
        return PoseTrack(times_ns=times_ns, poses=poses)


def _rows(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the line number and the values by column of each row below the names of the columns."""
    lines = text.splitlines()
    start = 0  # index of the first line that is not blank
    while start < len(lines) and not lines[start].strip():
        start += 1
    if start == len(lines):
        raise InputError("it is empty")
    separator = max(_SEPARATORS, key=lines[start].count)  # the most frequent one of the first line
    table = csv.reader(lines[start:], delimiter=separator, skipinitialspace=True)
    try:
        names = [name.strip() for name in next(table)]
        _require_columns(names)
        for row in table:
            values = [value.strip() for value in row]
            if not any(values):
                continue
            number = start + table.line_num  # `line_num` is 1 in the line with the names
            if len(values) < len(names):
                raise InputError(f"line {number}: it has {len(values)} of {len(names)} columns")
            if separator != ",":
                values = [value.replace(",", ".") for value in values]
            yield number, dict(zip(names, values, strict=False))  # further values are ignored
    except csv.Error as error:
        raise InputError(f"it is no CSV: {error}") from error


def _require_columns(names: Collection[str]) -> None:
    """Raise a ``ValueError`` if a required column is missing."""
    missing = [name for name in _VALUES if name not in names]
    if _TIME not in names and _FRAME not in names:
        missing.insert(0, f"{_TIME} or {_FRAME}")
    if missing:
        raise InputError(
            f"its first line must name the columns {_TIME} or {_FRAME}, {', '.join(_VALUES)}; it "
            f"lacks {', '.join(missing)} and has {list(names)[:_MOST_COLUMNS]!r:.200}"
        )


def _time_of(row: Mapping[str, str], time_of: Mapping[str, int | None]) -> int | None:
    """Time of a row in nanoseconds; None if no image has the name in the row."""
    if _FRAME in row:
        # The name of an image, without or with its suffix.
        name = row[_FRAME]
        if name not in time_of:
            name = Path(name).stem
        if name not in time_of:
            return None
        time_ns = time_of[name]
        if time_ns is None:
            raise InputError(
                f"{_FRAME} {name!r:.60} names images of different times: give {_TIME} instead"
            )
        return time_ns
    text = row[_TIME]
    match = _NUMBER.fullmatch(text)
    if match:
        return int(match[1])
    # Scientific notation, such as 1.56E+18.
    if re.fullmatch(r"\d([.,]\d+)?[eE]\+?\d+", text):
        raise InputError(
            f"{_TIME} is {text!r:.40}, rounded as spreadsheets write long numbers: keep its digits"
        )
    raise InputError(f"{_TIME} is {text!r:.40}, no whole number of nanoseconds")


def _pose_of(row: Mapping[str, str]) -> list[float]:
    """Position (x, y, z) in metres and quaternion (w, x, y, z) of a row: 7 numbers."""
    values = []
    for name in _VALUES:
        try:
            value = float(row[name])
        except ValueError:
            value = math.nan  # reported below, like a number that is not finite
        if not math.isfinite(value):
            raise InputError(f"{name} is {row[name]!r:.40}, no finite number")
        values.append(value)
    length = math.hypot(values[3], values[4], values[5], values[6])
    if not abs(length - 1) < _LENGTH_TOLERANCE:
        raise InputError(f"a quaternion must have length 1, got {values[3:]}")
    return values
