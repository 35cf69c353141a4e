"""`SMESpec`: the numbers from which a Synthetic Monitoring Environment is generated."""

from __future__ import annotations

import math
import os
from bisect import bisect_right
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeAlias, get_args

from pydantic import (
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from sme_registry.spec.blocks import (
    MAX_DIM,
    AgentSpec,
    NoiseSpec,
    ObservationSpec,
    SafetySpec,
    Seed,
    ShapingSpec,
    TeamSpec,
)
from sme_registry.spec.document import (
    LATER,
    Document,
    FieldMark,
    Integer,
    NamedDocument,
    Real,
    SchemaVersion,
    short_repr,
)

ActionRange: TypeAlias = Literal["unit", "symmetric"]
"""The range of actions: [0, 1], the paper's, or [−1, 1], which Stable-Baselines3 prefers."""

ACTION_RANGES: tuple[str, ...] = get_args(ActionRange)

FULL_TURN = 2.0 * math.pi


PAYMENT = FieldMark("payment")
"""Of a field that changes what is paid, or for how long, and neither states nor optimum."""


class Setting(Document):
    """One setting of the axes: everything that a task is generated from, except its seed.

    Defaults are the paper's (METHOD, section 1), or ours where it has none.

    Attributes:
      state_dim: S, state channels.
      action_dim: A, action channels.
      k: steps between payouts, each of the sum of the step rewards since the last.
      r_min: reward threshold: step rewards at or below it are set to 0.
      D: survival threshold: a step reward below it ends the episode.
      complexity: L, layers of the optimal policy.
      horizon: T, steps of an episode.
      hidden_width: H, width of the optimal policy's inner layers.
      policy_init: how the optimal policy's layers are drawn where they widen.
      team: divides the action channels among several agents; none in a single agent's task.
      rotation: θ, radians by which the optimal policy's input is rotated about the centre of the
        cube.
      safety: limits of the actions that depend on the state.
      observation: what the agent sees in place of the state.
      shaping: a potential whose differences are paid on top, and mislead an agent that does not
        look ahead.
      noise: noise of rewards and transitions.
    """

    schema_version: SchemaVersion = 1
    state_dim: Annotated[Integer, Field(ge=1, le=MAX_DIM, title="state dimension")] = 8
    action_dim: Annotated[Integer, Field(ge=1, le=MAX_DIM, title="action dimension")] = 4
    k: Annotated[Integer, Field(ge=1, le=2**31 - 1, title="reward interval"), PAYMENT] = 1
    r_min: Annotated[Real, Field(ge=0, lt=1, title="minimum reward"), PAYMENT] = 0.0
    D: Annotated[Real, Field(ge=0, lt=1, title="survival threshold"), PAYMENT] = 0.0
    complexity: Annotated[Integer, Field(ge=1, le=10_000)] = 1
    horizon: Annotated[Integer, Field(ge=1, le=2**31 - 1), PAYMENT] = 100
    hidden_width: Annotated[Integer, Field(ge=1, le=4096)] = 64
    policy_init: Literal["semi_orthogonal", "unit_variance"] = "semi_orthogonal"
    team: TeamSpec | None = None
    rotation: Annotated[Real, Field(ge=0, lt=FULL_TURN), LATER] = 0.0
    safety: Annotated[SafetySpec | None, LATER] = None
    observation: Annotated[ObservationSpec | None, LATER] = None
    shaping: Annotated[ShapingSpec | None, LATER, PAYMENT] = None
    noise: Annotated[NoiseSpec | None, LATER, PAYMENT] = None

    @field_validator("team")
    @classmethod
    def _every_channel_is_all(cls, team: TeamSpec | None, info: ValidationInfo) -> TeamSpec | None:
        """Write the list of all channels as "all": the same team must be the same document."""
        if team is None or "state_dim" not in info.data:
            return team
        every_channel = tuple(range(info.data["state_dim"]))
        agents = tuple(
            agent.model_copy(update={"observes": "all"})
            if agent.observes == every_channel
            else agent
            for agent in team.agents
        )
        return team.model_copy(update={"agents": agents})

    @model_validator(mode="after")
    def _team_fits(self) -> Self:
        if self.team is None:
            return self
        owned = sum(agent.action_dim for agent in self.team.agents)
        if owned != self.action_dim:
            raise ValueError(
                f"team.agents: their action channels add up to {owned}: must be "
                f"action_dim={self.action_dim}. Change an agent's action_dim, or the task's."
            )
        for agent in self.team.agents:
            if agent.observes != "all" and agent.observes[-1] >= self.state_dim:
                observes = short_repr(list(agent.observes))
                raise ValueError(
                    f"team.agents.{agent.name}.observes={observes}: must be in "
                    f"[0, state_dim={self.state_dim}). Remove channel {agent.observes[-1]}, or "
                    "increase state_dim."
                )
        return self

    @model_validator(mode="after")
    def _rotation_has_a_plane(self) -> Self:
        if not self.rotation:
            return self
        for agent, channels in zip(self.agents, self.observed_channels, strict=True):
            if len(channels) == 1:
                raise ValueError(
                    f"rotation={self.rotation}: must be 0, because a rotation needs two state "
                    f"channels and {agent.name} observes one. Leave it out, or add a channel."
                )
        return self

    @model_validator(mode="after")
    def _optimum_is_known(self) -> Self:
        if self.safety is not None and self.D > 0:
            raise ValueError(
                f"D={self.D}: must be 0 with safety, because with early termination the best safe "
                "action is not known: it may pay to break a limit and survive. Leave D or safety "
                "out."
            )
        for field in ("safety", "observation"):
            if getattr(self, field) is not None and self.team is not None:
                agents = len(self.team.agents)
                raise ValueError(
                    f"{field}={short_repr(getattr(self, field).to_dict())}: must be null in a task "
                    f"for a team ({agents} agent{'s' * (agents > 1)}). Leave {field} or team out."
                )
        return self

    @property
    def observation_dim(self) -> int:
        """Entries of a single agent's observation: S, the distractors, t/T and r_cum/k."""
        return self.state_dim + self.distractors + 2

    @property
    def agents(self) -> tuple[AgentSpec, ...]:
        """The agents; without a team one, `agent_0`, that owns and observes everything."""
        if self.team is not None:
            return self.team.agents
        return (AgentSpec(name="agent_0", action_dim=self.action_dim),)

    @property
    def observed_channels(self) -> tuple[tuple[int, ...], ...]:
        """The state channels that each agent observes."""
        everything = tuple(range(self.state_dim))
        return tuple(
            everything if agent.observes == "all" else agent.observes for agent in self.agents
        )

    @property
    def separable(self) -> bool:
        """Whether r is all that is paid, and it changes no observation and ends no episode."""
        on_top = self.compensated or self.shaping is not None or self.noise is not None
        return self.k == 1 and self.D == 0 and not on_top

    @property
    def is_plain(self) -> bool:
        """Whether a step does no more than METHOD's section 1."""
        return (self.safety, self.observation, self.shaping, self.noise) == (None,) * 4

    @property
    def tightness(self) -> float:
        """τ, 0 without `safety`: limits that no action exceeds."""
        return 0.0 if self.safety is None else self.safety.tightness

    @property
    def compensated(self) -> bool:
        """Whether each step pays the price of the best safe action."""
        return self.safety is not None and self.safety.compensated

    @property
    def reward_noise(self) -> float:
        """σ_r, 0 without `noise`."""
        return 0.0 if self.noise is None else self.noise.reward

    @property
    def distractors(self) -> int:
        """m, 0 without `observation`."""
        return 0 if self.observation is None else self.observation.distractors

    @property
    def dynamics(self) -> Literal["noise", "autonomous", "driven"] | None:
        """How the distractors move; None where there are none."""
        return None if self.observation is None else self.observation.dynamics

    @property
    def mixing(self) -> Literal["none", "orthogonal", "nonlinear"]:
        """The map from state and distractors to what the agent sees."""
        return "none" if self.observation is None else self.observation.mixing


NEVER = 2**63 - 1
"""Later than every environment step; the largest int64."""


class Segment(NamedTuple):
    """A part of a cycle in which one spec is in force."""

    phase: int  # its index; 0 where there are none
    spec: SMESpec
    start: int  # environment steps of the cycle before it


class SegmentTimes(NamedTuple):
    """Which segment is in force after how many environment steps."""

    starts: list[int]  # environment steps of a cycle before each segment
    cycle_steps: int
    cycles: int

    def segment_at(self, lifetime: int) -> int:
        """The index of the segment in force after so many steps; at the end the last one."""
        if lifetime >= self.cycles * self.cycle_steps:
            return len(self.starts) - 1
        return bisect_right(self.starts, lifetime % self.cycle_steps) - 1

    def next_switch(self, lifetime: int) -> int:
        """The lifetime at which that segment is over; NEVER in the last one of the life."""
        cycle, inside = divmod(lifetime, self.cycle_steps)
        after = bisect_right(self.starts, inside)
        end = self.starts[after] if after < len(self.starts) else self.cycle_steps
        switch = cycle * self.cycle_steps + end
        return switch if switch < self.cycles * self.cycle_steps else NEVER


class SMESpec(Setting, NamedDocument):
    """A complete task: a setting of the axes and the seed of its draw.

    Equal specs have equal digests, and equal digests are equal specs. The name that a file or a
    registration gives a spec is presentation: it is in no JSON and makes no two specs unequal.

    Attributes:
      seed: of all random draws of the task.

    Examples:
      >>> from sme_registry import SMESpec
      >>> spec = SMESpec(state_dim=16, complexity=10, k=5, seed=7)
      >>> spec.derive(k=1).k
      1
      >>> SMESpec(hidden_width=0)
      Traceback (most recent call last):
      ...
      sme_registry.errors.SpecError: SMESpec: hidden_width=0: must be in [1, 4096]. ...
    """

    # A task is a stream of one segment that is never over: it answers what a stream is asked.
    times: ClassVar[SegmentTimes] = SegmentTimes([0], NEVER, 1)
    switch: ClassVar[Literal["episode", "step"]] = "episode"
    switches: ClassVar[None] = None
    observed_phases: ClassVar[int] = 0
    kind: ClassVar[str] = "spec"  # the field that holds it in a file and in an `EnvSpec`

    seed: Seed = 0

    @property
    def specs(self) -> tuple[SMESpec, ...]:
        """This spec alone."""
        return (self,)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Its only segment."""
        return (Segment(0, self, 0),)

    @property
    def as_drawn(self) -> SMESpec:
        """This spec with the default payment: equal where states and optimal actions are."""
        return self.model_copy(update={name: _default(name) for name in self.marked(PAYMENT)})

    def derive(self, **overrides: Any) -> SMESpec:
        """This spec with some fields changed: another task, with another digest."""
        return SMESpec.from_dict({**self.to_dict(), **overrides}) if overrides else self


def _default(name: str) -> Any:
    return Setting.model_fields[name].default


SpecLike: TypeAlias = SMESpec | dict[str, Any] | str | os.PathLike[str]
"""A task: its spec, the spec's fields, an id, a digest or a path; see `resolve`."""
