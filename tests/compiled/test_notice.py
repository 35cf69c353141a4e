"""Whoever watches a terminal or a notebook is told why the first environment takes seconds."""

from __future__ import annotations

import io
import sys
import threading

import pytest

from sme_registry.compiled import notice


class Terminal(io.StringIO):
    def __init__(self) -> None:
        super().__init__()
        self.written = threading.Event()

    def isatty(self) -> bool:
        return True

    def flush(self) -> None:
        self.written.set()


def test_a_terminal_is_told_while_it_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(notice, "_PATIENCE", 0.0)
    with notice.compiling():
        assert terminal.written.wait(60)
    assert "Numba" in terminal.getvalue()
    assert terminal.getvalue().count("\n") == 1


def test_a_terminal_that_does_not_wait_is_told_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(notice, "_PATIENCE", 3600.0)
    with notice.compiling():
        pass
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.join(60)
    assert terminal.getvalue() == ""


def test_a_log_is_told_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    monkeypatch.setattr(notice, "_PATIENCE", 0.0)
    with notice.compiling():
        assert not any(isinstance(each, threading.Timer) for each in threading.enumerate())
    assert log.getvalue() == ""
