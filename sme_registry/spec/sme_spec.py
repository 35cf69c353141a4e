"""`SMESpec`: the numbers from which a Synthetic Monitoring Environment is generated."""

from __future__ import annotations

import math
import os
import re
from bisect import bisect_right
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeAlias, get_args

from pydantic import (
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from sme_registry.spec.document import (
    LATER,
    WORDED,
    Document,
    FieldMark,
    Integer,
    NamedDocument,
    Real,
    SchemaVersion,
    check_names,
    matching,
    plain_number,
    short_repr,
)

ActionRange: TypeAlias = Literal["unit", "symmetric"]
"""The range of actions: [0, 1], the paper's, or [−1, 1], which Stable-Baselines3 prefers."""

ACTION_RANGES: tuple[str, ...] = get_args(ActionRange)

MAX_DIM = 2**20
FULL_TURN = 2.0 * math.pi
MAX_SEED = 2**53  # above it not every integer is a JSON number that all readers agree on
_HEX_SEED = re.compile(r"0x[0-9a-fA-F]{1,64}")
_AGENT_NAME = r"^[A-Za-z][A-Za-z0-9-]*_(0|[1-9][0-9]*)$"


def _seed(value: Any) -> int | str:
    if isinstance(value, str) and _HEX_SEED.fullmatch(value):
        return f"0x{int(value, 16):x}"
    number = plain_number(value)
    if isinstance(number, int) and not isinstance(number, bool) and 0 <= number < MAX_SEED:
        return number
    raise ValueError(
        f"must be an integer in [0, {MAX_SEED}), or for a sealed task a string "
        "'0x…' of 1 to 64 hex digits. Correct it, or leave it out for the default, 0."
    )


Seed = Annotated[
    int | str,
    PlainValidator(_seed),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "integer", "minimum": 0, "exclusiveMaximum": MAX_SEED},
                {
                    "type": "string",
                    "pattern": "^0x[0-9a-fA-F]{1,64}$",
                    WORDED: "'0x' and 1 to 64 hex digits",
                },
            ]
        }
    ),
]


def _observed(value: Any) -> Any:
    if isinstance(value, str) and value == "all":
        return value
    channels = [plain_number(c) for c in value] if isinstance(value, list | tuple) else None
    if not channels or any(type(c) is not int or c < 0 for c in channels):
        raise ValueError(
            "must be 'all' or a list of state channels, each an integer in [0, state_dim). "
            "Leave it out for 'all'."
        )
    if sorted(set(channels)) != channels:
        raise ValueError(
            "channels must be in increasing order, each once. "
            f"Write {short_repr(sorted(set(channels)))}."
        )
    return tuple(channels)


Observed = Annotated[
    Literal["all"] | tuple[int, ...],
    PlainValidator(_observed),
    PlainSerializer(lambda channels: channels if channels == "all" else list(channels)),
    WithJsonSchema(
        {
            "anyOf": [
                {"const": "all"},
                {"type": "array", "items": {"type": "integer", "minimum": 0}, "minItems": 1},
            ]
        }
    ),
]


class AgentSpec(Document):
    """One agent of a team: the action channels it owns and the state channels it observes.

    Attributes:
      name: unique in the team. Without names, agents are `agent_0`, `agent_1`, … as in PettingZoo.
      action_dim: the number of its action channels. The agents own consecutive ones, in order.
      observes: the state channels that it sees, in increasing order, or all.
    """

    name: Annotated[
        str,
        matching(
            _AGENT_NAME,
            "a word, '_' and a number, such as 'agent_0', of at most 64 characters",
            max_length=64,
        ),
    ]
    action_dim: Annotated[Integer, Field(ge=1, le=MAX_DIM)]
    observes: Observed = "all"


class TeamSpec(Document):
    """Which agent owns which action channels: consecutive ones, in the order of the agents.

    Attributes:
      agents: in the order of their action channels, which add up to the task's.
      reward: an agent's reward is that of its own channels ("individual"), or all agents share that
        of the whole team ("team").

    Examples:
      >>> from sme_registry.spec import TeamSpec
      >>> agents = [{"action_dim": 3}, {"action_dim": 1, "observes": [0, 1]}]
      >>> sme_registry.SMESpec(team=TeamSpec(agents=agents)).team.agents[1].name
      'agent_1'
    """

    agents: Annotated[tuple[AgentSpec, ...], Field(min_length=1, max_length=1024, strict=False)]
    reward: Literal["individual", "team"] = "individual"

    @model_validator(mode="before")
    @classmethod
    def _default_names(cls, data: Any) -> Any:
        """Agents without a name are `agent_0`, `agent_1`, …, as in PettingZoo."""
        if not isinstance(data, dict) or not isinstance(data.get("agents"), list | tuple):
            return data
        agents = [
            {"name": f"agent_{i}", **agent} if isinstance(agent, dict) else agent
            for i, agent in enumerate(data["agents"])
        ]
        return {**data, "agents": agents}

    @model_validator(mode="after")
    def _unique_names(self) -> Self:
        check_names("agents", self.agents)
        return self


