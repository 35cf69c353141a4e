"""The child process of the sandbox: a script that runs one model under limits that it sets itself.

The parent starts it by its path; it imports nothing of this package. It sets the limits after it
has loaded the libraries and before it reads a byte of the model. From then on it cannot open or
grow a file or start a process, and its memory is limited. Messages, little-endian:

    in     uint32 length, the model;  then for each batch  uint32 rows, float32 [rows, S + 2]
    out    uint8 status, uint32 length, payload            one answer to the start, one to the
                                                           model, one to each batch

The payload of an `OK` answer to a batch is float32 [rows, A], and empty otherwise. Every other
status has a short text. Arguments: memory in bytes and processor time in seconds, both in addition
to what the libraries use; S + 2; A; then the folders of the libraries.
"""

from __future__ import annotations

import os
import struct
import sys
from typing import BinaryIO

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

    _set_limits(memory, seconds)
    _answer(answers, OK)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Run the model as submitted: the result of an optimiser depends on its version.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        session = onnxruntime.InferenceSession(
            messages.read(_length(messages) or 0), options, providers=["CPUExecutionProvider"]
        )
        name = session.get_inputs()[0].name
    except Exception as error:
        _answer(answers, *_error_answer(error, REFUSED))
        return
    _answer(answers, OK)

    while (rows := _length(messages)) is not None:
        try:
            batch = np.frombuffer(messages.read(rows * observation_dim * 4), np.float32)
            a = session.run(None, {name: batch.reshape(rows, observation_dim)})[0]
            if getattr(a, "dtype", None) != np.float32 or a.shape != (rows, action_dim):
                output = f"{getattr(a, 'dtype', type(a).__name__)} {list(np.shape(a)[:8])}"
                answer = OUTPUT, output.encode()
            else:
                answer = OK, a.tobytes()
        except Exception as error:
            answer = _error_answer(error, FAILED)
        _answer(answers, *answer)


def _set_limits(memory: int, seconds: int) -> None:
    import ctypes
    import resource

    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = int(used.ru_utime + used.ru_stime) + 1
    # The soft limit ends the process with SIGXCPU, which tells the parent why.
    resource.setrlimit(resource.RLIMIT_CPU, (spent + seconds, spent + seconds + 1))
    prctl = ctypes.CDLL(None).prctl
    prctl(_PR_SET_PDEATHSIG, _SIGKILL, 0, 0, 0)
    prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    with open("/proc/self/statm") as statm:
        mapped = int(statm.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + memory, mapped + memory))
    for kind in ("CORE", "FSIZE", "NPROC", "NOFILE"):
        resource.setrlimit(getattr(resource, f"RLIMIT_{kind}"), (0, 0))


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
    stream.write(struct.pack("<BI", status, len(payload)) + payload)
    stream.flush()


def _length(stream: BinaryIO) -> int | None:
    """The first number of a message, or None at the end of the input."""
    head = stream.read(4)
    return struct.unpack("<I", head)[0] if len(head) == 4 else None


if __name__ == "__main__":
    main()
