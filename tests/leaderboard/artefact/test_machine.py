"""What a machine has to spare for a child, and what a process has used."""

from __future__ import annotations

import subprocess
import sys

import pytest

from leaderboard.artefact import machine
from leaderboard.artefact.machine import RESERVED_BYTES, processor_seconds, spare_memory

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@pytest.mark.parametrize(("available", "spare"), [(RESERVED_BYTES + 7, 7), (7, 0), (None, 0)])
def test_a_child_may_use_the_available_memory_without_a_reserve(monkeypatch, available, spare):
    monkeypatch.setattr(machine, "available_memory", lambda: available)
    assert spare_memory() == spare


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
