"""Studies run without what only POSIX systems have, as on Windows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sme_registry.studies.engine.status import study_status
from tests.studies.cells import small_file

ROOT = Path(__file__).resolve().parents[3]

# File locks use fcntl through filelock, which has another implementation on Windows.
WITHOUT_POSIX = """
import os, signal, sys
from multiprocessing import resource_tracker
import filelock
if __name__ == "__main__":
    resource_tracker.ensure_running()  # used on POSIX alone, and by multiprocessing itself
for module in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[module] = None
del signal.pthread_sigmask, os.sched_getaffinity
"""
RUN = """
from sme_registry.cli import main
from sme_registry import datasets, diagnosis, offline, training
for name in ("SIGHUP", "SIGALRM", "SIGCHLD"):
    delattr(signal, name)
if __name__ == "__main__":
    main()
"""


@pytest.mark.parametrize("executor", ["in-process", "processes"])
def test_a_study_runs_without_posix_modules_and_signals(executor: str, tmp_path: Path) -> None:
    plan, study = tmp_path / "plan.json", tmp_path / "study"
    small_file(seeds=2).write(plan)
    script = tmp_path / "sme_without_posix.py"
    script.write_text(WITHOUT_POSIX + RUN)
    command = [sys.executable, str(script), "study", "run", str(plan), "-f", str(study)]
    process = subprocess.run(
        [*command, "--executor", executor, "--jobs", "2"],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(tmp_path)},
    )
    assert process.returncode == 0, process.stderr
    assert study_status(study).count("done") == 2
