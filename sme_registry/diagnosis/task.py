"""Agents on a task: one, also beside another run, or a team, and who of it is to blame.

    regret share of agent i        regret · d_i / Σ_j d_j,  d_i = ‖a_i − a*_i‖₁; they add up to it
    difference reward of agent i   the team's gain in step reward if agent i alone acted optimally

The team's regret is that of the mean similarity over all action channels, in either reward mode.
Each agent is measured as a single agent on the task of its own channels; only the episodes are the
team's, since all agents drive one transition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from pydantic import JsonValue

from sme_registry.diagnosis import behaviour, measure
from sme_registry.diagnosis.behaviour import CapacityProbe
from sme_registry.diagnosis.critics import critic, has_critic
from sme_registry.diagnosis.document import (
    Diagnosis,
    Level,
    Measurements,
    Part,
    TaskDiagnosis,
    cell,
)
from sme_registry.diagnosis.measure import POLICY, Score
from sme_registry.diagnosis.questions import (
    THRESHOLDS,
    TINY,
    Comparison,
    Decision,
    Difference,
    Questions,
    Verdict,
    add_to,
    words,
)
from sme_registry.diagnosis.subject import Subject, perceptron_of
from sme_registry.diagnosis.where import WHERE
from sme_registry.diagnosis.why import WHY
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.evaluation import Policy, evaluate
from sme_registry.evaluation.policies import TeamPolicy
from sme_registry.io import choice
from sme_registry.io.markup import percent
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Digest, Integer, Real, StrictModel, TupleOf
from sme_registry.task import Task, materialize
from sme_registry.task.draw import Array
from sme_registry.task.task import Observation

TASK_QUESTIONS = {**WHERE, **WHY}


def diagnose_task(
    subject: Subject,
    states: int,
    episodes: int,
    seed: int,
    report: Callable[[str], None],
    against: Subject | None = None,
    *,
    probe_capacity: bool = False,
) -> TaskDiagnosis:
    """The arguments and errors are those of `diagnose`."""
    measured = _measurements(subject, states, episodes, seed, report)
    if probe_capacity:
        report(f"{subject.name}: capacity, by fitting a network to the optimal actions")
        measured = measured.model_copy(update={"capacity": _probe(subject, seed)})
    diagnosis = diagnosed(subject, measured)
    if against is None:
        return diagnosis
    other = diagnosed(against, _measurements(against, states, episodes, seed, report))
    comparison = _compare(diagnosis, other)
    return diagnosis.model_copy(update={"comparison": comparison}).judged(TASK_QUESTIONS)


def diagnosed(
    subject: Subject, measured: Measurements, questions: Questions = TASK_QUESTIONS
) -> TaskDiagnosis:
    """The diagnosis that follows from measurements."""
    diagnosis = TaskDiagnosis.about(subject, level=measured.level, measurements=measured)
    return diagnosis.judged(questions)


def _measurements(
    subject: Subject, states: int, episodes: int, seed: int, report: Callable[[str], None]
) -> Measurements:
    task, policy = materialize(subject.spec), subject.policy
    assert isinstance(policy, Policy)  # of a single agent
    references = measure.fit_references(task, states, seed)
    report(f"{subject.name}: uniform states and shells")
    fields, sample = measure.fixed_states(policy, task, references, states, seed)
    report(f"{subject.name}: episodes")
    (runs,) = behaviour.episodes_of(policy.start(), task, references, episodes, seed)
    on_policy = fields["on_policy"] = behaviour.on_policy(task, runs)
    if subject.log is not None:
        constant = min(on_policy.scores[name].regret for name in behaviour.CONSTANTS)
        fields["training"] = behaviour.training(subject.log, constant)
    explored = behaviour.exploration_sd(subject.model, policy, sample.observation, seed)
    fields["exploration_sd"] = explored
    if has_critic(subject.model, task):
        report(f"{subject.name}: the critic against exact values")
        fields["critic"] = critic(subject.model, task, states=min(states, 500), seed=seed)
    if not subject.spec.is_plain:
        report(f"{subject.name}: limits and distractors")
        fields |= _limits_and_distractors(policy, task, sample, runs[POLICY], seed)
    return Measurements(**fields)


def _limits_and_distractors(
    policy: Policy, task: Task, sample: measure.Sample, run: behaviour.Trajectories, seed: int
) -> dict[str, Any]:
    """The fields of `Measurements` that tasks with `safety` or `observation` have."""
    protocol = EvaluationProtocol(states_per_region=len(sample.s), seed=seed)
    evaluated = evaluate(policy, task.spec, protocol)
    fields: dict[str, Any] = {"observation": evaluated.observation}
    if evaluated.safety is not None:
        visited = run.s[run.alive], run.a[run.alive]
        fields["limits"] = measure.limits(task, sample, visited, evaluated.safety)
    if task.spec.distractors:
        fields["distraction"] = measure.distraction(policy, task, sample, seed)
    return fields


def _probe(subject: Subject, seed: int) -> CapacityProbe:
    assert isinstance(subject.policy, Policy)  # of a single agent
    network = perceptron_of(subject.policy)
    if network is None:
        raise OptionError(
            f"probe_capacity: fits a network of the same layers, and those of {subject.name!r} are "
            "unknown. Leave it out."
        )
    steps = subject.checkpoint_step or subject.plan.get("steps")
    count = steps if isinstance(steps, int) and steps else behaviour.DEFAULT_STATES
    return behaviour.probe_capacity(network, materialize(subject.spec), count, seed)


def _compare(run: TaskDiagnosis, other: TaskDiagnosis) -> Comparison:
    values, other_values = (_quantities(one.measurements) for one in (run, other))
    answers = {verdict.question: verdict.answer for verdict in other.verdicts}
    return Comparison(
        name=other.name,
        spec_fields=_differing(run.spec.every_field(), other.spec.every_field()),
        plan_fields=_differing(run.plan, other.plan),
        differences=tuple(
            Difference(quantity=name, value=value, other=other_values[name])
            for name, value in values.items()
        ),
        answers={
            verdict.question: (verdict.answer, answers[verdict.question])
            for verdict in run.verdicts
            if answers.get(verdict.question, verdict.answer) != verdict.answer
        },
    )


def _differing(
    fields: dict[str, JsonValue], others: dict[str, JsonValue]
) -> dict[str, tuple[JsonValue, ...]]:
    return {
        field: (fields.get(field), others.get(field))
        for field in {**others, **fields}
        if fields.get(field) != others.get(field)
    }


def _quantities(measured: Measurements) -> dict[str, float]:
    """The quantities that are compared; normalised regret, which verdicts use, is first."""
    scores = {
        "": measured.policy,
        "linear_": measured.linear,
        "on_policy_": measured.visited,
        "outermost_shell_": measured.shells[-1].scores[POLICY],
    }
    regrets = {
        f"{prefix}{quantity}": getattr(score, quantity)
        for prefix, score in scores.items()
        for quantity in ("normalised_regret", "regret")
    }
    rewarded = {
        "rewarded_share": measured.on_policy.signal.rewarded,
        "random_rewarded_share": measured.on_policy.random_signal.rewarded,
    }
    return regrets | rewarded


class Credit(StrictModel):
    """An agent's part in the team's regret; means over states."""

    regret_share: Real  # in units of regret: over the agents, they add up to the team's regret
    difference_reward: Real  # in [0, 1]; these do not add up, because the step reward is clipped


class AgentDiagnosis(StrictModel):
    """One agent of a team, measured over its own action channels."""

    name: str  # of the agent
    state_channels: TupleOf[Integer]  # that it observes, from 1
    action_channels: TupleOf[Integer]  # that it owns, from 1
    level: Level  # its normalised regret, ranked among the constant ½, the linear policy and 0
    uniform: Credit  # in uniform states
    visited: Credit  # in the states that the team visits
    verdicts: TupleOf[Verdict]  # on its own policy
    measurements: Measurements  # what the verdicts rest on

    @property
    def visited_regret(self) -> float:
        """Normalised regret over its own channels in the states that the team visits."""
        return self.measurements.visited.normalised_regret

    @property
    def uniform_regret(self) -> float:
        """The same in uniform states."""
        return self.measurements.policy.normalised_regret

    @property
    def linear_regret(self) -> float:
        """The same of the linear policy."""
        return self.measurements.linear.normalised_regret


class TeamDiagnosis(Diagnosis):
    """The diagnosis of a team's policies; its verdicts say who causes the regret."""

    spec: SMESpec
    spec_digest: Digest
    uniform: Score  # of the team, in uniform states
    visited: Score  # of the team, in the states of its own episodes
    agents: TupleOf[AgentDiagnosis]  # in the order of the channels that they own
    left_out: TupleOf[str]  # questions of a single agent's diagnosis without an answer for a team

    def agent(self, name: str) -> AgentDiagnosis:
        by_name = {agent.name: agent for agent in self.agents}
        return by_name[choice("agent", name, by_name, error=UnknownNameError)]

    @property
    def learnt(self) -> float:
        """Normalised regret in the states that the team visits."""
        return self.visited.normalised_regret

    @property
    def best(self) -> AgentDiagnosis:
        """The agent with the lowest normalised regret in the states that the team visits."""
        return min(self.agents, key=lambda agent: agent.visited_regret)

    @property
    def worst(self) -> AgentDiagnosis:
        """The agent with the highest."""
        return max(self.agents, key=lambda agent: agent.visited_regret)

    @property
    def gap(self) -> float:
        """How much better the best agent is than the worst."""
        return self.worst.visited_regret - self.best.visited_regret

    def shares(self, agent: AgentDiagnosis) -> dict[str, float]:
        """Shares of an agent in the team's regret, and in its action channels."""
        return {
            "regret_share": agent.visited.regret_share / max(self.visited.regret, TINY),
            "channel_share": len(agent.action_channels) / self.spec.action_dim,
        }

    def parts(self) -> Iterator[Part]:
        """A table of the agents; all answers on request."""
        rows = [
            (
                agent.name,
                *map(percent, self.shares(agent).values()),
                cell(agent.uniform_regret),
                cell(agent.visited_regret),
                cell(agent.linear_regret),
                cell(agent.visited.difference_reward),
            )
            for agent in self.agents
        ]
        notes = (_LEGEND, words("left_out", self.left_out))
        yield Part("Agents", _COLUMNS, rows, notes)
        yield from (part._replace(detail=True) for part in super().parts())

    def tables(self) -> Iterator[Part]:
        """Where the error of each agent is."""
        for agent in self.agents:
            where = self.findings("", agent.verdicts)
            yield where._replace(heading=f"Where the error of {agent.name} is")
            yield from self.answers(agent.verdicts, f": {agent.name}")


