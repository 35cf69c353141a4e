"""Running a study: nothing lost, nothing twice, whatever ends a process or a disk."""

import contextlib
import io
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.studies.ledger import Ledger, study_status
from sme_registry.studies.result import CellFailure
from tests.commands import sme
from tests.studies import cells
from tests.studies.cells import ROOT, python, quick, small_file

DRIVER = """
import sys
from functools import partial
from pathlib import Path
from sme_registry.studies.runner import run_study
from tests.studies import cells
study, notes, seeds, open_for = sys.argv[1:]
work = partial(cells.gated, Path(notes), open_for=int(open_for))
run_study(cells.small_file(int(seeds)), study, jobs=2, run=work)
"""
UNGUARDED = """
import sys
from sme_registry.studies.runner import run_study
from tests.studies import cells
print("begun")
status = run_study(cells.small_file(), sys.argv[1], jobs=2)
print(status.count("done"), "done")
"""
# A file may grow no longer than a plan: results are longer.
FULL_DISK = """
import resource, sys
from sme_registry.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
main()
"""

# File locks use fcntl through filelock, which has another implementation on Windows.
MAIN = "from sme_registry.cli import main; main()"
WITHOUT_POSIX = """
import os, signal, sys
if "resource_tracker" not in " ".join(sys.orig_argv):
    from multiprocessing import resource_tracker
    import filelock
    if "--multiprocessing-fork" not in sys.orig_argv:
        resource_tracker.ensure_running()  # used on POSIX alone, and by multiprocessing itself
    for module in ("fcntl", "grp", "pwd", "resource", "termios"):
        sys.modules[module] = None
    del signal.pthread_sigmask, os.sched_getaffinity
    for name in ("SIGHUP", "SIGALRM", "SIGCHLD"):
        delattr(signal, name)
"""


@pytest.fixture(autouse=True)
def _processes_start_sooner(monkeypatch):
    """Loading Numba takes longer than a small cell."""
    monkeypatch.setenv("SME_BACKEND", "numpy")


@pytest.fixture
def notes(tmp_path):
    folder = tmp_path / "notes"
    folder.mkdir()
    return folder


