"""`Sandbox`: an untrusted model as a function of observations, run in a confined process.

    bytes → gate → child process (bwrap if it works, resource limits, onnxruntime) → actions

The child (`child.py`) gets no environment and no open file, and no network under bwrap. Its
processor time, memory and wall time are limited, and it cannot open files or start processes.
If it dies, hangs or sends garbage, the parent raises a `Rejection` with a stable code. The parent
never holds more than one batch. Linux only: other systems lack the limits.

`B` batch, `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Self

import numpy as np
import numpy.typing as npt

from leaderboard.artefact import child
from leaderboard.artefact.gate import inspect, printable
from leaderboard.errors import BoardError, Rejection
from sme_registry.errors import StateError
from sme_registry.io import require_packages

Observations = npt.NDArray[np.float32]
Actions = npt.NDArray[np.float32]

ROWS = 8192  # of one message: the largest allowed network fits into the memory limit with it
TOLERANCE = 1e-4
"""How much an action may depend on its batch, in the unit range.

A matrix product with another number of rows sums in another order. In float32 this changes a sum of
some hundreds of terms by about 1e-6 of its size, and more if weights are large. An error of 1e-4 in
an action changes a normalised regret by at most about 4e-4, which changes no rank.
"""

_CODES = {
    child.REFUSED: ("onnx_refused", "must be a model that onnxruntime loads", "Export it again"),
    child.FAILED: ("run_failed", "must run on any batch of rows", "Run it on 1 and on 100 rows"),
    child.OUTPUT: ("run_output", "must be one float32 action a row", "Export it for this task"),
    child.MEMORY: ("run_memory", "must run within {memory:,} MiB", "Submit a smaller network"),
}
# Sent by an operator or by a system that is short of memory, not caused by the model.
_EXTERNAL_SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
_SYSTEM_FOLDERS = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache")
_ANSWER = struct.Struct("<BI")
_ENDING_SECONDS = 2.0  # between closing its pipe and being gone


@dataclass(frozen=True)
class SandboxLimits:
    """Limits of one model.

    Attributes:
      memory_bytes: address space, in addition to that of the libraries.
      cpu_seconds: total processor time.
      call_seconds: wall time of loading the model, and of each batch.
      start_seconds: wall time of starting the process; exceeding it is the machine's fault.
    """

    memory_bytes: int = 2 * 2**30
    cpu_seconds: int = 300
    call_seconds: float = 60.0
    start_seconds: float = 60.0


class Sandbox:
    """A loaded model, ready to call. Leaving the `with` block ends its process.

    Use it in the thread that created it: the process ends with that thread.

    Args:
      data: the bytes of the ONNX file.
      observation_dim: S + 2.
      action_dim: A.
      limits: of time and memory.

    Raises:
      Rejection: a code of `gate.inspect`, or `onnx_refused`, `run_failed`, `run_time` or
        `run_memory` while the model loads.
      BoardError: this system is not Linux, or the process cannot be started or was ended from
        outside. The model is not judged.
      MissingDependencyError: onnxruntime is not installed.

    Attributes:
      isolation: "bwrap", or "process" if bwrap is missing or does not work.
    """

    def __init__(
        self,
        data: bytes,
        observation_dim: int,
        action_dim: int,
        limits: SandboxLimits = SandboxLimits(),
    ) -> None:
        inspect(data, observation_dim, action_dim)
        if sys.platform != "linux":
            raise BoardError(
                f"sys.platform={sys.platform!r}: policies run in a sandbox, which needs Linux. "
                "Score on a Linux machine or in a Linux container."
            )
        self._observation_dim, self._action_dim = observation_dim, action_dim
        self._limits = limits
        prefix = _bwrap()
        self.isolation = "bwrap" if prefix else "process"
        self._process = _start(prefix, limits, observation_dim, action_dim)
        self._starting = True
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        for pipe in (self._input, self._output):
            os.set_blocking(pipe.fileno(), False)
        with self._closed_on_error():
            self._ask(limits.start_seconds)
            self._starting = False
            self._ask(limits.call_seconds, struct.pack("<I", len(data)), data)

    def __call__(self, observations: Observations) -> Actions:
        """The model's actions, finite but not clipped.

        Args:
          observations: `[B, S + 2]` float32.

        Returns:
          `[B, A]` float32.

        Raises:
          Rejection: `run_failed`, `run_output`, `run_not_finite`, `run_time` or `run_memory`; this
            closes the sandbox.
          BoardError: the sandbox is closed, or its process was ended from outside.
          StateError: the observations have another shape.
        """
        observations = np.ascontiguousarray(observations, dtype="<f4")
        if observations.ndim != 2 or observations.shape[1] != self._observation_dim:
            raise StateError(
                f"observations of shape {observations.shape}: must be [B, {self._observation_dim}]."
            )
        a = np.empty((len(observations), self._action_dim), np.float32)
        with self._closed_on_error():
            for first in range(0, len(a), ROWS):
                rows = observations[first : first + ROWS]
                size = len(rows) * self._action_dim * 4
                frame = struct.pack("<I", len(rows)), rows.tobytes()
                answer = self._ask(self._limits.call_seconds, *frame, size=size)
                a[first : first + ROWS] = np.frombuffer(answer, "<f4").reshape(len(rows), -1)
            if not np.isfinite(a).all():
                row = int(np.flatnonzero(~np.isfinite(a).all(axis=1))[0])
                raise Rejection(
                    "run_not_finite",
                    f"action={a[row].tolist()} on observation {observations[row].tolist()}: must "
                    "be finite. Guard divisions and logarithms, and check the weights for NaN.",
                )
        return a

    def check_rows(self, observations: Observations, rows: int = 16) -> None:
        """Reject a model whose action in a state depends on the other rows of the batch.

        The batch in reverse, and some rows one at a time, must give the same actions as the batch.
        Actions are compared as they are scored, clipped to [0, 1].

        Args:
          observations: `[B, S + 2]` float32, B ≥ 1, preferably a batch that is scored.
          rows: number of rows evaluated one at a time, spread evenly.

        Raises:
          Rejection: `run_batch_dependent`, or the codes of a call.
          BoardError, StateError: see a call.
        """
        batched = self(observations)
        reversed_ = self(observations[::-1])[::-1]
        self._refuse_difference("in reverse", observations, batched, reversed_)
        chosen = np.unique(np.linspace(0, len(observations) - 1, rows).astype(int))
        single = np.concatenate([self(observations[row : row + 1]) for row in chosen])
        self._refuse_difference("alone", observations[chosen], batched[chosen], single)

    def close(self) -> None:
        """End the process and its descendants. Closing twice is allowed."""
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._input.close()
        self._output.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _refuse_difference(
        self, how: str, observations: Observations, batched: Actions, other: Actions
    ) -> None:
        difference = np.abs(np.clip(batched, 0.0, 1.0) - np.clip(other, 0.0, 1.0)).max(axis=1)
        row = int(difference.argmax())
        if difference[row] > TOLERANCE:
            self.close()
            raise Rejection(
                "run_batch_dependent",
                f"action={batched[row].tolist()} in a batch, {other[row].tolist()} {how}, on "
                f"observation {observations[row].tolist()}: must be the same within {TOLERANCE:g}. "
                "Let no operator work across rows.",
            )

    def _ask(self, seconds: float, *frame: bytes, size: int = 0) -> bytearray:
        """Send the parts of a message; return the answer's payload of this size."""
        if self._process.returncode is not None:
            raise BoardError("The sandbox is closed. Open another one.")
        deadline = time.monotonic() + seconds
        for part in frame:
            self._send(memoryview(part), deadline)
        status, length = _ANSWER.unpack(self._receive(_ANSWER.size, deadline))
        if status == child.OK and length == size:
            return self._receive(size, deadline)
        if status not in _CODES or length > child.MAX_TEXT:
            raise Rejection(
                "run_failed", f"answer={status}, {length} bytes: invalid. Submit another model."
            )
        code, allowed, remedy = _CODES[status]
        text = printable(b" ".join(self._receive(length, deadline).split()))
        allowed = allowed.format(memory=self._limits.memory_bytes // 2**20)
        raise Rejection(code, f"artefact: {text}: {allowed}. {remedy}.")

    def _send(self, left: memoryview, deadline: float) -> None:
        while left:
            self._await(self._input.fileno(), select.POLLOUT, deadline)
            try:
                left = left[os.write(self._input.fileno(), left) :]
            except BlockingIOError:  # less room than the smallest write
                continue
            except BrokenPipeError:
                # The process may have answered before it ended; `_receive` reads that first.
                return

    def _receive(self, size: int, deadline: float) -> bytearray:
        read = bytearray()
        while len(read) < size:
            self._await(self._output.fileno(), select.POLLIN, deadline)
            part = os.read(self._output.fileno(), min(size - len(read), 2**20))
            if not part:
                self._ended()
            read += part
        return read

    def _await(self, stream: int, event: int, deadline: float) -> None:
        """Wait until a pipe is ready or its other end is closed."""
        poll = select.poll()
        poll.register(stream, event)
        if poll.poll(max(deadline - time.monotonic(), 0.0) * 1000.0):
            return
        if self._starting:
            raise BoardError(
                f"The sandbox did not start within {self._limits.start_seconds:g} s. Try again "
                "when the machine is less busy."
            )
        raise Rejection(
            "run_time",
            f"artefact: no answer within {self._limits.call_seconds:g} s, the limit for loading "
            "and for each batch. Submit a smaller network.",
        )

    def _ended(self) -> NoReturn:
        """Raise the reason why the process ended."""
        try:
            status = self._process.wait(timeout=_ENDING_SECONDS)
        except subprocess.TimeoutExpired:
            status = 0
        number = -status if status < 0 else status - 128  # bwrap passes a signal on as 128 + n
        if number == signal.SIGXCPU:
            raise Rejection(
                "run_time",
                f"artefact: more than {self._limits.cpu_seconds} s of processor time, the limit "
                "for all batches. Submit a smaller network.",
            )
        if self._starting or number in {getattr(signal, name) for name in _EXTERNAL_SIGNALS}:
            raise BoardError(
                f"The sandbox's process ended with status {status}, not caused by the model. "
                "Check that onnxruntime can be imported and that memory is free, and try again."
            )
        raise Rejection(
            "run_failed",
            f"artefact: the model crashed its process, which ended with status {status}. Run it on "
            "your machine with `sme-leaderboard check`.",
        )

    @contextlib.contextmanager
    def _closed_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise


def _start(
    prefix: Sequence[str], limits: SandboxLimits, observation_dim: int, action_dim: int
) -> subprocess.Popen[bytes]:
    numbers = limits.memory_bytes, limits.cpu_seconds, observation_dim, action_dim
    return subprocess.Popen(
        [*prefix, *_script(), *map(str, numbers), *_library_folders()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        bufsize=0,
        cwd="/",
        env=_environment(),
        start_new_session=True,  # a separate process group, which Ctrl-C does not reach
    )


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
    """The folders of NumPy and onnxruntime."""
    libraries = {"numpy": "NumPy", "onnxruntime": "ONNX Runtime"}
    require_packages("running a policy's ONNX file", libraries, "leaderboard")
    packages = map(importlib.util.find_spec, libraries)
    files = [package.origin for package in packages if package and package.origin]
    return tuple(dict.fromkeys(str(Path(file).parents[1]) for file in files))


@functools.cache
def _bwrap() -> tuple[str, ...]:
    """The bwrap command that starts a child; empty if bwrap is missing or does not work.

    Containers often forbid what bwrap needs, so it is tried once, with a child without a model.
    """
    program = shutil.which("bwrap")
    if program is None:
        return ()
    interpreter = Path(sys.executable)
    readable = [
        *(folder for folder in _SYSTEM_FOLDERS if os.path.exists(folder)),
        *(sys.base_prefix, sys.prefix, str(interpreter.parent), str(interpreter.resolve().parent)),
        *_library_folders(),
        str(Path(child.__file__).resolve()),
    ]
    command = (
        *(program, "--unshare-all", "--die-with-parent", "--cap-drop", "ALL"),
        *(word for path in dict.fromkeys(readable) for word in ("--ro-bind", path, path)),
        *("--proc", "/proc", "--dev", "/dev", "--chdir", "/", "--"),
    )
    limits = SandboxLimits()
    with _start(command, limits, 1, 1) as process:
        try:
            answer, _ = process.communicate(timeout=limits.start_seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return ()
    return command if answer.startswith(_ANSWER.pack(child.OK, 0)) else ()