_COLUMNS = (
    *("agent", "share of regret", "of channels"),
    *("N, uniform", "N, own episodes", "N, linear", "gain if optimal"),
)
_LEGEND = (
    "N: normalised regret over the agent's channels · gain if optimal: of the team's step reward, "
    "if this agent alone acted optimally · the shares add up to the team's regret in its episodes"
)


TEAM_QUESTIONS: Questions = {}
"""Questions about a team, in order."""
_question = partial(add_to, TEAM_QUESTIONS, "who")


@_question(yes="some_agents_to_blame", no="spread_over_agents solved", thresholds="blame_ratio")
def _blame(run: TeamDiagnosis) -> Decision:
    agents: list[dict[str, Any]] = [
        {"agent": agent.name, **run.shares(agent), "normalised_regret": agent.visited_regret}
        for agent in run.agents
    ]
    blamed = [
        a for a in agents if a["regret_share"] >= THRESHOLDS["blame_ratio"] * a["channel_share"]
    ]
    return Decision(
        "solved" if run.solved else bool(blamed),
        {"agents": agents, "blamed": blamed, "regret": run.visited.regret},
        sum(a["regret_share"] for a in blamed),
    )


@_question(yes="agents_differ", no="agents_alike", thresholds="difference")
def _unequal_agents(run: TeamDiagnosis) -> Decision:
    best, worst = run.best, run.worst
    lowest, highest = best.visited_regret, worst.visited_regret
    return Decision(
        run.gap >= THRESHOLDS["difference"],
        {"best": best.name, "worst": worst.name, "lowest": lowest, "highest": highest},
    )


