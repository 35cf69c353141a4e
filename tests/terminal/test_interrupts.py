"""Interrupts wait until files are written."""

from __future__ import annotations

import signal

import pytest

from sme_registry.terminal.interrupts import defer_interrupts


def test_an_interrupt_waits_until_the_block_ends() -> None:
    written, before = [], signal.getsignal(signal.SIGINT)

    def save() -> None:
        with defer_interrupts():
            signal.raise_signal(signal.SIGINT)
            written.append("checkpoint and record")

    with pytest.raises(KeyboardInterrupt):
        save()
    assert written == ["checkpoint and record"]
    assert signal.getsignal(signal.SIGINT) is before
