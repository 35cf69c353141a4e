"""Policies: every form in which a user may give one, as one checked function of observations.

In a team, either each agent has its own policy of what it observes and owns,
`[B, |O_i| + 2] → [B, a_i]`, or all share one, which is called for each agent in turn with its
shared observation (`sme_registry.teams`), `[B, S + 2 + n] → [B, max a_i]`.
"""

from __future__ import annotations

import contextlib
import functools
import operator
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, cast

import numpy as np

from sme_registry.envs import arguments
from sme_registry.errors import (
    ActionError,
    OptionError,
    PolicyError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.evaluation import models
from sme_registry.evaluation.models import Interface, load_onnx, load_sb3
from sme_registry.evaluation.networks import OfflinePolicy, Perceptron
from sme_registry.evaluation.references import OLD_NAMES, POLICIES, reference_policy
from sme_registry.io import choice, import_object
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.sme_spec import ACTION_RANGES, ActionRange
from sme_registry.task.task import Array, Observation
from sme_registry.teams import shared_observation_of


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

        def with_phase(policy: Policy) -> Callable[[Observation], Array]:
            return lambda o: policy(np.concatenate([o, np.tile(one_hot, (len(o), 1))], axis=1))

        # `policy` has converted its actions to the unit range, and named its own errors.
        return replace(
            self,
            action_range="unit",
            act=with_phase(self),
            episodes=lambda: with_phase(self.start()),
            hidden=None,
        )

    def __call__(self, observations: Observation) -> Array:
        """Actions `[B, A]`, converted to the unit range but not clipped to it."""
        try:
            returned = models.without_tensor(self.act(observations))
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
                f"{models.advice_on(error)}"
            ) from error


class Member(NamedTuple):
    """An agent of a team, with its own policy or the one that all agents share."""

    agent: str
    policy: Policy
    observe: Callable[[Observation], Observation]  # `[B, S + 2]` to the policy's input, fresh
    action_dim: int  # a_i, entries of the policy's action that belong to this agent


@dataclass(frozen=True)
class TeamPolicy:
    """A team's policies, ready to be called."""

    name: str  # in reports
    action_range: ActionRange | Literal["mixed"]  # mixed: the agents' policies differ
    members: tuple[Member, ...]  # in the order of the channels that they own
    hidden: ClassVar[None] = None  # those of several networks

    def __call__(self, observations: Observation) -> Array:
        """Joint actions `[B, A]`, converted to the unit range but not clipped to it."""
        return self._joint_actions([observations] * len(self.members))

    def start(self) -> Callable[[Observation], Array]:
        """The joint actions in a batch of episodes, with recurrent agents' state; see `act_in`."""
        members = (member._replace(policy=member.policy.start()) for member in self.members)
        return replace(self, members=tuple(members)).act_in

    def act_in(self, joint: Observation) -> Array:
        """Joint actions `[B, A]` from s, t/T and each agent's r_cum/k, `[B, S + 1 + n]`."""
        shared = joint.shape[1] - len(self.members)
        columns = [[*range(shared), shared + agent] for agent in range(len(self.members))]
        return self._joint_actions([joint[:, of_agent] for of_agent in columns])

    def _joint_actions(self, observations: Sequence[Observation]) -> Array:
        """Joint actions, from the observations `[B, S + 2]` of each agent."""
        joint = []
        for member, seen in zip(self.members, observations, strict=True):
            with prefixed_errors(member.agent):
                a = member.policy(member.observe(seen))
            joint.append(a[:, : member.action_dim])
        return np.concatenate(joint, axis=1)

    def check_team(self, spec: SMESpec) -> None:
        prepared = [(member.agent, member.action_dim) for member in self.members]
        if prepared != [(agent.name, agent.action_dim) for agent in spec.agents]:
            raise PolicyError(
                f"policy {self.name!r}: it acts for the agents "
                f"{', '.join(f'{agent} ({dim} channels)' for agent, dim in prepared)}, and this "
                "task has others. Prepare it for this task."
            )


@contextlib.contextmanager
def prefixed_errors(where: str) -> Iterator[None]:
    """Errors of a policy begin with where it acts, such as its agent's name."""
    try:
        yield
    except (PolicyError, UnknownNameError) as error:
        raise type(error)(f"{where}: {error}") from error.__cause__


_SUFFIXES = (".zip", ".onnx", ".npz")


