"""Isolation is chosen, and nothing runs with less; what a machine has to spare, and has used."""

import shutil
import subprocess
import sys

import pytest

from leaderboard.errors import ScoringFault
from leaderboard.gate import isolation
from leaderboard.gate.isolation import (
    RESERVED_BYTES,
    available_isolation,
    processor_seconds,
    spare_memory,
)
from leaderboard.gate.sandbox import Sandbox
from tests.leaderboard.gate.models import ACTION, OBSERVATION, linear

MODEL = linear().SerializeToString()


@pytest.fixture
def bubblewrap(monkeypatch, tmp_path):
    """A machine whose bubblewrap is a script."""

    def install(script):
        program = tmp_path / "bwrap"
        program.write_text(f"#!{sys.executable}\n{script}")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path))
        isolation._bwrap.cache_clear()

    yield install
    isolation._bwrap.cache_clear()


@pytest.mark.parametrize("script", ["raise SystemExit(1)", "print('bwrap: No permissions')"])
def test_bubblewrap_that_does_not_work_is_a_fault_and_nothing_runs_without_it(script, bubblewrap):
    bubblewrap(script)
    for _ in range(2):
        with pytest.raises(ScoringFault, match="does not start a process"):
            available_isolation()
        for asked in (None, "bwrap"):
            with pytest.raises(ScoringFault, match="does not start a process"):
                Sandbox(MODEL, OBSERVATION, ACTION, isolation=asked)
    with Sandbox(MODEL, OBSERVATION, ACTION, isolation="process") as policy:  # chosen below it
        assert policy.isolation == "process"


@pytest.fixture
def working():
    """A script that is the bubblewrap of this machine."""
    found = shutil.which("bwrap")
    if found is None:
        pytest.skip("bubblewrap is not installed")
    return f"import os, sys; os.execv({found!r}, sys.argv)"


def test_a_failure_of_bubblewrap_is_not_remembered(bubblewrap, working):
    bubblewrap("raise SystemExit(1)")
    with pytest.raises(ScoringFault):
        available_isolation()
    bubblewrap(working)
    assert available_isolation() == "bwrap"
    with Sandbox(MODEL, OBSERVATION, ACTION) as policy:
        assert policy.isolation == "bwrap"


def test_bubblewrap_that_fails_later_is_a_fault(bubblewrap, working):
    bubblewrap(working)
    assert available_isolation() == "bwrap"
    with open(shutil.which("bwrap"), "w") as program:
        program.write(f"#!{sys.executable}\nraise SystemExit(1)")
    for _ in range(2):
        with pytest.raises(ScoringFault, match="not caused by the model"):
            Sandbox(MODEL, OBSERVATION, ACTION)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(("available", "spare"), [(RESERVED_BYTES + 7, 7), (7, 0), (None, 0)])
def test_a_child_may_use_the_available_memory_without_a_reserve(monkeypatch, available, spare):
    monkeypatch.setattr(isolation, "available_memory", lambda: available)
    assert spare_memory() == spare


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
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
