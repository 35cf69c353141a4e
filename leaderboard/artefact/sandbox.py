"""`Sandbox`: a model of a stranger as a function of observations, in a process of its own.

    bytes → gate → child process: bwrap where it works, its own limits, onnxruntime → actions

The child (`child.py`) gets no environment, no open file and no network where there is bwrap; it is
given processor time, memory and wall time, and cannot open files or start processes. Whatever it
does (die, hang, answer nonsense), this side raises a `Rejection` with a stable code, and holds no
more than one batch. `B` batch, `S` state_dim, `A` action_dim.
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
from types import TracebackType
from typing import NoReturn, Self

import numpy as np
import numpy.typing as npt

from leaderboard.artefact import child
from leaderboard.artefact.gate import ModelFacts, inspect
from leaderboard.errors import BoardError, Rejection
from sme_registry.errors import MissingDependencyError, StateError

Observations = npt.NDArray[np.float32]
Actions = npt.NDArray[np.float32]

ROWS = 8192  # of one frame: what a network of the largest size needs for it fits in the memory
TOLERANCE = 1e-4
"""By how much an action may depend on its batch, in the unit range.

A matrix product adds up in another order where it has another number of rows. In float32 that
moves a sum of some hundreds of terms by about 1e-6 of its size, and more where weights are large.
An action off by 1e-4 moves no normalised regret by more than about 4e-4, which ranks nobody.
"""

_CODES = {
    child.REFUSED: ("onnx_refused", "must be a model that onnxruntime loads", "Export it anew"),
    child.FAILED: ("run_failed", "must run on any batch of rows", "Run it on 1 and on 100 rows"),
    child.OUTPUT: ("run_output", "must be one float32 action a row", "Export it for this task"),
    child.MEMORY: ("run_memory", "must run within {memory:,} MiB", "Submit a smaller network"),
}
# Sent by an operator or by a system that is short of memory: no fault of the model.
_FROM_OUTSIDE = {signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP}
_SYSTEM_FOLDERS = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache")
_ANSWER = struct.Struct("<BI")
_ENDING_SECONDS = 2.0  # between closing its pipe and being gone


@dataclass(frozen=True)
class SandboxLimits:
    """What one model may take.

    Attributes:
      memory_bytes: of address space, above what the libraries take.
      cpu_seconds: of processor time, in all.
      call_seconds: of wall time, for loading the model and for each batch.
      start_seconds: of wall time, for starting the process; beyond it the machine is at fault.
    """

    memory_bytes: int = 2 * 2**30
    cpu_seconds: int = 300
    call_seconds: float = 60.0
    start_seconds: float = 60.0


class Sandbox:
    """A model, loaded and ready to be asked; ends its process on leaving the `with` block.

    It is to be used by the thread that made it, whose end also ends the process.

    Args:
      data: the ONNX file's bytes.
      observation_dim: S + 2.
      action_dim: A.
      limits: what it may take.

    Raises:
      Rejection: a code of `gate.inspect`, or `onnx_refused`, `run_failed`, `run_time`,
        `run_memory` while it is loaded.
      BoardError: the process cannot be started, or was ended from outside: the model is not judged.
      MissingDependencyError: onnxruntime is not installed.

    Attributes:
      facts: what the file holds.
      isolation: "bwrap", or "process" where bwrap is missing or does not work.
    """

    facts: ModelFacts
    isolation: str

    def __init__(
        self,
        data: bytes,
        observation_dim: int,
        action_dim: int,
        limits: SandboxLimits = SandboxLimits(),
    ) -> None:
        self.facts = inspect(data, observation_dim, action_dim)
        self._observation_dim, self._action_dim = observation_dim, action_dim
        self._limits = limits
        prefix = _bwrap()
        self.isolation = "bwrap" if prefix else "process"
        self._process = _start(prefix, limits, observation_dim, action_dim)
        self._starting = True
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            os.set_blocking(stream.fileno(), False)
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
          Rejection: `run_failed`, `run_output`, `run_not_finite`, `run_time` or `run_memory`; the
            sandbox is closed then.
          BoardError: it is closed, or its process was ended from outside.
          StateError: observations of another shape.
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
        """Refuse a model whose action in a state depends on what else is in the batch.

        Some rows are asked one at a time, and the whole batch in reverse; both must give what the
        batch gave. Actions are compared as they are scored, clipped to [0, 1].

        Args:
          observations: `[B, S + 2]` float32, B ≥ 1: a batch, best as it is scored.
          rows: how many are asked one at a time, spread evenly.

        Raises:
          Rejection: `run_batch_dependent`, or as a call.
          BoardError, StateError: as a call.
        """
        batched = self(observations)
        reversed_ = self(observations[::-1])[::-1]
        self._refuse_difference("in reverse", observations, batched, reversed_)
        chosen = np.unique(np.linspace(0, len(observations) - 1, rows).astype(int))
        single = np.concatenate([self(observations[row : row + 1]) for row in chosen])
        self._refuse_difference("alone", observations[chosen], batched[chosen], single)

    def close(self) -> None:
        """End the process and all that it started; does nothing a second time."""
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _refuse_difference(
        self, asked: str, observations: Observations, batched: Actions, other: Actions
    ) -> None:
        difference = np.abs(np.clip(batched, 0.0, 1.0) - np.clip(other, 0.0, 1.0)).max(axis=1)
        row = int(difference.argmax())
        if difference[row] > TOLERANCE:
            self.close()
            raise Rejection(
                "run_batch_dependent",
                f"action={batched[row].tolist()} in a batch, {other[row].tolist()} {asked}, on "
                f"observation {observations[row].tolist()}: must be the same within {TOLERANCE:g}. "
                "Let no operator work across rows.",
            )

    def _ask(self, seconds: float, *frame: bytes, size: int = 0) -> bytearray:
        """Send a frame's parts; the payload of the answer, which must have this size."""
        if self._process.returncode is not None:
            raise BoardError("this sandbox is closed. Make another.")
        deadline = time.monotonic() + seconds
        for part in frame:
            self._send(memoryview(part), deadline)
        status, length = _ANSWER.unpack(self._receive(_ANSWER.size, deadline))
        if status == child.OK and length == size:
            return self._receive(size, deadline)
        if status not in _CODES or length > child.MAX_TEXT:
            raise Rejection(
                "run_failed", f"answer={status}, {length} bytes: is none. Submit another model."
            )
        code, allowed, remedy = _CODES[status]
        text = _one_line(self._receive(length, deadline))
        allowed = allowed.format(memory=self._limits.memory_bytes // 2**20)
        raise Rejection(code, f"artefact: {text}: {allowed}. {remedy}.")

    def _send(self, left: memoryview, deadline: float) -> None:
        stream = self._process.stdin
        assert stream is not None
        while left:
            self._await(stream.fileno(), select.POLLOUT, deadline)
            try:
                left = left[os.write(stream.fileno(), left) :]
            except BlockingIOError:  # room for less than the system writes at once
                continue
            except BrokenPipeError:
                # It may have said why before it ended; an answer is read before its end is seen.
                return

    def _receive(self, size: int, deadline: float) -> bytearray:
        stream = self._process.stdout
        assert stream is not None
        read = bytearray()
        while len(read) < size:
            self._await(stream.fileno(), select.POLLIN, deadline)
            part = os.read(stream.fileno(), min(size - len(read), 2**20))
            if not part:
                self._ended()
            read += part
        return read

    def _await(self, stream: int, event: int, deadline: float) -> None:
        """Wait until a pipe is ready, or its other end is closed."""
        poll = select.poll()
        poll.register(stream, event)
        if poll.poll(max(deadline - time.monotonic(), 0.0) * 1000.0):
            return
        if self._starting:
            raise BoardError(
                f"the sandbox did not start within {self._limits.start_seconds:g} s. Try again "
                "when the machine has less to do."
            )
        raise Rejection(
            "run_time",
            f"artefact: no answer within {self._limits.call_seconds:g} s: must load, and answer "
            "each batch, sooner. Submit a smaller network.",
        )

    def _ended(self) -> NoReturn:
        """Say why the process ended by itself."""
        try:
            status = self._process.wait(timeout=_ENDING_SECONDS)
        except subprocess.TimeoutExpired:
            status = 0
        number = -status if status < 0 else status - 128  # bwrap passes a signal on as 128 + n
        if number == signal.SIGXCPU:
            raise Rejection(
                "run_time",
                f"artefact: more than {self._limits.cpu_seconds} s of processor time: must take "
                "less over all its batches. Submit a smaller network.",
            )
        if self._starting or number in _FROM_OUTSIDE:
            raise BoardError(
                f"the sandbox's process ended with status {status} through no fault of the model. "
                "Check that onnxruntime can be imported and that memory is free, and try again."
            )
        raise Rejection(
            "run_failed",
            f"artefact: its process ended with status {status}: must run without a crash. "
            "Run it at home with `sme-leaderboard check`.",
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
        start_new_session=True,  # a group of its own: Ctrl-C is for the parent alone
    )


def _script() -> list[str]:
    """The command of the child: no user's settings, no site's hooks."""
    return [sys.executable, "-I", "-S", "-B", str(Path(child.__file__).resolve())]


def _environment() -> dict[str, str]:
    """All that the child learns of its surroundings."""
    kept = {name: os.environ[name] for name in ("LD_LIBRARY_PATH",) if name in os.environ}
    return {
        "LANG": "C.UTF-8",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        # Without it onnxruntime keeps a database in the home and reports what it runs.
        "ORT_DISABLE_TELEMETRY": "1",
        **kept,
    }


@functools.cache
def _library_folders() -> tuple[str, ...]:
    """The folders that hold NumPy and onnxruntime."""
    folders = []
    for library in ("numpy", "onnxruntime"):
        found = importlib.util.find_spec(library)
        if found is None or not found.submodule_search_locations:
            raise MissingDependencyError(
                f"{library}: not installed, and needed to run a policy's ONNX file. "
                "Run `pip install 'sme-registry[leaderboard]'`."
            )
        folders.append(os.path.dirname(next(iter(found.submodule_search_locations))))
    return tuple(dict.fromkeys(folders))


@functools.cache
def _bwrap() -> tuple[str, ...]:
    """The command that a child is started through; empty where there is no bwrap that works.

    Containers often forbid what it needs, so that it is tried once, with a child without a model.
    """
    program = shutil.which("bwrap")
    if program is None:
        return ()
    interpreter = Path(sys.executable)
    seen = [
        *(folder for folder in _SYSTEM_FOLDERS if os.path.exists(folder)),
        *(sys.base_prefix, sys.prefix, str(interpreter.parent), str(interpreter.resolve().parent)),
        *_library_folders(),
        str(Path(child.__file__).resolve()),
    ]
    command = (
        *(program, "--unshare-all", "--die-with-parent", "--cap-drop", "ALL"),
        *(word for path in dict.fromkeys(seen) for word in ("--ro-bind", path, path)),
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


def _one_line(text: bytes | bytearray) -> str:
    """A stranger's text as messages show it."""
    words = text.decode("utf-8", "replace").split()
    return "".join(letter if letter.isprintable() else "�" for letter in " ".join(words))
