"""Confined processes: `Confined` reads a stranger's file, `Sandbox` runs it on observations.

    bytes → child process (bwrap, resource limits): gate → onnxruntime → actions

If the child crashes, exceeds a limit or sends garbage, the parent raises a `Rejection` with a
stable code. If the machine is the cause (no processor time, less memory than the limit, a process
killed from outside), it raises a `ScoringFault`, which judges nobody. The parent never holds more
than one batch. Linux only: other systems lack the limits.

`B` batch, `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NoReturn, Self

import numpy as np
import numpy.typing as npt

from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import CODES, BoardError, Rejection, ScoringFault
from leaderboard.gate import child, gate
from leaderboard.gate.isolation import (
    START_SECONDS,
    Isolation,
    available_isolation,
    processor_seconds,
    spare_memory,
    start,
)
from sme_registry import SMESpec
from sme_registry.errors import StateError
from sme_registry.evaluation import interface_of
from sme_registry.export import FEED_FORWARD
from sme_registry.io import require_packages, visible

Observations = npt.NDArray[np.float32]
Actions = npt.NDArray[np.float32]

ROWS = 8192  # of one message: the largest allowed network fits into the memory limit with it
TOLERANCE = 1e-4
"""How much an action may depend on its batch, in the unit range.

A matrix product with another number of rows sums in another order. In float32 this changes a sum of
some hundreds of terms by about 1e-6 of its size, and more if weights are large. An error of 1e-4 in
an action changes a normalised regret by at most about 4e-4, which changes no rank.
"""

BASE_SECONDS, STATE_SECONDS, STATE_BYTE_SECONDS = 10.0, 1e-4, 1e-10
"""Processor time of a policy: start and checks, each state, and each state and byte of the file.

