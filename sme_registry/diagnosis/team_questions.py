"""Who is to blame: questions about a team, which the measurements of its agents answer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from sme_registry.diagnosis.measurements import POLICY, Score
from sme_registry.diagnosis.questions import THRESHOLDS, Outcome, Question, add_to
from sme_registry.diagnosis.team_document import AgentDiagnosis
from sme_registry.spec import SMESpec

__all__ = ["TEAM_QUESTIONS", "TEAM_THRESHOLDS", "TeamCase"]

TEAM_THRESHOLDS = {
    **{name: THRESHOLDS[name] for name in ("solved", "difference", "on_policy_ratio")},
    "blame_ratio": 1.5,  # of an agent's share of the regret to its share of the channels
    "one_suffices": 0.5,  # share of the team's regret that correcting one agent removes, at least
    "termination_rate": 0.5,  # share of episodes that one agent ends, at least
}
_T = TEAM_THRESHOLDS
_TINY = 1e-9
_LINEAR = "linear_least_squares"


class TeamCase(NamedTuple):
    """What the rules read."""

    agents: Sequence[AgentDiagnosis]
    spec: SMESpec
    visited: Score  # of the team

    @property
    def solved(self) -> bool:
        """Whether nothing is left to explain."""
        return self.visited.normalised_regret <= _T["solved"]

    @property
    def worst(self) -> AgentDiagnosis:
        """The agent with the highest normalised regret in the states that the team visits."""
        return max(self.agents, key=visited_regret)


TEAM_QUESTIONS: dict[str, Question[TeamCase]] = {}
"""Questions about a team, in order."""
_question = partial(add_to, TEAM_QUESTIONS, "who")


def visited_regret(agent: AgentDiagnosis) -> float:
    """Normalised regret over the agent's own channels in the states that the team visits."""
    return agent.measurements.on_policy.scores[POLICY].normalised_regret


@_question(some_agents_to_blame="yes", spread_over_agents="no", solved="no")
def _blame(case: TeamCase) -> Outcome:
    total = max(case.visited.regret, _TINY)
    agents: list[dict[str, Any]] = [
        {
            "agent": agent.name,
            "regret_share": agent.visited.regret_share / total,
            "channel_share": len(agent.action_channels) / case.spec.action_dim,
            "normalised_regret": visited_regret(agent),
        }
        for agent in case.agents
    ]
    blamed = [a for a in agents if a["regret_share"] >= _T["blame_ratio"] * a["channel_share"]]
    reason = "some_agents_to_blame" if blamed else "spread_over_agents"
    return Outcome(
        "solved" if case.solved else reason,
        {"agents": agents, "blamed": blamed, "regret": case.visited.regret},
        ("blame_ratio",),
    )


@_question(agents_differ="yes", agents_alike="no")
def _unequal_agents(case: TeamCase) -> Outcome:
    best, worst = min(case.agents, key=visited_regret), case.worst
    low, high = visited_regret(best), visited_regret(worst)
    return Outcome(
        "agents_differ" if high - low >= _T["difference"] else "agents_alike",
        {"best": best.name, "worst": worst.name, "lowest": low, "highest": high},
        ("difference",),
    )


@_question(optimum_harder="yes", optimum_not_harder="no", agents_alike="no")
def _harder_optimum(case: TeamCase) -> Outcome:
    """Whether the worst agent's π* is harder: further from what a linear policy attains."""
    worst = case.worst
    others = [agent for agent in case.agents if agent is not worst]
    regret = {agent.name: _linear_regret(agent) for agent in case.agents}
    other = sum(regret[agent.name] for agent in others) / len(others) if others else 1.0
    alike = visited_regret(worst) - min(map(visited_regret, case.agents)) < _T["difference"]
    harder = regret[worst.name] - other >= _T["difference"]
    reason = "optimum_harder" if harder else "optimum_not_harder"
    return Outcome(
        "agents_alike" if alike else reason,
        {
            "agent": worst.name,
            "normalised_regret": worst.measurements.policy.normalised_regret,
            "linear_normalised_regret": regret[worst.name],
            "others_linear_normalised_regret": other,
            "nonlinear_variance": worst.measurements.response.nonlinear_variance,
        },
        ("difference",),
    )


def _linear_regret(agent: AgentDiagnosis) -> float:
    return agent.measurements.uniform[_LINEAR].normalised_regret


@_question(worse_where_visited="yes", not_worse_where_visited="no", solved="no")
def _visited_states(case: TeamCase) -> Outcome:
    """Whether the worst agent fails in the states that the team visits rather than everywhere."""
    worst = case.worst
    visited, uniform = visited_regret(worst), worst.measurements.policy.normalised_regret
    worse = visited >= _T["on_policy_ratio"] * uniform and visited - uniform >= _T["difference"]
    reason = "worse_where_visited" if worse else "not_worse_where_visited"
    return Outcome(
        "solved" if case.solved else reason,
        {"agent": worst.name, "visited": visited, "uniform": uniform},
        ("on_policy_ratio", "difference"),
    )


@_question(one_agent_suffices="yes", several_must_improve="no", solved="no")
def _one_correction(case: TeamCase) -> Outcome:
    """Whether correcting one agent would remove most of the team's regret."""
    best = max(case.agents, key=lambda agent: agent.visited.difference_reward)
    gain, regret = best.visited.difference_reward, case.visited.regret
    suffices = gain >= _T["one_suffices"] * regret
    reason = "one_agent_suffices" if suffices else "several_must_improve"
    return Outcome(
        "solved" if case.solved else reason,
        {"agent": best.name, "difference_reward": gain, "regret": regret},
        ("one_suffices",),
    )


@_question(no_survival_threshold="no", one_agent_ends_episodes="yes", no_agent_stands_out="no")
def _ended_episodes(case: TeamCase) -> Outcome:
    """Whether the threshold D ends episodes for all because of one agent."""
    if case.spec.D == 0:
        return Outcome("no_survival_threshold", {"D": case.spec.D})
    rates = {agent.name: agent.measurements.on_policy.termination_rate for agent in case.agents}
    shares = dict(sorted(rates.items(), key=lambda rate: -rate[1]))
    first, *rest = shares.values()
    alone = not rest or rest[0] <= first / 2
    ends = first >= _T["termination_rate"] and alone
    return Outcome(
        "one_agent_ends_episodes" if ends else "no_agent_stands_out",
        {"D": case.spec.D, "agent": next(iter(shares)), "shares": shares},
        ("termination_rate",),
    )
