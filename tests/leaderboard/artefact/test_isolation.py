"""Isolation is chosen, and what is broken is a fault: nothing runs with less."""

from __future__ import annotations

import shutil
import sys

import pytest

from leaderboard.artefact import isolation
from leaderboard.artefact.isolation import available_isolation
from leaderboard.artefact.sandbox import Sandbox
from leaderboard.errors import ScoringFault
from tests.leaderboard.artefact.models import ACTION, OBSERVATION, linear

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


BROKEN = {
    "fails": "raise SystemExit(1)",
    "answers something else": "print('bwrap: No permissions to create a new namespace')",
}


@pytest.mark.parametrize("kind", BROKEN)
def test_bubblewrap_that_does_not_work_is_a_fault_and_nothing_runs_without_it(kind, bubblewrap):
    bubblewrap(BROKEN[kind])
    for _ in range(2):
        with pytest.raises(ScoringFault, match="does not start a process"):
            available_isolation()
        for asked in (None, "bwrap"):
            with pytest.raises(ScoringFault, match="does not start a process"):
                Sandbox(MODEL, OBSERVATION, ACTION, isolation=asked)
    with Sandbox(MODEL, OBSERVATION, ACTION, isolation="process") as policy:  # chosen below it
        assert policy.isolation == "process"


def test_a_failure_of_bubblewrap_is_not_remembered(bubblewrap):
    working = shutil.which("bwrap")
    if working is None:
        pytest.skip("bubblewrap is not installed")
    bubblewrap("raise SystemExit(1)")
    with pytest.raises(ScoringFault):
        available_isolation()
    bubblewrap(f"import os, sys; os.execv({working!r}, sys.argv)")
    assert available_isolation() == "bwrap"
    with Sandbox(MODEL, OBSERVATION, ACTION) as policy:
        assert policy.isolation == "bwrap"


def test_bubblewrap_that_fails_later_is_a_fault(bubblewrap):
    working = shutil.which("bwrap")
    if working is None:
        pytest.skip("bubblewrap is not installed")
    bubblewrap(f"import os, sys; os.execv({working!r}, sys.argv)")
    assert available_isolation() == "bwrap"
    with open(shutil.which("bwrap"), "w") as program:
        program.write(f"#!{sys.executable}\nraise SystemExit(1)")
    for _ in range(2):
        with pytest.raises(ScoringFault, match="not caused by the model"):
            Sandbox(MODEL, OBSERVATION, ACTION)


def test_only_a_machine_without_bubblewrap_runs_without_it(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    isolation._bwrap.cache_clear()
    assert available_isolation() == "process"
    with Sandbox(MODEL, OBSERVATION, ACTION) as policy:
        assert policy.isolation == "process"
    with pytest.raises(ScoringFault, match="bubblewrap is not installed"):
        Sandbox(MODEL, OBSERVATION, ACTION, isolation="bwrap")
