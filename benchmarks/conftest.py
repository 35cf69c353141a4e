"""Ratios against named peers, measured in interleaved rounds of one run; `make bench` prints them.

A machine's speed wanders by a fifth within a minute. So ours and the peer take turns, and a row is
the ratio of their median times over the rounds. A bar that is missed is printed, never asserted:
speed is no part of a test's verdict.
"""

from __future__ import annotations

import os

# Before NumPy loads: one core for everybody.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from rich.console import Console
from rich.table import Table

ROUNDS = 11


@dataclass(frozen=True)
class Row:
    """One comparison: seconds per unit of work, and how many times as fast ours must be."""

    title: str
    unit: str
    ours: float
    peer_name: str
    peer: float
    bar: float

    @property
    def ratio(self) -> float:
        return self.peer / self.ours


rows: list[Row] = []

Work = Callable[[int], None]


@pytest.fixture
def compare(benchmark: Any) -> Callable[..., None]:
    """`compare(title, unit, ours, peers, units)`: rows for one of our functions and its peers.

    Each function does `n` units of work when called with n; `peers` maps a name to
    `(function, n of a round, bar)`; a bar is the least peer time divided by our time, 0 where
    the peer only stands there to compare. `clock` is wall time, or `time.thread_time` for work so
    long that other jobs on the machine would be measured with it.
    """

    def measure(
        title: str,
        unit: str,
        ours: Work,
        units: int,
        peers: dict[str, tuple[Work, int, float]],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        works = {"ours": (ours, units), **{name: peer[:2] for name, peer in peers.items()}}
        for work, count in works.values():  # warm up: compilation, caches, lazy imports
            work(max(1, count // 10))
        seconds: dict[str, list[float]] = {name: [] for name in works}
        for _ in range(ROUNDS):
            for name, (work, count) in works.items():
                begun = clock()
                work(count)
                seconds[name].append((clock() - begun) / count)
        medians = {name: statistics.median(values) for name, values in seconds.items()}
        for name, (_, _, bar) in peers.items():
            row = Row(title, unit, medians["ours"], name, medians[name], bar)
            rows.append(row)
            benchmark.extra_info[f"ratio to {name}"] = row.ratio
        benchmark.pedantic(ours, args=(units,), rounds=3, iterations=1)

    return measure


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The table of `make bench`."""
    if not rows:
        return
    import gymnasium
    import numpy as np

    from sme_registry.compiled import chosen_backend

    table = Table(title="Medians of interleaved rounds, one core", title_justify="left")
    for heading in ("what", "per", "ours", "peer", "", "ratio", "bar", ""):
        table.add_column(
            heading, justify="right" if heading in ("ours", "ratio", "bar") else "left"
        )
    for row in rows:
        met = "met" if row.ratio >= row.bar else "[bold]missed[/bold]"
        bar = f"{row.bar:.3g} ×"
        if not row.bar:
            met, bar = "", "none"
        table.add_row(
            row.title, row.unit, _time(row.ours), row.peer_name, _time(row.peer),
            f"{row.ratio:.2f} ×", bar, met,
        )  # fmt: skip
    terminalreporter.write_line("")
    console = Console(file=sys.stdout, width=130)
    console.print(table)
    console.print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, Gymnasium "
        f"{gymnasium.__version__}, back-end {chosen_backend()}, {platform.machine()}, "
        f"{os.cpu_count()} cores",
        highlight=False,
    )


def _time(seconds: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"
