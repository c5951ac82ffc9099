"""Order and times of images, from the names of their files."""

import re
from collections.abc import Collection
from pathlib import Path

from mapdata.unix_times import unix_time_ns

# Digits at the end of a name: a whole number of 10, 13, 16 or 19 digits, and an optional fraction.
_TIME = re.compile(r"(?:^|\D)(\d{10}(?:\d{3}|\d{6}|\d{9})?)(?:\.(\d{1,9}))?$")
# Year, month, day and hour, such as 2023100512. They may be followed by the minutes, and these by
# the seconds with the digits of their fraction.
_DATE = re.compile(
    r"20\d\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])([01]\d|2[0-3])([0-5]\d([0-5]\d*)?)?"
)


def natural_sort_key(path: Path) -> list[str | int]:
    """Sort key of a file's path, in which digits count as numbers: 2 before 10."""
    # Text and digits alternate, beginning with text that may be empty. So numbers are never
    # compared with text.
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if number % 2 else part for number, part in enumerate(parts)]


def times_of_names(stems: Collection[str]) -> dict[str, int] | None:
    """Parse the Unix times at the ends of file names.

    A time has 10 digits (s), 13 (ms), 16 (us) or 19 (ns), or is in seconds with a fraction. It is
    in the years 2000 to 2099. A date and hour such as 2023100512 is also a Unix time in seconds, of
    the year 2034. Therefore no number is taken as a time if the numbers of all names can be dates.

    Args:
        stems: File names without their suffixes.

    Returns:
        Times in nanoseconds by name; None if a name has no time, or if all numbers can be dates.
    """
    times = {}
    are_dates = True
    for stem in stems:
        match = _TIME.search(stem)
        time_ns = _time_ns(whole=match[1], fraction=match[2]) if match else None
        if match is None or time_ns is None:
            return None
        times[stem] = time_ns
        are_dates = are_dates and _DATE.fullmatch(match[1]) is not None
    return None if are_dates else times


def _time_ns(whole: str, fraction: str | None) -> int | None:
    """Time in nanoseconds from the digits before and after the point; None if it is no time."""
    if fraction is not None and len(whole) > 10:
        return None  # only seconds have a fraction
    # 10 digits are in seconds. With each further digit, the unit is ten times smaller.
    time_ns = unix_time_ns(int(whole), unit_ns=10 ** (19 - len(whole)))
    if time_ns is None:  # not in the years 2000 to 2099
        return None
    # The fraction of a second is filled up to nine digits, which are nanoseconds.
    return time_ns + int((fraction or "0").ljust(9, "0"))
