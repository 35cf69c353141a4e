"""`TeamPolicy`: the policies of a team's agents, as one policy of the joint action.

Either each agent has its own policy of what it observes and owns, `[B, |O_i| + 2] → [B, a_i]`, or
all share one, which is called for each agent in turn with its shared observation (`envs.shared`),
`[B, S + 2 + n] → [B, max a_i]`. A function of the whole state is no team policy: under partial
observation no agent could execute it.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from sme_registry.envs.shared import shared_observation_of
from sme_registry.envs.types import Observation as Observations
from sme_registry.errors import PolicyError, did_you_mean
from sme_registry.evaluation.policies.interface import Interface
from sme_registry.evaluation.policies.policy import Policy, prepare
from sme_registry.spec import ActionRange, SMESpec
from sme_registry.task import draw
from sme_registry.task.draw import Array


class Member(NamedTuple):
    """One agent of a team policy.

    Attributes:
      agent: its name.
      policy: its own policy, or the one that all agents share.
      observe: from observations `[B, S + 2]` to the policy's input, a fresh array.
      action_dim: a_i, how many entries of the policy's action belong to this agent.
    """

    agent: str
    policy: Policy
    observe: Callable[[Observations], Observations]
    action_dim: int


@dataclass(frozen=True)
class TeamPolicy:
    """A team's policies, ready to be called.

    Attributes:
      name: what reports call it.
      action_range: "unit" or "symmetric"; "mixed" if the agents' policies differ.
      members: the agents, in the order of the channels that they own.
    """

    name: str
    action_range: ActionRange | Literal["mixed"]
    members: tuple[Member, ...]

    def __call__(self, observations: Observations) -> Array:
        """Joint actions `[B, A]`, converted to the unit range but not clipped to it.

        Args:
          observations: `[B, S + 2]`: s, t/T and r_cum/k, the same for each agent.

        Raises:
          PolicyError: an agent's policy fails or returns invalid actions; names the agent.
        """
        joint = []
        for member in self.members:
            with _errors_name(member.agent):
                a = member.policy(member.observe(observations))
            joint.append(a[:, : member.action_dim])
        return np.concatenate(joint, axis=1)

    def check_team(self, spec: SMESpec) -> None:
        """Check that a task has the agents that this policy was prepared for.

        Raises:
          PolicyError: it has other agents, or none.
        """
        prepared = [(member.agent, member.action_dim) for member in self.members]
        agents = [] if spec.team is None else draw.agents(spec)
        if prepared != [(agent.name, agent.action_dim) for agent in agents]:
            raise PolicyError(
                f"policy {self.name!r}: it acts for the agents "
                f"{', '.join(f'{agent} ({dim} channels)' for agent, dim in prepared)}, and this "
                "task has others. Prepare it for this task."
            )


def separate_policies(
    policies: Mapping[str, Any],
    spec: SMESpec,
    *,
    action_range: str | None = None,
    name: str | None = None,
) -> TeamPolicy:
    """A team policy from a policy for each agent, by name.

    Raises:
      PolicyError: an agent has no policy, a name is unknown, or a policy is invalid.
    """
    agents = draw.agents(spec)
    _check_names(policies, [agent.name for agent in agents])
    members = []
    for agent, observed in zip(agents, draw.observed_channels(spec), strict=True):
        interface = Interface(
            len(observed) + 2,
            agent.action_dim,
            f"{len(observed)} observed and {agent.action_dim} owned channels",
        )
        with _errors_name(agent.name):
            policy = prepare(policies[agent.name], interface, action_range=action_range)
        columns = [*observed, spec.state_dim, spec.state_dim + 1]
        observe = functools.partial(_columns, columns)
        members.append(Member(agent.name, policy, observe, agent.action_dim))
    names = {member.policy.name for member in members}
    ranges = {member.policy.action_range for member in members}
    return TeamPolicy(
        name or (names.pop() if len(names) == 1 else f"{len(members)} policies"),
        ranges.pop() if len(ranges) == 1 else "mixed",
        tuple(members),
    )


def shared_policy(
    policy: Any, spec: SMESpec, *, action_range: str | None = None, name: str | None = None
) -> TeamPolicy:
    """A team policy from one policy that all agents share.

    Raises:
      PolicyError: the policy is invalid.
    """
    agents = draw.agents(spec)
    observation_dim = spec.state_dim + 2 + len(agents)
    action_dim = max(agent.action_dim for agent in agents)
    interface = Interface(
        observation_dim,
        action_dim,
        f"a policy that all {len(agents)} agents share",
        alternatives="a dict from each agent's name to its policy; or for all agents ",
        hint=f"A policy that a team shares is called for each agent in turn, from its shared "
        f"observation [B, {observation_dim}] to [B, {action_dim}]; for separate policies pass a "
        "dict by agent.",
    )
    prepared = prepare(policy, interface, action_range=action_range, name=name)
    members = tuple(
        Member(
            agent.name,
            prepared,
            functools.partial(shared_observation_of, index, len(agents), observed),
            agent.action_dim,
        )
        for index, (agent, observed) in enumerate(
            zip(agents, draw.observed_channels(spec), strict=True)
        )
    )
    return TeamPolicy(prepared.name, prepared.action_range, members)


def _columns(columns: list[int], observations: Observations) -> Observations:
    return observations[:, columns]


def _check_names(policies: Mapping[str, Any], names: list[str]) -> None:
    missing = [name for name in names if name not in policies]
    unknown = [name for name in policies if name not in names]
    problems = [f"{', '.join(missing)}: policy missing."] if missing else []
    if unknown:
        hint = did_you_mean(str(unknown[0]), missing or names)
        problems.append(f"{', '.join(map(repr, unknown))}: no such agent.{hint}")
    if problems:
        raise PolicyError(f"policy: {' '.join(problems)} Give one for each of {', '.join(names)}.")


@contextlib.contextmanager
def _errors_name(agent: str) -> Iterator[None]:
    """Errors of an agent's policy begin with its name."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"{agent}: {error}") from error.__cause__
