"""The clocks of the machine, as tests set them."""

import datetime
import time

from leaderboard.documents.submission import utc

WALL, UPTIME, BOOTTIME = time.time, time.monotonic, time.clock_gettime
AFTERWARDS = utc(datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=3))
"""When tiny seasons, and the deadlines of their tickets, are over."""


def set_clocks(monkeypatch, forward=0.0, passed=0.0):
    """Let so many hours pass, and set the machine's clock so many hours forward."""
    monkeypatch.setattr(time, "time", lambda: WALL() + 3600.0 * (forward + passed))
    monkeypatch.setattr(time, "monotonic", lambda: UPTIME() + 3600.0 * passed)
    monkeypatch.setattr(time, "clock_gettime", lambda clock: BOOTTIME(clock) + 3600.0 * passed)


def move_clock(monkeypatch, moment=AFTERWARDS):
    """Set the machine's clock to a time, as documents write it."""
    seconds = datetime.datetime.fromisoformat(moment).timestamp()
    monkeypatch.setattr(time, "time", lambda: seconds)
