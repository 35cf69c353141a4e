"""A life in a stream, as a cell keeps it: the policies at the ends of its visits, and its regret.

`TasksInForce` are the tasks of any cell, by its steps; `Life` records that of an agent of
Stable-Baselines3, and `life_report` makes the report of one in JAX, too.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import PolicyError
from sme_registry.evaluation import Perceptron, Policy, StreamReport, evaluate_stream
from sme_registry.evaluation.dynamic_regret import DynamicRegret, RegretBlocks, reference_regret
from sme_registry.evaluation.models import torch_policy
from sme_registry.evaluation.policies import stream_policy
from sme_registry.spec import Cell, SMESpec, StreamSpec
from sme_registry.studies.engine.training import Training
from sme_registry.task import Task, materialize, materialize_stream
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.snapshots import Snapshots
from sme_registry.training.visits import VisitEnds

_COUNTED_AT_ONCE = 500  # steps; one by one they would cost a twentieth of PPO's


class TasksInForce:
    """The task of a cell, or those of its stream, by the steps that were taken."""

    def __init__(self, document: SMESpec | StreamSpec) -> None:
        self._stream: StreamSpec | None = None
        if isinstance(document, StreamSpec):
            self._stream, self._tasks = document, materialize_stream(document)
        else:
            self._tasks = (materialize(document),)

    def after(self, steps: int) -> Task:
        """The task on which the last of so many steps was taken, or the first will be."""
        return self._tasks[self._piece(steps)]

    def shown_to(self, policy: Any, steps: int) -> Any:
        """The policy of that task's observations, with the phase if the agent observes it."""
        stream = self._stream
        if stream is None or not stream.observes_phase:
            return policy
        return policy.in_phase(stream.pieces[self._piece(steps)].phase, stream.observed_phases)

    def _piece(self, steps: int) -> int:
        return 0 if self._stream is None else self._stream.piece_at(max(steps - 1, 0))


class Life:
    """Records an agent's life while it trains."""

    def __init__(self, cell: Cell, run: Training, models: Path | None) -> None:
        assert cell.stream is not None
        self._cell, self._run = cell, run
        self._blocks = RegretBlocks(cell.stream)
        self._uncounted: list[tuple[float, int]] = []  # regret and phase of steps
        self._ends = VisitEnds(cell.stream, self._end_visit)
        self._files = None if models is None else Snapshots(models, cell.stream)
        self._initial, self._policies = lasting_policy(cell, run), list[Policy]()
        if self._files is not None:
            run.save(self._files.initial)

    def after_step(self, steps: int) -> None:
        """Count a step, before the learner learns from it."""
        info = self._run.env.info
        self._uncounted.append((info["regret"], info["phase"]))
        if len(self._uncounted) >= _COUNTED_AT_ONCE:
            self._count(steps)
        self._ends.after_step(steps)

    def finish(self, steps: int) -> None:
        """End the life after its training."""
        self._count(steps)
        self._ends.finish(steps)

    def report(self) -> StreamReport:
        """What the agent retains, and its dynamic regret."""
        return life_report(self._cell, self._policies, self._initial, self._blocks.dynamic_regret())

    def _count(self, steps: int) -> None:
        if self._uncounted:
            regret, phase = zip(*self._uncounted, strict=True)
            self._blocks.add(steps, np.array(regret)[:, None], phase)
            self._uncounted.clear()

    def _end_visit(self, visit: int) -> None:
        self._policies.append(lasting_policy(self._cell, self._run))
        if self._files is not None:
            self._run.save(self._files.visits[visit])


def lasting_policy(cell: Cell, run: Training) -> Policy:
    """The present policy of a single agent, which further training does not change."""
    policy = run.policy()
    assert isinstance(policy, Policy)  # streams have no teams
    if isinstance(policy.act, Perceptron):
        return policy  # a copy
    network = torch_policy(run.learner)
    try:
        copied = copy.deepcopy(network or run.learner, {id(run.env): run.env})
    except Exception as error:
        raise PolicyError(
            f"uses={cell.uses!r}: cannot live in a stream, since its learner cannot be copied at "
            f"the end of a visit: {type(error).__name__}: {error}. Give it a __deepcopy__."
        ) from error
    return numpy_policy(copied, cell.document, action_range=cell.action_range)


def life_report(
    cell: Cell, policies: Sequence[Any], initial: Any, regret: DynamicRegret
) -> StreamReport:
    """The report of a cell's life with the reference agents, still without fresh agents."""
    assert cell.stream is not None
    stream, range_ = cell.stream, cell.action_range
    report = evaluate_stream(
        policies, stream, cell.protocol, initial=initial, action_range=range_, name=cell.uses
    )
    frozen = stream_policy(policies[0], stream, "visit 0", range_)
    references = reference_regret(stream, frozen=frozen, training=regret)
    return report.with_dynamic_regret(regret).with_reference_regret(references)
