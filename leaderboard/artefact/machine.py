"""What the machine has to spare for a child process, and what a child has used. Linux only."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

RESERVED_BYTES = 256 * 2**20  # for the scorer itself and the child's libraries

_PROC = Path("/proc")
_MEMBERSHIP = Path("/proc/self/cgroup")
_CGROUPS = Path("/sys/fs/cgroup")


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
    available = [_meminfo()["MemAvailable"] * 1024]
    available += [limit - used for limit, used in _cgroup_memory()]
    return max(min(available) - RESERVED_BYTES, 0)


def _meminfo() -> dict[str, int]:
    lines = (_PROC / "meminfo").read_text().splitlines()
    return {line.partition(":")[0]: int(line.split()[1]) for line in lines}


def _cgroup_memory() -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of each control group with a limit that this process is in."""
    for line in _MEMBERSHIP.read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers:  # version 2
            root, names = _CGROUPS, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = _CGROUPS / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        group = root / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(root):
                yield from _limit_and_use(folder, *names)


def _limit_and_use(
    folder: Path, limit_name: str, use_name: str, cache_name: str
) -> Iterator[tuple[int, int]]:
    try:
        limit = (folder / limit_name).read_text().strip()
        use = int((folder / use_name).read_text())
        statistics = dict(map(str.split, (folder / "memory.stat").read_text().splitlines()))
    except OSError:  # the root has no limit, and in a container the outer folders are not visible
        return
    if limit != "max":
        yield int(limit), use - int(statistics.get(cache_name, "0"))
