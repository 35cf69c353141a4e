"""`Certificate`: measured numbers of a drawn task, each with the range in which it passes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from sme_registry.task.draw import Array
from sme_registry.task.streams import uniform
from sme_registry.task.task import Task

if TYPE_CHECKING:
    from sme_registry.io.tables import Table

Outcome = Literal["passed", "warning", "refused", "reported"]
_WORST_FIRST: tuple[Outcome, ...] = ("refused", "warning")

MARKS = {
    "passed": "[green]passed[/]",
    "warning": "[yellow]warning[/]",
    "refused": "[red]refused[/]",
    "reported": "[dim]reported[/]",
}
"""The outcomes in colour, with Rich's markup."""

INF = math.inf


@dataclass(frozen=True)
class Check:
    """One measured number of a task, and its range.

    Attributes:
      name: of the number.
      value: the number; None where it was not measured; `meaning` gives the reason.
      low, high: the range in which it passes; None where there is no bound on that side.
      outcome: "passed"; "warning" for an easy task, or one whose limits bind more or less often
        than its tightness says; "refused" for a broken or trivial one; "reported" for numbers
        without a range.
      meaning: one sentence for the reader.
    """

    name: str
    value: float | None
    low: float | None
    high: float | None
    outcome: Outcome
    meaning: str


@dataclass(frozen=True)
class Certificate:
    """The result of `certify`.

    Attributes:
      digest: of the spec.
      seed: of the states and actions that it was measured with; not the task's.
      checks: in the order of `certify`.
    """

    digest: str
    seed: int
    checks: tuple[Check, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst of the checks: "passed", "warning" or "refused"."""
        outcomes = {check.outcome for check in self.checks}
        return next((worst for worst in _WORST_FIRST if worst in outcomes), "passed")

    @property
    def passed(self) -> bool:
        """Whether no check refuses the task; warnings pass."""
        return self.outcome != "refused"

    def of(self, outcome: Outcome) -> tuple[Check, ...]:
        """The checks with this outcome."""
        return tuple(check for check in self.checks if check.outcome == outcome)

    def table(self, title: str, *, meanings: bool = False) -> Table:
        """The checks as a table: outcome, name, value and range."""
        from rich.markup import escape

        from sme_registry.io.tables import Table

        columns = {"": "name", "check": "name", "value": "number", "passes in": "name"}
        table = Table(title, columns | ({"meaning": "text"} if meanings else {}))
        for check in self.checks:
            bounds = filter(None, (short(check.low, "≥ "), short(check.high, "≤ ")))
            cells = MARKS[check.outcome], f"[bold]{check.name}[/]", short(check.value)
            table.add_row(*cells, ", ".join(bounds), *([escape(check.meaning)] if meanings else []))
        return table

    def _repr_html_(self) -> str:
        """A card for notebooks: the outcome, and every check with its meaning."""
        from sme_registry.io.markup import card, table_html

        return card(table_html(self.table(f"{self.digest}\n{self.outcome}", meanings=True)))

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON data."""
        return {
            "digest": self.digest,
            "seed": self.seed,
            "outcome": self.outcome,
            "passed": self.passed,
            "checks": [asdict(check) for check in self.checks],
        }


def short(value: float | None, sign: str = "") -> str:
    """A number of three digits after a sign, `≤ 0.8`; empty where there is none."""
    return "" if value is None else f"{sign}{value:.3g}"


def judged(
    name: str,
    value: float,
    meaning: str,
    *,
    passes: tuple[float, float],
    warns: tuple[float, float] | None = None,
) -> Check:
    """A number that passes inside one range, warns inside a wider one, and else refuses."""
    low, high = (bound if math.isfinite(bound) else None for bound in passes)
    outcome: Outcome = "refused"
    if passes[0] <= value <= passes[1]:
        outcome = "passed"
    elif warns is not None and warns[0] <= value <= warns[1]:
        outcome = "warning"
    return Check(name, value, low, high, outcome, meaning)


def reported(name: str, value: float | None, meaning: str) -> Check:
    """A number without a range."""
    return Check(name, value, None, None, "reported", meaning)


def numbers(task: Task, seed: int, name: str, *shape: int) -> Array:
    """Uniform numbers for measuring, independent of every stream that tasks are drawn from."""
    label = f"certify/{task.spec.digest}/{name}"
    return uniform(seed, label, math.prod(shape)).reshape(shape)
