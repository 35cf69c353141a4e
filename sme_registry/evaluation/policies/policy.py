"""`Policy` and `TeamPolicy`: checked functions from observations to actions of the unit range.

In a team, either each agent has its own policy of what it observes and owns,
`[B, |O_i| + 2] → [B, a_i]`, or all share one, which is called for each agent in turn with its
shared observation (`envs.shared`), `[B, S + 2 + n] → [B, max a_i]`. A function of the whole state
is no team policy: under partial observation no agent could execute it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from sme_registry.envs import arguments
from sme_registry.envs.types import Array, Observation
from sme_registry.errors import ActionError, PolicyError
from sme_registry.evaluation.policies import modules
from sme_registry.spec import ActionRange, SMESpec
from sme_registry.task import draw


class Interface(NamedTuple):
    """The widths of observations and actions that a task needs of a policy."""

    observation_dim: int
    action_dim: int
    description: str
    alternatives: str = ""
    hint: str = ""

    def check(self, policy: str, **shapes: tuple[int, ...] | None) -> None:
        """Raise `PolicyError` if a known shape of `observations` or `actions` is another."""
        widths = {"observations": self.observation_dim, "actions": self.action_dim}
        for what, shape in shapes.items():
            if shape not in (None, (widths[what],)):
                raise PolicyError(
                    f"{policy}: its {what} have shape {shape}: must be {(widths[what],)} for "
                    f"{self.description}. Evaluate it on the task that it was trained or prepared "
                    "for."
                )


@dataclass(frozen=True)
class Policy:
    """A policy, ready to be called.

    Attributes:
      name: what reports call it.
      action_range: the range of what `act` returns, "unit" or "symmetric".
      act: observations float32 to actions; unchecked.
      action_dim: A, entries of an action.
      hint: a sentence about its interface, which error messages end with.
      episodes: a new `act` for a batch of episodes that start together: it keeps the state of a
        recurrent policy from call to call, row by row. None: it has no state.
      hidden: observations to the outputs `[B, H]` of each hidden layer of its network, in order;
        None, or a result of None, of an unknown one.
    """

    name: str
    action_range: ActionRange
    act: Callable[[Observation], Any]
    action_dim: int
    hint: str = ""
    episodes: Callable[[], Callable[[Observation], Any]] | None = None
    hidden: Callable[[Observation], Iterable[Any] | None] | None = None

    def start(self) -> Policy:
        """This policy at the start of a batch of episodes; a recurrent one keeps its state."""
        return self if self.episodes is None else replace(self, act=self.episodes())

    def in_phase(self, phase: int, count: int) -> Policy:
        """This policy, given the one-hot of a phase, of so many, behind each observation."""
        one_hot = np.eye(count, dtype=np.float32)[phase]

        def shown(policy: Policy) -> Callable[[Observation], Array]:
            return lambda o: policy(np.concatenate([o, np.tile(one_hot, (len(o), 1))], axis=1))

        # `policy` has converted its actions to the unit range, and named its own errors.
        return replace(
            self,
            action_range="unit",
            act=shown(self),
            episodes=lambda: shown(self.start()),
            hidden=None,
        )

    def __call__(self, observations: Observation) -> Array:
        """Actions `[B, A]`, converted to the unit range but not clipped to it."""
        try:
            returned = modules.without_tensor(self.act(observations))
            shape = (len(observations), self.action_dim)
            a = arguments.to_unit(returned, shape, self.action_range == "symmetric")
            if not np.isfinite(a).all():
                raise arguments.not_finite_error()
            return a
        except ActionError as error:
            raise PolicyError(
                f"policy {self.name!r}: {error} It receives observations "
                f"[{len(observations)}, {observations.shape[1]}] and must return one action per "
                f"row.{self.hint and f' {self.hint}'}"
            ) from None
        except PolicyError:
            raise
        except Exception as error:
            raise PolicyError(
                f"policy {self.name!r} failed on observations of shape {observations.shape}: "
                f"{type(error).__name__}: {error}{self.hint and f'. {self.hint}'}"
                f"{modules.advice_on(error)}"
            ) from error


class Member(NamedTuple):
    """One agent of a team policy."""

    agent: str
    policy: Policy
    observe: Callable[[Observation], Observation]
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

    def __call__(self, observations: Observation) -> Array:
        """Joint actions `[B, A]`, converted to the unit range but not clipped to it."""
        return self._joint_actions([observations] * len(self.members))

    def act_in(self, joint: Observation) -> Array:
        """Joint actions `[B, A]` in episodes, where each agent has its own r_cum; see `__call__`.

        Args:
          joint: `[B, S + 1 + n]`: s, t/T, and each agent's r_cum/k.
        """
        shared = joint.shape[1] - len(self.members)
        columns = [[*range(shared), shared + agent] for agent in range(len(self.members))]
        return self._joint_actions([joint[:, own] for own in columns])

    def _joint_actions(self, observations: Sequence[Observation]) -> Array:
        """Joint actions, from the observations `[B, S + 2]` of each agent."""
        joint = []
        for member, seen in zip(self.members, observations, strict=True):
            with prefixed_errors(member.agent):
                a = member.policy(member.observe(seen))
            joint.append(a[:, : member.action_dim])
        return np.concatenate(joint, axis=1)

    def check_team(self, spec: SMESpec) -> None:
        """Raise `PolicyError` if a task has other agents than this policy was prepared for."""
        prepared = [(member.agent, member.action_dim) for member in self.members]
        agents = [] if spec.team is None else draw.agents(spec)
        if prepared != [(agent.name, agent.action_dim) for agent in agents]:
            raise PolicyError(
                f"policy {self.name!r}: it acts for the agents "
                f"{', '.join(f'{agent} ({dim} channels)' for agent, dim in prepared)}, and this "
                "task has others. Prepare it for this task."
            )


@contextlib.contextmanager
def prefixed_errors(agent: str) -> Iterator[None]:
    """Errors of an agent's policy begin with its name."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"{agent}: {error}") from error.__cause__