@_question(
    yes="optimum_harder",
    no="optimum_not_harder agents_alike",
    thresholds="difference",
    is_cause=True,
)
def _harder_optimum(run: TeamDiagnosis) -> Decision:
    """Whether the worst agent's π* is harder: further from what a linear policy attains."""
    worst = run.worst
    regrets = [agent.linear_regret for agent in run.agents if agent is not worst]
    other = sum(regrets) / len(regrets) if regrets else 1.0
    harder = worst.linear_regret - other >= THRESHOLDS["difference"]
    return Decision(
        "agents_alike" if run.gap < THRESHOLDS["difference"] else harder,
        {
            "agent": worst.name,
            "normalised_regret": worst.uniform_regret,
            "linear_normalised_regret": worst.linear_regret,
            "others_linear_normalised_regret": other,
            "nonlinear_variance": worst.measurements.response.nonlinear_variance,
        },
    )


@_question(
    yes="worse_where_visited",
    no="not_worse_where_visited solved",
    thresholds="on_policy_ratio difference",
)
def _visited_states(run: TeamDiagnosis) -> Decision:
    """Whether the worst agent fails in the states that the team visits rather than everywhere."""
    worst = run.worst
    visited, uniform = worst.visited_regret, worst.uniform_regret
    apart = visited - uniform >= THRESHOLDS["difference"]
    worse = apart and visited >= THRESHOLDS["on_policy_ratio"] * uniform
    evidence = {"agent": worst.name, "visited": visited, "uniform": uniform}
    return Decision("solved" if run.solved else worse, evidence)


