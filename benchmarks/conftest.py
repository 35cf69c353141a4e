"""Ratios against named peers, measured in interleaved rounds of one run; `make bench` prints them.

A machine's speed varies by a fifth within a minute, so we and the peer run alternately. A row is
the ratio of the median times over all rounds. A missed target is printed, never asserted. With
`--rounds FILE` the times of all rounds become rows of a CSV, as beside the pages of results.
"""

from __future__ import annotations

import os

# Set before NumPy is imported: one core for all candidates.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import csv
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from matplotlib.ticker import EngFormatter
from rich.console import Console
from rich.table import Table

ROUNDS = 11


@dataclass(frozen=True)
class Row:
    """One comparison: seconds per unit of work by round, and the least ratio of peer to ours."""

    title: str
    unit: str
    peer_name: str
    target: float
    ours_by_round: list[float]
    peer_by_round: list[float]

    @property
    def ours(self) -> float:
        return statistics.median(self.ours_by_round)

    @property
    def peer(self) -> float:
        return statistics.median(self.peer_by_round)

    @property
    def ratio(self) -> float:
        return self.peer / self.ours


rows: list[Row] = []

Work = Callable[[int], None]


@pytest.fixture
def compare(benchmark: Any) -> Callable[..., None]:
    """`compare(title, unit, ours, peers, units)`: rows for one of our functions and its peers.

    Each function does `n` units of work when called with n; `peers` maps a name to
    `(function, n per round, target)`; the target is the smallest acceptable ratio of peer time to
    our time, or 0 if there is none. `clock` is wall-clock time, or `time.thread_time` for long
    work that other jobs on the machine would disturb.
    """

    def measure(
        title: str,
        unit: str,
        ours: Work,
        units: int,
        peers: dict[str, tuple[Work, int, float]],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        candidates = {"ours": (ours, units), **{name: peer[:2] for name, peer in peers.items()}}
        for work, count in candidates.values():  # warm up: compilation, caches, lazy imports
            work(max(1, count // 10))
        seconds: dict[str, list[float]] = {name: [] for name in candidates}
        for _ in range(ROUNDS):
            for name, (work, count) in candidates.items():
                start = clock()
                work(count)
                seconds[name].append((clock() - start) / count)
        for name, (_, _, target) in peers.items():
            row = Row(title, unit, name, target, seconds["ours"], seconds[name])
            rows.append(row)
            benchmark.extra_info[f"ratio to {name}"] = row.ratio
        benchmark.pedantic(ours, args=(units,), rounds=3, iterations=1)

    return measure


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rounds", type=Path, metavar="FILE", help="write the times of all rounds")


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """The table of `make bench`, and the file of its rounds."""
    if not rows:
        return
    if config.option.rounds:
        with open(config.option.rounds, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["title", "unit", "peer", "target", "round", "ours_s", "peer_s"])
            for row in rows:
                times = enumerate(zip(row.ours_by_round, row.peer_by_round, strict=True), 1)
                place = row.title, row.unit, row.peer_name, f"{row.target:.4g}"
                writer.writerows((*place, n, f"{a:.5g}", f"{b:.5g}") for n, (a, b) in times)
    import gymnasium
    import numpy as np

    from sme_registry.task.engine import chosen_backend

    table = Table(title="Medians of interleaved rounds, one core", title_justify="left")
    for heading in ("what", "per", "ours", "peer", "", "ratio", "target", ""):
        table.add_column(
            heading, justify="right" if heading in ("ours", "ratio", "target") else "left"
        )
    for row in rows:
        outcome = "met" if row.ratio >= row.target else "[bold]missed[/bold]"
        target = f"{row.target:.3g} ×"
        if not row.target:
            outcome, target = "", "none"
        table.add_row(
            row.title, row.unit, _time(row.ours), row.peer_name, _time(row.peer),
            f"{row.ratio:.2f} ×", target, outcome,
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
    return EngFormatter("s")(float(f"{seconds:.3g}"))