At the 300,000 states of `paper-v1`, on one core of an AMD EPYC, two layers of 256 take 0.7 s of 48,
and the slowest honest network found, attention of 4 layers of 128 over 18 tokens, 67 s of 127.
"""
_CODES = {
    child.REFUSED: ("onnx_refused", "must be a model that onnxruntime loads", "Export it again"),
    child.FAILED: ("run_failed", "must run on any batch of rows", "Run it on 1 and on 100 rows"),
    child.OUTPUT: ("run_output", "must be one float32 action a row", "Export it for this task"),
    child.MEMORY: ("run_memory", "must run within {memory:,} MiB", "Submit a smaller network"),
}
# The gate reads files of 8 MiB in 64 MiB; a parser that has less calls them malformed.
LEAST_MEMORY = 2**28
_MAX_NETWORK = 2**25  # bytes of a network in JSON
# Sent by an operator or by a system that is short of memory, not caused by the model.
_EXTERNAL_SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
_ENDING_SECONDS = 2.0  # between closing its pipe and being gone
_BUSY = 0.5  # of its wall time: with less processor time, the machine and not the model is slow


@dataclass(frozen=True)
class SandboxLimits:
    """Limits of one model; `memory_bytes` are in addition to what the libraries use.

    A machine that has less memory to spare grants less, and whose start takes longer is at fault.
    """

    memory_bytes: int = 2 * 2**30
    cpu_seconds: int = 300
    call_seconds: float = 60.0  # wall time of loading the model, and of each batch
    start_seconds: float = START_SECONDS

    @classmethod
    def for_policy(cls, file_bytes: int, states: int, agents: int = 1) -> Self:
        """The limits of a policy that so many agents call in so many states of all regions."""
        each = STATE_SECONDS + STATE_BYTE_SECONDS * file_bytes
        return cls(cpu_seconds=math.ceil(BASE_SECONDS + states * agents * each))


class Confined:
    """A child process that reads files of strangers. Leaving the `with` block ends it.

    Use it in the thread that created it: the process ends with that thread. A Rejection closes the
    process, as all errors do; a ScoringFault, of the isolation or of the machine, judges nothing.
    """

    def __init__(
        self, limits: SandboxLimits = SandboxLimits(), *, isolation: Isolation | None = None
    ) -> None:
        if sys.platform != "linux":
            raise BoardError(
                f"sys.platform={sys.platform!r}: policies run in a sandbox, which needs Linux. "
                "Score on a Linux machine or in a Linux container."
            )
        self.isolation: Isolation = isolation or available_isolation()
        self._limits = limits
        memory = min(limits.memory_bytes, spare_memory())
        self._process = start(self.isolation, (memory, limits.cpu_seconds))
        self._starting = True
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        for pipe in (self._input, self._output):
            os.set_blocking(pipe.fileno(), False)
        with self._closed_on_error():
            started = self._ask(limits.start_seconds, size=child.START.size)
            self._starting = False
            self._memory, version = child.START.unpack(started)
            self.runtime = visible(version.rstrip(b"\0").decode("utf-8", "replace"))
            if self._memory < min(self._limits.memory_bytes, LEAST_MEMORY):
                self._raise_if_memory_was_short("The sandbox reads no file")

    def inspect(self, data: bytes, observation_dim: int, action_dim: int) -> None:
        """Reject a file that is no feed-forward network of these widths; see `gate.py`."""
        self._send_file(child.INSPECT, data, observation_dim, action_dim)

    def network(self, data: bytes, observation_dim: int, action_dim: int) -> bytes:
        """The network of a file as JSON, whose content nobody has checked; else like `inspect`."""
        return bytes(
            self._send_file(child.NETWORK, data, observation_dim, action_dim, most=_MAX_NETWORK)
        )

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

    def _send_file(
        self, command: int, data: bytes, observation_dim: int, action_dim: int, most: int = 0
    ) -> bytearray:
        with self._closed_on_error():
            check_size(data)
            head = child.HEAD.pack(command, len(data), observation_dim, action_dim)
            return self._ask(self._limits.call_seconds, head, data, most=most)

    def _ask(self, seconds: float, *frame: bytes, size: int = 0, most: int = 0) -> bytearray:
        """Send the parts of a message; return the answer's payload of this size, or at most one."""
        if self._process.returncode is not None:
            raise BoardError("The sandbox is closed. Open another one.")
        deadline = time.monotonic() + seconds
        self._spent = processor_seconds(self._process.pid)
        for part in frame:
            self._send(memoryview(part), deadline)
        status, length = child.ANSWER.unpack(self._receive(child.ANSWER.size, deadline))
        if status == child.OK and (length <= most if most else length == size):
            return self._receive(length, deadline)
        if status not in (child.REJECTED, *_CODES) or length > child.MAX_TEXT:
            raise Rejection(
                "run_failed", f"answer={status}, {length} bytes: invalid. Submit another model."
            )
        answer = self._receive(length, deadline).decode("utf-8", "replace")
        text = visible(" ".join(answer.split()))
        if status == child.REJECTED:
            self._reject(*text.partition(" ")[::2])
        if status == child.MEMORY:
            self._raise_if_memory_was_short(text)
        code, allowed, remedy = _CODES[status]
        allowed = allowed.format(memory=self._limits.memory_bytes // 2**20)
        raise Rejection(code, f"policy: {text}: {allowed}. {remedy}.")

    def _reject(self, code: str, message: str) -> NoReturn:
        """Raise the gate's verdict, of which a child that was taken over can make up any."""
        if code not in CODES or not code.startswith("onnx_"):
            raise Rejection("run_failed", "answer: invalid verdict. Submit another model.")
        raise Rejection(code, message)

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
            raise ScoringFault(
                f"The sandbox did not start within {self._limits.start_seconds:g} s. Try again "
                "when the machine is less busy."
            )
        used = processor_seconds(self._process.pid) - self._spent
        limit = self._limits.call_seconds
        if used < _BUSY * limit:
            raise ScoringFault(
                f"The sandbox did not answer within {limit:g} s, in which it got {used:.1f} s of "
                "processor time. Try again when the machine is less busy."
            )
        raise Rejection(
            "run_time",
            f"policy: no answer within {limit:g} s, the limit for loading and for each batch. "
            "Submit a smaller network.",
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
                f"policy: more than {self._limits.cpu_seconds} s of processor time, the limit "
                "for all batches. Submit a smaller network.",
            )
        ended = f"The sandbox's process ended with status {status}"
        if self._starting or number in {getattr(signal, name) for name in _EXTERNAL_SIGNALS}:
            raise ScoringFault(
                f"{ended}, not caused by the model. Check that onnxruntime can be imported and "
                "that memory is free, and try again."
            )
        self._raise_if_memory_was_short(ended)  # libraries crash where they cannot allocate
        raise Rejection(
            "run_failed",
            f"policy: the model crashed its process, which ended with status {status}. Run it on "
            "your machine with `sme-leaderboard submit --dry-run`.",
        )

    def _raise_if_memory_was_short(self, what: str) -> None:
        if self._memory < self._limits.memory_bytes:
            raise ScoringFault(
                f"{what}: the machine had {self._memory // 2**20:,} MiB to spare, less than the "
                f"limit of {self._limits.memory_bytes // 2**20:,} MiB. Score on a machine with "
                "more memory, or try again when more is free."
            )

    @contextlib.contextmanager
    def _closed_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise


class Sandbox(Confined):
    """A loaded model, of an ONNX file of these widths, as a function of observations."""

    def __init__(
        self,
        data: bytes,
        observation_dim: int,
        action_dim: int,
        limits: SandboxLimits = SandboxLimits(),
        *,
        isolation: Isolation | None = None,
    ) -> None:
        check_size(data)
        super().__init__(limits, isolation=isolation)
        self._widths = observation_dim, action_dim
        self._send_file(child.LOAD, data, *self._widths)

    def __call__(self, observations: Observations) -> Actions:
        """The model's actions `[B, A]`, finite but not clipped, on observations `[B, S + 2]`."""
        a = self._run(observations)
        if not np.isfinite(a).all():
            self.close()
            row = int(np.flatnonzero(~np.isfinite(a).all(axis=1))[0])
            raise Rejection(
                "run_not_finite",
                f"action={a[row].tolist()} on observation {observations[row].tolist()}: must "
                "be finite. Guard divisions and logarithms, and check the weights for NaN.",
            )
        return a

    def check_rows(self, observations: Observations, rows: int = 16) -> None:
        """Reject a model whose action in a state depends on the other rows of the batch.

        The batch in random order and in two parts, and `rows` one at a time, must give the same
        actions, compared as they are scored, clipped to [0, 1].
        """
        rng = np.random.default_rng(secrets.randbits(128))
        batched = self(observations)
        order = rng.permutation(len(observations))
        other = np.empty_like(batched)
        for part in np.array_split(order, 2):
            other[part] = self(observations[part])
        self._refuse_difference("in another batch", observations, batched, other)
        for row in order[:rows]:
            alone = slice(row, row + 1)
            single = self(observations[alone])
            self._refuse_difference("alone", observations[alone], batched[alone], single)

    def check_last_place(self, observations: Observations) -> None:
        """Reject a model whose actions depend on the last place of the observations.

        Each number but 0 and 1, which may be flags, moves by one unit in its last place, up or down
        at random, so that rounding errors are others: the actions of a policy that amplifies them
        differ, as they would on another machine. The mean change must be at most `TOLERANCE`, the
        row that changes most left out: a tree may branch within one unit.

        Measured: at most 4e-8 for the policies of examples/board; 3e-6 for the optimal policy in
        float32 at complexity 50, the most sensitive honest policy found.
        """
        rng = np.random.default_rng(secrets.randbits(128))
        ends = rng.choice(np.array([-np.inf, np.inf], np.float32), observations.shape)
        flags = (observations == 0.0) | (observations == 1.0)
        moved = np.where(flags, observations, np.nextafter(observations, ends))
        a, other = (np.clip(self(each), 0.0, 1.0) for each in (observations, moved))
        change = np.sort(np.abs(a - other).mean(axis=1, dtype=np.float64))[:-1]
        mean = float(change.sum() / len(observations))
        if mean > TOLERANCE:
            self.close()
            raise Rejection(
                "run_rounding",
                f"mean change of the actions, where observations change by one unit in the last "
                f"place={mean:.1e}: must be at most {TOLERANCE:g}, or another machine computes "
                "another score. Avoid differences of nearly equal numbers, large factors, and sums "
                "compared for equality.",
            )

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

    def _run(self, observations: Observations) -> Actions:
        observations = np.ascontiguousarray(observations, dtype="<f4")
        observation_dim, action_dim = self._widths
        if observations.ndim != 2 or observations.shape[1] != observation_dim:
            raise StateError(
                f"observations of shape {observations.shape}: must be [B, {observation_dim}]."
            )
        a = np.empty((len(observations), action_dim), np.float32)
        with self._closed_on_error():
            for first in range(0, len(a), ROWS):
                rows = observations[first : first + ROWS]
                head = child.HEAD.pack(child.RUN, len(rows), *self._widths)
                size = len(rows) * action_dim * 4
                answer = self._ask(self._limits.call_seconds, head, rows.tobytes(), size=size)
                a[first : first + ROWS] = np.frombuffer(answer, "<f4").reshape(len(rows), -1)
        return a


def widths(spec: SMESpec) -> tuple[int, int]:
    """The widths of a task's policies, of observations and of actions.

    A team has one policy, which is called for each agent with that agent's shared observation: the
    scorer computes it, so no agent sees more of the state than it observes.
    """
    interface = interface_of(spec)
    return interface.observation_dim, interface.action_dim


def inspect_own(data: bytes, observation_dim: int, action_dim: int) -> None:
    """`Confined.inspect` of a file of one's own: in this process, and on every system."""
    check_size(data)
    require_packages("checking an ONNX file", {"onnx": "onnx"}, "leaderboard")
    try:
        gate.read(data, observation_dim, action_dim, FEED_FORWARD)
    except gate.Refused as refused:
        raise Rejection(refused.code, refused.message) from None


def check_size(data: bytes) -> None:
    """Reject (`too_large`) a file that no board accepts."""
    if len(data) > MAX_ARTEFACT_BYTES:
        raise Rejection(
            "too_large",
            f"policy={len(data):,} bytes: must be at most {MAX_ARTEFACT_BYTES:,}. "
            "Submit a smaller network.",
        )
