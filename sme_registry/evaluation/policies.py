"""Policies: whatever a user has, as one function from observations to actions of the unit range.

A policy is a callable `[B, S + 2] → [B, A]`, a Stable-Baselines3 model or policy, or the path of an
SB3 model's .zip or of an .onnx file. An SB3 .zip is code, and an .onnx file is run in this process
without any limit: open only those whose author you trust.

A team's is a dict from each agent's name to a policy of what that agent observes and owns,
`[B, |O_i| + 2] → [B, a_i]`; or one policy for all agents, asked for each in turn with its shared
observation (`envs.shared`), `[B, S + 2 + n] → [B, max a_i]`. A function of the whole state is no
team's policy: under partial observation no agent could follow it.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from sme_registry.envs import actions
from sme_registry.envs.shared import Observation as Observations
from sme_registry.envs.shared import shared_observation_of
from sme_registry.errors import (
    ActionError,
    MissingDependencyError,
    OptionError,
    PolicyError,
    did_you_mean,
)
from sme_registry.spec import SMESpec
from sme_registry.task import draw
from sme_registry.task.draw import Array

ActionRange = Literal["unit", "symmetric"]
_LOW = {"unit": 0.0, "symmetric": -1.0}

# A saved model does not name its algorithm. These fields do; the first that is there decides.
_ALGORITHM_MARKS = {
    "clip_range": "PPO",
    "target_entropy": "SAC",
    "policy_delay": "TD3",  # DDPG is TD3 with other settings, and loads as one
    "gae_lambda": "A2C",
}


@dataclass(frozen=True)
class Policy:
    """A policy ready to be asked.

    Attributes:
      name: what reports call it.
      action_range: the range of what `act` returns, "unit" or "symmetric".
      act: observations float32 to actions; unchecked.
      action_dim: A, entries of an action.
      asked: how it is asked, for who wonders what it was given.
    """

    name: str
    action_range: ActionRange
    act: Callable[[Observations], Any]
    action_dim: int
    asked: str = ""

    def __call__(self, observations: Observations) -> Array:
        """Actions `[B, A]` in units of the unit range, not yet clipped to it.

        Raises:
          PolicyError: it fails, or returns something else than `[B, A]` finite numbers.
        """
        try:
            returned = self.act(observations)
            shape = (len(observations), self.action_dim)
            a = actions.checked(returned, shape, self.action_range == "symmetric")
            if not np.isfinite(a).all():
                raise actions.not_finite()
            return a
        except ActionError as error:
            raise PolicyError(
                f"policy {self.name!r}: {error} It is given observations "
                f"[{len(observations)}, {observations.shape[1]}] and must return one action a row."
                f"{self.asked}"
            ) from None
        except PolicyError:
            raise
        except Exception as error:
            raise PolicyError(
                f"policy {self.name!r} failed on observations of shape {observations.shape}: "
                f"{type(error).__name__}: {error}{'.' * bool(self.asked)}{self.asked}"
            ) from error


@dataclass(frozen=True)
class TeamPolicy:
    """A team's policies ready to be asked, as one policy of the joint action.

    Attributes:
      name: what reports call it.
      action_range: "unit" or "symmetric"; "mixed" where the agents' policies differ.
      members: the agents, in the order of the channels that they own.
    """

    name: str
    action_range: ActionRange | Literal["mixed"]
    members: tuple[Member, ...]

    def __call__(self, observations: Observations) -> Array:
        """Joint actions `[B, A]` in units of the unit range, not yet clipped to it.

        Args:
          observations: `[B, S + 2]`: s, t/T and r_cum/k, the same for each agent.

        Raises:
          PolicyError: an agent's policy fails, or its actions cannot be used; says whose.
        """
        joint = []
        for member in self.members:
            with _said_of(member.agent):
                a = member.policy(member.seen(observations))
            joint.append(a[:, : member.action_dim])
        return np.concatenate(joint, axis=1)


class Member(NamedTuple):
    """One agent of a team policy.

    Attributes:
      agent: its name.
      policy: its own policy, or the one that all agents share.
      seen: what the policy is shown of observations `[B, S + 2]`; a fresh array.
      action_dim: a_i, how many entries of the policy's action are this agent's.
    """

    agent: str
    policy: Policy
    seen: Callable[[Observations], Observations]
    action_dim: int


def as_policy(
    policy: Any, spec: SMESpec, *, action_range: str | None = None, name: str | None = None
) -> Policy | TeamPolicy:
    """A policy given in any of the forms that this module's head lists.

    Args:
      policy: the policy.
      spec: the task it is for.
      action_range: the range of its actions; None takes an SB3 model's own action space, and
        "unit" for a callable or an .onnx file.
      name: what reports call it; None takes the file's, algorithm's or function's name.

    Raises:
      PolicyError: it is none of these, cannot be loaded, or is made for other spaces; or an agent
        of a team is missing or unknown.
      OptionError: `action_range` is neither "unit" nor "symmetric".
      MissingDependencyError: a .zip is given and Stable-Baselines3 is not installed, or an .onnx
        file and onnxruntime is not.
    """
    if action_range not in (None, *_LOW):
        raise OptionError(f"action_range={action_range!r}: must be 'unit' or 'symmetric'.")
    S, A = spec.state_dim, spec.action_dim
    if spec.team is None:
        return _prepared(policy, (S + 2, A), f"state_dim={S}, action_dim={A}", action_range, name)
    if isinstance(policy, Mapping):
        return _separate(policy, spec, action_range, name)
    return _shared(policy, spec, action_range, name)


def _prepared(
    policy: Any,
    dims: tuple[int, int],
    of: str,
    action_range: str | None,
    name: str | None,
    form: str = "",
    asked: str = "",
) -> Policy:
    """A policy from observations of `dims[0]` entries to actions of `dims[1]`.

    Args:
      policy: a callable, a model or a path.
      dims: entries of an observation, and of an action.
      of: what these widths are of, for a model made for others.
      action_range: as in `as_policy`.
      name: as in `as_policy`.
      form: what else a policy may be, for what is none.
      asked: as in `Policy`.
    """
    if isinstance(policy, str | os.PathLike):
        name = Path(policy).stem if name is None else name
        is_onnx = Path(policy).suffix == ".onnx"
        policy = load_onnx(policy, dims, of) if is_onnx else load_sb3(policy)
    if hasattr(policy, "predict"):
        _refuse_other_spaces(policy, dims, of)
        act = _predictor(policy)
        range_ = action_range or _range_of(policy)
    elif callable(policy):
        act, range_ = policy, action_range or "unit"
    else:
        raise PolicyError(
            f"policy={policy!r:.80}: must be {form}a callable from observations [B, {dims[0]}]"
            f" to actions [B, {dims[1]}], a Stable-Baselines3 model, or the path of a model's .zip "
            "or .onnx."
        )
    return Policy(name or _name_of(policy), cast(ActionRange, range_), act, dims[1], asked)


def _separate(
    policies: Mapping[str, Any], spec: SMESpec, action_range: str | None, name: str | None
) -> TeamPolicy:
    """A team in which each agent has a policy of its own."""
    agents = draw.agents(spec)
    _refuse_other_names(policies, [agent.name for agent in agents])
    members = []
    for agent, observed in zip(agents, draw.observed_channels(spec), strict=True):
        dims = len(observed) + 2, agent.action_dim
        of = f"{len(observed)} observed and {agent.action_dim} owned channels"
        with _said_of(agent.name):
            own = _prepared(policies[agent.name], dims, of, action_range, None)
        columns = [*observed, spec.state_dim, spec.state_dim + 1]
        members.append(Member(agent.name, own, _columns(columns), agent.action_dim))
    names = {member.policy.name for member in members}
    ranges = {member.policy.action_range for member in members}
    return TeamPolicy(
        name or (names.pop() if len(names) == 1 else f"{len(members)} policies"),
        ranges.pop() if len(ranges) == 1 else "mixed",
        tuple(members),
    )


def _shared(policy: Any, spec: SMESpec, action_range: str | None, name: str | None) -> TeamPolicy:
    """A team in which all agents share one policy."""
    agents = draw.agents(spec)
    dims = spec.state_dim + 2 + len(agents), max(agent.action_dim for agent in agents)
    one = _prepared(
        policy,
        dims,
        f"a policy that all {len(agents)} agents share",
        action_range,
        name,
        form="a dict from each agent's name to its policy; or for all agents ",
        asked=f" A team's one policy is asked for each agent in turn, from its shared observation "
        f"[B, {dims[0]}] to [B, {dims[1]}]; for separate policies give a dict by agent.",
    )
    members = tuple(
        Member(agent.name, one, _shown(index, len(agents), observed), agent.action_dim)
        for index, (agent, observed) in enumerate(
            zip(agents, draw.observed_channels(spec), strict=True)
        )
    )
    return TeamPolicy(one.name, one.action_range, members)


def _columns(columns: list[int]) -> Callable[[Observations], Observations]:
    return lambda observations: observations[:, columns]


def _shown(
    agent: int, agents: int, observed: tuple[int, ...]
) -> Callable[[Observations], Observations]:
    return lambda observations: shared_observation_of(agent, agents, observed, observations)


def _refuse_other_names(policies: Mapping[str, Any], names: list[str]) -> None:
    missing = [name for name in names if name not in policies]
    unknown = [name for name in policies if name not in names]
    said = [f"{', '.join(missing)}: policy missing."] if missing else []
    if unknown:
        hint = did_you_mean(str(unknown[0]), missing or names)
        said.append(f"{', '.join(map(repr, unknown))}: no such agent.{hint}")
    if said:
        raise PolicyError(f"policy: {' '.join(said)} Give one for each of {', '.join(names)}.")


@contextlib.contextmanager
def _said_of(agent: str) -> Iterator[None]:
    """Errors of an agent's policy begin with its name."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"{agent}: {error}") from error.__cause__


