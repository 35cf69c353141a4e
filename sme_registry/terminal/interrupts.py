"""Ctrl-C at moments where it would leave something half done, or nobody's."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """An interrupt (Ctrl-C) waits until the block is done, so that what it writes agrees.

    And inside `torch.save` it would turn into an error of PyTorch's about a broken archive.
    """
    pressed: list[int] = []
    handled = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, lambda *_: pressed.append(1)) if handled else None
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    if pressed:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def starting_deaf() -> Iterator[None]:
    """Processes started inside hear no interrupt from their first instruction on.

    Without it one that comes while they still import ends them with a traceback of their own. A
    terminal sends Ctrl-C to all of them.
    """
    resource_tracker.ensure_running()  # which would lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def hear() -> None:
    """Hear interrupts from now on, and one that came before: for a process that started deaf."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
