"""What a machine has to spare, read from a copy of its files, and what a process has used."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from leaderboard.artefact import machine
from leaderboard.artefact.machine import RESERVED_BYTES, processor_seconds, spare_memory

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

MIB = 2**20


@pytest.fixture
def groups(monkeypatch, tmp_path):
    """A machine with 64 GiB and these control groups: limit, use and cache in MiB by folder."""

    def made(membership, limits, names):
        (tmp_path / "cgroup").write_text(membership)
        (tmp_path / "meminfo").write_text(f"MemTotal: 0 kB\nMemAvailable: {64 * MIB} kB\n")
        for folder, (limit, use, cache) in limits.items():
            group = tmp_path / "groups" / folder
            group.mkdir(parents=True, exist_ok=True)
            limit_name, use_name, cache_name = names
            number = limit if isinstance(limit, str) else str(limit * MIB)
            (group / limit_name).write_text(number + "\n")
            (group / use_name).write_text(f"{use * MIB}\n")
            (group / "memory.stat").write_text(f"anon 1\n{cache_name} {cache * MIB}\n")
        monkeypatch.setattr(machine, "_PROC", tmp_path)
        monkeypatch.setattr(machine, "_MEMBERSHIP", tmp_path / "cgroup")
        monkeypatch.setattr(machine, "_CGROUPS", tmp_path / "groups")
        return (spare_memory() + RESERVED_BYTES) // MIB

    return made


VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
VERSION_2 = ("memory.max", "memory.current", "inactive_file")


@pytest.mark.parametrize(
    ("limits", "spare"),
    [
        ({"a/b": (900, 100, 0)}, 800),
        ({"a/b": (900, 100, 50)}, 850),
        ({"a/b": ("max", 100, 50), "a": (500, 100, 0)}, 400),
        ({"a/b": (900, 100, 0), "a": (500, 100, 0)}, 400),
        ({"a/b": (300, 400, 0)}, 256),
        ({"a/b": ("max", 100, 0)}, 64 * 1024),
        ({}, 64 * 1024),
    ],
)
def test_the_smallest_remainder_of_all_groups_counts(groups, limits, spare):
    assert groups("0::/a/b\n", limits, VERSION_2) == spare


def test_groups_of_version_1_count(groups):
    limits = {"memory/a": (900, 100, 20), "a": (1, 1, 0)}
    assert groups("3:cpu:/a\n2:memory,hugetlb:/a\n0::/\n", limits, VERSION_1) == 820


def test_this_machine_has_memory_to_spare():
    assert 0 < spare_memory() < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def test_processor_time_includes_descendants():
    script = (
        "import sys, time\n"
        "while time.process_time() < 0.3: pass\n"
        "print(flush=True); sys.stdin.read()\n"
    )
    inner = f"exec({script!r})"
    outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}])"
    with subprocess.Popen(
        [sys.executable, "-c", outer], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert processor_seconds(process.pid) >= 0.2
        process.communicate()
    assert processor_seconds(process.pid) == 0.0