@pytest.fixture(autouse=True)
def _path(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("COLUMNS", "120")


@pytest.fixture
def study(tmp_path):
    return tmp_path / "study"


def driver(study, notes, seeds, open_for=0):
    arguments = (str(study), str(notes), str(seeds), str(open_for))
    return subprocess.Popen(
        [sys.executable, "-c", DRIVER, *arguments], stderr=subprocess.PIPE, text=True
    )


def keys(file):
    return {planned.cell.digest for planned in file.plan.cells}


def test_every_cell_is_run_once_and_running_again_runs_nothing(study, notes):
    file, work = small_file(seeds=3), partial(cells.noted, notes)
    status, output = quick(file, study, run=work)
    assert (status.count("done"), len(status.cells)) == (3, 3)
    assert set(Ledger(study).results()) == keys(file)
    assert "3 cells · 3 to run · 1 at once" in output
    again, output = quick(file, study, run=work)
    assert again == status
    assert "3 finished before and reused · 0 to run" in output
    assert set(cells.starts(notes).values()) == {1}


def test_a_process_of_each_cell_gives_the_same_results_with_one_thread(study, notes, tmp_path):
    file = small_file(seeds=1)
    quick(file, tmp_path / "here")
    before = dict(os.environ)
    status, _ = quick(file, study, executor="processes", run=partial(cells.surroundings, notes))
    assert status.count("done") == 1
    assert (notes / "threads").read_text() == "1 1"
    assert dict(os.environ) == before
    here = Ledger(tmp_path / "here").results()
    for key, result in Ledger(study).results().items():
        # This process may have loaded more than the cell's own did, and a report names all of it.
        ours = here[key].report.model_copy(update={"versions": result.report.versions})
        assert result.report == ours


def test_a_cell_that_raises_is_listed_with_its_error_and_retried_on_request(study):
    file = small_file(seeds=3)
    status, output = quick(file, study, run=cells.raising)
    assert [status.count(state) for state in ("done", "failed", "waiting")] == [2, 1, 0]
    (broken,) = status.failed
    assert broken.planned.run == 1
    assert broken.failure.error == "ValueError: this one is broken"
    assert "in raising" in broken.failure.traceback
    assert "failed: constant on small, run 1: ValueError: this one is broken" in output

    status, output = quick(file, study, run=cells.raising)
    assert "1 failed before (--retry runs them again) · 0 to run" in output
    status, _ = quick(file, study, run=cells.raising, retry_failed=True)
    assert status.failed[0].failure.attempts == 2
    status, _ = quick(file, study, retry_failed=True)
    assert status.count("done") == 3
    assert not Ledger(study).failures()


def test_what_another_run_saw_fail_or_finish_meanwhile_is_not_run_again(study, notes):
    file = small_file(seeds=3)
    first, second, third = (planned.cell for planned in file.plan.cells)

    def beside_another(cell, progress, model_path):
        failure = CellFailure(
            key=second.digest, cell=second, error="theirs", traceback="", versions={}
        )
        Ledger(study).write(failure)
        Ledger(study).write(cells.run_cell(third))
        return cells.noted(notes, cell)

    status, _ = quick(file, study, run=beside_another)
    assert set(cells.starts(notes)) == {first.digest}
    assert (status.count("done"), status.count("failed")) == (2, 1)
    assert status.failed[0].failure.error == "theirs"


def test_a_cell_whose_process_is_killed_fails_and_the_others_go_on(study):
    status, _ = quick(small_file(seeds=3), study, executor="processes", jobs=2, run=cells.dying)
    assert (status.count("done"), status.count("failed")) == (2, 1)
    failure = status.failed[0].failure
    assert "killed by SIGKILL" in failure.error
    assert "Memory may have run out" in failure.error
    assert failure.traceback == "last words\n"


def test_a_cleaner_of_temporary_files_fails_no_cell(study, tmp_path, monkeypatch):
    # Should the cells' folder ever be another, what is removed is this one, and nobody else's.
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    status, _ = quick(small_file(2), study, executor="processes", jobs=1, run=cells.littering)
    assert status.count("done") == 2, [cell.failure for cell in status.failed]


def test_after_kill_9_only_the_cells_that_ran_are_run_again(study, notes):
    with driver(study, notes, seeds=5, open_for=2) as killed:
        try:
            # Two have finished, and two wait at the gate.
            cells.wait_for(lambda: sum(cells.starts(notes).values()) == 4)
            cells.wait_for(lambda: len(Ledger(study).results()) == 2)
        finally:
            killed.kill()
    children = cells.pids(notes)
    cells.wait_for(lambda: not any(map(cells.alive, children)))
    status = study_status(study)
    assert (status.count("done"), status.count("running")) == (2, 0)
    finished = set(Ledger(study).results())

    (notes / cells.GATE).touch()
    status, _ = quick(small_file(seeds=5), study, run=partial(cells.gated, notes))
    assert status.count("done") == 5
    begun = cells.starts(notes)
    assert {key for key, times in begun.items() if times == 1} >= finished
    assert sum(begun.values()) == 5 + 2


def test_two_runs_on_one_folder_share_the_cells_and_each_is_run_once(study, notes):
    with driver(study, notes, seeds=5) as one, driver(study, notes, seeds=5) as two:
        try:
            # All that they hold wait at the gate: two cells each, and no cell twice.
            cells.wait_for(lambda: sum(cells.starts(notes).values()) == 4)
            assert study_status(study).count("running") == 4
            (notes / cells.GATE).touch()
            output = [process.communicate(timeout=120)[1] for process in (one, two)]
        finally:
            one.kill()
            two.kill()
    assert [one.returncode, two.returncode] == [0, 0], output
    assert cells.starts(notes) == dict.fromkeys(keys(small_file(seeds=5)), 1)
    assert study_status(study).count("done") == 5


def test_ctrl_c_ends_in_one_line_that_says_how_to_go_on(study, tmp_path):
    plan = tmp_path / "plan.json"
    small_file(algorithms=("constant",), evaluations=100_000, evaluation_episodes=100).write(plan)
    command = [sys.executable, "-c", "from sme_registry.cli import main; main()"]
    command += ["study", "run", str(plan), "--folder", str(study), "--jobs", "2"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            cells.wait_for((study / "plan.json").exists)
            cells.wait_for(lambda: study_status(study).count("running") == 2)
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the children, too
            _, output = process.communicate(timeout=120)
        finally:
            with contextlib.suppress(ProcessLookupError):  # nobody is left
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert output.splitlines()[-1] == (
        f"error: interrupted: 0 of 2 cells have finished and are in {study}. Run the same command "
        "to continue."
    )
    assert "Traceback" not in output
    assert study_status(study).count("waiting") == 2


def test_a_corrupt_result_is_set_aside_and_its_cell_run_again(study, notes):
    file, work = small_file(seeds=2), partial(cells.noted, notes)
    quick(file, study, run=work)
    path = min((study / "cells").iterdir())
    path.write_text(path.read_text()[:-100])
    assert study_status(study).count("waiting") == 1
    status, output = quick(file, study, run=work)
    assert status.count("done") == 2
    assert "Renamed to" in output
    assert sorted(cells.starts(notes).values()) == [1, 2]
    assert path.with_name(f"{path.name}.corrupt").exists()


def test_of_an_edited_plan_only_the_new_cells_are_run(study, notes):
    work = partial(cells.noted, notes)
    quick(small_file(seeds=2), study, run=work)
    edited = small_file(seeds=3, algorithms=("optimal", "constant"))
    status, output = quick(edited, study, run=work)
    assert status.count("done") == 6
    assert "The folder's plan was small-v1" in output
    assert "2 finished before and reused · 4 to run" in output
    assert set(cells.starts(notes).values()) == {1}
    assert Ledger(study).plan_file() == edited
    status, _ = quick(small_file(seeds=1), study, run=work)
    assert (len(status.cells), status.other_results) == (1, 5)
    assert len(cells.starts(notes)) == 6


def test_on_a_full_disk_it_stops_with_a_typed_error_and_loses_nothing(study, tmp_path):
    plan, small = tmp_path / "plan.json", small_file(seeds=2)
    small.write(plan)
    quick(small_file(seeds=1), study)
    before = {path: path.read_bytes() for path in (study / "cells").iterdir()}
    command = ("study", "run", plan, "-f", study, "--executor", "in-process")
    process = python(FULL_DISK, *command)
    assert process.returncode == 2, process.stderr
    assert process.stderr.splitlines()[-1].startswith("error: ")
    assert "cannot be written: File too large" in process.stderr
    assert "Traceback" not in process.stderr
    assert {path: path.read_bytes() for path in (study / "cells").iterdir()} == before
    status, _ = quick(small, study)
    assert status.count("done") == 2


HELD = small_file(seeds=3).plan.cells[2].cell.digest


@pytest.fixture
def read_only():
    """A study with a finished cell, and one that runs, that nobody may write to, not even root."""
    folder = Path(tempfile.mkdtemp(prefix="read-only-"))
    quick(small_file(seeds=1), folder)
    lock = Ledger(folder).lock(HELD)
    for path in (*folder.rglob("*"), folder):
        path.chmod(0o555 if path.is_dir() else 0o444)
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    yield folder
    if root:
        os.seteuid(0)
    lock.release()
    for path in (folder, *filter(Path.is_dir, folder.iterdir())):
        path.chmod(0o755)
    shutil.rmtree(folder)


def test_a_read_only_folder_is_a_typed_error_and_can_still_be_looked_at(read_only):
    other = small_file(seeds=2).plan.cells[1].cell.digest
    with pytest.raises(OptionError, match=r"plan\.json: cannot be written: Permission denied"):
        quick(small_file(seeds=2), read_only)
    with pytest.raises(OptionError, match="cannot be locked: Permission denied"):
        Ledger(read_only).lock(other)
    assert [Ledger(read_only).is_running(key) for key in (HELD, other)] == [True, False]
    assert study_status(read_only).count("done") == 1
    status, _ = quick(small_file(seeds=1), read_only)  # nothing to write
    assert status.count("done") == 1


@pytest.mark.parametrize("executor", ["in-process", "processes"])
def test_models_are_kept_where_that_is_asked_for(executor, study):
    file = small_file(seeds=1)
    quick(file, study, run=cells.modelled, only=["class=small"])
    assert not (study / "models").exists()
    kept = study.with_name("kept")
    quick(file, kept, executor=executor, run=cells.modelled, keep_models=True)
    for key in keys(file):
        assert Ledger(kept).model_path(key).read_bytes() == key.encode()


def test_finished_cells_do_not_run_again_for_their_models(study):
    file = small_file(seeds=2)
    quick(file, study)
    _, output = quick(file, study, run=cells.modelled, keep_models=True)
    assert "2 finished before and reused · 0 to run" in output
    assert not (study / "models").exists()


def test_results_of_other_versions_are_reused_and_said_to_be(study):
    file = small_file(seeds=3)
    quick(file, study)
    ledger = Ledger(study)
    for planned, numpy in zip(file.plan.cells, ("1.0.0", "1.0.1"), strict=False):
        result = ledger.result(planned.cell.digest)
        versions = {**result.versions, "numpy": numpy, "of a package that is not installed": "1"}
        ledger.write(result.model_copy(update={"versions": versions}))
    status, output = quick(file, study)
    assert status.count("done") == 3
    here = f"(installed: {np.__version__})"
    assert (
        f"Reused results come from other package versions: numpy 1.0.0 {here}, numpy 1.0.1 {here}."
    ) in " ".join(output.split())
    fresh = study.with_name("fresh")
    quick(file, fresh)
    assert "other versions" not in quick(file, fresh)[1]


def test_a_result_of_another_cell_is_a_failure(study):
    other = small_file(seeds=3).plan.cells[2].cell
    status, _ = quick(small_file(seeds=1), study, run=lambda *arguments: cells.run_cell(other))
    assert "the result belongs to another cell, sha256:" in status.failed[0].failure.error


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"executor": "threads"}, UnknownNameError, "must be 'processes', 'in-process' or 'ray'"),
        ({"only": ["class"]}, OptionError, "class=GLOB"),
        ({"executor": "in-process", "jobs": 2}, OptionError, "^jobs=2: must be 1 with"),
        ({"device": "cpu"}, OptionError, "^device=.*no cell to run has one. Leave it out, or"),
        ({"lanes": 3}, OptionError, "^lanes=.*no cell to run has one. Leave it out, or"),
    ],
)
def test_bad_arguments_are_refused_and_nothing_is_written(options, error, words, study):
    with pytest.raises(error, match=words):
        quick(**{"file": small_file(), "folder": study} | options)
    assert not study.exists()


