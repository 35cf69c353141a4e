"""`Progress`: how far a long job is, as bars in a terminal, elsewhere as a few lines.

Lines come after 5, 10, 20, 40, … seconds, and at every further tenth of the job, at most one a
minute: a log shows early that the job runs, and stays short however long it takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars

from sme_registry.terminal.numbers import duration

_SECONDS_TO_FIRST_LINE = 5.0
_SECONDS_BETWEEN_TENTHS = 60.0
_SECONDS_BETWEEN_BARS = 0.5
_PARTS_NAMED = 3  # in a line


class Progress:
    """Shows steps done, the rate, the time left, a note, and the parts of the job that are running.

    Args:
      title: the job, such as `training`.
      total: its steps.
      done: steps that were done before it started.
      console: where to print; None for standard error. If it is no terminal, lines replace bars.
      unit: what a step is, in the plural.
      seconds_left: estimates the time left; by default it follows from the rate.
      enabled: False shows nothing.
    """

    def __init__(
        self,
        title: str,
        total: int,
        *,
        done: int = 0,
        console: Console | None = None,
        unit: str = "steps",
        seconds_left: Callable[[], float] | None = None,
        enabled: bool = True,
    ) -> None:
        self._title, self._unit = title, unit
        self._total, self._done_before, self._done = total, done, done
        self._rate_from: tuple[int, float] | None = None  # steps and time; None while it prepares
        self._console = console or Console(stderr=True)
        self._seconds_left, self._enabled = seconds_left, enabled
        self._note = ""
        self._parts: dict[str, str] = {}  # how far they are
        self._start = self._last = time.monotonic()
        self._share_printed = 0.0
        self._bars: Bars | None = None
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._start = self._last = time.monotonic()
        self._rate_from = self._done, self._start
        if self._enabled and self._console.is_terminal:
            self._bars = Bars(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[text]}"),
                console=self._console,
            )
            self._tasks[""] = self._bars.add_task(
                escape(self._title), total=self._total, completed=self._done, text=""
            )
            self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for name in tuple(self._parts):
            self._remove(name)
        if self._bars is not None:
            self._draw()
            self._bars.stop()
        elif self._enabled and error is None and self._done_before < self._done >= self._total:
            self._print()

    def prepare(self, note: str) -> None:
        """Show at once what precedes or slows the first steps, such as a compilation.

        Until `prepared`, neither a rate nor the time left is shown: both would be wrong.
        """
        self._note, self._rate_from = note, None
        if self._bars is not None:
            self._draw()
        else:
            self.message(f"{self._title}: {note}")

    def prepared(self) -> None:
        """Measure the rate from here on, if it is not measured yet."""
        self._rate_from = self._rate_from or (self._done, time.monotonic())

    def update(self, done: int, note: str | None = None, *, total: int | None = None) -> None:
        """Set how far the job is; cheap enough to call at every step.

        Args:
          done: steps done, including those before the start.
          note: more text to show; None keeps the last one.
          total: steps of the job, if they have changed.
        """
        self._done = done
        self._note = self._note if note is None else note
        self._total = self._total if total is None else total
        self._refresh()

    def update_of(self, done: int, total: int) -> None:
        """Set how far the job is and how long it is, as callbacks `(done, total)` report it."""
        self.update(done, total=total)

    def start_part(self, name: str, note: str = "") -> None:
        """Show a part of the job that runs from now on, and what it does first."""
        self._parts[name] = f"({note})" if note else "0%"
        if self._bars is not None:
            label = f"  {escape(name)}"
            self._tasks[name] = self._bars.add_task(label, total=1.0, text=note or "starting")
        self._refresh()

    def update_part(self, name: str, share: float, note: str = "") -> None:
        """Set how far a part is, from 0 to 1."""
        self._parts[name] = f"{share:.0%}"
        if self._bars is not None:
            self._bars.update(self._tasks[name], completed=share, text=note)
        self._refresh()

    def end_part(self, name: str) -> None:
        """Stop showing a part; of one that was never started this does nothing."""
        self._remove(name)
        self._refresh()

    def message(self, text: str) -> None:
        """Print a line of its own, above the bars."""
        if self._enabled:
            self._console.print(escape(text), highlight=False, soft_wrap=True)

    def _remove(self, name: str) -> None:
        self._parts.pop(name, None)
        if self._bars is not None and name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))

    def _refresh(self) -> None:
        now = time.monotonic()
        if not self._enabled:
            return
        if self._bars is not None:
            if now - self._last >= _SECONDS_BETWEEN_BARS:
                self._last = now
                self._draw()
        elif self._done < self._total and self._line_is_due(now):  # the last one is at the end
            self._last, self._share_printed = now, self._done / self._total
            self._print()

    def _line_is_due(self, now: float) -> bool:
        if now - self._start >= max(_SECONDS_TO_FIRST_LINE, 2 * (self._last - self._start)):
            return True
        another_tenth = self._done / self._total - self._share_printed >= 0.1
        return another_tenth and now - self._last >= _SECONDS_BETWEEN_TENTHS

    def _draw(self) -> None:
        assert self._bars is not None
        done, text = min(self._done, self._total), " · ".join(self._summary())
        self._bars.update(self._tasks[""], completed=done, total=self._total, text=text)

    def _print(self) -> None:
        self.message(f"{self._title}: {' · '.join([*self._summary(), *self._running()])}")

    def _summary(self) -> list[str]:
        """`4 of 10 steps`, the rate, the time left, the note."""
        now = time.monotonic()
        done_before, start = self._rate_from or (self._done, now)
        rate = (self._done - done_before) / max(now - start, 1e-9)
        parts = [f"{self._done:,} of {self._total:,} {self._unit}"]
        if rate > 0 and self._seconds_left is None:
            parts.append(_rate(rate, self._unit))
        if self._done >= self._total:
            parts.append("done")
        elif self._seconds_left is not None:
            parts.append(f"about {duration(self._seconds_left())} left")
        elif rate > 0:
            parts.append(f"about {duration((self._total - self._done) / rate)} left")
        return [*parts, self._note] if self._note else parts

    def _running(self) -> list[str]:
        if not self._parts:
            return []
        parts = [f"{name} {state}" for name, state in self._parts.items()]
        more = f", and {len(parts) - _PARTS_NAMED} more" if len(parts) > _PARTS_NAMED else ""
        return [f"running: {', '.join(parts[:_PARTS_NAMED])}{more}"]


def _rate(rate: float, unit: str) -> str:
    """`280 steps/s`; where a step takes longer than a second, `3 s per run`."""
    if rate < 1 and unit.endswith("s"):
        one = f"{unit[:-3]}y" if unit.endswith("ies") else unit[:-1]
        return f"{duration(1 / rate)} per {one}"
    return f"{rate:,.0f} {unit}/s"
