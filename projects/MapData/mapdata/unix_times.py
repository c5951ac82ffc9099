"""Unix times: detection of their unit, and their text in messages.

A Unix time is the time since the start of 1970 in UTC. Times of other clocks, such as the time
since a device was switched on, have much smaller numbers.
"""

from collections.abc import Iterable
from datetime import datetime, timezone
from typing import Any

import numpy as np

_FROM_NS = 946_684_800 * 10**9  # start of the year 2000, the first valid time
_TO_NS = 4_102_444_800 * 10**9  # start of the year 2100, no longer valid
_UNITS_NS = (10**9, 10**6, 10**3, 1)  # seconds, milliseconds, microseconds, nanoseconds


def unix_time_ns(number: float, unit_ns: int | None = None) -> int | None:
    """Convert a Unix time to nanoseconds.

    Args:
        number: Time since the start of 1970.
        unit_ns: Unit of the time in nanoseconds. None detects seconds, milliseconds, microseconds
            or nanoseconds: a number is in the years 2000 to 2099 in at most one of these units.

    Returns:
        The time in nanoseconds; None if it is not in the years 2000 to 2099.
    """
    # No valid time is so large. The test also refuses NaN and infinity, which cannot be rounded.
    if not abs(number) < 1 << 63:
        return None
    whole = round(number)
    units = _UNITS_NS if unit_ns is None else (unit_ns,)
    for unit in units:
        # A whole number is multiplied as an integer, which has no rounding error.
        time_ns = whole * unit if whole == number else round(number * unit)
        if _FROM_NS <= time_ns < _TO_NS:
            return time_ns
    return None


def in_nanoseconds(time: Any, usual_unit_ns: int) -> int:
    """Convert a time from a file to nanoseconds.

    Args:
        time: A Unix time in seconds, milliseconds, microseconds or nanoseconds, or a time of
            another clock, as a number or the text of an integer.
        usual_unit_ns: Unit of the times of other clocks, in nanoseconds.

    Returns:
        The time in nanoseconds.

    Raises:
        ValueError: If a text is no integer, or a time is NaN.
        OverflowError: If a time is infinite.
    """
    # An integer stays an integer, because a float would round nanoseconds.
    number = float(time) if isinstance(time, (float, np.floating)) else int(time)
    time_ns = unix_time_ns(number)
    return round(number * usual_unit_ns) if time_ns is None else time_ns


def span_of(times_ns: Iterable[int]) -> str:
    """Format the first and last of times in nanoseconds: in UTC, or in seconds of another clock.

    The times are in any order, and there is at least one.
    """
    times = list(times_ns)
    return f"{_text_of(min(times))} to {_text_of(max(times))}"


def _text_of(time_ns: int) -> str:
    """Text of a time in UTC; in seconds if it is no Unix time of the years 2000 to 2099."""
    if unix_time_ns(time_ns, unit_ns=1) is None:
        return f"{time_ns / 1e9:.3f} s"
    seconds, fraction_ns = divmod(time_ns, 10**9)
    text = datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")
    return f"{text}.{fraction_ns // 10**6:03d} UTC"