def test_a_terminal_has_bars_and_anything_else_lines(study, monkeypatch):
    monkeypatch.setattr("sme_registry.io.terminal.Progress._line_is_due", lambda *_: True)
    _, output = quick(small_file(seeds=2), study)
    assert "study small-v1: 1 of 2 cells · " in output
    assert " · about " in output
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120)
    status, _ = quick(small_file(seeds=4), study, console=console, run=cells.modelled)
    assert status.count("done") == 4
    assert "constant on small, run 3" in screen.getvalue()
    assert "━" in screen.getvalue()


def test_the_command_ends_with_1_where_a_cell_failed_and_lists_it(study, tmp_path):
    plan = tmp_path / "plan.json"
    pytest.importorskip("stable_baselines3")
    bad = {"name": "bad", "uses": "math:sqrt"}
    small_file(algorithms=["constant", bad]).write(plan)
    command = ("study", "run", plan, "-f", study, "--executor", "in-process")
    result = sme(*command)
    assert result.exit_code == 1, result.output
    again = ("sme", *command[:2], f"{study}/plan.json", "--folder", f"{study}", "--retry")
    assert f"2 of 4 cells failed. To run them again: {shlex.join(again)}\n" in result.stderr
    one = sme(*command, "--only", "run=0")
    assert f"{shlex.join((*again, '--only', 'run=0'))}\n" in one.stderr
    assert "bad on small, run 0: OptionError: " in result.stdout
    again = sme(*command, "--retry", "--json")
    assert again.exit_code == 1
    printed = json.loads(again.stdout)
    assert (printed["done"], printed["failed"]) == (2, 2)
    assert [failure["attempts"] for failure in printed["failures"]] == [2, 2]


def test_a_study_runs_without_posix_modules_and_signals(tmp_path):
    plan, study = tmp_path / "plan.json", tmp_path / "study"
    small_file(seeds=2).write(plan)
    (tmp_path / "sitecustomize.py").write_text(WITHOUT_POSIX)  # of this process and its children
    command = [sys.executable, "-c", MAIN, "study", "run", str(plan), "-f", str(study)]
    process = subprocess.run(
        [*command, "--executor", "processes", "--jobs", "2"],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": f"{tmp_path}:{ROOT}", "PATH": "", "HOME": str(tmp_path)},
    )
    assert process.returncode == 0, process.stderr
    assert study_status(study).count("done") == 2


def test_a_script_needs_no_guard_for_its_processes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    process = subprocess.run(
        [sys.executable, script, tmp_path / "study"], capture_output=True, text=True, check=True,
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120,
    )  # fmt: skip
    assert process.stdout.splitlines() == ["begun", "2 done"]
