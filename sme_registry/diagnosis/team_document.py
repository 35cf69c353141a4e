"""`TeamDiagnosis`: who is to blame for a team's regret, and where each agent's own regret is.

In the states s of uniform samples or of the team's own episodes, with joint actions a:

    regret share of agent i        regret · d_i / Σ_j d_j,  d_i = ‖a_i − a*_i‖₁; they add up to it
    difference reward of agent i   the team's gain in step reward if agent i alone acted optimally

The team's regret is that of the mean similarity over all action channels, in either reward mode.
"""

from __future__ import annotations

from pydantic import JsonValue

from sme_registry.diagnosis.document import Level, Verdict, verdict_on, without_html
from sme_registry.diagnosis.measurements import Measurements, Score
from sme_registry.errors import UnknownNameError, did_you_mean
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, SMESpec, StrictModel, TupleOf

__all__ = ["AgentDiagnosis", "Credit", "TeamDiagnosis"]


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


class TeamDiagnosis(StrictModel):
    """The diagnosis of a team's policies.

    Attributes:
      name: of the run or policy.
      spec: the task.
      spec_digest: the task's digest.
      task: its name.
      plan: algorithm, seed, steps and so on; empty without a run.
      checkpoint_step: of an unfinished run, the steps at its checkpoint.
      uniform: of the team, in uniform states.
      visited: of the team, in the states of its own episodes.
      verdicts: on the team: who.
      agents: in the order of the channels that they own.
      left_out: questions of a single agent's diagnosis without an answer for a team.
      thresholds: all that verdicts use.
      versions: of Python and of the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    name: str
    spec: SMESpec
    spec_digest: Digest
    task: str = ""
    plan: dict[str, JsonValue]
    checkpoint_step: Integer | None = None
    uniform: Score
    visited: Score
    verdicts: TupleOf[Verdict]
    agents: TupleOf[AgentDiagnosis]
    left_out: TupleOf[str]
    thresholds: dict[str, Real]
    versions: dict[str, str]

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question about the team, such as "blame"."""
        return verdict_on(question, self.verdicts)

    def agent(self, name: str) -> AgentDiagnosis:
        """One agent, by its name."""
        by_name = {agent.name: agent for agent in self.agents}
        if name not in by_name:
            hint = did_you_mean(name, by_name)
            raise UnknownNameError(f"agent={name!r}: must be one of {', '.join(by_name)}.{hint}")
        return by_name[name]

    def _repr_markdown_(self) -> str:
        """The page, for notebooks."""
        from sme_registry.diagnosis.team_render import markdown

        return without_html(markdown(self, ()))