def as_policy(
    policy: Any,
    spec: SMESpec,
    *,
    action_range: str | None = None,
    name: str | None = None,
    algorithm: str | None = None,
    observed_phases: int = 0,
) -> Policy | TeamPolicy:
    """Prepare a policy for a task.

    Args:
      policy: a callable from observations `[B, S + 2]` float32 (with m distractors
        `[B, S + m + 2]`) to actions `[B, A]`, arrays or PyTorch tensors; a `torch.nn.Module`; a
        model with `predict(observations, deterministic=True)`, or the path of its .zip (it can run
        code of its author), an .onnx or an .npz file; `module:function`; or the name of a reference
        such as "linear". For a team a dict by agent, each from `[B, |O_i| + 2]` to `[B, a_i]`; a
        folder of files `<agent>.zip`; or one that all share, `[B, S + 2 + n]` to `[B, max a_i]`.
      action_range: "unit" for actions in [0, 1] or "symmetric" for [−1, 1]; None takes an SB3
        model's own action space, and "unit" for any other policy.
      algorithm: the class of a .zip that does not tell it, as in `load_sb3`.
      observed_phases: entries at the end of its observations for the phase of a stream, one-hot.

    A recurrent model acts from its initial state in each observation, until `Policy.start`.
    """
    if action_range is not None:
        choice("action_range", action_range, ACTION_RANGES)
    range_ = cast("ActionRange | None", action_range)
    if isinstance(policy, str):
        policy, default = _named(policy, spec)
        name = name or default
    if isinstance(policy, os.PathLike) and os.path.isdir(policy):
        name = name or Path(policy).stem
        policy = _of_agents(Path(policy), spec)
    if algorithm is not None:
        if not isinstance(policy, os.PathLike) or Path(policy).suffix != ".zip":
            raise PolicyError(
                f"algorithm={algorithm!r}: is for the path of a model's .zip. Leave it out."
            )
        policy, name = load_sb3(policy, algorithm), name or Path(policy).stem
    if isinstance(policy, TeamPolicy):
        policy.check_team(spec)
        return policy if name is None else replace(policy, name=name)
    if spec.team is None:
        return _prepare(policy, interface_of(spec, observed_phases), range_, name)
    return _team_policy(policy, spec, range_, name)


def interface_of(spec: SMESpec, observed_phases: int = 0) -> Interface:
    """The widths of a policy for a task; of a team's, for the one that all agents share."""
    if spec.team is None:
        S, A, m = spec.state_dim, spec.action_dim, spec.distractors
        distractors = f", {m} distractors" if m else ""
        observed = f" and {observed_phases} observed phases" if observed_phases else ""
        return Interface(
            spec.observation_dim + observed_phases,
            A,
            f"state_dim={S}, action_dim={A}{distractors}{observed}",
        )
    agents = spec.agents
    observation_dim = spec.state_dim + 2 + len(agents)
    action_dim = max(agent.action_dim for agent in agents)
    return Interface(
        observation_dim,
        action_dim,
        f"a policy that all {len(agents)} agents share",
        hint=f"A policy that a team shares is called for each agent in turn, from its shared "
        f"observation [B, {observation_dim}] to [B, {action_dim}]; for separate policies pass a "
        "dict by agent.",
    )


def _named(text: str, spec: SMESpec) -> tuple[Any, str]:
    """The policy that a text names, where a path stays one, and what reports call it."""
    path = Path(text)
    if text in (*POLICIES, *OLD_NAMES):
        return reference_policy(text, spec), OLD_NAMES.get(text, text)
    if path.suffix in (".pt", ".pth"):
        raise PolicyError(
            f"policy={text!r}: is a PyTorch file, which lacks the network's code. In Python, pass "
            "the loaded torch.nn.Module to `sme_registry.evaluate`, or write it with "
            "`sme_registry.export_onnx` and give the .onnx file."
        )
    if text.endswith(_SUFFIXES) or os.path.exists(text):
        return path, path.stem
    if ":" not in text:
        raise UnknownNameError(
            f"policy={text!r}: must be the path of a .zip, .onnx or .npz file, module:function, or "
            f"one of {', '.join(POLICIES)}.{did_you_mean(text, POLICIES)}"
        )
    function = import_object(text, "policy", PolicyError)
    if not callable(function):
        raise PolicyError(
            f"policy={text!r}: is a {type(function).__name__}: must be a function from "
            "observations to actions."
        )
    return function, text


def _of_agents(folder: Path, spec: SMESpec) -> dict[str, Path]:
    """The policies in a folder by agent: `<agent>.zip`, `.onnx` or `.npz`."""
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix in _SUFFIXES}
    if spec.team is None or not files:
        raise PolicyError(
            f"policy={str(folder)!r}: is a folder. Give the policy's file in it; for a team, a "
            "folder with the policy of each agent, such as agent_0.zip."
        )
    return files


