"""Poses of a vehicle in a text file with columns (docs/inference.md)."""

import csv
import math
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gsmap.datasets.errors import naming
from gsmap.structures.rigid import rigid
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_text
from mapdata.folders.rig import PoseTrack

_VALUES = ("x", "y", "z", "qw", "qx", "qy", "qz")
_TIME, _FRAME = "timestamp_ns", "frame"
_SEPARATORS = ",;\t"
_NUMBER = re.compile(r"(-?\d+)(\.0*)?")
_LENGTH_TOLERANCE = 1e-2  # of a quaternion
_SHOWN = 12  # columns in a message


def read_poses(path: Path, time_of: Mapping[str, int], ground: np.ndarray) -> PoseTrack:
    """Read a file with x, y, z, qw, qx, qy, qz, and timestamp_ns or frame (an image's name).

    Columns are separated by commas, semicolons or tabs; blanks around values do not count. Beside
    semicolons and tabs, numbers may have decimal commas.

    Args:
        path: The file. Its first line names the columns.
        time_of: Times of the images in nanoseconds, by their names without suffix.
        ground: Pose of the road in the vehicle's frame. (4, 4)

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is malformed; the message names the line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no file of poses {path}.")
    times, values, foreign = [], [], []
    with naming(path, "see docs/inference.md"):
        for number, row in _rows(read_text(path)):
            try:
                time_ns = _time_of(row, time_of)
                if time_ns is None:
                    foreign.append(row[_FRAME])
                    continue
                values.append(_pose_of(row))
            except ValueError as error:
                raise InputError(f"line {number}: {error}") from error
            times.append(time_ns)
        if not times and foreign:
            raise InputError(
                f"none of its {len(foreign)} frames is the name of an image: it has "
                f"{foreign[0]!r:.60}, images are {next(iter(time_of), '')!r:.60}"
            )
        if not times:
            raise InputError("it holds no pose")
        rows = np.array(values, np.float64)
        turns = Rotation.from_quat(rows[:, [4, 5, 6, 3]]).as_matrix()
        poses = [rigid(turn, row[:3]) @ ground for turn, row in zip(turns, rows, strict=True)]
        return PoseTrack(times, poses)


def _rows(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the lines below the first, with their numbers, by the names in the first."""
    lines = text.splitlines()
    start = next((n for n, line in enumerate(lines) if line.strip()), None)
    if start is None:
        raise InputError("it is empty")
    separator = max(_SEPARATORS, key=lines[start].count)
    table = csv.reader(lines[start:], delimiter=separator, skipinitialspace=True)
    try:
        names = [name.strip() for name in next(table)]
        _require_columns(names)
        for row in table:
            if not any(value.strip() for value in row):
                continue
            number = start + table.line_num
            if len(row) < len(names):
                raise InputError(f"line {number}: it has {len(row)} of {len(names)} columns")
            cells = [value.strip() for value in row]
            if separator != ",":
                cells = [value.replace(",", ".") for value in cells]
            yield number, dict(zip(names, cells, strict=False))
    except csv.Error as error:
        raise InputError(f"it is no CSV: {error}") from error


def _require_columns(names: Collection[str]) -> None:
    """Refuse a first line without the columns that are needed."""
    missing = [name for name in _VALUES if name not in names]
    if _TIME not in names and _FRAME not in names:
        missing.insert(0, f"{_TIME} or {_FRAME}")
    if missing:
        raise InputError(
            f"its first line must name the columns {_TIME} or {_FRAME}, {', '.join(_VALUES)}; it "
            f"lacks {', '.join(missing)} and has {list(names)[:_SHOWN]!r:.200}"
        )


def _time_of(row: Mapping[str, str], time_of: Mapping[str, int]) -> int | None:
    """Return the time of a row; None where it names no image."""
    if _FRAME in row:
        name = row[_FRAME]
        return time_of.get(name, time_of.get(Path(name).stem))
    text = row[_TIME]
    if match := _NUMBER.fullmatch(text):
        return int(match[1])
    if re.fullmatch(r"\d([.,]\d+)?[eE]\+?\d+", text):
        raise InputError(
            f"{_TIME} is {text!r:.40}, rounded as spreadsheets write long numbers: keep its digits"
        )
    raise InputError(f"{_TIME} is {text!r:.40}, no whole number of nanoseconds")


def _pose_of(row: Mapping[str, str]) -> list[float]:
    """Return a row's position and quaternion."""
    values = []
    for name in _VALUES:
        try:
            values.append(float(row[name]))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise InputError(f"{name} is {row[name]!r:.40}, no finite number")
    if not abs(math.hypot(*values[3:]) - 1) < _LENGTH_TOLERANCE:
        raise InputError(f"a quaternion must have length 1, got {values[3:]}")
    return values