class SafetySpec(Document):
    """State-dependent upper limits of the action channels, which the optimum breaks at times.

    Source: METHOD, section 8.

    Attributes:
      tightness: τ, about the share of states and channels in which the optimum is above its limit.
      compensated: whether each step also pays the price 1 − r of the best safe action. The safe
        projection is then the best policy that never violates; a violating one may earn more.

    Examples:
      >>> from sme_registry.spec import SafetySpec
      >>> sme_registry.SMESpec(safety=SafetySpec(tightness=0.2)).safety.tightness
      0.2
    """

    tightness: Annotated[Real, Field(gt=0, le=0.5)]
    compensated: Annotated[bool, LATER] = False


class ShapingSpec(Document):
    """A potential of state and time, whose differences are paid on top and mislead: foresight.

    Source: METHOD, section 10.

    Attributes:
      scale: c, largest potential, in units of the largest step reward.
      discount: g, factor of the next potential. With 1 the optimum is that of the undiscounted
        return; another one is the control of a study, for learners that discount by it.

    Examples:
      >>> from sme_registry.spec import ShapingSpec
      >>> sme_registry.SMESpec(shaping=ShapingSpec(scale=3)).shaping.discount
      1.0
    """

    scale: Annotated[Real, Field(gt=0, le=100)]
    discount: Annotated[Real, Field(ge=0, le=1), LATER] = 1.0


class NoiseSpec(Document):
    """Normal noise of what is paid and of the next state; optimum and regret are as without.

    Source: METHOD, section 12. Observations have none: it would hide the state.

    Attributes:
      reward: σ_r, standard deviation of what is added to the reward of each step.
      transition: σ_s, standard deviation of what is added to each state channel before the fold.

    Examples:
      >>> from sme_registry.spec import NoiseSpec
      >>> sme_registry.SMESpec(noise=NoiseSpec(reward=0.3)).noise.transition
      0.0
    """

    reward: Annotated[Real, Field(ge=0, le=10)] = 0.0
    transition: Annotated[Real, Field(ge=0, le=1)] = 0.0

    @model_validator(mode="before")
    @classmethod
    def _observations_have_none(cls, data: Any) -> Any:
        if isinstance(data, dict) and "observation" in data:
            raise ValueError(
                "noise.observation: must be left out, because noise of the observation would hide "
                "the state, and the optimum would not be known. Use reward or transition."
            )
        return data

    @model_validator(mode="after")
    def _some_noise(self) -> Self:
        if not self.reward and not self.transition:
            raise ValueError(
                "reward=0.0: must be above 0 where transition is 0. Increase one of them, or leave "
                "noise out."
            )
        return self


class ObservationSpec(Document):
    """What the agent sees in place of the state: distractors beside it, and an invertible map.

    Source: METHOD, section 9.

    Attributes:
      distractors: m, channels beside the state that change neither reward nor optimum.
      dynamics: how they move: drawn anew at each step ("noise", the default), by a transition of
        their own under random inputs ("autonomous"), or under the agent's actions ("driven"). None
        without distractors.
      mixing: the map: none, a scaled rotation about the centre ("orthogonal"), or `mixing_depth`
        square uniform layers ("nonlinear").
      mixing_depth: number of layers; 1 where the mixing is "nonlinear" and none is given, and None
        for another mixing.

    Examples:
      >>> from sme_registry.spec import ObservationSpec
      >>> sees = ObservationSpec(distractors=32, dynamics="driven", mixing="nonlinear")
      >>> sme_registry.SMESpec(observation=sees).observation_dim
      42
    """

    distractors: Annotated[Integer, Field(ge=0, le=MAX_DIM)] = 0
    dynamics: Literal["noise", "autonomous", "driven"] | None = None
    mixing: Literal["none", "orthogonal", "nonlinear"] = "none"
    mixing_depth: Annotated[Integer, Field(ge=1, le=3)] | None = None

    @model_validator(mode="after")
    def _one_document_for_one_observation(self) -> Self:
        for field, condition, needed, default in (
            ("dynamics", "distractors > 0", self.distractors > 0, "noise"),
            ("mixing_depth", "mixing='nonlinear'", self.mixing == "nonlinear", 1),
        ):
            value = getattr(self, field)
            if value is not None and not needed:
                raise ValueError(
                    f"{field}={value!r}: needs {condition}. Leave {field} out, or set {condition}."
                )
            if value is None and needed:
                object.__setattr__(self, field, default)
        if not self.distractors and self.mixing == "none":
            raise ValueError(
                "distractors=0: with mixing='none' the agent would see the state as it is. Set "
                "distractors > 0 or a mixing, or leave observation out."
            )
        return self


PAYMENT = FieldMark("payment")
"""Of a field that changes what is paid, or for how long, and neither states nor optimum."""


class Setting(Document):
    """One setting of the axes: everything that a task is generated from, except its seed.

    Defaults are the paper's (METHOD, section 1), or ours where it has none.

    Attributes:
      state_dim: S, state channels.
      action_dim: A, action channels.
      k: steps between payouts of the reward.
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
