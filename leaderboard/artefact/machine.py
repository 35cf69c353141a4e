"""What the machine has to spare for a child process, and what a child has used. Linux only."""

from __future__ import annotations

import os
from pathlib import Path

from sme_registry.io import available_memory

RESERVED_BYTES = 256 * 2**20  # for the scorer itself and the child's libraries


def processor_seconds(pid: int) -> float:
    """Processor time of a process and its descendants, in seconds; 0 for a process that is gone."""
    ticks = 0
    pending = [pid]
    while pending:
        process = Path("/proc", str(pending.pop()))
        try:
            numbers = (process / "stat").read_text().rpartition(")")[2].split()
            children = [path.read_text() for path in process.glob("task/*/children")]
        except OSError:  # it ended meanwhile
            continue
        ticks += sum(map(int, numbers[11:15]))  # utime, stime, and those of waited-for children
        pending += map(int, " ".join(children).split())
    return ticks / os.sysconf("SC_CLK_TCK")


def spare_memory() -> int:
    """Memory in bytes that a new process can use before the system ends one for lack of it."""
    return max((available_memory() or 0) - RESERVED_BYTES, 0)
