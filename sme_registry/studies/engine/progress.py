"""How a running study shows where it is: bars in a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from sme_registry.spec import PlannedCell
from sme_registry.terminal.progress import duration

SECONDS_BETWEEN_LINES = 10.0
_SECONDS_BETWEEN_ESTIMATES = 1.0
_NAMED = 3  # running cells that a line names


class Board:
    """Shows a study's cells while they run.

    Args:
      what: the study.
      total: its cells.
      done: those that had finished before.
      left: estimates the seconds to the end.
      console: where to. Not a terminal: lines in place of bars.
      shown: False shows nothing.
    """

    def __init__(
        self,
        what: str,
        total: int,
        done: int,
        left: Callable[[], float],
        console: Console,
        *,
        shown: bool = True,
    ) -> None:
        self._what, self._total, self._done, self._failed = what, total, done, 0
        self._left, self._console, self._shown = left, console, shown
        self._running: dict[str, float] = {}
        self._last_line = self._last_estimate = time.monotonic()
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._last_line = time.monotonic()
        if self._shown and self._console.is_terminal:
            self._bars = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[note]}"),
                console=self._console,
                transient=True,
            )
            self._tasks[""] = self._bars.add_task(
                f"[bold]{escape(self._what)}", total=self._total, completed=self._done, note=""
            )
            self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def say(self, text: str) -> None:
        """A line of its own, above the bars."""
        if self._shown:
            self._console.print(escape(text), highlight=False, soft_wrap=True)

    def began(self, planned: PlannedCell) -> None:
        """A cell runs from now on."""
        name = title(planned)
        self._running[name] = 0.0
        if self._bars is not None:
            self._tasks[name] = self._bars.add_task(f"  {escape(name)}", total=1.0, note="starts")
        self._refresh()

    def told(self, planned: PlannedCell, done: int, total: int) -> None:
        """A running cell has done so many of its steps."""
        name = title(planned)
        self._running[name] = share = done / total if total else 1.0
        if self._bars is not None:
            note = f"{done:,} of {total:,} steps" if done < total else "is evaluated"
            self._bars.update(self._tasks[name], completed=share, note=note)
        self._refresh()

    def ended(self, planned: PlannedCell, *, failed: bool = False) -> None:
        """A cell has finished or failed, here or in another process."""
        name = title(planned)
        self._running.pop(name, None)
        self._done += not failed
        self._failed += failed
        if self._bars is not None:
            if name in self._tasks:
                self._bars.remove_task(self._tasks.pop(name))
            self._bars.update(self._tasks[""], completed=self._done)
            self._last_estimate = 0.0
        self._refresh()

    def _refresh(self) -> None:
        now = time.monotonic()
        if self._bars is not None:
            if now - self._last_estimate >= _SECONDS_BETWEEN_ESTIMATES:
                self._last_estimate = now
                self._bars.update(self._tasks[""], note=" · ".join(self._summary()))
        elif self._shown and now - self._last_line >= SECONDS_BETWEEN_LINES:
            self._last_line = now
            running = [f"{name} {share:.0%}" for name, share in self._running.items()]
            more = f", and {len(running) - _NAMED} more" if len(running) > _NAMED else ""
            parts = [*self._summary(), f"running: {', '.join(running[:_NAMED])}{more}"]
            self.say(f"{self._what}: {' · '.join(parts)}")

    def _summary(self) -> list[str]:
        parts = [f"{self._done:,} of {self._total:,} cells"]
        if self._failed:
            parts.append(f"{self._failed} failed")
        return [*parts, f"about {duration(self._left())} left"]


def title(planned: PlannedCell) -> str:
    """How a cell is called: `PPO on k-25, run 3`."""
    return f"{planned.algorithm} on {planned.class_name}, run {planned.run}"