@_question(yes="one_agent_suffices", no="several_must_improve solved", thresholds="one_suffices")
def _one_correction(run: TeamDiagnosis) -> Decision:
    """Whether correcting one agent would remove most of the team's regret."""
    best = max(run.agents, key=lambda agent: agent.visited.difference_reward)
    gain, regret = best.visited.difference_reward, run.visited.regret
    suffices = gain >= THRESHOLDS["one_suffices"] * regret
    evidence = {"agent": best.name, "difference_reward": gain, "regret": regret}
    return Decision("solved" if run.solved else suffices, evidence, gain / max(regret, TINY))


@_question(
    yes="one_agent_ends_episodes",
    no="no_agent_stands_out no_survival_threshold",
    thresholds="termination_rate",
)
def _ended_episodes(run: TeamDiagnosis) -> Decision:
    """Whether the threshold D ends episodes for all because of one agent."""
    if run.spec.D == 0:
        return Decision("no_survival_threshold", {"D": run.spec.D})
    rates = {agent.name: agent.measurements.on_policy.termination_rate for agent in run.agents}
    shares = dict(sorted(rates.items(), key=lambda rate: -rate[1]))
    first, *rest = shares.values()
    alone = not rest or rest[0] <= first / 2
    return Decision(
        first >= THRESHOLDS["termination_rate"] and alone,
        {"D": run.spec.D, "agent": next(iter(shares)), "shares": shares},
    )


