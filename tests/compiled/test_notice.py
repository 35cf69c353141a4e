"""Whoever watches a terminal or a notebook is told why the first environment takes seconds."""

import io
import sys
import threading

from sme_registry.compiled import notice


class Terminal(io.StringIO):
    def __init__(self):
        super().__init__()
        self.written = threading.Event()

    def isatty(self):
        return True

    def flush(self):
        self.written.set()


def test_a_terminal_is_told_while_it_waits(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(notice, "_PATIENCE", 0.0)
    with notice.compiling():
        assert terminal.written.wait(60)
    assert "Numba" in terminal.getvalue()
    assert terminal.getvalue().count("\n") == 1


def test_a_log_and_a_terminal_that_does_not_wait_are_told_nothing(monkeypatch):
    for stream, patience in ((Terminal(), 3600.0), (io.StringIO(), 0.0)):
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
        monkeypatch.setattr(notice, "_PATIENCE", patience)
        timers = set(threading.enumerate())
        with notice.compiling():
            timers = set(threading.enumerate()) - timers
            assert bool(timers) == (patience > 0.0)
        for timer in timers:
            timer.join(60)
        assert stream.getvalue() == ""
