"""The order of images and their times, as the names of their files tell them."""

import re
from collections.abc import Collection
from pathlib import Path

from mapdata.unix_times import unix_time_ns

_TIME = re.compile(r"(?:^|\D)(\d{10}(?:\d{3}|\d{6}|\d{9})?)(?:\.(\d{1,9}))?$")
_DATE = re.compile(  # 2023100512, with minutes, with seconds and their parts
    r"20\d\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])([01]\d|2[0-3])([0-5]\d([0-5]\d*)?)?"
)


def in_order(path: Path) -> list[str | int]:
    """Sort key of a file: its path, in which numbers count as numbers, 2 before 10."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if number % 2 else part for number, part in enumerate(parts)]


def times_of_names(stems: Collection[str]) -> dict[str, int] | None:
    """Read the Unix times at the ends of file names.

    A time has 10 digits (s), 13 (ms), 16 (us) or 19 (ns), or is in seconds with a fraction, and
    lies in the years 2000 to 2099. Names of which all read as dates hold no times.

    Args:
        stems: File names without their suffixes.

    Returns:
        Times in nanoseconds by name; None unless all names have one.
    """
    found = {stem: match for stem in stems if (match := _TIME.search(stem))}
    times = {stem: _time_ns(match[1], match[2]) for stem, match in found.items()}
    known = {stem: time_ns for stem, time_ns in times.items() if time_ns is not None}
    if len(known) < len(stems) or all(_DATE.fullmatch(match[1]) for match in found.values()):
        return None
    return known


def _time_ns(whole: str, fraction: str | None) -> int | None:
    """Return the time that digits say, if they say one."""
    if fraction is not None and len(whole) > 10:
        return None
    time_ns = unix_time_ns(int(whole), 10 ** (19 - len(whole)))
    return None if time_ns is None else time_ns + int((fraction or "0").ljust(9, "0"))