def diagnose_team(
    subject: Subject, states: int, episodes: int, seed: int, report: Callable[[str], None]
) -> TeamDiagnosis:
    """The arguments and errors are those of `diagnose`."""
    task, policy = materialize(subject.spec), subject.policy
    assert isinstance(policy, TeamPolicy)  # of a team's spec
    report(f"{subject.name}: episodes")
    references = measure.fit_references(task, states, seed)
    runs = behaviour.episodes_of(policy.start(), task, references, episodes, seed)
    first = runs[0][POLICY]
    drawn = measure.states_of(task.spec, measure.affordable(task, states), seed)
    actions = np.clip(policy(drawn.observation(drawn.s, task.spec.horizon)), 0.0, 1.0)
    uniform, uniform_credit = _team_in(task, drawn.s.astype(np.float64), actions)
    visited, visited_credit = _team_in(task, first.s[first.alive], first.a[first.alive])
    questions = _questions(task.spec)
    agents = []
    for index, name in enumerate(task.names):
        report(f"{subject.name}: {name}")
        part, alone = _alone(task, policy, index)
        fitted = measure.fit_references(part, states, seed)
        fields, _ = measure.fixed_states(alone, part, fitted, states, seed)
        measured = Measurements(**fields, on_policy=behaviour.on_policy(part, runs[index]))
        agent = diagnosed(
            Subject(name, part.spec, alone, updates=subject.updates), measured, questions
        )
        agents.append(
            AgentDiagnosis(
                name=name,
                state_channels=tuple(channel + 1 for channel in task.observed[index]),
                action_channels=tuple(i + 1 for i in range(*task.owned[index].indices(10**9))),
                level=agent.level,
                uniform=uniform_credit[index],
                visited=visited_credit[index],
                verdicts=agent.verdicts,
                measurements=measured,
            )
        )
    diagnosis = TeamDiagnosis.about(
        subject,
        uniform=uniform,
        visited=visited,
        agents=tuple(agents),
        left_out=tuple(name for name in WHY if name not in questions and not WHY[name].needs),
    )
    return diagnosis.judged(TEAM_QUESTIONS)


def _questions(spec: SMESpec) -> Questions:
    """The questions about a task that have an answer for an agent of a team.

    Those about training rest on the log, the exploration or the network of a single learner with a
    reward of its own. Sparsity needs a reward of its own as well.
    """
    has_own_reward = spec.team is not None and spec.team.reward == "individual"
    return WHERE | ({"sparsity": WHY["sparsity"]} if has_own_reward else {})


def _alone(task: Task, policy: TeamPolicy, index: int) -> tuple[Task, Policy]:
    """The task of an agent's own action channels, and its policy of observations `[B, S + 2]`."""
    member, owned = policy.members[index], task.owned[index]
    fields = {**task.spec.to_dict(), "team": None, "action_dim": member.action_dim}
    part = Task(
        spec=SMESpec.from_dict(fields),
        W=task.W[owned],
        b=task.b,
        policies=(task.policies[index],),
        observed=(task.observed[index],),
    )

    def act(observations: Observation) -> Array:
        return member.policy(member.observe(observations))[:, : member.action_dim]

    return part, Policy(member.agent, "unit", act, member.action_dim)


def _team_in(task: Task, s: Array, a: Array) -> tuple[Score, list[Credit]]:
    """The team, and each agent's part, in states `[N, S]` with joint actions `[N, A]`."""
    optimal = task.optimal_action(s)
    mae, constant_mae = (float(np.abs(x - optimal).mean()) for x in (a, 0.5))
    shares = task.regret_shares(s, a).mean(axis=0)
    gains = task.difference_rewards(s, a).mean(axis=0)
    credit = [
        Credit(regret_share=float(share), difference_reward=float(gain))
        for share, gain in zip(shares, gains, strict=True)
    ]
    return Score.of(float(task.regret(s, a).mean()), mae, constant_mae), credit
