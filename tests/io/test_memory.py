"""Memory that a machine has to spare, read from a copy of its files."""

import os
import sys

import pytest

from sme_registry.io import available_memory, system

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

MIB = 2**20


@pytest.fixture
def groups(monkeypatch, tmp_path):
    """A machine with 64 GiB and these control groups: limit, use and cache in MiB by folder."""

    def made(membership, limits, names):
        (tmp_path / "self").mkdir()
        (tmp_path / "self" / "cgroup").write_text(membership)
        (tmp_path / "meminfo").write_text(f"MemTotal: 0 kB\nMemAvailable: {64 * MIB} kB\n")
        for folder, (limit, use, cache) in limits.items():
            group = tmp_path / "groups" / folder
            group.mkdir(parents=True, exist_ok=True)
            limit_name, use_name, cache_name = names
            number = limit if isinstance(limit, str) else str(limit * MIB)
            (group / limit_name).write_text(number + "\n")
            (group / use_name).write_text(f"{use * MIB}\n")
            (group / "memory.stat").write_text(f"anon 1\n{cache_name} {cache * MIB}\n")
        monkeypatch.setattr(system, "_PROC", tmp_path)
        monkeypatch.setattr(system, "_CGROUPS", tmp_path / "groups")
        return available_memory() // MIB

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
        ({"a/b": (300, 400, 0)}, 0),
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
    assert 0 < available_memory() < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def test_without_control_groups_or_a_list_of_memory_all_of_the_machine_counts(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(system, "_PROC", tmp_path)
    assert available_memory() == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    (tmp_path / "meminfo").write_text("MemTotal: 256 kB\nMemAvailable: 64 kB\n")
    assert available_memory() == 64 * 1024
