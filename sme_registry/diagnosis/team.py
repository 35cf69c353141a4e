"""`diagnose_team`: the policies of a team to a `TeamDiagnosis`.

Each agent is measured as a single agent: the task of its own channels has the same states, its π*
and its step reward, and its policy sees what it observes. Only the episodes are the team's, since
all agents drive one transition.

`n` states, `S` state_dim, `A` action_dim, `m` agents.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sme_registry.diagnosis import measure, rollouts, verdicts
from sme_registry.diagnosis.measurements import POLICY, Measurements, Score
from sme_registry.diagnosis.questions import answer_all
from sme_registry.diagnosis.subject import TeamSubject
from sme_registry.diagnosis.team_document import AgentDiagnosis, Credit, TeamDiagnosis
from sme_registry.diagnosis.team_questions import TEAM_QUESTIONS, TEAM_THRESHOLDS, TeamCase
from sme_registry.diagnosis.where import WHERE
from sme_registry.diagnosis.why import WHY
from sme_registry.envs.types import Observation
from sme_registry.evaluation import Policy, TeamPolicy, regions
from sme_registry.io import versions
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.task import Task, materialize
from sme_registry.task.draw import Array

__all__ = ["diagnose_team"]

_TINY = 1e-12


class _Member(NamedTuple):
    """One agent as if it were alone."""

    task: Task  # of its own action channels
    policy: Policy  # from observations `[B, S + 2]` to its actions


def diagnose_team(
    subject: TeamSubject, states: int, episodes: int, seed: int, report: Callable[[str], None]
) -> TeamDiagnosis:
    """Measure a team and each of its agents, and answer who is to blame for its regret.

    The arguments and errors are those of `diagnose`.
    """
    task, policy = materialize(subject.spec), subject.policy
    report(f"{subject.name}: episodes")
    references = measure.fit_references(task, states, seed)
    runs = rollouts.episodes_of(_joint_action(policy, task), task, references, episodes, seed)
    first = runs[0][POLICY]
    uniform = _team_in(task, *_uniform(task, policy, states, seed))
    visited = _team_in(task, first.s[first.alive], first.a[first.alive])
    agents = []
    for index, member in enumerate(_members(task, policy)):
        report(f"{subject.name}: {task.names[index]}")
        measurements = _measurements(member, runs[index], states, seed)
        questions = _questions(task.spec)
        agents.append(
            AgentDiagnosis(
                name=task.names[index],
                state_channels=tuple(channel + 1 for channel in task.observed[index]),
                action_channels=tuple(i + 1 for i in range(*task.owned[index].indices(10**9))),
                level=verdicts.level(measurements),
                uniform=uniform.credit[index],
                visited=visited.credit[index],
                verdicts=verdicts.judge(measurements, member.task.spec, questions=questions),
                measurements=measurements,
            )
        )
    case = TeamCase(agents, subject.spec, visited.score)
    return TeamDiagnosis(
        name=subject.name,
        spec=subject.spec,
        spec_digest=subject.spec.digest,
        task=subject.spec.name,
        plan=subject.plan,
        checkpoint_step=subject.checkpoint_step,
        uniform=uniform.score,
        visited=visited.score,
        verdicts=answer_all(TEAM_QUESTIONS, case, TEAM_THRESHOLDS),
        agents=tuple(agents),
        left_out=tuple(name for name in WHY if name not in _questions(task.spec)),
        thresholds=TEAM_THRESHOLDS,
        versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
    )


def _measurements(
    member: _Member, runs: dict[str, rollouts.Trajectories], states: int, seed: int
) -> Measurements:
    fitted = measure.fit_references(member.task, states, seed)
    fields, _ = measure.fixed_states(member.policy, member.task, fitted, states, seed)
    return Measurements(**fields, on_policy=rollouts.on_policy(member.task, runs))


def _questions(spec: SMESpec) -> tuple[str, ...]:
    """The questions of a single agent's diagnosis that have an answer for an agent of a team."""
    own_reward = spec.team is not None and spec.team.reward == "individual"
    return (*WHERE, "sparsity") if own_reward else tuple(WHERE)


def _members(task: Task, policy: TeamPolicy) -> list[_Member]:
    """Each agent's own task and policy."""
    members = []
    for index, member in enumerate(policy.members):
        owned = task.owned[index]
        fields = {**task.spec.to_dict(), "team": None, "action_dim": member.action_dim}
        own = Task(
            spec=SMESpec.from_dict(fields),
            W=task.W[owned],
            b=task.b,
            policies=(task.policies[index],),
            observed=(task.observed[index],),
        )
        act = _own_action(policy, index)
        members.append(_Member(own, Policy(member.agent, "unit", act, member.action_dim)))
    return members


def _own_action(policy: TeamPolicy, index: int) -> Callable[[Observation], Array]:
    member = policy.members[index]
    return lambda observations: member.policy(member.observe(observations))[:, : member.action_dim]


def _joint_action(policy: TeamPolicy, task: Task) -> Callable[[Observation], Array]:
    """Joint actions `[n, A]` from joint observations `[n, S + 1 + m]`, each with its own r_cum."""
    S = task.spec.state_dim
    started = replace(
        policy,
        members=tuple(member._replace(policy=member.policy.start()) for member in policy.members),
    )
    acts = [_own_action(started, index) for index in range(len(policy.members))]

    def act(joint: Observation) -> Array:
        columns = [*range(S + 1)]
        return np.concatenate(
            [own(joint[:, [*columns, S + 1 + index]]) for index, own in enumerate(acts)], axis=1
        )

    return act


def _uniform(task: Task, policy: TeamPolicy, states: int, seed: int) -> tuple[Array, Array]:
    """The uniform states `[N, S]` in which every agent is measured, and the joint actions."""
    count = measure.affordable(task, states)
    protocol = EvaluationProtocol(states_per_region=count, seed=seed)
    (drawn,) = regions.states(protocol, 0, task.spec, rows=count)
    observation = drawn.observation(drawn.s, task.spec.horizon)
    return drawn.s.astype(np.float64), np.clip(policy(observation), 0.0, 1.0)


class _Team(NamedTuple):
    """The team in some states."""

    score: Score
    credit: list[Credit]  # of each agent


def _team_in(task: Task, s: Array, a: Array) -> _Team:
    """The team in states `[N, S]` with joint actions `[N, A]`."""
    optimal = task.optimal_action(s)
    mae = float(np.abs(a - optimal).mean())
    half = max(float(np.abs(0.5 - optimal).mean()), _TINY)
    regret = float(task.regret(s, a).mean())
    shares = task.regret_shares(s, a).mean(axis=0)
    gains = task.difference_rewards(s, a).mean(axis=0)
    return _Team(
        Score(regret=regret, mae=mae, normalised_regret=mae / half),
        [
            Credit(regret_share=float(share), difference_reward=float(gain))
            for share, gain in zip(shares, gains, strict=True)
        ],
    )
