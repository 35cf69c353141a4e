"""Shared by every test: the same examples, threads and signals on every run and machine."""

import contextlib
import ctypes
import gc
import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

from tests.browser import launched

# Compiled once, and not by every worker and child: rewritten tests, and the packages.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# The workers share the cores. Read when NumPy, Torch and JAX are imported, here and in children.
for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{library}_NUM_THREADS"] = "1"
# A job in the background of a script ignores SIGINT, and so would every process started here.
signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when ONNX Runtime is imported
# One compile cache for all workers of a test run.
os.environ.setdefault(
    "SME_JAX_CACHE", str(Path(tempfile.gettempdir()) / f"sme-jax-cache-{os.getuid()}")
)
# JAX keeps only what took a second to compile; here the workers share all of it.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

# First the files that take most memory for a moment, as a worker is small then; then those that
# take longest, so that no worker is left with one at the end.
FIRST = (
    "tests/studies/engine/test_lanes.py",
    "tests/studies/engine/test_lives.py",
    "tests/training/test_jax_runs.py",
    "tests/jax/",
    "tests/evaluation/test_observation.py",
    "tests/studies/engine/test_cell.py",
    "tests/task/test_certify.py",
    "tests/task/test_draw.py",
    "tests/test_documentation.py",
    "tests/docs/test_site.py",
    "tests/test_cli.py",
    "tests/studies/engine/test_runner.py",
    "tests/leaderboard/test_cli.py",
)
ROOT = Path(__file__).parent.parent
LITTLE, MUCH = 30_000_000, 150_000_000  # bytes since programs were last forgotten
LARGE = 1_450_000_000  # a worker that forgets programs after each test that took a little
_kept = 0

settings.register_profile(
    "deterministic", derandomize=True, deadline=None, database=None, max_examples=50
)
settings.load_profile("deterministic")


KERNELS = """
import gymnasium, numpy as np, sme_registry
for env in {envs}:
    env.reset(seed=0)
    env.step(np.full(env.action_space.shape, 0.5, {dtype}))
"""
SINGLE, BATCH = "gymnasium.make('SME/Default-v1')", "gymnasium.make_vec('SME/Default-v1')"
_compiling = []


def pytest_configure(config):
    """Compile the steps while the workers collect, before they and their children would each."""
    is_worker = not config.getoption("numprocesses", None) or hasattr(config, "workerinput")
    if is_worker or not importlib.util.find_spec("numba"):  # an extra
        return
    for envs, dtype in ((f"[{SINGLE}]", "np.float32"), (f"[{BATCH}, {SINGLE}]", "float")):
        script = KERNELS.format(envs=envs, dtype=dtype)
        _compiling.append(subprocess.Popen([sys.executable, "-c", script]))


def pytest_collection(session):
    """Every second worker begins with the last files, so that two compile half of them each."""
    worker = getattr(session.config, "workerinput", {}).get("workerid", "gw0")
    if int(worker.removeprefix("gw")) % 2:
        asked = [Path(text.partition("::")[0]).resolve() for text in session.config.args]
        files = {file for path in asked for file in (path, *path.rglob("test_*.py"))}
        for path in sorted((file for file in files if file.match("test_*.py")), reverse=True):
            with contextlib.suppress(pytest.skip.Exception):  # where an extra is missing
                importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def pytest_unconfigure():
    for process in _compiling:
        assert process.wait() == 0


def pytest_collection_modifyitems(items):
    """Give some files to workers first."""

    def rank(item):
        places = (place for place, name in enumerate(FIRST) if item.nodeid.startswith(name))
        return next(places, len(FIRST))

    items.sort(key=rank)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item, nextitem):
    """The programs that a file compiled in JAX go with it: hundreds of them take gigabytes."""
    global _kept
    jax = sys.modules.get("jax")
    is_last = nextitem is None or nextitem.path != item.path
    memory = _memory()
    if jax and memory - _kept > (LITTLE if is_last or memory > LARGE else MUCH):
        jax.clear_caches()
        gc.collect()
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)  # glibc keeps a third of what was freed
        _kept = _memory()


def _memory():
    """Bytes in use, where the system says so."""
    statm = Path("/proc/self/statm")
    pages = int(statm.read_text().split()[1]) if statm.exists() else 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module")
def quickly_compiled():
    """JAX in half the time: for programs not compared with another library's last bits."""
    jax = pytest.importorskip("jax")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")  # of processes started here
        jax.config.update("jax_disable_most_optimizations", True)
        yield
        jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module")
def chromium():
    """A headless browser."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = launched(playwright)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def once(tmp_path_factory, worker_id):
    """`once(name, make)`: the folder that `make(folder)` filled, in one worker for all of them.

    Nobody changes it: a test that writes works on a copy.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent

    def made(name, make):
        folder, error = shared / "once" / name, shared / "once" / f"{name}.error"
        folder.parent.mkdir(exist_ok=True)
        with FileLock(folder.with_name(f"{name}.lock")):
            if not error.exists():
                folder.mkdir(exist_ok=True)
                error.write_text("it was interrupted")
                try:
                    make(folder)
                except Exception as exception:
                    error.write_text(str(exception))
                    raise
                error.write_text("")
        assert error.read_text() == ""
        return folder

    return made


@pytest.fixture
def figures(monkeypatch):
    """Every figure drawn in a test, as it was when it was saved."""
    from matplotlib.figure import Figure

    drawn = []
    save = Figure.savefig

    def saving(figure, *args, **kw):
        drawn.append(figure)
        return save(figure, *args, **kw)

    monkeypatch.setattr(Figure, "savefig", saving)
    return drawn
