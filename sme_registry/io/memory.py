"""Memory that this machine has to spare, also where control groups limit it (containers, Slurm)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

_PROC = Path("/proc")
_CGROUPS = Path("/sys/fs/cgroup")


def available_memory() -> int | None:
    """Memory in bytes that a process can use before the system ends one for lack of it.

    Outside Linux, all memory of the machine; None where even that is unknown.
    """
    try:
        lines = (_PROC / "meminfo").read_text().splitlines()
    except OSError:
        if not hasattr(os, "sysconf"):
            return None
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    kibibytes = {line.partition(":")[0]: int(line.split()[1]) for line in lines}
    spare = [limit - used for limit, used in _cgroup_memory()]
    return max(0, min([kibibytes["MemAvailable"] * 1024, *spare]))


def _cgroup_memory() -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of each control group with a limit that this process is in."""
    try:
        membership = (_PROC / "self" / "cgroup").read_text()
    except OSError:  # a kernel without control groups
        return
    for line in membership.splitlines():
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