def load_sb3(path: str | os.PathLike[str]) -> Any:
    """Load a model that Stable-Baselines3 saved, on the CPU and without its environment.

    Args:
      path: a .zip of PPO, SAC, TD3, A2C or DDPG (which loads as TD3). Loading one can run code
        of whoever made it.

    Raises:
      PolicyError: missing, not such a file, or of an unknown algorithm.
      MissingDependencyError: Stable-Baselines3 is not installed.
    """
    path = Path(path)
    fields = _saved_fields(path)
    algorithm = next((name for mark, name in _ALGORITHM_MARKS.items() if mark in fields), None)
    if algorithm is None:
        raise PolicyError(
            f"{path}: a model of an unknown algorithm; known: PPO, SAC, TD3, A2C, DDPG. Load it "
            "yourself and give the model, or a callable around it."
        )
    try:
        import stable_baselines3
    except ImportError:
        raise MissingDependencyError(
            f"{path}: Stable-Baselines3 is needed to load it and is not installed. "
            "Run `pip install 'sme-registry[train]'`."
        ) from None
    try:
        # A replay buffer would be allocated at its full size, to act without ever being used.
        return getattr(stable_baselines3, algorithm).load(
            path, device="cpu", custom_objects={"buffer_size": 1}
        )
    except Exception as error:
        raise PolicyError(
            f"{path}: cannot be loaded as a {algorithm} model: {type(error).__name__}: {error}. "
            "Save it again with the installed stable-baselines3, or load it yourself and give "
            "the model."
        ) from error


