"""The confined child: a script that reads and runs policy files under limits of its own.

The parent starts it by its path; it imports nothing of this package but `gate.py`, by its path. It
sets the limits after it has loaded the libraries and before it reads a byte of a file. From then on
it cannot open or grow a file or start a process, and its memory is limited. Messages and answers
have heads, little-endian:

    in     command, number, S + 2, A, content    a file's bytes (number: their length) for a task of
                                                 these widths, or a batch, float32 [number, S + 2]
    out    status, length, payload               one answer to the start and to each message

The payload of an `OK` answer is a `Start`; nothing for a file that the gate accepts, or that is
loaded; its network in JSON; float32 [number, A] for a batch. Every other status has a short text,
`REJECTED` with the gate's code before it. Arguments: memory in bytes and processor time in seconds,
both in addition to what the libraries use; the allowed operators; the folders of the libraries.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import struct
import sys
from pathlib import Path
from typing import Any, BinaryIO

HEAD = struct.Struct("<BIHH")
ANSWER = struct.Struct("<BI")
START = struct.Struct("<Q32s")  # the memory limit in bytes, in addition to the libraries; version
INSPECT, LOAD, NETWORK, RUN = range(4)
OK, REJECTED, REFUSED, FAILED, OUTPUT, MEMORY = range(6)
MAX_TEXT = 700

_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS = 1, 38
_SIGKILL = 9


def main() -> None:
    """Serve until the input ends."""
    memory, seconds = map(int, sys.argv[1:3])
    operators = frozenset(sys.argv[3].split(","))
    sys.path += sys.argv[4:]
    messages, answers = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # output of a library must not be read as an answer
    os.dup2(nowhere, 2)

    import numpy as np
    import onnx.checker  # noqa: F401  # of the gate, which can open no file later
    import onnxruntime

    gate = _gate()

    def run(session: Any, rows: int, observation_dim: int, action_dim: int) -> tuple[int, bytes]:
        batch = np.frombuffer(messages.read(rows * observation_dim * 4), np.float32)
        name = session.get_inputs()[0].name
        a = session.run(None, {name: batch.reshape(rows, observation_dim)})[0]
        if getattr(a, "dtype", None) != np.float32 or a.shape != (rows, action_dim):
            output = f"{getattr(a, 'dtype', type(a).__name__)} {list(np.shape(a)[:8])}"
            return OUTPUT, output.encode()
        return OK, a.tobytes()

    granted = _set_limits(memory, seconds)
    _answer(answers, OK, START.pack(granted, onnxruntime.__version__.encode()))
    options = _options(onnxruntime)
    session = None
    while (head := messages.read(HEAD.size)) and len(head) == HEAD.size:
        command, number, *widths = HEAD.unpack(head)
        try:
            if command == RUN:
                answer = run(session, number, *widths)
            else:
                data = messages.read(number)
                model = gate.read(data, *widths, operators)
                answer = OK, gate.numbers(model) if command == NETWORK else b""
                del model
            if command == LOAD:
                session = onnxruntime.InferenceSession(
                    data, options, providers=["CPUExecutionProvider"]
                )
        except gate.Refused as refused:
            answer = REJECTED, f"{refused.code} {refused.message}".encode("utf-8", "replace")
        except Exception as error:
            answer = _error_answer(error, FAILED if command == RUN else REFUSED)
        _answer(answers, answer[0], answer[1] if answer[0] == OK else answer[1][:MAX_TEXT])


def _gate() -> Any:
    """The module `gate.py` beside this file."""
    path = Path(__file__).with_name("gate.py")
    spec = importlib.util.spec_from_file_location("gate", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _options(onnxruntime: Any) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Run the model as submitted: the result of an optimiser depends on its version.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    # Kernels differ in where they round denormal numbers to 0; and these take 100 times as long.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    # Otherwise the bytes themselves choose: onnxruntime's own format starts with another mark.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return options


def _set_limits(memory: int, seconds: int) -> int:
    """Set the limits; return the memory limit, which the parent's own limit may lower."""
    import ctypes
    import resource

    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as adjustment:
        adjustment.write("1000")  # a machine short of memory ends this process, not the scorer
    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = int(used.ru_utime + used.ru_stime) + 1
    # The soft limit ends the process with SIGXCPU, which tells the parent why.
    resource.setrlimit(resource.RLIMIT_CPU, (spent + seconds, spent + seconds + 1))
    prctl = ctypes.CDLL(None).prctl
    prctl(_PR_SET_PDEATHSIG, _SIGKILL, 0, 0, 0)
    prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    with open("/proc/self/statm") as statm:
        mapped = int(statm.read().split()[0]) * resource.getpagesize()
    inherited = resource.getrlimit(resource.RLIMIT_AS)
    limit = min([mapped + memory, *(each for each in inherited if each != resource.RLIM_INFINITY)])
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for kind in ("CORE", "FSIZE", "NPROC", "NOFILE"):
        resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), (0, 0))
    return max(limit - mapped, 0)


def _error_answer(error: Exception, status: int) -> tuple[int, bytes]:
    """The status and text of an error."""
    text = str(error)
    # ONNX Runtime's errors have one type; only the text says that memory ran out.
    if isinstance(error, MemoryError) or any(
        mark in text for mark in ("bad_alloc", "bad allocation", "allocate memory")
    ):
        status = MEMORY
    return status, text.encode("utf-8", "replace")


def _answer(stream: BinaryIO, status: int, payload: bytes = b"") -> None:
    stream.write(ANSWER.pack(status, len(payload)) + payload)
    stream.flush()


if __name__ == "__main__":
    main()
