"""`training`: the environment and the learner of a cell, for a single agent and for teams.

    uses               a single agent          a team
    PPO, TD3, …        one environment         one model that all agents share
    independent:PPO                            one model for each agent

A team's model gets each agent's transitions, from as many environments and with the same rollout
as in `sme train`. A step is one step of the whole team.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sme_registry.evaluation import Policy, TeamPolicy
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.spec.study import Cell
from sme_registry.studies.engine.algorithms import find_algorithm, independent_name
from sme_registry.training.algorithms import default_num_envs, is_sb3
from sme_registry.training.hyperparameters import for_lanes
from sme_registry.training.learners import new_learner
from sme_registry.training.numpy_policy import numpy_policy, numpy_team_policy


@dataclass(frozen=True)
class Training:
    """What a cell trains."""

    env: Any
    learner: Any
    learn: Callable[[], Any]
    policy: Callable[[], Policy | TeamPolicy]
    save: Callable[[Path], Any]


def training(cell: Cell) -> Training:
    """The environment and the learner of a cell."""
    if cell.spec.team is None:
        return _single(cell)
    return _shared(cell) if independent_name(cell.uses) is None else _independent(cell)


def _single(cell: Cell) -> Training:
    from sme_registry.training.monitored_env import MonitoredVecEnv

    env = MonitoredVecEnv(cell.document, action_range=cell.action_range)
    learner = new_learner(
        cell.uses, env, seed=cell.seed, steps=cell.steps, hyperparameters=cell.hyperparameters
    )
    return Training(
        env,
        learner,
        lambda: learner.learn(cell.steps),
        lambda: numpy_policy(learner, cell.document, action_range=cell.action_range),
        lambda path: _save(learner, path),
    )


def _shared(cell: Cell) -> Training:
    env, settings = _team_environment(cell, cell.uses)
    transitions = cell.steps * len(env.agents)
    learner = new_learner(
        cell.uses, env, seed=cell.seed, steps=transitions, hyperparameters=settings
    )
    return Training(
        env,
        learner,
        lambda: learner.learn(transitions),
        lambda: numpy_team_policy(learner, cell.spec, action_range=cell.action_range),
        lambda path: _save(learner, path),
    )


def _independent(cell: Cell) -> Training:
    from sme_registry.training.independent import IndependentLearners
    from sme_registry.training.record import RunRecord

    uses = independent_name(cell.uses) or cell.uses
    env, settings = _team_environment(cell, uses, agents=1)
    record = RunRecord(
        status="running",
        spec=cell.spec,
        spec_digest=cell.spec.digest,
        algorithm=uses,
        hyperparameters=settings,
        seed=cell.seed,
        action_range=cell.action_range,
        num_envs=env.num_teams,
        agents=len(env.agents),
        independent=True,
        steps=cell.steps,
        checkpoint_every=max(1, cell.steps),
        protocol=cell.protocol,
        protocol_digest=cell.protocol.digest,
        versions={},
    )
    learners = IndependentLearners(record)
    learners.env = env
    return Training(
        env,
        learners,
        lambda: learners.learn(cell.steps, lambda *step: None, lambda: None),
        lambda: numpy_team_policy(learners.models, cell.spec, action_range=cell.action_range),
        learners.save_checkpoint,
    )


def _team_environment(
    cell: Cell, uses: str, agents: int | None = None
) -> tuple[Any, dict[str, Any]]:
    """The environments of a team, and hyperparameters for them."""
    from sme_registry.training.monitored_env import MonitoredTeamVecEnv

    algorithm = find_algorithm(uses)
    num_envs = default_num_envs(cell.spec, algorithm)
    env = MonitoredTeamVecEnv(cell.spec, num_envs, action_range=cell.action_range)
    lanes = num_envs * (len(env.agents) if agents is None else agents)
    chosen = cell.hyperparameters
    return env, {**for_lanes(algorithm, lanes, chosen), **chosen}


def _save(learner: Any, path: Path) -> None:
    save = getattr(learner, "save", None)
    if is_sb3(learner):
        write_atomically(path, saved_sb3(learner))
    elif save is not None:
        archive = io.BytesIO()
        save(archive)
        write_atomically(path, archive.getvalue())