def load_onnx(
    path: str | os.PathLike[str], dims: tuple[int, int], of: str = "this task"
) -> Callable[[Observations], Any]:
    """Load an ONNX file's network, on one thread of the CPU.

    Args:
      path: an .onnx file with one float32 input `[B, dims[0]]` and one output `[B, dims[1]]`.
        It runs in this process: give no stranger's.
      dims: entries of an observation, and of an action.
      of: what these widths are of, for a network made for others.

    Returns:
      Its actions, as a function of observations.

    Raises:
      PolicyError: missing, refused by onnxruntime, or of another interface.
      MissingDependencyError: onnxruntime is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise PolicyError(f"{path}: there is no such file. Give the path of an .onnx file.")
    # Its telemetry, on by default from 1.31 on, is nothing that an evaluation should switch on.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime
    except ImportError:
        raise MissingDependencyError(
            f"{path}: onnxruntime is needed to run it and is not installed. "
            "Run `pip install 'sme-registry[onnx]'`."
        ) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong is raised
    try:
        session = onnxruntime.InferenceSession(
            os.fspath(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:
        raise PolicyError(
            f"{path}: not a network that onnxruntime loads: {error}. Export it again, with an "
            "opset from 13 to 23, or give a callable."
        ) from error
    for what, ends, width in zip(
        ("input", "output"), (session.get_inputs(), session.get_outputs()), dims, strict=True
    ):
        told = ", ".join(f"{end.name} {end.type} {end.shape}" for end in ends)
        # A length that is not a number is open: it is known when the network has run.
        fits = len(ends) == 1 and ends[0].type == "tensor(float)" and len(ends[0].shape) == 2
        if not fits or any(
            isinstance(length, int) and length != wanted
            for length, wanted in zip(ends[0].shape, (None, width), strict=True)
        ):
            raise PolicyError(
                f"{path}: its {what}s are {told or 'none'}: must be one tensor(float) "
                f"[batch, {width}] for {of}, the batch of any size. Evaluate it on the task it was "
                "trained for, and export it with a dynamic batch axis."
            )
    observation = session.get_inputs()[0].name
    return lambda observations: session.run(None, {observation: observations})[0]


def _saved_fields(path: Path) -> set[str]:
    """The names of a saved model's fields; reads JSON only, runs nothing."""
    if not path.is_file():
        raise PolicyError(f"{path}: there is no such file. Give the path of a saved model (.zip).")
    try:
        with zipfile.ZipFile(path) as archive:
            fields = json.loads(archive.read("data"))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError):
        fields = None
    if not isinstance(fields, dict):
        raise PolicyError(
            f"{path}: not a model that Stable-Baselines3 saved. Give the .zip that `model.save` "
            "wrote, or in Python a callable."
        )
    return set(fields)


