"""Keep an interrupt (Ctrl-C) from leaving files half written or processes without an owner."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Deliver an interrupt only after the block, so that the files it writes agree.

    Inside `torch.save`, an interrupt would become a PyTorch error about a broken archive.
    """
    received: list[int] = []
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, lambda *_: received.append(1)) if in_main_thread else None
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    if received:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def block_interrupts() -> Iterator[None]:
    """Processes started inside the block begin with interrupts blocked.

    A terminal sends Ctrl-C to all of them; one that is still importing would print a traceback.
    `unblock_interrupts`, or ignoring the signal, ends the block in the child. Windows has no signal
    masks, so there this does nothing.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # starting it later would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def unblock_interrupts() -> None:
    """Accept interrupts in a process that began with them blocked, including one already sent."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def end_with_parent() -> None:
    """End this process when its parent ends, for any reason."""
    if sys.platform == "linux":
        set_parent_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_parent() -> None:
        parent.join()  # returns at the end of a pipe that only the parent holds
        os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()
