"""What a long job shows while it runs, how durations are written, and interrupts."""

import io
import signal
from itertools import pairwise
from types import SimpleNamespace

import pytest
from rich.console import Console

from sme_registry.io.system import defer_interrupts
from sme_registry.io.terminal import Progress, duration, duration_range, err


def test_without_a_terminal_it_prints_lines_and_in_one_it_draws_a_bar():
    text, bar, silent = io.StringIO(), io.StringIO(), io.StringIO()
    with Progress("training", 10, console=Console(file=text, width=200)) as progress:
        progress.update(4, note="note")
        progress.update(10, note="note")
    (line,) = text.getvalue().splitlines()
    assert line.startswith("training: 10 of 10 steps")
    assert line.endswith("done · note")
    console = Console(file=bar, force_terminal=True, width=160)
    with Progress("training", 10, console=console) as progress:
        progress.update(10, note="mean regret 0.5")
    assert "mean regret 0.5" in bar.getvalue()
    assert "10 of 10 steps" in bar.getvalue()
    with Progress("training", 10, console=Console(file=silent), enabled=False) as progress:
        progress.update(10)
    with Progress("scoring", 0, console=Console(file=silent)):
        pass
    assert silent.getvalue() == ""


def test_durations_are_in_words():
    for seconds, words in (
        (0.4, "0 s"), (59, "59 s"), (61, "1 min 1 s"), (7500, "2 h 5 min"), (302_400, "3.5 days"),
    ):  # fmt: skip
        assert duration(seconds) == words
    assert duration_range(60, 60.2) == "1 min 0 s"
    assert duration_range(60, 7500) == "1 min 0 s to 2 h 5 min"


@pytest.fixture
def clock(monkeypatch):
    """Time as a test sets it."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr("sme_registry.io.terminal.time.monotonic", lambda: clock.now)
    return clock


def test_what_precedes_the_first_steps_is_shown_at_once_and_slows_no_estimate(clock):
    text = io.StringIO()
    with Progress("training", 100, console=Console(file=text, width=200)) as progress:
        progress.prepare("compiling …")
        assert text.getvalue() == "training: compiling …\n"
        clock.now = 30.0
        progress.update(20, note="")
        clock.now = 100.0
        progress.update(90, note="")
        clock.now = 220.0
        progress.update(95, note="")
    lines = text.getvalue().splitlines()[1:]
    assert lines == [
        "training: 20 of 100 steps",
        "training: 90 of 100 steps · 1 steps/s · about 10 s left",
        "training: 95 of 100 steps · about 13 s left",
    ]


@pytest.mark.parametrize(("hours", "most"), [(0.05, 7), (1, 20), (24 * 30, 30)])
def test_a_log_stays_short_however_long_the_job_takes(clock, hours, most):
    text, seconds = io.StringIO(), int(hours * 3600)
    with Progress("training", seconds, console=Console(file=text, width=200)) as progress:
        for second in range(0, seconds + 1, max(1, seconds // 10_000)):
            clock.now = float(second)
            progress.update(second)
    lines = text.getvalue().splitlines()
    assert 5 <= len(lines) <= most
    done = [int(line.split()[1].replace(",", "")) for line in lines]
    assert done[0] <= max(10, seconds // 5_000)  # the first line comes early
    steps = [later - earlier for earlier, later in pairwise(done)]
    assert max(steps) <= max(120, 0.11 * seconds)  # no long silence


def test_running_parts_are_named_in_a_line(clock):
    text = io.StringIO()
    console = Console(file=text, width=200)
    with Progress("study", 9, unit="cells", console=console) as progress:
        for number in range(5):
            progress.start_part(f"cell {number}", "compiling" if number == 2 else "")
        clock.now = 5.0
        progress.update_part("cell 0", 0.5)
        clock.now = 10.0
        progress.end_part("cell 4")
    expected = (
        "study: 0 of 9 cells · running: cell 0 50%, cell 1 0%, cell 2 (compiling), and 2 more"
    )
    assert expected in text.getvalue()
    assert "cell 4" not in text.getvalue().splitlines()[-1]


def test_in_a_pipe_colours_can_be_forced_but_not_bars(monkeypatch, capsys):
    """Jupyter forces colours in the shell cells of a notebook."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    console = err()
    console.print("[red]long[/]" + " long" * 40)
    with Progress("training", 10, console=console) as progress:
        progress.update(10)
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("\x1b[31mlong\x1b[0m long")
    assert second.startswith("training: 10 of 10 steps")


def test_an_interrupt_waits_until_the_block_ends():
    written, before = [], signal.getsignal(signal.SIGINT)

    def save():
        with defer_interrupts():
            signal.raise_signal(signal.SIGINT)
            written.append("checkpoint and record")

    with pytest.raises(KeyboardInterrupt):
        save()
    assert written == ["checkpoint and record"]
    assert signal.getsignal(signal.SIGINT) is before