def _predictor(model: Any) -> Callable[[Observations], Any]:
    """The deterministic actions of an object with `predict`, before clipping where it is SB3's."""
    sb3 = sys.modules.get("stable_baselines3.common.policies")
    network = getattr(model, "policy", model)
    if sb3 is None or not isinstance(network, sb3.BasePolicy):

        def predict(observations: Observations) -> Any:
            predicted = model.predict(observations, deterministic=True)
            return predicted[0] if isinstance(predicted, tuple) else predicted

        return predict

    import torch

    def act(observations: Observations) -> Any:
        was_training = network.training
        network.set_training_mode(False)
        try:
            with torch.no_grad():
                batch = torch.as_tensor(observations, device=network.device)
                # `predict` would also clip a Gaussian's mean, and hide how much of it is clipped.
                chosen = network._predict(batch, deterministic=True).cpu().numpy()
        finally:
            network.set_training_mode(was_training)
        return network.unscale_action(chosen) if network.squash_output else chosen

    return act


def _refuse_other_spaces(model: Any, dims: tuple[int, int], of: str) -> None:
    for what, width in zip(("observation", "action"), dims, strict=True):
        found = getattr(getattr(model, f"{what}_space", None), "shape", (width,))
        if found != (width,):
            raise PolicyError(
                f"policy: its {what}s have shape {found}: must be {(width,)} for {of}. "
                "Evaluate it on the task it was trained for."
            )
    normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
    if getattr(normaliser, "norm_obs", False):
        raise PolicyError(
            "policy: it was trained on observations that VecNormalize rescaled, and here are "
            "none. Give a callable: "
            "lambda obs: model.predict(vec_normalize.normalize_obs(obs), deterministic=True)[0]."
        )


def _range_of(model: Any) -> str:
    """The action range that a model's own action space is."""
    space = getattr(model, "action_space", None)
    if space is None:
        return "unit"
    with contextlib.suppress(AttributeError):
        for range_, low in _LOW.items():
            if np.all(space.low == low) and np.all(space.high == 1.0):
                return range_
    raise PolicyError(
        f"policy: its action space is {space}: must be [0, 1] or [-1, 1] in every channel. "
        "Train it on one of them, or give a callable that rescales its actions."
    )


def _name_of(policy: Any) -> str:
    name = getattr(policy, "__name__", type(policy).__name__)
    return "policy" if name in ("<lambda>", "function") else str(name)
