"""The algorithms by name, loaded when they are needed: importing PyTorch takes seconds.

And how all of them are run here: on one thread, quietly, with a replay buffer of the size needed.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import warnings
from collections.abc import Iterator
from typing import Any

from sme_registry.errors import MissingDependencyError, UnknownNameError, did_you_mean
from sme_registry.spec import SMESpec

# Each with what `sme train --help` says of it. The value's class is in `stable_baselines3`.
ALGORITHMS = {
    "TD3": "off-policy, deterministic; the fastest learner on the default task",
    "SAC": "off-policy, entropy-regularised",
    "DDPG": "off-policy, deterministic; TD3's ancestor",
    "PPO": "on-policy; ten times faster a step, and many more steps to learn",
    "A2C": "on-policy",
}
_ON_POLICY = ("PPO", "A2C")
_TEAMS_AT_ONCE = 8
_ROLLOUT, _FEWEST_STEPS = 2048, 16  # SB3's PPO collects this many of one environment
_MAX_REPLAY = 1_000_000  # SB3's default


def default_algorithm(spec: SMESpec) -> str:
    """What trains where nothing else is asked for: TD3, and on a team PPO."""
    return "TD3" if spec.team is None else "PPO"


def default_num_envs(spec: SMESpec, algorithm: str) -> int:
    """Environments at once where nothing else is asked for: 1, and of a team on-policy 8.

    Off-policy more of them would mean fewer updates.
    """
    return _TEAMS_AT_ONCE if spec.team is not None and algorithm in _ON_POLICY else 1


def rollout_steps(spec: SMESpec, algorithm: str, num_envs: int) -> int | None:
    """PPO's `n_steps` on a team; None leaves SB3's default.

    Its default, 2,048 steps, is of each lane, and a team has a lane for each agent: 8 teams of 4
    would collect 65,536 transitions for one update. On Team4, seed 0, 16,384 steps of the team then
    left r̃ at 0.77; with 2,048 transitions shared out over the lanes it was 0.85. So trained, mean
    regret fell from 0.89 to 0.14 by step 55,000, and then rose again, to 0.55 at 100,000; with four
    times the rollout it fell steadily and slower, to 0.23 at 64,000.
    """
    if spec.team is None or algorithm != "PPO":
        return None
    return max(_FEWEST_STEPS, _ROLLOUT // (num_envs * len(spec.team.agents)))


def known_algorithm(name: str) -> str:
    """The algorithm's name as it is written, whatever the case it was given in.

    Raises:
      UnknownNameError: no such algorithm; says which there are and what is near.
    """
    by_fold = {known.casefold(): known for known in ALGORITHMS}
    found = by_fold.get(str(name).casefold())
    if found is None:
        raise UnknownNameError(
            f"algorithm={name!r}: must be one of {', '.join(ALGORITHMS)}."
            f"{did_you_mean(str(name), ALGORITHMS)}"
        )
    return found


def refuse_without_dependencies() -> None:
    """Raise where Stable-Baselines3 or PyTorch is not installed; imports neither.

    Raises:
      MissingDependencyError: says what to install.
    """
    for package, known_as in (("stable_baselines3", "Stable-Baselines3"), ("torch", "PyTorch")):
        if importlib.util.find_spec(package) is None:
            raise MissingDependencyError(
                f"training: {known_as} is not installed. Run `pip install 'sme-registry[train]'`."
            )


def load_algorithm(name: str) -> Any:
    """The algorithm's class.

    Raises:
      UnknownNameError: no such algorithm.
      MissingDependencyError: Stable-Baselines3 is not installed.
    """
    name = known_algorithm(name)
    refuse_without_dependencies()
    # It imports the retired `gym` where that is installed, which then prints a long notice.
    with contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return getattr(importlib.import_module("stable_baselines3"), name)


def is_sb3(found: Any) -> bool:
    """Whether this is a class of Stable-Baselines3's kind, or an object of one."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    return issubclass(found if isinstance(found, type) else type(found), BaseAlgorithm)


def replay_settings(algorithm: Any, transitions: int) -> dict[str, int]:
    """The size of an off-policy algorithm's replay buffer; nothing for another.

    Never smaller than what will be stored, so nothing that SB3's default would do changes.
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    if not issubclass(algorithm, OffPolicyAlgorithm):
        return {}
    return {"buffer_size": min(_MAX_REPLAY, transitions)}


def silence(model: Any) -> None:
    """Have an SB3 model log nowhere; left to itself it makes a folder among temporary files."""
    from stable_baselines3.common.logger import Logger

    model.set_logger(Logger(None, []))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """No warnings of the libraries below: they speak to programmers about their own insides."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One thread for PyTorch, whose default is put back afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
