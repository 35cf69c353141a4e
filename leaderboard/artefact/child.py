"""The sandbox's inside: a script that runs one model, within limits that it sets for itself.

It is started by its path in a process of its own and imports nothing of this package. The limits
come after the libraries are loaded and before a byte of the model is read: from then on no file can
be opened or grown and no process started, and memory is limited to so much above what the libraries
took. What arrives and leaves, little-endian:

    in     uint32 length, the model;  then again and again  uint32 rows, float32 [rows, S + 2]
    out    uint8 status, uint32 length, payload             one answer to the start, one to the
                                                            model, one to each batch

An answer of status `OK` has no payload but after a batch: float32 [rows, A]. Any other has a short
text. Arguments: memory in bytes and processor time in seconds above what is used at the start, S +
2, A, then the folders that hold the libraries.
"""

from __future__ import annotations

import os
import resource
import struct
import sys

OK, REFUSED, FAILED, OUTPUT, MEMORY = range(5)
MAX_TEXT = 500

_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS = 1, 38
_SIGKILL = 9


def main() -> None:
    """Serve one model until the input ends."""
    memory, seconds, observation_dim, action_dim = map(int, sys.argv[1:5])
    sys.path += sys.argv[5:]
    answers = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # whatever a library prints must not be taken for an answer
    os.dup2(nowhere, 2)

    import numpy as np
    import onnxruntime

    _set_limits(memory, seconds)
    _answer(answers, OK)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # As it was submitted: what an optimiser makes of it would change with its version.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        session = onnxruntime.InferenceSession(
            _read(_length() or 0), options, providers=["CPUExecutionProvider"]
        )
        name = session.get_inputs()[0].name
    except Exception as error:
        _answer(answers, *_told(error, REFUSED))
        return
    _answer(answers, OK)

    while (rows := _length()) is not None:
        try:
            batch = np.frombuffer(_read(rows * observation_dim * 4), np.float32)
            a = session.run(None, {name: batch.reshape(rows, observation_dim)})[0]
            if getattr(a, "dtype", None) != np.float32 or a.shape != (rows, action_dim):
                found = f"{getattr(a, 'dtype', type(a).__name__)} {list(np.shape(a)[:8])}"
                answer = OUTPUT, found.encode()
            else:
                answer = OK, a.tobytes()
        except Exception as error:
            answer = _told(error, FAILED)
        _answer(answers, *answer)


def _set_limits(memory: int, seconds: int) -> None:
    used = resource.getrusage(resource.RUSAGE_SELF)
    spent = int(used.ru_utime + used.ru_stime) + 1
    # The soft limit ends the process by SIGXCPU, which tells the parent why.
    resource.setrlimit(resource.RLIMIT_CPU, (spent + seconds, spent + seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    if sys.platform == "linux":
        import ctypes

        prctl = ctypes.CDLL(None).prctl
        prctl(_PR_SET_PDEATHSIG, _SIGKILL, 0, 0, 0)
        prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        with open("/proc/self/statm") as statm:
            taken = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + memory, taken + memory))
        resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))


def _told(error: Exception, status: int) -> tuple[int, bytes]:
    """The status and text of a failure."""
    text = str(error)
    # Runtime errors are all of one kind; which one ran out of memory only their texts say.
    if isinstance(error, MemoryError) or any(
        mark in text for mark in ("bad_alloc", "bad allocation", "allocate memory")
    ):
        status = MEMORY
    return status, text.encode("utf-8", "replace")[:MAX_TEXT]


def _answer(stream: int, status: int, payload: bytes = b"") -> None:
    for part in (struct.pack("<BI", status, len(payload)), payload):
        left = memoryview(part)
        while left:
            left = left[os.write(stream, left) :]


def _length() -> int | None:
    """A frame's first number, or None at the end of the input."""
    head = _read(4)
    return struct.unpack("<I", head)[0] if len(head) == 4 else None


def _read(size: int) -> bytes:
    """So many bytes, or fewer where the input ends."""
    read = bytearray()
    while len(read) < size:
        part = os.read(0, min(size - len(read), 2**20))
        if not part:
            break
        read += part
    return bytes(read)


if __name__ == "__main__":
    main()
