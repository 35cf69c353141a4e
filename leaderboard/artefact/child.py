"""The child process of the sandbox: a script that runs one model under limits that it sets itself.

The parent starts it by its path; it imports nothing of this package. It sets the limits after it
has loaded the libraries and before it reads a byte of the model. From then on it cannot open or
grow a file or start a process, and its memory is limited. Messages and answers have a head of
uint8 and uint32, little-endian:

    in     command, number, content     a model's bytes (number: their length), or
                                        a batch, float32 [number, S + 2]
    out    status, length, payload      one answer to the start and to each message

The policy and its twin for rounding (`twin.py`) may both be loaded. The payload of an `OK` answer
is a `Start`, nothing for a model, float32 [number, A] for a batch. Every other status has a short
text. Arguments: memory in bytes and processor time in seconds, both in addition to what the
libraries use; S + 2; A; then the folders of the libraries.
"""

from __future__ import annotations

import contextlib
import os
import struct
import sys
from typing import Any, BinaryIO

HEAD = struct.Struct("<BI")
START = struct.Struct("<Q32s")  # the memory limit in bytes, in addition to the libraries; version
LOAD, LOAD_TWIN, RUN, RUN_TWIN = range(4)
OK, REFUSED, FAILED, OUTPUT, MEMORY = range(5)
MAX_TEXT = 500

_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS = 1, 38
_SIGKILL = 9


def main() -> None:
    """Serve one model until the input ends."""
    memory, seconds, observation_dim, action_dim = map(int, sys.argv[1:5])
    sys.path += sys.argv[5:]
    messages, answers = os.fdopen(0, "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # output of a library must not be read as an answer
    os.dup2(nowhere, 2)

    import numpy as np
    import onnxruntime

    def run(session: Any, rows: int) -> tuple[int, bytes]:
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
    sessions: dict[int, Any] = {}
    while (head := messages.read(HEAD.size)) and len(head) == HEAD.size:
        command, number = HEAD.unpack(head)
        try:
            if command in (RUN, RUN_TWIN):
                answer = run(sessions[command], number)
            else:
                sessions[command + RUN] = onnxruntime.InferenceSession(
                    messages.read(number), options, providers=["CPUExecutionProvider"]
                )
                answer = OK, b""
        except Exception as error:
            answer = _error_answer(error, FAILED if command in (RUN, RUN_TWIN) else REFUSED)
        _answer(answers, *answer)


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
    return status, text.encode("utf-8", "replace")[:MAX_TEXT]


def _answer(stream: BinaryIO, status: int, payload: bytes = b"") -> None:
    stream.write(HEAD.pack(status, len(payload)) + payload)
    stream.flush()


if __name__ == "__main__":
    main()
