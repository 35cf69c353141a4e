"""`Record`: what the runs of a learner did, and from that the results of their cells.

The runs are those of one program; one of Stable-Baselines3 is a program with one run. Evaluations,
sums of regret and cost, and lives have an axis of runs, and are saved with a program's state.

The k-th evaluation follows round(steps · k / evaluations) steps, the last one the end of training:
on-policy algorithms finish their last rollout, so it can be later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, StreamReport, evaluate_stream
from sme_registry.evaluation.dynamic_regret import DynamicRegret, RegretBlocks, reference_regret
from sme_registry.evaluation.policies import stream_policy
from sme_registry.io import Arrays
from sme_registry.spec import Cell
from sme_registry.studies.engine.result import CellResult, LearningCurve, Timing, report_field
from sme_registry.training.record import versions_for

TRAINING, EVALUATION = 0, 1  # what time is for


class Record:
    """Evaluations, regret, lives and times of the runs of some cells, all on tasks of one form.

    Attributes:
      due: steps of the evaluations.
      evaluated: how many of them are done.
      arrays: by name, with the runs as last axis; of a team's only run, `regret` is by agent.
        `failed_at` is the step at which a run was seen to have failed, or −1.
      blocks: the regret of lives; None for tasks.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        runs: int,
        clock: Callable[[], float],
        agents: Sequence[str] = (),
    ) -> None:
        cell, n = cells[0], cells[0].evaluations
        self._cells, self._agents = cells, agents
        self.due = [round(cell.steps * k / n) for k in range(1, n + 1)]
        self.evaluated = 0
        self.arrays: Arrays = {
            "rows": np.zeros((n, 5, runs)),  # the fields of a `LearningCurve`
            "regret": np.zeros(len(agents) or runs),  # over all steps of training
            "failed_at": np.full(runs, -1),
            "seconds": np.zeros(2),
        }
        if agents:
            self.arrays["agents_rows"] = np.zeros((n, len(agents)))
        if cell.spec.safety is not None:
            self.arrays["cost"] = np.zeros(runs)  # as the regret
        self.blocks = None if cell.stream is None else RegretBlocks(cell.stream, runs)
        if self.blocks is not None:
            self.arrays |= {"block_steps": self.blocks.steps, "block_regret": self.blocks.regret}
        self._clock, self._mark = clock, clock()

    def restore(self, arrays: Arrays) -> None:
        """Go on from the arrays of a record of the same form."""
        self.arrays = arrays
        if self.blocks is not None:
            self.blocks.steps = arrays["block_steps"]
            self.blocks.regret = arrays["block_regret"]

    def add(self, regret: Any, cost: Any = None) -> None:
        """Add sums over steps of training, by run; of a team by agent."""
        self.arrays["regret"] += regret
        if cost is not None:
            self.arrays["cost"] += cost

    def evaluation(self, k: int, rows: Any, agents_regret: Any = None) -> None:
        """Store the k-th evaluation: the fields of a `LearningCurve`, by run."""
        self.arrays["rows"][k] = rows
        if agents_regret is not None:
            self.arrays["agents_rows"][k] = agents_regret
        self.evaluated = k + 1

    def start(self) -> None:
        """Count time from here on."""
        self._mark = self._clock()

    def spend(self, purpose: int) -> None:
        """Count the time since the last call."""
        now = self._clock()
        self.arrays["seconds"][purpose] += now - self._mark
        self._mark = now

    def result(
        self,
        run: int,
        steps: int,
        report: EvaluationReport | StreamReport,
        timing: Timing,
        **fields: Any,
    ) -> CellResult:
        """The result of a run after so many steps of training; 0 where nothing was learned."""
        cell = self._cells[run]
        return CellResult(
            key=cell.digest,
            cell=cell,
            curve=self._curve(run),
            **report_field(report),
            **(self._online(run, steps) if steps else {}),
            timing=timing,
            versions=versions_for(cell.uses),
            **fields,
        )

    def _curve(self, run: int) -> LearningCurve:
        if not self.due:
            return LearningCurve()
        steps, *others = self.arrays["rows"][:, :, run].T.tolist()
        names = [name for name in LearningCurve.model_fields if name != "steps"]
        columns: dict[str, Any] = dict(zip(names, others, strict=False))
        if self._agents:
            by_agent = self.arrays["agents_rows"].T.tolist()
            columns["agents_regret"] = dict(zip(self._agents, by_agent, strict=True))
        return LearningCurve(steps=tuple(int(step) for step in steps), **columns)

    def _online(self, run: int, steps: int) -> dict[str, Any]:
        """Means over all steps of training: the regret, the cost, and the regret of each agent."""
        regret, cost = self.arrays["regret"], self.arrays.get("cost")
        means = (regret / steps).tolist()
        return {
            "online_regret": float(regret.mean() if self._agents else regret[run]) / steps,
            "online_cost": None if cost is None else float(cost[run]) / steps,
            "agents_online_regret": dict(zip(self._agents, means, strict=False)),
        }

    def timing(
        self,
        steps: int,
        at_the_end: float,
        *,
        cells: int = 1,
        environment: float = 0.0,
        total: float | None = None,
    ) -> Timing:
        """A cell's share of the time, and that of its evaluation at the end.

        `environment` is the part of training that was spent in steps of the environment; `total`
        also has what precedes them, if it was measured.
        """
        training, evaluation = (self.arrays["seconds"] / cells).tolist()
        return Timing(
            total=training + evaluation + at_the_end if total is None else total,
            training=training - environment,
            environment=environment,
            evaluation=evaluation + at_the_end,
            steps_per_second=steps / training if steps and training else 0.0,
        )


def check_forms(arrays: Arrays, own: Arrays) -> None:
    """Raise OptionError if arrays that were saved have other names, types or shapes than those."""
    one, other = ({n: (a.dtype, a.shape) for n, a in each.items()} for each in (arrays, own))
    if one != other:
        raise OptionError(
            "its records of the lanes are missing or others, or of lives without models."
        )


def life_report(
    cell: Cell, policies: Sequence[Any], initial: Any, regret: DynamicRegret
) -> StreamReport:
    """The report of a life with the reference agents, still without fresh agents.

    `policies` are those at the ends of the visits, `initial` the one before training.
    """
    assert cell.stream is not None
    stream, range_ = cell.stream, cell.action_range
    report = evaluate_stream(
        policies, stream, cell.protocol, initial=initial, action_range=range_, name=cell.uses
    )
    frozen = stream_policy(policies[0], stream, "visit 0", range_)
    references = reference_regret(stream, frozen=frozen, training=regret)
    return report.with_dynamic_regret(regret).with_reference_regret(references)
