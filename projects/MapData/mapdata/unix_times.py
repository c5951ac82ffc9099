"""Unix times: their unit by their size, and how a message names them."""

from collections.abc import Iterable
from datetime import datetime, timezone
from typing import Any

import numpy as np

_FROM_NS, _TO_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9  # the years 2000 to 2099
_UNITS_NS = (10**9, 10**6, 10**3, 1)


def unix_time_ns(number: float, unit_ns: int | None = None) -> int | None:
    """Return a Unix time in nanoseconds; None if it is not of the years 2000 to 2099.

    Args:
        number: The time since 1970.
        unit_ns: Its unit in nanoseconds. By default the one of seconds, milliseconds, microseconds
            and nanoseconds that puts it into these years, of which there is one at most.
    """
    if not abs(number) < 1 << 63:  # NaN neither
        return None
    whole = round(number)
    for unit in _UNITS_NS if unit_ns is None else (unit_ns,):
        time_ns = whole * unit if whole == number else round(number * unit)
        if _FROM_NS <= time_ns < _TO_NS:
            return time_ns
    return None


def in_nanoseconds(time: Any, usual_unit_ns: int) -> int:
    """Return a time that a file brings, in nanoseconds.

    Args:
        time: A Unix time of any unit, or a time of another clock; a number or the text of one.
        usual_unit_ns: Unit in nanoseconds of a time that is no Unix time.
    """
    number = float(time) if isinstance(time, (float, np.floating)) else int(time)
    known = unix_time_ns(number)
    return round(number * usual_unit_ns) if known is None else known


def span_of(times_ns: Iterable[int]) -> str:
    """Return the first and the last of times as a text: in UTC, or in seconds of another clock."""
    times = list(times_ns)
    return f"{_text_of(min(times))} to {_text_of(max(times))}"


def _text_of(time_ns: int) -> str:
    if unix_time_ns(time_ns, 1) is None:
        return f"{time_ns / 1e9:.3f} s"
    text = datetime.fromtimestamp(time_ns // 10**9, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")
    return f"{text}.{time_ns % 10**9 // 10**6:03d} UTC"
