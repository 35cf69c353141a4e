"""How a long job shows where it is: a bar in a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

SECONDS_BETWEEN_LINES = 5.0
_SECONDS_BETWEEN_EQUAL_LINES = 60.0


class Meter:
    """Shows steps done, steps a second, the time left, and a note.

    Args:
      what: the job, as in `training`.
      total: its steps.
      done: those that an earlier session has done.
      console: where to; None for standard error. Not a terminal: lines in place of a bar.
      unit: of the steps.
      shown: False shows nothing.
    """

    def __init__(
        self,
        what: str,
        total: int,
        *,
        done: int = 0,
        console: Console | None = None,
        unit: str = "steps",
        shown: bool = True,
    ) -> None:
        self._what, self._total, self._begun_at, self._unit = what, total, done, unit
        self._console = console or Console(stderr=True)
        self._shown = shown
        self._start = self._last_line = time.monotonic()
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._line = self._printed = ""

    def __enter__(self) -> Self:
        self._start = self._last_line = time.monotonic()
        if self._shown and self._console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
                console=self._console,
            )
            self._task = self._bar.add_task(
                self._what, total=self._total, completed=self._begun_at, rate="", note=""
            )
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        elif self._line and error is None:
            self._print()

    def update(self, done: int, note: str = "") -> None:
        """Say where the job is; cheap enough to call at every step.

        Args:
          done: steps done, over all sessions.
          note: what else to show.
        """
        if not self._shown:
            return
        now = time.monotonic()
        rate = (done - self._begun_at) / max(now - self._start, 1e-9)
        if self._bar is not None and self._task is not None:
            self._bar.update(
                self._task,
                completed=min(done, self._total),
                rate=self._rate(rate),
                note=note,
            )
        elif now - self._last_line >= SECONDS_BETWEEN_LINES or done >= self._total:
            left = (self._total - done) / rate if rate > 0 else 0.0
            parts = [
                f"{self._what}: {done:,} of {self._total:,} {self._unit}",
                *([self._rate(rate)] if rate > 0 else []),
                "done" if done >= self._total else f"{duration(left)} left" if rate > 0 else "…",
            ]
            self._line = " · ".join([*parts, note] if note else parts)
            if done < self._total:  # the last line is printed once, at the end
                self._print()

    def of(self, done: int, total: int) -> None:
        """As `update`, for work that learns on its way how much there is."""
        if total != self._total:
            self._total = total
            if self._bar is not None and self._task is not None:
                self._bar.update(self._task, total=total)
        self.update(done)

    def _rate(self, rate: float) -> str:
        """`280 steps/s`; of what takes longer than a second each, `3 s a run`."""
        if 0 < rate < 1 and self._unit.endswith("s"):
            return f"{duration(1 / rate)} a {self._unit[:-1]}"
        return f"{rate:,.0f} {self._unit}/s"

    def _print(self) -> None:
        now = time.monotonic()
        if self._line == self._printed and now - self._last_line < _SECONDS_BETWEEN_EQUAL_LINES:
            return
        self._printed = self._line
        self._console.print(self._line, highlight=False, soft_wrap=True)
        self._last_line, self._line = time.monotonic(), ""


def duration(seconds: float) -> str:
    """`42 s`, `3 min 10 s`, `2 h 5 min`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
