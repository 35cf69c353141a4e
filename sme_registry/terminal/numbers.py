"""How numbers and durations are written for people."""

from __future__ import annotations

_SECONDS_PER_DAY = 86_400


def fixed(value: float, digits: int = 3) -> str:
    """A number with a fixed count of digits, and no negative zero."""
    return f"{value:z.{digits}f}"


def duration(seconds: float) -> str:
    """`42 s`, `3 min 10 s`, `2 h 5 min`, `3.5 days`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if whole < 2 * _SECONDS_PER_DAY:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{seconds / _SECONDS_PER_DAY:.1f} days"


def duration_range(low: float, high: float) -> str:
    """`3 min 10 s`, or `2 h 0 min to 4 h 5 min` where the bounds differ."""
    first, last = duration(low), duration(high)
    return first if first == last else f"{first} to {last}"
