"""How a confined process is isolated, and what the machine has for it. Linux only.

    bwrap      no network, no files but the system's and Python's, its own processes and devices
    process    resource limits, an empty environment, no open file

Isolation is chosen and never lowered: bubblewrap that is installed and does not work is a fault of
the machine. Only a machine without it uses "process", and `serve` refuses even that.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from leaderboard.errors import ScoringFault
from leaderboard.gate import child
from sme_registry.export import FEED_FORWARD
from sme_registry.io import available_memory, require_packages

Isolation = Literal["bwrap", "process"]

START_SECONDS = 60.0
RESERVED_BYTES = 256 * 2**20
"""Memory for the scorer itself and the child's libraries."""

_SYSTEM_FOLDERS = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache")


def available_isolation() -> Isolation:
    """The isolation that this machine has: "bwrap", or "process" if bubblewrap is not installed."""
    if shutil.which("bwrap") is None:
        return "process"
    _bwrap()
    return "bwrap"


def isolation_for_own() -> Isolation:
    """The isolation for policies of one's own: a broken bubblewrap is no reason to refuse them."""
    try:
        return available_isolation()
    except ScoringFault:
        return "process"


def start(isolation: Isolation, arguments: Sequence[int]) -> subprocess.Popen[bytes]:
    """Start a child with its limits, its pipes open and unbuffered."""
    return _start(_bwrap() if isolation == "bwrap" else (), arguments)


def _start(prefix: Sequence[str], arguments: Sequence[int]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            [
                *prefix,
                *_script(),
                *map(str, arguments),
                ",".join(sorted(FEED_FORWARD)),
                *_library_folders(),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            cwd="/",
            env=_environment(),
            start_new_session=True,  # a separate process group, which Ctrl-C does not reach
        )
    except OSError as error:
        raise ScoringFault(
            f"The sandbox's process cannot be started: {error}. Check the machine's limits on "
            "processes, memory and open files, and try again."
        ) from None


def _script() -> list[str]:
    """The command of the child, without user settings or site hooks."""
    return [sys.executable, "-I", "-S", "-B", str(Path(child.__file__).resolve())]


def _environment() -> dict[str, str]:
    """The environment variables of the child."""
    kept = {name: os.environ[name] for name in ("LD_LIBRARY_PATH",) if name in os.environ}
    return {
        "LANG": "C.UTF-8",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        # Without it onnxruntime keeps a database in the home folder and sends usage data.
        "ORT_DISABLE_TELEMETRY": "1",
        **kept,
    }


@functools.cache
def _library_folders() -> tuple[str, ...]:
    """The folders of the child's libraries."""
    libraries = {"numpy": "NumPy", "onnx": "onnx", "onnxruntime": "ONNX Runtime"}
    require_packages("running a policy's ONNX file", libraries, "leaderboard")
    packages = map(importlib.util.find_spec, libraries)
    files = [package.origin for package in packages if package and package.origin]
    return tuple(dict.fromkeys(str(Path(file).parents[1]) for file in files))


@functools.cache  # of success only: an error is raised again, and the next call tries again
def _bwrap() -> tuple[str, ...]:
    """The bwrap command that starts a child, after it has started one without a model."""
    program = shutil.which("bwrap")
    if program is None:
        raise ScoringFault(
            'isolation="bwrap": bubblewrap is not installed. Install it '
            "(apt install bubblewrap), or choose another isolation."
        )
    interpreter = Path(sys.executable)
    readable = [
        *(folder for folder in _SYSTEM_FOLDERS if os.path.exists(folder)),
        *(sys.base_prefix, sys.prefix, str(interpreter.parent), str(interpreter.resolve().parent)),
        *_library_folders(),
        str(Path(child.__file__).resolve().parent),
    ]
    command = (
        *(program, "--unshare-all", "--die-with-parent", "--cap-drop", "ALL"),
        *(word for path in dict.fromkeys(readable) for word in ("--ro-bind", path, path)),
        *("--proc", "/proc", "--dev", "/dev", "--chdir", "/", "--"),
    )
    with _start(command, (2**31, 60)) as process:
        try:
            answer, _ = process.communicate(timeout=START_SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            answer = b""
    if not answer.startswith(child.ANSWER.pack(child.OK, child.START.size)):
        raise ScoringFault(
            f"bubblewrap is installed ({program}) but does not start a process, with status "
            f"{process.returncode}. Containers often forbid user namespaces: allow them, or use "
            "--unsafe-no-sandbox if nobody else can submit to this board."
        )
    return command


def processor_seconds(pid: int) -> float:
    """Processor time of a process and its descendants, in seconds; 0 for a process that is gone."""
    ticks = 0
    pending = [pid]
    while pending:
        process = Path("/proc", str(pending.pop()))
        try:
            numbers = (process / "stat").read_text().rpartition(")")[2].split()
            children = [path.read_text() for path in process.glob("task/*/children")]
        except OSError:  # it ended meanwhile
            continue
        ticks += sum(map(int, numbers[11:15]))  # utime, stime, and those of waited-for children
        pending += map(int, " ".join(children).split())
    return ticks / os.sysconf("SC_CLK_TCK")


def spare_memory() -> int:
    """Memory in bytes that a new process can use before the system ends one for lack of it."""
    return max((available_memory() or 0) - RESERVED_BYTES, 0)