def _prepare(
    policy: Any, interface: Interface, action_range: ActionRange | None, name: str | None = None
) -> Policy:
    """One policy of this interface, from a callable, a model or the path of a file."""
    if isinstance(policy, Policy):
        interface.check(f"policy {policy.name!r}", actions=(policy.action_dim,))
        return replace(
            policy, name=name or policy.name, action_range=action_range or policy.action_range
        )
    if isinstance(policy, os.PathLike):
        name = name or Path(policy).stem
        policy = _load(Path(policy), interface)
    functions: dict[str, Any]
    if hasattr(policy, "predict"):
        functions = models.of_sb3(policy, interface)
        action_range = action_range or models.action_range_of(policy)
    elif models.is_module(policy):
        functions = models.of_module(policy)
    elif isinstance(policy, Perceptron):
        shapes = {"observations": (policy.observation_dim,), "actions": (policy.action_dim,)}
        interface.check(f"policy {name or _name_of(policy)!r}", **shapes)
        functions = {"act": policy, "hidden": policy.hidden}
    elif callable(policy):
        functions = {"act": policy}
    else:
        raise PolicyError(
            f"policy={policy!r:.80}: must be a callable from observations "
            f"[B, {interface.observation_dim}] to actions [B, {interface.action_dim}], a "
            "torch.nn.Module, a Stable-Baselines3 model, the path of a .zip, .onnx or .npz file, "
            f"module:function, or the name of a reference policy. {interface.hint}".rstrip()
        )
    name, own = name or _name_of(policy), getattr(policy, "action_range", None)
    if (action_range, own) == ("symmetric", "unit"):
        raise PolicyError(
            f"action_range='symmetric': the actions of policy {name!r} are in [0, 1]. Leave it out."
        )
    return Policy(
        name=name,
        action_range=action_range or own or "unit",
        action_dim=interface.action_dim,
        hint=interface.hint,
        **functions,
    )


def _load(path: Path, interface: Interface) -> Any:
    if path.suffix == ".onnx":
        return load_onnx(path, interface)
    return OfflinePolicy.load(path) if path.suffix == ".npz" else load_sb3(path)


def _name_of(policy: Any) -> str:
    name = getattr(policy, "__name__", type(policy).__name__)
    return "policy" if name in ("<lambda>", "function") else str(name)


def _team_policy(
    policy: Any, spec: SMESpec, action_range: ActionRange | None, name: str | None
) -> TeamPolicy:
    """A team policy from a policy for each agent, by name, or from one that all agents share."""
    if isinstance(policy, Mapping):
        members = tuple(_separate_members(policy, spec, action_range))
    else:
        shared = _prepare(policy, interface_of(spec), action_range, name)
        agents = zip(spec.agents, spec.observed_channels, strict=True)
        members = tuple(
            Member(
                agent.name,
                shared,
                functools.partial(shared_observation_of, index, len(spec.agents), observed),
                agent.action_dim,
            )
            for index, (agent, observed) in enumerate(agents)
        )
    names = {member.policy.name for member in members}
    ranges = {member.policy.action_range for member in members}
    return TeamPolicy(
        name or (names.pop() if len(names) == 1 else f"{len(members)} policies"),
        ranges.pop() if len(ranges) == 1 else "mixed",
        members,
    )


def _separate_members(
    policies: Mapping[str, Any], spec: SMESpec, action_range: ActionRange | None
) -> Iterator[Member]:
    """Agents with policies of their own, from the channels that they observe to those they own."""
    if problem := arguments.agents_problem(policies, [a.name for a in spec.agents], "policy"):
        raise PolicyError(f"policy: {problem}")
    for agent, observed in zip(spec.agents, spec.observed_channels, strict=True):
        n, a = len(observed), agent.action_dim
        with prefixed_errors(agent.name):
            policy = policies[agent.name]
            if isinstance(policy, str):
                policy, _ = _named(policy, spec)
            if isinstance(policy, Mapping):  # a reference policy, of all agents
                policy = policy.get(agent.name)
            interface = Interface(n + 2, a, f"{n} observed and {a} owned channels")
            policy = _prepare(policy, interface, action_range)
        columns = [*observed, spec.state_dim, spec.state_dim + 1]
        yield Member(agent.name, policy, operator.itemgetter((slice(None), columns)), a)


def stream_policy(
    policy: Any,
    stream: StreamSpec,
    where: str,
    action_range: str | None = None,
    algorithm: str | None = None,
    *,
    alone: bool = False,
) -> Policy:
    """A policy in any form, ready for a stream's observations, or `alone` for those of a phase."""
    with prefixed_errors(where):
        ready = as_policy(
            policy,
            stream.phases[0].spec,
            action_range=action_range,
            algorithm=algorithm,
            observed_phases=0 if alone else stream.observed_phases,
        )
    assert isinstance(ready, Policy)  # streams have no teams
    return ready


def check_count(name: str, policies: Any, count: int, which: str) -> None:
    if not isinstance(policies, Sequence) or isinstance(policies, str) or len(policies) != count:
        given = f"{len(policies)} of them" if isinstance(policies, list | tuple) else repr(policies)
        raise OptionError(f"{name}={given:.60}: must be {count} policies, one {which}.")
