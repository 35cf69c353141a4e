"""The blocks of a `SMESpec`: its seed, team, safety, shaping, noise and observation."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    PlainSerializer,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)

from sme_registry.spec.document import (
    LATER,
    WORDED,
    Document,
    Integer,
    Real,
    check_names,
    matching,
    plain_number,
    short_repr,
)

MAX_DIM = 2**20
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
                "observation: must be left out, because noise of the observation would hide "
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
