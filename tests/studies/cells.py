"""Plans of small cells, and work for them that waits, fails or dies as a test wants it."""

import io
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from rich.console import Console

from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.spec.study import Cell
from sme_registry.studies.cell import run_cell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.runner import run_study

ROOT = Path(__file__).resolve().parents[2]
PROTOCOL = {"states_per_region": 2, "epsilons": [1.0]}
STARTED, GATE = "started", "gate"


def file_of(name, **fields):
    """The file of a plan with these fields."""
    plan = StudyPlan.from_dict(fields)
    return StudyFile(name=name, description="For tests.", digest=plan.digest, plan=plan)


def small_file(seeds=2, algorithms=("constant",), **fields):
    """References, or other algorithms, on one small class, `seeds` runs each: milliseconds each."""
    fields = {
        "classes": [
            {"name": "small", "setting": {"state_dim": 2, "action_dim": 2}, "seeds": [1, 2]}
        ],
        "algorithms": [
            {"name": one, "uses": f"reference:{one}", "steps": 0} if isinstance(one, str) else one
            for one in algorithms
        ],
        "seeds": seeds,
        "evaluations": 0,
        "protocol": PROTOCOL,
    } | fields
    return file_of("small", **fields)


def cell_of(**fields):
    """A cell with these fields, and others for a short run."""
    defaults = {
        "hyperparameters": {}, "action_range": "symmetric", "seed": 3, "evaluation_episodes": 3,
        "protocol": {"states_per_region": 50, "epsilons": [1.0]},
    }  # fmt: skip
    return Cell(**defaults | fields)


def quick(file, folder, **options):
    """Run a plan in this process; its status, and the output."""
    output = io.StringIO()
    options = {"executor": "in-process", "console": Console(file=output, width=200)} | options
    return run_study(file, folder, **options), output.getvalue()


def python(source, *arguments):
    """Run this source in another process, which finds our packages."""
    return subprocess.run(
        [sys.executable, "-c", source, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        timeout=300,
    )


def noted(folder, cell, progress=None, model_path=None):
    """The real thing, with a note in `folder` that it was begun, and by whom."""
    handle = os.open(folder / STARTED, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(handle, f"{cell.digest} {os.getpid()} {cell.seed}\n".encode())
    os.close(handle)
    return run_cell(cell, progress, model_path)


def gated(folder, cell, progress=None, model_path=None, *, open_for=0):
    """Runs of a number from `open_for` on wait until the gate is there."""
    result = noted(folder, cell, progress, model_path)
    wait_for(lambda: cell.seed < open_for or (folder / GATE).exists())
    return result


def raising(cell, progress=None, model_path=None):
    """Run 1 raises."""
    if cell.seed == 1:
        raise ValueError("this one is broken")
    return run_cell(cell, progress, model_path)


def dying(cell, progress=None, model_path=None):
    """Run 1 is killed, as the kernel does where memory runs out."""
    if cell.seed == 1:
        print("last words", flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    return run_cell(cell, progress, model_path)


def littering(cell, progress=None, model_path=None):
    """Removes the folder for temporary files that cells share, as a cleaner of /tmp would."""
    shutil.rmtree(tempfile.gettempdir())
    return run_cell(cell)


def modelled(cell, progress=None, model_path=None):
    """Leaves a model, and says how far it is."""
    if progress is not None:
        progress(10, 10)
    if model_path is not None:
        model_path.write_bytes(cell.digest.encode())
    return run_cell(cell)


def surroundings(folder, cell, progress=None, model_path=None):
    """Writes down the threads that this process may use."""
    import numba

    threads = f"{os.environ['OMP_NUM_THREADS']} {numba.get_num_threads()}"
    (folder / "threads").write_text(threads)
    return run_cell(cell)


def numbers(study):
    """All results but their times, and the versions of what else this process has loaded."""
    documents = {key: result.to_dict() for key, result in Ledger(study).results().items()}
    for document in documents.values():
        del document["timing"]
        document.get("report", document.get("stream_report"))["versions"] = {}
    return documents


def starts(folder):
    """How often each cell was begun, by key."""
    return Counter(line[0] for line in _lines(folder))


def pids(folder):
    """The processes that began cells."""
    return [int(line[1]) for line in _lines(folder)]


def _lines(folder):
    path = folder / STARTED
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


def alive(pid):
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def wait_for(condition, seconds=180.0):
    """Poll until it holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("what was waited for did not come about")
        time.sleep(0.02)
